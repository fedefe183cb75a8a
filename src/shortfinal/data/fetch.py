"""Data sets fetched over HTTP: LARD v1 (a Dataverse), LARD v2 (the Hugging Face hub), OurAirports' tables.

`list_files` asks the service what there is, `fetch_files` brings it, `unpack_archives` unpacks it.
Any of them may be killed and run again, and goes on where it stopped.

The bytes come through one downloader, for two reasons found in the libraries that could have done
it. huggingface_hub (2.4.0) resumes a dropped connection, but a new process starts the file anew,
and it compares sizes, not checksums. pooch (1.9.0) hands its downloader a fresh temporary file each
time. So the hub's library lists the files, and signs in; here each file grows beside its name, by
HTTP ranges, and takes its name when its checksum is the published one.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import stat
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING, Any, NoReturn, TypeVar

from shortfinal.errors import InputError, JobError
from shortfinal.files import make_folder, partial_of

if TYPE_CHECKING:
    from requests import Response, Session

T = TypeVar("T")
Progress = Callable[[int], None]  # of bytes done since the last call; negative: they were in vain

DATAVERSE = "https://entrepot.recherche.data.gouv.fr"
LARD_V1 = "doi:10.57745/MZSH2Y"
LARD_V2 = "DEEL-AI/LARD_V2"
LARD_V2_SUBSETS = ("ges", "arcgis", "bingmaps", "xplane", "flsim")
OURAIRPORTS = "https://davidmegginson.github.io/ourairports-data"

_CHUNK = 1 << 18
_COPIES = 3  # fetched with a wrong checksum before giving up
_LONGEST_WAIT_S = 300.0
_STAMP = ".unpacked"  # in an unpacked folder: the checksum of its archive


@dataclass(frozen=True)
class Patience:
    """How long to bear with a server."""

    timeout_s: float = 30.0  # of silence, after which a connection is given up
    attempts: int = 6  # in a row that bring no new byte
    pause_s: float = 1.0  # before the second attempt; doubled before each further one


PATIENCE = Patience()


@dataclass(frozen=True)
class RemoteFile:
    """A file of a data set, as its publisher describes it."""

    path: str  # under the data set's folder; with /
    url: str
    size: int | None = None  # bytes
    checksum: str = ""  # "md5:...", "sha256:..." and so on; "git:..." is git's of a blob; nothing: not published
    head: bytes = b""  # how the content begins, where there is no checksum

    @property
    def is_archive(self) -> bool:
        """Whether it is to be unpacked."""
        return self.path.lower().endswith(".zip")


@dataclass(frozen=True)
class Listing:
    """What is to be fetched from one service."""

    files: tuple[RemoteFile, ...]
    headers: Mapping[str, str] = field(default_factory=dict, repr=False)  # they may hold an access token

    @property
    def size(self) -> int:
        """Bytes of all files; those of unknown size are not counted."""
        return sum(f.size or 0 for f in self.files)

    @property
    def archives(self) -> tuple[RemoteFile, ...]:
        """The files to unpack."""
        return tuple(f for f in self.files if f.is_archive)


def list_files(
    name: str, *, url: str | None = None, subsets: Sequence[str] = (), patience: Patience = PATIENCE
) -> Listing:
    """What the data set "lard-v1", "lard-v2" or "ourairports" consists of, with sizes and checksums.

    `url` is the service's address, if not the public one. `subsets` picks parts: of LARD v2 those of
    LARD_V2_SUBSETS; of LARD v1 the archives whose names hold such a word ("BIRK", "test"). Files that
    belong to no part come along. Raises InputError for an unknown name, part or address, or where the
    service wants a sign-in; JobError if it does not answer.
    """
    services = {"lard-v1": _list_lard_v1, "lard-v2": _list_lard_v2, "ourairports": _list_ourairports}
    if name not in services:
        raise InputError(f"data set {name!r}: unknown; there are {', '.join(services)}")
    try:
        import huggingface_hub  # noqa: F401
        import requests  # noqa: F401
    except ImportError as error:
        raise InputError(f"fetching needs the package {error.name}: pip install 'shortfinal[data]'") from error
    listing = services[name](url, [s.lower() for s in subsets], patience)
    paths = {_inside(file.path, file.url): file for file in listing.files}
    if len(paths) < len(listing.files):
        raise JobError(f"{name}: the service lists one name twice; tell its publishers")
    return listing


def fetch_files(
    listing: Listing,
    folder: str | Path,
    *,
    progress: Progress | None = None,
    patience: Patience = PATIENCE,
    workers: int = 4,
) -> list[Path]:
    """Bring all files of a listing into the folder, each whole and with its checksum or not at all.

    Files that are there with the right checksum stay; a file begun before goes on. `progress` hears of
    `listing.size` bytes in all. Raises InputError if the disk has no room, or an address or a
    permission is wrong; JobError if the server fails for longer than `patience`, or keeps sending
    something else than was published. What has come stays for the next call.
    """
    target = make_folder(folder)
    _check_room(listing, target)
    fetcher = _Fetcher(listing.headers, patience, progress)
    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(fetcher.fetch, file, target) for file in listing.files]
        try:
            for future in as_completed(futures):
                future.result()
        except BaseException:
            fetcher.stop.set()
            pool.shutdown(cancel_futures=True)
            raise
    return [future.result() for future in futures]


# The services


def _list_lard_v1(url: str | None, subsets: Sequence[str], patience: Patience) -> Listing:
    """Dataverse's native API: the files of the record's latest version."""
    base = (url or DATAVERSE).rstrip("/")
    address = f"{base}/api/datasets/:persistentId/?persistentId={LARD_V1}"
    answer = _Fetcher({}, patience, None).json(address)
    try:
        files = [_dataverse_file(entry, base) for entry in answer["data"]["latestVersion"]["files"]]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise JobError(f"{address}: not a Dataverse's list of files ({error!r}); check the address") from error
    archives = [f for f in files if f.is_archive]
    for subset in subsets:
        if not any(subset in _words(f.path) for f in archives):
            raise InputError(f"subset {subset!r}: in no archive's name; there are {_names(f.path for f in archives)}")
    chosen = (f for f in files if not subsets or not f.is_archive or _words(f.path) & set(subsets))
    return Listing(tuple(chosen))


def _dataverse_file(entry: Mapping[str, Any], base: str) -> RemoteFile:
    """One file. A table that Dataverse has converted is taken as it was uploaded, whose checksum it does not tell."""
    file = entry["dataFile"]
    folder = entry.get("directoryLabel") or ""
    url = f"{base}/api/access/datafile/{int(file['id'])}"
    if "originalFileName" in file:
        name, size, checksum = file["originalFileName"], file.get("originalFileSize"), ""
        url += "?format=original"
    else:
        name, size = file["filename"], file.get("filesize")
        given = file.get("checksum") or {"type": "MD5", "value": file["md5"]}
        checksum = f"{given['type'].lower().replace('-', '')}:{given['value']}".lower()
    return RemoteFile(f"{folder}/{name}" if folder else name, url, None if size is None else int(size), checksum)


def _list_lard_v2(url: str | None, subsets: Sequence[str], patience: Patience) -> Listing:
    """The hub's tree at its newest commit, to which all addresses are tied."""
    unknown = set(subsets) - set(LARD_V2_SUBSETS)
    if unknown:
        raise InputError(f"subset {min(unknown)!r}: unknown; there are {', '.join(LARD_V2_SUBSETS)}")
    from huggingface_hub import get_token, hf_hub_url

    commit, entries = _hub_tree(url, patience)
    wanted = set(subsets or LARD_V2_SUBSETS)
    files = []
    for entry in entries:
        parts = _words(entry.path) & set(LARD_V2_SUBSETS)
        if parts and not parts & wanted:
            continue
        address = hf_hub_url(LARD_V2, entry.path, repo_type="dataset", revision=commit, endpoint=url)
        checksum = f"sha256:{entry.lfs.sha256}" if entry.lfs else f"git:{entry.blob_id}"
        files.append(RemoteFile(entry.path, address, entry.size, checksum))
    token = get_token()
    return Listing(tuple(files), {"Authorization": f"Bearer {token}"} if token else {})


