"""A world on a Dask cluster of two worker processes, one of which is killed: the same bytes as here."""

from __future__ import annotations

import signal
import socket
import subprocess
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("distributed")

from gsvis.errors import BackendError
from gsvis.jobs.cluster import connect
from gsvis.jobs.graph import Task, run_graph
from gsvis.jobs.objects import open_store
from gsvis.world.prepare import prepare_world
from tests.jobs.small_tasks import HERE, tree
from tests.pvs.test_cluster import scheduler, two_workers  # noqa: F401  fixtures
from tests.world import cities

Processes = list[subprocess.Popen[bytes]]


def test_a_dead_worker_of_a_cluster_costs_only_its_task(scheduler: str, two_workers: Processes, tmp_path: Path) -> None:  # noqa: F811
    slow = [Task(t.name, t.run if t.needs else f"{HERE}:slow", {**t.params, "seconds": 0.5}, t.needs) for t in tree(8)]
    here = run_graph(slow, open_store(tmp_path / "here"))
    with connect(scheduler) as workers:
        done = threading.Event()

        def kill() -> None:
            notes = tmp_path / "there" / "notes"
            while not done.is_set() and not (notes.is_dir() and any(notes.iterdir())):
                time.sleep(0.02)
            two_workers[0].send_signal(signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        there = run_graph(slow, open_store(tmp_path / "there"), workers)
        done.set()
        killer.join()
    assert {name: result.digest for name, result in there.items()} == {n: r.digest for n, r in here.items()}
    assert two_workers[0].wait(timeout=60) == -signal.SIGKILL


def test_a_cluster_gives_the_same_world(scheduler: str, two_workers: Processes, tmp_path: Path) -> None:  # noqa: F811
    scenes, config = [cities.write(cities.street(), tmp_path / "s.ply")], cities.config(most=2000)
    prepare_world(scenes, tmp_path / "here.gsworld", config)
    with connect(scheduler) as workers:
        prepare_world(scenes, tmp_path / "there.gsworld", config, store=str(tmp_path / "shared"), workers=workers)
    assert cities.content(tmp_path / "there.gsworld") == cities.content(tmp_path / "here.gsworld")


def test_a_scheduler_that_says_nothing_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.jobs.cluster._SLACK", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(BackendError, match="no Dask scheduler answers"), connect(address, timeout=0.5):
            pass


def test_a_server_that_is_no_scheduler_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as strange:

        def talk() -> None:
            with strange.accept()[0] as found:
                found.sendall(b"\xff" * 64)  # a message of 2^64 - 1 bytes
                found.recv(1 << 16)

        threading.Thread(target=talk, daemon=True).start()
        address = f"tcp://127.0.0.1:{strange.getsockname()[1]}"
        with pytest.raises(BackendError, match="answers at"), connect(address, timeout=2.0):
            pass


def test_a_scheduler_that_cannot_be_reached_is_one_line() -> None:
    with (
        pytest.raises(BackendError, match=r"no Dask scheduler answers at tcp://127.0.0.1:1 within"),
        connect("tcp://127.0.0.1:1", timeout=1.0),
    ):
        pass
