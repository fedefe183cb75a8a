"""Is a data set fit to train and to test on? Every picture and label looked at, and leakage between splits.

Pictures are read once, side by side, and forgotten; what stays of each is a few hundred bytes.
"""

from __future__ import annotations

import io
import json
import math
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from shortfinal.audit import AuditedLabel, AuditReport, audit_label, look_up
from shortfinal.crops import box_around, centre_crop
from shortfinal.data.formats import open_dataset
from shortfinal.data.image import read_image
from shortfinal.data.labelled import Label, LabelledPictures, Origin, Picture, Problem
from shortfinal.data.lard import AIMING_POINT_M, WHOLE_PIXEL_SIGMA, RunwayLabel
from shortfinal.errors import InputError
from shortfinal.files import csv_text, make_folder, write_png, write_whole
from shortfinal.geometry import Camera, PixelWindow, Pose
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.pose import estimate_pose
from shortfinal.runway import Runway, RunwayDatabase, load_database

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# A clean data set of any size is wrongly found inconsistent one time in a hundred at most.
FALSE_ALARM_RATE = 0.01
RENDERED_SIGMA = 0.05  # px: how exact the labels of rendered pictures claim to be
# Distance of two unit thumbnails (2 - 2 correlation, its root) below which they show the same scene. Measured:
# no pair in 72 million of 12,000 rendered scenes; all JPEG copies (quality 30) and half-size copies of
# LARD's pictures lie below 0.008, and of rendered ones from 150 pixels on 95 % (quality 30) and 90 %.
SAME_SCENE = 0.05
TOO_SMALL_PX = 8.0  # longer side of the runway's box; the renderer begins at 11
FLAT = 1.0  # standard deviation of the grey levels below which there is nothing to be seen

_THUMBNAIL = 8  # pixels a side
_ORIENTATION = 274  # EXIF tag
_SHEET, _COLUMNS, _TILE = 24, 6, 240  # of each kind so many examples, so many in a row, px
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#666666")  # told apart by colour-blind readers too

# What is measured of a picture or of a label: its name in the report, and on the figure's axis.
MEASURES = {
    "distance_m": "distance, m",
    "glide_deg": "glide angle, °",
    "lateral_deg": "lateral angle, °, left positive",
    "yaw_deg": "yaw, °",
    "pitch_deg": "pitch, °",
    "roll_deg": "roll, °",
    "runway_px": "runway's box in the picture, longer side, px",
    "brightness": "brightness, grey levels",
}


@dataclass(frozen=True, eq=False)
class CheckReport:
    """What was found."""

    source: str
    format: str
    pictures: int
    labels: int
    unlabelled: int  # pictures without a label
    splits: dict[str, int]  # pictures of each
    airports: dict[str, dict[str, int]]  # pictures of each split, by airport
    problems: tuple[Problem, ...]  # the serious ones first
    notes: tuple[str, ...]
    audit: AuditReport
    measures: dict[str, dict[str, Array]]  # by name, by split

    @property
    def serious(self) -> tuple[Problem, ...]:
        """The problems that a clean data set has none of."""
        return tuple(p for p in self.problems if p.serious)

    @property
    def counts(self) -> dict[str, int]:
        """Serious problems by kind."""
        return dict(Counter(p.kind for p in self.serious))


@dataclass(eq=False)
class _Look:
    """What stays of one picture."""

    picture: Picture
    problems: list[Problem] = field(default_factory=list)
    digest: bytes = b""  # of the pixels
    thumbnail: Array | None = None
    audited: list[AuditedLabel] = field(default_factory=list)
    measures: list[tuple[str, float]] = field(default_factory=list)

    def add(self, kind: str, what: str, mend: str, label: Label | None = None, *, serious: bool = True) -> None:
        file, row = (label.file, label.row) if label else (str(self.picture.path), "")
        self.problems.append(Problem(kind, file, row, "", what, mend, self.picture.name, serious))

    @property
    def badness(self) -> float:
        """Sorts pictures: serious problems, then the audit's statistic."""
        statistic = max((a.statistic for a in self.audited if math.isfinite(a.statistic)), default=0.0)
        return 1e12 * any(p.serious for p in self.problems) + statistic


