"""The distribution of a pose: by its linear covariance, by solving anew, or as a posterior.

The covariance of an estimate is that of a linear problem. Far away (beyond 4 km, 1 px and more) the
pose is no linear function of the pixels, and its errors are skewed; the two sampling methods follow
them (Valentin et al. 2024, probabilistic parameter estimators and calibration metrics for pose
estimation from image features). How well each covers the truth: benchmarks/distribution.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError
from shortfinal.geometry import Pose
from shortfinal.pose import PoseEstimate, estimate_pose_batch, pose_costs

Array = NDArray[np.float64]

METHODS = ("linear", "resample", "posterior")
LARGEST_LOSS = 0.05  # share of re-solved draws that may end without a pose

_WALKERS = 64
_BLOCK = 100  # steps between looks at the autocorrelation
_MOST_STEPS = 10_000
_ENOUGH = 50  # autocorrelation times that a chain must last for its own estimate of them (Sokal 1997)
_WARM_UPS = 2  # blocks after which the coordinates are fitted to the ensemble, and which do not count
_FREEDOM, _SPREAD = 5.0, 1.3  # of the proposals at large: a t distribution, a little wider than the linear solution
_FARTHEST_M = 1e5  # a flat prior needs an end: from far enough every runway is one pixel


@dataclass(frozen=True, eq=False)
class PoseSamples:
    """N draws of a pose."""

    positions: Array  # (N, 3) m, runway frame
    rotations: Array  # (N, 3, 3) runway_from_camera
    centre: Pose  # the estimate that they are of
    lost: int = 0  # draws without a pose ("resample"), left out

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def increments(self) -> Array:
        """Local increments (N, 6) that lead from `centre` to the draws; m and rad."""
        from scipy.spatial.transform import Rotation

        turns = Rotation.from_matrix(self.centre.runway_from_camera.T @ self.rotations).as_rotvec()
        return np.hstack([self.positions - self.centre.position_m, turns])

    @property
    def cov(self) -> Array:
        """Covariance (6, 6) of the increments about their own mean; m and rad."""
        return np.asarray(np.cov(self.increments, rowvar=False), np.float64)

    def interval(self, level: float) -> Array:
        """Lower and upper end (3, 2), metres, that hold the share `level` along, across and up, with
        as much left out on either side. Raises InputError unless 0 < level < 1.

        Quantiles are at k / (N + 1), so that one more draw falls between the ends with just that chance.
        """
        if not 0 < level < 1:
            raise InputError(f"level: {level} is no share; it must lie between 0 and 1, e.g. 0.95")
        tails = 0.5 * (1.0 - level), 0.5 * (1.0 + level)
        return np.asarray(np.quantile(self.positions, tails, axis=0, method="weibull").T, np.float64)


def sample_pose(est: PoseEstimate, count: int = 1000, method: str = "linear", seed: int = 0) -> PoseSamples:
    """`count` draws from the distribution of the pose.

    "linear": normal, with the covariance of `est`. "resample": a parametric bootstrap (Efron 1979):
    measurements are drawn around the *predicted* ones, as around the truth, and solved anew; drawn
    around the measured ones their noise would enter twice. "posterior": draws from exp(-J / 2), J
    the solver's cost, with a flat prior on position and rotation over physical poses, by emcee's
    ensemble sampler (Foreman-Mackey et al. 2013; extra "posterior").

    Raises InputError without an estimate, for an unknown method or a count below 2, if more than
    one re-solved draw in 20 has no pose, if emcee is missing, or if its chain has not mixed.
    """
    draw = {"linear": _linear, "resample": _resampled, "posterior": _posterior}.get(method)
    if draw is None:
        raise InputError(f"method: {method!r} is unknown; choose one of {', '.join(METHODS)}")
    if isinstance(count, bool) or not isinstance(count, int) or count < 2:
        raise InputError(f"count: {count!r} is no number of draws; give 2 or more")
    if est.pose is None or est.cov is None:
        raise InputError(f"est: no pose to sample: the solver ended {est.status.value}")
    return draw(est, est.pose, est.cov, count, seed)


def _linear(est: PoseEstimate, pose: Pose, cov: Array, count: int, seed: int) -> PoseSamples:
    steps = np.random.default_rng(seed).normal(size=(count, 6)) @ np.linalg.cholesky(cov).T
    return _moved(pose, steps)


def _moved(pose: Pose, steps: Array) -> PoseSamples:
    """The poses `pose.plus(step)`."""
    return PoseSamples(pose.position_m + steps[:, :3], pose.runway_from_camera @ _turns(steps[:, 3:]), pose)


def _turns(vectors: Array) -> Array:
    """Rotations (N, 3, 3) of rotation vectors (N, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def _resampled(est: PoseEstimate, pose: Pose, cov: Array, count: int, seed: int) -> PoseSamples:
    noise = np.random.default_rng(seed).normal(size=(count, len(est.residual))) @ est.factor.T
    shifts = noise - est.factor @ est.residual  # from the measured to the predicted, and from there by the noise
    rows = {feature.name: feature.rows for feature in est.features}
    k = len(est.points)
    others: dict[str, Any] = {}
    if est.lines is not None:
        shift = shifts[:, 2 * k : 2 * (k + len(est.lines.mean))].reshape(count, -1, 2)
        others = {"lines": (est.lines.mean + shift, est.lines.cov), "edges": est.edges}
    if est.attitude_prior is not None:
        turned = pose.runway_from_camera @ _turns(noise[:, rows["attitude prior"]])
        others["attitude_prior"] = (turned, est.attitude_prior.cov_rad2)
    if est.position_prior is not None:
        moved = est.position_prior.position_m + shifts[:, rows["position prior"]]
        others["position_prior"] = (moved, est.position_prior.cov_m2)
    if est.altitude is not None:
        heights = est.altitude.height_m + shifts[:, rows["altitude"]].ravel()
        others["altitude"] = (heights, est.altitude.sigma_m)
    mean = est.keypoints.mean_px + shifts[:, : 2 * k].reshape(count, k, 2)
    batch = estimate_pose_batch(mean, est.keypoints.cov_px, est.points, est.camera, **others)
    solved = np.isfinite(batch.chi2)
    lost = int(count - solved.sum())
    if lost > LARGEST_LOSS * count:
        raise InputError(f"est: {lost} of {count} draws have no pose: too uncertain to sample by solving anew")
    return PoseSamples(batch.positions[solved], batch.rotations[solved], pose, lost)


def _posterior(est: PoseEstimate, pose: Pose, cov: Array, count: int, seed: int) -> PoseSamples:
    try:
        import emcee
    except ImportError as error:
        raise InputError('method: "posterior" needs emcee; install shortfinal[posterior]') from error
    random = np.random.RandomState(seed)  # emcee's kind
    density = _Density(est, pose, cov)
    start = random.normal(size=(4 * _WALKERS, 6))
    start = start[np.isfinite(density(start))][:_WALKERS]
    if len(start) < _WALKERS:
        raise InputError("est: most poses within its covariance are impossible: nowhere to start a posterior from")
    # Half the proposals are made at large, from a distribution near the posterior; half follow the ensemble.
    moves = [(emcee.moves.MHMove(_heavy_tailed), 0.5), (emcee.moves.DEMove(), 0.5)]

    def sampler_from(walkers: Array, steps: int) -> Any:
        sampler = emcee.EnsembleSampler(_WALKERS, 6, density, vectorize=True, moves=moves)
        sampler.random_state = random.get_state()
        sampler.run_mcmc(walkers, steps)
        random.set_state(sampler.random_state)
        return sampler

    for _ in range(_WARM_UPS):
        chain = sampler_from(start, _BLOCK).get_chain()
        start = density.fitted(chain[_BLOCK // 2 :].reshape(-1, 6), chain[-1])
    sampler = sampler_from(start, _BLOCK)
    while True:
        with np.errstate(invalid="ignore"):  # a walker that has not moved yet has no autocorrelation
            time = float(np.max(sampler.get_autocorr_time(tol=0)))
        if sampler.iteration >= _ENOUGH * time and sampler.iteration * _WALKERS >= count * time:
            chain = sampler.get_chain(thin=max(1, int(time)), flat=True)
            chosen = chain[np.linspace(0, len(chain) - 1, count).astype(int)]
            return _moved(pose, density.steps(chosen)[0])
        if sampler.iteration >= _MOST_STEPS:
            raise InputError(
                f"est: the posterior has not mixed: autocorrelation time {time:.0f} in {_MOST_STEPS} steps"
            )
        missing = _ENOUGH * time - sampler.iteration if math.isfinite(time) else math.inf
        sampler.run_mcmc(None, int(min(max(missing, _BLOCK), sampler.iteration)))


def _heavy_tailed(coordinates: Array, rng: np.random.RandomState) -> tuple[Array, Array]:
    """Draws of a multivariate t wherever the walkers are, and the logarithm of the ratio of its densities."""
    count, dimension = coordinates.shape
    scale = np.sqrt(_FREEDOM / rng.chisquare(_FREEDOM, size=count))
    proposed = _SPREAD * scale[:, None] * rng.normal(size=coordinates.shape)

    def log_t(x: Array) -> Array:
        return np.asarray(-0.5 * (_FREEDOM + dimension) * np.log1p(np.sum((x / _SPREAD) ** 2, axis=1) / _FREEDOM))

    return proposed, log_t(coordinates) - log_t(proposed)


class _Density:
    """The logarithm of the posterior's density over coordinates (N, 6) in which it is near normal.

    They are in standard deviations of the linear solution, and linear in 1 / range instead of the
    range from the points, as what a camera measures of an object is its size over its range.
    """

    def __init__(self, est: PoseEstimate, pose: Pose, cov: Array) -> None:
        self.est, self.pose = est, pose
        self.shift, self.root = np.zeros(6), np.linalg.cholesky(cov)
        self.offset = pose.position_m - est.points.mean(axis=0)

    def fitted(self, chain: Array, walkers: Array) -> Array:
        """The walkers (W, 6) in new coordinates, in which the chain (N, 6) has mean 0 and covariance 1."""
        linear = self.shift + walkers @ self.root.T
        self.shift = self.shift + self.root @ chain.mean(axis=0)
        self.root = self.root @ np.linalg.cholesky(np.cov(chain, rowvar=False))
        return np.asarray(np.linalg.solve(self.root, (linear - self.shift).T).T, np.float64)

    def steps(self, unit: Array) -> tuple[Array, Array]:
        """Local increments (N, 6) of the pose, and the logarithm of their volume per volume of `unit`."""
        linear = self.shift + unit @ self.root.T
        length = float(np.linalg.norm(self.offset))
        along = linear[:, :3] @ self.offset / length**2
        # The range grows as 1 / (1 - a), not as 1 + a, and the sideways part with it: the volume as its fourth power.
        shrunk = np.maximum(1.0 - along, length / _FARTHEST_M)
        aside = linear[:, :3] - along[:, None] * self.offset
        moved = (self.offset + aside) / shrunk[:, None] - self.offset
        volume = np.where(1.0 - along < shrunk, -np.inf, -4.0 * np.log(shrunk))
        return np.hstack([moved, linear[:, 3:]]), volume

    def __call__(self, unit: Array) -> Array:
        steps, volume = self.steps(unit)
        samples = _moved(self.pose, steps)
        costs = pose_costs(self.est, samples.positions, samples.rotations)
        # Above the ground and upright, as the solver asks of an optimum.
        physical = (samples.positions[:, 2] > 0) & (samples.rotations[:, 2, 1] < 0) & np.isfinite(costs)
        # Rotations are uniform when the vector's density is (sin(t / 2) / (t / 2))², t its length.
        turn = np.linalg.norm(steps[:, 3:], axis=1)
        uniform = 2.0 * np.log(np.sinc(np.minimum(turn, 3.0) / (2.0 * np.pi)))
        return np.where(physical & (turn < np.pi), -0.5 * np.where(physical, costs, 0.0) + uniform + volume, -np.inf)
