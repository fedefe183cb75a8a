"""Files written whole or not at all: beside their name first, then renamed."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shortfinal.errors import InputError


def partial_of(path: Path) -> Path:
    """The temporary name of a file; it keeps the suffix, from which writers tell the format."""
    return path.with_name(f"{path.stem}.partial{path.suffix}")


def write_whole(path: str | Path, content: bytes | str) -> None:
    """Write a file; text as UTF-8. An interrupted call leaves what was there before.

    Raises InputError if the file cannot be written there.
    """
    target = Path(path)
    partial = partial_of(target)
    try:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        partial.replace(target)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise InputError(f"{target}: cannot be written: {error.strerror}") from error


def write_png(path: str | Path, picture: NDArray[np.uint8]) -> None:
    """An RGB picture (h, w, 3) as PNG."""
    import cv2

    write_whole(path, bytes(cv2.imencode(".png", picture[..., ::-1])[1]))


def read_json(path: str | Path, what: str) -> Any:
    """The content of a JSON file; a byte-order mark is let pass. Raises InputError naming the file and `what` it is."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a JSON file: {error}") from error


def read_toml(path: str | Path, what: str) -> dict[str, Any]:
    """The content of a TOML file; a byte-order mark is let pass. Raises InputError naming the file and `what` it is."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # tomllib's own and Unicode's are ValueErrors
        raise InputError(f"{path}: not a TOML file: {error}") from error


def sha256_of(paths: Iterable[Path]) -> str:
    """SHA-256 of the content of files, one after the other. Raises InputError naming the one that cannot be read."""
    digest = hashlib.sha256()
    for path in paths:
        try:
            with path.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    return digest.hexdigest()


def claim(stamp: Path, made_of: Mapping[str, Any], otherwise: str) -> None:
    """Note in a folder what its content follows from, as JSON in `stamp`; a folder of something else is refused.

    Raises InputError that calls what is there `otherwise`.
    """
    text = json.dumps(made_of)
    try:
        there = stamp.read_text(encoding="utf-8") if stamp.exists() else text
    except OSError as error:
        raise InputError(f"{stamp}: cannot be read: {error.strerror}; choose an empty folder") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{stamp}: not a text file; choose an empty folder") from error
    if there != text:
        raise InputError(f"{stamp.parent}: holds {otherwise}; choose an empty folder or the same ones")
    write_whole(stamp, text)


def csv_text(columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """A table with a header line, as text for `write_whole`."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def make_folder(path: str | Path) -> Path:
    """The folder, made if need be. Raises InputError if it cannot be."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot make the output folder: {error.strerror}") from error
    return folder
