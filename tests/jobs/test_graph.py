"""Graphs of tasks: the same results on every executor, what a kill leaves, and workers that die, wait or do not fit."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from gsvis.errors import BackendError, FormatError, GsvisError, OutputError
from gsvis.jobs import graph
from gsvis.jobs.cost import IDLE
from gsvis.jobs.graph import Task, machine_kind, run_graph
from gsvis.jobs.objects import open_store
from gsvis.jobs.workers import Workers
from gsvis.prepare.stages import VERSIONS as STAGES
from gsvis.world import packages, tiles
from tests.jobs.small_tasks import HERE, tree

HANG_S = 300.0
TOTAL = "(((leaf 0 leaf 1) (leaf 2 leaf 3)) ((leaf 4 leaf 5) (leaf 6 leaf 7)))"


def content(folder: Path) -> dict[str, bytes]:
    """The objects of a store, and the keys of its notes."""
    objects = {path.name: path.read_bytes() for path in (folder / "objects").rglob("*") if path.is_file()}
    return objects | {path.name: b"" for path in (folder / "notes").iterdir()}


@pytest.fixture(scope="module")
def wanted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("wanted")
    found = run_graph(tree(8), open_store(folder))
    assert found[TOTAL].facts == {"value": 28}
    return content(folder)


@pytest.fixture(params=["threads", "processes"])
def workers(request: pytest.FixtureRequest, warm_processes: None) -> Iterator[Workers]:
    if request.param == "processes":
        yield Workers(2)
        return
    with ThreadPoolExecutor(3) as executor:
        yield Workers(3, executor=executor)


def test_every_executor_gives_the_same_bytes(workers: Workers, wanted: dict[str, bytes], tmp_path: Path) -> None:
    assert run_graph(tree(8), open_store(tmp_path), workers)[TOTAL].facts == {"value": 28}
    assert content(tmp_path) == wanted


def test_what_is_finished_is_not_done_again(tmp_path: Path) -> None:
    log, store = tmp_path / "log", open_store(tmp_path / "store")
    run_graph(tree(8, log), store)
    run_graph(tree(8, log), store)
    assert log.stat().st_size == 15
    changed = tree(8, log)
    changed[3] = Task(changed[3].name, changed[3].run, {"value": 9, "log": str(log)})
    assert run_graph(changed, store)[TOTAL].facts == {"value": 34}
    assert log.stat().st_size == 15 + 4


def test_equal_results_cut_off_the_rest(tmp_path: Path) -> None:
    log, store = tmp_path / "log", open_store(tmp_path / "store")
    run_graph(tree(4, log), store)
    changed = tree(4, log)
    changed[0] = Task(changed[0].name, f"{HERE}:slow", {"value": 0, "seconds": 0.0, "log": str(log)})
    run_graph(changed, store)
    assert log.stat().st_size == 7 + 1


@pytest.mark.parametrize("damage", ["cut", "other", "gone", "note"])
def test_damaged_objects_are_made_again(damage: str, tmp_path: Path) -> None:
    store = open_store(tmp_path)
    before = run_graph(tree(4), store)
    digest, _ = before["(leaf 0 leaf 1)"].files["number"]
    path = tmp_path / "objects" / digest[:2] / digest
    if damage == "note":
        for note in (tmp_path / "notes").iterdir():
            note.write_bytes(note.read_bytes()[:-1])
    elif damage == "gone":
        path.unlink()
    else:
        path.write_bytes(b"" if damage == "cut" else b"7")
    again = Task("reader", f"{HERE}:join", {}, ("(leaf 0 leaf 1)",))
    if damage == "other":  # found when it is read; then it is gone and the next run makes it again
        with pytest.raises(FormatError, match=r"content that fits its name.*run the same again"):
            run_graph([*tree(4), again], store)
    assert run_graph([*tree(4), again], store)["reader"].facts == {"value": 1}


def test_a_failed_task_stops_only_what_needs_it(tmp_path: Path) -> None:
    tasks = tree(4)
    tasks[0] = Task(tasks[0].name, f"{HERE}:fail")
    store = open_store(tmp_path)
    with pytest.raises(FormatError, match="tile 7: expected a whole one, got a damaged one"):
        run_graph(tasks, store)
    assert len(list((tmp_path / "notes").iterdir())) == 4  # three leaves and one pair


def test_a_full_disk_stops_at_once_and_keeps_what_is_finished(tmp_path: Path) -> None:
    tasks = tree(4)
    tasks[2] = Task(tasks[2].name, f"{HERE}:fill")
    with pytest.raises(OutputError, match="no space left"):
        run_graph(tasks, open_store(tmp_path))
    assert len(list((tmp_path / "notes").iterdir())) == 2
    assert run_graph(tree(4), open_store(tmp_path))["((leaf 0 leaf 1) (leaf 2 leaf 3))"].facts == {"value": 6}


def test_a_dead_process_is_replaced_and_its_work_is_found(tmp_path: Path) -> None:
    params = {"tries": str(tmp_path / "tries"), "deaths": 2}
    tasks = [*tree(2), Task("victim", f"{HERE}:die", params)]
    found = run_graph(tasks, open_store(tmp_path / "store"), Workers(2))
    assert found["victim"].facts == {"value": 1}  # the third attempt found what the others had left
    assert (tmp_path / "tries").stat().st_size == 3
    assert not list((tmp_path / "store" / "work").iterdir())


def test_processes_that_die_again_and_again_end_with_one_line(tmp_path: Path) -> None:
    task = Task("victim", f"{HERE}:die", {"tries": str(tmp_path / "tries"), "deaths": 99})
    with pytest.raises(GsvisError, match=r"workers died again and again.*what is finished is kept"):
        run_graph([task], open_store(tmp_path / "store"), Workers(2))


def test_a_slow_worker_holds_up_nothing_else(tmp_path: Path) -> None:
    tasks = [Task("slow", f"{HERE}:count", {"value": 1}), *tree(4)]
    with _SlowWorker(2, others=len(tasks) - 1) as executor:
        run_graph(tasks, open_store(tmp_path), Workers(2, executor=executor))
        assert executor.is_last


class _SlowWorker(ThreadPoolExecutor):
    """Keeps the task named slow, outside of the lock that tasks hold for kernels, until all others have ended."""

    def __init__(self, workers: int, others: int) -> None:
        super().__init__(workers)
        self.is_last = False
        self._left = others
        self._others_ended = threading.Event()

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        if args[0].task.name == "slow":
            return super().submit(self._wait_then_run, fn, *args)
        future = super().submit(fn, *args, **kwargs)
        future.add_done_callback(self._count)
        return future

    def _count(self, _: Future[Any]) -> None:
        self._left -= 1
        if not self._left:
            self._others_ended.set()

    def _wait_then_run(self, fn: Callable[..., Any], *args: Any) -> Any:
        self.is_last = self._others_ended.wait(HANG_S)
        return fn(*args)


def test_another_version_or_processor_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = graph.Job(tree(2)[0], "0" * 64, (), str(tmp_path), "0.0.1", machine_kind())
    with pytest.raises(BackendError, match=r"expected gsvis 0\.0\.1, as here, got gsvis"):
        graph.perform(job)
    job = graph.Job(tree(2)[0], "0" * 64, (), str(tmp_path), graph._version(), "m68k base")
    with pytest.raises(BackendError, match="a processor like the one here"):
        graph.perform(job)
    here = graph.key_of(tree(2)[0], (), machine_kind())
    assert here != graph.key_of(tree(2)[0], (), "m68k base")
    monkeypatch.setattr("tests.jobs.small_tasks.VERSIONS", {"count": 2})
    assert here != graph.key_of(tree(2)[0], (), machine_kind())
    monkeypatch.undo()
    monkeypatch.setattr(graph, "_version", lambda: "0.0.1")  # what another release has made is not mixed in
    assert here != graph.key_of(tree(2)[0], (), machine_kind())


def test_the_version_of_a_task_names_those_of_the_stages_that_it_runs() -> None:
    assert STAGES["levels"] in tiles.VERSIONS["make_tile_levels"]
    assert {name for each in packages.VERSIONS["prepare_tile"] if isinstance(each, dict) for name in each} | {
        "levels"
    } == set(STAGES)


def test_a_result_that_a_slow_worker_has_left_meanwhile_is_taken(tmp_path: Path) -> None:
    log, (task, *_) = tmp_path / "log", tree(2, tmp_path / "log")
    job = graph.Job(task, "0" * 64, (), str(tmp_path / "store"), graph._version(), machine_kind())
    assert graph.perform(job) == graph.perform(job)
    assert log.stat().st_size == 1
    assert not list((tmp_path / "store" / "work").iterdir())


def test_wrong_graphs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="got one twice"):
        run_graph([*tree(2), *tree(2)], open_store(tmp_path))
    with pytest.raises(ValueError, match="before"):
        run_graph(tree(2)[::-1], open_store(tmp_path))


SCRIPT = """
import sys
from gsvis.jobs.objects import open_store
from gsvis.jobs.graph import run_graph
from tests.jobs.small_tasks import HERE, Task, tree
tasks = [Task(t.name, t.run if t.needs else HERE + ":slow", {**t.params, "seconds": 0.02}, t.needs) for t in tree(8)]
run_graph(tasks, open_store(sys.argv[1]))
"""


def test_kills_at_random_moments_change_no_byte(tmp_path: Path) -> None:
    def start(folder: Path) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", SCRIPT, str(folder)])

    whole = tmp_path / "whole"
    assert start(whole).wait() == 0
    rng, killed = random.Random(5), tmp_path / "killed"
    done = 0
    for _ in range(8):
        process = start(killed)
        deadline = time.monotonic() + HANG_S
        while not (killed / "notes").is_dir() and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.01)
        time.sleep(0.15 * rng.random())
        process.send_signal(signal.SIGKILL)
        process.wait()
        finished = sum(1 for path in (killed / "notes").iterdir() if path.name[:1] != ".")
        assert finished >= done
        done = finished
    assert start(killed).wait() == 0
    assert {k: v for k, v in content(killed).items() if k[:1] != "."} == content(whole)


def test_tasks_that_do_not_fit_together_run_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graph, "needed_memory", lambda run, params, inputs: 100)
    beside = list[int]()

    class Counting(ThreadPoolExecutor):
        """Notes how many tasks run when another one comes."""

        running = list[Future[Any]]()

        def submit(self, *given: Any) -> Future[Any]:
            beside.append(sum(not each.done() for each in self.running))
            self.running.append(super().submit(*given))
            return self.running[-1]

    for room, most in ((150, 0), (250, 1)):
        beside.clear()
        with Counting(3) as executor:
            workers = Workers(3, executor=executor, max_memory=IDLE + room)
            found = run_graph(tree(8), open_store(tmp_path / str(room)), workers)
        assert found[TOTAL].facts == {"value": 28}
        assert len(beside) == 15
        assert max(beside) <= most
    with pytest.raises(ValueError, match=r"max_memory: expected at least .* one of them with leaf 0, got .*; raise it"):
        run_graph(tree(8), open_store(tmp_path / "small"), Workers(1, max_memory=IDLE + 50))
