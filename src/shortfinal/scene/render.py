"""Scenes: a runway and the land around it, drawn exactly through a camera.

Each pixel is cast as a ray onto the ground plane z = 0 of the runway frame, through the same camera
model as everywhere else, and shaded there. Hard edges (paint, pavement, field borders) are averaged
over stratified samples inside the pixel; ground texture is band-limited to the pixel's footprint.
So the runway's corners lie where `project` puts them (tested to 0.05 px), at any resolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from shortfinal.crops import box_around
from shortfinal.errors import InputError
from shortfinal.geometry import Camera, PixelWindow, Pose, as_array, can_project, normalise_kernel, project
from shortfinal.runway import Runway
from shortfinal.scene.airfield import (
    Airfield,
    add_lights,
    away,
    grain,
    ground,
    near_pavement,
    paved,
    random_airfield,
    record,
)
from shortfinal.scene.land import Land, land, random_climate, random_land
from shortfinal.scene.noise import noise_table, packed, shader
from shortfinal.scene.sensor import Sensor, expose
from shortfinal.scene.sky import Sky, air_towards, haze, random_sky, shade_relief, shade_sky, sunlit
from shortfinal.scene.town import lamps, memory

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


class Scene(NamedTuple):
    """Everything a picture of one airfield depends on but the camera."""

    airfield: Airfield
    land: Land
    sky: Sky

    @property
    def runway(self) -> Runway:
        """The airfield's, flat and without a name."""
        return Runway(self.airfield.length, self.airfield.width)

    @property
    def aiming_marking(self) -> Array | None:
        """Outer corners (4, 3) of the pair of aiming-point markings, in keypoint order, metres; None if not painted."""
        begin, length, stripe, inner = self.airfield.aiming
        far, side = begin + length, min(inner + stripe, 0.5 * self.airfield.width - 2.0)  # as it is painted
        corners: Array = np.array([[begin, side, 0], [begin, -side, 0], [far, -side, 0], [far, side, 0]])
        return corners if length > 0 else None


@dataclass(frozen=True, eq=False)
class Motion:
    """The camera's motion while a rolling shutter reads the picture, from its top row to its bottom row.

    The pose given to `render` is that of the middle row. Raises InputError for a wrong shape, a
    non-finite entry or a negative time.
    """

    velocity_m_s: Array  # (3,) runway frame
    rates_deg_s: Array  # (3,) turning about the camera's own axes: x right, y down, z forward
    readout_s: float  # between the top row and the bottom row

    def __post_init__(self) -> None:
        for name in ("velocity_m_s", "rates_deg_s"):
            object.__setattr__(self, name, as_array(getattr(self, name), (3,), f"motion: {name}"))
        if not float(as_array(self.readout_s, (), "motion: readout_s")) >= 0:
            raise InputError(f"motion: readout_s is {self.readout_s}; it must not be negative")

    def poses(self, camera: Camera, pose: Pose) -> tuple[Array, Array]:
        """Position (height, 3) and runway_from_camera (height, 3, 3) of each row."""
        return self.at_rows(camera, pose, np.arange(camera.height))

    def at_rows(self, camera: Camera, pose: Pose, rows: ArrayLike) -> tuple[Array, Array]:
        """Position (N, 3) and runway_from_camera (N, 3, 3) when the rows (N,), whole or not, are read."""
        span = max(camera.height - 1, 1)
        t = (np.asarray(rows, float) - 0.5 * (camera.height - 1)) / span * self.readout_s
        turns = Rotation.from_rotvec(t[:, None] * np.radians(self.rates_deg_s)).as_matrix()
        return pose.position_m + t[:, None] * self.velocity_m_s, pose.runway_from_camera @ turns

    def through(self, window: PixelWindow, camera: Camera, pose: Pose) -> tuple[Motion, Pose]:
        """The motion, and the pose of the middle row, with which `camera.view(window)` takes its part."""
        top, bottom = window.inverse([[0.0, 0.0], [0.0, window.out_height - 1.0]])[:, 1]
        positions, rotations = self.at_rows(camera, pose, [0.5 * (top + bottom)])
        readout = self.readout_s * (bottom - top) / max(camera.height - 1, 1)
        return Motion(self.velocity_m_s, self.rates_deg_s, float(readout)), Pose(positions[0], rotations[0])


