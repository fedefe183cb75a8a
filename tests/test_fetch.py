"""Downloads against a real server on this machine that drops, stalls, corrupts, refuses and lies."""

import hashlib
import io
import json
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
import zipfile
from collections import namedtuple
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote

import numpy as np
import pytest

import shortfinal as sf
from shortfinal.cli import main
from shortfinal.data.fetch import (
    LARD_V1,
    LARD_V2,
    Listing,
    Patience,
    RemoteFile,
    fetch_files,
    list_files,
    unpack_archives,
)
from shortfinal.errors import JobError

QUICK = Patience(timeout_s=0.3, attempts=3, pause_s=0.01)
CONTENT = np.random.default_rng(4).bytes(300_000)
COMMIT = "c" * 40

Fault = namedtuple("Fault", "kind at", defaults=(100_000,))
Asked = namedtuple("Asked", "path range if_range authorization")


class Server(ThreadingHTTPServer):
    """Serves `content` by path; of each path the faults in `faults` first, one per request, `always` after them."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server_port}"
        self.content, self.faults, self.always, self.etags, self.links = {}, {}, {}, True, {}
        self.log, self.release = [], threading.Event()

    def handle_error(self, *_):
        """A client that has gone is what the tests are about."""

    def ranges(self, path):
        return [asked.range for asked in self.log if asked.path == path]


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def do_GET(self):
        server, path = self.server, unquote(self.path)
        headers = self.headers
        server.log.append(Asked(path, headers["Range"], headers["If-Range"], headers["Authorization"]))
        waiting = server.faults.get(path, [])
        fault = waiting.pop(0) if waiting else server.always.get(path, Fault(""))
        if isinstance(fault.kind, int):
            self.answer(fault.kind, b"trouble", {"Retry-After": "0"})
            return
        if path in server.links:
            self.answer(302, b"", {"Location": server.links[path]})
            return
        if path not in server.content:
            self.answer(404, b"nothing here", {})
            return
        self.serve(server.content[path], fault)

    def answer(self, status, body, headers):
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def serve(self, content, fault):
        etag = f'"{hashlib.md5(content).hexdigest()}"'
        asked, same = self.headers["Range"], self.headers["If-Range"] in (None, etag)
        begin = int(asked[6:-1]) if asked and same and fault.kind != "no range" else 0
        if begin >= len(content) > 0:
            self.answer(416, b"", {})
            return
        body = content[begin:]
        if fault.kind == "corrupt":
            body = body[:-1] + bytes([body[-1] ^ 1])
        self.send_response(206 if begin else 200)
        if begin:
            start = begin - 1 if fault.kind == "wrong range" else begin
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        if self.server.etags:
            self.send_header("ETag", etag)
        self.send_header("Content-Length", str(len(body) + {"long": 50, "short": -50}.get(fault.kind, 0)))
        self.end_headers()
        self.close_connection = True
        if fault.kind in ("drop", "stall", "slow", "no range"):
            self.wfile.write(body[: fault.at])
            self.wfile.flush()
            if fault.kind == "stall":
                self.server.release.wait(20)
            if fault.kind != "slow":
                if fault.kind == "no range" and fault.at >= len(body):
                    return
                self.connection.shutdown(2)
                return
            for start in range(fault.at, len(body), 2000):
                time.sleep(0.01)
                self.wfile.write(body[start : start + 2000])
        elif fault.kind == "short":
            self.wfile.write(body[:-50])
        else:
            self.wfile.write(body)


@pytest.fixture
def server():
    server = Server()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.release.set()
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def one(server):
    """A listing of one file, with its checksum."""
    server.content["/f"] = CONTENT
    return Listing((remote(server, "/f", CONTENT),))


def remote(server, path, content, name="data/f.bin"):
    return RemoteFile(name, server.url + path, len(content), "md5:" + hashlib.md5(content).hexdigest())


def fetched(listing, folder, **options):
    """The content of the one file, and that nothing else is left in the folder."""
    path = fetch_files(listing, folder, patience=QUICK, **options)[0]
    assert [p for p in folder.rglob("*") if p.is_file()] == [path]
    return path.read_bytes()


def left(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def command(capsys, *arguments):
    """Exit status, standard output, standard error of `shortfinal data fetch`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["shortfinal", "data", "fetch", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
    return end.value.code or 0, *capsys.readouterr()


# The command


def test_the_command_fetches_and_unpacks(server, tmp_path, capsys):
    dataverse(server, {"LARD_train_BIRK_LFST.zip": zipped(PICTURES), "LARD_train_KMSY.zip": b"", "a.csv": b"a"})
    out = tmp_path / "data"
    status, printed, _ = command(capsys, "lard-v1", "--subset", "BIRK", "--url", server.url, "--out", out)
    assert status == 0
    assert "(2 files, 1 of them unpacked)" in " ".join(printed.split())
    assert (out / "LARD_train_BIRK_LFST/images/a.jpg").read_bytes() == PICTURES["images/a.jpg"]
    assert left(out)[-1] == "a.csv"


def test_the_command_fetches_runways_that_can_be_looked_up(server, tmp_path, capsys):
    table = "id,airport_ref,airport_ident,length_ft,width_ft,surface,lighted,closed"
    for end in ("le", "he"):
        table += "".join(f",{end}_{n}" for n in ("ident", "latitude_deg", "longitude_deg", "elevation_ft"))
        table += f",{end}_heading_degT,{end}_displaced_threshold_ft"
    head, *columns = table.split(",")
    server.content["/runways.csv"] = (
        f'"{head}",{",".join(columns)}\n1,2,EGLL,,164,ASP,1,0,09L,51.4775,-0.4850,79,90,,27R,51.4777,-0.4332,78,270,\n'
    ).encode()
    server.content["/airports.csv"] = b'"id",ident,name,iata_code,gps_code,local_code\n2,EGLL,Heathrow,LHR,EGLL,\n'
    status, _, _ = command(capsys, "ourairports", "--url", server.url, "--out", tmp_path / "a")
    assert status == 0
    assert sf.find_runway("LHR/27R", tmp_path / "a").length_m == pytest.approx(3600, abs=10)


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (["lard-v3"], 2, "shortfinal: data set 'lard-v3': unknown; there are lard-v1, lard-v2, ourairports"),
        (["lard-v2", "--subset", "moon"], 2, "shortfinal: subset 'moon': unknown; there are ges"),
        (["lard-v1", "--url", "{url}"], 2, "not there (404)"),
        (["ourairports", "--url", "{url}/html"], 1, "the file begins with b'<html', not"),
    ],
)
def test_the_commands_refusals_are_one_line(server, tmp_path, capsys, arguments, status, line):
    server.content |= {f"/html/{name}.csv": b"<html>" for name in ("airports", "runways")}
    arguments = [a.format(url=server.url) for a in arguments]
    ended, printed, error = command(capsys, *arguments, "--out", tmp_path / "out")
    assert ended == status
    assert line in error
    assert error.count("\n") == 1
    assert "Traceback" not in printed + error


