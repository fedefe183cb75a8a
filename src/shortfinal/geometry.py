"""Camera, pose and projection.

Frames, axes, units and the pixel centre: the table of conventions in docs/architecture.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from shortfinal.errors import InputError

Array = NDArray[np.float64]

# Columns: the body axes (x forward, y left, z up) seen in the camera's (x right, y down, z forward).
BODY_FROM_CAMERA: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

# A compiled function. Without numba's runtime nothing can be allocated in it, which is a promise of
# the solver's, and no references are counted, which would cost it half of its time. (So a function
# that does have the runtime must not take an array back from one of these: numbers only.)
kernel: Any = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)  # type: ignore[call-overload]
# For a kernel that takes long tuples and is called in one place: a call copies them.
inlined: Any = njit(cache=True, nogil=True, error_model="numpy", _nrt=False, forceinline=True)  # type: ignore[call-overload]

_DISTORTION_LENGTHS = (0, 4, 5, 8)
_FOLDED = 1e-6  # Jacobian determinant of the distortion beyond the radius where it is one-to-one


def as_array(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """A read-only float64 copy of `value`, refused unless finite and of `shape` (None: any length).

    Raises InputError naming the argument and, for a non-finite entry, its index.
    """
    try:
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError) as error:
        given = " ".join(repr(value).split())
        raise InputError(f"{name}: expected numbers, got {given:.80}") from error
    matches = array.ndim == len(shape) and all(
        want in (None, got) for want, got in zip(shape, array.shape, strict=True)
    )
    if not matches:
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise InputError(f"{name}: expected shape {wanted}, got {array.shape}")
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{name}: entry {list(index)} is {array[index]}; every entry must be finite")
    return frozen(array)


def nearest_rotation(matrix: Array) -> Array:
    """The rotation nearest to `matrix` (3, 3), which rounding has left a little skew: U Vt of its SVD."""
    u, _, vt = np.linalg.svd(matrix)
    return frozen(u @ vt)


def frozen(array: Array) -> Array:
    """The same array, no longer to be written to."""
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class PixelWindow:
    """A rectangle of an image, resampled to `out_width` x `out_height`.

    The one place where crops, resizes and label imports move pixel coordinates. Bounds are pixel
    *edges* (the image spans 0 to width; the centre of pixel u lies at u + 1/2), so that with scale
    s = out / extent a pixel u becomes (u + 1/2 - left) s - 1/2. The window may exceed the image.
    """

    left: float  # edge, px of the source image
    top: float
    width: float  # extent, px of the source image
    height: float
    out_width: int
    out_height: int

    def __post_init__(self) -> None:
        values = (self.left, self.top, self.width, self.height)
        if not all(map(math.isfinite, values)) or min(self.width, self.height) <= 0:
            raise InputError(f"window: extents must be finite and positive, got {values}")
        if min(self.out_width, self.out_height) < 1:
            raise InputError("window: the output must be at least 1 x 1 pixel")

    @classmethod
    def resize(cls, width: int, height: int, out_width: int, out_height: int) -> PixelWindow:
        """The whole of a `width` x `height` image, resized."""
        return cls(0.0, 0.0, width, height, out_width, out_height)

    @property
    def scale(self) -> Array:
        """Output pixels per source pixel, (2,): along u, along v."""
        return np.array([self.out_width / self.width, self.out_height / self.height])

    def apply(self, px: ArrayLike) -> Array:
        """Source pixels (..., 2) to output pixels (..., 2)."""
        return (np.asarray(px, float) + 0.5 - [self.left, self.top]) * self.scale - 0.5

    def inverse(self, px: ArrayLike) -> Array:
        """Output pixels (..., 2) to source pixels (..., 2)."""
        return (np.asarray(px, float) + 0.5) / self.scale + [self.left, self.top] - 0.5

    def apply_cov(self, cov_px: ArrayLike) -> Array:
        """Covariance of K keypoints (2K, 2K) in source pixels, as one in output pixels."""
        return _scaled_cov(cov_px, self.scale)

    def inverse_cov(self, cov_px: ArrayLike) -> Array:
        """Covariance of K keypoints (2K, 2K) in output pixels, as one in source pixels."""
        return _scaled_cov(cov_px, 1.0 / self.scale)


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with OpenCV's distortion.

    Raises InputError for a non-positive size or focal length, a non-finite value, or a number of
    distortion coefficients other than 0, 4, 5 or 8 (k1, k2, p1, p2, k3, k4, k5, k6).
    """

    width: int  # px
    height: int  # px
    fx: float  # focal length, px
    fy: float
    cx: float  # principal point, px; the centre of the top-left pixel is (0, 0)
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            if isinstance(getattr(self, name), bool) or not isinstance(getattr(self, name), (int, np.integer)):
                raise InputError(f"camera: {name} is {getattr(self, name)!r}; it must be a whole number of pixels")
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(as_array(getattr(self, name), (), f"camera: {name}")))
        distortion = as_array(self.distortion, (None,), "camera: distortion")
        object.__setattr__(self, "distortion", tuple(float(k) for k in distortion))
        if min(self.width, self.height) < 1 or min(self.fx, self.fy) <= 0:
            raise InputError("camera: width, height, fx and fy must be positive")
        if len(self.distortion) not in _DISTORTION_LENGTHS:
            raise InputError(
                f"camera: distortion has {len(self.distortion)} coefficients; "
                f"OpenCV's order has {', '.join(map(str, _DISTORTION_LENGTHS))}"
            )

    @property
    def matrix(self) -> Array:
        """The 3 x 3 intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def intrinsics(self) -> Array:
        """(fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6): what the kernels take; read-only."""
        padding = (0.0,) * (8 - len(self.distortion))
        return frozen(np.array((self.fx, self.fy, self.cx, self.cy, *self.distortion, *padding)))

    def view(self, window: PixelWindow) -> Camera:
        """The camera that would have taken the resampled window directly."""
        sx, sy = (float(s) for s in window.scale)
        cx, cy = (float(c) for c in window.apply((self.cx, self.cy)))
        return Camera(window.out_width, window.out_height, self.fx * sx, self.fy * sy, cx, cy, self.distortion)


class Attitude(NamedTuple):
    """Aviation sense, degrees: yaw right of the runway heading, nose up, right wing down positive."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float


