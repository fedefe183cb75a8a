"""YOLO-pose, read and written: data.yaml, images, and for each image a text file of labels.

A line is class, box (centre x, y, width, height), and per keypoint x, y and, with kpt_shape [K, 3],
its visibility; all as shares of the image's width and height, counted from its corner (see
`labelled`). The labels of .../images/a.jpg lie in .../labels/a.txt. The format has no room for a
keypoint outside the picture, and none for the runway's name.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow

from shortfinal.crops import box_around
from shortfinal.data.labelled import (
    IMAGE_SUFFIXES,
    SPLITS,
    Array,
    Flags,
    Label,
    LabelledPictures,
    Picture,
    Problem,
    corner_order,
    corner_window,
    keypoint_names,
    make_keypoints,
    read_text,
    refused,
)
from shortfinal.errors import InputError

_ROUNDING = 1e-6  # by which a tool's share may exceed one


def read_yolo(file: Path, corners: Sequence[str] = ()) -> LabelledPictures:
    """The pictures of a YOLO-pose data set, with those lines of labels that are sound.

    `file` is its data.yaml. Keypoints are known by `kpt_names`; where the file has none, `corners` gives
    the numbers (from 0) of near-left, near-right, far-right, far-left. Raises InputError for a
    data.yaml that does not describe keypoints, or whose keypoints are none of our corners.
    """
    layout = _Layout(file, corners)
    pictures: list[Picture] = []
    bad: list[Problem] = []
    for split in SPLITS:
        images = layout.images(split)
        pictures += [layout.picture(path, split, bad) for path in images]
        bad += _without_image(images)
    if not pictures:
        raise InputError(f"{file}: train, val and test name no images; check their paths")
    return LabelledPictures(str(file.parent), "YOLO", tuple(pictures), tuple(bad))


class _Layout:
    """What data.yaml says."""

    def __init__(self, file: Path, corners: Sequence[str]) -> None:
        self.file = file
        self.content = _read_yaml(file)
        self.count, self.width = self._shape()
        self.orders = self._orders(corners)
        given = self.content.get("path")
        root = file.parent / given if isinstance(given, str) else file.parent
        self.root = root if root.is_dir() else file.parent

    def _shape(self) -> tuple[int, int]:
        shape = self.content.get("kpt_shape")
        numbers = shape if isinstance(shape, list) and all(type(n) is int for n in shape) else []
        if len(numbers) != 2 or numbers[0] < 4 or numbers[1] not in (2, 3):
            raise InputError(f"{self.file}: kpt_shape is {shape!r}; expected [4, 2] or [4, 3]: four corners or more")
        return numbers[0], numbers[1]

    def _orders(self, corners: Sequence[str]) -> dict[int, tuple[list[int], tuple[str, ...]]]:
        """Per class: the order of its keypoints, and their names."""
        classes = _by_number(self.content.get("names"))
        if not classes or not all(isinstance(k, int) and isinstance(v, str) for k, v in classes.items()):
            raise InputError(f"{self.file}: names is {self.content.get('names')!r}; expected a list of class names")
        named = self.content.get("kpt_names")
        orders = {}
        for number, name in classes.items():
            each = named if isinstance(named, list) else _by_number(named).get(number)
            names = each if isinstance(each, list) else [str(k) for k in range(self.count)]
            where = f"{self.file}: class {name!r}"
            if len(names) != self.count or not all(isinstance(n, str) for n in names):
                raise InputError(f"{where}: kpt_names is {each!r}; expected {self.count} names")
            order = corner_order(names, corners, where)
            orders[number] = (order, keypoint_names(names, order))
        return orders

    def images(self, split: str) -> list[Path]:
        """The image files of a split: of folders, of lists in text files, or named one by one."""
        entries = self.content.get(split) or []
        if split == "val" and not entries:
            entries = self.content.get("valid") or []
        paths: list[Path] = []
        for entry in entries if isinstance(entries, list) else [entries]:
            if not isinstance(entry, str):
                raise InputError(f"{self.file}: {split} is {entry!r}; expected a folder of images")
            place = self._place(entry, split)
            paths += _listed(place) if place.suffix == ".txt" else _images_in(place)
        return paths

    def _place(self, entry: str, split: str) -> Path:
        # Roboflow writes ../train/images for the folder beside data.yaml.
        for name in (entry, entry.removeprefix("../")):
            if (self.root / name).exists():
                return self.root / name
        raise InputError(f"{self.file}: {split}: {self.root / entry}: no such folder or list of images")

    def picture(self, path: Path, split: str, bad: list[Problem]) -> Picture:
        """An image with its labels; what is wrong with them is added to `bad`."""
        file = label_file(path)
        labels = []
        size = image_size(path)
        try:
            lines = read_text(file, "labels").splitlines() if file.is_file() else []
        except InputError as error:
            lines = []
            bad.append(refused(error, file, picture=path.name))
        for number, line in enumerate(lines, start=1):
            # Without the image its size is unknown, and the labels say nothing; the image is reported elsewhere.
            if not line.strip() or size is None:
                continue
            row = f"line {number}"
            try:
                labels.append(self._label(line, size, file, row))
            except InputError as error:
                bad.append(refused(error, file, row, path.name))
        return Picture(path, _relative(path, self.root), split, size, tuple(labels))

    def _label(self, line: str, size: tuple[int, int], file: Path, row: str) -> Label:
        where = f"{file}: {row}"
        values = _numbers(line, where)
        expected = 5 + self.count * self.width
        if len(values) != expected:
            raise InputError(
                f"{where}: {len(values)} numbers; "
                f"expected {expected}: class, box and {self.count} keypoints of {self.width}"
            )
        if values[0] not in self.orders:
            known = ", ".join(map(str, self.orders))
            raise InputError(f"{where}: class is {values[0]:g}; data.yaml has {known}")
        order, names = self.orders[int(values[0])]
        px, visible = self._keypoints(values[5:], where)
        _check_share("box", values[1:5], where)
        keypoints, flags = make_keypoints(corner_window(*size, 1, 1).inverse(px), visible, order)
        return Label(str(file), row, names, keypoints, flags)

    def _keypoints(self, values: Sequence[float], where: str) -> tuple[Array, Flags]:
        table = np.array(values).reshape(self.count, self.width)
        visible = table[:, 2] if self.width == 3 else np.full(self.count, 2.0)
        odd = [v for v in visible if v not in (0, 1, 2)]
        if odd:
            raise InputError(f"{where}: visibility is {odd[0]:g}; it is 0 (not labelled), 1 (hidden) or 2 (seen)")
        if not visible.any():
            raise InputError(f"{where}: no keypoint is labelled; label the corners or remove the line")
        _check_share("keypoint", table[visible > 0, :2].ravel().tolist(), where)
        return table[:, :2], visible.astype(np.int8)


def _read_yaml(file: Path) -> dict[str, Any]:
    try:
        import yaml  # type: ignore[import-untyped]
    except ImportError as error:
        raise InputError(f"{file}: reading it needs PyYAML; pip install 'shortfinal[data]'") from error
    try:
        content = yaml.safe_load(read_text(file, "YOLO data set"))
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise InputError(f"{file}: not a YAML file: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise InputError(f"{file}: expected train, val, names and kpt_shape, found {content!r:.60}")
    return content


def _by_number(names: Any) -> dict[Any, Any]:
    return dict(enumerate(names)) if isinstance(names, list) else names if isinstance(names, dict) else {}


def _numbers(line: str, where: str) -> list[float]:
    try:
        values = [float(cell) for cell in line.split()]
    except ValueError as error:
        raise InputError(
            f"{where}: {line.strip()!r:.60} holds more than numbers; expected class, box and keypoints"
        ) from error
    odd = [v for v in values if not math.isfinite(v)]
    if odd:
        raise InputError(f"{where}: {odd[0]} among the numbers; expected finite ones")
    return values


def _check_share(what: str, values: Sequence[float], where: str) -> None:
    odd = [v for v in values if not -_ROUNDING <= v <= 1 + _ROUNDING]
    if odd:
        raise InputError(f"{where}: {what} is {odd[0]:g}; expected shares of the image's size, from 0 to 1")


def label_file(image: Path) -> Path:
    """Where an image's labels lie: the last folder `images` of its path becomes `labels`, its suffix .txt."""
    parts = list(image.parts)
    folders = [k for k, part in enumerate(parts[:-1]) if part == "images"]
    if folders:
        parts[folders[-1]] = "labels"
    return Path(*parts).with_suffix(".txt")


