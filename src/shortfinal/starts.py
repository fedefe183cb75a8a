"""Where the solver's refinement begins: the closed-form poses that a few equations allow.

Compiled, for `pose.py` to call. Each kernel writes rotations (S, 3, 3), runway_from_camera, and
positions (S, 3), and returns how many. None is more than a start: weights and priors come later.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from shortfinal.geometry import copy_kernel, kernel, normalise_kernel

MOST_STARTS = 5  # of one kernel


class Scratch(NamedTuple):
    """Where the starts are worked out."""

    image: Any  # (K, 2) undistorted image coordinates of the keypoints
    flat: Any  # (K, 2) the points in their plane
    axes: Any  # (3, 3) runway_from_plane, or of a triangle
    centre: Any  # (3,) of the points
    turn: Any  # (3, 3)
    tilt: Any  # (3, 3)
    rays: Any  # (3, 3) of three keypoints, unit length
    roots: Any  # (4,) of the quartic
    rotations: Any  # (5, 3, 3) the starts
    positions: Any  # (5, 3)


def scratch_size(k: int) -> int:
    """Numbers that `carve_kernel` takes for K keypoints."""
    return 4 * k + 43 + 12 * MOST_STARTS


@kernel
def carve_kernel(work, start, k):  # type: ignore[no-untyped-def]
    """A scratch in `work` from `start` on, and where it ends."""
    a = start + 2 * k
    b = a + 2 * k
    c = b + 43
    d = c + 9 * MOST_STARTS
    end = d + 3 * MOST_STARTS
    return Scratch(
        work[start:a].reshape(k, 2), work[a:b].reshape(k, 2), work[b : b + 9].reshape(3, 3), work[b + 9 : b + 12],
        work[b + 12 : b + 21].reshape(3, 3), work[b + 21 : b + 30].reshape(3, 3), work[b + 30 : b + 39].reshape(3, 3),
        work[b + 39 : c], work[c:d].reshape(MOST_STARTS, 3, 3), work[d:end].reshape(MOST_STARTS, 3),
    ), end  # fmt: skip


@kernel
def flatten_kernel(mean, lens, image):  # type: ignore[no-untyped-def]
    """Undistorted image coordinates of the keypoints; False where the lens model has none."""
    seen = True
    for i in range(image.shape[0]):
        x, y, ok = normalise_kernel(mean[2 * i], mean[2 * i + 1], lens)
        image[i, 0], image[i, 1] = x, y
        seen = seen and ok
    return seen


@kernel
def planar_starts_kernel(points, w, rotations, positions):  # type: ignore[no-untyped-def]
    """IPPE's two poses of the points' plane (Collins & Bartoli 2014), the physical one first; 0 or 2.

    From the homography's value (p, q) and Jacobian at the centre: turn the optical axis on to the
    ray to the centre, and what is left of the Jacobian is a scaled 2 x 2 block of a rotation, which
    has two completions.
    """
    if not _plane_kernel(points, w):
        return 0
    p, q, j00, j01, j10, j11 = _homography_kernel(w.flat, w.image)
    _ray_kernel(p, q, w.turn)
    b00, b01 = w.turn[0, 0] - p * w.turn[2, 0], w.turn[0, 1] - p * w.turn[2, 1]
    b10, b11 = w.turn[1, 0] - q * w.turn[2, 0], w.turn[1, 1] - q * w.turn[2, 1]
    inverse = 1.0 / (b00 * b11 - b01 * b10)
    a00, a01 = (b11 * j00 - b01 * j10) * inverse, (b11 * j01 - b01 * j11) * inverse
    a10, a11 = (b00 * j10 - b10 * j00) * inverse, (b00 * j11 - b10 * j01) * inverse
    square = a00 * a00 + a01 * a01 + a10 * a10 + a11 * a11
    spread = math.sqrt(max(square * square - 4.0 * (a00 * a11 - a01 * a10) ** 2, 0.0))
    depth = 1.0 / math.sqrt(0.5 * (square + spread))  # 1 / the largest singular value
    if not 0.0 < depth < math.inf:
        return 0
    a00, a01, a10, a11 = a00 * depth, a01 * depth, a10 * depth, a11 * depth
    z0 = math.sqrt(max(1.0 - a00 * a00 - a10 * a10, 0.0))
    z1 = math.copysign(math.sqrt(max(1.0 - a01 * a01 - a11 * a11, 0.0)), -(a00 * a01 + a10 * a11))
    for s in range(2):
        sign = 1.0 - 2.0 * s
        _basis_kernel(a00, a10, sign * z0, a01, a11, sign * z1, w.tilt)
        rotation = rotations[s]
        _align_kernel(w.axes, w.turn, w.tilt, rotation)
        for a in range(3):
            centre = rotation[a, 0] * p + rotation[a, 1] * q + rotation[a, 2]
            positions[s, a] = w.centre[a] - centre * depth
    if physical_kernel(rotations[1], positions[1]):
        for a in range(3):
            positions[0, a], positions[1, a] = positions[1, a], positions[0, a]
            for b in range(3):
                rotations[0, a, b], rotations[1, a, b] = rotations[1, a, b], rotations[0, a, b]
    return 2


@kernel
def physical_kernel(rotation, position):  # type: ignore[no-untyped-def]
    """Above the ground and upright: the image's y axis points down."""
    return position[2] > 0.0 and rotation[2, 1] < 0.0