def project_rolling(camera: Camera, pose: Pose, motion: Motion, points: ArrayLike) -> Array:
    """Pixels (K, 2) of `points` (K, 3), metres in the runway frame, each seen when its own row is read.

    A fixed-point iteration on the row: it contracts as long as a point crosses the picture more slowly
    than the shutter does. Raises InputError as `project`, and where the steps do not shrink.
    """
    world = as_array(points, (None, 3), "points")
    px, last = project(camera, pose, world), math.inf
    for _ in range(100):
        positions, rotations = motion.at_rows(camera, pose, px[:, 1])
        moved = np.array([
            project(camera, Pose(p, r), [w])[0] for p, r, w in zip(positions, rotations, world, strict=True)
        ]).reshape(-1, 2)  # fmt: skip
        step, px = float(np.abs(moved - px).max(initial=0.0)), moved
        if step < 1e-7:
            return px
        if step > last:
            break
        last = step
    raise InputError("motion: the picture moves as fast as the shutter reads it; lower the rates or the readout time")


def random_scene(rng: np.random.Generator, runway: Runway | None = None) -> Scene:
    """A random airfield around `runway` (its length and width; random ones if none is given), and its world."""
    climate = random_climate(rng)
    airfield = random_airfield(rng, runway, climate.wild[0])
    snow_line = float(rng.uniform(-200, 900) if climate.name in ("winter", "tundra") else rng.uniform(700, 4000))
    return Scene(
        airfield=airfield,
        land=random_land(rng, climate, airfield),
        sky=random_sky(rng, airfield.length, climate.rock, snow_line),
    )


def ground_homography(camera: Camera, pose: Pose) -> NDArray[np.float64]:
    """The homography (3, 3) from the runway's plane (x, y, 1), metres, to pixels. Without distortion."""
    intrinsic = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    ground = np.column_stack([np.eye(3)[:, :2], -pose.position_m])
    return np.asarray(intrinsic @ pose.runway_from_camera.T @ ground)


def seen_from(picture: NDArray[np.uint8], camera: Camera, pose: Pose, other: Camera, there: Pose) -> NDArray[np.uint8]:
    """What `other` sees from `there`, made of a picture that `camera` took at `pose`: exact for the flat ground, and
    near enough for the rest where the two are close. It costs a hundredth of drawing it.
    """
    back = ground_homography(camera, pose) @ np.linalg.inv(ground_homography(other, there))
    size, flags = (other.width, other.height), cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(picture, back, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def render(
    scene: Scene,
    camera: Camera,
    pose: Pose,
    sensor: Sensor | None = None,
    *,
    samples: int = 4,
    seed: int = 0,
    motion: Motion | None = None,
) -> Image:
    """The picture (height, width, 3), RGB, that `camera` at `pose` takes of `scene`.

    To draw a part only, pass `camera.view(window)`. `samples` squared rays go into each pixel that
    touches the airfield. `seed` fixes the sensor's noise. With `motion`, each row is taken from where
    the camera then is. Raises InputError where that is not above the ground.
    """
    still = motion or Motion(np.zeros(3), np.zeros(3), 0.0)
    positions, rotations = still.poses(camera, pose)
    if not positions[:, 2].min() > 0:
        raise InputError(
            f"pose: the camera is at a height of {positions[:, 2].min():.1f} m; it must be above the runway"
        )
    light = np.empty((camera.height, camera.width, 3), np.float32)
    parts = [record(scene.airfield), packed(scene.land), packed(scene.sky)]
    _render_kernel(*parts, camera.intrinsics, rotations, positions, noise_table(), samples, light)
    if scene.sky.darkness >= 0.0:
        add_lights(light, scene.airfield, camera, pose, scene.sky.darkness, scene.sky.visibility_m)
    corners = scene.runway.corners
    seen = can_project(camera, pose, corners).all()
    keep_out = box_around(project(camera, pose, corners)) if seen else None  # without it nothing is laid over
    return expose(light, sensor or Sensor(), np.random.default_rng(seed), keep_out)


@shader
def _ray(u: Any, v: Any, intrinsics: Any, rotation: Any) -> Any:
    """Unit direction in the runway frame of the ray through a pixel."""
    x, y, _ = normalise_kernel(u, v, intrinsics)
    scale = 1.0 / math.sqrt(x * x + y * y + 1.0)
    wx = (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]) * scale
    wy = (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]) * scale
    wz = (rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]) * scale
    return wx, wy, wz


