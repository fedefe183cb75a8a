import numpy as np
import pytest
from marks import dots, measure

from shortfinal.data.augment import EFFECTS, Warp, augmented_crop, night, occlusion, random_warp
from shortfinal.data.dataset import Example

SIZE = 224
CORNERS = np.array([[250.3, 310.2], [380.8, 305.7], [340.1, 200.9], [290.6, 203.4]])  # of an image 640 x 480
HEIGHTS = np.array([60.0, 90.0, 120.0, 150.0])  # tell the corners apart


def example(corners, sigma, size=(640, 480)):
    return Example(dots(size, corners, sigma, 60.0, HEIGHTS).round().astype(np.uint8), corners)


@pytest.mark.parametrize(
    ("spread", "sigma"), [(1.0, 2.5), (0.35, 1.5), (2.0, 6.0)], ids=["as is", "magnified", "averaged"]
)
def test_corners_land_where_the_picture_shows_them(spread, sigma):
    # Crop, rotation and mirror at once. 2.0: the crop halves the picture, which averages blocks.
    middle = CORNERS.mean(axis=0)
    shot = example((CORNERS - middle) * spread * 1.4 + middle, sigma)
    rng, turns, mirrored = np.random.default_rng(1), [], 0
    for seed in rng.integers(0, 2**31, 40):
        warp = random_warp(shot.corners_px, (640, 480), SIZE, np.random.default_rng(seed))
        crop, corners = warp.cut(shot.image), warp.apply(shot.corners_px)
        assert ((corners > 0) & (corners < SIZE - 1)).all()
        shifts, heights = measure(crop, corners, sigma * warp.scale)
        assert np.abs(shifts).max() < 0.05
        order = [1, 0, 3, 2] if warp.mirrored else [0, 1, 2, 3]
        np.testing.assert_allclose(heights / heights.sum(), HEIGHTS[order] / HEIGHTS.sum(), rtol=0.1)
        assert corners[0, 0] < corners[1, 0]  # left is left
        mirrored += warp.mirrored
        turns.append(abs(warp.crop_from_image[1, 0]) / warp.scale)
    assert 8 < mirrored < 32  # 20 +- 4 standard deviations of 3.2
    assert 3 < np.sum(np.array(turns) > 0.002) < 25  # 12 +- 4 of 2.9
    assert np.max(turns) < np.sin(np.radians(7.01))


def test_a_warp_and_its_inverse_cancel():
    rng = np.random.default_rng(2)
    for _ in range(20):
        warp = random_warp(CORNERS, (640, 480), SIZE, rng)
        there = warp.crop_from_image @ np.vstack([CORNERS.T, np.ones(4)])
        back = warp.image_from_crop @ np.vstack([there, np.ones(4)])
        np.testing.assert_allclose(back.T, CORNERS, atol=1e-9)


def test_the_region_of_a_crop_is_all_it_shows():
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, (90, 110, 3), dtype=np.uint8)
    corners = np.array([[40.0, 60], [60, 58], [55, 40], [45, 41]])
    smaller = 0
    for _ in range(40):
        warp = random_warp(corners, (110, 90), SIZE, rng)
        part, moved = warp.region(image)
        # OpenCV rounds positions to 1/32 px, from another origin here: one level of contrast 255 / 32.
        assert np.abs(moved.cut(part).astype(int) - warp.cut(image)).max() <= 2 * 255 / 32 + 1
        np.testing.assert_allclose(moved.apply(corners - _origin(warp, moved)), warp.apply(corners))
        smaller += part.size < image.size
    assert smaller > 30


def _origin(warp, moved):
    """Where the region begins in the image."""
    return np.linalg.solve(warp.crop_from_image[:, :2], moved.crop_from_image[:, 2] - warp.crop_from_image[:, 2])


MARKED = Warp(np.array([[1.0, 0, -195.2], [0, 1.0, -140.6]]), SIZE)
EXACT = [effect.apply for effect in EFFECTS if effect.apply not in (night, occlusion)]


