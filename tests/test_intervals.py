import numpy as np
import pytest

from shortfinal.evaluate.intervals import auroc_figure, mean_figure, quantile_figures, share_figure

TRIALS, ROWS = 2000, 60


def clustered(rng, shape):
    """Numbers of mean 0 and variance 2, those of a row half alike; some not known."""
    values = rng.normal(size=(*shape, 1)) + rng.normal(size=(*shape, 8))
    values[rng.random(values.shape) < 0.2] = np.nan
    return values


def held(make, true):
    """How often the interval holds the true value, and its 99.9 % tolerance around 95 %."""
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(TRIALS):
        figure = make(clustered(rng, (ROWS,)))
        inside += figure.low <= true <= figure.high
    return inside / TRIALS


# 3.3 standard errors of a share of 0.95 in 2,000 trials are 1.6 points; the methods' own error with 60 rows
# is a point or two, and Clopper and Pearson's are wider than nominal by design.
def test_the_mean_is_held_by_its_interval():
    assert held(mean_figure, 0.0) == pytest.approx(0.95, abs=0.02)


def test_the_share_is_held_by_its_interval():
    assert 0.935 < held(lambda v: share_figure(np.where(np.isnan(v), np.nan, v > 1.0)), 0.2397501) < 0.99


@pytest.mark.parametrize("level, true", [(0.5, 0.0), (0.9, 1.8123876)])
def test_the_quantile_is_held_by_its_interval(level, true):
    assert 0.935 < held(lambda v: quantile_figures(v, [level])[0], true) < 0.99


def test_without_clusters_a_share_is_clopper_pearsons():
    from shortfinal.campaign.report import rate_of

    flags = np.arange(500) < 40
    exact, ours = rate_of(40, 500), share_figure(flags)
    assert ours.value == exact.rate
    assert ours.low == pytest.approx(exact.low, rel=0.01)
    assert ours.high == pytest.approx(exact.high, rel=0.01)


def test_repeating_every_number_does_not_narrow_an_interval():
    values = np.random.default_rng(1).normal(size=(40, 1))
    for make in (mean_figure, lambda v: share_figure(v > 0), lambda v: quantile_figures(v, [0.5])[0]):
        once, often = make(values), make(np.repeat(values, 50, axis=1))
        assert often.high - often.low == pytest.approx(once.high - once.low, rel=0.15)


def test_none_of_many_is_not_none_at_all():
    never = share_figure(np.zeros(1000))
    assert (never.value, never.low) == (0.0, 0.0)
    assert never.high == pytest.approx(0.00368, abs=1e-4)  # 1 - 0.025 ** (1 / 1000)


def test_the_area_under_the_roc_is_the_share_of_pairs_in_order_and_held_by_its_interval():
    rng = np.random.default_rng(2)
    a, b = np.round(rng.normal(1, 1, 40), 1), np.round(rng.normal(0, 1, 30), 1)
    pairs = np.mean([(x > y) + 0.5 * (x == y) for x in a for y in b])
    assert auroc_figure(a, b).value == pytest.approx(pairs)
    true, inside = 0.9213503965, 0  # Φ(2 / √2)
    for _ in range(TRIALS):
        figure = auroc_figure(rng.normal(2, 1, 60), rng.normal(0, 1, 50))
        inside += figure.low <= true <= figure.high
    assert inside / TRIALS == pytest.approx(0.95, abs=0.02)


def test_a_perfect_separation_is_not_certain():
    figure = auroc_figure(np.linspace(1, 2, 20), np.linspace(-1, 0, 30))
    assert figure.value == figure.high == 1
    assert figure.low == pytest.approx(0.025 ** (1 / 20), abs=1e-6)


def test_of_nothing_nothing_is_said_and_of_one_row_no_interval():
    nothing = np.full((5, 8), np.nan)
    assert mean_figure(nothing) is None
    assert share_figure(nothing) is None
    assert quantile_figures(nothing, [0.5, 0.9]) == [None, None]
    one = mean_figure(np.array([[1.0, 3.0]]))
    assert one.value == 2.0
    assert np.isnan([one.low, one.high]).all()