def _hub_tree(url: str | None, patience: Patience) -> tuple[str, list[Any]]:
    """The newest commit, and the files of its tree."""
    from huggingface_hub import HfApi
    from huggingface_hub.hf_api import RepoFile

    api = HfApi(endpoint=url)
    where = f"{api.endpoint}/datasets/{LARD_V2}"

    def newest() -> str:
        with _hub_errors(where):
            return str(api.dataset_info(LARD_V2, timeout=patience.timeout_s).sha)

    commit = _Fetcher({}, patience, None).persist(newest, where)
    try:
        with _hub_errors(where):
            tree = api.list_repo_tree(LARD_V2, recursive=True, repo_type="dataset", revision=commit)
            return commit, [entry for entry in tree if isinstance(entry, RepoFile)]
    except _AgainError as error:  # the library has tried several times
        raise JobError(f"{where}: {error}; run again later") from error


@contextmanager
def _hub_errors(where: str) -> Iterator[None]:
    """What the hub's library raises, as our own errors."""
    import httpx2
    from huggingface_hub.errors import HfHubHTTPError

    try:
        yield
    except HfHubHTTPError as error:
        _refuse(error.response.status_code, where, error.response.headers)
    except (httpx2.HTTPError, OSError) as error:
        raise _AgainError("cannot be reached, or dropped the connection") from error
    except (KeyError, TypeError, ValueError) as error:
        raise JobError(f"{where}: not the hub's answer ({error!r}); check the address") from error


