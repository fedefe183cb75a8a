"""Which measured feature is at fault? Leave it out and go on, or say why that cannot be done.

Fault detection and exclusion as in GNSS receiver autonomous integrity monitoring (Joerger & Pervan
2014), with every subset solved anew and not by its linearisation, so that faults of any size count
for what they are. Rival explanations are weighed by Akaike's criterion (Akaike 1974).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from shortfinal.errors import InputError
from shortfinal.features import GaussianLines
from shortfinal.integrity import FALSE_ALARM_RATE, Decision, IntegrityVerdict, check_integrity, check_rate
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pose import PoseEstimate, estimate_pose

Array = NDArray[np.float64]

# A culprit is named when it is at least four times as likely as all its rivals together. Measured
# with eight points, one off by 8 sigma: 95 to 96 % of the alarms then end with the right name, and
# 0.4 to 0.6 % of the frames with a wrong one; with 0.9 it would be 94 and 0.3 %.
SURE = 0.8

_FEWEST_POINTS = 3  # that the solver takes
_PRIORS = {"attitude prior": "attitude_prior", "position prior": "position_prior", "altitude": "altitude"}


@dataclass(frozen=True, eq=False)
class FaultExclusion:
    """What was left out of an estimate, what remained, and the verdict on that."""

    estimate: PoseEstimate  # re-made without the excluded features; the one given if none was
    verdict: IntegrityVerdict  # of `check_integrity` on `estimate`; DO_NOT_USE where the culprit cannot be told
    excluded: tuple[str, ...]  # names of the features left out
    kept: tuple[str, ...]  # names of the features of `estimate`, in the order of its rows
    candidates: tuple[tuple[str, ...], ...]  # sets of features that may be at fault, likeliest first


class _Trial(NamedTuple):
    """One hypothesis: these features are at fault, and no others."""

    members: tuple[int, ...]  # positions in `est.features`
    rows: int  # that they take with them
    estimate: PoseEstimate | None  # without them; None where there is none

    @property
    def cost(self) -> float:
        """Akaike's criterion: χ² of the rest, and 2 for each row left out; without a solution any χ² is possible."""
        return (0.0 if self.estimate is None else self.estimate.chi2) + 2.0 * self.rows

    def fits(self, rate: float) -> bool:
        """Whether the rest was solved and agrees with itself."""
        return self.estimate is not None and not _contradicts(self.estimate, rate)


def exclude_faults(
    est: PoseEstimate,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    *,
    max_faults: int = 2,
    names: Sequence[str] | None = None,
) -> FaultExclusion:
    """Leave out the features (keypoints, lines, priors) that contradict the others, and solve again.

    If the χ² test of all rows fails, or they have no solution, each feature is left out in turn,
    then each pair, up to `max_faults`. At the first number of faults at which some remainder passes
    its own test the likeliest set is excluded, provided its Akaike weight reaches 0.8; else the
    verdict is DO_NOT_USE and `candidates` holds the sets that share this weight. A set whose
    absence leaves nothing to check cannot be ruled out: four corners alone never name a culprit.

    The budget: a faultless frame alarms with `false_alarm_rate`, and then loses a good feature or
    is refused. With faults, of all remainders only the one without them can fail its test falsely,
    with that same rate, so that the rate is spent once whatever the number of subsets. Naming the
    wrong culprit is guarded by the weight instead. It is no worst-case bound: near a geometry where
    two faults look alike a wrong name is as likely as the weight says, up to one in five.

    `names` (K) replaces the names of the keypoints. Raises InputError for a rate outside (0, 1),
    `max_faults` below 1, or names that do not match the keypoints.
    """
    check_rate(false_alarm_rate, "false_alarm_rate")
    if isinstance(max_faults, bool) or not isinstance(max_faults, int) or max_faults < 1:
        raise InputError(f"max_faults: {max_faults!r} is no number of faults; give 1, 2 or more")
    named = _names(est, names)
    verdict = check_integrity(est, false_alarm_rate)
    if est.pose is not None and not _contradicts(est, false_alarm_rate):
        return FaultExclusion(est, verdict, (), named, ())
    unsolved: list[_Trial] = []
    for count in range(1, max_faults + 1):
        trials = [_try(est, members) for members in combinations(range(len(named)), count)]
        solved = [trial for trial in trials if trial.estimate is not None]
        unsolved += [trial for trial in trials if trial.estimate is None]
        if any(trial.fits(false_alarm_rate) for trial in solved):
            likely = _credible(_possible(est, solved, unsolved))
            return _decide(est, verdict, named, likely, false_alarm_rate)
    if unsolved:
        reason = "no freedom to spare: without the feature at fault nothing could be checked"
    else:
        reason = f"no {'single feature' if max_faults == 1 else f'set of up to {max_faults} features'} explains it"
    return FaultExclusion(est, _refused(verdict, reason, est.pose is not None), (), named, ())