# One file


def test_a_file_comes_whole_and_is_not_fetched_again(server, one, tmp_path):
    done = []
    assert fetched(one, tmp_path, progress=done.append) == CONTENT
    assert sum(done) == one.size == len(CONTENT)
    assert fetched(one, tmp_path, progress=done.append) == CONTENT
    assert sum(done) == 2 * len(CONTENT)
    assert server.ranges("/f") == [None]


def test_a_file_of_the_right_size_but_another_content_is_fetched_again(server, one, tmp_path):
    fetched(one, tmp_path)
    (tmp_path / "data/f.bin").write_bytes(bytes(len(CONTENT)))
    done = []
    assert fetched(one, tmp_path, progress=done.append) == CONTENT
    assert sum(done) == len(CONTENT)
    assert server.ranges("/f") == [None, None]


def test_after_a_drop_only_the_rest_is_asked_for(server, one, tmp_path):
    server.faults["/f"] = [Fault("drop", 100_000), Fault("drop", 50_000)]
    done = []
    assert fetched(one, tmp_path, progress=done.append) == CONTENT
    assert server.ranges("/f") == [None, "bytes=100000-", "bytes=150000-"]
    assert server.log[1].if_range == f'"{hashlib.md5(CONTENT).hexdigest()}"'
    assert sum(done) == len(CONTENT)
    assert min(done) > 0  # nothing came twice


def test_a_stall_is_given_up_after_the_timeout_and_gone_on_from(server, one, tmp_path):
    server.faults["/f"] = [Fault("stall", 100_000)]
    begin = time.monotonic()
    assert fetched(one, tmp_path) == CONTENT
    assert QUICK.timeout_s <= time.monotonic() - begin < 10 * QUICK.timeout_s
    assert server.ranges("/f") == [None, "bytes=100000-"]


