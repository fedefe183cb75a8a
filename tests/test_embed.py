"""What other programs take from here: the Python example, the solver's C library, and landing by ONNX Runtime."""

import ctypes
import dataclasses
import json
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pymap3d.vincenty import vreckon

import shortfinal as sf
from shortfinal.crops import box_around
from shortfinal.demo import CAMERA, RUNWAY, approach_pose, demo_scene, render_frame
from shortfinal.detector import shipped_model
from shortfinal.integrity import Decision, check_integrity_batch
from shortfinal.pose import STATUS_OF_CODE, SolverStatus, estimate_pose_batch
from shortfinal.protection import protection_levels_batch

EMBED = Path(__file__).resolve().parents[1] / "examples" / "embed"
LARD = sf.Camera(2448, 2648, 3401.6, 3401.6, 1223.5, 1323.5)
BENT = sf.Camera(2448, 2648, 3401.6, 3390.0, 1223.5, 1323.5, (-0.2, 0.05, 1e-3, -5e-4, 0.01, 0.02, -0.01, 0.002))
FALSE_ALARM_RATE, INTEGRITY_RISK, FAULT_PRIOR = 1e-3, 1e-5, 1e-4
Numbers = ctypes.POINTER(ctypes.c_double)
MAX_POINTS = 12
MAX_ROWS = 2 * MAX_POINTS + 7


class CCamera(ctypes.Structure):
    _fields_ = [(name, ctypes.c_double) for name in ("fx", "fy", "cx", "cy")] + [("distortion", ctypes.c_double * 8)]


class CProblem(ctypes.Structure):
    _fields_ = [
        ("points", ctypes.c_int),
        *((name, Numbers) for name in ("mean_px", "cov_px", "points_m")),
        ("camera", ctypes.POINTER(CCamera)),
        *((name, Numbers) for name in ("attitude", "position", "altitude", "initial")),
        ("points_sigma_m", ctypes.c_double),
    ]


class CEstimate(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int) for name in ("status", "rows", "iterations", "sharp_rows")),
        ("position_m", ctypes.c_double * 3),
        ("runway_from_camera", ctypes.c_double * 9),
        ("cov", ctypes.c_double * 36),
        ("chi2", ctypes.c_double),
        ("relative_sigma", ctypes.c_double),
        ("residual", ctypes.c_double * MAX_ROWS),
        ("jacobian", ctypes.c_double * (6 * MAX_ROWS)),
        ("cov_px", ctypes.c_double * (4 * MAX_POINTS**2)),
    ]


class CMonitor(ctypes.Structure):
    _fields_ = [
        ("dof", ctypes.c_int),
        *((name, ctypes.c_double) for name in ("false_alarm_rate", "integrity_risk", "fault_prior", "threshold")),
        ("cells", ctypes.c_int),
        ("table", ctypes.c_double * 4 * 1200),
    ]


class CVerdict(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int) for name in ("decision", "reason", "dof")),
        *((name, ctypes.c_double) for name in ("statistic", "p_value", "threshold")),
    ]


class CLevels(ctypes.Structure):
    _fields_ = [("levels", ctypes.c_double * 5), ("driver", ctypes.c_int * 5)]


def read_only(array):
    return np.ascontiguousarray(array, np.float64).ctypes.data_as(Numbers)


def pointers(**arrays):
    return {name: None if array is None else read_only(array) for name, array in arrays.items()}


def test_a_fix_becomes_a_pose_in_the_runway_frame():
    flight = runpy.run_path(str(EMBED / "flight.py"))
    latitude, longitude, height = flight["THRESHOLD"]
    # A kilometre before the threshold and 100 m left of the centreline, along geodesics (Vincenty).
    back = vreckon(latitude, longitude, 1000.0, flight["HEADING_DEG"] + 180.0)
    place = vreckon(*map(float, back), 100.0, flight["HEADING_DEG"] - 90.0)
    pose = flight["pose_of"](flight["Fix"](*map(float, place), height + 60.0, flight["HEADING_DEG"] + 2.0, -3.0, 1.0))
    # The ground falls away by d² / 2R, 8 cm, from the level plane; 60 m higher up lengths are 1e-5 longer.
    np.testing.assert_allclose(pose.position_m, [-1000.0, 100.0, 60.0], atol=0.1)
    np.testing.assert_allclose(pose.attitude, [2.0, -3.0, 1.0], atol=1e-9)


