import numpy as np
import pytest

import shortfinal as sf

MEAN = np.array([[10.0, 20], [30, 40]])


def spd(seed):
    a = np.random.default_rng(seed).normal(size=(4, 4))
    return a @ a.T + 0.1 * np.eye(4)


def test_whitening_turns_the_covariance_into_the_identity():
    kp = sf.GaussianKeypoints(MEAN, spd(0))
    np.testing.assert_allclose(kp.whitening @ kp.cov_px @ kp.whitening.T, np.eye(4), atol=1e-12)


def test_from_sigma_takes_one_number_a_column_or_a_table():
    for sigma in (2.0, [[2.0], [2.0]], np.full((2, 2), 2.0)):
        kp = sf.GaussianKeypoints.from_sigma(MEAN, sigma)
        np.testing.assert_array_equal(kp.cov_px, 4 * np.eye(4))
        np.testing.assert_array_equal(kp.sigma_px, np.full((2, 2), 2.0))


def test_block_is_one_keypoints_covariance():
    cov = spd(1)
    np.testing.assert_array_equal(sf.GaussianKeypoints(MEAN, cov).block(1), cov[2:, 2:])


def skewed():
    cov = np.eye(4)
    cov[0, 1] = 0.3
    return cov


def correlated(r):
    cov = np.eye(4)
    cov[0, 1] = cov[1, 0] = r
    return cov


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: sf.GaussianKeypoints(MEAN, np.diag([1, 1, 0, 1])), "variance of keypoint 1 u is 0"),
        (lambda: sf.GaussianKeypoints(MEAN, np.diag([1, -1, 1, 1])), "variance of keypoint 0 v is -1"),
        (lambda: sf.GaussianKeypoints(MEAN, skewed()), "not symmetric"),
        (lambda: sf.GaussianKeypoints(MEAN, correlated(1.2)), "not positive definite"),
        (lambda: sf.GaussianKeypoints(MEAN, correlated(1.0)), "not positive definite"),
        (lambda: sf.GaussianKeypoints(MEAN, np.eye(3)), "expected shape"),
        (lambda: sf.GaussianKeypoints([[1, np.nan], [2, 3]], np.eye(4)), r"mean_px: entry \[0, 1\] is nan"),
        (lambda: sf.GaussianKeypoints(np.empty((0, 2)), np.empty((0, 0))), "at least one"),
        (lambda: sf.GaussianKeypoints.from_sigma(MEAN, 0.0), "keypoint 0 u is 0"),
        (lambda: sf.GaussianKeypoints.from_sigma(MEAN, [[1, 1], [1, -2]]), "keypoint 1 v is -2"),
        (lambda: sf.GaussianKeypoints.from_sigma(MEAN, [1, 2, 3]), "sigma_px: expected"),
    ],
)
def test_an_uncertainty_that_cannot_be_is_refused(build, message):
    with pytest.raises(sf.InputError, match=message):
        build()


def test_what_is_replaced_is_independent_of_what_stays():
    root = np.random.default_rng(0).normal(size=(2, 8, 8))
    one, other = (
        sf.GaussianKeypoints(np.full((4, 2), float(n)), r @ r.T + np.eye(8)) for n, r in enumerate(root)
    )  # fmt: skip
    both = one.replaced([1, 3], other)
    np.testing.assert_array_equal(both.mean_px[:, 0], [0, 1, 0, 1])
    new, old = [2, 3, 6, 7], [0, 1, 4, 5]
    np.testing.assert_array_equal(both.cov_px[np.ix_(new, new)], other.cov_px[np.ix_(new, new)])
    np.testing.assert_array_equal(both.cov_px[np.ix_(old, old)], one.cov_px[np.ix_(old, old)])
    assert not both.cov_px[np.ix_(new, old)].any()
    np.testing.assert_array_equal(one.replaced([], other).cov_px, one.cov_px)