def test_a_drop_that_never_ends_is_one_line_and_leaves_what_came(server, one, tmp_path):
    server.faults["/f"] = [Fault("drop", 100_000)]
    server.always["/f"] = Fault("drop", 0)
    with pytest.raises(
        JobError, match=r"/f: cannot be reached, or dropped the connection, 3 times in a row; run again"
    ):
        fetched(one, tmp_path)
    assert left(tmp_path) == ["data/f.partial.bin"]
    assert (tmp_path / "data/f.partial.bin").read_bytes() == CONTENT[:100_000]
    server.always.clear()
    assert fetched(one, tmp_path) == CONTENT
    assert server.ranges("/f")[-1] == "bytes=100000-"


def test_attempts_are_counted_without_progress_only(server, one, tmp_path):
    server.faults["/f"] = [Fault("drop", 10_000)] * 12  # four times what may fail in a row
    assert fetched(one, tmp_path) == CONTENT


def test_a_server_silent_for_good_is_one_line(server, one, tmp_path):
    server.always["/f"] = Fault("stall", 0)
    with pytest.raises(JobError, match=r"silent for 0.3 s, 3 times in a row"):
        fetched(one, tmp_path)


def test_a_server_that_is_not_there_is_one_line(server, tmp_path):
    with pytest.raises(JobError, match="cannot be reached"):
        fetched(Listing((RemoteFile("f", "http://127.0.0.1:9/f", 1, "md5:0"),)), tmp_path)
    with pytest.raises(sf.InputError, match="not an address"):
        fetched(Listing((RemoteFile("f", "no-address", 1, "md5:0"),)), tmp_path)


def test_corrupted_once_is_fetched_again(server, one, tmp_path):
    server.faults["/f"] = [Fault("corrupt")]
    done = []
    assert fetched(one, tmp_path, progress=done.append) == CONTENT
    assert server.ranges("/f") == [None, None]
    assert sum(done) == len(CONTENT)


def test_corrupted_always_is_one_line_and_leaves_nothing(server, one, tmp_path):
    server.always["/f"] = Fault("corrupt")
    with pytest.raises(JobError, match=r"the checksum is md5:\w+, not md5:\w+, 3 times over"):
        fetched(one, tmp_path)
    assert left(tmp_path) == []
    assert len(server.log) == 3


def test_a_file_longer_than_published_is_cut_off_and_refused(server, one, tmp_path):
    server.content["/f"] = CONTENT + bytes(5_000_000)
    done = []
    with pytest.raises(JobError, match=r"bytes came instead of 300000"):
        fetched(one, tmp_path, progress=done.append)
    assert left(tmp_path) == []
    assert sum(done) == 0
    assert sum(n for n in done if n > 0) < 3 * 1_000_000  # three copies, none of 5 MB


def test_a_file_shorter_than_published_is_refused(server, one, tmp_path):
    server.content["/f"] = CONTENT[:-1]
    with pytest.raises(JobError, match=r"(fewer bytes than published|ended the file early), \d times in a row"):
        fetched(one, tmp_path)


@pytest.mark.parametrize(
    ("status", "error", "line"),
    [
        (404, sf.InputError, r"/f: not there \(404\); if the data set has moved, pass its new address"),
        (403, sf.InputError, r"/f: access refused \(403\); accept the data set's terms .* HF_TOKEN"),
        (401, sf.InputError, r"/f: access refused \(401\)"),
        (500, JobError, r"/f: answered 500, 3 times in a row; run again later"),
        (429, JobError, r"/f: answered 429, 3 times in a row"),
        (418, JobError, r"/f: answered 418, which no server of this data set should"),
    ],
)
def test_refusals_are_one_line(server, one, tmp_path, status, error, line):
    server.always["/f"] = Fault(status)
    with pytest.raises(error, match=line) as raised:
        fetched(one, tmp_path)
    assert "\n" not in str(raised.value)
    assert left(tmp_path) == []
    assert len(server.log) == (QUICK.attempts if status in (500, 429) else 1)


@pytest.mark.parametrize("status", [500, 502, 503, 429, 408])
def test_what_passes_by_itself_is_waited_for(server, one, tmp_path, status):
    server.faults["/f"] = [Fault(status), Fault("drop", 100_000), Fault(status)]
    assert fetched(one, tmp_path) == CONTENT
    assert server.ranges("/f")[-1] == "bytes=100000-"


def test_the_server_says_how_long_to_wait(server, one, tmp_path, monkeypatch):
    monkeypatch.setattr(Handler, "answer", waiting(Handler.answer))
    server.faults["/f"] = [Fault(429)]
    begin = time.monotonic()
    assert fetched(one, tmp_path) == CONTENT
    assert time.monotonic() - begin > 1


def waiting(answer):
    return lambda self, status, body, headers: answer(self, status, body, headers | {"Retry-After": "1"})


