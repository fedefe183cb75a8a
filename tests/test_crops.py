import numpy as np
import pytest
from scipy.stats import binomtest, chi2_contingency, chisquare, ks_2samp, kstest, loguniform, uniform

import shortfinal as sf
from shortfinal.crops import (
    PATCH_PX,
    bogo_crop,
    box_around,
    centre_crop,
    corner_patches,
    inverse_crop,
    native_crop,
    random_margin,
)
from shortfinal.detector import crop_image

BOX = np.array([100.0, 50.0, 180.0, 90.0])


def test_the_box_holds_the_keypoints():
    np.testing.assert_array_equal(box_around([[3, 9], [1, 2], [5, 4]]), [1, 2, 5, 9])


def test_the_centre_crop_is_centred_and_has_its_margin():
    window = centre_crop(BOX, 1.5, 224)
    assert (window.width, window.height) == (120, 120)
    assert window.apply([140, 70]) == pytest.approx([111.5, 111.5])


def same_distribution(one, other, bins=5):
    """p-values of two samples (N, 2), (M, 2): Kolmogorov-Smirnov by axis, and chi-square over a joint grid."""
    edges = [np.quantile(np.concatenate([one, other])[:, axis], np.linspace(0, 1, bins + 1)) for axis in range(2)]
    counts = np.array([np.histogram2d(*sample.T, bins=edges)[0].ravel() for sample in (one, other)])
    joint = chi2_contingency(counts[:, counts.sum(axis=0) > 0]).pvalue
    return [*(ks_2samp(one[:, axis], other[:, axis]).pvalue for axis in range(2)), joint]


@pytest.mark.parametrize("image_size", [None, (230, 400), (110, 400)], ids=["anywhere", "inside", "image inside"])
def test_bogo_crops_are_distributed_as_by_rejection(image_size):
    # The paper's loop: any position around, until one holds the box (and lies in the image).
    box = np.array([20.0, 10.0, 100.0, 60.0])
    rng = np.random.default_rng(3)
    crops = (bogo_crop(box, 1.5, 224, rng, image_size=image_size) for _ in range(4000))
    direct = np.array([(w.left, w.top) for w in crops])
    tries = rng.uniform([-110, -110], [210, 210], (200_000, 2))
    kept = (tries <= box[:2] + 0.5).all(axis=1) & (tries + 120 >= box[2:] + 0.5).all(axis=1)
    if image_size:
        over = np.array(image_size) - 120.0
        kept &= ((tries >= np.minimum(0, over)) & (tries <= np.maximum(0, over))).all(axis=1)
    assert min(same_distribution(direct, tries[kept])) > 0.001


def test_bogo_crops_keep_their_slack():
    rng = np.random.default_rng(4)
    for _ in range(200):
        px = bogo_crop(BOX, 1.5, 100, rng, slack=0.1).apply(BOX.reshape(2, 2))
        assert (px > 9).all()
        assert (px < 90).all()


def test_a_bogo_crop_as_large_as_the_image_is_the_image():
    # Where there is one position it is taken, not the box's centre.
    for margin in np.linspace(1.3, 1.9, 13):
        window = bogo_crop([0, 3, 50, 40], margin, 64, np.random.default_rng(0), image_size=(90, 50 * margin))
        assert window.top == pytest.approx(0, abs=1e-9)


