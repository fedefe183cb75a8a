"""LARD v2 (`DEEL-AI/LARD_V2` on the Hugging Face hub) straight from its parquet files, row by row.

The columns are taken to be those of the metadata files, and `image` a picture as the hub stores it
(bytes and path); the files are `SUBSET/SPLIT-....parquet`, as public code that reads them has it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

from shortfinal.data.fetch import LARD_V2, LARD_V2_SUBSETS
from shortfinal.data.image import Image, decode_image
from shortfinal.data.lard import RunwayLabel, check_columns, label_of
from shortfinal.data.table import Refusal, Row
from shortfinal.errors import InputError
from shortfinal.geometry import Camera


def stream_lard_v2(
    source: str | Path = LARD_V2,
    subset: str = "flsim",
    split: str = "train",
    *,
    camera: Camera | None = None,
    refused: Callable[[Refusal], None] | None = None,
) -> Iterator[tuple[Image, RunwayLabel]]:
    """Pictures (h, w, 3; RGB) with their labels, read as they are asked for: at most about a file is held.

    `source` is the hub's name of the set, or a folder that holds `SUBSET/SPLIT*.parquet` (or the
    files themselves). `camera` as in `read_labels`. Bad rows, pictures that cannot be decoded, and
    files of the folder that are no parquet go to `refused` and are left out; their line is the
    row's number in its file (on the hub: in the split), from 1. Raises InputError for an unknown
    subset, a folder without such files, or columns that are not LARD's, and, where the package
    `datasets` is missing, one that says how to get it.
    """
    if subset not in LARD_V2_SUBSETS:
        raise InputError(f"subset {subset!r}: LARD v2 has {', '.join(LARD_V2_SUBSETS)}")
    try:
        import datasets
    except ImportError as error:
        raise InputError("LARD v2's parquet needs the package datasets: pip install 'shortfinal[data]'") from error
    tell = refused or (lambda refusal: None)
    if not Path(source).is_dir():
        if str(source) != LARD_V2:
            raise InputError(f"{source}: no such folder; give one of parquet files, or {LARD_V2}")
        rows = datasets.load_dataset(LARD_V2, subset, split=split, streaming=True)
        return _examples(rows, f"{LARD_V2}/{subset}/{split}", camera, tell)
    files = _files(Path(source), subset, split)
    return chain.from_iterable(_file(path, camera, tell) for path in files)


def _files(folder: Path, subset: str, split: str) -> list[Path]:
    for pattern in (f"{subset}/{split}*.parquet", f"{split}*.parquet"):
        if files := sorted(folder.glob(pattern)):
            return files
    raise InputError(f"{folder}: holds neither {subset}/{split}*.parquet nor {split}*.parquet")


def _file(path: Path, camera: Camera | None, tell: Callable[[Refusal], None]) -> Iterator[tuple[Image, RunwayLabel]]:
    import datasets
    import pyarrow

    try:
        rows = datasets.load_dataset("parquet", data_files=str(path), split="train", streaming=True)
        yield from _examples(rows, str(path), camera, tell)
    except (pyarrow.ArrowInvalid, datasets.exceptions.DatasetGenerationError, OSError) as error:
        tell(Refusal(0, f"{path}: not a whole parquet file: {' '.join(str(error).split()):.120}; fetch it anew"))


def _examples(
    rows: Any, where: str, camera: Camera | None, tell: Callable[[Refusal], None]
) -> Iterator[tuple[Image, RunwayLabel]]:
    names = list(rows.features or next(iter(rows)))
    check_columns(where, names)
    rows = rows.cast_column("image", _undecoded())
    columns = {name: place for place, name in enumerate(names)}
    for number, row in enumerate(rows, start=1):
        try:
            picture = row["image"] or {}
            name = picture.get("path") or f"row {number}"
            label = label_of(Row(where, number, columns, _cells(row, names, name)), camera)
            image = decode_image(picture.get("bytes") or b"", f"{where}: line {number}: {name}")
        except InputError as error:
            tell(Refusal(number, str(error)))
        else:
            yield image, label


def _undecoded() -> Any:
    """The feature of a picture that is left as its bytes: a damaged one must not end the stream."""
    import datasets

    return datasets.Image(decode=False)


def _cells(row: Mapping[str, Any], names: list[str], image: str) -> tuple[str, ...]:
    """The row as a CSV would hold it."""
    return tuple(image if name == "image" else _cell(row[name]) for name in names)


def _cell(value: Any) -> str:
    missing = value is None or (isinstance(value, float) and math.isnan(value))
    return "" if missing else str(value).strip()
