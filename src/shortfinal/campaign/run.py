"""Running a campaign: chunks over processes or over Ray, each written down as soon as it is counted.

The journal, `chunks.jsonl`, is all there is to resume from. Its first line says what is counted and
by which code, each further line is one finished chunk, and a line half written when the power went
is dropped and its chunk counted again.
"""

from __future__ import annotations

import hashlib
import importlib
import itertools
import json
import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from shortfinal.campaign.config import Campaign, Scenario
from shortfinal.campaign.trials import CHUNK, Counts, check_scenario, count_chunk
from shortfinal.errors import InputError, JobError
from shortfinal.files import make_folder

Job = tuple[Scenario, int, int, int, int]  # the arguments of count_chunk
Take = Callable[[int, int, dict[str, Any]], None]  # scenario, chunk, what it counted
Seen = Callable[[int, int], None]  # trials done, of so many


@dataclass(frozen=True)
class Effort:
    """What this run of a campaign took; chunks found in the journal are not its own."""

    trials: int
    seconds: float
    peak_mb: float | None  # memory of the largest process on this machine; None where it is not known


def run_campaign(
    campaign: Campaign,
    out: str | Path,
    *,
    workers: int | None = None,
    ray: str | None = None,
    seen: Seen = lambda done, total: None,
) -> tuple[list[Counts], Effort]:
    """Count all scenarios, from where the journal in `out` ends: the counts of each, and the effort.

    On `workers` processes (default: one per processor; 1: this process), or as tasks on Ray at the
    address `ray` ("local" starts one here). `seen` is called at the start and after each chunk.
    Raises InputError if `out` holds another campaign, a scenario has no pose that shows the runway,
    or Ray is not there; JobError if workers die.
    """
    for scenario in campaign.scenarios:
        check_scenario(scenario)
    journal = _Journal(make_folder(out) / "chunks.jsonl", campaign)
    tallies = [_Tally() for _ in campaign.scenarios]
    done, total = 0, campaign.trials * len(campaign.scenarios)

    def add(index: int, number: int, record: dict[str, Any]) -> None:
        nonlocal done
        tallies[index].add(number, record)
        done += _trials_of(campaign, number)

    def take(index: int, number: int, record: dict[str, Any]) -> None:
        journal.append(index, number, record)
        add(index, number, record)
        seen(done, total)

    with journal.file:
        for index, number, record in journal.read():
            if number not in tallies[index].squares:  # twice there, should two have run at once
                add(index, number, record)
        before, start = done, time.perf_counter()
        seen(done, total)
        jobs = [job for job in _jobs(campaign) if job[3] not in tallies[job[2]].squares]
        if ray is not None:
            _over_ray(jobs, ray, workers, take)
        elif workers == 1 or len(jobs) <= 1:
            for job in jobs:
                take(job[2], job[3], count_chunk(*job))
        else:
            _over_processes(jobs, workers or os.cpu_count() or 1, take)
    return [tally.counts() for tally in tallies], Effort(done - before, time.perf_counter() - start, _peak_mb())


def _jobs(campaign: Campaign) -> Iterator[Job]:
    chunks = math.ceil(campaign.trials / CHUNK)
    for (index, scenario), number in itertools.product(enumerate(campaign.scenarios), range(chunks)):
        yield scenario, campaign.seed, index, number, _trials_of(campaign, number)


def _trials_of(campaign: Campaign, number: int) -> int:
    """How many trials chunk `number` of any scenario has; the last one has what is left."""
    return min(CHUNK, campaign.trials - CHUNK * number)


class _Tally:
    """The sum of a scenario's chunks, the same in whatever order they come."""

    def __init__(self) -> None:
        self.total: Counts | None = None
        self.squares: dict[int, list[float]] = {}  # by the chunk's number

    def add(self, number: int, record: dict[str, Any]) -> None:
        counts = Counts.from_dict(record)
        self.squares[number] = record["squares"]
        if self.total is None:
            self.total = counts
            return
        for field in fields(Counts):
            if field.name != "squares":
                getattr(self.total, field.name)[...] += getattr(counts, field.name)

    def counts(self) -> Counts:
        assert self.total is not None  # as every scenario has a chunk
        sums = [math.fsum(column) for column in zip(*self.squares.values(), strict=True)]
        return replace(self.total, squares=np.array(sums))


