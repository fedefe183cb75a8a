import numpy as np
import pytest
from marks import dots, measure

from shortfinal.data import augment
from shortfinal.data.augment import (
    EFFECTS,
    Warp,
    augmented_crop,
    beside_warp,
    corner_looks,
    inside,
    native_warp,
    night,
    occlusion,
    random_warp,
    uneven,
    within,
)
from shortfinal.data.dataset import Example, plan_shot
from shortfinal.geometry import Camera, project
from shortfinal.keypoints import AIMING_NAMES, CORNER_NAMES

SIZE = 224
LARD = Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)
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
        np.testing.assert_array_equal(np.argsort(heights), np.argsort(HEIGHTS[order]))
        if sigma * warp.scale >= 1:  # a narrower dot, of a wide crop, is as high as its place between pixels lets it be
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
        crop, moved = augmented_crop(shot, SIZE, np.random.default_rng(seed))
        assert crop.shape == (SIZE, SIZE, 3)
        assert crop.dtype == np.uint8
        assert np.isfinite(moved).all()
        scale = np.linalg.norm(moved[0] - moved[1]) / np.linalg.norm(corners[0] - corners[1])
        seen = moved[inside(moved, SIZE, SIZE)]  # few crops are beside the runway, or cut it
        if len(seen):
            errors += list(np.abs(measure(crop, seen, sigma * scale)[0]).max(axis=1) / max(1, scale))
    assert len(errors) > 70
    assert np.median(errors) < 0.1  # px of the image or the crop, the coarser


# What is not wholly in the picture, or not at all.

# The near end is below an image 640 x 480.
CUT = np.array([[150.3, 900.2], [480.8, 905.7], [340.1, 200.9], [290.6, 203.4]])


def test_inside_is_up_to_the_edges_of_the_pixels():
    points = np.array([[-0.5, 0], [-0.6, 0], [9.5, 4.5], [9.6, 0], [0, 4.6], [np.nan, 0], [0, np.nan], [3, np.inf]])
    assert inside(points, 10, 5).tolist() == [True, False, True, False, False, False, False, False]
    shot = Example(np.zeros((480, 640, 3), np.uint8), CUT)
    np.testing.assert_array_equal(within(shot)[2:], CUT[2:])
    assert np.isnan(within(shot)[:2]).all()
    assert np.isnan(within(Example(shot.image, None))).all()


def test_a_crop_of_a_runway_that_is_cut_holds_what_the_picture_does():
    rng, scales = np.random.default_rng(8), []
    for corners in (CUT, np.where(CUT > 600, np.nan, CUT)):
        for _ in range(50):
            warp = random_warp(corners, (640, 480), SIZE, rng)
            far = warp.apply(corners)[2:]
            assert ((far > 0) & (far < SIZE - 1)).all()
            assert far[0, 0] > far[1, 0]
            scales.append(warp.scale)
    # The far end is 50 px wide: its crops are 1.15 to 8 times that.
    assert SIZE / (8 * 50) < min(scales) < max(scales) < SIZE / (1.15 * 49)


ONE = np.where(np.eye(4)[:, :1] > 0, CORNERS, np.nan)


@pytest.mark.parametrize("corners", [ONE * np.nan, CUT + 1000, ONE], ids=["none", "beyond", "one"])
def test_of_a_picture_without_a_runway_any_part_may_come(corners):
    rng, reach = np.random.default_rng(9), []
    for _ in range(200):
        warp = random_warp(corners, (640, 480), SIZE, rng)
        ends = np.array([[0, 0, 1], [SIZE - 1, SIZE - 1, 1]]) @ warp.image_from_crop.T
        reach.append(ends[np.argsort(ends[:, 0])])
    reach = np.array(reach)
    # All over the picture, and seldom beyond: 5 % overhang, and a third, turned by 7 degrees, do by 12 % of their side.
    assert reach[:, 0, 0].min() < 60
    assert reach[:, 1, 0].max() > 580
    over = np.maximum(-reach[:, 0, 0], reach[:, 1, 0] - 639)
    assert np.mean(over > 1) < 0.35
    assert over.max() < 400


