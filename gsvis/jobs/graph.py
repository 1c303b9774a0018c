"""Graphs of pure tasks named by content. The same graph runs here, on processes, on any executor, and on Dask.

A task is a function, JSON values, and the results of other tasks. Its key is the hash of these, so a result is found
again wherever it was made, and equal inputs end in equal bytes. Results lie in an `ObjectStore`: workers read and write
it themselves, and only keys and small facts go through a scheduler. A note under the key is written last: it is the
journal. docs/design/058-graphs-of-tasks.md has the reasons.
"""

from __future__ import annotations

import hashlib
import heapq
import json
import logging
import os
import platform
import re
import shutil
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

from gsvis.errors import ArgumentError, BackendError, FormatError, OutputError
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import DAMAGED
from gsvis.jobs.cost import IDLE, memory_error, needed_memory
from gsvis.jobs.crew import Crew
from gsvis.jobs.objects import ObjectStore, StoredObject, open_store
from gsvis.jobs.processes import limit_threads, one_at_a_time
from gsvis.jobs.task_folder import forget_work, work_folder
from gsvis.jobs.workers import Workers
from gsvis.progress import Progress, silent

__all__ = ["TOO_LARGE", "Given", "Job", "Result", "Task", "machine_kind", "perform", "run_graph"]

TOO_LARGE = "raise it, or use fewer workers or smaller tiles"
"""What to do about a task that does not fit the memory."""

Facts = dict[str, Any]

_log = logging.getLogger(__name__)
_DIGEST = re.compile("[0-9a-f]{64}")
_MOST_BYTES = 1 << 50


@dataclass(frozen=True)
class Task:
    """A pure task.

    Attributes:
        name: Name for people, different from all others of the graph.
        run: Function, as `module:name`. Its module has a version for it in `VERSIONS`, of JSON values; change it if
            results change. It may declare the memory of the function in `MEMORY`, see `jobs.cost`.
        params: JSON values.
        needs: Names of the tasks whose results it reads, in order.
    """

    name: str
    run: str
    params: Facts = field(default_factory=dict)
    needs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Result:
    """What a task left.

    Attributes:
        files: Its files: name and object.
        facts: Small JSON values that it returned.
        seconds: Time that it took where it ran.
        cpu: Processor time that it took there.
        peak: Most bytes of memory that its process had used by then; 0 if unknown.
    """

    files: dict[str, StoredObject]
    facts: Facts
    seconds: float = 0.0
    cpu: float = 0.0
    peak: int = 0

    @cached_property
    def digest(self) -> str:
        """Hash of the content: files and facts."""
        return _hash([sorted((name, *stored) for name, stored in self.files.items()), self.facts])

    def to_json(self) -> bytes:
        """Return the bytes of a note."""
        return json.dumps(asdict(self), sort_keys=True, allow_nan=False).encode()

    @classmethod
    def from_json(cls, data: bytes) -> Result:
        """Return the result of a note.

        Raises:
            FormatError: If it is none.
        """
        said = parse_object("a note", data)
        files = said.child("files")
        facts = said.child("facts")
        stored = {name: _stored(files, name) for name in files.value}
        seconds = said.number("seconds")
        cpu = said.number("cpu")
        if min(seconds, cpu) < 0.0:
            raise FormatError("a note", "seconds", "seconds >= 0", f"{seconds:g}, {cpu:g}", DAMAGED)
        found = cls(stored, facts.value, seconds, cpu, said.integer("peak", 0, _MOST_BYTES))
        try:
            _ = found.digest
        except ValueError as error:
            raise FormatError("a note", "facts", "finite numbers", str(error), DAMAGED) from error
        return found


@dataclass(frozen=True)
class Job:
    """A task as it is sent to a worker.

    Attributes:
        task: The task.
        key: Its key.
        inputs: Results of the tasks that it needs, in order.
        store: Address of the store.
        version: Version of gsvis that sent it.
        machine: Kind of processor that the results are for.
        max_memory: Bytes that the worker may use beside the others; None sets no limit. Decides no result.
    """

    task: Task
    key: str
    inputs: tuple[Result, ...]
    store: str
    version: str
    machine: str
    max_memory: int | None = None


class Given:
    """The inputs of a running task.

    Args:
        store: The store.
        inputs: The results of the tasks that it needs, in order.
        cache: Folder for copies of remote objects.
        max_memory: Bytes that the task may use; None sets no limit.

    Attributes:
        inputs: The results.
        max_memory: The limit.
    """

    def __init__(
        self, store: ObjectStore, inputs: tuple[Result, ...], cache: Path, max_memory: int | None = None
    ) -> None:
        self._store = store
        self.inputs = inputs
        self._cache = cache
        self.max_memory = max_memory

    def __len__(self) -> int:
        return len(self.inputs)

    def path(self, number: int, name: str) -> Path:
        """Return the path of a file of an input, with its content checked; do not write to it.

        Raises:
            FormatError: If it is missing or damaged.
        """
        return self._store.path_of(self.inputs[number].files[name], self._cache)