@pytest.mark.parametrize("lie", ["long", "short"])
def test_a_wrong_content_length_does_no_harm(server, one, tmp_path, lie):
    server.faults["/f"] = [Fault(lie)]
    assert fetched(one, tmp_path) == CONTENT
    # Too long: all bytes were there. Too short: the rest is asked for.
    assert server.ranges("/f") == ([None] if lie == "long" else [None, f"bytes={len(CONTENT) - 50}-"])


def test_a_server_that_ignores_ranges_sends_the_whole_from_the_start(server, one, tmp_path):
    server.faults["/f"] = [Fault("drop", 100_000), Fault("no range", len(CONTENT))]
    done = []
    assert fetched(one, tmp_path, progress=done.append) == CONTENT
    assert server.ranges("/f") == [None, "bytes=100000-"]
    assert sum(done) == len(CONTENT)


def test_ignoring_ranges_and_dropping_at_the_same_byte_comes_to_an_end(server, one, tmp_path):
    server.always["/f"] = Fault("no range", 100_000)
    with pytest.raises(JobError, match="3 times in a row"):
        fetched(one, tmp_path)
    assert len(server.log) == 1 + QUICK.attempts


def test_another_range_than_asked_for_is_not_appended(server, one, tmp_path):
    server.faults["/f"] = [Fault("drop", 100_000), Fault("wrong range")]
    assert fetched(one, tmp_path) == CONTENT
    assert server.ranges("/f") == [None, "bytes=100000-", None]


@pytest.mark.parametrize("etags", [True, False])
def test_a_file_that_changes_between_attempts_is_never_mixed(server, tmp_path, etags):
    """With an ETag the server sends the new file whole; without one, the checksum catches the mixture."""
    server.etags, old = etags, bytes(len(CONTENT))
    server.content["/f"] = old
    server.faults["/f"] = [Fault("drop", 100_000)]
    listing = Listing((remote(server, "/f", CONTENT),))
    (tmp_path / "data").mkdir()
    renewing = threading.Thread(target=renew, args=(server,))
    renewing.start()
    assert fetched(listing, tmp_path) == CONTENT
    renewing.join()
    assert server.ranges("/f") == ([None, "bytes=100000-"] if etags else [None, "bytes=100000-", None])


def renew(server):
    while not server.log:
        time.sleep(0.001)
    server.content["/f"] = CONTENT


def test_without_a_checksum_nothing_is_gone_on_from_an_earlier_call(server, tmp_path):
    """Nothing would show that the two halves belong to different files."""
    server.content["/f"] = CONTENT
    (tmp_path / "f.partial.bin").write_bytes(bytes(1000))
    (tmp_path / "f.bin").write_bytes(b"yesterday's")
    listing = Listing((RemoteFile("f.bin", server.url + "/f", head=CONTENT[:5]),))
    assert fetched(listing, tmp_path) == CONTENT
    assert server.ranges("/f") == [None]


def test_without_a_checksum_the_beginning_is_looked_at(server, tmp_path):
    server.content["/f"] = b"<html>sign in to this network</html>"
    listing = Listing((RemoteFile("f.csv", server.url + "/f", head=b'"id",'),))
    with pytest.raises(JobError, match=r"the file begins with b'<html', not b'\"id\",', 3 times over"):
        fetched(listing, tmp_path)
    assert left(tmp_path) == []


def test_an_empty_file(server, tmp_path):
    server.content["/f"] = b""
    assert fetched(Listing((remote(server, "/f", b""),)), tmp_path) == b""


def test_no_room_is_one_line_before_anything_is_asked_for(server, one, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=299_999))
    with pytest.raises(sf.InputError, match=r"0.00 GB are needed, 0.00 GB are free; make room"):
        fetched(one, tmp_path)
    assert server.log == []
    (tmp_path / "data").mkdir()
    (tmp_path / "data/f.partial.bin").write_bytes(CONTENT[:1])  # what is there needs no room
    assert fetched(one, tmp_path) == CONTENT


def test_a_folder_that_cannot_be_made_is_one_line(one, tmp_path):
    (tmp_path / "data").write_text("a file")
    with pytest.raises(sf.InputError, match="cannot make"):
        fetch_files(one, tmp_path, patience=QUICK)


