"""Campaigns: what is drawn, that it is counted right, and that no finished work is ever lost."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import binom, binomtest, chi2, ncx2
from test_cli import call, refused

import shortfinal as sf
import shortfinal.protection
from shortfinal.campaign import run, trials
from shortfinal.campaign.config import (
    Campaign,
    Correlation,
    Fault,
    Monitor,
    Poses,
    Priors,
    RunwaySizes,
    Scenario,
    Sigma,
    read_campaign,
)
from shortfinal.campaign.report import Rate, quantile, rate_of, scenario_table, write_figures, write_tables
from shortfinal.campaign.run import run_campaign
from shortfinal.campaign.trials import AXES, COUNTERS, Counts, count_chunk, count_trials, draw_views, measure
from shortfinal.integrity import Decision
from shortfinal.pose import estimate_pose_batch

CAMERA = sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)
CAMERA_TEXT = "[camera]\nwidth = 2448\nheight = 2648\nfx = 3401.6\nfy = 3401.6\ncx = 1223.5\ncy = 1323.5\n"
PLAIN = Scenario("plain", (), CAMERA)
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "campaign.toml"


def at(distance, glide=3.0, **attitude):
    """One pose for all trials."""
    fixed = {name: (v, v) for name, v in {"yaw_deg": 1, "pitch_deg": -3, "roll_deg": 2, **attitude}.items()}
    return Poses((distance, distance), (glide, glide), (1, 1), **fixed)


def campaign_file(tmp_path, text, trials=100):
    path = tmp_path / "campaign.toml"
    path.write_text(f"seed = 5\ntrials = {trials}\n{CAMERA_TEXT}{text}")
    return path


def counted(scenario, count, seed=1, index=0):
    """The counters of one chunk, by name."""
    cells = Counts.from_dict(count_chunk(scenario, seed, index, 0, count)).cells
    return dict(zip(COUNTERS, cells.sum(axis=0).tolist()))


def within(count, trials, probability, confidence=0.999):
    low, high = binom.interval(confidence, trials, probability)
    return low <= count <= high


# What a file may say


def test_sections_written_several_times_make_all_combinations(tmp_path):
    text = """