def test_native_crops_are_the_pictures_own_pixels():
    rng = np.random.default_rng(10)
    image = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
    mirrored = 0
    for _ in range(20):
        warp = native_warp(CORNERS, (640, 480), SIZE, rng)
        crop = warp.cut(image)
        assert warp.scale == pytest.approx(1)
        left, top = np.round((np.array([[0, 0, 1], [SIZE - 1, 0, 1]]) @ warp.image_from_crop.T).min(axis=0)).astype(int)
        part = image[top : top + SIZE, left : left + SIZE]
        np.testing.assert_array_equal(crop, part[:, ::-1] if warp.mirrored else part)
        expected = CORNERS - [left, top]
        if warp.mirrored:
            expected = (np.array([SIZE - 1, 0]) + expected * [-1, 1])[[1, 0, 3, 2]]
        np.testing.assert_allclose(warp.apply(CORNERS), expected, atol=1e-9)
        mirrored += warp.mirrored
    assert 2 <= mirrored <= 18
    # A runway of 131 px in a crop of 64 is halved twice.
    assert native_warp(CORNERS, (640, 480), 64, rng).scale == pytest.approx(0.25)


def test_beside_the_runway_there_is_none_of_it():
    rng = np.random.default_rng(11)
    low, high = CORNERS.min(axis=0), CORNERS.max(axis=0)
    outline = np.array([[u, v] for u in np.linspace(low[0], high[0], 9) for v in np.linspace(low[1], high[1], 9)])
    warps = [beside_warp(CORNERS, (640, 480), SIZE, rng) for _ in range(100)]
    assert sum(warp is None for warp in warps) < 40  # for the widest of a quarter there is no room
    for warp in filter(None, warps):
        moved = outline @ warp.crop_from_image[:, :2].T + warp.crop_from_image[:, 2]
        assert not inside(moved, SIZE, SIZE).any()
        ends = np.array([[-0.5, -0.5, 1], [SIZE - 0.5, SIZE - 0.5, 1]]) @ warp.image_from_crop.T
        assert ends.min() > -0.5 - 1e-6
        assert (ends.max(axis=0) < [639.5 + 1e-6, 479.5 + 1e-6]).all()
    assert {warp.mirrored for warp in filter(None, warps)} == {True, False}
    assert beside_warp(CORNERS * 1.4, (640, 480), SIZE, rng) is None  # a runway of 188 px has no room beside it


def test_corners_that_are_not_in_the_picture_are_not_numbers():
    grey = np.full((480, 640, 3), 90, np.uint8)
    for seed in range(40):
        for corners, gone in ((CUT, 2), (None, 4), (np.where(CORNERS > 350, np.nan, CORNERS), 1)):
            crop, moved = augmented_crop(Example(grey, corners), SIZE, np.random.default_rng(seed))
            assert crop.shape == (SIZE, SIZE, 3)
            assert np.isnan(moved).all(axis=1).sum() == gone
            assert np.isfinite(moved).all(axis=1).sum() == 4 - gone


def test_where_a_crop_hangs_over_the_border_there_is_no_corner():
    # The near end lies 3 px below the picture: crops that reach there show black, and must not be told of it.
    corners = np.array([[20.0, 103], [80, 103], [70, 60], [30, 60]])
    image = np.full((100, 100, 3), 90, np.uint8)
    shot, reached = Example(image, corners), 0
    for seed in range(600):
        warp = random_warp(within(shot), (100, 100), SIZE, np.random.default_rng(seed))
        if inside(warp.apply(corners), SIZE, SIZE)[:2].any():
            crop, moved = augmented_crop(shot, SIZE, np.random.default_rng(seed), weather=False)
            np.testing.assert_array_equal(crop, warp.cut(image))
            assert np.isnan(moved[:2]).all()
            reached += 1
    assert reached > 3