@pytest.mark.parametrize("effect", EXACT, ids=lambda effect: effect.__name__)
def test_no_effect_moves_a_corner(effect):
    corners = MARKED.apply(CORNERS)
    light = dots((SIZE, SIZE), corners, 2.0, 60.0, 120.0).round().astype(np.uint8)
    rng, changed = np.random.default_rng(4), 0
    for _ in range(60):
        crop = effect(light, corners, rng)
        shifts, heights = measure(crop, corners, 2.0)
        seen = heights > 10  # glare may drown one
        assert np.abs(shifts[seen]).max() < 0.1
        assert seen.mean() >= 0.5
        changed += bool((crop != light).any())
    assert changed > 50  # small drops on plain ground do not show


def test_night_moves_no_corner_on_average():
    # Its noise hides faint marks: so the mean of many, within four of its standard errors.
    corners = MARKED.apply(CORNERS)
    light = dots((SIZE, SIZE), corners, 2.0, 40.0, 120.0).round().astype(np.uint8)
    rng = np.random.default_rng(5)
    crops = [night(light, corners, rng) for _ in range(60)]
    shifts = np.array([measure(crop, corners, 2.0)[0] for crop in crops]).reshape(-1, 2)
    assert (np.abs(shifts.mean(axis=0)) < 4 * shifts.std(axis=0) / len(shifts) ** 0.5).all()
    assert np.abs(np.median(shifts, axis=0)).max() < 0.03
    assert np.mean([crop.mean() for crop in crops]) < 0.8 * light.mean()


def test_night_keeps_bright_points():
    picture = np.full((SIZE, SIZE, 3), 90, np.uint8)
    picture[100:110, 100:110] = 255
    rng = np.random.default_rng(6)
    for _ in range(20):
        dark = night(picture, CORNERS, rng)
        assert dark[102:108, 102:108].mean() > 200
        assert dark[:90].mean() < 75


def test_occlusion_hides_two_corners_at_most_and_moves_none():
    corners = MARKED.apply(CORNERS)
    light = dots((SIZE, SIZE), corners, 2.0, 60.0, 120.0).round().astype(np.uint8)
    rng, hidden = np.random.default_rng(7), []
    for _ in range(300):
        crop = occlusion(light, corners, rng)
        u, v = np.round(corners).astype(int).T
        covered = np.abs(crop[v, u].astype(int) - light[v, u]).mean(axis=1) > 40
        hidden.append(covered.sum())
        # Those with nothing near them stay where they are.
        near = [np.abs(crop[y - 7 : y + 8, x - 7 : x + 8].astype(int) - light[y - 7 : y + 8, x - 7 : x + 8]).max()
                for x, y in zip(u, v)]  # fmt: skip
        free = np.array(near) < 10
        if free.any():
            assert np.abs(measure(crop, corners[free], 2.0)[0]).max() < 0.1
    assert max(hidden) == 2
    assert hidden.count(0) > 150


def test_augmented_crops_follow_from_the_generator():
    shot = example(CORNERS, 2.0)
    one, same, other = (augmented_crop(shot, SIZE, np.random.default_rng(s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(one[0], same[0])
    np.testing.assert_array_equal(one[1], same[1])
    assert (one[0] != other[0]).any()


@pytest.mark.parametrize("side", [20, 80, 600], ids=["magnified", "native", "averaged"])
def test_augmented_crops_keep_marks_and_labels_together(side):
    # All at once: half of the marks, blurred and noisy as they are, are found near their labels.
    corners = np.array([[0.2, 0.9], [0.8, 0.85], [0.7, 0.1], [0.35, 0.12]]) * side * 0.6 + 0.2 * side
    sigma = max(1.0, side / 40)
    shot = Example(dots((side, side), corners, sigma, 60.0, 120.0).round().astype(np.uint8), corners)
    errors = []
    for seed in range(25):
        scale = random_warp(corners, (side, side), SIZE, np.random.default_rng(seed)).scale
        crop, moved = augmented_crop(shot, SIZE, np.random.default_rng(seed))
        assert crop.shape == (SIZE, SIZE, 3)
        assert crop.dtype == np.uint8
        assert np.isfinite(moved).all()
        errors.append(np.abs(measure(crop, moved, sigma * scale)[0]).max(axis=1) / max(1, scale))
    assert np.median(errors) < 0.1  # px of the image or the crop, the coarser
