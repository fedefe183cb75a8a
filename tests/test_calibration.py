"""Calibration measures on errors whose distribution is known."""

import numpy as np
import pytest
from scipy.stats import binom, multivariate_normal, norm

import shortfinal as sf

RNG = np.random.default_rng(0)
SIGMA = np.exp(RNG.normal(size=(20_000, 2)))
ERRORS = SIGMA * RNG.normal(size=SIGMA.shape)
ROOT = np.array([[1.0, 0.0], [0.8, 0.5]])
COV = np.tile(ROOT @ ROOT.T, (20_000, 1, 1))
CORRELATED = RNG.normal(size=(20_000, 2)) @ ROOT.T


def test_calibrated_errors_are_covered_as_often_as_claimed():
    levels = np.array([0.5, 0.6827, 0.95, 0.99])
    for errors, sigma, count in ((ERRORS, SIGMA, 40_000), (CORRELATED, COV, 20_000)):
        low, high = binom.interval(0.999, count, levels)
        covered = sf.coverage(errors, sigma, levels) * count
        assert ((covered >= low) & (covered <= high)).all()


def test_coverage_of_one_level_counts_by_hand():
    assert sf.coverage([0.5, 1.5, -1.9, 2.1], np.ones(4), 0.95) == 0.75  # the normal quantile is 1.96


def test_sharpness_is_the_root_mean_square():
    assert sf.sharpness([3.0, 4.0]) == pytest.approx(np.sqrt(12.5))


def test_likelihood_agrees_with_scipy():
    assert sf.gaussian_nll(ERRORS, SIGMA) == pytest.approx(-norm.logpdf(ERRORS, scale=SIGMA).mean())
    want = -multivariate_normal(cov=COV[0]).logpdf(CORRELATED).mean()
    assert sf.gaussian_nll(CORRELATED, COV) == pytest.approx(want)


def test_the_likelihood_is_best_at_the_true_sigma():
    # The published loss lacks the ½ before log|Σ|; its optimum is too small by √2.
    scales = np.linspace(0.5, 1.5, 201)
    ours = [sf.gaussian_nll(ERRORS, scale * SIGMA) for scale in scales]
    published = [0.5 * np.mean((ERRORS / SIGMA / scale) ** 2) + 2 * np.log(scale) for scale in scales]
    assert scales[np.argmin(ours)] == pytest.approx(1.0, abs=0.02)
    assert scales[np.argmin(published)] == pytest.approx(np.sqrt(0.5), abs=0.02)


def test_the_fitted_scale_mends_each_coordinate():
    # The standard error of a scale is 1 / sqrt(2 N) = 0.005.
    np.testing.assert_allclose(sf.fit_sigma_scale(ERRORS, SIGMA / [2.0, 0.5]), [2.0, 0.5], rtol=0.02)
    assert sf.fit_sigma_scale([3.0, 4.0], [1.0, 1.0]) == pytest.approx(np.sqrt(12.5))


@pytest.mark.parametrize(
    ("errors", "sigma", "message"),
    [
        ([1.0, 2.0], [1.0], "does not match"),
        ([], [], "at least one"),
        ([1.0], [0.0], "> 0"),
        ([np.nan], [1.0], "finite"),
        (np.ones((2, 2)), np.ones((2, 3, 3)), "expected covariances"),
        (np.ones((2, 2)), np.zeros((2, 2, 2)), "positive definite"),
        (np.ones((1, 2)), [[[1.0, np.nan], [np.nan, 1.0]]], "finite"),
        (np.ones((1, 2)), [[[1.0, 0.5], [0.0, 1.0]]], "not symmetric"),
    ],
)
def test_wrong_input_is_refused(errors, sigma, message):
    for measure in (lambda: sf.coverage(errors, sigma, 0.9), lambda: sf.gaussian_nll(errors, sigma)):
        with pytest.raises(sf.InputError, match=message):
            measure()


def test_a_level_that_is_no_probability_is_refused():
    with pytest.raises(sf.InputError, match="between 0 and 1"):
        sf.coverage([1.0], [1.0], 1.0)