def _names(est: PoseEstimate, names: Sequence[str] | None) -> tuple[str, ...]:
    own = [feature.name for feature in est.features]
    if names is None:
        return tuple(own)
    k = len(est.points)
    if isinstance(names, str) or len(names) != k or len({*names, *own[k:]}) != len(own):
        raise InputError(f"names: give {k} different names, one per keypoint")
    return (*names, *own[k:])


def _contradicts(est: PoseEstimate, rate: float) -> bool:
    """Whether the residual is larger than the stated uncertainty explains."""
    return est.dof > 0 and float(chdtrc(est.dof, est.chi2)) < rate


def _try(est: PoseEstimate, members: tuple[int, ...]) -> _Trial:
    rows = sum(est.features[m].rows.stop - est.features[m].rows.start for m in members)
    points = len(est.points) - sum(m < len(est.points) for m in members)
    if est.dof - rows < 1 or points < _FEWEST_POINTS:
        return _Trial(members, rows, None)
    rest = _without(est, members)
    return _Trial(members, rows, None if rest.pose is None else rest)


def _possible(est: PoseEstimate, solved: list[_Trial], unsolved: list[_Trial]) -> list[_Trial]:
    """Without the sets whose rest has no solution though its geometry has one: the rest contradicts itself.

    The geometry is that of the likeliest solution. Where it stays determined without the rows of a
    set, the gap that the set leaves is not the reason.
    """
    best = min(solved, key=lambda trial: trial.cost)
    return solved + [t for t in unsolved if est.dof - t.rows < 1 or not _determined(est, best, t)]


def _determined(est: PoseEstimate, best: _Trial, other: _Trial) -> bool:
    """Whether the rows of `best` that `other` also keeps determine the pose."""
    assert best.estimate is not None
    rows = [r for m, f in enumerate(est.features) if m not in best.members for r in [m] * (f.rows.stop - f.rows.start)]
    jacobian = best.estimate.jacobian[~np.isin(rows, other.members)]
    return bool(np.linalg.matrix_rank(jacobian / np.linalg.norm(jacobian, axis=0), tol=1e-6) == 6)


def _without(est: PoseEstimate, members: tuple[int, ...]) -> PoseEstimate:
    """The estimate from all features but these."""
    k = len(est.points)
    gone = {est.features[m].name for m in members}
    priors = {argument: getattr(est, argument) for name, argument in _PRIORS.items() if name not in gone}
    keep = [m for m in range(k) if m not in members]
    keypoints = GaussianKeypoints(*_part(est.keypoints.mean_px, est.keypoints.cov_px, keep))
    if est.lines is None or est.edges is None:
        return estimate_pose(keypoints, est.points[keep], est.camera, **priors)
    kept = [m for m in range(len(est.edges)) if k + m not in members]
    lines = GaussianLines(*_part(est.lines.mean, est.lines.cov, kept)) if kept else None
    edges = est.edges[kept] if kept else None
    return estimate_pose(keypoints, est.points[keep], est.camera, lines=lines, edges=edges, **priors)


def _part(mean: Array, cov: Array, keep: list[int]) -> tuple[Array, Array]:
    """Some of the pairs (K, 2), with their own covariance."""
    rows = [row for k in keep for row in (2 * k, 2 * k + 1)]
    return mean[keep], cov[np.ix_(rows, rows)]


def _decide(
    est: PoseEstimate, verdict: IntegrityVerdict, names: tuple[str, ...], likely: list[_Trial], rate: float
) -> FaultExclusion:
    """Exclude the likeliest set if it has no rival and leaves something to check; else refuse, and say why."""
    candidates = tuple(tuple(names[m] for m in trial.members) for trial in likely)
    shown = " or ".join(" with ".join(each) for each in candidates)
    best = likely[0].estimate
    after = None if best is None or len(likely) > 1 else check_integrity(best, rate)
    if best is None or after is None or after.decision is not Decision.USE:
        if len(likely) > 1:
            reason = f"the culprit cannot be told: {shown} would explain it about as well"
        else:
            reason = f"{shown} may be at fault, but the rest cannot be checked"
        return FaultExclusion(est, _refused(verdict, reason), (), names, candidates)
    kept = tuple(name for m, name in enumerate(names) if m not in likely[0].members)
    reasons = (f"{shown} excluded: {verdict.reasons[0]}", *after.reasons)
    return FaultExclusion(best, replace(after, reasons=reasons), candidates[0], kept, candidates)


def _credible(trials: list[_Trial]) -> list[_Trial]:
    """The fewest sets, likeliest first, that hold the share SURE of the Akaike weights exp(-cost / 2)."""
    ranked = sorted(trials, key=lambda trial: trial.cost)
    weights = np.exp(-0.5 * (np.array([trial.cost for trial in ranked]) - ranked[0].cost))
    return ranked[: 1 + int(np.searchsorted(np.cumsum(weights), SURE * weights.sum()))]


def _refused(verdict: IntegrityVerdict, reason: str, contradicted: bool = True) -> IntegrityVerdict:
    """The verdict on all rows, with one reason more."""
    decision = Decision.DO_NOT_USE if contradicted else Decision.NOT_MONITORED
    return replace(verdict, decision=decision, reasons=(*verdict.reasons, reason))