[sigma]
px = 0.8
[[priors]]
name = "none"
[[priors]]
altitude_m = 1
[[fault]]
kind = "none"
[[fault]]
name = "short"
kind = "far-threshold"
far_off_m = -184
"""
    campaign = read_campaign(campaign_file(tmp_path, text))
    assert [s.name for s in campaign.scenarios] == [
        "none, kind none", "none, short", "altitude_m 1, kind none", "altitude_m 1, short",
    ]  # fmt: skip
    assert [s.priors.altitude_m for s in campaign.scenarios] == [None, None, 1.0, 1.0]
    assert campaign.scenarios[3].fault == Fault("far-threshold", far_off_m=-184.0)
    assert {s.sigma.px for s in campaign.scenarios} == {0.8}
    assert campaign.scenarios[0].camera == CAMERA
    assert dict(campaign.scenarios[1].variants) == {"priors": "none", "fault": "short"}


REFUSALS = {
    "posess = 1": "unknown key 'posess'; the nearest known one is 'poses'",
    "[priors]\nattitude = 1": "priors: unknown key 'attitude'; the nearest known one is 'attitude_deg'",
    "[[priors]]\n[[priors]]\naltitude = 1": "[[priors]] number 2: unknown key 'altitude'",
    "[poses]\ndistance_m = [3000, 1000]": "poses: distance_m: expected a number or [low, high] within 10 to 100000",
    "[poses]\ndistance_m = [1, 2, 3]": "poses: distance_m",
    "[poses]\nglide_deg = nan": "poses: glide_deg",
    "[poses]\npitch_deg = [30, 40]": "of 2000 random poses 0 have every point in the frame",
    "[sigma]\npx = 0": "sigma: px: expected a number from 0.001 to 1000, got 0",
    '[sigma]\npx = "small"': "sigma: px",
    "[correlation]\nrho = 1.0": "correlation: rho",
    "[correlation]\ntold = 1": "correlation: told: expected true or false, got 1",
    '[fault]\nkind = "corners"': "fault: kind: expected one of none, corner, far-threshold, got 'corners'",
    '[fault]\nkind = "corner"': "fault: give shift_sigma or shift_px, one of them",
    '[fault]\nkind = "corner"\nshift_px = 1\nshift_sigma = 1': "fault: give shift_sigma or shift_px",
    '[fault]\nkind = "far-threshold"': "fault: no far_off_m",
    "[fault]\nshift_px = 5": "fault: shift_px: not a key of kind 'none'",
    '[fault]\nkind = "far-threshold"\nfar_off_m = -1480': "fault: far_off_m: -1480 leaves less than 50 m",
    "[monitor]\nfalse_alarm_rate = 1": "monitor: false_alarm_rate: expected a probability, over 0 and below 1, got 1",
    "[monitor]\nprotection = 1": "monitor: protection",
    "[runway]\npoints_m = [[300, 9]]": "runway: points_m: expected a list of [x, y, z]",
    "[[fault]]\n[[fault]]": "two scenarios are called 'default'",
    "[poses": "not a TOML file",
    "sigma = 3": "sigma: expected a table [sigma], or several [[sigma]]",
    "[sigma]\nname = 3": "sigma: name: expected a text, got 3",
}


@pytest.mark.parametrize("text", REFUSALS)
def test_a_bad_file_is_refused_by_file_and_key(tmp_path, capsys, text):
    path = campaign_file(tmp_path, "")
    # Top-level keys come before the first table.
    head, tail = ("", text) if text.startswith("[") else (text, "")
    path.write_text(f"seed = 5\ntrials = 100\n{head}\n{CAMERA_TEXT}{tail}\n")
    line = refused(capsys, "campaign", path, "--out", tmp_path / "out")
    assert REFUSALS[text] in line
    assert str(path) in line or "random poses" in line
    assert not (tmp_path / "out" / "tables.json").exists()


@pytest.mark.parametrize(
    "text, message",
    [
        ("trials = 10\n" + CAMERA_TEXT, "no seed"),
        ("seed = 1\ntrials = 10\n", "no camera"),
        ("seed = -1\ntrials = 10\n" + CAMERA_TEXT, "seed: expected a whole number, 0 or more, got -1"),
        ("seed = 1\ntrials = 1e6\n" + CAMERA_TEXT, "trials: expected a whole number, 1 or more, got 1000000.0"),
        ("seed = 1\ntrials = 10\n[camera]\nwidth = 100\n", "camera: no height; a camera has width"),
        ("seed = 1\ntrials = 10\n" + CAMERA_TEXT.replace("3401.6", "-1"), "must be positive"),
    ],
)
def test_what_every_campaign_needs(tmp_path, capsys, text, message):
    path = tmp_path / "c.toml"
    path.write_text(text)
    line = refused(capsys, "campaign", path, "--out", tmp_path / "out")
    assert message in line
    assert str(path) in line


def test_a_missing_file_is_refused(tmp_path, capsys):
    assert "cannot read the campaign" in refused(capsys, "campaign", tmp_path / "none.toml")


# What is drawn


def test_views_are_what_the_library_sees():
    rng = np.random.default_rng(2)
    poses = replace(PLAIN.poses, distance_m=(400, 900))  # near: many do not fit the frame
    camera = replace(CAMERA, distortion=(-0.05, 0.01, 1e-4, -1e-4))
    views = draw_views(rng, replace(PLAIN, camera=camera, poses=poses), 500)
    assert len(views.px) == 500
    assert (views.px >= 0).all()
    assert (views.px <= [CAMERA.width - 1, CAMERA.height - 1]).all()
    for i in range(0, 500, 50):
        pose = sf.Pose(views.positions[i], views.rotations[i])
        np.testing.assert_allclose(views.px[i], sf.project(camera, pose, views.points[i]), atol=1e-9)
        x, y, z = pose.position_m
        assert -x == pytest.approx(views.distance_m[i])
        assert np.degrees(np.arctan2(z, -x)) == pytest.approx(views.glide_deg[i])
        assert -4 <= np.degrees(np.arctan2(y, -x)) <= 4
        length, width = views.points[i, 2, 0], 2 * views.points[i, 0, 1]
        np.testing.assert_allclose(views.points[i], sf.Runway(length, width).corners)
        assert 1500 <= length <= 3500


def test_attitudes_are_those_of_pose():
    angles = np.random.default_rng(3).uniform(-40, 40, (20, 3))
    for (yaw, pitch, roll), rotation in zip(angles, trials.camera_rotations(*angles.T)):
        np.testing.assert_allclose(rotation, sf.Pose.from_attitude([0, 0, 1], yaw, pitch, roll).runway_from_camera)


@pytest.mark.parametrize("told", [True, False])
def test_the_noise_has_the_stated_covariance(told):
    # Whitened by the truth, entries of a sample covariance of N have standard errors of sqrt(1 or 2 over N).
    count = 40_000
    stated = Sigma(0.4, far_ratio=2.0)
    scenario = replace(PLAIN, poses=at(1500), sigma=stated, correlation=Correlation(0.6, told))
    rng = np.random.default_rng(4)
    views = draw_views(rng, scenario, count)
    measured = measure(rng, scenario, views)
    sigma = 0.4 * np.repeat([1, 1, 2, 2], 2)
    correlation = np.eye(8)
    for i in range(8):
        for j in range(8):
            if i != j and i % 2 == j % 2:
                correlation[i, j] = 0.6
    truth = np.outer(sigma, sigma) * correlation
    np.testing.assert_allclose(measured.cov_px, truth if told else np.diag(sigma**2))
    whitened = np.linalg.solve(np.linalg.cholesky(truth), (measured.mean_px - views.px).reshape(count, 8).T)
    assert np.abs(whitened @ whitened.T / count - np.eye(8)).max() < 4.5 * np.sqrt(2 / count)


def test_sigmas_spread_as_a_log_normal_down_to_the_floor():
    scenario = replace(PLAIN, sigma=Sigma(0.5, spread=0.5, floor_px=0.2))
    rng = np.random.default_rng(5)
    views = draw_views(rng, scenario, 5000)
    sigma = np.sqrt(np.diagonal(measure(rng, scenario, views).cov_px, axis1=1, axis2=2))
    assert sigma.min() == 0.2
    spread = np.log(sigma[sigma > 0.2] / 0.5)
    # Half lies over the median, to four standard errors of 40,000 draws.
    assert abs((spread > 0).sum() / sigma.size - 0.5) < 4 * 0.5 / np.sqrt(sigma.size)
    assert abs((spread > 0.5).sum() / sigma.size - 0.1587) < 4 * 0.366 / np.sqrt(sigma.size)


def test_a_short_far_threshold_is_seen_short_and_told_long():
    scenario = replace(PLAIN, fault=Fault("far-threshold", far_off_m=-184.0))
    views = draw_views(np.random.default_rng(6), scenario, 10)
    for i in range(10):
        seen = views.points[i] - np.outer([0, 0, 1, 1], [184, 0, 0])
        pose = sf.Pose(views.positions[i], views.rotations[i])
        np.testing.assert_allclose(views.px[i], sf.project(CAMERA, pose, seen), atol=1e-9)
        np.testing.assert_allclose(np.ptp(views.points[i, :, 0]), views.points[i, 2, 0])


@pytest.mark.parametrize("corner, allowed", [("any", {0, 1, 2, 3}), ("near", {0, 1}), ("far-left", {3})])
@pytest.mark.parametrize("unit", ["shift_px", "shift_sigma"])
def test_one_corner_is_shifted_by_what_is_asked(corner, allowed, unit):
    sound = replace(PLAIN, sigma=Sigma(0.5, spread=0.3))
    faulty = replace(sound, fault=Fault("corner", corner=corner, **{unit: 6.0}))
    views = draw_views(np.random.default_rng(7), sound, 400)
    means = [measure(np.random.default_rng(8), s, views) for s in (sound, faulty)]
    shift = means[1].mean_px - means[0].mean_px
    moved = np.abs(shift).sum(axis=2) > 0
    assert (moved.sum(axis=1) == 1).all()
    assert set(np.flatnonzero(moved.any(axis=0))) == allowed
    sigma = np.sqrt(np.diagonal(means[0].cov_px, axis1=1, axis2=2)).reshape(400, 4, 2)
    size = np.linalg.norm(shift / (1 if unit == "shift_px" else sigma), axis=2)
    np.testing.assert_allclose(size[moved], 6.0)


def test_the_worst_direction_leaves_the_smallest_residual():
    fault = Fault("corner", shift_sigma=6.0, direction="worst")
    scenario = replace(PLAIN, sigma=Sigma(0.5, 0.4), correlation=Correlation(0.4), fault=fault)
    rng = np.random.default_rng(9)
    views = draw_views(rng, scenario, 12)
    measured = measure(np.random.default_rng(1), scenario, views)
    sound = measure(np.random.default_rng(1), replace(scenario, fault=Fault()), views)
    angles = np.linspace(0, np.pi, 721)
    for i in range(12):
        clean = sf.estimate_pose(sf.GaussianKeypoints(views.px[i], measured.cov_px[i]), views.points[i], CAMERA)
        basis = np.linalg.qr(clean.jacobian)[0]
        left = np.linalg.inv(clean.factor)
        left = left - basis @ (basis.T @ left)
        shift = (measured.mean_px[i] - sound.mean_px[i]).ravel()
        which = np.flatnonzero(shift)[0] // 2
        sigma = clean.keypoints.sigma_px[which]
        tried = np.zeros((8, len(angles)))
        tried[2 * which : 2 * which + 2] = 6 * sigma[:, None] * [np.cos(angles), np.sin(angles)]
        assert np.linalg.norm(left @ shift) <= np.linalg.norm(left @ tried, axis=0).min() * (1 + 1e-6)


# What is counted


def one_prior(priors, i):
    """The priors of trial `i`: what has a row for each trial, and what all share."""
    shapes = {"attitude_prior": 3, "position_prior": 2, "altitude": 1}
    return {name: (each[i], shared) for name, (each, shared) in priors.items() if each.ndim == shapes[name]}


def scalar_counts(scenario, views, measured):
    """The same trials, one by one, through the library's front door."""
    counts = dict.fromkeys(COUNTERS, 0)
    monitor = scenario.monitor
    for i in range(len(views.px)):
        cov = measured.cov_px if measured.cov_px.ndim == 2 else measured.cov_px[i]
        keypoints = sf.GaussianKeypoints(measured.mean_px[i], cov)
        est = sf.estimate_pose(keypoints, views.points[i], scenario.camera, **one_prior(measured.priors, i))
        verdict = sf.check_integrity(est, monitor.false_alarm_rate)
        counts["trials"] += 1
        counts["solved"] += est.status.value == "converged"
        if verdict.decision is Decision.NOT_MONITORED:
            continue
        error = np.abs(est.pose.position_m - views.positions[i])
        accepted = verdict.decision is Decision.USE
        levels = None
        if monitor.protection:
            levels = sf.protection.protection_levels(
                est, integrity_risk=monitor.integrity_risk, fault_prior=monitor.fault_prior,
                false_alarm_rate=monitor.false_alarm_rate, method=monitor.method,
            )  # fmt: skip
            accepted = accepted if levels.passed is None else levels.passed
        counts["monitored"] += 1
        counts["accepted" if accepted else "refused"] += 1
        for rate in trials.TAIL_RATES:
            counts[f"p_below_{rate:g}"] += verdict.p_value < rate
        over = [accepted and e > limit for e, limit in zip(error, monitor.limits_m)]
        counts["over_limit"] += any(over)
        for axis, e, s, o in zip(AXES, error, est.sigma_position_m, over):
            counts[f"within_95_{axis}"] += e <= 1.959964 * s
            counts[f"over_limit_{axis}"] += o
        if levels:
            three = [getattr(levels, f"{axis}_m") for axis in AXES]
            available = accepted and all(level <= limit for level, limit in zip(three, monitor.limits_m))
            counts["available"] += available
            counts["hazardous"] += available and any(over)
            counts["over_level"] += accepted and any(e > level for e, level in zip(error, three))
            for axis, e, level in zip(AXES, error, three):
                counts[f"over_level_{axis}"] += accepted and e > level
    return counts