@pytest.mark.slow
def test_the_python_example_flies(capsys):
    runpy.run_path(str(EMBED / "flight.py"), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert "searching" in lines[0]
    assert "m to go" in lines[-1]


@pytest.fixture(scope="module")
def compiler():
    found = shutil.which("g++")
    if found is None:
        pytest.skip("no g++ here")
    return found


@pytest.fixture(scope="module")
def kernels(tmp_path_factory):
    """The solver's kernels as an object file; most of a minute."""
    path = tmp_path_factory.mktemp("embed") / "kernels.o"
    source = str(Path(sf.__file__).parents[1])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([source, os.environ.get("PYTHONPATH", "")])}
    subprocess.run([sys.executable, EMBED / "export_kernels.py", path], check=True, env=environment)
    return path


@pytest.fixture(scope="module")
def library(compiler, kernels):
    path = kernels.with_name("libshortfinal.so")
    strict = ["-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", "-fvisibility=hidden"]
    subprocess.run([compiler, *strict, EMBED / "shortfinal.cpp", kernels, "-o", path], check=True)
    loaded = ctypes.CDLL(str(path))
    loaded.sf_monitor_init.argtypes = [ctypes.POINTER(CMonitor), ctypes.c_int, *[ctypes.c_double] * 3]
    loaded.sf_status_text.restype = ctypes.c_char_p
    return loaded


def monitor_of(library, dof):
    monitor = CMonitor()
    assert library.sf_monitor_init(monitor, dof, FALSE_ALARM_RATE, INTEGRITY_RISK, FAULT_PRIOR) == 0
    return monitor


def lens_of(camera):
    return CCamera(camera.fx, camera.fy, camera.cx, camera.cy, (ctypes.c_double * 8)(*camera.intrinsics[4:]))


def solved(library, monitor, camera, points, mean, cov, points_sigma_m=0.0, **priors):
    """Everything that the library says of one problem."""
    lens = lens_of(camera)
    given = dict.fromkeys(("attitude", "position", "altitude", "initial")) | priors
    problem = CProblem(
        len(points), *pointers(mean=mean, cov=cov, points=points).values(), ctypes.pointer(lens),
        *pointers(**given).values(), points_sigma_m,
    )  # fmt: skip
    estimate, verdict, levels = CEstimate(), CVerdict(), CLevels()
    status = library.sf_estimate_pose(ctypes.byref(problem), ctypes.byref(estimate))
    assert status == estimate.status
    assert library.sf_check(ctypes.byref(monitor), ctypes.byref(estimate), ctypes.byref(verdict)) == 0
    protected = library.sf_protect(*map(ctypes.byref, (monitor, problem, estimate, levels)))
    assert (protected == 0) == (status <= 1)
    return estimate, verdict, levels


def problems(camera, count, further=0, seed=0):
    """Approaches with noise of full covariances of unequal sigmas; one in ten with a corner astray."""
    rng = np.random.default_rng(seed)
    k = 4 + further
    means, covs, corners, truths = [], [], [], []
    while len(means) < count:
        distance, offset = rng.uniform(300, 5000), rng.uniform(-0.07, 0.07)
        position = distance * np.array([-1.0, offset, np.tan(np.radians(rng.uniform(2.2, 3.8)))])
        pose = sf.Pose.from_attitude(position, *rng.uniform([-10, -8, -10], [10, 0, 10]))
        runway = sf.Runway(rng.uniform(1500, 3500), rng.uniform(30, 60))
        points = np.vstack([runway.corners, np.array([[300, 9, 0], [300, -9, 0], [900, 20, 0]])[:further]])
        try:
            px = sf.project(camera, pose, points)
        except sf.InputError:
            continue
        if not ((px > 0).all() and (px < [camera.width - 1, camera.height - 1]).all()):
            continue
        mixed = rng.normal(size=(2 * k, 2 * k))
        cov = mixed @ mixed.T / (2 * k) + 0.1 * np.eye(2 * k)
        sigma = np.exp(rng.normal(np.log(0.6), 0.7, 2 * k))  # the largest some fifty times the smallest
        cov *= np.outer(sigma, sigma) / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
        mean = px.ravel() + np.linalg.cholesky(cov) @ rng.normal(size=2 * k)
        if rng.random() < 0.1:
            mean[rng.integers(2 * k)] += rng.choice([-1, 1]) * rng.uniform(5, 60)
        means.append(mean.reshape(k, 2))
        covs.append((cov + cov.T) / 2)
        corners.append(points)
        truths.append(pose)
    return np.array(means), np.array(covs), np.array(corners), truths