def test_a_kill_in_the_middle_is_gone_on_from(server, one, tmp_path):
    server.faults["/f"] = [Fault("slow", 60_000)]
    script = f"""
import sys
from pathlib import Path
from shortfinal.data.fetch import *
fetch_files(Listing(({one.files[0]!r},)), Path(sys.argv[1]))
"""
    partial = tmp_path / "data/f.partial.bin"
    with subprocess.Popen([sys.executable, "-c", script, str(tmp_path)]) as process:
        deadline = time.monotonic() + 30
        while not (partial.exists() and partial.stat().st_size >= 60_000):
            assert time.monotonic() < deadline
            assert process.poll() is None
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    have = partial.stat().st_size
    assert 0 < have < len(CONTENT)
    assert left(tmp_path) == ["data/f.partial.bin"]
    done = []
    assert fetched(one, tmp_path, progress=done.append) == CONTENT
    assert server.ranges("/f") == [None, f"bytes={have}-"]
    assert sum(done) == len(CONTENT)


def test_many_files_and_one_that_fails_ends_the_call(server, tmp_path):
    files = []
    for k in range(40):
        server.content[f"/{k}"] = CONTENT[k : 2000 + k]
        files.append(remote(server, f"/{k}", server.content[f"/{k}"], f"{k}.bin"))
    server.always["/20"] = Fault(404)
    with pytest.raises(sf.InputError, match="/20: not there"):
        fetch_files(Listing(tuple(files)), tmp_path, patience=QUICK)
    server.always.clear()
    done = []
    paths = fetch_files(Listing(tuple(files)), tmp_path, patience=QUICK, progress=done.append)
    assert [p.read_bytes() for p in paths] == [CONTENT[k : 2000 + k] for k in range(40)]
    assert sum(done) == 80_000
    assert len(server.log) <= 40 + 1 + 2 * 4  # the failed one, and what four threads were at, are asked for again


def test_the_users_interrupt_ends_all_downloads_at_once(server, tmp_path):
    server.content["/f"] = CONTENT
    server.always["/f"] = Fault("slow", 1000)
    files = tuple(remote(server, "/f", CONTENT, f"{k}.bin") for k in range(8))
    calls = []

    def interrupt(_):
        calls.append(1)
        if len(calls) == 20:
            raise KeyboardInterrupt

    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        fetch_files(Listing(files), tmp_path, progress=interrupt)
    assert time.monotonic() - begin < 1.5  # of 1.5 s and more that two rounds of four would take
    assert all("partial" in name for name in left(tmp_path))


# The services


def dataverse(server, files, **extra):
    """Answer as a Dataverse does, for files {name: content}."""
    entries = []
    for number, (name, content) in enumerate(files.items()):
        folder, _, label = name.rpartition("/")
        server.content[f"/api/access/datafile/{number}"] = content
        md5 = hashlib.md5(content).hexdigest()
        file = {"id": number, "filename": label, "filesize": len(content), "md5": md5}
        file["checksum"] = {"type": "MD5", "value": md5.upper()}
        entries.append({"label": label, "restricted": False, "dataFile": file | extra.get(label, {})})
        if folder:
            entries[-1]["directoryLabel"] = folder
    record = f"/api/datasets/:persistentId/?persistentId={LARD_V1}"
    server.content[record] = json.dumps({"status": "OK", "data": {"latestVersion": {"files": entries}}}).encode()
    return record


def zipped(files, outer=""):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(outer + name, content)
    return packed.getvalue()


PICTURES = {"images/a.jpg": CONTENT[:70_000], "images/b.jpg": CONTENT[70_000:150_000], "test.csv": b"image;x_A\n" * 99}


def test_lard_v1_is_listed_fetched_and_unpacked(server, tmp_path):
    files = {
        "LARD_train.csv": b"image;height\n",
        "LARD_train_BIRK_LFST.zip": zipped(PICTURES, "LARD_train_BIRK_LFST/"),
        "tests/LARD_test_synth.zip": zipped(PICTURES),
    }
    dataverse(server, files)
    listing = list_files("lard-v1", url=server.url + "/", patience=QUICK)
    assert {f.path: f.size for f in listing.files} == {name: len(content) for name, content in files.items()}
    paths = fetch_files(listing, tmp_path, patience=QUICK)
    assert [p.read_bytes() for p in paths] == list(files.values())
    done = []
    folders = unpack_archives(listing, tmp_path, progress=done.append)
    assert folders == [tmp_path / "LARD_train_BIRK_LFST", tmp_path / "tests/LARD_test_synth"]
    for folder in folders:  # with or without an outer folder in the archive
        assert {name: (folder / name).read_bytes() for name in PICTURES} == PICTURES
    assert sum(done) == sum(file.size for file in listing.archives)