@kernel
def known_attitude_start_kernel(points, attitude, w, rotations, positions):  # type: ignore[no-untyped-def]
    """The position at which a camera of the given attitude sees the points; 0 or 1.

    Each ray d says that (1 - d dt)(P - p) = 0, which is linear in p: three normal equations.
    """
    a00 = a01 = a02 = a11 = a12 = a22 = b0 = b1 = b2 = 0.0
    for i in range(points.shape[0]):
        x, y = w.image[i, 0], w.image[i, 1]
        n = 1.0 / math.sqrt(1.0 + x * x + y * y)
        d0 = n * (attitude[0, 0] * x + attitude[0, 1] * y + attitude[0, 2])
        d1 = n * (attitude[1, 0] * x + attitude[1, 1] * y + attitude[1, 2])
        d2 = n * (attitude[2, 0] * x + attitude[2, 1] * y + attitude[2, 2])
        along = d0 * points[i, 0] + d1 * points[i, 1] + d2 * points[i, 2]
        a00, a01, a02 = a00 + 1.0 - d0 * d0, a01 - d0 * d1, a02 - d0 * d2
        a11, a12, a22 = a11 + 1.0 - d1 * d1, a12 - d1 * d2, a22 + 1.0 - d2 * d2
        b0, b1, b2 = b0 + points[i, 0] - d0 * along, b1 + points[i, 1] - d1 * along, b2 + points[i, 2] - d2 * along
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    det = a00 * c00 + a01 * c01 + a02 * c02
    if not det > 0.0:
        return 0
    c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
    positions[0, 0] = (c00 * b0 + c01 * b1 + c02 * b2) / det
    positions[0, 1] = (c01 * b0 + c11 * b1 + c12 * b2) / det
    positions[0, 2] = (c02 * b0 + c12 * b1 + c22 * b2) / det
    copy_kernel(attitude.reshape(9), rotations[0].reshape(9))
    return 1


@kernel
def known_position_start_kernel(points, position, w, rotations, positions):  # type: ignore[no-untyped-def]
    """The attitude at which a camera at the given position sees the first point, and that farthest
    from it in the image, where they are (TRIAD; Black 1964); 0 or 1.
    """
    first, second = 0, _farthest_kernel(w.image, 0)
    if second == first:
        return 0
    _world_basis_kernel(points, position, first, second, w.axes)
    x0, y0, x1, y1 = w.image[first, 0], w.image[first, 1], w.image[second, 0], w.image[second, 1]
    _basis_kernel(x0, y0, 1.0, x1, y1, 1.0, w.tilt)
    _product_transposed_kernel(w.axes, w.tilt, rotations[0])
    copy_kernel(position, positions[0])
    return 1


@kernel
def level_start_kernel(points, slope, w, rotations, positions):  # type: ignore[no-untyped-def]
    """Level, on a glide path of the given slope, as far off as the points' width in view tells; 1."""
    x, along = _spread_kernel(points, 0)
    y, across = _spread_kernel(points, 1)
    in_view = _spread_kernel(w.image, 0)[1] + _spread_kernel(w.image, 1)[1]
    distance = min(max((across + slope * along) / max(in_view, 1e-9), 1.0), 1e5)
    _basis_kernel(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, rotations[0])
    positions[0, 0], positions[0, 1], positions[0, 2] = x - along - distance, y, points[0, 2] + distance * slope
    return 1


