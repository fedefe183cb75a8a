"""Data sets of labelled pictures in any format we know, opened by what they hold, and converted.

Known are our own `labels.csv` (from `shortfinal data render`), LARD's CSV, COCO keypoints and YOLO-pose.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from shortfinal.data.coco import coco_text, is_coco, read_coco
from shortfinal.data.labelled import (
    LARGEST_PX,
    SPLITS,
    Label,
    LabelledPictures,
    Origin,
    Picture,
    Problem,
    find_image,
    refused,
    split_named,
)
from shortfinal.data.lard import RunwayLabel, distortion_of, labels_of
from shortfinal.data.table import Refusal, Row, read_table
from shortfinal.data.yolo import image_size, read_yolo, yolo_line, yolo_yaml
from shortfinal.errors import InputError
from shortfinal.files import make_folder, write_whole
from shortfinal.geometry import Camera, Pose, frozen
from shortfinal.keypoints import CORNER_NAMES
from shortfinal.runway import Runway

Target = Literal["coco", "yolo"]


def keypoint_columns(names: Sequence[str]) -> tuple[str, ...]:
    """Of our own labels.csv: "near_left_u", "near_left_v", ..."""
    return tuple(f"{name.replace('-', '_')}_{axis}" for name in names for axis in "uv")


# Of our own labels.csv.
CORNER_COLUMNS = keypoint_columns(CORNER_NAMES)
CAMERA_COLUMNS = ("width", "height", "fx", "fy", "cx", "cy")
POSE_COLUMNS = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
_ALL_SEEN = np.full(4, 2, np.int8)
_ALL_SEEN.setflags(write=False)
_LARD_COLUMNS = ({"x_A", "y_A", "x_D", "y_D"}, {"x_TL", "y_TL", "x_BR", "y_BR"})


def open_dataset(
    source: str | Path, *, corners: Sequence[str] = (), origin: Origin = "corner", camera: Camera | None = None
) -> LabelledPictures:
    """A data set: a folder, or the one of its files that holds or describes the labels.

    The format is told by the content; splits by data.yaml, a column `split`, or the names of files and
    folders. `corners`: the file's names of near-left, near-right, far-right, far-left, where they are
    not the usual ones. `origin`: from where COCO keypoints count (see `labelled`). `camera`: the one
    that took the pictures, where the labels do not say. Rows that are wrong are in `.refused`; raises
    InputError where no format fits, or the whole file is wrong.
    """
    if origin not in get_args(Origin):
        raise InputError(f"origin: {origin!r}; expected {' or '.join(get_args(Origin))}")
    path = Path(source)
    if path.is_file():
        kinds = {_kind(path): [path]}
        if "" in kinds:
            raise InputError(f"{path}: {_NOT_KNOWN}")
        root = path.parent.parent if path.parent.name == "annotations" else path.parent
        return _open(kinds, root, corners, origin, camera)
    if not path.is_dir():
        raise InputError(f"{path}: no such folder; expected a data set")
    kinds = _label_files(path)
    if kinds:
        return _open(kinds, path, corners, origin, camera)
    parts = [folder for folder in sorted(path.iterdir()) if folder.is_dir() and split_named(folder.name)]
    parts = [folder for folder in parts if _label_files(folder)]
    if not parts:
        raise InputError(f"{path}: {_NOT_KNOWN}")
    opened = [open_dataset(folder, corners=corners, origin=origin, camera=camera) for folder in parts]
    return _joined(path, parts, opened)


_NOT_KNOWN = (
    "not a data set; looked for labels.csv (ours or LARD's columns), a .json of COCO keypoints "
    "(images, annotations, categories; also in annotations/), and a .yaml of YOLO-pose (kpt_shape, train, val)"
)


def _open(
    kinds: dict[str, list[Path]], root: Path, corners: Sequence[str], origin: Origin, camera: Camera | None
) -> LabelledPictures:
    if len(kinds) > 1:
        found = " and ".join(f"{kind} ({files[0].name})" for kind, files in kinds.items())
        raise InputError(f"{root}: holds {found}; name the file instead of the folder")
    (kind, files), *_ = kinds.items()
    if kind == "COCO":
        return read_coco(files, root, corners, origin)
    if kind == "YOLO":
        if len(files) > 1:
            raise InputError(f"{root}: holds {files[0].name} and {files[1].name}; name the one that describes the data")
        return read_yolo(files[0], corners)
    pictures, bad = [], []
    for file in files:
        read = _read_own if kind == "shortfinal" else _read_lard
        rows, wrong = read(file, camera)
        pictures += _pictures(rows, root)
        bad += wrong
    return LabelledPictures(str(root), kind, tuple(pictures), tuple(bad))


def _label_files(folder: Path) -> dict[str, list[Path]]:
    """The files that hold or describe labels, by format."""
    # `data render` writes LARD's columns beside ours: what is called labels.csv counts.
    tables = [folder / "labels.csv"] if _kind(folder / "labels.csv") else sorted(folder.glob("*.csv"))
    documents = [*folder.glob("*.json"), *folder.glob("annotations/*.json")]
    documents += [file for file in folder.glob("*/*.json") if split_named(file.parent.name)]
    kinds = defaultdict(list)
    for file in [*tables, *sorted(documents), *sorted([*folder.glob("*.yaml"), *folder.glob("*.yml")])]:
        if kind := _kind(file):
            kinds[kind].append(file)
    if len(kinds.get("COCO", ())) > 1:  # beside keypoints COCO has boxes and captions, each in its file
        kinds["COCO"] = [file for file in kinds["COCO"] if '"keypoints"' in file.read_text()] or kinds["COCO"]
    return kinds


def _kind(file: Path) -> str:
    """The format of a file of labels; "" if it is none."""
    try:
        if file.suffix == ".csv":
            return _table_kind(file)
        text = file.read_text(encoding="utf-8-sig") if file.suffix in (".json", ".yaml", ".yml") else ""
    except (OSError, UnicodeDecodeError):
        return ""
    if file.suffix == ".json":
        return _document_kind(text)
    return "YOLO" if "kpt_shape" in text or ("names" in text and "train" in text) else ""


def _table_kind(file: Path) -> str:
    with open(file, encoding="utf-8-sig") as lines:
        columns = set(next(lines, "").strip().replace(";", ",").split(","))
    if len(columns & set(CORNER_COLUMNS)) > 4:
        return "shortfinal"
    return "LARD" if any(wanted <= columns for wanted in _LARD_COLUMNS) else ""


def _document_kind(text: str) -> str:
    try:
        return "COCO" if is_coco(json.loads(text)) else ""
    except (ValueError, RecursionError):
        # Cut off or damaged: the reader says where.
        return "COCO" if '"annotations"' in text or '"images"' in text else ""


def _joined(path: Path, folders: Sequence[Path], parts: Sequence[LabelledPictures]) -> LabelledPictures:
    """Data sets in folders named for a split, as one."""
    formats = sorted({part.format for part in parts})
    if len(formats) > 1:
        raise InputError(f"{path}: its folders hold {' and '.join(formats)}; check them one by one")
    pictures = [
        replace(picture, name=f"{folder.name}/{picture.name}", split=split_named(folder.name))
        for folder, part in zip(folders, parts, strict=True)
        for picture in part.pictures
    ]
    bad = [problem for part in parts for problem in part.refused]
    notes = [note for part in parts for note in part.notes]
    return LabelledPictures(str(path), formats[0], tuple(pictures), tuple(bad), tuple(notes))


# Tables: one row a label, several rows a picture where it shows several runways.


@dataclass(frozen=True)
class _TableRow:
    """A label, and what its row says of the picture."""

    image: str
    split: str
    size: tuple[int, int] | None
    resampled: bool
    label: Label | None  # None: the picture shows no runway


def _pictures(rows: Iterable[_TableRow], root: Path) -> list[Picture]:
    folders = (root, root / "images")
    together: dict[str, list[_TableRow]] = defaultdict(list)
    for row in rows:
        together[row.image].append(row)
    return [
        Picture(
            find_image(name, folders),
            name,
            mine[0].split,
            mine[0].size,
            tuple(r.label for r in mine if r.label),
            mine[0].resampled,
        )
        for name, mine in together.items()
    ]


def _read_own(file: Path, camera: Camera | None) -> tuple[list[_TableRow], list[Problem]]:
    table = read_table(file)
    missing = [name for name in ("image", *CORNER_COLUMNS) if name not in table.columns]
    if missing:
        raise InputError(f"{file}: line 1: no column {', '.join(missing)}")
    if not table.records:
        raise InputError(f"{file}: line 1: a header without rows; expected one label per line")
    cameras: dict[tuple[str, ...], Camera | None] = {}  # by their cells: most rows have the same
    rows, bad = table.read(lambda row: _own_row(row, camera, cameras))
    return rows, _problems(bad, file)


def _problems(refusals: Iterable[Refusal], file: Path) -> list[Problem]:
    return [refused(InputError(r.message), file, f"line {r.line}") for r in refusals]


def _own_row(row: Row, given: Camera | None, cameras: dict[tuple[str, ...], Camera | None]) -> _TableRow:
    cells = tuple(row.get(name) for name in (*CAMERA_COLUMNS, "distortion"))
    if given is None and cells not in cameras:
        cameras[cells] = _own_camera(row)
    camera = given or cameras[cells]
    size = (camera.width, camera.height) if camera else None
    image = row.text("image")
    split = _split_of(row.get("split"), image, Path(row.path))
    if not any(row.get(name) for name in CORNER_COLUMNS):
        return _TableRow(image, split, size, False, None)
    further = [name[:-2].replace("_", "-") for name in row.columns if name.endswith("_u")]
    names = (*CORNER_NAMES, *(name for name in further if name not in CORNER_NAMES))
    places, visible = np.full((len(names), 2), np.nan), np.zeros(len(names), np.int8)
    for k, name in enumerate(names):
        columns = keypoint_columns([name])
        if k < 4 or any(row.get(column) for column in columns):  # a further one may be missing
            places[k] = [row.number(column, -LARGEST_PX, LARGEST_PX) for column in columns]
            visible[k] = 2
    pose = None
    if all(name in row.columns for name in POSE_COLUMNS):
        numbers = [row.number(name) for name in POSE_COLUMNS]
        pose = Pose.from_attitude(numbers[:3], *numbers[3:])
    runway = None
    if row.get("length_m") and row.get("width_m"):
        runway = Runway(row.number("length_m", 0.1, 1e5), row.number("width_m", 0.1, 1e5), row.get("ident"))
    # Every rendered picture is a world of its own.
    label = Label(
        str(row.path), f"line {row.line}", names, frozen(places), visible,
        row.get("ident").upper(), row.get("scenario") or f"{row.path}: {image}", runway, camera, pose,
    )  # fmt: skip
    return _TableRow(image, split, size, False, label)


def _own_camera(row: Row) -> Camera | None:
    if not all(name in row.columns for name in CAMERA_COLUMNS):
        return None
    values = {name: row.number(name, 0.1, 1e6) for name in CAMERA_COLUMNS[:4]} | {
        name: row.number(name) for name in CAMERA_COLUMNS[4:]
    }
    for name in CAMERA_COLUMNS[:2]:
        if values[name] % 1:
            row.refuse(name, "expected a whole number of pixels")
    width, height, fx, fy, cx, cy = values.values()
    return Camera(int(width), int(height), fx, fy, cx, cy, distortion_of(row))


def _read_lard(file: Path, camera: Camera | None) -> tuple[list[_TableRow], list[Problem]]:
    table = read_table(file)
    labels = labels_of(table, camera)
    splits = dict(table.read(lambda row: (row.line, row.get("split")))[0])
    return [_lard_row(label, splits[label.line], file) for label in labels], _problems(labels.refused, file)


def _lard_row(recorded: RunwayLabel, split: str, file: Path) -> _TableRow:
    label = Label(
        str(file), f"line {recorded.line}", CORNER_NAMES, recorded.corners_px, _ALL_SEEN, recorded.ident,
        recorded.picture.scenario, None, recorded.camera, None, recorded,
    )  # fmt: skip
    size = (recorded.camera.width, recorded.camera.height) if recorded.camera else None
    return _TableRow(recorded.image, _split_of(split, recorded.image, file), size, True, label)


def _split_of(cell: str, image: str, file: Path) -> str:
    """Of a row: its column, else the image's folder, else the label file's name."""
    return split_named(cell, *Path(image).parts[:-1], file.name)


# Splits.


def split_by_airport(pictures: Sequence[Picture], fractions: Sequence[float], seed: int = 0) -> list[str]:
    """Per picture train, val or test, so that no airport is in two of them.

    Fractions are wanted shares of the pictures. Airports go, largest first and in an order drawn by
    `seed` among equals, to the split that lacks most. Rendered scenes, which are at no airport, and
    pictures without a runway go one by one. Raises InputError for fractions that do not add up to one,
    or a label without airport.
    """
    wanted = dict(zip(SPLITS, fractions, strict=False))
    if len(fractions) > 3 or min(fractions, default=0) < 0 or not abs(sum(fractions) - 1) < 1e-6:
        raise InputError(
            f"split: {list(fractions)}; expected shares of train, val, test that add up to 1, e.g. 0.8,0.1,0.1"
        )
    groups = [_group(picture) for picture in pictures]
    nameless = [p.name for p, group in zip(pictures, groups, strict=True) if not group]
    if nameless:
        raise InputError(
            f"split: {len(nameless)} pictures are at no known airport (first: {nameless[0]}); "
            "give their labels the attribute runway, e.g. LFPO/24"
        )
    sizes = Counter(groups)
    names = sorted(sizes)
    np.random.default_rng(seed).shuffle(names)
    lacking = {split: share * len(pictures) for split, share in wanted.items() if share > 0}
    if len(names) < len(lacking):
        raise InputError(f"split: {len(names)} airports cannot fill {len(lacking)} splits: {', '.join(sorted(names))}")
    chosen: dict[str, str] = {}
    for name in sorted(names, key=lambda n: -sizes[n]):
        empty = [split for split in lacking if split not in chosen.values()]
        # What is left must suffice for the splits that are still empty.
        open_to = empty if len(names) - len(chosen) == len(empty) else lacking
        split = max(open_to, key=lambda s: lacking[s])
        chosen[name] = split
        lacking[split] -= sizes[name]
    return [chosen[group] for group in groups]


def _group(picture: Picture) -> str:
    airports = sorted({label.airport for label in picture.labels if label.airport})
    scenarios = sorted({label.scenario for label in picture.labels if label.scenario})
    return next(iter([*airports, *scenarios]), "" if picture.labels else str(picture.path))


# Conversion.


@dataclass(frozen=True, eq=False)
class Conversion:
    """What was written, and what was not."""

    out: Path
    pictures: int
    labels: int
    outside: int  # corners outside their picture that YOLO has no room for
    splits: dict[str, int]  # pictures of each
    refused: tuple[Problem, ...]
    notes: tuple[str, ...]


def convert(
    source: str | Path,
    out: str | Path,
    to: Target,
    *,
    corners: Sequence[str] = (),
    origin: Origin = "corner",
    fractions: Sequence[float] = (),
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Conversion:
    """Write a data set as COCO keypoints or YOLO-pose into the folder `out`, whole or not at all.

    Images are linked where the file system can, copied elsewhere, and never altered. `fractions`: split
    anew by airport (`split_by_airport`); else the splits stay as they are. Labels that are wrong, or
    whose picture is, are left out and listed in `.refused`. `progress` is told how many pictures are
    written, of how many. Raises InputError if nothing is left.
    """
    target = Path(out)
    if to not in get_args(Target):
        raise InputError(f"to: {to!r}; expected {' or '.join(get_args(Target))}")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{target}: is there already; choose an empty folder")
    data = open_dataset(source, corners=corners, origin=origin)
    plan = _Plan(data)
    if not plan.items:
        first = f"; the first: {plan.bad[0]}" if plan.bad else ""
        raise InputError(f"{source}: no sound picture to write{first}")
    if fractions:
        splits = split_by_airport([picture for picture, *_ in plan.items], fractions, seed)
        plan.items = [(replace(p, split=s), z, lab) for (p, z, lab), s in zip(plan.items, splits, strict=True)]
    staging = target.with_name(f"{target.name}.partial")
    if staging.exists():
        raise InputError(f"{staging}: left by a conversion that was stopped; remove it")
    make_folder(staging)
    try:
        write = _write_coco if to == "coco" else _write_yolo
        outside = write(plan, staging, progress)
        staging.replace(target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    labels = sum(len(labels) for *_, labels in plan.items)
    counts = Counter(picture.split for picture, *_ in plan.items)
    return Conversion(target, len(plan.items), labels, outside, dict(counts), tuple(plan.bad), data.notes)


class _Plan:
    """Sound pictures with their size and labels in their own pixels, and what was left out."""

    def __init__(self, data: LabelledPictures) -> None:
        self.bad = list(data.refused)
        self.items: list[tuple[Picture, tuple[int, int], tuple[Label, ...]]] = []
        for picture in data.pictures:
            size = image_size(picture.path)
            if size is None:
                what = "cannot be read as an image" if picture.path.exists() else "no such image"
                self._leave_out(picture, "image", what, "add it or remove its labels")
            elif picture.wrong_size(*size):
                what = f"{size[0]} x {size[1]} pixels, but its labels say {picture.size[0]} x {picture.size[1]}"  # type: ignore[index]
                self._leave_out(picture, "size", what, "take the image that was labelled")
            else:
                window = picture.window(*size)
                labels = (replace(lab, keypoints_px=window.apply(lab.keypoints_px)) for lab in picture.labels)
                self.items.append((picture, size, tuple(labels)))

    def _leave_out(self, picture: Picture, kind: str, what: str, mend: str) -> None:
        self.bad.append(Problem(kind, str(picture.path), "", "", what, mend, picture.name))

    def by_split(self) -> dict[str, list[tuple[str, Picture, tuple[int, int], tuple[Label, ...]]]]:
        """Items by split, each with a file name that no other picture there has, whatever the suffix."""
        splits: dict[str, list[tuple[str, Picture, tuple[int, int], tuple[Label, ...]]]] = defaultdict(list)
        stems = Counter((p.split, Path(p.name).stem.lower()) for p, *_ in self.items)
        taken: set[tuple[str, str]] = set()
        for item in self.items:
            path = Path(item[0].name)
            alone = stems[item[0].split, path.stem.lower()] == 1
            stem = (
                path.stem if alone else "_".join(part for part in path.with_suffix("").parts if part not in ("/", ".."))
            )
            stem = next(s for s in (stem, *(f"{stem}_{n}" for n in range(2, len(self.items) + 2)))
                        if (item[0].split, s.lower()) not in taken)  # fmt: skip
            taken.add((item[0].split, stem.lower()))
            splits[item[0].split].append((stem + path.suffix, *item))
        return splits


def _write_coco(plan: _Plan, folder: Path, progress: Callable[[int, int], None] | None) -> int:
    done = 0
    for split, items in plan.by_split().items():
        images = make_folder(folder / "images" / split)
        for name, picture, *_ in items:
            _place(picture.path, images / name)
            done = _step(done, plan, progress)
        make_folder(folder / "annotations")
        text = coco_text((name, *size, labels) for name, _, size, labels in items)
        write_whole(folder / "annotations" / f"keypoints{'_' * bool(split)}{split}.json", text)
    return 0


def _write_yolo(plan: _Plan, folder: Path, progress: Callable[[int, int], None] | None) -> int:
    names = {label.names for *_, labels in plan.items for label in labels} or {CORNER_NAMES}
    if len(names) > 1:
        raise InputError(
            f"labels of {len(names)} kinds ({'; '.join(', '.join(n) for n in islice(names, 2))}); YOLO takes one"
        )
    done = outside = 0
    folders = {}
    for split, items in plan.by_split().items():
        part = split or "train"  # YOLO knows no data without a split
        folders[part] = f"images/{part}"
        images, texts = make_folder(folder / "images" / part), make_folder(folder / "labels" / part)
        for name, picture, size, labels in items:
            _place(picture.path, images / name)
            outside += _write_lines(texts / f"{Path(name).stem}.txt", labels, size, plan.bad)
            done = _step(done, plan, progress)
    in_order = {split: folders[split] for split in SPLITS if split in folders}
    write_whole(folder / "data.yaml", yolo_yaml(in_order, next(iter(names))))
    return outside


def _write_lines(file: Path, labels: Sequence[Label], size: tuple[int, int], bad: list[Problem]) -> int:
    """Write one picture's labels; how many keypoints lay outside it."""
    lines, outside = "", 0
    for label in labels:
        try:
            line, lost = yolo_line(label, *size)
        except InputError as error:
            bad.append(refused(error, label.file, label.row))
            continue
        lines, outside = f"{lines}{line}\n", outside + lost
    write_whole(file, lines)
    return outside


def _place(source: Path, target: Path) -> None:
    """The same file under another name: a link, or a copy where links cannot be."""
    try:
        os.link(source.resolve(), target)
    except OSError:
        shutil.copyfile(source, target)


def _step(done: int, plan: _Plan, progress: Callable[[int, int], None] | None) -> int:
    if progress:
        progress(done + 1, len(plan.items))
    return done + 1
