"""The same job on a Dask cluster of two real worker processes, one of which is killed in the middle."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gsvis.errors import BackendError
from gsvis.jobs.cluster import check_address, connect
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.scene.procedural import two_rooms
from tests import warm_start

CONFIG = PvsConfig(size=24, limit=0.05, rays=128, max_inner=1)
GUARD = 300.0  # seconds until a hang is a failure
QUIET = {**os.environ, "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "critical"}


def started(*words: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]]
    return warm_start.Popen(command, env=QUIET, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """A scheduler without workers: one for each test, as it remembers workers for a while after they are gone."""
    found = tmp_path / "scheduler.json"  # written once it listens
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show", "--scheduler-file", str(found)]
    process = started("dask_scheduler", *options)
    try:
        yield address_in(found, process)
    finally:
        process.kill()
        process.wait()


def address_in(file: Path, process: subprocess.Popen[bytes]) -> str:
    """The address that a scheduler writes into its file."""
    deadline = time.monotonic() + GUARD
    while time.monotonic() < deadline:
        assert process.poll() is None, "the scheduler ended"
        with contextlib.suppress(FileNotFoundError, ValueError):  # not there yet, or half of it
            return str(json.loads(file.read_text())["address"])
        time.sleep(0.05)
    raise AssertionError("the scheduler hangs")


@pytest.fixture
def two_workers(scheduler: str, tmp_path: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Two workers in processes of their own, without nannies: a killed one stays dead."""
    options = ["--no-nanny", "--nthreads", "1", "--no-dashboard", "--local-directory", str(tmp_path / "dask")]
    processes = [started("dask_worker", scheduler, *options) for _ in range(2)]
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_a_cluster_gives_the_same_bytes_even_if_a_worker_dies(
    scheduler: str, two_workers: list[subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    from distributed import Client

    made = two_rooms(2000, sh_degree=1)
    grid = CellGrid.over(made.navigable, max_cells=16)
    killed: list[int] = []

    def kill_one(stage: str, done: int, total: int) -> None:
        if stage == "cells" and done == 3:
            two_workers[0].send_signal(signal.SIGKILL)
            killed.append(done)

    with Client(scheduler, set_as_default=False, timeout=GUARD) as client:
        client.wait_for_workers(2, timeout=GUARD)
    with connect(scheduler, timeout=GUARD) as workers:
        assert workers.count == 2
        path = tmp_path / "cluster.pvs"
        build_pvs(made.gaussians, grid, made.navigable, path, CONFIG, workers=workers, progress=kill_one).close()
    assert killed
    assert two_workers[0].wait(timeout=GUARD) == -signal.SIGKILL
    build_pvs(made.gaussians, grid, made.navigable, tmp_path / "here.pvs", CONFIG).close()
    assert path.read_bytes() == (tmp_path / "here.pvs").read_bytes()


def test_a_scheduler_without_workers_is_reported(scheduler: str) -> None:
    for timeout in (1.0, 4.0, 16.0, 64.0):  # a slow scheduler answers late, and then it is asked once more
        with pytest.raises(BackendError) as caught, connect(scheduler, timeout=timeout):
            raise AssertionError("not reached")
        if "has no worker" in str(caught.value):
            break
    assert f"start some with `dask worker {scheduler}`" in str(caught.value)


def test_a_scheduler_that_does_not_answer_is_reported() -> None:
    with (
        socket.socket() as silent,
        pytest.raises(BackendError, match=r"no Dask scheduler answers at tcp.* within 0.5 s"),
        connect(bound_to(silent), timeout=0.5),
    ):
        raise AssertionError("not reached")


def bound_to(sock: socket.socket) -> str:
    """The address of a socket that nobody else can take and nobody listens on."""
    sock.bind(("127.0.0.1", 0))
    return f"tcp://127.0.0.1:{sock.getsockname()[1]}"


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(BackendError, match=r'pip install "gsvis\[cluster\]"'), connect("tcp://127.0.0.1:1"):
        raise AssertionError("not reached")


@pytest.mark.parametrize("bad", ["", "10.0.0.5:8786", "http://x:1", "tcp://", "tcp://x", "tcp://x:port", "tcp://a b:1"])
def test_addresses_are_checked(bad: str) -> None:
    with pytest.raises(ValueError, match="scheduler: expected an address such as"):
        check_address(bad)


def test_an_address_may_be_a_number_of_the_new_kind() -> None:
    assert check_address("tcp://[::1]:8786") == "tcp://[::1]:8786"
