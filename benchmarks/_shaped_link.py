"""A real link whose rate follows a trace: two network namespaces, a pair of virtual cables, a token bucket on one.

Linux, root, and the commands `ip` and `tc` are needed; `why_not` says which is missing. Threads enter a namespace, so
that a server and a client of one process stand at the two ends.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from gsvis.abr.traces import BandwidthTrace

__all__ = ["PAYLOAD", "SERVER", "ShapedLink", "shaped_link", "why_not"]

SERVER = "10.201.77.1"
_CLIENT = "10.201.77.2"
_CLONE_NEWNET = 0x40000000

PAYLOAD = 1448 / 1514
"""Share of the shaped bytes that TCP delivers: a full frame with its headers, time stamps among the options."""

T = TypeVar("T")


def why_not() -> str | None:
    """What is missing here; None if nothing is."""
    if sys.platform != "linux":
        return "network namespaces need Linux"
    if os.geteuid() != 0:
        return "network namespaces need root"
    for command in ("ip", "tc"):
        if shutil.which(command) is None:
            return f"{command} is missing: install iproute2"
    name = f"gsvis-try-{os.getpid()}"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
    if made.returncode:
        return f"no network namespaces here: {made.stderr.strip()[:100]}"
    shaped = subprocess.run(
        f"ip netns exec {name} tc qdisc add dev lo root tbf rate 1mbit burst 8kb limit 8kb".split(),
        capture_output=True,
        text=True,
        check=False,
    )
    _run("ip", "netns", "del", name)
    return f"tc cannot shape here: {shaped.stderr.strip()[:100]}" if shaped.returncode else None


class ShapedLink:
    """Two ends and the rate between them.

    Args:
        queue: Seconds of data that the bottleneck holds before it drops.
    """

    def __init__(self, queue: float = 0.5) -> None:
        self._ends = tuple(f"gsvis-{os.getpid()}-{end}" for end in "ab")
        self._queue = queue
        self._rate = 0.0
        self._changes: list[tuple[float, float, float]] = []  # before, after, Mbit/s

    def open(self) -> None:
        """Make the namespaces and the cable."""
        a, b = self._ends
        for name in self._ends:
            _run("ip", "netns", "add", name)
        _run("ip", "link", "add", "veth0", "netns", a, "type", "veth", "peer", "name", "veth0", "netns", b)
        for name, address in ((a, SERVER), (b, _CLIENT)):
            _run("ip", "-n", name, "addr", "add", f"{address}/24", "dev", "veth0")
            _run("ip", "-n", name, "link", "set", "veth0", "up")
            _run("ip", "-n", name, "link", "set", "lo", "up")
            # Offloading would hand the bucket packets of 64 KB.
            subprocess.run(
                ["ip", "-n", name, "link", "set", "veth0", "gso_max_segs", "1"], capture_output=True, check=False
            )
        self._tc("add", 10.0)

    def close(self) -> None:
        """Remove them."""
        for name in self._ends:
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)

    def rate(self, mbit_per_s: float) -> None:
        """Let the server's side send so fast from now on."""
        if mbit_per_s != self._rate:
            self._tc("change", mbit_per_s)

    def _tc(self, verb: str, mbit_per_s: float) -> None:
        rate = max(mbit_per_s, 0.008)
        before = time.monotonic()
        limit = max(int(rate * 125_000 * self._queue), 16_000)
        words = f"qdisc {verb} dev veth0 root tbf rate {int(rate * 1e6)}bit burst 6000 limit {limit}"
        _run("ip", "netns", "exec", self._ends[0], "tc", *words.split())
        self._rate = mbit_per_s
        self._changes.append((before, time.monotonic(), rate))

    def most_bytes(self, start: float, end: float) -> float:
        """What it can have carried between two monotonic times at most: on a busy machine a change of rate is late."""
        total, ends = 0.0, [after for _, after, _ in self._changes[1:]] + [end]
        for (begin, _, rate), stop in zip(self._changes, ends, strict=True):
            total += 125_000 * rate * max(min(stop, end) - max(begin, start), 0.0)
        return total

    def at(self, end: str, work: Callable[[], T]) -> Callable[[], T]:
        """Start work in a thread at the end "server" or "client".

        Returns:
            What waits for its result.
        """
        found: list[Any] = []

        def there() -> None:
            try:
                with open(f"/run/netns/{self._ends[0 if end == 'server' else 1]}", "rb") as file:
                    if ctypes.CDLL(None, use_errno=True).setns(file.fileno(), _CLONE_NEWNET) != 0:
                        raise OSError(ctypes.get_errno(), "setns")
                found.append(work())
            except BaseException as error:
                found.append(error)

        thread = threading.Thread(target=there, daemon=True)
        thread.start()

        def result() -> T:
            thread.join()
            if isinstance(found[0], BaseException):
                raise found[0]
            value: T = found[0]
            return value

        return result

    def follow(self, trace: BandwidthTrace, start: float, stopped: threading.Event) -> None:
        """Change the rate as the trace says, from monotonic time `start` until asked to stop."""
        while not stopped.is_set():
            now = max(time.monotonic() - start, 0.0)
            self.rate(trace.rate_at(now))
            within = now % trace.period
            later = trace.times[trace.times > within + 1e-9]
            stopped.wait(min(float(later[0]) - within if len(later) else 0.05, 1.0))


@contextmanager
def shaped_link(queue: float = 0.5) -> Iterator[ShapedLink]:
    """A link, removed at the end."""
    link = ShapedLink(queue)
    try:
        link.open()
        yield link
    finally:
        link.close()


def _run(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"{' '.join(words)}: {done.stderr.strip()}")
