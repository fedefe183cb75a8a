"""Many predictions at once are judged as one by one."""

import numpy as np
import pytest

import shortfinal as sf
from shortfinal.data.dataset import LARD_CONE, random_approach
from shortfinal.evaluate.faults import FAULTS, fault_figures, plant
from shortfinal.evaluate.judge import Problems, Rates, reasons_of

RATES = Rates()


def camera(rng, distorted):
    lens = (-0.1, 0.02, 1e-3, -1e-3) if distorted else ()
    f = rng.uniform(1500, 4000)
    return sf.Camera(2448, 2648, f, f * rng.uniform(0.9, 1.1), rng.uniform(1100, 1300), rng.uniform(1200, 1400), lens)


def drawn(count, distorted=False, seed=0, nearest=0.3, sigma=0.5):
    rng = np.random.default_rng(seed)
    cameras, means, covs, points, poses = [], [], [], [], []
    cone = LARD_CONE._replace(nautical_miles=(nearest, 1.5))
    for _ in range(count):
        cam, pose = camera(rng, distorted), random_approach(rng, cone=cone)
        runway = sf.Runway(rng.uniform(1200, 3000), 45.0)
        root = sigma * (np.diag(np.exp(rng.normal(0, 0.4, 8))) + 0.2 * rng.normal(size=(8, 8)))
        px = sf.project(cam, pose, runway.corners) + (root @ rng.normal(size=8)).reshape(4, 2)
        cameras.append(cam), means.append(px), covs.append(root @ root.T), points.append(runway.corners)
        poses.append(pose.position_m)
    return cameras, np.array(means), np.array(covs), np.array(points), np.array(poses)


@pytest.mark.parametrize("distorted", [False, True])
def test_a_batch_of_many_cameras_is_judged_as_each_by_itself(distorted):
    cameras, mean, cov, points, _ = drawn(40, distorted)
    solved = Problems.of(mean, cov, points, cameras).solve(RATES, levels=True)
    for i in range(40):
        est = sf.estimate_pose(sf.GaussianKeypoints(mean[i], cov[i]), points[i], cameras[i])
        verdict = sf.check_integrity(est)
        np.testing.assert_allclose(solved.position_m[i], est.pose.position_m, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(solved.sigma_m[i], est.sigma_position_m, rtol=1e-5)
        assert solved.p_value[i] == pytest.approx(verdict.p_value, abs=1e-6)
        assert solved.usable[i] == (verdict.decision is sf.Decision.USE)
        np.testing.assert_allclose(solved.level_m[i], sf.protection_levels(est).levels[:3], rtol=1e-4)


def test_what_is_not_known_is_not_judged():
    cameras, mean, cov, points, _ = drawn(4)
    cameras[0], mean[1], points[2] = None, np.nan, np.nan
    solved = Problems.of(mean, cov, points, cameras).solve(RATES, levels=True)
    assert solved.monitored.tolist() == [False, False, False, True]
    assert np.isnan(solved.p_value[:3]).all()
    assert "not known" in reasons_of(solved, RATES)[0]
    assert "p = " in reasons_of(solved, RATES)[3]


def test_some_of_the_problems_have_the_answers_of_all():
    problems = Problems.of(*(lambda c, m, v, p, _: (m, v, p, c))(*drawn(30)))
    which = np.array([3, 7, 20])
    np.testing.assert_array_equal(problems.select(which).solve(RATES).p_value, problems.solve(RATES).p_value[which])


def test_planted_faults_are_caught_more_often_the_larger_and_sound_rows_at_the_nominal_rate():
    cameras, mean, cov, points, truth = drawn(3000, sigma=0.3)
    problems = Problems.of(mean, cov, points, cameras)
    rates = Rates(false_alarm_rate=0.01)
    nominal = problems.solve(rates)
    figures = fault_figures(problems, nominal, truth, rates, seed=0)
    alarms = np.count_nonzero(nominal.monitored & ~nominal.usable)
    assert alarms == pytest.approx(30, abs=3.3 * 30**0.5)  # binomial
    for record in figures["faults"]:
        assert np.diff(record["detected"]).min() > -0.01
        assert record["detected"][-1] > 0.5
        for low, value, high in zip(record["low"], record["detected"], record["high"]):
            assert low <= value <= high
    statistic = figures["statistic"]
    width = np.diff(statistic["edges"])
    assert np.dot(statistic["nominal"], width) == pytest.approx(1)
    assert np.dot(statistic["fault"], width) == pytest.approx(1)
    # χ²(2) has a mean of 2: what the nominal histogram shows, to the width of its bins and 3,000 draws.
    middle = (np.array(statistic["edges"][1:]) + statistic["edges"][:-1]) / 2
    assert np.dot(statistic["nominal"] * width, middle) == pytest.approx(2, abs=0.15)
    assert np.dot(statistic["fault"] * width, middle) > 5
    roc = figures["roc"]
    assert all(np.diff(curve).min() >= 0 for curve in roc["detection"].values())
    assert roc["false_alarm"][-1] == 1


def test_a_slid_corner_moves_by_its_size_in_pixels_of_the_picture():
    cameras, mean, cov, points, _ = drawn(5)
    problems = Problems.of(mean, cov, points, cameras)
    far = FAULTS[1]
    assert far.corners == (2, 3)
    shift = np.zeros((5, 4, 2))
    shift[:, 2, 0] = 3.0
    moved = [m + s for m, s in zip(mean, shift)]
    by_hand = Problems.of(np.array(moved), cov, points, cameras).solve(RATES)
    np.testing.assert_allclose(problems.solve(RATES, shift_px=shift).p_value, by_hand.p_value, rtol=1e-6)
    assert (plant(problems, far, 0.0, RATES, 0).p_value == problems.solve(RATES).p_value).all()
