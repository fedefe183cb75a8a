import numpy as np
import pytest
from scipy.stats import ks_2samp

import shortfinal as sf
from shortfinal.crops import bogo_crop, box_around, centre_crop

BOX = np.array([100.0, 50.0, 180.0, 90.0])


def test_the_box_holds_the_keypoints():
    np.testing.assert_array_equal(box_around([[3, 9], [1, 2], [5, 4]]), [1, 2, 5, 9])


def test_the_centre_crop_is_centred_and_has_its_margin():
    window = centre_crop(BOX, 1.5, 224)
    assert (window.width, window.height) == (120, 120)
    assert window.apply([140, 70]) == pytest.approx([111.5, 111.5])


def test_bogo_crops_are_distributed_as_by_rejection():
    # The paper's loop: any position around, until one holds the box.
    rng = np.random.default_rng(3)
    direct = np.array([(w.left, w.top) for w in (bogo_crop(BOX, 1.5, 224, rng) for _ in range(4000))])
    tries = rng.uniform([0, -100], [250, 150], (120_000, 2))
    inside = (tries <= BOX[:2] + 0.5).all(axis=1) & (tries + 120 >= BOX[2:] + 0.5).all(axis=1)
    for axis in range(2):
        assert ks_2samp(direct[:, axis], tries[inside, axis]).pvalue > 0.01


def test_bogo_crops_keep_their_slack():
    rng = np.random.default_rng(4)
    for _ in range(200):
        px = bogo_crop(BOX, 1.5, 100, rng, slack=0.1).apply(BOX.reshape(2, 2))
        assert (px > 9).all()
        assert (px < 90).all()


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