def by_chunk_and_one_by_one(scenario, count):
    rng = np.random.default_rng(np.random.SeedSequence(3, spawn_key=(2, 0)))
    views = draw_views(rng, scenario, count)
    return counted(scenario, count, seed=3, index=2), scalar_counts(scenario, views, measure(rng, scenario, views))


@pytest.mark.parametrize("fault", [Fault(), Fault("corner", shift_px=3.0), Fault("far-threshold", far_off_m=-184.0)])
def test_counts_are_those_of_the_trials_one_by_one(fault):
    scenario = replace(
        PLAIN, sigma=Sigma(0.8, spread=0.4), correlation=Correlation(0.3, told=False), fault=fault,
        monitor=Monitor(0.05, along_limit_m=40.0, cross_limit_m=5.0, vertical_limit_m=4.0),
    )  # fmt: skip
    got, want = by_chunk_and_one_by_one(scenario, 300)
    assert got == want
    assert 0 < want["refused"] < want["monitored"]
    assert 0 < want["over_limit_cross"] < want["accepted"]


@pytest.mark.parametrize("method", ["residual", "solution-separation"])
@pytest.mark.parametrize("priors, limit", [(Priors(0.05, 1.0, 5.0), 15.0), (Priors(altitude_m=0.5), 30.0)])
def test_counts_with_priors_and_levels_are_those_of_the_trials_one_by_one(method, priors, limit):
    scenario = replace(
        PLAIN, poses=replace(PLAIN.poses, distance_m=(500, 2000)), priors=priors,
        runway=RunwaySizes(points_m=((300.0, 9.0, 0.0),)), fault=Fault("corner", shift_sigma=5.0),
        monitor=Monitor(0.05, True, method, 1e-3, 1e-3, along_limit_m=limit, cross_limit_m=5.0, vertical_limit_m=5.0),
    )  # fmt: skip
    got, want = by_chunk_and_one_by_one(scenario, 200)
    assert got == want
    assert 0 < want["refused"] < want["monitored"]
    assert 0 < want["available"] < want["accepted"]


