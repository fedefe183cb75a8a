"""Rows of a network that errs as it says, with faults planted on request, and the evidence that they make."""

import itertools

import numpy as np
from scipy.special import erfinv
from scipy.stats import chi2, ncx2

from shortfinal.evaluate.rows import AXES, DO_NOT_USE, MISSING, NOT_MONITORED, USE, Rows

AIRPORTS = ("BIRK", "EDDM", "KJFK", "LFPO", "RJTT", "YSSY")
EDGES_M = [0.0, 500, 1000, 1500, 2000, 3000, 4000, 6000]
LEVELS = np.linspace(0.02, 0.98, 49)
FOCAL_PX = 3400.0


def small_rows(count=2000, seed=0, halved="", far_bias_px=0.0):
    """`count` runways. Their sigma is halved at the airport `halved`; beyond 2 km the far corners lie
    `far_bias_px` too low in the picture. Those of "light" "night" are a third as sharp."""
    rng = np.random.default_rng(seed)
    distance = rng.uniform(300, 6000, count)
    glide, lateral = rng.normal(3.0, 0.4, count), rng.normal(0, 1.0, count)
    truth = _corners(distance, glide, lateral)
    light = rng.choice(["night", "dim", "bright"], count, p=[0.15, 0.25, 0.6]).astype(object)
    airport = rng.choice(AIRPORTS, count).astype(object)
    sigma = 0.5 * np.exp(0.4 * rng.standard_normal((count, 1, 1)) + 0.15 * rng.standard_normal((count, 4, 2)))
    sigma *= np.where(light == "night", 3.0, 1.0)[:, None, None] * np.array([1.0, 1.0, 0.7, 0.7])[:, None]
    mean = truth + sigma * rng.standard_normal((count, 4, 2))
    mean[:, 2:, 1] += np.where(distance > 2000, far_bias_px, 0.0)[:, None]
    stated = sigma * np.where(airport == halved, 0.5, 1.0)[:, None, None]
    cov = np.zeros((count, 8, 8))
    cov[:, np.arange(8), np.arange(8)] = stated.reshape(count, 8) ** 2
    statistic = rng.chisquare(2, count)
    decision = np.where(statistic > chi2.isf(1e-3, 2), DO_NOT_USE, USE).astype(object)
    decision[rng.random(count) < 0.02] = NOT_MONITORED
    gone = rng.random(count) < 0.01
    decision[gone] = MISSING
    statistic[(decision == NOT_MONITORED) | gone] = np.nan
    mean[gone], cov[gone] = np.nan, np.nan
    sigma_m = (distance / 1000)[:, None] * np.array([30.0, 3.0, 2.0]) * sigma.mean(axis=(1, 2))[:, None]
    error_m = sigma_m * rng.standard_normal((count, 3))
    level = sigma_m * rng.uniform(4.5, 7, (count, 1))
    level[rng.random(count) < 0.03] = np.inf
    planted = np.flatnonzero(decision == USE)[:: max(1, count // 3)]  # misleading information
    error_m[planted] = 1.5 * np.where(np.isfinite(level[planted]), level[planted], 50.0)
    unsolved = gone | (decision == NOT_MONITORED)
    error_m[unsolved], sigma_m[unsolved], level[unsolved] = np.nan, np.nan, np.nan
    return Rows(
        picture=np.array([f"{n:06d}.png" for n in range(count)], object),
        source=np.array([f"labels.csv: line {n + 2}" for n in range(count)], object),
        ident=np.array([f"{name}/24" for name in airport], object), airport=airport, light=light,
        truth_px=truth, mean_px=mean, cov_px=cov, enlarged=np.full(count, 1.5),
        distance_m=distance, glide_deg=glide, lateral_deg=lateral,
        decision=decision, reason=np.array(["of the generator"] * count, object), present=np.ones(count),
        absent=np.zeros(count),
        statistic=statistic, dof=np.where(np.isfinite(statistic), 2.0, np.nan), p_value=chi2.sf(statistic, 2),
        error_m=error_m, sigma_m=sigma_m, level_m=level,
        caught_184m=np.where(np.isfinite(statistic), 0.0, np.nan),
        latency_ms=40 * np.exp(0.2 * rng.standard_normal(count)),
    )  # fmt: skip


def _corners(distance, glide, lateral, width=1225.0, height=1325.0, length_m=2000.0, width_m=45.0):
    """Corners (N, 4, 2) of a runway that a level camera sees, looking along it."""
    x = np.array([0, 0, length_m, length_m])
    y = np.array([1, -1, -1, 1]) * width_m / 2
    depth = distance[:, None] + x
    side, up = (distance * np.tan(np.radians(angle)) for angle in (lateral, glide))
    return np.stack([width - FOCAL_PX * (y - side[:, None]) / depth, height + FOCAL_PX * up[:, None] / depth], axis=-1)


def small_evidence(rows, limits_m=(150.0, 20.0, 12.0)):
    """What evaluation.json holds of these rows, as far as the pictures use it."""
    known = rows.select(rows.predicted)
    share = np.abs(known.error_px / known.sigma_px).ravel()
    observed = np.array([(share <= np.sqrt(2) * erfinv(level)).mean() for level in LEVELS])
    half = 1.96 * np.sqrt(observed * (1 - observed) / len(known)) + 1e-3
    edges = np.geomspace(known.sigma_px.min(), known.sigma_px.max() * 1.001, 41)
    monitored = rows.statistic[np.isfinite(rows.statistic)]
    at = np.linspace(0, 40, 61)
    fault = np.random.default_rng(1).noncentral_chisquare(2, 12, len(monitored))
    false_alarm = np.geomspace(1e-5, 1, 40)
    sizes = np.linspace(0, 400, 9)
    shifts = np.linspace(0, 10, 9)
    return {
        "format": 1, "title": "of the generator", "created": "2025-01-01T00:00:00Z", "version": "0",
        "settings": {"false_alarm_rate": 1e-3, "integrity_risk": 1e-7, "fault_prior": 1e-4,
                     "alert_limits_m": None if limits_m is None else list(limits_m)},
        "metrics": _metrics(known),
        "calibration": {"nominal": LEVELS.tolist(), "observed": observed.tolist(),
                        "low": np.clip(observed - half, 0, 1).tolist(),
                        "high": np.clip(observed + half, 0, 1).tolist()},
        "sharpness": {"edges": edges.tolist(), "counts": np.histogram(known.sigma_px, edges)[0].tolist()},
        "statistic": {"dof": 2, "threshold": float(chi2.isf(1e-3, 2)), "edges": at.tolist(),
                      "nominal": np.histogram(monitored, at, density=True)[0].tolist(),
                      "fault": np.histogram(fault, at, density=True)[0].tolist(),
                      "fault_name": "far threshold 184 m nearer than believed"},
        "faults": [_fault("far threshold nearer than believed", "m", sizes, (sizes / 60) ** 2),
                   _fault("one far corner slid", "px", shifts, shifts**2)],
        "roc": {"false_alarm": false_alarm.tolist(),
                "detection": {name: ncx2.sf(chi2.isf(false_alarm, 2), 2, power).tolist()
                              for name, power in (("184 m", 9.0), ("5 px far corner", 25.0))}},
        "navigation": _navigation(rows),
        "stanford": _stanford(rows, limits_m),
    }  # fmt: skip


def _metrics(rows):
    table = []
    groups = [("all", "all", np.ones(len(rows), bool))]
    groups += [("airport", name, rows.airport == name) for name in sorted(set(rows.airport))]
    for low, high in itertools.pairwise(EDGES_M):
        groups.append(("distance", f"{low:g}–{high:g} m", (rows.distance_m >= low) & (rows.distance_m < high)))
    for by, group, which in groups:
        if not which.any():
            continue
        some = rows.select(which)
        error = np.abs(some.error_px)
        median, count = float(np.median(error)), error.size
        spread = 1.25 * 1.96 * float(error.std()) / np.sqrt(count)
        inside = float((error <= 1.96 * some.sigma_px).mean())
        half = 1.96 * np.sqrt(inside * (1 - inside) / count)
        for name, value, reach, unit in (("error_px.median", median, spread, "px"), ("coverage.95", inside, half, "")):
            table.append({"by": by, "group": group, "name": name, "value": value, "low": value - reach,
                          "high": min(value + reach, 1.0) if unit == "" else value + reach, "count": count,
                          "unit": unit})  # fmt: skip
    return table


def _fault(name, unit, sizes, power):
    detected = ncx2.sf(chi2.isf(1e-3, 2), 2, np.maximum(power, 1e-9))
    half = 0.04 * np.sqrt(detected * (1 - detected)) * 2
    return {"name": name, "unit": unit, "sizes": sizes.tolist(), "detected": detected.tolist(),
            "low": np.clip(detected - half, 0, 1).tolist(), "high": np.clip(detected + half, 0, 1).tolist(),
            "accepted_error_m": [[30.0, 3.0, 2.0]] * len(sizes)}  # fmt: skip


def _navigation(rows):
    solved = rows.select(np.isfinite(rows.error_m).all(axis=1))
    at = np.digitize(solved.distance_m, EDGES_M) - 1
    bins = [solved.select(at == k) for k in range(len(EDGES_M) - 1)]
    level = [np.where(np.isfinite(some.level_m), some.level_m, np.nan) for some in bins]
    return {"edges_m": EDGES_M, "axes": {
        axis: {"count": [len(some) for some in bins],
               "rms_m": [_plain(np.sqrt((some.error_m[:, a] ** 2).mean())) if len(some) else None for some in bins],
               "sigma_rms_m": [_plain(np.sqrt((some.sigma_m[:, a] ** 2).mean())) if len(some) else None
                               for some in bins],
               "q95_m": [_plain(np.quantile(np.abs(some.error_m[:, a]), 0.95)) if len(some) else None
                         for some in bins],
               "level_median_m": [_plain(np.nanmedian(some[:, a])) if np.isfinite(some[:, a]).any() else None
                                  for some in level]}
        for a, axis in enumerate(AXES)}}  # fmt: skip


def _plain(value):
    return float(value) if np.isfinite(value) else None


def _stanford(rows, limits_m):
    known = np.isfinite(rows.error_m) & ~np.isnan(rows.level_m)
    table = {}
    for a, axis in enumerate(AXES):
        which = known[:, a] & rows.accepted
        error, level = np.abs(rows.error_m[which, a]), rows.level_m[which, a]
        limit = np.inf if limits_m is None else limits_m[a]
        offered, over = level <= limit, error > level
        counts = {"nominal": offered & ~over, "misleading": offered & over & (error <= limit),
                  "hazardous": offered & over & (error > limit), "unavailable": ~offered & ~over,
                  "unavailable_misleading": ~offered & over}  # fmt: skip
        table[axis] = {name: int(flags.sum()) for name, flags in counts.items()}
        table[axis]["not_accepted"] = int((known[:, a] & ~rows.accepted).sum())
    return table