def test_lard_v1_in_part(server):
    files = {"readme.txt": b"", "LARD_train_BIRK_LFST.zip": b"", "LARD_train_KMSY.zip": b"", "LARD_test_real.zip": b""}
    dataverse(server, files)

    def chosen(*subsets):
        return [f.path for f in list_files("lard-v1", url=server.url, subsets=subsets, patience=QUICK).files]

    assert chosen("birk") == ["readme.txt", "LARD_train_BIRK_LFST.zip"]
    assert chosen("train") == ["readme.txt", "LARD_train_BIRK_LFST.zip", "LARD_train_KMSY.zip"]
    assert chosen() == list(files)
    with pytest.raises(sf.InputError, match=r"subset 'lfpo': in no archive's name; there are LARD_test_real.zip"):
        chosen("BIRK", "LFPO")


def test_a_table_that_dataverse_converted_comes_as_it_was_uploaded(server, tmp_path):
    """Its checksum is published for the conversion only."""
    uploaded = b"image;height;width\na.jpg;1024;1024\n"
    extra = {"train.tab": {"originalFileName": "train.csv", "originalFileSize": len(uploaded)}}
    dataverse(server, {"train.tab": b"image\theight\twidth\n"}, **extra)
    server.content["/api/access/datafile/0?format=original"] = uploaded
    listing = list_files("lard-v1", url=server.url, patience=QUICK)
    assert [p.name for p in fetch_files(listing, tmp_path, patience=QUICK)] == ["train.csv"]
    assert (tmp_path / "train.csv").read_bytes() == uploaded
    fetch_files(listing, tmp_path, patience=QUICK)
    assert len(server.ranges("/api/access/datafile/0?format=original")) == 1
    (tmp_path / "train.csv").rename(tmp_path / "train.partial.csv")  # of another version, for all one knows
    fetch_files(listing, tmp_path, patience=QUICK)
    assert server.ranges("/api/access/datafile/0?format=original") == [None, None]


@pytest.mark.parametrize(
    ("answer", "error", "line"),
    [
        (b"<html>", JobError, "the answer is not JSON; check the address"),
        (b"{}", JobError, "not a Dataverse's list of files"),
        (b"[]", JobError, "not a Dataverse's list of files"),
        (b'{"data": {"latestVersion": {"files": [{"dataFile": {}}]}}}', JobError, "not a Dataverse's list"),
        (None, sf.InputError, r"not there \(404\)"),
    ],
)
def test_a_wrong_address_of_the_record_is_one_line(server, answer, error, line):
    if answer is not None:
        server.content[f"/api/datasets/:persistentId/?persistentId={LARD_V1}"] = answer
    with pytest.raises(error, match=line) as raised:
        list_files("lard-v1", url=server.url, patience=QUICK)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("fault", [Fault("stall", 10), Fault("drop", 10), Fault(503)])
def test_listing_is_as_patient_as_fetching(server, fault):
    server.faults[dataverse(server, {"a.csv": b"a"})] = [fault]
    assert len(list_files("lard-v1", url=server.url, patience=QUICK).files) == 1


@pytest.mark.parametrize("name", ["../f", "/etc/f", "a/../../f", "a\\..\\f", "C:f"])
def test_a_name_that_leads_out_of_the_folder_is_refused(server, name):
    record = dataverse(server, {"f": b""})
    answer = json.loads(server.content[record])
    answer["data"]["latestVersion"]["files"][0]["dataFile"]["filename"] = name
    server.content[record] = json.dumps(answer).encode()
    with pytest.raises(JobError, match="leads out of the folder"):
        list_files("lard-v1", url=server.url, patience=QUICK)


def test_the_names_of_data_sets_and_subsets(server):
    with pytest.raises(sf.InputError, match="data set 'lard': unknown; there are lard-v1, lard-v2, ourairports"):
        list_files("lard")
    with pytest.raises(sf.InputError, match="subset 'google': unknown; there are ges, arcgis"):
        list_files("lard-v2", subsets=["google"])
    with pytest.raises(sf.InputError, match="OurAirports has none"):
        list_files("ourairports", subsets=["ges"])


def test_ourairports(server, tmp_path):
    server.content |= {"/airports.csv": b'"id","ident"\n', "/runways.csv": b'"id","airport_ref"\n'}
    listing = list_files("ourairports", url=server.url)
    assert [p.name for p in fetch_files(listing, tmp_path, patience=QUICK)] == ["airports.csv", "runways.csv"]
    fetch_files(listing, tmp_path, patience=QUICK)
    assert len(server.log) == 4  # they change daily


# LARD v2