@pytest.mark.parametrize(
    "priors", [Priors(0.05), Priors(altitude_m=0.3), Priors(position_m=2.0), Priors(0.02, 1.0, 5.0)]
)
def test_priors_err_as_they_say(priors):
    # Their errors are in the residual, so false alarms are nominal only if they are drawn as stated.
    scenario = replace(PLAIN, poses=replace(PLAIN.poses, distance_m=(500, 1500)), priors=priors)
    counts = Counts.from_dict(count_chunk(scenario, 13, 0, 0, 20_000))
    found = dict(zip(COUNTERS, counts.cells.sum(axis=0)))
    for rate in trials.TAIL_RATES:
        assert within(found[f"p_below_{rate:g}"], 20_000, rate)
    for axis in ("cross", "vertical"):
        assert within(found[f"within_95_{axis}"], 20_000, 0.95)
    assert counts.squares[3] / 20_000 == pytest.approx(6, abs=4 * np.sqrt(12 / 20_000))


def test_the_map_and_the_histograms_hold_every_trial():
    scenario = replace(PLAIN, monitor=Monitor(0.05))
    rng = np.random.default_rng(10)
    views = draw_views(rng, scenario, 2000)
    measured = measure(rng, scenario, views)
    batch = estimate_pose_batch(measured.mean_px, measured.cov_px, views.points, CAMERA)
    counts = count_trials(scenario, views, batch)
    table = scenario_table(scenario, counts)
    want, *_ = np.histogram2d(views.distance_m, views.glide_deg, [np.linspace(500, 6000, 13), np.linspace(2.2, 3.8, 9)])
    np.testing.assert_array_equal(table["map"]["trials"], want)
    assert sum(table["p_values"]) == table["counts"]["monitored"]
    assert counts.errors.sum(axis=1).tolist() == [table["counts"]["accepted"]] * 3
    accepted = sf.check_integrity_batch(batch, 0.05).usable
    error = np.abs(batch.positions - views.positions)[accepted]
    for n, axis in enumerate(AXES):
        assert table["rms_error_m"][axis] == pytest.approx(np.sqrt(np.mean(error[:, n] ** 2)))
        # A bin is 2.3 % wide.
        assert table["error_m"][axis]["median"] == pytest.approx(np.median(error[:, n]), rel=0.024)
    squared = []
    for i in np.flatnonzero(batch.converged)[:200]:
        truth = sf.Pose(views.positions[i], views.rotations[i])
        d = truth.minus(batch[int(i)].pose)
        squared.append(d @ np.linalg.solve(batch.covs[i], d))
    few = trials._nees(views, batch)[batch.converged][:200]
    np.testing.assert_allclose(few, squared, rtol=1e-4)