@kernel
def further_starts_kernel(points, rotation, position, rotations, positions):  # type: ignore[no-untyped-def]
    """Where else the optimum may be, given one: nearer or farther on the line to the nearest point,
    or at the other end of the runway, looking back; 5.
    """
    nearest, least = 0, math.inf
    for i in range(points.shape[0]):
        square = 0.0
        for a in range(3):
            square += (points[i, a] - position[a]) ** 2
        if square < least:
            nearest, least = i, square
    for s in range(5):
        copy_kernel(rotation.reshape(9), rotations[s].reshape(9))
        for a in range(3):
            scale = 0.25 if s == 0 else (0.5 if s == 1 else (2.0 if s == 2 else 4.0))
            positions[s, a] = points[nearest, a] + scale * (position[a] - points[nearest, a])
    for a in range(2):  # half a turn about the vertical
        positions[4, a] = 2.0 * _spread_kernel(points, a)[0] - position[a]
        for b in range(3):
            rotations[4, a, b] = -rotation[a, b]
    positions[4, 2] = position[2]
    return 5


@kernel
def _spread_kernel(rows, axis):  # type: ignore[no-untyped-def]
    """Mean and standard deviation of a column."""
    total = square = 0.0
    for i in range(rows.shape[0]):
        total += rows[i, axis]
    mean = total / rows.shape[0]
    for i in range(rows.shape[0]):
        square += (rows[i, axis] - mean) ** 2
    return mean, math.sqrt(square / rows.shape[0])


@kernel
def three_point_starts_kernel(points, i, j, k, w, rotations, positions):  # type: ignore[no-untyped-def]
    """The poses, at most four, from which three points are seen where they are (Grunert 1841).

    Haralick et al. 1994, section 3.1: with s1, s2 = u s1, s3 = v s1 the distances to the points,
    a, b, c the sides opposite them and alpha, beta, gamma the angles between the rays, v solves a
    quartic. Roots that noise has made complex enter by their real part.
    """
    _rays_kernel(w.image, i, j, k, w.rays)
    a2, b2, c2 = _square_kernel(points, j, k), _square_kernel(points, i, k), _square_kernel(points, i, j)
    if not (a2 > 0.0 and b2 > 0.0 and c2 > 0.0):
        return 0
    ca, cb, cg = _dot_kernel(w.rays, 1, 2), _dot_kernel(w.rays, 0, 2), _dot_kernel(w.rays, 0, 1)
    d, e, f, g = (a2 - c2) / b2, (a2 + c2) / b2, a2 / b2, c2 / b2
    a4 = (d - 1.0) ** 2 - 4.0 * g * ca * ca
    a3 = 4.0 * (d * (1.0 - d) * cb - (1.0 - e) * ca * cg + 2.0 * g * ca * ca * cb)
    middle = d * d - 1.0 + 2.0 * d * d * cb * cb + 2.0 * (1.0 - g) * ca * ca
    a2_ = 2.0 * (middle - 4.0 * e * ca * cb * cg + 2.0 * (1.0 - f) * cg * cg)
    a1 = 4.0 * (-d * (1.0 + d) * cb + 2.0 * f * cg * cg * cb - (1.0 - e) * ca * cg)
    a0 = (1.0 + d) ** 2 - 4.0 * f * cg * cg
    _quartic_kernel(a4, a3, a2_, a1, a0, w.roots)
    count = 0
    for root in range(4):
        v = w.roots[root]
        u = ((d - 1.0) * v * v - 2.0 * d * cb * v + 1.0 + d) / (2.0 * (cg - v * ca))
        s = math.sqrt(b2 / (1.0 + v * v - 2.0 * v * cb))
        if not (u > 0.0 and v > 0.0 and u * s < math.inf and v * s < math.inf):
            continue
        _triangle_pose_kernel(points, i, j, k, s, u * s, v * s, w, rotations[count], positions[count])
        count += 1
    return count