Run = Callable[[Facts, Given, Path, Path], Facts]
"""The function of a task: `run(params, given, out, work)` writes files into `out` and returns facts.

`work` is a folder that a killed attempt leaves to the next one.
"""


@cache
def machine_kind() -> str:
    """Return what the bytes of results depend on between processors: architecture, vector width, fused multiply-add."""
    from llvmlite.binding import get_host_cpu_features

    features = get_host_cpu_features()
    width = next((name for name in ("avx512f", "avx2", "avx", "sve", "neon") if features.get(name)), "base")
    return f"{platform.machine()} {width}{' fma' if features.get('fma') else ''}"


def key_of(task: Task, inputs: Iterable[Result], machine: str) -> str:
    """Return the key of a task: the hash of everything that decides its result."""
    module, name = task.run.split(":")
    versions = _version(), import_module(module).VERSIONS[name]
    return _hash([task.run, versions, task.params, [each.digest for each in inputs], machine])


def perform(job: Job) -> Result:
    """Run a task where it is called, and leave its result in the store; called in the worker.

    Raises:
        BackendError: If this is another version of gsvis or another kind of processor.
    """
    _check_worker(job)
    store = open_store(job.store)
    with work_folder(store, job.key) as work, one_at_a_time:
        found = find_result(store, job.key)  # of a worker that was given up and still ended
        return _perform(job, store, work) if found is None else found


def _perform(job: Job, store: ObjectStore, work: Path) -> Result:
    """Run a task in its folder, and leave its result in the store."""
    module, name = job.task.run.split(":")
    run: Run = getattr(import_module(module), name)
    began = time.perf_counter()
    cpu = time.process_time()
    limit_threads()
    out = work / "out"
    cached = work / "cache"
    kept = work / "kept"
    shutil.rmtree(out, ignore_errors=True)
    for folder in (out, cached, kept):
        folder.mkdir(parents=True, exist_ok=True)
    facts = run(dict(job.task.params), Given(store, job.inputs, cached, job.max_memory), out, kept)
    paths = sorted(path for path in out.rglob("*") if path.is_file())
    files = {path.relative_to(out).as_posix(): store.put(path) for path in paths}
    facts = json.loads(json.dumps(facts, allow_nan=False))
    result = Result(files, facts, time.perf_counter() - began, time.process_time() - cpu, _peak_memory())
    store.keep_note(f"{job.key}.json", result.to_json())
    return result


def find_result(store: ObjectStore, key: str) -> Result | None:
    """Return the result that a store has under a key; None if it has none, or a file of it is missing or cut."""
    data = store.note(f"{key}.json")
    try:
        found = None if data is None else Result.from_json(data)
    except FormatError:
        return None
    return found if found is not None and all(store.has(stored) for stored in found.files.values()) else None


def run_graph(
    tasks: Iterable[Task],
    store: ObjectStore,
    workers: Workers | None = None,
    *,
    stage: str = "tasks",
    progress: Progress = silent,
) -> dict[str, Result]:
    """Run all tasks that have no result yet, and return all results by name.

    If a task fails, those that do not need it go on; then the first error is raised. The next run takes up what is
    finished. With more than one worker, a script that calls this needs an `if __name__ == "__main__":` guard.

    Args:
        tasks: The tasks, each after those that it needs.
        store: Where results lie, on this machine and on all workers.
        workers: The workers; None means this process.
        stage: Name of the progress stage.
        progress: Called with the stage, in tasks.

    Raises:
        OutputError: If a disk is full; at once.
        BackendError: If the workers or the store cannot be used.
        GsvisError: If workers die again and again, or what a task raises.
        ValueError: If a task comes twice, or before one that it needs.
    """
    listed = list(tasks)
    run = _Run(listed, store, workers or Workers(), stage, progress)
    run.all()
    if run.failed:
        first = min(run.failed)
        others = len(run.failed) - 1
        if others:
            _log.warning("%d more tasks of %s failed; the first error follows", others, stage)
        raise run.failed[first]
    return {task.name: run.results[task.name] for task in listed}


