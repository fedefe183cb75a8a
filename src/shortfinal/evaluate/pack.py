"""The evidence pack's manifest: what was evaluated, on which data, by which code, with which result.

Every file goes by its SHA-256, so that others can check the pack. It holds no absolute path, user or host.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

from shortfinal.errors import InputError, JobError
from shortfinal.evaluate.card import Evidence, without_card
from shortfinal.evaluate.requirements import passed
from shortfinal.files import read_json, sha256_of, write_whole

FORMAT = 1
MANIFEST = "manifest.json"
PICTURES = "pictures.sha256"  # as `sha256sum --check` reads it
EVALUATION = "evaluation.json"
PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "onnxruntime", "pymap3d", "matplotlib", "pyarrow")


def write_manifest(
    out: str | Path,
    evidence: Evidence,
    *,
    subject: str | Path,
    data: str | Path,
    labels: Iterable[str | Path],
    pictures: Iterable[str | Path] = (),
    requirements: str | Path | None = None,
    seeds: Mapping[str, int] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Write manifest.json into `out`, last of all: it lists every file that is there. Returns its path.

    `subject` is the model or the file of predictions, `labels` and `pictures` are the files that were read, named
    relative to the folder `data` (or of the file `data`); one outside goes by its name alone. Pictures are digested
    one by one into pictures.sha256, and `progress` is told how many are done; those that are not there are counted
    and named. Raises InputError where a file cannot be read or written, JobError if `subject` is no longer what was
    evaluated.
    """
    out, root = Path(out), _folder(Path(data))
    content = _subject(Path(subject), evidence)
    its_data = {
        **{name: evidence["data"][name] for name in ("name", "format", "sha256")},
        "labels": [_file(path, _name(path, root)) for path in sorted(Path(p) for p in labels)],
        "pictures": _list_pictures(out, root, pictures, progress),
    }
    manifest = {
        "format": FORMAT,
        **{name: evidence[name] for name in ("title", "created")},
        "subject": content,
        "data": its_data,
        "requirements_file": None if requirements is None else _file(Path(requirements), Path(requirements).name),
        "code": _code(evidence["version"]),
        "environment": _environment(),
        "settings": evidence["settings"],
        "seeds": dict(sorted((seeds or {}).items())),
        "counts": evidence["counts"],
        "notes": evidence["notes"],
        "passed": None if evidence["requirements"] is None else passed(evidence["requirements"]),
        "requirements": evidence["requirements"],
        "metrics": evidence["metrics"],
        "files": [_file(path, name) for name, path in _files_in(out)],
    }
    write_whole(out / MANIFEST, json.dumps(manifest, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    return out / MANIFEST


def verify_manifest(
    path: str | Path,
    *,
    subject: str | Path | None = None,
    data: str | Path | None = None,
    requirements: str | Path | None = None,
) -> list[str]:
    """What no longer matches a manifest, one line each; nothing: everything does.

    The files beside the manifest are always checked, and that its figures are those of evaluation.json; the model or
    predictions, the folder of the data and the requirements where they are given. Raises InputError if the manifest
    cannot be read as one. A manifest is not signed: whoever can change the files can write another.
    """
    path = Path(path)
    manifest = read_json(path, "manifest")
    try:
        return list(_mismatches(path.parent, manifest, subject, data, requirements))
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not a manifest of format {FORMAT}; expected one that `evaluate` wrote") from error


def _mismatches(
    folder: Path, manifest: Any, subject: str | Path | None, data: str | Path | None, requirements: str | Path | None
) -> Iterator[str]:
    if manifest["format"] != FORMAT:
        raise KeyError("format")
    for entry in manifest["files"]:
        yield from _mismatch(folder, entry)
    if any(entry["file"] == EVALUATION for entry in manifest["files"]) and (folder / EVALUATION).is_file():
        evidence = read_json(folder / EVALUATION, "evaluation")
        for name in ("metrics", "requirements", "settings", "counts", "notes"):
            if manifest[name] != evidence.get(name):
                yield f"{MANIFEST}: its {name} are not those of {EVALUATION}"
    if subject is not None:
        yield from _subject_mismatch(Path(subject), manifest["subject"])
    if requirements is not None:
        if manifest["requirements_file"] is None:
            yield f"{Path(requirements).name}: no requirements were used"
        else:
            yield from _mismatch(
                Path(requirements).parent, {**manifest["requirements_file"], "file": Path(requirements).name}
            )
    if data is not None:
        root = _folder(Path(data))
        for entry in manifest["data"]["labels"]:
            yield from _mismatch(root, entry)
        if manifest["data"]["pictures"] and (folder / PICTURES).is_file():
            for line in (folder / PICTURES).read_text(encoding="utf-8").splitlines():
                yield from _mismatch(root, _parsed(line))


def _mismatch(folder: Path, entry: Mapping[str, str]) -> Iterator[str]:
    name = entry["file"]
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        yield f"{name}: not a name within the folder"
    elif not (folder / name).is_file():
        yield f"{name}: missing"
    elif _digest(folder / name)[0] != entry["sha256"]:
        yield f"{name}: changed"


def _subject_mismatch(path: Path, told: Mapping[str, Any]) -> Iterator[str]:
    """The file that was evaluated is as good as the same with a card in it."""
    if not (told["kind"] == "model" and path.is_file() and _bare_digest(path) == told["sha256_without_card"]):
        yield from _mismatch(path.parent, {**told, "file": path.name})


def _bare_digest(path: Path) -> str:
    return hashlib.sha256(without_card(path.read_bytes())).hexdigest()


def _subject(path: Path, evidence: Evidence) -> dict[str, Any]:
    told = evidence["subject"]
    digest, size = _digest(path)
    if digest != told["sha256"]:
        raise JobError(f"{path}: changed since it was evaluated; evaluate it again")
    content = {"kind": told["kind"], "name": told["name"], "sha256": digest, "bytes": size, "sigma": told["sigma"]}
    if told["kind"] == "model":
        # The same whether a card is in the file or not: by this a file with a card is known as what was evaluated.
        content["sha256_without_card"] = _bare_digest(path)
    return content


def _list_pictures(
    out: Path, root: Path, pictures: Iterable[str | Path], progress: Callable[[int], None] | None
) -> dict[str, Any] | None:
    """The list of pictures, written to `out`, and its digest; None if there are none."""
    lines, missing, total = [], [], 0
    for done, path in enumerate(sorted({Path(p) for p in pictures}), 1):
        name = _name(path, root)
        if path.is_file():
            digest, size = _digest(path)
            lines.append(_line(digest, name))
            total += size
        else:
            missing.append(name)
        if progress:
            progress(done)
    (out / PICTURES).unlink(missing_ok=True)  # of an earlier evaluation into the same folder
    if not lines and not missing:
        return None
    content = "".join(lines).encode()
    write_whole(out / PICTURES, content)
    digest = hashlib.sha256(content).hexdigest()
    return {
        "count": len(lines), "bytes": total, "sha256": digest, "list": PICTURES,
        "missing": len(missing), "missing_names": missing[:100],
    }  # fmt: skip


def _line(digest: str, name: str) -> str:
    r"""As sha256sum writes it: a name with a line break or backslash is escaped, and the line begins with one."""
    escaped = name.replace("\\", "\\\\").replace("\n", "\\n").replace("\r", "\\r")
    return f"{'' if escaped == name else chr(92)}{digest}  {escaped}\n"


def _parsed(line: str) -> dict[str, str]:
    digest, _, name = line.partition("  ")
    if digest.startswith("\\"):
        digest = digest[1:]
        name = re.sub(r"\\(.)", lambda found: {"n": "\n", "r": "\r"}.get(found[1], found[1]), name)
    return {"file": name, "sha256": digest}


def _folder(path: Path) -> Path:
    return path if path.is_dir() else path.parent


def _name(path: str | Path, root: Path) -> str:
    """Relative to the folder; of a file outside its name alone, as the way there is nobody's business."""
    try:
        return Path(path).resolve().relative_to(root.resolve()).as_posix()
    except ValueError:
        return Path(path).name


def _files_in(out: Path) -> list[tuple[str, Path]]:
    found = ((path.relative_to(out).as_posix(), path) for path in out.rglob("*") if path.is_file())
    return sorted((name, path) for name, path in found if name != MANIFEST)


def _file(path: Path, name: str) -> dict[str, Any]:
    digest, size = _digest(path)
    return {"file": name, "sha256": digest, "bytes": size}


def _digest(path: Path) -> tuple[str, int]:
    """SHA-256 and size, however large the file is."""
    return sha256_of([path]), path.stat().st_size


def _code(package_version: str) -> dict[str, Any]:
    """What computed it: the version, a digest of the package's modules, and the commit if they are in a checkout."""
    package = Path(__file__).resolve().parents[1]
    modules = sorted((path.relative_to(package).as_posix(), path) for path in package.rglob("*.py"))
    digest = hashlib.sha256("".join(_line(_digest(path)[0], name) for name, path in modules).encode()).hexdigest()
    # A package that is merely installed somewhere within a repository is none of its files.
    tracked = _git(package, "ls-files", "--error-unmatch", "__init__.py") is not None
    commit = _git(package, "rev-parse", "HEAD") if tracked else None
    changes = _git(package, "status", "--porcelain", "--", ".") if tracked else None
    return {
        "package": "shortfinal", "version": package_version, "sha256": digest,
        "commit": commit, "dirty": None if changes is None else bool(changes),
    }  # fmt: skip


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _environment() -> dict[str, Any]:
    return {
        "python": platform.python_version(), "implementation": platform.python_implementation(),
        "system": platform.system(), "machine": platform.machine(), "cpus": os.cpu_count(),
        "packages": {name: _version(name) for name in PACKAGES},
    }  # fmt: skip


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