def image_size(path: Path) -> tuple[int, int] | None:
    """Width and height of an image file as stored, from its header; None if it is no image."""
    try:
        with Pillow.open(path) as image:
            return image.size
    except (OSError, ValueError, SyntaxError, Pillow.DecompressionBombError):
        return None


def _images_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)


def _listed(file: Path) -> list[Path]:
    """The images that a text file names, a line each, from its own folder."""
    lines = [line.strip() for line in read_text(file, "list of images").splitlines()]
    return [file.parent / line for line in lines if line]


def _without_image(images: Iterable[Path]) -> list[Problem]:
    """Label files in the folders of these images' labels that belong to none of them."""
    known = {label_file(path) for path in images}
    folders = {file.parent for file in known if "labels" in file.parts}
    files = sorted(file for folder in folders for file in folder.glob("*.txt") if file not in known)
    return [
        Problem("label", str(file), "", "", "labels without an image", "add the image or remove the file")
        for file in files
    ]


def _relative(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name


def yolo_line(label: Label, width: int, height: int) -> tuple[str, int]:
    """A label as a line, its keypoints in pixels of a `width` x `height` image.

    A keypoint outside the picture, for which the format has no room, is written as not labelled; how
    many there are comes second. Raises InputError if none is left.
    """
    share = corner_window(width, height, 1, 1).apply(label.keypoints_px)
    labelled = label.visible > 0
    inside = labelled & ((share >= 0) & (share <= 1)).all(axis=1)
    if not inside.any():
        raise InputError(f"{label.file}: {label.row}: no keypoint lies in the picture; YOLO has no room for others")
    left, top, right, bottom = np.clip(box_around(share[labelled]), 0, 1)
    box = [(left + right) / 2, (top + bottom) / 2, right - left, bottom - top]
    cells = [f"{v:.10f}" for v in box]
    for (u, v), seen, flag in zip(share, inside, label.visible, strict=True):
        cells += [f"{u:.10f}", f"{v:.10f}", str(flag)] if seen else ["0", "0", "0"]
    return " ".join(["0", *cells]), int(labelled.sum() - inside.sum())


def yolo_yaml(folders: Mapping[str, str], names: Sequence[str]) -> str:
    """data.yaml for images of one class with keypoints `names`; `folders` by split."""
    plain = [name.replace("-", "_") for name in names[:4]] + list(names[4:])
    lines = [f"{split}: {folder}" for split, folder in folders.items()]
    lines += [f"kpt_shape: [{len(names)}, 3]", f"flip_idx: {_mirrored(plain)}", "names:", "  0: runway"]
    return "\n".join([*lines, "kpt_names:", "  0:", *(f"    - {json.dumps(name)}" for name in plain), ""])


def _mirrored(names: Sequence[str]) -> list[int]:
    """Which keypoint each becomes when the picture is mirrored: left and right change places."""
    swap = {"left": "right", "right": "left"}
    mirror = ["_".join(swap.get(part, part) for part in name.split("_")) for name in names]
    return [names.index(other) if other in names else k for k, other in enumerate(mirror)]
