"""The same job on a Dask cluster of two real worker processes, one of which is killed in the middle."""

from __future__ import annotations

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
from gsvis.scene.procedural import two_rooms
from gsvis.visibility.build import build_pvs
from gsvis.visibility.cells import CellGrid
from gsvis.visibility.cluster import check_address, connect
from gsvis.visibility.pvs import PvsConfig

CONFIG = PvsConfig(size=24, max_viewpoints=8)
QUIET = {**os.environ, "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "critical"}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def started(*words: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]]
    return subprocess.Popen(command, env=QUIET, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """A scheduler without workers."""
    port = free_port()
    process = started("dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard", "--no-show")
    try:
        yield f"tcp://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


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

    with Client(scheduler, set_as_default=False, timeout=20) as client:
        client.wait_for_workers(2, timeout=30)
    with connect(scheduler) as workers:
        assert workers.count == 2
        path = tmp_path / "cluster.pvs"
        build_pvs(made.gaussians, grid, made.navigable, path, CONFIG, workers=workers, progress=kill_one).close()
    assert killed
    assert two_workers[0].wait(timeout=10) == -signal.SIGKILL
    build_pvs(made.gaussians, grid, made.navigable, tmp_path / "here.pvs", CONFIG).close()
    assert path.read_bytes() == (tmp_path / "here.pvs").read_bytes()


def test_a_scheduler_without_workers_is_told(scheduler: str) -> None:
    deadline = time.monotonic() + 20
    while True:
        with pytest.raises(BackendError) as caught, connect(scheduler, timeout=1.0):
            raise AssertionError("not reached")
        if "has no worker" in str(caught.value) or time.monotonic() > deadline:
            break
    assert f"start some with `dask worker {scheduler}`" in str(caught.value)


def test_a_scheduler_that_does_not_answer_is_told() -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    with (
        pytest.raises(BackendError, match=r"no Dask scheduler answers at tcp.* within 0.5 s"),
        connect(address, timeout=0.5),
    ):
        raise AssertionError("not reached")


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(BackendError, match=r"pip install 'gsvis\[cluster\]'"), connect("tcp://127.0.0.1:1"):
        raise AssertionError("not reached")


@pytest.mark.parametrize("bad", ["", "10.0.0.5:8786", "http://x:1", "tcp://", "tcp://x", "tcp://x:port", "tcp://a b:1"])
def test_addresses_are_checked(bad: str) -> None:
    with pytest.raises(ValueError, match="scheduler: expected an address such as"):
        check_address(bad)


def test_an_address_may_be_a_number_of_the_new_kind() -> None:
    assert check_address("tcp://[::1]:8786") == "tcp://[::1]:8786"
