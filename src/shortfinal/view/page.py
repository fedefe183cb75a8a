"""A results folder as one page to replay, frame by frame; the page's data, for a file and for a live view."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

import numpy as np

from shortfinal.errors import InputError
from shortfinal.files import read_json, write_whole
from shortfinal.geometry import Camera, as_array
from shortfinal.protection import AXES, GLIDE_PATH_ORIGIN_M

FORMAT = 1  # of flight.json
GLIDE_PATH_DEG = 3.0
LOCALIZER_DDM, LOCALIZER_DDM_PER_M, LARGEST_LATERAL_DEG = 0.155, 0.00145, 3.0
HALF_SCALE = 0.12  # of the glide path's angle
DECISIONS = ("use", "do-not-use", "not-monitored")
STATES = ("searching", "tracking", "degraded", "lost")
INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")
WIDE = ("t", "frame")  # columns in double precision: a timestamp may count from 1970
TEXTS = ("decision", "reason", "state", "state_reason", "status", "image")
LINES_NAMED = 5  # of those that are damaged, at most


@dataclass
class Row:
    """What the page shows of one frame: a number or a text by the name of its column; what is absent is not known."""

    numbers: dict[str, float]
    texts: dict[str, str]


@dataclass
class Columns:
    """Rows as columns: N numbers each, NaN where a frame lacks one; N texts each, empty where it lacks one."""

    numbers: dict[str, array[float]] = field(default_factory=dict)
    texts: dict[str, list[str]] = field(default_factory=lambda: {name: [] for name in TEXTS})
    count: int = 0

    def append(self, row: Row) -> None:
        """Add a frame."""
        for name, value in row.numbers.items():
            column = self.numbers.get(name)
            if column is None:
                column = self.numbers[name] = array("d" if name in WIDE else "f")
            column.extend([math.nan] * (self.count - len(column)))
            column.append(value)
        for name, texts in self.texts.items():
            texts.append(row.texts.get(name, ""))
        self.count += 1

    def packed(self) -> dict[str, Any]:
        """For JSON: numbers as base64 of little-endian arrays; a text that repeats the one before as null."""
        numbers = {}
        for name, column in self.numbers.items():
            column.extend([math.nan] * (self.count - len(column)))
            values = np.frombuffer(column, "f8" if name in WIDE else "f4")
            numbers[name] = base64.b64encode(values.astype(values.dtype.newbyteorder("<")).tobytes()).decode()
        texts = {
            name: [text if i == 0 or text != column[i - 1] else None for i, text in enumerate(column)]
            for name, column in self.texts.items()
        }
        return {"count": self.count, "numbers": numbers, "wide": WIDE, "texts": texts}


def write_replay(results: str | Path) -> Path:
    """Write replay.html into a results folder, from its flight.json and frames.jsonl, and return its path.

    The page shows the folder's pictures by their relative path and asks for nothing else. Frames are
    read as far as they go: a last line that is cut off and lines that are damaged are left out, and
    the page says how many. Raises InputError for a folder without the two files, a flight.json that
    is none, no frame that can be read, or a page that cannot be written.
    """
    folder = Path(results)
    for name in ("flight.json", "frames.jsonl"):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: no {name} there; give the folder that `shortfinal run --out` wrote")
    flight = check_flight(read_json(folder / "flight.json", "flight"), str(folder / "flight.json"))
    columns, damaged, cut = _read_frames(folder / "frames.jsonl", runway_end_m(flight))
    notes = []
    if damaged:
        lines = ", ".join(map(str, damaged[:LINES_NAMED])) + (", ..." if len(damaged) > LINES_NAMED else "")
        notes.append(f"frames.jsonl: {len(damaged)} damaged lines left out (line {lines}).")
    if cut:
        notes.append("frames.jsonl ends in the middle of a line: the writer was stopped. All lines before it are here.")
    if not columns.count:
        said = f"none of its {len(damaged)} lines can be read" if damaged else "it holds no whole line"
        raise InputError(f"{folder / 'frames.jsonl'}: no frame to show: {said}")
    path = folder / "replay.html"
    write_whole(path, page_html(flight, columns, notes))
    return path


def page_html(flight: Mapping[str, Any], columns: Columns, notes: list[str], live: bool = False) -> str:
    """The page of a checked flight; a live one asks its own server for frames, the other asks for nothing."""
    content = {
        "flight": flight,
        "live": live,
        "notes": notes,
        "glide_path": {"deg": GLIDE_PATH_DEG, "origin_m": GLIDE_PATH_ORIGIN_M},
        "full_scale_deg": full_scale_deg(runway_end_m(flight)),
        **columns.packed(),
    }
    script = _template("replay.js")
    ident = str(flight["runway"].get("ident") or "runway")
    return Template(_template("replay.html")).substitute(
        title=html.escape(f"{ident}: {'live' if live else 'replay'}"),
        runway=html.escape(ident),
        kind="Live" if live else "Replay",
        style=_template("replay.css"),
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        connect="'self'" if live else "'none'",
        # A text may hold "</script>".
        data=json.dumps(_finite(content), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
    )


def check_flight(flight: Any, name: str) -> dict[str, Any]:
    """The content of flight.json, if the page can be drawn from it. Raises InputError naming the field."""
    if not isinstance(flight, dict):
        raise InputError(f"{name}: expected an object with format, camera and runway")
    if flight.get("format") != FORMAT:
        raise InputError(f"{name}: format is {flight.get('format')!r}; this version reads {FORMAT}")
    for part in ("camera", "runway"):
        if not isinstance(flight.get(part), dict):
            raise InputError(f"{name}: {part} is missing, or no object")
    camera = flight["camera"]
    try:
        Camera(**{part: camera[part] for part in INTRINSICS}, distortion=tuple(camera.get("distortion") or ()))
    except KeyError as error:
        raise InputError(f"{name}: camera: no {error.args[0]}") from error
    except (TypeError, InputError) as error:
        raise InputError(f"{name}: {error}") from error
    try:
        as_array(flight["runway"].get("corners_m"), (4, 3), "corners_m")
    except InputError as error:
        raise InputError(f"{name}: runway: {error}") from error
    return flight


def runway_end_m(flight: Mapping[str, Any]) -> float:
    """Where the runway ends, x of the runway frame: a localizer's antenna stands there (protection.py)."""
    return max(float(corner[0]) for corner in flight["runway"]["corners_m"])


