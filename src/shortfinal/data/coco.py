"""COCO keypoints, read and written: images, annotations and categories in one JSON file a split.

Coordinates count from the image's corner, as labelling tools write them; COCO's own keypoint files
hold indices of pixels instead, and are read with `origin="centre"` (see `labelled`). A keypoint is
x, y and its visibility: 0 not labelled, 1 labelled but hidden, 2 seen. The runway's name stands in
the annotation's attribute `runway`, where CVAT puts what users define.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shortfinal.crops import box_around
from shortfinal.data.labelled import (
    LARGEST_PX,
    Array,
    Flags,
    Label,
    LabelledPictures,
    Origin,
    Picture,
    Problem,
    corner_order,
    corner_window,
    find_image,
    keypoint_names,
    make_keypoints,
    split_named,
)
from shortfinal.errors import InputError
from shortfinal.files import read_json

PARTS = ("images", "annotations", "categories")


def is_coco(content: Any) -> bool:
    """Whether a JSON file's content looks like COCO's."""
    return isinstance(content, dict) and sum(isinstance(content.get(part), list) for part in PARTS) >= 2


def read_coco(
    files: Sequence[Path], root: Path, corners: Sequence[str] = (), origin: Origin = "corner"
) -> LabelledPictures:
    """The pictures of COCO keypoint files, with those annotations that are sound.

    `root` is the data set's folder, `corners` the names of our four corners in these files. Raises
    InputError for a file that is not COCO keypoints, or whose keypoints are none of our corners.
    """
    pictures, bad, notes = [], [], []
    for file in files:
        reader = _Reader(file, root, corners, origin)
        pictures += reader.pictures()
        bad += reader.bad
        notes += reader.notes()
    return LabelledPictures(str(root), "COCO", tuple(pictures), tuple(bad), tuple(notes))


class _Reader:
    """One file, and what has been refused of it so far."""

    def __init__(self, file: Path, root: Path, corners: Sequence[str], origin: Origin) -> None:
        self.file, self.root, self.origin = file, root, origin
        self.bad: list[Problem] = []
        self.passed_over: Counter[str] = Counter()
        self.whole = True  # whether all coordinates are whole numbers
        content = read_json(file, "COCO annotations")
        for part in PARTS:
            if not isinstance(content, dict) or not isinstance(content.get(part), list):
                raise InputError(f"{file}: no list {part!r}; COCO keypoints have {', '.join(PARTS)}")
        self.images, self.annotations = content["images"], content["annotations"]
        self.categories = self._categories(content["categories"], corners)

    def _categories(self, entries: list[Any], corners: Sequence[str]) -> dict[Any, tuple[list[int], tuple[str, ...]]]:
        """Per category with keypoints: their order and names; None for the other categories."""
        known: dict[Any, Any] = {}
        for number, entry in enumerate(entries):
            if not isinstance(entry, dict) or not isinstance(entry.get("id"), int):
                raise InputError(f"{self.file}: categories[{number}] has no id; a category has id, name and keypoints")
            if entry["id"] in known:
                raise InputError(f"{self.file}: category id {entry['id']} stands there twice; give each its own")
            names, known[entry["id"]] = entry.get("keypoints"), None
            if names is None:
                continue
            if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
                raise InputError(f"{self.file}: categories[{number}]: keypoints must be a list of names")
            where = f"{self.file}: category {entry.get('name', entry['id'])!r}"
            order = corner_order(names, corners, where)
            known[entry["id"]] = (order, keypoint_names(names, order))
        if not any(known.values()):
            found = ", ".join(repr(e.get("name")) for e in entries[:6]) or "none"
            raise InputError(
                f"{self.file}: no category has keypoints (categories: {found}); label the four corners as keypoints"
            )
        return known

    def pictures(self) -> list[Picture]:
        images = self._images()
        labels: dict[Any, list[Label]] = {key: [] for key in images}
        seen: set[Any] = set()
        for number, entry in enumerate(self.annotations):
            row = f"annotation {entry['id']}" if isinstance(entry, dict) and "id" in entry else f"annotations[{number}]"
            try:
                label = self._label(entry, row, images, seen)
            except _BadFieldError as why:
                self._refuse(row, *why.args)
                continue
            if label is not None:
                labels[entry["image_id"]].append(label)
        # The name of the data set's own folder says nothing of a split.
        split = split_named(self.file.name, *(self.file.parent.name,) * (self.file.parent != self.root))
        folders = self._folders(split)
        return [
            Picture(
                find_image(name, folders), name, split or split_named(*Path(name).parts[:-1]), size, tuple(labels[k])
            )
            for k, (name, size) in images.items()
        ]

    def _folders(self, split: str) -> list[Path]:
        images = self.root / "images"
        return [*((images / split, self.root / split) if split else ()), self.file.parent, self.root, images]

    def _images(self) -> dict[Any, tuple[str, tuple[int, int]]]:
        """Name and size by id. An id that stands there twice is nobody's."""
        images: dict[Any, tuple[str, tuple[int, int]]] = {}
        names: set[str] = set()
        ids = Counter(str(e.get("id")) for e in self.images if isinstance(e, dict))
        for number, entry in enumerate(self.images):
            row = f"images[{number}]"
            try:
                key, name, size = _image(entry)
                if ids[str(key)] > 1:
                    raise _BadFieldError(
                        "id", f"image id {key} stands there {ids[str(key)]} times", "give each image its own"
                    )
                if name in names:
                    raise _BadFieldError(
                        "file_name", f"{name} stands there twice", "keep one image and its annotations"
                    )
            except _BadFieldError as why:
                self._refuse(row, *why.args)
                continue
            names.add(name)
            images[key] = (name, size)
        return images

    def _label(self, entry: Any, row: str, images: dict[Any, Any], seen: set[Any]) -> Label | None:
        if not isinstance(entry, dict):
            raise _BadFieldError("", f"{_short(entry)} is no annotation", "an annotation is an object with image_id")
        if not _hashable(entry.get("category_id")) or entry["category_id"] not in self.categories:
            known = ", ".join(map(str, self.categories))
            raise _BadFieldError(
                "category_id", f"no category {_short(entry.get('category_id'))}", f"the file has {known}"
            )
        category = self.categories[entry["category_id"]]
        if category is None:
            self.passed_over[str(entry["category_id"])] += 1
            return None
        if not _hashable(entry.get("image_id")) or entry.get("image_id") not in images:
            raise _BadFieldError(
                "image_id", f"no image {_short(entry.get('image_id'))}", "add the image or remove the label"
            )
        if "id" in entry and str(entry["id"]) in seen:
            raise _BadFieldError("id", f"annotation id {_short(entry['id'])} stands there twice", "give each its own")
        seen.add(str(entry.get("id")))
        order, names = category
        px, visible = _keypoints(entry.get("keypoints"), len(order))
        self.whole &= bool((px[visible > 0] % 1 == 0).all())
        size = images[entry["image_id"]][1]
        ours = px if self.origin == "centre" else corner_window(*size, *size).inverse(px)
        keypoints, flags = make_keypoints(ours, visible, order)
        return Label(str(self.file), row, names, keypoints, flags, _ident(entry.get("attributes")))

    def _refuse(self, row: str, field: str, what: str, mend: str) -> None:
        self.bad.append(Problem("label", str(self.file), row, field, what, mend))

    def notes(self) -> list[str]:
        notes = [
            f"{self.file}: {count} annotations of category {key}, which has no keypoints, passed over"
            for key, count in self.passed_over.items()
        ]
        if self.whole and self.annotations and self.origin == "corner":
            notes.append(
                f"{self.file}: all coordinates are whole numbers; if they are indices of pixels, as in COCO's own "
                "files, read them with --origin centre (half a pixel)"
            )
        return notes