@pytest.fixture
def hub(server, monkeypatch):
    """The hub's API as huggingface_hub 2.4 uses it: newest commit, tree in pages, files behind a redirection."""
    pytest.importorskip("huggingface_hub")
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    files = {
        "README.md": b"# LARD V2\n",
        "metadata_ges_train.csv": b"image;height\n",
        "images/ges/KATL/1.jpg": CONTENT[:5000],
        "xplane/train-00000-of-00001.parquet": CONTENT,
        "flsim/test-00000-of-00001.parquet": CONTENT[5000:],
    }
    server.content[f"/api/datasets/{LARD_V2}"] = json.dumps({"id": LARD_V2, "sha": COMMIT}).encode()
    entries = [{"type": "directory", "oid": "0" * 40, "size": 0, "path": "xplane"}]
    for name, content in files.items():
        blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
        entries.append({"type": "file", "oid": blob, "size": len(content), "path": name})
        if not name.endswith((".md", ".csv")):
            oid = hashlib.sha256(content).hexdigest()
            entries[-1]["lfs"] = {"oid": oid, "size": len(content), "pointerSize": 130}
        # Large files lie at another host: localhost is one, to a client.
        server.links[f"/datasets/{LARD_V2}/resolve/{COMMIT}/{name}"] = f"{server.url}/cdn/{name}".replace(
            "127.0.0.1", "localhost"
        )
        server.content[f"/cdn/{name}"] = content
    tree = f"/api/datasets/{LARD_V2}/tree/{COMMIT}"
    server.content[f"{tree}?recursive=true&expand=false"] = json.dumps(entries).encode()
    server.tree, server.files = f"{tree}?recursive=true&expand=false", files
    return server


def test_lard_v2_is_listed_and_fetched_in_part(hub, tmp_path):
    listing = list_files("lard-v2", url=hub.url, subsets=["ges"], patience=QUICK)
    wanted = ["README.md", "metadata_ges_train.csv", "images/ges/KATL/1.jpg"]
    assert [f.path for f in listing.files] == wanted
    fetch_files(listing, tmp_path, patience=QUICK)
    assert {name: (tmp_path / name).read_bytes() for name in wanted} == {name: hub.files[name] for name in wanted}
    everything = list_files("lard-v2", url=hub.url, patience=QUICK)
    assert [f.path for f in everything.files] == list(hub.files)
    before = len(hub.log)
    fetch_files(everything, tmp_path, patience=QUICK)
    assert sorted(a.path for a in hub.log[before:] if a.path.startswith("/cdn")) == [
        "/cdn/flsim/test-00000-of-00001.parquet",
        "/cdn/xplane/train-00000-of-00001.parquet",
    ]


def test_the_token_goes_to_the_hub_and_no_further(hub, tmp_path):
    listing = list_files("lard-v2", url=hub.url, subsets=["ges"], patience=QUICK)
    assert "hf_secret" not in repr(listing)
    fetch_files(listing, tmp_path, patience=QUICK)
    for asked in hub.log:
        assert asked.authorization == (None if asked.path.startswith("/cdn") else "Bearer hf_secret")


def test_lard_v2_is_gone_on_from_and_checked(hub, tmp_path):
    path = "/cdn/xplane/train-00000-of-00001.parquet"
    hub.faults[path] = [Fault("drop", 100_000), Fault("stall", 1000), Fault("corrupt")]
    hub.faults["/cdn/README.md"] = [Fault("corrupt")]
    listing = list_files("lard-v2", url=hub.url, subsets=["xplane"], patience=QUICK)
    fetch_files(listing, tmp_path, patience=QUICK)
    assert (tmp_path / "xplane/train-00000-of-00001.parquet").read_bytes() == CONTENT
    assert hub.ranges(path) == [None, "bytes=100000-", "bytes=101000-", None]
    assert (tmp_path / "README.md").read_bytes() == hub.files["README.md"]


@pytest.mark.parametrize(
    ("fault", "error", "line"),
    [
        (Fault(404), sf.InputError, r"not there \(404\)"),
        (Fault(403), sf.InputError, r"access refused \(403\)"),
        (Fault(401), sf.InputError, r"(access refused|not there)"),
        (Fault(500), JobError, r"answered 500, 3 times in a row"),
        (Fault("drop", 0), JobError, r"cannot be reached, or dropped the connection, 3 times in a row"),
        (Fault("stall", 0), JobError, r"cannot be reached, or dropped the connection, 3 times in a row"),
    ],
)
def test_the_hubs_refusals_are_one_line(hub, fault, error, line):
    hub.always[f"/api/datasets/{LARD_V2}"] = fault
    with pytest.raises(error, match=line) as raised:
        list_files("lard-v2", url=hub.url, patience=QUICK)
    assert "\n" not in str(raised.value)


def test_an_answer_that_is_not_the_hubs_is_one_line(hub):
    hub.content[hub.tree] = b'[{"type": "file"}]'
    with pytest.raises(JobError, match="not the hub's answer"):
        list_files("lard-v2", url=hub.url, patience=QUICK)