def test_false_alarms_come_at_the_nominal_rates_and_errors_within_their_sigma():
    scenario = replace(
        PLAIN, poses=replace(PLAIN.poses, distance_m=(500, 1500)), sigma=Sigma(0.5, 0.3, far_ratio=0.7),
        correlation=Correlation(0.3),
    )  # fmt: skip
    counts = Counts.from_dict(count_chunk(scenario, 11, 0, 0, 40_000))
    counted = dict(zip(COUNTERS, counts.cells.sum(axis=0)))
    assert counted["monitored"] == 40_000
    assert within(counted["refused"], 40_000, 1e-3)
    for rate in trials.TAIL_RATES:
        assert within(counted[f"p_below_{rate:g}"], 40_000, rate)
    for axis in ("cross", "vertical"):  # along is skewed already: range goes as one over size
        assert within(counted[f"within_95_{axis}"], 40_000, 0.95)
    expected = 40_000 / trials.P_BINS
    assert ((counts.p_values - expected) ** 2 / expected).sum() < chi2.isf(1e-3, trials.P_BINS - 1)
    assert counts.squares[3] / 40_000 == pytest.approx(6, abs=4 * np.sqrt(12 / 40_000))


def test_detection_of_a_short_far_threshold_follows_the_noncentral_law():
    scenario = replace(
        PLAIN, poses=at(1500), runway=replace(PLAIN.runway, length_m=(1500, 1500), width_m=(45, 45)),
        sigma=Sigma(0.5), fault=Fault("far-threshold", far_off_m=-184.0),
    )  # fmt: skip
    views = draw_views(np.random.default_rng(0), scenario, 1)
    clean = sf.estimate_pose(sf.GaussianKeypoints.from_sigma(views.px[0], 0.5), views.points[0], CAMERA)
    power = ncx2.sf(chi2.isf(1e-3, 2), 2, clean.chi2)
    assert 0.1 < power < 0.9
    assert within(counted(scenario, 20_000)["refused"], 20_000, power)