@kernel
def widest_triple_kernel(points):  # type: ignore[no-untyped-def]
    """Three points that span a wide triangle: the first, the one farthest off, and the one that makes
    the largest area with them. Equal to one another where all points lie on a line.
    """
    i = _farthest_kernel(points, 0)
    j = _farthest_kernel(points, i)
    k, largest = i, 0.0
    for m in range(points.shape[0]):
        b2, c2 = _square_kernel(points, i, m), _square_kernel(points, i, j)
        dot = 0.0
        for a in range(3):
            dot += (points[m, a] - points[i, a]) * (points[j, a] - points[i, a])
        area = b2 * c2 - dot * dot
        if area > largest and area > 1e-12 * c2 * c2:
            k, largest = m, area
    return i, j, k


@kernel
def _quartic_kernel(a4, a3, a2, a1, a0, roots):  # type: ignore[no-untyped-def]
    """Real parts of the four roots, into the first half of `roots`: Weierstrass' simultaneous iteration."""
    b3, b2, b1, b0 = a3 / a4, a2 / a4, a1 / a4, a0 / a4
    radius = 1.0 + max(max(abs(b3), abs(b2)), max(abs(b1), abs(b0)))
    start = complex(0.4, 0.9)
    z0 = complex(min(radius, 2.0), 0.0) * start
    z1, z2, z3 = z0 * start, z0 * start * start, z0 * start * start * start
    for _ in range(100):
        d0 = _quartic_value_kernel(z0, b3, b2, b1, b0) / ((z0 - z1) * (z0 - z2) * (z0 - z3))
        z0 -= d0
        d1 = _quartic_value_kernel(z1, b3, b2, b1, b0) / ((z1 - z0) * (z1 - z2) * (z1 - z3))
        z1 -= d1
        d2 = _quartic_value_kernel(z2, b3, b2, b1, b0) / ((z2 - z0) * (z2 - z1) * (z2 - z3))
        z2 -= d2
        d3 = _quartic_value_kernel(z3, b3, b2, b1, b0) / ((z3 - z0) * (z3 - z1) * (z3 - z2))
        z3 -= d3
        if abs(d0) + abs(d1) + abs(d2) + abs(d3) < 1e-13:
            break
    roots[0], roots[1], roots[2], roots[3] = z0.real, z1.real, z2.real, z3.real


@kernel
def _quartic_value_kernel(z, b3, b2, b1, b0):  # type: ignore[no-untyped-def]
    return (((z + b3) * z + b2) * z + b1) * z + b0


@kernel
def _triangle_pose_kernel(points, i, j, k, s1, s2, s3, w, rotation, position):  # type: ignore[no-untyped-def]
    """The pose in which three points lie at the given distances along their rays."""
    r = w.rays
    _world_basis_kernel(points, points[i], j, k, w.axes)
    _basis_kernel(
        s2 * r[1, 0] - s1 * r[0, 0], s2 * r[1, 1] - s1 * r[0, 1], s2 * r[1, 2] - s1 * r[0, 2],
        s3 * r[2, 0] - s1 * r[0, 0], s3 * r[2, 1] - s1 * r[0, 1], s3 * r[2, 2] - s1 * r[0, 2], w.tilt,
    )  # fmt: skip
    _product_transposed_kernel(w.axes, w.tilt, rotation)
    for a in range(3):
        ray = rotation[a, 0] * r[0, 0] + rotation[a, 1] * r[0, 1] + rotation[a, 2] * r[0, 2]
        position[a] = points[i, a] - s1 * ray


@kernel
def _world_basis_kernel(points, origin, i, j, out):  # type: ignore[no-untyped-def]
    """The basis whose first axis points from `origin` to point i, and its second towards point j."""
    x, y, z = origin[0], origin[1], origin[2]
    _basis_kernel(
        points[i, 0] - x, points[i, 1] - y, points[i, 2] - z,
        points[j, 0] - x, points[j, 1] - y, points[j, 2] - z, out,
    )  # fmt: skip


@kernel
def _rays_kernel(image, i, j, k, rays):  # type: ignore[no-untyped-def]
    """Unit rays of three keypoints."""
    for row in range(3):
        m = i if row == 0 else (j if row == 1 else k)
        x, y = image[m, 0], image[m, 1]
        n = 1.0 / math.sqrt(1.0 + x * x + y * y)
        rays[row, 0], rays[row, 1], rays[row, 2] = x * n, y * n, n