@dataclass(frozen=True, eq=False)
class Pose:
    """Where the camera is, in the runway frame, and how it is turned.

    `position_m` (3,) and `runway_from_camera` (3, 3, or a scipy Rotation). Raises InputError for a
    wrong shape, a non-finite entry, or a matrix that is no rotation (to 1e-6).
    """

    position_m: Array
    runway_from_camera: Array

    def __post_init__(self) -> None:
        rotation = self.runway_from_camera
        rotation = rotation.as_matrix() if hasattr(rotation, "as_matrix") else rotation
        rotation = as_array(rotation, (3, 3), "runway_from_camera")
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if off > 1e-6 or np.linalg.det(rotation) < 0:
            raise InputError(f"runway_from_camera: not a rotation (R Rt - 1 is up to {off:.1e}, or it mirrors)")
        object.__setattr__(self, "position_m", as_array(self.position_m, (3,), "position_m"))
        object.__setattr__(self, "runway_from_camera", rotation)

    @classmethod
    def trusted(cls, position_m: Array, runway_from_camera: Array) -> Pose:
        """From arrays that are read-only, and a rotation that is one: the solver's own. Nothing is checked."""
        pose = object.__new__(cls)
        pose.__dict__.update(position_m=position_m, runway_from_camera=runway_from_camera)
        return pose

    @classmethod
    def from_attitude(
        cls, position_m: ArrayLike, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0
    ) -> Pose:
        """A camera that looks along the body's x axis, from attitude in aviation sense (degrees)."""
        yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
        # In x forward, y left, z up, a turn to the right is negative about z and nose up negative
        # about y; right wing down is positive about x.
        runway_from_body = _rotation_z(-yaw) @ _rotation_y(-pitch) @ _rotation_x(roll)
        return cls(np.asarray(position_m, float), runway_from_body @ BODY_FROM_CAMERA)

    @property
    def attitude(self) -> Attitude:
        """Yaw, pitch and roll in degrees: the inverse of `from_attitude`."""
        r = self.runway_from_camera @ BODY_FROM_CAMERA.T
        yaw = -math.atan2(r[1, 0], r[0, 0])
        pitch = math.asin(min(1.0, max(-1.0, r[2, 0])))
        roll = math.atan2(r[2, 1], r[2, 2])
        return Attitude(*(math.degrees(a) for a in (yaw, pitch, roll)))

    def plus(self, increment: ArrayLike) -> Pose:
        """Moved by a local increment (6,): p + dp, R exp(dtheta); metres and radians."""
        d = np.asarray(increment, float)
        return Pose(self.position_m + d[:3], self.runway_from_camera @ so3_exp(d[3:]))

    def minus(self, other: Pose) -> Array:
        """The local increment (6,) with `other.plus(increment)` equal to this pose."""
        from scipy.spatial.transform import Rotation

        turn = other.runway_from_camera.T @ self.runway_from_camera
        return np.concatenate([self.position_m - other.position_m, Rotation.from_matrix(turn).as_rotvec()])