# What is said


def test_intervals_are_clopper_and_pearsons():
    for count, of in ((0, 50), (3, 50), (50, 50), (17, 100_000)):
        want = binomtest(count, of).proportion_ci(0.95, "exact")
        got = rate_of(count, of)
        assert (got.low, got.high) == pytest.approx((want.low, want.high), rel=1e-9)
        assert got.rate == count / of
    assert rate_of(0, 0) == Rate(0, 0, None, 0.0, 1.0)


def test_quantiles_of_the_histogram():
    values = np.exp(np.random.default_rng(12).normal(2, 1.5, (20_000, 3)))
    histogram = trials._histogram(values)
    for n in range(3):
        for share in (0.1, 0.5, 0.95):
            assert quantile(histogram[n], share) == pytest.approx(np.quantile(values[:, n], share), rel=0.02)
    endless = trials._histogram(np.full((10, 3), np.inf))
    assert quantile(endless[0], 0.5) is None
    assert quantile(0 * endless[0], 0.5) is None


SMALL = """
[[fault]]
name = "none"
[[fault]]
name = "far corner"
kind = "corner"
corner = "far"
shift_sigma = 8
"""
FILES = ("tables.json", "table.csv")


def contents(folder):
    return [(folder / name).read_bytes() for name in FILES]