def compared(library, camera, mean, cov, points, priors=(), points_sigma_m=0.0, **batch_priors):
    """The library's answers held against Python's, problem by problem; the counts of decisions."""
    batch = estimate_pose_batch(mean, cov, points, camera, threads=1, points_sigma_m=points_sigma_m, **batch_priors)
    verdicts = check_integrity_batch(batch, FALSE_ALARM_RATE)
    rates = {"integrity_risk": INTEGRITY_RISK, "fault_prior": FAULT_PRIOR, "false_alarm_rate": FALSE_ALARM_RATE}
    protection = protection_levels_batch(batch, threads=1, **rates)
    monitor = monitor_of(library, batch.dof)
    counts = dict.fromkeys(Decision, 0)
    for i in range(len(mean)):
        own = {name: values[i] for name, values in dict(priors).items()}
        estimate, verdict, levels = solved(library, monitor, camera, points[i], mean[i], cov[i], points_sigma_m, **own)
        assert STATUS_OF_CODE[estimate.status] is batch.status(i)
        decision = list(Decision)[verdict.decision]
        assert decision is verdicts.decision(i)
        counts[decision] += 1
        if estimate.status > 1:
            assert np.isnan(estimate.position_m).all()
            continue
        # The same operations for another processor. Where rounding makes one of the two take a step more, that
        # step is below a millionth of a standard deviation, and the other one that follows from it.
        sigma = np.sqrt(np.diag(batch.covs[i]))
        assert np.abs((np.array(estimate.position_m) - batch.positions[i]) / sigma[:3]).max() < 1e-5
        turn = batch.rotations[i].T @ np.reshape(estimate.runway_from_camera, (3, 3))
        turned = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        assert np.abs(turned / sigma[3:]).max() < 1e-5
        np.testing.assert_allclose(np.reshape(estimate.cov, (6, 6)) / np.outer(sigma, sigma),
                                   batch.covs[i] / np.outer(sigma, sigma), atol=1e-6)  # fmt: skip
        assert estimate.chi2 == pytest.approx(batch.chi2[i], rel=1e-9, abs=1e-9)
        if decision is not Decision.NOT_MONITORED:
            assert verdict.p_value == pytest.approx(verdicts.p_value[i], rel=1e-8)
            assert verdict.threshold == pytest.approx(verdicts.threshold, rel=1e-12)
        # Its search ends within 1e-3 of a level; the same search ends at the same place.
        np.testing.assert_allclose(levels.levels, protection.levels[i], rtol=1e-5)
        assert list(levels.driver) == protection.drivers[i].tolist()
    return counts


@pytest.mark.slow
def test_the_library_solves_and_doubts_as_python_does(library):
    counts = compared(library, LARD, *problems(LARD, 1000)[:3])
    assert min(counts[Decision.USE], counts[Decision.DO_NOT_USE]) > 30


@pytest.mark.slow
def test_so_it_does_with_distortion_and_further_points(library):
    assert compared(library, BENT, *problems(BENT, 150, further=3, seed=1)[:3])[Decision.USE] > 50


@pytest.mark.slow
def test_so_it_does_with_points_that_are_known_to_half_a_metre(library):
    counts = compared(library, BENT, *problems(BENT, 300, further=3, seed=6)[:3], points_sigma_m=0.5)
    assert min(counts[Decision.USE], counts[Decision.DO_NOT_USE]) > 10