def project(camera: Camera, pose: Pose, points: ArrayLike) -> Array:
    """Pixels (K, 2) of `points` (K, 3), metres in the runway frame.

    Raises InputError naming the first point that lies behind the camera, or so far aside that the
    distortion folds back on itself there.
    """
    px, _, depth = _project_all(camera, pose, points)
    if not (depth > 0).all():
        k = int(np.argmax(~(depth > 0)))
        where = "outside the range of the camera's distortion" if np.isnan(depth[k]) else "behind the camera"
        raise InputError(f"points: point {k} is {where}")
    return px


def can_project(camera: Camera, pose: Pose, points: ArrayLike) -> NDArray[np.bool_]:
    """Which (K,) of `points` (K, 3) `project` has pixels for."""
    return np.asarray(_project_all(camera, pose, points)[2] > 0)


def project_jacobian(camera: Camera, pose: Pose, points: ArrayLike) -> Array:
    """d(pixels) / d(local increment) of the pose, (2K, 6): pixels per metre and per radian.

    Rows u0, v0, u1, v1, ...; columns as in `Pose.plus`. Raises as `project`.
    """
    project(camera, pose, points)
    return _project_all(camera, pose, points)[1]


def project_lines(camera: Camera, pose: Pose, edges: ArrayLike) -> Array:
    """Image lines (L, 2) of straight `edges` (L, 2, 3; both ends, metres, runway frame): rho, theta.

    Normal form u cos(theta) + v sin(theta) = rho, in pixels of the undistorted image and radians;
    0 <= theta < pi. Either end may lie behind the camera: it is the line through both that is
    drawn. Raises InputError for an edge that points at the camera, whose image is no line.
    """
    ends = as_array(edges, (None, 2, 3), "edges")
    lines, rotation = np.zeros((len(ends), 2)), np.ascontiguousarray(pose.runway_from_camera)
    lines_kernel(ends, rotation, pose.position_m, camera.intrinsics, 0, lines.reshape(-1), np.empty((2 * len(ends), 6)))
    if not np.isfinite(lines).all():
        k = int(np.argmax(~np.isfinite(lines).all(axis=1)))
        raise InputError(f"edges: edge {k} points at the camera, or lies in its focal plane: its image is no line")
    turned = lines[:, 1] < 0.0
    lines[turned] = lines[turned] * [-1.0, 1.0] + [0.0, np.pi]
    return lines


def unproject(camera: Camera, px: ArrayLike) -> Array:
    """Directions (K, 3) in the camera frame with z = 1, of pixels (K, 2); distortion removed.

    Raises InputError where no undistorted direction exists: the pixel lies outside the lens model.
    """
    pixels = as_array(px, (None, 2), "px")
    rays = np.ones((len(pixels), 3))
    for k, (u, v) in enumerate(pixels):
        x, y, ok = normalise_kernel(u, v, camera.intrinsics)
        if not ok:
            raise InputError(f"px: pixel {k} ({u:.1f}, {v:.1f}) is outside the range of the camera's distortion")
        rays[k, :2] = x, y
    return rays