def finish(campaign, folder, **options):
    counts, effort = run_campaign(campaign, folder, **options)
    write_tables(campaign, counts, folder)
    return effort


def small_chunks(monkeypatch):
    monkeypatch.setattr(run, "CHUNK", 300)


def test_a_report_is_complete(tmp_path, capsys):
    out = tmp_path / "out"
    status, printed, _ = call(capsys, "campaign", campaign_file(tmp_path, SMALL, 1000), "--out", out, "--workers", 1)
    assert status == 0
    assert "2,000 trials in" in printed
    tables = json.loads((out / "tables.json").read_text())["scenarios"]
    assert [t["counts"]["trials"] for t in tables] == [1000, 1000]
    assert "false_alarm" in tables[0]["rates"]
    assert tables[1]["rates"]["detection"]["count"] + tables[1]["rates"]["missed_detection"]["count"] == 1000
    assert tables[1]["rates"]["detection"]["rate"] > 0.8
    lines = (out / "table.csv").read_text().splitlines()
    assert len(lines) == 3
    assert lines[0].startswith("scenario,fault,trials,monitored,monitored_low,monitored_high,")
    for name in ("false_alarms.png", "map-01-none.png", "map-02-far-corner.png"):
        assert cv2.imread(str(out / name)) is not None


def test_one_distance_makes_no_map(tmp_path):
    scenario = replace(PLAIN, poses=at(1500))
    counts = Counts.from_dict(count_chunk(scenario, 1, 0, 0, 100))
    assert [p.name for p in write_figures(Campaign(1, 100, (scenario,)), [counts], tmp_path)] == ["false_alarms.png"]


# That nothing is lost


def test_a_run_goes_on_where_the_journal_ends(tmp_path, monkeypatch):
    small_chunks(monkeypatch)
    campaign = read_campaign(campaign_file(tmp_path, SMALL, trials=1000))
    finish(campaign, tmp_path / "whole", workers=1)
    journal = (tmp_path / "whole" / "chunks.jsonl").read_bytes()
    lines = journal.splitlines(keepends=True)
    assert len(lines) == 1 + 2 * 4
    # Cut anywhere: within the header, after it, within a line, out of order, with a chunk twice.
    cuts = [b"", lines[0][:50], lines[0], b"".join(lines[:4]) + lines[4][:500], lines[0] + b"".join(lines[:5:-1]),
            b"".join(lines[:4]) + lines[2]]  # fmt: skip
    for number, cut in enumerate(cuts):
        folder = tmp_path / f"cut{number}"
        folder.mkdir()
        (folder / "chunks.jsonl").write_bytes(cut)
        progress = []
        finish(campaign, folder, workers=1, seen=lambda done, total, p=progress: p.append((done, total)))
        assert contents(folder) == contents(tmp_path / "whole")
        assert finish(campaign, folder, workers=1).trials == 0  # the journal is whole again
        assert progress[-1] == (2000, 2000)
        if len(cut) > 2000:
            assert progress[0][0] >= 700
    assert finish(campaign, tmp_path / "whole", workers=1).trials == 0
    assert (tmp_path / "whole" / "chunks.jsonl").read_bytes() == journal