def full_scale_deg(end_m: float) -> dict[str, float]:
    """Deviations at which the needles stand at two dots, 150 µA; the localizer's antenna `end_m` past the threshold.

    ICAO Annex 10, vol. I. 3.1.3.7.1: 0.00145 DDM a metre at the threshold; the course sector ends at 0.155 DDM
    to either side, and is 6 degrees wide at most. 3.1.5.6: 0.0875 DDM, half the scale, at 0.12 of the glide path's
    angle.
    """
    lateral = math.degrees(math.atan2(LOCALIZER_DDM / LOCALIZER_DDM_PER_M, end_m))
    return {"lateral": min(lateral, LARGEST_LATERAL_DEG), "vertical": 2 * HALF_SCALE * GLIDE_PATH_DEG}


def row_of(record: Mapping[str, Any], end_m: float) -> Row:
    """What the page shows of a line of frames.jsonl; `end_m` as of `runway_end_m`.

    Raises ValueError, TypeError, KeyError, AttributeError or IndexError for a record that is damaged.
    """
    numbers = {"t": float(record["timestamp_s"]), "frame": float(record.get("frame", math.nan))}
    if not math.isfinite(numbers["t"]):
        raise ValueError("timestamp_s is not finite")
    if record["decision"] not in DECISIONS:
        raise ValueError("no such decision")
    texts = {"decision": str(record["decision"]), "reason": "; ".join(map(str, record.get("reasons", ())))}
    for name in ("status", "image"):
        if record.get(name) is not None:
            texts[name] = str(record[name])
    if "image" in texts:
        texts["image"] = _beside(texts["image"])
    for name in ("statistic", "p_value", "present"):
        if record.get(name) is not None:
            numbers[name] = float(record[name])
    for stage, ms in (record.get("timings") or {}).items():
        numbers[f"ms_{str(stage).removesuffix('_ms')}"] = float(ms)
    if record.get("crop") is not None:
        numbers |= _named("crop_", ("left", "top", "width", "height"), record["crop"])
    numbers |= _keypoints(record.get("keypoints_px"), record.get("keypoints_cov_px"))
    numbers |= _pose("", record, "pose_cov", end_m)
    protection = record.get("protection")
    if protection is not None:  # a level of null is one that cannot be given: infinite
        levels = [protection.get(axis) for axis in AXES]
        numbers |= _named("level_", AXES, [math.inf if level is None else level for level in levels])
    numbers |= _pose("true_", record.get("truth") or {}, "", end_m)
    track = record.get("track")
    if track is not None:
        if track["state"] not in STATES:
            raise ValueError("no such state")
        texts |= {"state": track["state"], "state_reason": str(track.get("reason") or "")}
        numbers |= {"taken": float(bool(track.get("taken"))), "coasting_s": float(track.get("coasting_s") or 0.0)}
        if track.get("innovation_p") is not None:
            numbers["innovation_p"] = float(track["innovation_p"])
        numbers |= _pose("track_", track, "cov", end_m)
    return Row(numbers, texts)