def test_some_crops_of_a_whole_runway_are_beside_it_and_some_cut_it():
    shot = example(CORNERS * 0.3 + 100, 2.0)  # 39 px long: room enough
    kept = np.array([
        inside(augmented_crop(shot, 64, np.random.default_rng(seed), weather=False)[1], 64, 64).sum()
        for seed in range(400)
    ])  # fmt: skip
    assert 10 < (kept == 0).sum() < 54  # 8 %: 32 +- 4 standard deviations of 5.4
    # Moved by up to half their side, 6 % of the others; some of them, of the wide ones, still hold all of it.
    assert 2 < ((kept > 0) & (kept < 4)).sum() < 41


def test_without_weather_the_picture_is_only_cut():
    shot = example(CORNERS, 2.5)
    for seed in range(4):  # none of which moves the crop off the runway
        crop, corners = augmented_crop(shot, SIZE, np.random.default_rng(seed), kind="native", weather=False)
        warp = native_warp(CORNERS, (640, 480), SIZE, np.random.default_rng(seed))
        np.testing.assert_array_equal(crop, warp.cut(shot.image))
        np.testing.assert_array_equal(corners, warp.apply(CORNERS))
        # What is not whole has no such crop, and is framed.
        cut = Example(shot.image, CUT)
        _, framed = augmented_crop(cut, SIZE, np.random.default_rng(seed), kind="native", weather=False)
        warp = random_warp(within(cut), (640, 480), SIZE, np.random.default_rng(seed))
        np.testing.assert_array_equal(framed, warp.apply(within(cut)))


def test_further_keypoints_move_and_change_sides_with_the_corners():
    # The aiming point's marking, its near end beyond the picture.
    points = np.vstack([CORNERS, [[280.0, 700], [350, 701], [350, 281], [280, 280]]])
    names = (*CORNER_NAMES, *AIMING_NAMES)
    orders = set()
    for seed in range(20):
        shot = Example(np.zeros((480, 640, 3), np.uint8), points, names)
        options = {"weather": False, "kind": "native"}
        _, four = augmented_crop(Example(shot.image, CORNERS), SIZE, np.random.default_rng(seed), **options)
        _, eight = augmented_crop(shot, SIZE, np.random.default_rng(seed), **options)
        np.testing.assert_array_equal(eight[:4], four)
        assert np.isnan(eight[4:6]).all()
        assert eight[7, 0] < eight[6, 0]  # left is left
        np.testing.assert_allclose(np.linalg.norm(eight[6] - eight[7]), np.hypot(70, 1))
        orders.add(bool(eight[7, 1] > eight[6, 1]))
        _, none = augmented_crop(Example(shot.image, None, names), SIZE, np.random.default_rng(seed))
        assert none.shape == (8, 2)
    assert orders == {True, False}


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.apply.__name__)
@pytest.mark.parametrize("count", [0, 1, 2])
def test_effects_need_no_corners(effect, count):
    light = dots((SIZE, SIZE), MARKED.apply(CORNERS), 2.0, 60.0, 120.0).round().astype(np.uint8)
    rng = np.random.default_rng(12)
    crops = [effect.apply(light, MARKED.apply(CORNERS)[:count], rng) for _ in range(10)]
    assert all(crop.shape == light.shape and crop.dtype == np.uint8 for crop in crops)
    assert any((crop != light).any() for crop in crops)