def _list_ourairports(url: str | None, subsets: Sequence[str], _: Patience) -> Listing:
    """The two tables `find_runway` reads. They change daily, without checksums, so they are always fetched anew."""
    if subsets:
        raise InputError(f"subset {subsets[0]!r}: OurAirports has none")
    base = (url or OURAIRPORTS).rstrip("/")
    return Listing(tuple(RemoteFile(name, f"{base}/{name}", head=b'"id",') for name in ("airports.csv", "runways.csv")))


def _words(path: str) -> set[str]:
    return set(re.split(r"[^a-z0-9]+", path.lower()))


def _names(paths: Iterable[str]) -> str:
    return ", ".join(sorted(paths)) or "no archives"


# Fetching


class _AgainError(Exception):
    """What may pass by itself; `wait_s` is how long the server asks to wait."""

    def __init__(self, reason: str, wait_s: float = 0.0) -> None:
        super().__init__(reason)
        self.wait_s = wait_s


class _StoppedError(Exception):
    """Another file's failure, or the user, has ended the call."""


class _Fetcher:
    """Downloads with patience, from several threads."""

    def __init__(self, headers: Mapping[str, str], patience: Patience, progress: Progress | None) -> None:
        self.stop = threading.Event()
        self._headers, self._patience, self._progress = headers, patience, progress
        self._lock, self._thread = threading.Lock(), threading.local()

    def json(self, url: str) -> Any:
        """A small answer."""
        import requests

        def attempt() -> Any:
            with self._get(url, {}) as response:
                try:
                    return response.json()
                except requests.JSONDecodeError as error:
                    raise JobError(f"{url}: the answer is not JSON; check the address") from error
                except requests.RequestException as error:
                    raise _AgainError(self._reason(error)) from error

        return self.persist(attempt, url)

    def fetch(self, file: RemoteFile, folder: Path) -> Path:
        """One file, whole and checked."""
        target = folder / file.path
        if self._is_there(file, target):
            return target
        make_folder(target.parent)
        partial, fault = partial_of(target), ""
        for _ in range(_COPIES):
            try:
                self._download(file, partial)
                fault = self._fault(file, partial)
                if not fault:
                    partial.replace(target)
                    return target
                self._discard(partial)
            except OSError as error:
                raise InputError(f"{partial}: cannot be written: {error.strerror}; mend that and run again") from error
        raise JobError(f"{file.url}: {fault}, {_COPIES} times over; the server has another file than it publishes")

    def persist(self, attempt: Callable[[], T], url: str, reached: Callable[[], int] = lambda: 0) -> T:
        """Try until it succeeds; `reached` tells how far a failed attempt came."""
        failures, best = 0, reached()
        while True:
            try:
                return attempt()
            except _AgainError as error:
                now = reached()
                failures, best = (0, now) if now > best else (failures + 1, best)
                if failures >= self._patience.attempts:
                    raise JobError(
                        f"{url}: {error}, {failures} times in a row; run again later to go on from here"
                    ) from error
                pause = max(error.wait_s, self._patience.pause_s * 2 ** max(0, failures - 1))
                if self.stop.wait(min(pause, _LONGEST_WAIT_S)):
                    raise _StoppedError from error

    def _is_there(self, file: RemoteFile, target: Path) -> bool:
        if not target.is_file() or (file.size is None and not file.checksum):
            return False
        if file.size is not None and target.stat().st_size != file.size:
            return False
        if not file.checksum:
            self._count(file.size or 0)
            return True
        counted = 0

        def count(n: int) -> None:
            nonlocal counted
            counted += n
            self._count(n)

        if self._checksum(target, file.checksum, count) == file.checksum:
            return True
        self._count(-counted)
        return False

    def _download(self, file: RemoteFile, partial: Path) -> None:
        """Bring the partial file to its full length, going on from what is there."""
        if not file.checksum:  # nothing would show that the halves belong to different files
            partial.unlink(missing_ok=True)
        self._count(_size(partial))
        etag = ""

        def attempt() -> None:
            nonlocal etag
            have = _size(partial)
            if file.size is not None and have >= file.size and partial.exists():
                return
            with self._get(file.url, _range_headers(have if file.checksum or etag else 0, etag)) as response:
                if response.status_code == 416:
                    self._discard(partial)
                    raise _AgainError("has fewer bytes than published")
                before, etag = etag, _strong_etag(response)
                if response.status_code == 206 and (_range_start(response) != have or before not in ("", etag)):
                    self._discard(partial)
                    raise _AgainError("sent a part of another file, or another part, than asked for")
                if response.status_code == 200:
                    self._discard(partial)
                self._write(response, partial, file.size)
            if file.size is not None and _size(partial) < file.size:
                raise _AgainError("ended the file early")

        self.persist(attempt, file.url, lambda: _size(partial))

    def _write(self, response: Response, partial: Path, size: int | None) -> None:
        """Append what comes as it comes, so that a drop costs nothing; stop once it is longer than it may be."""
        import urllib3

        with partial.open("ab") as out:
            while size is None or out.tell() <= size:
                try:
                    chunk = response.raw.read1(_CHUNK)
                except urllib3.exceptions.HTTPError as error:
                    raise _AgainError(self._reason(error)) from error
                if self.stop.is_set():
                    raise _StoppedError
                if not chunk:
                    return
                out.write(chunk)
                self._count(len(chunk))

    def _fault(self, file: RemoteFile, partial: Path) -> str:
        """What is wrong with a file that has come; nothing if it is right."""
        if file.size is not None and _size(partial) != file.size:
            return f"{_size(partial)} bytes came instead of {file.size}"
        if file.checksum:
            found = self._checksum(partial, file.checksum, lambda _: None)
            return "" if found == file.checksum else f"the checksum is {found}, not {file.checksum}"
        with partial.open("rb") as content:
            begin = content.read(len(file.head))
        return "" if begin == file.head else f"the file begins with {begin!r}, not {file.head!r}"

    def _checksum(self, path: Path, like: str, count: Progress) -> str:
        """A file's checksum, of the same kind as another."""
        kind = like.partition(":")[0]
        try:
            digest = hashlib.new("sha1" if kind == "git" else kind, usedforsecurity=False)
        except ValueError as error:
            raise JobError(f"{path.name}: published with an unknown kind of checksum, {kind!r}") from error
        if kind == "git":
            digest.update(f"blob {_size(path)}\0".encode())
        with path.open("rb") as content:
            for chunk in _chunks(content):
                if self.stop.is_set():
                    raise _StoppedError
                digest.update(chunk)
                count(len(chunk))
        return f"{kind}:{digest.hexdigest()}"

    def _get(self, url: str, headers: Mapping[str, str]) -> Response:
        """An answer with content, or 416. Raises _AgainError for what may pass, InputError or JobError otherwise."""
        import requests

        try:
            response = self._session().get(url, headers=dict(headers), stream=True, timeout=self._patience.timeout_s)
        except (
            requests.exceptions.MissingSchema,
            requests.exceptions.InvalidSchema,
            requests.exceptions.InvalidURL,
        ) as e:
            raise InputError(f"{url}: not an address; expected http(s)://...") from e
        except requests.RequestException as error:
            raise _AgainError(self._reason(error)) from error
        if response.status_code not in (200, 206, 416):
            response.close()
            _refuse(response.status_code, url, response.headers)
        return response

    def _session(self) -> Session:
        """Connections kept open, one set per thread."""
        import requests

        if not hasattr(self._thread, "session"):
            self._thread.session = requests.Session()
            self._thread.session.headers.update({"User-Agent": "shortfinal", **self._headers})
        session: Session = self._thread.session
        return session

    def _reason(self, error: Exception) -> str:
        if "timed out" in str(error):
            return f"silent for {self._patience.timeout_s:g} s"
        return "cannot be reached, or dropped the connection"

    def _discard(self, partial: Path) -> None:
        self._count(-_size(partial))
        partial.unlink(missing_ok=True)

    def _count(self, n: int) -> None:
        if self._progress is not None and n:
            with self._lock:
                self._progress(n)