class _BadFieldError(Exception):
    """Field, what is wrong with it, and the mend."""


def _image(entry: Any) -> tuple[Any, str, tuple[int, int]]:
    if not isinstance(entry, dict):
        raise _BadFieldError(
            "", f"{_short(entry)} is no image", "an image is an object with id, file_name, width, height"
        )
    if not isinstance(entry.get("id"), (int, str)):
        raise _BadFieldError("id", f"id is {_short(entry.get('id'))}", "give the image a number")
    if not isinstance(entry.get("file_name"), str) or not entry["file_name"].strip():
        raise _BadFieldError("file_name", f"file_name is {_short(entry.get('file_name'))}", "name the image's file")
    size = []
    for side in ("width", "height"):
        value = entry.get(side)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 < value < LARGEST_PX:
            raise _BadFieldError(side, f"{side} is {_short(value)}", "give the image's size in pixels")
        size.append(value)
    return entry["id"], entry["file_name"], (size[0], size[1])


def _keypoints(values: Any, count: int) -> tuple[Array, Flags]:
    """x, y (K, 2) as they stand, and visibility (K,)."""
    if not isinstance(values, list) or len(values) != 3 * count:
        found = f"{len(values)} numbers" if isinstance(values, list) else _short(values)
        raise _BadFieldError("keypoints", f"keypoints are {found}", f"expected x, y, visibility of {count} keypoints")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise _BadFieldError("keypoints", f"{_short(value)} among the keypoints", "expected finite numbers")
    table = np.array(values, float).reshape(-1, 3)
    odd = [v for v in table[:, 2] if v not in (0, 1, 2)]
    if odd:
        raise _BadFieldError("keypoints", f"visibility {odd[0]:g}", "it is 0 (not labelled), 1 (hidden) or 2 (seen)")
    if np.abs(table[:, :2]).max() > LARGEST_PX:
        raise _BadFieldError("keypoints", f"{np.abs(table[:, :2]).max():g} is no pixel of any image", "correct it")
    if not table[:, 2].any():
        raise _BadFieldError("keypoints", "no keypoint is labelled", "label the corners or remove the annotation")
    return table[:, :2], table[:, 2].astype(np.int8)