@shader
def _land_pixel(
    a: Any, g: Any, k: Any, table: Any, u: Any, v: Any, intrinsics: Any, rotation: Any, origin: Any, pixel: Any,
    inside: Any, least: Any, tags: Any, facts: Any, o: Any, rgb: Any, one: Any,
) -> None:  # fmt: skip
    """The land's mean colour over a pixel: of two places in it, and of two more where those differ in kind.

    On the airfield's grounds, which show little of it, of the middle alone.
    """
    rgb[:] = 0.0
    kind, taken = -1, 0
    for n in range(1 if inside else 4):
        if n == 2 and kind >= 0:
            break
        du, dv = (0.25 if n % 2 == 0 else -0.25), (0.25 if n in (0, 3) else -0.25)
        if inside:
            du = dv = 0.0
        wx, wy, wz = _ray(u + du, v + dv, intrinsics, rotation)
        grazing = max(-wz, least)
        distance = origin[2] / grazing
        footprint = distance * pixel / math.sqrt(grazing)
        x, y = origin[0] + wx * distance, origin[1] + wy * distance
        found = land(g, a, k, table, x, y, -wx / grazing, -wy / grazing, 0.5 * origin[2], grazing,
                     distance * pixel, footprint, tags, facts, o, one)  # fmt: skip
        kind = found if n == 0 or found == kind else -1
        for c in range(3):
            rgb[c] += one[c]
        taken += 1
    for c in range(3):
        rgb[c] /= taken


@shader
def _ground_pixel(
    a: Any, g: Any, k: Any, table: Any, u: Any, v: Any, intrinsics: Any, rotation: Any, origin: Any, pixel: Any,
    samples: Any, wx: Any, wy: Any, grazing: Any, tags: Any, facts: Any, o: Any,
    work: Any, total: Any,
) -> None:  # fmt: skip
    """The ground's colour over a pixel, lit but not hazed, into `total`."""
    base, rgb = work[0], work[1]
    distance = origin[2] / grazing
    x, y = origin[0] + wx * distance, origin[1] + wy * distance
    short, long = distance * pixel, distance * pixel / grazing
    footprint = math.sqrt(short * long)
    _land_pixel(a, g, k, table, u, v, intrinsics, rotation, origin, pixel, away(a, x, y) == 0.0, 0.5 * grazing,
                tags, facts, o, base, rgb)  # fmt: skip
    ground(a, table, x, y, footprint, base)
    near = near_pavement(a, x, y, long + 2.0 * short, 2.0 * long * abs(wy) + 2.0 * short)
    count = samples if near == 2 else min(2, samples) if near == 1 else 0
    if count > 0:
        texture = grain(a, table, x, y, footprint)
        total[:] = 0.0
        for m in range(count):
            for n in range(count):
                rgb[:] = base
                sx, sy, sz = _ray(u - 0.5 + (m + 0.5) / count, v - 0.5 + (n + 0.5) / count, intrinsics, rotation)
                if sz < 0.0:
                    t = -origin[2] / sz
                    paved(a, table, origin[0] + sx * t, origin[1] + sy * t, texture, rgb)
                for c in range(3):
                    total[c] += rgb[c] / (count * count)
    else:
        total[:] = base
    sun = sunlit(k, table, x, y, footprint)
    for c in range(3):
        total[c] *= k.ambient[c] + k.direct[c] * sun
    if k.darkness > 0.0:
        lamp = k.darkness * lamps(g, a, table, x, y, footprint, tags, facts)
        for c in range(3):
            total[c] += lamp * g.lamps[c]


@shader
def _render_kernel(
    airfield: Any, country: Any, heaven: Any, intrinsics: Any, rotations: Any, positions: Any, table: Any,
    samples: Any, light: Any,
) -> None:  # fmt: skip
    a, g, k = airfield[0], country[0], heaven[0]
    height, width = light.shape[0], light.shape[1]
    total, above, work = np.empty(3), np.empty(3), np.empty((2, 3))
    air, spare, o = np.empty(3), np.empty(6), np.empty(8)
    tags, facts = memory()
    pixel = 1.0 / math.sqrt(intrinsics[0] * intrinsics[1])  # radians
    for v in range(height):
        rotation, origin = rotations[v], positions[v]
        for u in range(width):
            wx, wy, wz = _ray(u, v, intrinsics, rotation)
            sky = min(1.0, max(0.0, 0.5 + wz / pixel))  # share of the pixel above the horizon
            reach = math.inf
            if sky < 1.0:
                grazing = max(-wz, 0.3 * pixel)
                _ground_pixel(a, g, k, table, u, v, intrinsics, rotation, origin, pixel, samples, wx, wy, grazing,
                              tags, facts, o, work, total)  # fmt: skip
                reach = origin[2] / grazing
                air_towards(k, wx, wy, 0.0, 1.0, air)
                haze(k, reach, air, total)
            if sky > 0.0:
                shade_sky(k, table, origin, wx, wy, max(wz, 0.0), pixel, air, above)
                for c in range(3):
                    total[c] = above[c] if sky >= 1.0 else total[c] + sky * (above[c] - total[c])
            if wz < 0.6:
                shade_relief(k, table, origin, wx, wy, wz, reach, pixel, spare, total)
            for c in range(3):
                light[v, u, c] = 255.0 * min(1.0, max(0.0, total[c]))