class _Journal:
    """The file of finished chunks, appended to line by line, each on the disk before the next."""

    def __init__(self, path: Path, campaign: Campaign) -> None:
        self.path, self.header = path, _header(campaign)
        try:
            self.file = path.open("a+b")
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from error

    def read(self) -> Iterator[tuple[int, int, dict[str, Any]]]:
        """Scenario, chunk and counts of each whole line; begins the file if there is none."""
        self.file.seek(0)
        whole = 0
        for number, line in enumerate(self.file, 1):
            if not line.endswith(b"\n"):
                break
            record = self._parsed(line, number)
            if number == 1:
                self._check(record)
            else:
                yield record["scenario"], record["chunk"], record
            whole += len(line)
        self.file.truncate(whole)
        if whole == 0:
            self._write(self.header)

    def append(self, index: int, number: int, record: dict[str, Any]) -> None:
        self._write({"scenario": index, "chunk": number, **record})

    def _write(self, record: dict[str, Any]) -> None:
        try:
            self.file.write(json.dumps(record, separators=(",", ":")).encode() + b"\n")
            self.file.flush()
            os.fsync(self.file.fileno())
        except OSError as error:
            raise JobError(f"{self.path}: cannot be written: {error.strerror}") from error

    def _parsed(self, line: bytes, number: int) -> dict[str, Any]:
        try:
            return dict(json.loads(line))
        except ValueError as error:
            raise InputError(f"{self.path}: line {number} is damaged; delete the file to begin again") from error

    def _check(self, found: dict[str, Any]) -> None:
        for key, value in self.header.items():
            if found.get(key) != value:
                what = "another version of the code" if key == "code" else f"another campaign: {key} differ"
                raise InputError(f"{self.path.parent}: begun with {what}; choose another --out, or delete it")


def _header(campaign: Campaign) -> dict[str, Any]:
    """What must be the same for chunks to belong together, as JSON has it."""
    record = {"code": _code_digest(), "chunk_trials": CHUNK, **asdict(campaign)}
    return dict(json.loads(json.dumps(record)))


def _code_digest() -> str:
    """Of the sources that may decide what a chunk counts, and of numpy's version, whose generator draws."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256(np.__version__.encode())
    for path in (
        *sorted(package.glob("*.py")),
        *(package / "campaign" / f"{name}.py" for name in ("config", "trials")),
    ):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _over_processes(jobs: list[Job], workers: int, take: Take) -> None:
    # Spawned, not forked: a fork of a process with threads may hang, and would inherit the journal.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), context, _begin_worker) as pool:
        where = {pool.submit(count_chunk, *job): job[2:4] for job in jobs}
        try:
            for future in as_completed(where):
                take(*where.pop(future), future.result())
        except BrokenProcessPool as error:
            raise JobError("a worker died (out of memory?); run the same command again to go on") from error
        finally:
            pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    """Leave Ctrl-C to the parent, and end with it, however it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None  # as this runs in a worker only

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _over_ray(jobs: list[Job], address: str, workers: int | None, take: Take) -> None:
    try:
        ray: Any = importlib.import_module("ray")
    except ImportError as error:
        raise InputError("--ray: Ray is not installed; pip install 'shortfinal[cluster]'") from error
    local: dict[str, Any] = {"num_cpus": workers, "include_dashboard": False} if address == "local" else {}
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", **local)
    except (ConnectionError, ValueError) as error:
        raise InputError(f"--ray: cannot reach {address!r}: {error}") from error
    try:
        _feed(ray, jobs, take)
    except ray.exceptions.RayError as error:
        raise JobError(f"Ray: {error}; run the same command again to go on") from error
    finally:
        ray.shutdown()


def _feed(ray: Any, jobs: list[Job], take: Take) -> None:
    """Keep every processor of the cluster busy, and no more results waiting than that takes."""
    task, waiting = ray.remote(count_chunk), iter(jobs)
    ahead = 2 * int(ray.cluster_resources().get("CPU", 1))
    running = {task.remote(*job): job[2:4] for job in itertools.islice(waiting, ahead)}
    while running:
        (finished,), _ = ray.wait(list(running))
        take(*running.pop(finished), ray.get(finished))
        running |= {task.remote(*job): job[2:4] for job in itertools.islice(waiting, 1)}


def _peak_mb() -> float | None:
    try:
        import resource
    except ImportError:  # on Windows
        return None
    workers, own = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_CHILDREN, resource.RUSAGE_SELF))
    return max(workers, own) / 1024