def _pose(prefix: str, record: Mapping[str, Any], cov: str, end_m: float) -> dict[str, float]:
    """Position, attitude, deviations from the ILS's path in degrees, and the sigma of each that has one."""
    position = record.get("position_m")
    if position is None:
        return {}
    x, y, z = (float(v) for v in position)
    ahead, back = end_m - x, GLIDE_PATH_ORIGIN_M - x
    level = math.hypot(back, y)
    numbers = {
        "x": x,
        "y": y,
        "z": z,
        "lateral": math.degrees(math.atan2(y, ahead)),
        "vertical": math.degrees(math.atan2(z, level)) - GLIDE_PATH_DEG,
    }
    if record.get("attitude_deg") is not None:
        numbers |= _named("", ("yaw", "pitch", "roll"), record["attitude_deg"])
    if record.get(cov) is not None:
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = (row[:3] for row in record[cov][:3])
        # Both angles' derivatives by the position, as in protection.py.
        square = ahead * ahead + y * y
        lx, ly = y / square, ahead / square
        square = level * (level * level + z * z)
        gx, gy, gz = z * back / square, -z * y / square, level * level / square
        lateral = lx * lx * xx + ly * ly * yy + 2 * lx * ly * xy
        vertical = gx * gx * xx + gy * gy * yy + gz * gz * zz + 2 * (gx * gy * xy + gx * gz * xz + gy * gz * yz)
        numbers |= {f"s{name}": math.sqrt(max(v, 0.0)) for name, v in (("x", xx), ("y", yy), ("z", zz))}
        numbers["slateral"] = math.degrees(math.sqrt(max(lateral, 0.0)))
        numbers["svertical"] = math.degrees(math.sqrt(max(vertical, 0.0)))
    return {prefix + name: value for name, value in numbers.items()}


def _keypoints(mean: Any, cov: Any) -> dict[str, float]:
    """Of each keypoint u, v, and of its covariance the three entries that its ellipse needs."""
    numbers: dict[str, float] = {}
    for k, point in enumerate(mean or ()):
        numbers |= _named(f"k{k}_", ("u", "v"), point)
        if cov is not None:
            u, v = cov[2 * k], cov[2 * k + 1]
            numbers |= _named(f"k{k}_", ("uu", "uv", "vv"), (u[2 * k], u[2 * k + 1], v[2 * k + 1]))
    return numbers


def _named(prefix: str, names: tuple[str, ...], values: Any) -> dict[str, float]:
    return {prefix + name: float(value) for name, value in zip(names, values, strict=True)}


def _beside(image: str) -> str:
    """A picture's relative path as a URL; one that leads out of the folder is refused."""
    if image.startswith("/") or ".." in image.split("/"):
        raise ValueError("image leads out of the folder")
    return quote(image)


def _read_frames(path: Path, end_m: float) -> tuple[Columns, list[int], bool]:
    """The frames, the numbers of lines that are damaged, and whether the last one is cut off."""
    columns, damaged, cut = Columns(), [], False
    for number, line in _lines(path):
        if not line.strip():
            continue
        try:
            columns.append(row_of(json.loads(line), end_m))
        except (ValueError, TypeError, KeyError, AttributeError, IndexError, OverflowError, RecursionError):
            if line.endswith(b"\n"):
                damaged.append(number)
            else:
                cut = True
    return columns, damaged, cut


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    try:
        with path.open("rb") as file:
            yield from enumerate(file, 1)
    except OSError as error:
        raise InputError(f"{path}: cannot read the frames: {error.strerror}") from error


def _finite(value: Any) -> Any:
    """The same without infinity and NaN, which JSON does not know: None in their place."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return value


def _template(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