def test_another_campaign_in_the_folder_is_refused(tmp_path, capsys):
    path = campaign_file(tmp_path, SMALL)
    finish(read_campaign(path), tmp_path / "out", workers=1)
    path.write_text(path.read_text().replace("seed = 5", "seed = 6"))
    line = refused(capsys, "campaign", path, "--out", tmp_path / "out", "--workers", 1)
    assert "begun with another campaign: seed differ" in line
    path.write_text(path.read_text().replace("seed = 6", "seed = 5").replace("shift_sigma = 8", "shift_sigma = 7"))
    assert "another campaign: scenarios differ" in refused(capsys, "campaign", path, "--out", tmp_path / "out")


def test_other_code_or_a_damaged_journal_is_refused(tmp_path, monkeypatch):
    campaign = read_campaign(campaign_file(tmp_path, SMALL))
    finish(campaign, tmp_path / "out", workers=1)
    journal = tmp_path / "out" / "chunks.jsonl"
    whole = journal.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(run, "_code_digest", lambda: "0")
        with pytest.raises(sf.InputError, match="begun with another version of the code"):
            finish(campaign, tmp_path / "out", workers=1)
    journal.write_bytes(whole.replace(b'"scenario":0', b'"scenar', 1))
    with pytest.raises(sf.InputError, match="line 2 is damaged"):
        finish(campaign, tmp_path / "out", workers=1)
    assert journal.read_bytes() != whole  # refused, not mended


@pytest.mark.slow
def test_any_number_of_workers_counts_the_same(tmp_path, monkeypatch):
    small_chunks(monkeypatch)
    campaign = read_campaign(campaign_file(tmp_path, SMALL, trials=1000))
    for workers in (1, 2):
        finish(campaign, tmp_path / str(workers), workers=workers)
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


@pytest.mark.slow
def test_ray_counts_the_same(tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="the extra `cluster` is not installed")
    small_chunks(monkeypatch)
    campaign = read_campaign(campaign_file(tmp_path, SMALL, trials=1000))
    finish(campaign, tmp_path / "here", workers=1)
    finish(campaign, tmp_path / "ray", workers=2, ray="local")
    assert contents(tmp_path / "ray") == contents(tmp_path / "here")


def test_without_ray_the_mend_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    line = refused(capsys, "campaign", campaign_file(tmp_path, SMALL), "--out", tmp_path / "out", "--ray", "local")
    assert "pip install 'shortfinal[cluster]'" in line


def children_of(pid):
    """Processes whose parent is `pid`."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(entry.parent.name))
    return found


def gone(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def until(condition, seconds):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    return condition()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the workers in /proc")
def test_killed_halfway_and_resumed_the_tables_are_the_same(tmp_path):
    path = campaign_file(tmp_path, SMALL, trials=120_000)
    command = [sys.executable, "-m", "shortfinal.cli", "campaign", str(path), "--workers", "2", "--json", "--out"]
    journal = tmp_path / "killed" / "chunks.jsonl"
    with subprocess.Popen([*command, str(tmp_path / "killed")], stdout=subprocess.DEVNULL) as process:
        assert until(lambda: journal.exists() and journal.read_bytes().count(b"\n") >= 4, 120)
        workers = children_of(process.pid)
        os.kill(process.pid, signal.SIGKILL)
    assert len(workers) >= 2
    assert until(lambda: all(map(gone, workers)), 5), "workers outlived their parent"
    written = journal.read_bytes().count(b"\n")
    assert 4 <= written < 13
    with journal.open("ab") as file:
        file.write(b'{"scenario":1,"chunk":9,"cells":[[1')  # as a cut in the middle of a line leaves it
    subprocess.run([*command, str(tmp_path / "killed")], check=True, stdout=subprocess.DEVNULL)
    subprocess.run([*command, str(tmp_path / "whole")], check=True, stdout=subprocess.DEVNULL)
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")
    assert json.loads((tmp_path / "whole" / "tables.json").read_text())["scenarios"][0]["counts"]["trials"] == 120_000