def test_corners_are_where_their_patches_show_them(monkeypatch):
    monkeypatch.setattr(augment, "_UNEVEN", 0.0)  # which is tested below
    shot, rng, off, offsets = example(CORNERS, 3.0), np.random.default_rng(20), [], []
    for _ in range(60):
        patches, places, scale = corner_looks(shot, rng, weather=False)
        assert patches.shape == (4, 48, 48, 3)
        for patch, place, enlarged in zip(patches, places, scale):
            if np.isfinite(place).all() and 1 < enlarged * 3.0 < 4 and (np.abs(place - 23.5) < 12).all():
                v, u = np.indices(patch.shape[:2])
                near = np.hypot(u - place[0], v - place[1]) < 11  # other corners' dots are farther
                weight = np.clip(patch[..., 0] - 75.0, 0, None) * near  # of a ground of 60; black beyond it
                centre = np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()
                off.append(np.abs(centre - place).max())
                offsets.append(place - 23.5)
    assert len(off) > 40
    # Where a patch's axes are nearly parallel, a dot is a few pixels of it.
    assert np.quantile(off, 0.95) < 0.35
    assert np.std(offsets) > 2  # first looks are off


def test_a_first_look_may_be_far_off_or_of_nothing():
    rng = np.random.default_rng(21)
    missed = sum(
        (np.abs(corner_looks(example(CORNERS, 3.0), rng, weather=False)[1] - 23.5) > 24).any() for _ in range(300)
    )
    assert missed > 0
    _, places, _ = corner_looks(Example(example(CORNERS, 3.0).image, None), rng)
    assert np.isnan(places).all()
    one = Example(example(CORNERS, 3.0).image, np.where(np.eye(4)[:, :1] > 0, CORNERS, np.nan))
    assert np.isfinite(corner_looks(one, rng)[1]).all(axis=1).sum() <= 1


class Profile:
    """A generator whose normal numbers are given."""

    def __init__(self, *numbers):
        self.numbers = np.array(numbers)

    def normal(self, mean, sigma):
        return self.numbers


@pytest.mark.parametrize("rise", [-0.3, -0.1, 0.1, 0.25])
def test_a_far_end_is_where_the_camera_would_see_it_higher_or_lower(rise):
    compared = 0
    for index in range(60):
        shot = plan_shot(5, index, LARD, 224)
        raised = shot.runway.corners.copy()
        raised[2:, 2] = rise * shot.runway.width_m
        if abs(raised[2, 2]) > 0.3 * shot.pose.position_m[2]:  # steeper than runways are
            continue
        flat = Example(np.zeros((224, 224, 3), np.uint8), shot.corners_px)
        bent = uneven(flat, Profile(0.0, 0.0, rise))
        moved = np.abs(bent.keypoints_px - shot.corners_px)
        assert moved[:2].max() < 1e-4  # OpenCV's homography takes float32
        # Upright lines lean towards each other a little where the camera looks down: by less than a twentieth.
        off = np.abs(bent.keypoints_px - project(shot.camera, shot.pose, raised)).max()
        assert off < 0.05 * moved[2:].max() + 0.01
        compared += 1
    assert compared > 20


def test_what_is_bent_is_seen_where_its_corners_are_said_to_be():
    rng, off = np.random.default_rng(8), []
    for _ in range(100):
        corners = np.array([[60.0, 180], [170, 184], [136, 60], [110, 60]]) + rng.uniform(-8, 8, (4, 2))
        bent = uneven(example(corners, 1.5, (SIZE, SIZE)), rng)
        seen = np.isfinite(bent.keypoints_px).all(axis=1)
        assert seen[:2].all()
        off.append(measure(bent.image, bent.keypoints_px[seen], 1.5)[0])
    off = np.concatenate(off)
    assert len(off) > 350
    # A dot is drawn out or squeezed along the runway, a little less at its near side than at its far one.
    assert np.abs(off.mean(axis=0)).max() < 0.02
    assert np.quantile(np.abs(off), 0.95) < 0.1


def test_behind_a_crest_there_is_no_corner():
    flat = example(np.array([[60.0, 180], [170, 180], [122, 62], [108, 62]]), 2.0, (SIZE, SIZE))
    assert np.isnan(uneven(flat, Profile(0.6, -0.5, -0.6)).keypoints_px[2:]).all()
    assert np.isfinite(uneven(flat, Profile(0.05, 0.0, 0.0)).keypoints_px).all()
    flat.keypoints_px[1] = np.nan
    assert uneven(flat, np.random.default_rng(0)) is flat