def paper_positions(box, image_size, size, margin, factor):
    """Every whole-pixel crop of the halved image that the paper's loop would accept, (N, 2), by trying all.

    With one mend: the margin is not wanted beyond the image, or the loop would never end there.
    """
    width, height = (n // factor for n in image_size)
    left, top = np.meshgrid(np.arange(width - size + 1), np.arange(height - size + 1), indexing="ij")
    tries = np.column_stack([left.ravel(), top.ravel()])
    edges = (np.asarray(box) + 0.5) / factor
    low = np.maximum(edges[:2] - margin, 0)
    high = np.minimum(edges[2:] + margin, [width, height])
    fits = (tries <= low).all(axis=1) & (tries + size >= high).all(axis=1)
    return tries[fits]


@pytest.mark.parametrize(
    ("box", "image_size", "factor"),
    [
        ([30, 34.2, 38.7, 41], (70, 61), 1),  # native
        ([12, 11, 38.6, 30], (71, 61), 2),  # halved, odd sides
        ([3, 20, 50, 75], (133, 127), 4),  # the margin ends at the image's border
    ],
)
def test_native_crops_are_distributed_as_by_the_papers_loop(box, image_size, factor):
    rng = np.random.default_rng(5)
    size, margin = 16 if factor < 4 else 20, 1.0
    windows = [native_crop(box, image_size, rng, size, margin) for _ in range(6000)]
    assert {w.width for w in windows} == {size * factor}
    drawn = np.array([(w.left / factor, w.top / factor) for w in windows])
    np.testing.assert_array_equal(drawn, np.round(drawn))
    positions = paper_positions(box, image_size, size, margin, factor)
    counts = [np.sum((drawn == place).all(axis=1)) for place in positions]
    assert sum(counts) == len(drawn)  # no other position
    assert chisquare(counts).pvalue > 0.001
    if factor > 1:  # and none would fit with one halving less
        assert not len(paper_positions(box, image_size, size, margin, factor // 2))


def test_native_crops_of_small_images_and_at_borders():
    rng = np.random.default_rng(6)
    for _ in range(100):
        window = native_crop([2, 3, 30, 38], (50, 40), rng, 64)
        assert window.width == 64
        assert window.left <= 0 <= 50 <= window.left + 64  # the whole image is in it
        assert window.top <= 0 <= 40 <= window.top + 64
        window = native_crop([0, 0, 20, 98.5], (301, 301), rng, 128, 8.0)  # no margin beyond the border
        assert (window.left, window.top) == (0, 0) or window.left >= 0
    window = native_crop([0, 0, 300, 300], (301, 301), rng, 128, 8.0)  # in the odd last column
    assert (window.apply([300, 300]) < 127.5).all()


def test_halved_crops_are_block_means_to_the_pixel_centre():
    # Odd sides, any number of halvings, windows at any whole pixel, over the border as well.
    rng = np.random.default_rng(7)
    image = rng.integers(0, 256, (83, 97, 3), dtype=np.uint8)
    padded = np.pad(image, ((128, 128), (128, 128), (0, 0))).astype(float)
    for factor in (1, 2, 4, 8):
        for left, top in [(0, 0), (1, 3), (7, 5), (-3, -9), (60, 50), *rng.integers(-60, 80, (30, 2))]:
            window = sf.PixelWindow(int(left), int(top), 12 * factor, 8 * factor, 12, 8)
            part = padded[128 + top :, 128 + left :][: 8 * factor, : 12 * factor]
            means = part.reshape(8, factor, 12, factor, 3).mean(axis=(1, 3))
            assert np.abs(crop_image(image, window) - means).max() <= 0.501  # rounding to whole levels
    centre = sf.PixelWindow(4, 6, 48, 32, 12, 8).inverse([0, 0])
    np.testing.assert_allclose(centre, [4 + 1.5, 6 + 1.5])  # the middle of the first 4 x 4 block


def test_windows_between_pixels_agree_with_those_on_them():
    # A ramp is its own block mean and its own interpolation: the crop must show it at the window's pixel centres.
    v, u = np.mgrid[:120, :150]
    ramp = np.repeat((0.7 * u + 0.9 * v)[..., None], 3, axis=2)
    image = np.round(ramp).astype(np.uint8)
    rng = np.random.default_rng(8)
    for _ in range(60):
        shrink = rng.uniform(0.3, 5)
        window = sf.PixelWindow(*rng.uniform(8, 50, 2), 12 * shrink, 10 * shrink, 12, 10)
        at = window.inverse(np.moveaxis(np.mgrid[:10, :12][::-1], 0, -1))
        # Rounded twice or, averaged, three times; and OpenCV's positions are multiples of 1/32 block.
        bound = 1.5 + 1.6 * max(1, int(shrink)) / 32
        assert np.abs(crop_image(image, window)[..., 0] - (0.7 * at[..., 0] + 0.9 * at[..., 1])).max() < bound


@pytest.mark.parametrize(("image_size", "widest"), [((400, 300), 3.75), ((5000, 4000), 8.0)])
def test_one_margin_in_four_is_wide_where_there_is_room(image_size, widest):
    rng = np.random.default_rng(12)
    margins = np.array([random_margin(BOX, image_size, rng) for _ in range(4000)])  # the box is 80 long
    wide = margins > 1.9
    assert binomtest(int(wide.sum()), 4000, 0.25).pvalue > 0.001
    assert kstest(margins[~wide], uniform(1.15, 0.75).cdf).pvalue > 0.001
    assert kstest(margins[wide], loguniform(1.9, widest).cdf).pvalue > 0.001


@pytest.mark.parametrize(("extent", "most"), [(140, 1.75), (90, 1.2), (60, 1.2)])
def test_in_a_small_image_margins_are_what_it_holds(extent, most):
    rng = np.random.default_rng(13)
    margins = [random_margin(BOX, (900, extent), rng) for _ in range(2000)]
    assert kstest(margins, uniform(1.15, most - 1.15).cdf).pvalue > 0.001


def touches(left, top, side, box, keep):
    """Whether windows come closer than `keep` to the box."""
    return (
        (left < box[2] + 0.5 + keep)
        & (left + side > box[0] + 0.5 - keep)
        & (top < box[3] + 0.5 + keep)
        & (top + side > box[1] + 0.5 - keep)
    )


@pytest.mark.parametrize(
    "box", [BOX, [0, 0, 70, 50], [-20, 150, 40, 299]], ids=["within", "in a corner", "over a border"]
)
def test_inverse_crops_are_uniform_over_where_the_runway_is_not(box):
    rng = np.random.default_rng(11)
    size, box = np.array([400, 300]), np.asarray(box, float)
    drawn = [inverse_crop(box, (400, 300), 224, rng) for _ in range(8000)]
    windows = [window for window in drawn if window]
    left, top, side = np.array([(w.left, w.top, w.width) for w in windows]).T
    assert ((left >= 0) & (left + side <= 400) & (top >= 0) & (top + side <= 300)).all()
    assert not touches(left, top, side - 1e-9, box, 0.05 * side).any()
    longer = (box[2:] - box[:2]).max()
    # Of the wide scales, a quarter and log-uniform, there is none where the widest gap beside the box is too narrow.
    gap = max(*(box[:2] + 0.5), *(size - 0.5 - box[2:])) / (1.05 * longer)
    widest = min(8.0, 300 / longer)
    narrow = 0.25 * max(0.0, np.log(widest / gap)) / np.log(widest / 1.9)
    assert binomtest(len(drawn) - len(windows), len(drawn), narrow).pvalue > 0.001
    assert (side >= 1.15 * longer).all()
    assert (side <= min(8 * longer, 300 * (1 + 1e-12))).all()  # the wide ones, as far as the image goes
    assert (side > 1.9 * longer).any()
    # The loop: for each of the same scales, positions in the image until one keeps clear of the box.
    scales = np.repeat(side, 60)
    tries = rng.uniform(0, 1, (len(scales), 2)) * (size - scales[:, None])
    clear = ~touches(tries[:, 0], tries[:, 1], scales, box, 0.05 * scales)
    groups = clear.reshape(-1, 60)
    found = groups.any(axis=1)  # a wide scale may have little room; whether 60 tries hit it says nothing of where
    assert found.mean() > 0.97
    first = tries.reshape(-1, 60, 2)[np.arange(len(side)), groups.argmax(axis=1)]
    assert min(same_distribution(np.column_stack([left, top])[found], first[found])) > 0.001


def test_without_room_there_is_no_inverse_crop():
    rng = np.random.default_rng(10)
    assert inverse_crop([40, 40, 60, 110], (150, 150), 224, rng, clearance=0.6) is None
    assert inverse_crop([0, 0, 149, 60], (150, 150), 224, rng) is None


@pytest.mark.parametrize(
    ("box", "margin", "message"),
    [
        ([10, 0, 5, 5], 1.5, "not left < right"),
        ([5, 5, 5, 5], 1.5, "not left < right"),
        ([0, 0, float("nan"), 5], 1.5, "box: entry"),
        ([0, 0, 5, 5], 0.9, "margin: 0.9"),
    ],
)
def test_a_box_that_is_none_is_refused(box, margin, message):
    with pytest.raises(sf.InputError, match=message):
        centre_crop(box, margin, 224)


@pytest.mark.parametrize(
    ("box", "margin_px", "message"),
    [
        ([10, 0, 5, 5], 8, "not left < right"),
        ([-3, 0, 5, 5], 8, "reaches beyond the image of 100 x 80"),
        ([0, 0, 5, 80], 8, "reaches beyond the image of 100 x 80"),
        ([0, 0, 5, 5], 112, "margin_px: 112; between 0 and 111 for a crop of 224"),
    ],
)
def test_a_native_crop_that_cannot_be_is_refused(box, margin_px, message):
    with pytest.raises(sf.InputError, match=message):
        native_crop(box, (100, 80), np.random.default_rng(0), 224, margin_px)


SEEN = np.array([[300.0, 420], [420, 410], [372, 300], [340, 302]])  # corners of a runway, 120 px wide here, 32 there


def in_patch(image_from_patch, px):
    return np.linalg.solve(image_from_patch[:, :2], np.asarray(px) - image_from_patch[:, 2])


def test_every_corner_looks_alike_in_its_patch():
    maps = corner_patches(SEEN, np.full((4, 2), 0.5))
    centre = (PATCH_PX - 1) / 2
    for corner, (across, along) in enumerate(zip([1, 0, 3, 2], [3, 2, 1, 0])):
        here, beside, ahead = (in_patch(maps[corner], SEEN[n]) for n in (corner, across, along))
        np.testing.assert_allclose(here, centre, atol=1e-9)
        assert beside[0] > centre + 1  # along x, and nothing else
        np.testing.assert_allclose(beside[1], centre, atol=1e-9)
        assert ahead[1] > centre + 1  # along y
        np.testing.assert_allclose(ahead[0], centre, atol=1e-9)


@pytest.mark.parametrize(
    ("width", "sigma", "half"),
    [(60.0, 0.5, 24.0), (14.0, 0.5, 14.0), (400.0, 0.5, 100.0), (60.0, 8.0, 40.0), (1.0, 0.1, 2.0)],
    ids=["at the image's resolution", "a narrow end", "a wide one", "as far as it may be", "hardly a width at all"],
)
def test_a_patch_reaches_as_far_as_the_end_is_wide_and_as_the_corner_is_uncertain(width, sigma, half):
    square = np.array([[0.0, 0], [width, 0], [width, -width], [0, -width]])
    maps = corner_patches(square, np.full((4, 2), sigma))
    for corner, outward in enumerate([[-1, 1], [1, 1], [1, -1], [-1, -1]]):
        border = in_patch(maps[corner], square[corner] + half * np.array(outward))
        np.testing.assert_allclose(border, -0.5, atol=1e-9)


def test_a_patchs_axes_are_never_flat():
    flat = np.array([[0.0, 0], [100, 1], [180, 2], [90, 3]])  # a runway seen from hardly above it, turned
    same = np.zeros((4, 2))  # nothing at all: whatever is said of it, the maps can be inverted
    for corners in (flat, same, flat[::-1]):
        maps = corner_patches(corners, np.ones((4, 2)))
        x, y = maps[:, :, 0], maps[:, :, 1]
        length = np.linalg.norm(x, axis=1)
        np.testing.assert_allclose(np.linalg.norm(y, axis=1), length)
        turn = np.abs(x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]) / length**2
        assert (turn > np.sin(np.radians(24.99))).all()


def test_patches_of_nothing_are_refused():
    with pytest.raises(sf.InputError, match="corners_px"):
        corner_patches(SEEN[:3], np.ones((4, 2)))
    with pytest.raises(sf.InputError, match="sigma_px"):
        corner_patches(SEEN, np.full((4, 2), np.nan))
