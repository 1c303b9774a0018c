"""End to end between two network namespaces, over a cable whose rate follows a recorded trace: needs Linux and root.

How well the simulation agrees is measured by benchmarks/shaped_link.py; here: all is well formed, and the laws of the
link hold.
"""

from __future__ import annotations

import asyncio
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks._shaped_link import SERVER, shaped_link, why_not
from gsvis.abr.traces import BandwidthTrace, load_trace
from gsvis.serve import Address, ClientConfig, ManualClock, Server, StreamClient, open_scenes
from gsvis.stream import Received
from tests.serve.servers import PATIENCE, VIEW, still
from tests.stream.worlds import package_of

LATE = 3.0
"""Seconds from the begin after which the first batch ends the exchange: without one after all that the link did, a test
hangs until `PATIENCE` ends it."""


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("large") / "large.gsvis"
    package_of(folder, 60_000, stores=False).close()
    return folder


def exchanged(package: Path, trace: BandwidthTrace) -> tuple[StreamClient, np.ndarray, np.ndarray]:
    """A client at one end of the link until something comes late; when how much came, and at most could."""
    reason = why_not()
    if reason is not None:
        pytest.skip(reason)
    came: list[tuple[float, int]] = []
    began: list[float] = []
    stopped = threading.Event()
    with open_scenes([package]) as scenes, shaped_link() as link:
        server = link.at("server", lambda: Server(scenes, address=Address(SERVER, 0), clock=ManualClock()))()
        running = link.at("server", server.run)

        async def stream() -> StreamClient:
            client = StreamClient(server.url, VIEW, ClientConfig(poses_per_s=10.0), clock=ManualClock())
            start = time.monotonic()
            began.append(start)
            threading.Thread(target=link.follow, args=(trace, start, stopped), daemon=True).start()

            def on_batch(got: Received) -> None:
                came.append((time.monotonic() - start, got.nbytes))
                if came[-1][0] > LATE:
                    client.stop()

            await asyncio.wait_for(client.run(still, on_batch=on_batch), PATIENCE)
            return client

        link.rate(trace.rate_at(0.0))
        client = link.at("client", lambda: asyncio.run(stream()))()
        stopped.set()
        server.stop()
        running()
        most = [link.most_bytes(began[0], began[0] + t) for t, _ in came]
    return client, np.array(came), np.array(most)


def check(client: StreamClient, came: np.ndarray, most: np.ndarray) -> None:
    assert client.connections == 1
    assert client.receiver is not None
    assert client.nbytes == came[:, 1].sum()
    gaussians, _ = client.receiver.scene()
    assert len(gaussians) == len(client.receiver.shown()) > 0
    assert (np.cumsum(came[:, 1]) <= most + 16_000).all()  # no link brings more than it carries, and its bucket


@pytest.mark.slow
@pytest.mark.realdata
def test_a_recorded_link(large: Path, realdata: Path) -> None:
    trace = load_trace(realdata / "traces" / "cooked_3gp" / "norway_tram_10")
    client, came, most = exchanged(large, trace)
    check(client, came, most)


@pytest.mark.slow
def test_a_link_that_falls_silent_and_comes_back(large: Path) -> None:
    trace = BandwidthTrace([1.5, 2.5, 1000.0], [2.0, 0.0, 2.0])
    client, came, most = exchanged(large, trace)
    check(client, came, most)