@kernel
def _dot_kernel(rows, i, j):  # type: ignore[no-untyped-def]
    return rows[i, 0] * rows[j, 0] + rows[i, 1] * rows[j, 1] + rows[i, 2] * rows[j, 2]


@kernel
def _square_kernel(rows, i, j):  # type: ignore[no-untyped-def]
    """Squared distance of two rows."""
    total = 0.0
    for a in range(rows.shape[1]):
        total += (rows[i, a] - rows[j, a]) ** 2
    return total


@kernel
def _farthest_kernel(rows, i):  # type: ignore[no-untyped-def]
    """The row farthest from row i."""
    best, largest = i, 0.0
    for m in range(rows.shape[0]):
        square = _square_kernel(rows, i, m)
        if square > largest:
            best, largest = m, square
    return best


@kernel
def _product_transposed_kernel(a, b, out):  # type: ignore[no-untyped-def]
    """a bt, both (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]


@kernel
def _align_kernel(axes, turn, tilt, out):  # type: ignore[no-untyped-def]
    """axes (turn tilt)t: runway_from_plane, then plane_from_camera."""
    for j in range(3):
        # Column j of (turn tilt)t is row j of turn tilt.
        x = turn[j, 0] * tilt[0, 0] + turn[j, 1] * tilt[1, 0] + turn[j, 2] * tilt[2, 0]
        y = turn[j, 0] * tilt[0, 1] + turn[j, 1] * tilt[1, 1] + turn[j, 2] * tilt[2, 1]
        z = turn[j, 0] * tilt[0, 2] + turn[j, 1] * tilt[1, 2] + turn[j, 2] * tilt[2, 2]
        for i in range(3):
            out[i, j] = axes[i, 0] * x + axes[i, 1] * y + axes[i, 2] * z


@kernel
def _ray_kernel(p, q, out):  # type: ignore[no-untyped-def]
    """The smallest turn that takes (0, 0, 1) to the direction of (p, q, 1), smooth at p = q = 0."""
    z = 1.0 / math.sqrt(1.0 + p * p + q * q)
    x, y = p * z, q * z
    h = 1.0 / (1.0 + z)
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - x * x * h, -x * y * h, x
    out[1, 0], out[1, 1], out[1, 2] = -x * y * h, 1.0 - y * y * h, y
    out[2, 0], out[2, 1], out[2, 2] = -x, -y, z


@kernel
def _plane_kernel(points, w):  # type: ignore[no-untyped-def]
    """The plane z = a x + b y + c nearest the points: centre, axes, coordinates. False for a line."""
    centre, axes, count = w.centre, w.axes, points.shape[0]
    cx = cy = cz = sxx = sxy = syy = sxz = syz = 0.0
    for i in range(count):
        cx, cy, cz = cx + points[i, 0], cy + points[i, 1], cz + points[i, 2]
    cx, cy, cz = cx / count, cy / count, cz / count
    for i in range(count):
        x, y, z = points[i, 0] - cx, points[i, 1] - cy, points[i, 2] - cz
        sxx, sxy, syy, sxz, syz = sxx + x * x, sxy + x * y, syy + y * y, sxz + x * z, syz + y * z
    det = sxx * syy - sxy * sxy
    if not det > 1e-10 * sxx * syy:
        return False
    centre[0], centre[1], centre[2] = cx, cy, cz
    _basis_kernel(1.0, 0.0, (syy * sxz - sxy * syz) / det, 0.0, 1.0, (sxx * syz - sxy * sxz) / det, axes)
    for i in range(count):
        x, y, z = points[i, 0] - cx, points[i, 1] - cy, points[i, 2] - cz
        w.flat[i, 0] = axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z
        w.flat[i, 1] = axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z
    return True


@kernel
def _basis_kernel(x0, x1, x2, y0, y1, y2, out):  # type: ignore[no-untyped-def]
    """A right-handed orthonormal basis as columns: the first along x, the second towards y."""
    n = 1.0 / math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
    x0, x1, x2 = x0 * n, x1 * n, x2 * n
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    n = 1.0 / math.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
    z0, z1, z2 = z0 * n, z1 * n, z2 * n
    out[0, 0], out[1, 0], out[2, 0] = x0, x1, x2
    out[0, 1], out[1, 1], out[2, 1] = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    out[0, 2], out[1, 2], out[2, 2] = z0, z1, z2


@kernel
def _homography_kernel(flat, image):  # type: ignore[no-untyped-def]
    """Plane to image, by least squares: its value (p, q) and Jacobian (4 entries) at the centre.

    Each image axis is w = (a0 + a1 f1 + a2 f2) / (1 + g1 f1 + g2 f2), with f1, f2 the plane's
    coordinates made orthonormal over the points, for a runway is a hundred times longer than wide.
    Multiplied out it is linear; the a of either axis are projected out, and two equations remain
    for (g1, g2). The image's axes are centred and scaled to unit size.
    """
    count = flat.shape[0]
    sxx = sxy = u0 = v0 = 0.0
    for i in range(count):
        x, y = flat[i, 0], flat[i, 1]
        sxx, sxy, u0, v0 = sxx + x * x, sxy + x * y, u0 + image[i, 0], v0 + image[i, 1]
    u0, v0, shear = u0 / count, v0 / count, sxy / sxx
    syy = suu = svv = 0.0
    for i in range(count):
        y = flat[i, 1] - shear * flat[i, 0]
        syy, suu, svv = syy + y * y, suu + (image[i, 0] - u0) ** 2, svv + (image[i, 1] - v0) ** 2
    nx, ny = 1.0 / math.sqrt(sxx), 1.0 / math.sqrt(syy)
    nu, nv = math.sqrt(suu), math.sqrt(svv)
    u10, u01, u20, u11, u02, s11, s12, s22, r1, r2 = _moments_kernel(flat, image, 0, u0, 1.0 / nu, shear, nx, ny)
    v10, v01, v20, v11, v02, t11, t12, t22, q1, q2 = _moments_kernel(flat, image, 1, v0, 1.0 / nv, shear, nx, ny)
    s11, s12, s22, r1, r2 = s11 + t11, s12 + t12, s22 + t22, r1 + q1, r2 + q2
    inverse = 1.0 / (s11 * s22 - s12 * s12)
    g1, g2 = (s22 * r1 - s12 * r2) * inverse, (s11 * r2 - s12 * r1) * inverse
    pu, pv = (g1 * u10 + g2 * u01) / count, (g1 * v10 + g2 * v01) / count
    # d/df1 and d/df2 at the centre, then d/dx and d/dy.
    a, b = nu * ny * (u01 + g1 * u11 + g2 * u02 - pu * g2), nv * ny * (v01 + g1 * v11 + g2 * v02 - pv * g2)
    j00 = nu * nx * (u10 + g1 * u20 + g2 * u11 - pu * g1) - shear * a
    j10 = nv * nx * (v10 + g1 * v20 + g2 * v11 - pv * g1) - shear * b
    return u0 + nu * pu, v0 + nv * pv, j00, a, j10, b


@kernel
def _moments_kernel(flat, image, axis, centre, scale, shear, nx, ny):  # type: ignore[no-untyped-def]
    """Of one image axis: its moments with f1^a f2^b, and its share of the equations for (g1, g2)."""
    m10 = m01 = m20 = m11 = m02 = n10 = n01 = n20 = n11 = n02 = 0.0
    for i in range(flat.shape[0]):
        f1, f2 = nx * flat[i, 0], ny * (flat[i, 1] - shear * flat[i, 0])
        w = scale * (image[i, axis] - centre)
        w1, w2 = w * f1, w * f2
        m10, m01, m20, m11, m02 = m10 + w1, m01 + w2, m20 + w1 * f1, m11 + w1 * f2, m02 + w2 * f2
        n10, n01, n20, n11, n02 = n10 + w * w1, n01 + w * w2, n20 + w1 * w1, n11 + w1 * w2, n02 + w2 * w2
    count = flat.shape[0]
    s11 = n20 - m10 * m10 / count - m20 * m20 - m11 * m11
    s12 = n11 - m10 * m01 / count - m20 * m11 - m11 * m02
    s22 = n02 - m01 * m01 / count - m11 * m11 - m02 * m02
    return m10, m01, m20, m11, m02, s11, s12, s22, m10 * m20 + m01 * m11 - n10, m10 * m11 + m01 * m02 - n01