class _Run:
    """One run of a graph."""

    def __init__(self, tasks: list[Task], store: ObjectStore, workers: Workers, stage: str, progress: Progress) -> None:
        self.tasks = tasks
        self.store = store
        self.stage = stage
        self.progress = progress
        self.crew = Crew(workers, perform)
        self.limit = workers.max_memory
        self.idle = IDLE * (workers.count + 1 if workers.executor is None and workers.count > 1 else 1)
        self.results: dict[str, Result] = {}
        self.failed: dict[int, Exception] = {}
        self.running: dict[int, int] = {}  # bytes that each running task needs
        self.numbers = {task.name: k for k, task in enumerate(tasks)}
        if len(self.numbers) < len(tasks):
            raise ValueError("tasks: expected different names, got one twice")
        self.needed_by: dict[str, list[int]] = {task.name: [] for task in tasks}
        self.missing = [len(set(task.needs)) for task in tasks]
        for k, task in enumerate(tasks):
            for name in set(task.needs):
                if self.numbers.get(name, k) >= k:
                    raise ValueError(f"tasks: expected {name!r} before {task.name!r}, which needs it")
                self.needed_by[name].append(k)
        self.ready = [k for k, count in enumerate(self.missing) if not count]
        heapq.heapify(self.ready)

    def all(self) -> None:
        """Run everything that can be run.

        Raises:
            OutputError: If a task cannot write its files.
            BackendError: If a worker cannot be used.
        """
        self.progress(self.stage, 0, len(self.tasks))
        with self.crew, closing(self.crew.run(self._next_job, self._put_back)) as finished:
            for number, future in finished:
                del self.running[number]
                try:
                    result = future.result()
                except (OutputError, BackendError):
                    raise
                except Exception as error:
                    self.failed[number] = error
                else:
                    self._finish(number, result)

    def _next_job(self) -> tuple[int, Job] | None:
        """Return a ready task that fits the memory; tasks with a result are finished at once."""
        machine = machine_kind()
        while self.ready:
            number = heapq.heappop(self.ready)
            task = self.tasks[number]
            inputs = tuple(self.results[name] for name in task.needs)
            key = key_of(task, inputs, machine)
            found = find_result(self.store, key)
            if found is not None:
                forget_work(self.store, key)
                self._finish(number, found)
                continue
            need = needed_memory(task.run, task.params, [each.facts for each in inputs])
            most = None
            if self.limit is not None:
                left = self.limit - self.idle - sum(self.running.values())
                if need > left and self.running:
                    heapq.heappush(self.ready, number)  # until a task beside it has finished
                    return None
                if need > left:
                    self.failed[number] = _too_large(task.name, need - left + self.limit, self.limit)
                    continue
                most = left + IDLE
            self.running[number] = need
            return number, Job(task, key, inputs, self.store.address, _version(), machine, most)
        return None

    def _put_back(self, number: int) -> None:
        """Make a task of a lost worker ready again."""
        del self.running[number]
        heapq.heappush(self.ready, number)

    def _finish(self, number: int, result: Result) -> None:
        """Record a result, and make tasks ready that waited for it."""
        name = self.tasks[number].name
        self.results[name] = result
        self.progress(self.stage, len(self.results), len(self.tasks))
        for other in self.needed_by[name]:
            self.missing[other] -= 1
            if not self.missing[other]:
                heapq.heappush(self.ready, other)


def _too_large(name: str, need: int, limit: int) -> ArgumentError:
    """Return the error for a task that needs too much memory."""
    return memory_error(need, limit, f"all workers, one of them with {name}", TOO_LARGE)


def _check_worker(job: Job) -> None:
    """Raise BackendError unless this worker has the version of gsvis and the kind of processor of a job."""
    where = f"a worker on {platform.node()}, process {os.getpid()}"
    if _version() != job.version:
        raise BackendError(f"{where}: expected gsvis {job.version}, as here, got gsvis {_version()}; install it there")
    if machine_kind() != job.machine:
        raise BackendError(
            f"{where}: expected a processor like the one here ({job.machine}), got {machine_kind()}; bytes would"
            " depend on the worker, so use machines of one kind"
        )


@cache
def _version() -> str:
    """Return the version of the installed gsvis."""
    from importlib.metadata import version

    return version("gsvis")


def _peak_memory() -> int:
    """Return the peak bytes of memory of this process; 0 if the system does not report it."""
    try:
        import resource
    except ImportError:
        return 0
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * 1024


def _stored(files: Fields, name: str) -> StoredObject:
    """Return the object of a file; its digest becomes a path, so it is checked."""
    found = files.items(name, 2)
    if not (isinstance(found[0], str) and _DIGEST.fullmatch(found[0]) and type(found[1]) is int and found[1] >= 0):
        raise FormatError(files.path, files.where(name), "a SHA-256 and a size", repr(found)[:80], DAMAGED)
    return found[0], found[1]


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, allow_nan=False).encode()).hexdigest()