# Unpacking


def archive(folder, content, name="set.zip"):
    """A listing of an archive that lies in the folder."""
    (folder / name).write_bytes(content)
    return Listing((RemoteFile(name, "", len(content), "md5:" + hashlib.md5(content).hexdigest()),))


def test_what_is_unpacked_is_not_unpacked_again(tmp_path):
    listing = archive(tmp_path, zipped(PICTURES))
    unpack_archives(listing, tmp_path)
    picture = tmp_path / "set/images/a.jpg"
    before = picture.stat().st_mtime_ns
    unpack_archives(listing, tmp_path)
    assert picture.stat().st_mtime_ns == before


def test_unpacking_goes_on_with_what_is_missing(tmp_path):
    """As after a kill: one file whole, one cut short, one of the right size but wrong."""
    listing = archive(tmp_path, zipped(PICTURES))
    unpack_archives(listing, tmp_path)
    (tmp_path / "set").rename(tmp_path / "set.partial")
    begun = tmp_path / "set.partial"
    (begun / "images/b.jpg").write_bytes(PICTURES["images/b.jpg"][:1000])
    (begun / "test.csv").write_bytes(bytes(len(PICTURES["test.csv"])))
    before = (begun / "images/a.jpg").stat().st_mtime_ns
    unpack_archives(listing, tmp_path)
    assert {name: (tmp_path / "set" / name).read_bytes() for name in PICTURES} == PICTURES
    assert (tmp_path / "set/images/a.jpg").stat().st_mtime_ns == before
    assert not begun.exists()


def test_a_new_archive_replaces_what_the_old_one_held(tmp_path):
    unpack_archives(archive(tmp_path, zipped({"old.csv": b"1"})), tmp_path)
    unpack_archives(archive(tmp_path, zipped({"new.csv": b"2"})), tmp_path)
    assert left(tmp_path / "set") == [".unpacked", "new.csv"]


def test_the_users_own_folder_is_not_touched(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set/mine.txt").write_text("mine")
    with pytest.raises(sf.InputError, match=r"set: in the way of what set.zip holds; move it away"):
        unpack_archives(archive(tmp_path, zipped(PICTURES)), tmp_path)
    assert left(tmp_path / "set") == ["mine.txt"]


@pytest.mark.parametrize("name", ["../evil", "/tmp/evil", "a/../../evil", "..\\evil", "C:\\evil"])
def test_an_archive_that_would_write_elsewhere_is_refused(tmp_path, name):
    folder = tmp_path / "data"
    folder.mkdir()
    listing = archive(folder, zipped({"good.txt": b"", name: b"evil"}))
    with pytest.raises(JobError, match=r"leads out of the folder; not to be trusted, nothing was written"):
        unpack_archives(listing, folder)
    assert left(tmp_path) == ["data/set.zip"]


def test_an_archive_with_a_link_is_refused(tmp_path):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as content:
        link = zipfile.ZipInfo("link")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        content.writestr(link, "/etc")
    with pytest.raises(JobError, match="'link' is a link; not to be trusted"):
        unpack_archives(archive(tmp_path, packed.getvalue()), tmp_path)
    assert left(tmp_path) == ["set.zip"]


def damaged(kind):
    content = bytearray(zipped(PICTURES))
    if kind == "cut":
        return bytes(content[: len(content) // 2])
    if kind == "flipped":
        content[40_000] ^= 0xFF
    if kind == "encrypted":
        for signature, offset in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
            content[content.index(signature) + offset] |= 1
    if kind == "method":
        for signature, offset in ((b"PK\3\4", 8), (b"PK\1\2", 10)):
            content[content.index(signature) + offset] = 99
    if kind == "empty":
        return b""
    return bytes(content)


@pytest.mark.parametrize("kind", ["cut", "flipped", "encrypted", "method", "empty"])
def test_a_damaged_archive_is_one_line_and_gives_nothing(tmp_path, kind):
    with pytest.raises(JobError, match=r"set.zip: damaged \(.*\); delete it and run again") as raised:
        unpack_archives(archive(tmp_path, damaged(kind)), tmp_path)
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "set").exists()


def test_no_room_to_unpack_is_one_line(tmp_path, monkeypatch):
    listing = archive(tmp_path, zipped({"zeros": bytes(10_000_000)}))  # packed, 10 kB
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=9_999_999))
    with pytest.raises(sf.InputError, match=r"0.01 GB are needed"):
        unpack_archives(listing, tmp_path)
    assert not (tmp_path / "set").exists()