def _scaled_cov(cov_px: ArrayLike, scale: Array) -> Array:
    cov = np.asarray(cov_px, float)
    each = np.tile(scale, cov.shape[0] // 2)
    return cov * np.outer(each, each)


def so3_exp(rotation_vector: ArrayLike) -> Array:
    """Rotation matrix of a rotation vector (3,), radians."""
    out = np.empty((3, 3))
    exp_kernel(np.asarray(rotation_vector, np.float64), out)
    return out


def _project_all(camera: Camera, pose: Pose, points: ArrayLike) -> tuple[Array, Array, Array]:
    world = np.ascontiguousarray(as_array(points, (None, 3), "points"))
    count = len(world)
    px, jacobian, depth = np.empty(2 * count), np.empty((2 * count, 6)), np.empty(count)
    rotation = np.ascontiguousarray(pose.runway_from_camera)
    project_kernel(world, rotation, pose.position_m, camera.intrinsics, px, jacobian, depth)
    return px.reshape(-1, 2), jacobian, depth


def _rotation_x(a: float) -> Array:
    c, s = math.cos(a), math.sin(a)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _rotation_y(a: float) -> Array:
    c, s = math.cos(a), math.sin(a)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _rotation_z(a: float) -> Array:
    c, s = math.cos(a), math.sin(a)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


# The kernels below are compiled; the solver calls the same ones, so that what it minimises is what
# `project` draws. Scalars and caller-owned arrays only: nothing is allocated per call.


@kernel
def distort_kernel(x, y, k):  # type: ignore[no-untyped-def]
    """OpenCV's rational model on normalised (x, y): (xd, yd) and the four entries of its Jacobian."""
    k1, k2, p1, p2, k3, k4, k5, k6 = k[4], k[5], k[6], k[7], k[8], k[9], k[10], k[11]
    r2 = x * x + y * y
    up = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    down = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = up / down
    # d(radial) / d(r2), by the quotient rule
    slope = (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - radial * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) / down
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    xx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    xy = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    yy = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return xd, yd, xx, xy, xy, yy


@kernel
def pinhole_kernel(k):  # type: ignore[no-untyped-def]
    """Whether the lens has no distortion."""
    return (
        k[4] == 0.0 and k[5] == 0.0 and k[6] == 0.0 and k[7] == 0.0
        and k[8] == 0.0 and k[9] == 0.0 and k[10] == 0.0 and k[11] == 0.0
    )  # fmt: skip


@kernel
def normalise_kernel(u, v, k):  # type: ignore[no-untyped-def]
    """Pixel to undistorted normalised (x, y) by Newton's method, and whether it converged."""
    xd, yd = (u - k[2]) / k[0], (v - k[3]) / k[1]
    if pinhole_kernel(k):
        return xd, yd, True
    x, y = xd, yd
    for _ in range(50):
        a, b, xx, xy, yx, yy = distort_kernel(x, y, k)
        det = xx * yy - xy * yx
        if not det > _FOLDED:
            return x, y, False
        ex, ey = a - xd, b - yd
        x -= (yy * ex - xy * ey) / det
        y -= (xx * ey - yx * ex) / det
        if ex * ex + ey * ey < 1e-24:
            return x, y, True
    return x, y, False


@kernel
def exp_kernel(w, out):  # type: ignore[no-untyped-def]
    """Rodrigues' formula into `out` (3, 3)."""
    x, y, z = w[0], w[1], w[2]
    t2 = x * x + y * y + z * z
    if t2 < 1e-8:  # series: both quotients lose digits near zero
        a, b = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    else:
        t = math.sqrt(t2)
        a, b = math.sin(t) / t, (1.0 - math.cos(t)) / t2
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[0, 1] = b * x * y - a * z
    out[0, 2] = b * x * z + a * y
    out[1, 0] = b * x * y + a * z
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[1, 2] = b * y * z - a * x
    out[2, 0] = b * x * z - a * y
    out[2, 1] = b * y * z + a * x
    out[2, 2] = 1.0 - b * (x * x + y * y)


@kernel
def cayley_kernel(w, out):  # type: ignore[no-untyped-def]
    """A rotation by about the rotation vector `w` (3,), to second order, into `out` (3, 3).

    Cayley's map: the quaternion (1, w/2), normalised. No trigonometry, and no step beyond half a turn.
    """
    x, y, z = 0.5 * w[0], 0.5 * w[1], 0.5 * w[2]
    b = 2.0 / (1.0 + x * x + y * y + z * z)
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - b * (y * y + z * z), b * (x * y - z), b * (x * z + y)
    out[1, 0], out[1, 1], out[1, 2] = b * (x * y + z), 1.0 - b * (x * x + z * z), b * (y * z - x)
    out[2, 0], out[2, 1], out[2, 2] = b * (x * z - y), b * (y * z + x), 1.0 - b * (x * x + y * y)


@kernel
def copy_kernel(source, target):  # type: ignore[no-untyped-def]
    """Into `target`, number by number; both flat, and not overlapping."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@kernel
def product_kernel(a, b, out):  # type: ignore[no-untyped-def]
    """The product of two matrices (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@kernel
def log_kernel(r, w):  # type: ignore[no-untyped-def]
    """The rotation vector of the matrix `r` (3, 3) into `w` (3,); its length is in [0, pi]."""
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]  # 2 sin(t) times the axis
    sine, cosine = 0.5 * math.sqrt(x * x + y * y + z * z), 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0)
    angle = math.atan2(sine, cosine)
    if cosine > -0.9:
        scale = 0.5 * angle / sine if sine > 1e-4 else 0.5 + sine * sine / 12.0
        w[0], w[1], w[2] = x * scale, y * scale, z * scale
        return
    # Near pi the sine is lost: the axis is the longest column of R + Rt + (1 - trace) 1, which is
    # 2 (1 - cos t) times axis axis-t.
    shift, longest = 1.0 - r[0, 0] - r[1, 1] - r[2, 2], 0
    for a in range(1, 3):
        if r[a, a] > r[longest, longest]:
            longest = a
    for a in range(3):
        w[a] = r[a, longest] + r[longest, a] + (shift if a == longest else 0.0)
    length = math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    scale = math.copysign(angle / length, x * w[0] + y * w[1] + z * w[2])
    w[0], w[1], w[2] = w[0] * scale, w[1] * scale, w[2] * scale