@pytest.mark.slow
def test_so_it_does_with_an_attitude_a_position_and_a_height(library):
    mean, cov, points, truths = problems(LARD, 150, seed=2)
    rng = np.random.default_rng(3)
    turns = np.array([t.plus([0, 0, 0, *rng.normal(0, 0.005, 3)]).runway_from_camera for t in truths])
    places = np.array([t.position_m + rng.normal(0, 5.0, 3) for t in truths])
    heights = np.array([t.position_m[2] + rng.normal(0, 1.0) for t in truths])
    turn_cov, place_cov = 0.005**2 * np.eye(3) + 1e-6, 25.0 * np.eye(3) + 5.0
    many = len(mean)
    priors = {
        "attitude": [np.concatenate([t.ravel(), turn_cov.ravel()]) for t in turns],
        "position": [np.concatenate([p, place_cov.ravel()]) for p in places],
        "altitude": [np.array([h, 1.0]) for h in heights],
    }
    counts = compared(
        library, LARD, mean, cov, points, priors,
        attitude_prior=(turns, turn_cov), position_prior=(places, place_cov), altitude=(heights, np.ones(many)),
    )  # fmt: skip
    assert counts[Decision.USE] > 50


@pytest.mark.slow
def test_what_cannot_be_solved_has_the_same_status(library):
    mean, cov, points, _ = (a[:1] for a in problems(LARD, 1, seed=4))
    flat, mirrored, skew, blown = mean.copy(), mean[:, [1, 0, 3, 2]], cov.copy(), cov * 1e8
    flat[:] = flat[:, :1] + np.arange(4)[None, :, None]
    skew[0, 0, 1] += 1.0
    lost = mean.copy()
    lost[0, 0, 0] = np.nan
    statuses = set()
    for m, c in ((flat, cov), (mirrored, cov), (mean, skew), (mean, blown), (lost, cov), (mean, -cov)):
        compared(library, LARD, m, c, points)
        statuses.add(estimate_pose_batch(m, c, points, LARD).status(0))
    assert {SolverStatus.ILL_CONDITIONED, SolverStatus.NON_FINITE} < statuses
    for code, status in enumerate(STATUS_OF_CODE):
        assert library.sf_status_text(code).decode() == status.value


