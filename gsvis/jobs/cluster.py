"""Workers of a Dask cluster: `with connect("tcp://10.0.0.5:8786") as workers: build_pvs(..., workers=workers)`.

Each worker needs the same version of gsvis. If one dies, the scheduler gives its tasks to the others, also to workers
that join later. Results equal local ones, byte for byte.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import contextmanager, suppress
from importlib.metadata import version
from typing import Any

from gsvis._extras import require
from gsvis.errors import BackendError
from gsvis.files.apart import call_apart
from gsvis.jobs import processes
from gsvis.jobs.workers import Workers

__all__ = ["check_address", "connect"]

_RETRIES = 2  # of a task that raises an error; the death of a worker does not count
_PLUGIN = "gsvis-threads"
_SLACK = 5.0  # seconds, beside the time that Dask has for a scheduler, until it counts as silent


def check_address(address: str) -> str:
    """Return the address; raise unless it has the form of a scheduler's address.

    Raises:
        ValueError: If it is not of the form `tcp://host:port` or `tls://host:port`.
    """
    if not re.fullmatch(r"(tcp|tls)://(\[[0-9A-Fa-f:.%]+\]|[^\s/:\[\]]+):\d{1,5}", address):
        raise ValueError(f"scheduler: expected an address such as tcp://10.0.0.5:8786, got {address!r}")
    return address


@contextmanager
def connect(address: str, *, timeout: float = 10.0) -> Iterator[Workers]:
    """Yield the workers of a Dask cluster.

    Args:
        address: Address of the scheduler, such as `tcp://10.0.0.5:8786`.
        timeout: Seconds to wait for the scheduler, and then for its first worker.

    Yields:
        The `workers` argument of `build_pvs`, `prepare_package` and `prepare_world`.

    Raises:
        ValueError: If the address is malformed.
        MissingExtraError: If dask is not installed.
        BackendError: If no scheduler or no worker answers, or a worker lacks this version of gsvis.
    """
    check_address(address)
    require("a Dask cluster", "dask", "distributed")
    from dask import config
    from distributed.diagnostics.plugin import WorkerPlugin

    class Threads(WorkerPlugin):  # type: ignore[misc]
        """Sets the number of kernel threads in each worker, also in workers that join later."""

        name = _PLUGIN
        idempotent = True

        def setup(self, worker: Any) -> None:
            """Use as many kernel threads as the worker has."""
            from gsvis.jobs import processes

            processes.use_threads(worker.state.nthreads)

        def teardown(self, worker: Any) -> None:
            """Return to the default number of kernel threads."""
            from gsvis.jobs import processes

            processes.use_threads(None)
            processes.ready.clear()

    with config.set({"distributed.comm.timeouts.connect": f"{timeout} s"}):
        try:
            client = _ask(address, timeout)
        except (OSError, TimeoutError, FutureTimeoutError) as error:
            raise BackendError(
                f"no Dask scheduler answers at {address} within {timeout:g} s: is it running (`dask scheduler`),"
                " reachable from here, and not at another port, as that of its dashboard?"
            ) from error
        except Exception as error:  # what a stranger says ends in any error, of memory too
            raise BackendError(
                f"what answers at {address} is not understood ({type(error).__name__}): is it a Dask scheduler, of the"
                f" version here, {version('distributed')}?"
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
            with suppress(Exception):  # a lost scheduler must not hide the error of the block
                client.unregister_worker_plugin(_PLUGIN)
    finally:
        with suppress(Exception):
            client.close()


def _ask(address: str, timeout: float) -> Any:
    """Return a client of a scheduler. Dask waits for ever for one that accepts a connection and says nothing."""
    from distributed import Client

    class Asked(Client):  # type: ignore[misc]
        """A client that counts as closed if it never opened: Dask would wait for its end, and say so late."""

        def __init__(self, *args: Any, **kwargs: Any) -> None:
            try:
                super().__init__(*args, **kwargs)
            except Exception:
                self.status = "closed"
                raise

    def ask() -> Client:
        return Asked(address, timeout=timeout, set_as_default=False, name="gsvis")

    answer = call_apart(ask, "gsvis-scheduler")
    try:
        return answer.result(timeout + _SLACK)
    except FutureTimeoutError:
        answer.add_done_callback(_close_late)
        raise


def _close_late(answer: Future[Any]) -> None:
    """Close a client that is no longer used."""
    if answer.exception() is None:
        answer.result().close()


def _check_versions(client: Any) -> None:
    """Raise unless every worker has this version of gsvis.

    Raises:
        BackendError: If gsvis is missing on a worker, or has another version there.
    """
    here = version("gsvis")
    found = client.run(_version, on_error="return")
    other = {worker: reported for worker, reported in found.items() if reported != here}
    if other:
        worker, reported = next(iter(other.items()))
        got = f"gsvis {reported}" if isinstance(reported, str) else f"{type(reported).__name__}: {reported}"
        raise BackendError(f"worker {worker}: expected gsvis {here}, as here, got {got}; install it there")


def _version() -> str:
    assert processes
    return version("gsvis")