@kernel
def project_kernel(points, rotation, position, k, px, jacobian, depth):  # type: ignore[no-untyped-def]
    """Pixels (2K,), Jacobian (2K, 6) in the local increment, and depths (K,) of points (K, 3).

    The depth is NaN where the distortion is no longer one-to-one: there is no such pixel.

    With Xc = Rt (P - p): dXc/dp = -Rt and, for R exp(dtheta), dXc/dtheta = [Xc]x.
    """
    pinhole = pinhole_kernel(k)
    # Scalars, for the compiler cannot tell that the arrays it fills are not those it reads.
    fu, fv, cu, cv, px0, py0, pz0 = k[0], k[1], k[2], k[3], position[0], position[1], position[2]
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - px0, points[i, 1] - py0, points[i, 2] - pz0
        xc, yc, zc = r00 * dx + r10 * dy + r20 * dz, r01 * dx + r11 * dy + r21 * dz, r02 * dx + r12 * dy + r22 * dz
        depth[i] = zc
        inverse = 1.0 / zc if zc != 0.0 else math.inf
        x, y = xc * inverse, yc * inverse
        xd, yd, xx, xy, yx, yy = x, y, 1.0, 0.0, 0.0, 1.0
        if not pinhole:
            xd, yd, xx, xy, yx, yy = distort_kernel(x, y, k)
            if not xx * yy - xy * yx > _FOLDED:
                depth[i] = math.nan
        u, v = 2 * i, 2 * i + 1
        px[u], px[v] = fu * xd + cu, fv * yd + cv
        gx, gy = fu * inverse * xx, fu * inverse * xy
        gz = -(gx * x + gy * y)
        jacobian[u, 0] = -(gx * r00 + gy * r01 + gz * r02)
        jacobian[u, 1] = -(gx * r10 + gy * r11 + gz * r12)
        jacobian[u, 2] = -(gx * r20 + gy * r21 + gz * r22)
        jacobian[u, 3], jacobian[u, 4], jacobian[u, 5] = gy * zc - gz * yc, gz * xc - gx * zc, gx * yc - gy * xc
        gx, gy = fv * inverse * yx, fv * inverse * yy
        gz = -(gx * x + gy * y)
        jacobian[v, 0] = -(gx * r00 + gy * r01 + gz * r02)
        jacobian[v, 1] = -(gx * r10 + gy * r11 + gz * r12)
        jacobian[v, 2] = -(gx * r20 + gy * r21 + gz * r22)
        jacobian[v, 3], jacobian[v, 4], jacobian[v, 5] = gy * zc - gz * yc, gz * xc - gx * zc, gx * yc - gy * xc