@pytest.mark.slow
@pytest.mark.parametrize("dof", [1, 2, 3, 8, 25])
@pytest.mark.parametrize("rate", [1e-1, 1e-3, 1e-7])
def test_the_monitors_table_is_pythons(library, dof, rate):
    from shortfinal.protection import _acceptance

    monitor = CMonitor()
    assert library.sf_monitor_init(monitor, dof, rate, INTEGRITY_RISK, FAULT_PRIOR) == 0
    expected = _acceptance(dof, rate)
    assert monitor.cells == len(expected)
    # Logarithms down to -300: 1e-9 of them is rounding, and a relative error of the probability.
    np.testing.assert_allclose(np.array(monitor.table)[: monitor.cells], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_what_is_wrong_with_a_call_is_a_status(library):
    monitor, bad = CMonitor(), 6
    for dof, rate in ((0, 1e-3), (26, 1e-3), (2, 0.0), (2, 1.0), (2, float("nan"))):
        assert library.sf_monitor_init(monitor, dof, rate, INTEGRITY_RISK, FAULT_PRIOR) == bad
    estimate, verdict, levels = CEstimate(), CVerdict(), CLevels()
    assert library.sf_estimate_pose(None, ctypes.byref(estimate)) == bad
    mean, cov, points, _ = problems(LARD, 1, seed=5)
    lens = lens_of(LARD)
    for count in (2, 13):
        problem = CProblem(count, *pointers(mean=mean, cov=cov, points=points).values(), ctypes.pointer(lens))
        assert library.sf_estimate_pose(ctypes.byref(problem), ctypes.byref(estimate)) == bad
    for doubt in (-1.0, np.nan, np.inf):
        problem = CProblem(4, *pointers(mean=mean, cov=cov, points=points).values(), ctypes.pointer(lens))
        problem.points_sigma_m = doubt
        assert library.sf_estimate_pose(ctypes.byref(problem), ctypes.byref(estimate)) == bad
    other = monitor_of(library, 3)
    problem = CProblem(4, *pointers(mean=mean, cov=cov, points=points).values(), ctypes.pointer(lens))
    assert library.sf_estimate_pose(ctypes.byref(problem), ctypes.byref(estimate)) == 0
    assert library.sf_check(ctypes.byref(other), ctypes.byref(estimate), ctypes.byref(verdict)) == 0
    assert (verdict.decision, verdict.reason) == (2, 4)  # not monitored: made for another dof
    assert library.sf_protect(*map(ctypes.byref, (other, problem, estimate, levels))) == bad


C_PROGRAM = """
#include <pthread.h>
#include <stdio.h>
#include "shortfinal.h"

static void *fly(void *nothing) {
    double px[24], cov[576] = {0}, points[36] = {0, 22, 0, 0, -22, 0, 1500, -22, 0, 1500, 22, 0};
    const double position[3] = {-900, 12, 60}, rotation[9] = {0, 0, 1, -1, 0, 0, 0, -1, 0};
    sf_camera camera = {.fx = 2000, .fy = 2000, .cx = 479.5, .cy = 359.5};
    sf_problem seen = {.points = SF_MAX_POINTS, .mean_px = px, .cov_px = cov, .points_m = points, .camera = &camera};
    static sf_monitor monitor;
    sf_estimate pose;
    sf_verdict verdict;
    sf_levels levels;
    for (int i = 4; i < SF_MAX_POINTS; ++i) points[3 * i] = 150 * i, points[3 * i + 1] = i % 2 ? 9 : -9;
    for (int i = 0; i < 24; ++i) cov[25 * i] = 0.25;
    sf_project(&camera, position, rotation, SF_MAX_POINTS, points, px);
    sf_monitor_init(&monitor, 2 * SF_MAX_POINTS - 6, 1e-3, 1e-7, 1e-5);
    sf_estimate_pose(&seen, &pose);
    sf_check(&monitor, &pose, &verdict);
    sf_protect(&monitor, &seen, &pose, &levels);
    printf("%s %s %.6f %d", sf_status_text(pose.status), sf_decision_text(verdict.decision), pose.position_m[0],
           levels.vertical_m > 0 && levels.vertical_m < 50);
    return nothing;
}

int main(void) {
    pthread_t thread;
    pthread_attr_t small;
    pthread_attr_init(&small);
    pthread_attr_setstacksize(&small, 65536);
    return pthread_create(&thread, &small, fly, NULL) || pthread_join(thread, NULL);
}
"""


@pytest.mark.slow
def test_a_c_program_needs_64_kb_of_stack(library, kernels, tmp_path):
    program, source = tmp_path / "fly", tmp_path / "fly.c"
    source.write_text(C_PROGRAM)
    gcc = shutil.which("gcc") or pytest.skip("no gcc here")
    folder = kernels.parent
    words = [gcc, "-std=c11", "-Wall", "-Wextra", "-Werror", "-pedantic", f"-I{EMBED}", source, "-o", program]
    subprocess.run([*words, f"-L{folder}", "-lshortfinal", f"-Wl,-rpath,{folder}", "-pthread"], check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    assert done.stdout == "converged use -900.000000 1"


@pytest.mark.slow
def test_points_are_projected_where_python_projects_them(library):
    pose = sf.Pose.from_attitude([-900.0, 12.0, 60.0], 2.0, -3.0, 1.0)
    lens, px = lens_of(BENT), np.empty((4, 2))
    rotation = np.ascontiguousarray(pose.runway_from_camera)

    def project(position):
        return library.sf_project(
            ctypes.byref(lens), *pointers(p=position, r=rotation).values(), 4, read_only(RUNWAY.corners), read_only(px)
        )

    assert project(pose.position_m) == 0
    np.testing.assert_allclose(px, sf.project(BENT, pose, RUNWAY.corners), rtol=1e-12)
    assert project(np.array([500.0, 0, 60])) == 3  # behind the camera


@pytest.fixture(scope="module")
def landing(kernels, tmp_path_factory):
    """landing.cpp, built by CMake. Headers: $ONNXRUNTIME_ROOT or the system's; the library: those', or the wheel's."""
    if shutil.which("cmake") is None or shutil.which("g++") is None:
        pytest.skip("no cmake or no g++ here")
    build = kernels.with_name("build")
    root = os.environ.get("ONNXRUNTIME_ROOT", "")
    options = [f"-DSHORTFINAL_KERNELS={kernels}", f"-DONNXRUNTIME_ROOT={root}"]
    import onnxruntime

    wheel = next(iter((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*")), None)
    if wheel is not None and not (Path(root) / "lib" / "libonnxruntime.so").exists():
        link = kernels.with_name("libonnxruntime.so.1")  # its own name; in the wheel it has a longer one
        link.symlink_to(wheel)
        options.append(f"-DONNXRUNTIME_LIBRARY={link}")
    subprocess.run(["cmake", "-S", EMBED, "-B", build, *options], check=True, stdout=subprocess.DEVNULL)
    subprocess.run(["cmake", "--build", build], check=True, stdout=subprocess.DEVNULL)
    if not (build / "landing").exists():
        pytest.skip("no ONNX Runtime headers here; name a release in ONNXRUNTIME_ROOT")
    return build / "landing"


def landed(landing, image, camera, box, folder, runway=RUNWAY):
    path = folder / "frame.ppm"
    path.write_bytes(b"P6\n%d %d\n255\n" % (image.shape[1], image.shape[0]) + image.tobytes())
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, runway.length_m, runway.width_m, *box)
    done = subprocess.run(
        [landing, shipped_model(), path, *(repr(float(n)) for n in numbers)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "scale", "beside"), [(50, 1, 0.0), (80, 1, 0.0), (80, 2, 0.0), (97, 3, 0.0),
                                                         (80, 1, 0.35), (80, 1, 3.0)])  # fmt: skip
def test_a_frame_lands_as_in_python(landing, number, scale, beside, tmp_path):
    """`scale`: the picture enlarged, so that crops shrink it by two and more; `beside`: the box moved by that share."""
    image = np.repeat(np.repeat(render_frame(demo_scene(), number), scale, 0), scale, 1)
    window = sf.PixelWindow.resize(CAMERA.width, CAMERA.height, CAMERA.width * scale, CAMERA.height * scale)
    camera = CAMERA.view(window)
    box = box_around(sf.project(camera, approach_pose(number), RUNWAY.corners))
    box[[0, 2]] += beside * (box[2] - box[0])
    runway = dataclasses.replace(RUNWAY, survey_sigma_m=0.5)
    expected = sf.LandingPipeline(sf.KeypointDetector(threads=1), runway, camera).step(image, box=box)
    found = landed(landing, image, camera, box, tmp_path)
    assert found["decision"] == expected.verdict.decision.value
    if expected.estimate is not None:
        # Levels differ by at most one, where OpenCV's rounding does, and its weights are whole 32nds: 0.05 px was asked
        # for, of the picture as it was rendered.
        assert np.abs(np.reshape(found["keypoints_px"], (4, 2)) - expected.keypoints.mean_px).max() < 0.05 * scale
        cov = np.reshape(found["keypoints_cov_px"], (8, 8))
        sigma = expected.keypoints.sigma_px.ravel()
        assert np.abs((cov - expected.keypoints.cov_px) / np.outer(sigma, sigma)).max() < 0.05
    if expected.protection is not None:
        assert found["status"] == expected.estimate.status.value
        shift = (np.array(found["position_m"]) - expected.estimate.pose.position_m) / expected.estimate.sigma_position_m
        assert np.abs(shift).max() < 0.1
        for level, own in zip(found["protection"], expected.protection.levels, strict=True):
            assert level is None if np.isinf(own) else level == pytest.approx(own, rel=0.05)


@pytest.mark.slow
def test_what_it_cannot_read_is_named(landing, tmp_path):
    def refusal(*numbers):
        words = [landing, shipped_model(), tmp_path / "frame.ppm", *(str(n) for n in numbers)]
        done = subprocess.run(words, capture_output=True, text=True)
        assert done.returncode == 2
        return done.stderr

    assert "no number" in refusal(*[1] * 9, "nan")
    assert "frame.ppm: no binary PPM" in refusal(*[1] * 10)
    (tmp_path / "frame.ppm").write_bytes(b"P6\n10 10\n255\nshort")
    assert "frame.ppm: cut short" in refusal(*[1] * 10)