def _refuse(status: int, url: str, headers: Mapping[str, str]) -> NoReturn:
    """Raise what an answer without content means: _AgainError, InputError or JobError."""
    if status in (401, 403):
        raise InputError(
            f"{url}: access refused ({status}); accept the data set's terms on its page and, on the hub, set HF_TOKEN"
        )
    if status in (404, 410):
        raise InputError(f"{url}: not there ({status}); if the data set has moved, pass its new address")
    if status in (408, 425, 429) or status >= 500:
        asked = headers.get("Retry-After", "") or "".join(re.findall(r"\bt=(\d+)", headers.get("RateLimit", "")))
        raise _AgainError(f"answered {status}", float(asked) if asked.isdigit() else 0.0)
    raise JobError(f"{url}: answered {status}, which no server of this data set should; check the address")


def _range_headers(have: int, etag: str) -> dict[str, str]:
    """Ask for the rest, and for the whole if it is no longer the same file; never compressed on the way."""
    headers = {"Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        if etag:
            headers["If-Range"] = etag
    return headers


def _range_start(response: Response) -> int | None:
    found = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
    return int(found[1]) if found else None


def _strong_etag(response: Response) -> str:
    etag: str = response.headers.get("ETag", "")
    return "" if etag.startswith("W/") else etag


def _check_room(listing: Listing, folder: Path) -> None:
    """Refuse if the rest of the files, and the archives' content, would not fit."""
    need = 0
    for file in listing.files:
        size, target = file.size or 0, folder / file.path
        need += max(0, size - max(_size(target), _size(partial_of(target))))
        if file.is_archive and not _folder_of(target).exists():
            need += size
    _refuse_no_room(folder, need)


def _refuse_no_room(folder: Path, need: int) -> None:
    free = shutil.disk_usage(folder).free
    if need > free:
        raise InputError(
            f"{folder}: {need / 1e9:.2f} GB are needed, {free / 1e9:.2f} GB are free; "
            "make room, fetch fewer subsets or choose another folder"
        )


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def _chunks(content: IO[bytes]) -> Iterator[bytes]:
    return iter(lambda: content.read(_CHUNK), b"")


def _inside(name: str, where: str) -> PurePosixPath:
    """A name as a path that stays in its folder. Raises JobError for any other."""
    path = PurePosixPath(name)
    if not path.parts or path.is_absolute() or ".." in path.parts or re.search(r"[\\:\0]", name):
        raise JobError(f"{where}: the name {name!r} leads out of the folder; not to be trusted, nothing was written")
    return path


# Unpacking


def unpack_archives(listing: Listing, folder: str | Path, *, progress: Progress | None = None) -> list[Path]:
    """Unpack each archive of a listing beside itself, into a folder of its name; whole or not at all.

    A folder unpacked from the same archive stays; one begun before goes on. `progress` hears of the
    archives' bytes. Raises JobError for an archive that is damaged or would write outside its folder,
    InputError if another folder is in the way, or the disk has no room.
    """
    count = progress or (lambda _: None)
    return [_unpack(Path(folder) / file.path, file.checksum or f"size:{file.size}", count) for file in listing.archives]


def _unpack(archive: Path, stamp: str, count: Progress) -> Path:
    target = _folder_of(archive)
    if _read_stamp(target) == stamp:
        count(_size(archive))
        return target
    if target.exists() and not _read_stamp(target):
        raise InputError(f"{target}: in the way of what {archive.name} holds; move it away and run again")
    partial = partial_of(target)
    try:
        with _opened(archive) as content:
            members = _checked_members(content, archive)
            if _read_stamp(partial) != stamp:
                shutil.rmtree(partial, ignore_errors=True)
                partial.mkdir()
                (partial / _STAMP).write_text(stamp)
            _refuse_no_room(partial, sum(m.file_size - _size(partial / path) for path, m in members.items()))
            for path, member in members.items():
                _extract(content, member, partial / path)
                count(member.compress_size)
        count(_size(archive) - sum(member.compress_size for member in members.values()))
        shutil.rmtree(target, ignore_errors=True)
        partial.replace(target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}; mend that and run again") from error
    return target


@contextmanager
def _opened(archive: Path) -> Iterator[zipfile.ZipFile]:
    """An archive; whatever is wrong with it is one line."""
    try:
        with zipfile.ZipFile(archive) as content:
            yield content
    # A password or an unknown compression is a RuntimeError, and a broken stream one of three.
    except (zipfile.BadZipFile, RuntimeError, EOFError, zlib.error) as error:
        if isinstance(error, JobError):
            raise
        raise JobError(f"{archive}: damaged ({error}); delete it and run again") from error


def _checked_members(content: zipfile.ZipFile, archive: Path) -> dict[PurePosixPath, zipfile.ZipInfo]:
    """The files of an archive by their path under its folder. An outer folder of the archive's name is left out."""
    files = [member for member in content.infolist() if not member.is_dir()]
    for member in files:
        _inside(member.filename, str(archive))
        if stat.S_ISLNK(member.external_attr >> 16):
            raise JobError(f"{archive}: {member.filename!r} is a link; not to be trusted, nothing was unpacked")
    outer = f"{archive.stem}/"
    skip = len(outer) if all(member.filename.startswith(outer) for member in files) else 0
    members = {PurePosixPath(member.filename[skip:]): member for member in files}
    if len(members) < len(files):
        raise JobError(f"{archive}: damaged (a name stands there twice); delete it and run again")
    return members


def _extract(content: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path) -> None:
    """Write one file, unless it is there."""
    if _size(target) == member.file_size and target.is_file() and _crc(target) == member.CRC:
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    with content.open(member) as source, target.open("wb") as out:
        shutil.copyfileobj(source, out, _CHUNK)


def _crc(path: Path) -> int:
    value = 0
    with path.open("rb") as content:
        for chunk in _chunks(content):
            value = zlib.crc32(chunk, value)
    return value


def _folder_of(archive: Path) -> Path:
    return archive.with_suffix("")


def _read_stamp(folder: Path) -> str:
    with suppress(OSError):
        return (folder / _STAMP).read_text()
    return ""