def check_dataset(
    source: str | Path,
    out: str | Path,
    *,
    runways: str | Path | None = None,
    camera: Camera | None = None,
    sigma_px: float | None = None,
    corners: Sequence[str] = (),
    origin: Origin = "corner",
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CheckReport:
    """Check a data set and write check.json, problems.csv, check.png and contact_sheet.png into `out`.

    `runways`: LARD-style database to hold the labels against, where they give no runway of their own.
    `camera`: of all pictures, where the labels give none. `sigma_px`: of a labelled coordinate (default:
    0.05 px for rendered pictures, what rounding to a pixel gives for others). `corners`, `origin`: as in
    `open_dataset`. `progress` is told how many pictures are done, of how many. The data set is only read.
    Raises InputError if it is none, or for a wrong argument.
    """
    if sigma_px is not None and not (math.isfinite(sigma_px) and sigma_px > 0):
        raise InputError(f"sigma_px: got {sigma_px}; it must be finite and > 0")
    data = open_dataset(source, corners=corners, origin=origin, camera=camera)
    labels = sum(len(p.labels) for p in data.pictures)
    ground = _Ground(load_database(runways) if runways else None, camera, sigma_px, FALSE_ALARM_RATE / max(labels, 1))
    folder = make_folder(out)
    looks = []
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        for look in pool.map(lambda picture: _look(picture, ground), data.pictures):
            looks.append(look)
            if progress:
                progress(len(looks), len(data.pictures))
    report = _report(data, looks, ground, labels)
    _write(report, looks, folder)
    return report


# One picture.


@dataclass(frozen=True)
class _Ground:
    """What labels are held against."""

    database: RunwayDatabase | None
    camera: Camera | None
    sigma_px: float | None
    rate: float  # of false alarms, a label

    def runway(self, label: Label) -> Runway | str:
        """The label's runway, or why there is none."""
        if label.runway is not None:
            return label.runway
        return look_up(self.database, label.ident)

    def sigma(self, label: Label) -> float:
        return self.sigma_px or (RENDERED_SIGMA if label.pose is not None else WHOLE_PIXEL_SIGMA)


def _look(picture: Picture, ground: _Ground) -> _Look:
    look = _Look(picture)
    try:
        image = read_image(picture.path)
    except InputError as error:
        what = str(error).removeprefix(f"{picture.path}: ")
        look.add("image", what, "restore the image or remove its labels")
        return look
    height, width = image.shape[:2]
    _look_at_pixels(look, image)
    if picture.wrong_size(width, height):
        wanted = "{} x {}".format(*(picture.size or ()))
        look.add("size", f"{width} x {height} pixels, but its labels say {wanted}", "take the image that was labelled")
        return look
    for label in picture.labels:
        _look_at_label(look, label, width, height)
        _hold_against_runway(look, label, (width, height), ground)
    return look


def _look_at_pixels(look: _Look, image: Image) -> None:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    mean, spread = (float(v[0, 0]) for v in cv2.meanStdDev(grey))
    look.digest = blake2b(np.array(image.shape).tobytes() + image.tobytes(), digest_size=16).digest()
    look.measures.append(("brightness", mean))
    if spread < FLAT:
        look.add("flat", f"nothing to be seen: all of it is about grey level {mean:.0f}", "remove it")
    else:
        look.thumbnail = _thumbnail(grey)
    if all(np.array_equal(image[..., 1], image[..., k]) for k in (0, 2)):
        look.add("grey", "no colour", "", serious=False)
    if turned := _turned(look.picture.path):
        look.add(
            "orientation",
            f"EXIF says to turn it (orientation {turned}); labelling tools do, and here it is not done",
            "save it upright and without the tag",
        )


def _thumbnail(grey: NDArray[Any]) -> Array | None:
    """Block means less their mean, as a unit vector (64,); the same for a copy resized or encoded anew."""
    size = (_THUMBNAIL, _THUMBNAIL)
    small = cv2.resize(grey.astype(np.float32), size, interpolation=cv2.INTER_AREA).astype(float).ravel()
    small -= small.mean()
    length = float(np.linalg.norm(small))
    return small / length if length > 0 else None


def _turned(path: Path) -> int:
    """EXIF's orientation of a JPEG file if it is not upright, else 0."""
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return 0
    try:
        with Pillow.open(path) as image:
            tag = image.getexif().get(_ORIENTATION, 1)
    except (OSError, ValueError, SyntaxError):
        return 0
    return tag if isinstance(tag, int) and 1 < tag <= 8 else 0


def _look_at_label(look: _Look, label: Label, width: int, height: int) -> None:
    """Its corners in the pixels of the image file."""
    if label.corners_px is None:
        missing = ", ".join(label.names[k] for k in range(4) if label.visible[k] == 0)
        look.add("partial", f"{missing} not labelled", "", label, serious=False)
        return
    corners = look.picture.window(width, height).apply(label.corners_px)
    box = box_around(corners)
    last = np.array([width, height]) - 0.5
    shown = np.clip(box.reshape(2, 2), -0.5, last)
    side = float((shown[1] - shown[0]).max())
    look.measures.append(("runway_px", side))
    if why := _disorder(label.corners_px):
        look.add("order", why, "expected near-left, near-right, far-right, far-left as the pilot sees them", label)
    if (box[2:] < -0.5).any() or (box[:2] > last).any():
        look.add("outside", "the runway lies outside the picture", "correct or remove the label", label)
    elif (box[:2] < -0.5).any() or (box[2:] > last).any():
        look.add("cut", "the picture's border cuts the runway", "", label, serious=False)
    if side < TOO_SMALL_PX:
        look.add("small", f"the runway is {side:.1f} pixels long", "", label, serious=False)


def _disorder(corners: Array) -> str:
    """What is wrong with the order of corners (4, 2), for any view of less than 45 degrees of bank."""
    edges = np.roll(corners, -1, axis=0) - corners
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    lengths = np.linalg.norm(edges, axis=1)
    if lengths.min() == 0 or (np.abs(turns) < 1e-9 * lengths * np.roll(lengths, -1)).any():
        return "corners coincide or lie on one line"
    if (turns > 0).all():
        return "left and right are swapped"
    if not (turns < 0).all():  # with v down, the order is anticlockwise on the screen
        return "the outline crosses itself or is not convex"
    near_left, near_right, far_right, far_left = corners
    if near_left[1] + near_right[1] <= far_left[1] + far_right[1]:
        return "the near end is above the far end"
    return "left is right of right" if near_left[0] >= near_right[0] or far_left[0] >= far_right[0] else ""


def _hold_against_runway(look: _Look, label: Label, size: tuple[int, int], ground: _Ground) -> None:
    """The audit of a label, and the pose for the distributions."""
    if label.corners_px is None:
        return
    camera, runway, sigma = label.camera or ground.camera, ground.runway(label), ground.sigma(label)
    if camera and (camera.width, camera.height) != (look.picture.size or size):
        runway = f"the camera has {camera.width} x {camera.height} pixels, the picture has not"
    audited = audit_label(_recorded(label, look.picture, camera, sigma), runway, camera, sigma, ground.rate)
    look.audited.append(audited)
    # A label out of order contradicts its runway as well; once is enough.
    if audited.findings and not any(p.kind == "order" and p.row == label.row for p in look.problems):
        named = ", ".join(f.value for f in audited.findings)
        error = "" if math.isnan(audited.reprojection_px) else f" (corners {audited.reprojection_px:.2g} px off"
        error += "" if math.isnan(audited.distance_error_m) else f", distance {audited.distance_error_m:+.3g} m"
        what = f"contradicts its runway: {named}{error}{')' * bool(error)}"
        look.add("audit", what, "correct the label, its runway or camera", label)
    pose = label.pose
    if pose is None and audited.checked and isinstance(runway, Runway) and camera:
        pose = estimate_pose(GaussianKeypoints.from_sigma(label.corners_px, sigma), runway.corners, camera).pose
    if pose is not None:
        look.measures += _flight(pose)


def _recorded(label: Label, picture: Picture, camera: Camera | None, sigma: float) -> RunwayLabel:
    """The label as the audit takes it."""
    if label.recorded is not None:
        return label.recorded
    line = int("".join(c for c in label.row if c.isdigit()) or 0)
    distance = None if label.pose is None else float(np.linalg.norm(label.pose.position_m))
    return RunwayLabel(line, picture.name, label.ident, label.keypoints_px[:4], camera, distance, 0.0, True, sigma)


def _flight(pose: Pose) -> list[tuple[str, float]]:
    x, y, z = (float(v) for v in pose.position_m)
    yaw, pitch, roll = pose.attitude
    glide, lateral = math.degrees(math.atan2(z, AIMING_POINT_M - x)), math.degrees(math.atan2(y, -x))
    distance = float(np.linalg.norm(pose.position_m))
    values = (distance, glide, lateral, yaw, pitch, roll)
    return list(zip(MEASURES, values, strict=False))


# All pictures together.


def _report(data: LabelledPictures, looks: Sequence[_Look], ground: _Ground, labels: int) -> CheckReport:
    airports: dict[str, Counter[str]] = defaultdict(Counter)
    for look in looks:
        for airport in {label.airport for label in look.picture.labels if label.airport}:
            airports[airport][look.picture.split] += 1
    splits = Counter(look.picture.split for look in looks)
    everywhere = [*data.refused, *_shared_places(data.source, looks), *_copies(looks)]
    problems = [*(p for look in looks for p in look.problems), *everywhere]
    audited = sorted((a for look in looks for a in look.audited), key=lambda a: (not a.findings, -a.statistic))
    audit = AuditReport(data.source, tuple(audited), ground.sigma_px, ground.rate)
    return CheckReport(
        data.source,
        data.format,
        len(looks),
        labels,
        sum(not look.picture.labels for look in looks),
        dict(splits),
        {airport: dict(counts) for airport, counts in sorted(airports.items())},
        tuple(sorted(problems, key=lambda p: not p.serious)),
        (*data.notes, *_notes(data, splits, airports, audit)),
        audit,
        _gathered(looks),
    )


def _notes(data: LabelledPictures, splits: Counter[str], airports: dict[str, Any], audit: AuditReport) -> Iterator[str]:
    reasons = Counter(a.note for a in audit.not_checked)
    for reason, count in reasons.most_common(3):
        yield f"{count} labels were not held against a runway: {reason}"
    if len(splits) > 1 and not airports and data.format != "shortfinal":
        yield "no label names its airport, so leakage was looked for in the pictures only"


def _gathered(looks: Iterable[_Look]) -> dict[str, dict[str, Array]]:
    values: dict[str, dict[str, list[float]]] = {name: defaultdict(list) for name in MEASURES}
    for look in looks:
        for name, value in look.measures:
            values[name][look.picture.split].append(value)
    return {name: {s: np.array(v) for s, v in sorted(each.items())} for name, each in values.items()}


def _shared_places(source: str, looks: Sequence[_Look]) -> Iterator[Problem]:
    """Airports in more than one split, and scenarios where no airport tells."""
    for kind in ("airport", "scenario"):
        places: dict[str, Counter[str]] = defaultdict(Counter)
        for look in looks:
            for label in look.picture.labels:
                if kind == "airport" or not label.airport:
                    places[getattr(label, kind)][look.picture.split] += 1
        for place, counts in sorted(places.items()):
            if place and len(counts) > 1:
                where = " and ".join(f"{split or 'no split'} ({count})" for split, count in sorted(counts.items()))
                mend = "split by airport: shortfinal data convert --split"
                yield Problem("leakage", source, "", kind, f"{place} is in {where}", mend)


def _copies(looks: Sequence[_Look]) -> Iterator[Problem]:
    """Pictures whose pixels are another's, or that show another's scene."""
    first: dict[bytes, int] = {}
    unique = []
    for number, look in enumerate(looks):
        if not look.digest:
            continue
        earlier = first.setdefault(look.digest, number)
        if earlier == number:
            unique.append(number)
        else:
            yield _copy(look, looks[earlier], "the same pixels as", serious=True)
    for number, other in _same_scenes(looks, unique):
        yield _copy(looks[number], looks[other], "shows the same scene as", serious=False)


def _copy(look: _Look, other: _Look, how: str, *, serious: bool) -> Problem:
    leak = look.picture.split != other.picture.split
    kind = "leakage" if leak else "duplicate" if serious else "near-duplicate"
    what = f"{how} {other.picture.path}" + (f", in {other.picture.split or 'no split'}" if leak else "")
    return Problem(
        kind,
        str(look.picture.path),
        "",
        "",
        what,
        "keep one" if leak or serious else "",
        look.picture.name,
        leak or serious,
    )


def _same_scenes(looks: Sequence[_Look], numbers: Sequence[int]) -> list[tuple[int, int]]:
    """(picture, another that shows the same scene), each picture once.

    The other is one of another split if there is any; of each scene's pictures in one split, the first is not
    reported.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    index = [n for n in numbers if looks[n].thumbnail is not None]
    if len(index) < 2:
        return []
    points = np.array([looks[n].thumbnail for n in index])
    split = np.array([looks[n].picture.split for n in index])
    found: dict[int, int] = {}
    ends = []
    for name in np.unique(split):
        mine, later = np.flatnonzero(split == name), np.flatnonzero(split > name)
        found |= dict(_neighbours(points, later, mine)[::-1].tolist())  # so that the nearest stays
        ends.append(_neighbours(points, mine, mine))
    links = np.vstack(ends)
    graph = coo_array((np.ones(len(links)), links.T), shape=(len(index), len(index)))
    firsts = np.unique(connected_components(graph, directed=False)[1], return_index=True)[1]
    nearest = dict(links[::-1].tolist())
    for first in firsts:
        nearest.pop(int(first), None)
    return [(index[a], index[b]) for a, b in sorted((nearest | found).items())]


def _neighbours(points: Array, asked: NDArray[np.intp], among: NDArray[np.intp], most: int = 4) -> NDArray[np.intp]:
    """Pairs (n, 2) of one asked and one among, no further apart than SAME_SCENE, the nearest `most`, nearest first."""
    from scipy.spatial import cKDTree

    if not (len(asked) and len(among)):
        return np.empty((0, 2), np.intp)
    # A projection shortens distances, so none is missed; the tree is quick in 24 dimensions, not in 64.
    flat = points @ np.linalg.eigh(points.T @ points)[1][:, -24:]
    near = cKDTree(flat[among]).query(flat[asked], most + 1, distance_upper_bound=SAME_SCENE)[1]
    columns = []
    for column in near.T:
        known = column < len(among)
        a, b = asked[known], among[column[known]]
        same = (a != b) & (np.linalg.norm(points[a] - points[b], axis=1) < SAME_SCENE)
        columns.append(np.column_stack([a[same], b[same]]))
    return np.vstack(columns)


# What is written.


def report_as_dict(report: CheckReport) -> dict[str, Any]:
    """The report as JSON takes it."""
    return {
        "source": report.source,
        "format": report.format,
        "pictures": report.pictures,
        "labels": report.labels,
        "pictures_without_label": report.unlabelled,
        "splits": report.splits,
        "airports": report.airports,
        "clean": not report.serious,
        "problems": report.counts,
        "remarks": dict(Counter(p.kind for p in report.problems if not p.serious)),
        "notes": list(report.notes),
        "audit": {
            "checked": len(report.audit.labels) - len(report.audit.not_checked),
            "contradicting": len(report.audit.contradicting),
            "not_checked": len(report.audit.not_checked),
            "findings": report.audit.counts,
            "false_alarm_rate": report.audit.false_alarm_rate,
            "sigma_ratio": _finite(report.audit.sigma_ratio),
        },
        "distributions": {
            name: {split or "all": _summary(values) for split, values in each.items()}
            for name, each in report.measures.items()
        },
    }


def _summary(values: Array) -> dict[str, float | int]:
    quantiles = np.quantile(values, [0, 0.05, 0.25, 0.5, 0.75, 0.95, 1])
    names = ("min", "q05", "q25", "median", "q75", "q95", "max")
    return {"count": len(values)} | {n: float(f"{q:.6g}") for n, q in zip(names, quantiles, strict=True)}


def _finite(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _write(report: CheckReport, looks: Sequence[_Look], folder: Path) -> None:
    columns = ("level", "kind", "file", "row", "field", "what", "mend")
    rows = [
        {"level": "problem" if p.serious else "remark"} | {name: getattr(p, name) for name in columns[1:]}
        for p in report.problems
    ]
    write_whole(folder / "check.json", json.dumps(report_as_dict(report), indent=1, allow_nan=False))
    write_whole(folder / "problems.csv", csv_text(columns, rows))
    write_whole(folder / "check.png", _figure(report))
    write_png(folder / "contact_sheet.png", _sheet(report, looks))


def _figure(report: CheckReport) -> bytes:
    """Histograms of all measures, and the pictures of each airport, by split."""
    # Not pyplot: it keeps a global state, and a display back end that a server has not.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 10))
    axes = figure.subplots(3, 3).ravel()
    figure.subplots_adjust(0.05, 0.06, 0.98, 0.93, 0.16, 0.25)  # a layout engine would draw all of it twice
    splits = sorted(report.splits)
    for panel, (name, title) in zip(axes, MEASURES.items(), strict=False):
        _histogram(panel, report.measures[name], splits, title, log=name in ("distance_m", "runway_px"))
    _airports(axes[-1], report.airports, splits)
    if report.measures["brightness"]:  # known of every picture that can be read
        axes[list(MEASURES).index("brightness")].legend(fontsize=8, frameon=False)
    bad = len(report.serious)
    figure.suptitle(f"{report.pictures} pictures, {report.labels} labels, {bad} problems: {report.source}")
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=100)
    return content.getvalue()


def _colour(splits: Sequence[str], split: str) -> str:
    return _COLOURS[splits.index(split) % len(_COLOURS)]


def _histogram(panel: Any, each: dict[str, Array], splits: Sequence[str], title: str, *, log: bool) -> None:
    panel.set(xlabel=title, yticks=[])
    if not each:
        panel.text(0.5, 0.5, "not known", ha="center", va="center", transform=panel.transAxes, color="0.5")
        panel.set_xticks([])
        return
    values = np.concatenate(list(each.values()))
    low, high = float(values.min()), float(values.max())
    log = log and low > 0 and high > 1.5 * low
    pad = 0.02 * (high - low) or 0.5
    bins = np.geomspace(low, high, 31) if log else np.linspace(low - pad, high + pad, 31)
    for split, mine in each.items():
        # Shares, so that splits of different size can be compared.
        shares = np.histogram(mine, bins)[0] / len(mine)
        panel.stairs(shares, bins, color=_colour(splits, split), label=f"{split or 'all'} ({len(mine)})")
    panel.set(ylabel="share", **({"xscale": "log"} if log else {}))


def _airports(panel: Any, airports: dict[str, dict[str, int]], splits: Sequence[str], most: int = 25) -> None:
    """Pictures of the airports that have most."""
    shown = sorted(airports.items(), key=lambda item: -sum(item[1].values()))[:most]
    panel.set(xlabel=f"pictures, of {len(airports)} airports" if airports else "airports not known")
    left = np.zeros(len(shown))
    for split in splits:
        widths = np.array([counts.get(split, 0) for _, counts in shown], float)
        panel.barh(range(len(shown)), widths, left=left, color=_colour(splits, split))
        left += widths
    panel.set_yticks(range(len(shown)), [name for name, _ in shown], fontsize=7)
    panel.invert_yaxis()


def _sheet(report: CheckReport, looks: Sequence[_Look]) -> Image:
    """Examples drawn at random, below them the worst: close-ups with the corners as labelled."""
    from shortfinal.stream.overlay import contact_sheet, write_labelled

    sound = [look for look in looks if look.digest]
    chosen = np.random.default_rng(0).choice(len(sound), min(_SHEET, len(sound)), replace=False)
    worst = sorted((look for look in sound if look.badness > 0), key=lambda look: -look.badness)[:_SHEET]
    parts = []
    for title, shown in (("drawn at random", [sound[k] for k in sorted(chosen)]), ("the worst", worst)):
        strip = np.zeros((26, _COLUMNS * _TILE, 3), np.uint8)
        parts.append(write_labelled(strip, f"{title}: {len(shown)} of {len(sound)}"))
        if shown:
            parts.append(contact_sheet([_tile(look) for look in shown], _COLUMNS, _TILE))
    return np.vstack(parts)


def _tile(look: _Look, size: int = _TILE) -> Image:
    from shortfinal.detector import crop_image
    from shortfinal.stream.overlay import write_labelled

    image = read_image(look.picture.path)
    height, width = image.shape[:2]
    onto = look.picture.window(width, height)
    outlines = [onto.apply(label.corners_px) for label in look.picture.labels if label.corners_px is not None]
    side = max(width, height)
    window = PixelWindow((width - side) / 2, (height - side) / 2, side, side, size, size)
    if outlines and np.ptp(np.vstack(outlines), axis=0).max() > 0:
        window = centre_crop(box_around(np.vstack(outlines)), 1.6, size)
    tile = crop_image(image, window)
    for outline in outlines:
        fixed = np.clip(np.round(window.apply(outline) * 16), -1e6, 1e6).astype(np.int32)
        cv2.polylines(tile, [fixed.reshape(-1, 1, 2)], True, (255, 196, 84), 1, cv2.LINE_AA, 4)
        # Near-left is marked: the order can be seen.
        cv2.circle(tile, [int(v) for v in fixed[0]], 3 * 16, (255, 80, 255), 1, cv2.LINE_AA, 4)
    why = "".join(f"{p.kind}: " for p in look.problems if p.serious)
    return write_labelled(tile, f"{why}{Path(look.picture.name).stem}"[:30])


def render_summary(report: CheckReport, most: int = 10) -> str:
    """A few lines for people: what was looked at, what is wrong, what could not be checked."""
    splits = ", ".join(f"{name} {count}" for name, count in sorted(report.splits.items()) if name)
    checked = len(report.audit.labels) - len(report.audit.not_checked)
    lines = [
        f"{report.format}: {report.pictures} pictures, {report.labels} labels, {len(report.airports)} airports"
        + (f"; {splits}" if splits else ""),
        f"{checked} labels held against their runway, {len(report.audit.contradicting)} contradict it",
    ]
    lines += [f"problem: {p}" for p in report.serious[:most]]
    if len(report.serious) > most:
        lines.append(f"... and {len(report.serious) - most} more in problems.csv")
    remarks = Counter(p.kind for p in report.problems if not p.serious)
    lines += ["remarks: " + ", ".join(f"{count} {kind}" for kind, count in remarks.items())] if remarks else []
    return "\n".join([*lines, *(f"note: {note}" for note in report.notes)])
