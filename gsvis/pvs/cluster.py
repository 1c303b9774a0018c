"""Visible sets on a Dask cluster: `with connect("tcp://10.0.0.5:8786") as workers: build_pvs(..., workers=workers)`.

Each worker of the cluster needs gsvis of the same version. The scene travels once; tasks of a worker that dies are
given to others by the scheduler, and to workers that come later. The store is the same, byte by byte, as a local one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from typing import Any

from gsvis._extras import require
from gsvis.errors import BackendError
from gsvis.pvs import _workers
from gsvis.pvs.build import Workers

__all__ = ["check_address", "connect"]

_RETRIES = 2  # of a task that fails with an error; a worker that dies does not count
_PLUGIN = "gsvis-threads"


def check_address(address: str) -> str:
    """The address, if it looks like one of a scheduler.

    Raises:
        ValueError: If it does not.
    """
    if not re.fullmatch(r"(tcp|tls)://(\[[0-9A-Fa-f:.%]+\]|[^\s/:\[\]]+):\d{1,5}", address):
        raise ValueError(f"scheduler: expected an address such as tcp://10.0.0.5:8786, got {address!r}")
    return address


@contextmanager
def connect(address: str, *, timeout: float = 10.0) -> Iterator[Workers]:
    """The workers of a Dask cluster.

    Args:
        address: Of its scheduler, such as `tcp://10.0.0.5:8786`.
        timeout: Seconds to wait for the scheduler, and then for its first worker.

    Yields:
        What `build_pvs` takes as `workers`.

    Raises:
        ValueError: If the address is malformed.
        MissingExtraError: If dask is not installed.
        BackendError: If no scheduler or no worker answers, or a worker lacks this gsvis.
    """
    check_address(address)
    require("a Dask cluster", "dask", "distributed")
    from dask import config
    from distributed import Client
    from distributed.diagnostics.plugin import WorkerPlugin

    class Threads(WorkerPlugin):  # type: ignore[misc]
        """Set the number of threads of kernels in each worker, also in workers that join later."""

        name = _PLUGIN
        idempotent = True

        def setup(self, worker: Any) -> None:
            from gsvis.pvs import _workers

            _workers.use_threads(worker.state.nthreads)

        def teardown(self, worker: Any) -> None:
            from gsvis.pvs import _workers

            _workers.use_threads(None)
            _workers.forget_scene()

    with config.set({"distributed.comm.timeouts.connect": f"{timeout} s"}):
        try:
            client = Client(address, timeout=timeout, set_as_default=False, name="gsvis")
        except OSError as error:
            raise BackendError(
                f"no Dask scheduler answers at {address} within {timeout:g} s: is it running (`dask scheduler`) and"
                " reachable from here?"
            ) from error
    try:
        try:
            client.wait_for_workers(1, timeout=timeout)
        except TimeoutError as error:
            raise BackendError(
                f"the Dask scheduler at {address} has no worker: start some with `dask worker {address}`"
            ) from error
        _check_versions(client)
        client.register_plugin(Threads())
        try:
            yield Workers(
                count=max(1, len(client.nthreads())),
                executor=client.get_executor(pure=False, retries=_RETRIES),
                scatter=lambda scene: client.scatter(scene, broadcast=True, hash=False),
            )
        finally:
            with suppress(Exception):  # a scheduler that has gone must not hide the error that tells it
                client.unregister_worker_plugin(_PLUGIN)
    finally:
        with suppress(Exception):
            client.close()


def _check_versions(client: Any) -> None:
    """Say which workers cannot do this work.

    Raises:
        BackendError: If gsvis is missing on a worker, or is another version there.
    """
    here = version("gsvis")
    found = client.run(_version, on_error="return")
    other = {worker: reported for worker, reported in found.items() if reported != here}
    if other:
        worker, reported = next(iter(other.items()))
        got = f"gsvis {reported}" if isinstance(reported, str) else f"{type(reported).__name__}: {reported}"
        raise BackendError(f"worker {worker}: expected gsvis {here}, as here, got {got}; install it there")


def _version() -> str:
    assert _workers  # what the tasks need can be imported
    return version("gsvis")