def _ident(attributes: Any) -> str:
    runway = attributes.get("runway") if isinstance(attributes, dict) else None
    return runway.strip().upper() if isinstance(runway, str) else ""


def _hashable(value: Any) -> bool:
    return isinstance(value, (int, str))


def _short(value: Any) -> str:
    return f"{' '.join(repr(value).split()):.60}"


def coco_text(pictures: Iterable[tuple[str, int, int, Sequence[Label]]]) -> str:
    """A COCO keypoint file for pictures, each: file name, width, height, labels in its pixels.

    Keypoints count from the image's corner; the box, and the area as the box's, are of the labelled ones.
    """
    images: list[Any] = []
    annotations: list[Any] = []
    categories: dict[tuple[str, ...], dict[str, Any]] = {}
    for name, width, height, labels in pictures:
        images.append({"id": len(images) + 1, "file_name": name, "width": width, "height": height})
        for label in labels:
            category = categories.setdefault(label.names, _category(len(categories) + 1, label.names))
            record = _annotation(label, width, height)
            ids = {"id": len(annotations) + 1, "image_id": len(images), "category_id": category["id"]}
            annotations.append(ids | record)
    info = {"description": "Keypoints in pixels from the image's corner: the first pixel's centre is (0.5, 0.5)."}
    content = {"info": info, "categories": list(categories.values()), "images": images, "annotations": annotations}
    return json.dumps(content, allow_nan=False)


def _category(number: int, names: Sequence[str]) -> dict[str, Any]:
    outline = [[1, 2], [2, 3], [3, 4], [4, 1]]  # COCO counts keypoints from 1
    plain = [name.replace("-", "_") for name in names[:4]] + list(names[4:])
    return {"id": number, "name": "runway", "supercategory": "", "keypoints": plain, "skeleton": outline}


def _annotation(label: Label, width: int, height: int) -> dict[str, Any]:
    seen = label.visible > 0
    px = corner_window(width, height, width, height).apply(label.keypoints_px)
    left, top, right, bottom = box_around(px[seen])
    rows = [[float(u), float(v), int(f)] if f else [0, 0, 0] for (u, v), f in zip(px, label.visible, strict=True)]
    record = {
        "keypoints": [value for row in rows for value in row],
        "num_keypoints": int(seen.sum()),
        "bbox": [left, top, right - left, bottom - top],
        "area": (right - left) * (bottom - top),
        "iscrowd": 0,
    }
    return record | ({"attributes": {"runway": label.ident}} if label.ident else {})