@kernel
def lines_kernel(edges, rotation, position, k, first, lines, jacobian):  # type: ignore[no-untyped-def]
    """Image lines rho, theta of `edges` (L, 2, 3) over what `lines` holds from row `first` on, and
    their Jacobian in the local increment.

    (rho, theta) and (-rho, theta + pi) are one line: the form nearest in angle to the line that was
    in `lines` is chosen, so that a difference of the two has no jumps. NaN where there is no line.

    The camera centre p and the edge A, B span the plane with normal n = (A - p) x (B - p); in the
    camera n_c = Rt n, and the line is l = K^-T n_c. dn = dp x (A - B); dn_c = [n_c]x dtheta.
    """
    for i in range(edges.shape[0]):
        rho, theta = first + 2 * i, first + 2 * i + 1
        ax, ay, az = edges[i, 0, 0] - position[0], edges[i, 0, 1] - position[1], edges[i, 0, 2] - position[2]
        bx, by, bz = edges[i, 1, 0] - position[0], edges[i, 1, 1] - position[1], edges[i, 1, 2] - position[2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        cx = rotation[0, 0] * nx + rotation[1, 0] * ny + rotation[2, 0] * nz
        cy = rotation[0, 1] * nx + rotation[1, 1] * ny + rotation[2, 1] * nz
        cz = rotation[0, 2] * nx + rotation[1, 2] * ny + rotation[2, 2] * nz
        l0, l1 = cx / k[0], cy / k[1]
        l2 = cz - k[2] * l0 - k[3] * l1
        size = l0 * l0 + l1 * l1
        norm = math.sqrt(size) if size > 0.0 else math.nan
        angle, sign = math.atan2(l1, l0), 1.0
        turns = math.floor((lines[theta] - angle) / math.pi + 0.5)
        if turns % 2.0 == 1.0:
            sign = -1.0
        lines[rho], lines[theta] = -sign * l2 / norm, angle + turns * math.pi + 0.0 * norm
        # Derivatives of both in n_c: columns of K^-T, then the normal form.
        for row in range(2):
            if row == 0:
                d0, d1, d2 = sign * l2 * l0 / (size * norm), sign * l2 * l1 / (size * norm), -sign / norm
            else:
                d0, d1, d2 = -l1 / size, l0 / size, 0.0
            gx, gy, gz = (d0 - k[2] * d2) / k[0], (d1 - k[3] * d2) / k[1], d2
            wx = rotation[0, 0] * gx + rotation[0, 1] * gy + rotation[0, 2] * gz
            wy = rotation[1, 0] * gx + rotation[1, 1] * gy + rotation[1, 2] * gz
            wz = rotation[2, 0] * gx + rotation[2, 1] * gy + rotation[2, 2] * gz
            j = rho + row
            # g . (dp x (A - B)) = ((A - B) x g) . dp, and g . (n_c x dtheta) = (g x n_c) . dtheta
            ex, ey, ez = ax - bx, ay - by, az - bz
            jacobian[j, 0], jacobian[j, 1], jacobian[j, 2] = ey * wz - ez * wy, ez * wx - ex * wz, ex * wy - ey * wx
            jacobian[j, 3], jacobian[j, 4], jacobian[j, 5] = gy * cz - gz * cy, gz * cx - gx * cz, gx * cy - gy * cx
