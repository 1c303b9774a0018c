"""Viewers who keep what they receive, and the check of it: every byte against the package, terms too.

A viewer sits behind a link of its own of a steady rate, walks from cell to cell, acknowledges a batch when its link
would have brought it, and begins anew once the server has nothing more for it. What a visit has received is checked in
other processes, so that it takes no time from those who measure; where these are behind, viewers wait between visits.
"""

from __future__ import annotations

import asyncio
import json
import os
import ssl
import struct
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from gsvis.abr.classes import FieldOfView
from gsvis.errors import ProtocolError
from gsvis.package import Package
from gsvis.package.contents import base_rgb
from gsvis.package.rounding import chunks_of
from gsvis.scene.sh import SH_C0
from gsvis.stream import Ack, Bye, Hello, PoseAt, Receiver
from gsvis.stream.batch import Sections
from gsvis.stream.coding import Coding
from gsvis.stream.wire import ERROR, ServerFault

__all__ = ["Checker", "Checks", "Link", "Viewer", "Visit", "begin_checks", "check"]

VIEW = FieldOfView.from_degrees(90, 70, margin=8)
DRY_S = 0.08  # nothing has come for so long though all is acknowledged: ask whether the server is awake
VISIT_S = 20.0  # longest visit


@dataclass(frozen=True)
class Link:
    """What all viewers share.

    Attributes:
        url: Of the stream.
        stops: (K, 3) places to walk between.
        up: (3,) axis.
        mbit: Rate of the link of each, Mbit/s.
        tls: For wss://.
        one_address: Whether all viewers come from one address, as behind one NAT.
    """

    url: str
    stops: np.ndarray
    up: np.ndarray
    mbit: float
    tls: ssl.SSLContext | None = None
    one_address: bool = False


@dataclass
class Visit:
    """What one connection has brought.

    Attributes:
        welcome: The first message.
        batches: The others.
    """

    welcome: bytes
    batches: list[bytes] = field(default_factory=list)


class Checks:
    """Has visits checked in other processes, and sums up what they find.

    Args:
        executor: Where `check` runs.
        most: Visits that may wait there before viewers do, so that they do not fill the memory of the benchmark.

    Attributes:
        found: Sums of what `check` returns.
        longest: Most visits that have waited at once.
        waited_s: Seconds that viewers have waited, all of them together.
    """

    def __init__(self, executor: Executor, most: int, job: Callable[[Visit], dict[str, int]] | None = None) -> None:
        self._executor, self._most, self._job = executor, most, job or check
        self._waiting: set[asyncio.Future[dict[str, int]]] = set()
        self.found: Counter[str] = Counter()
        self.longest, self.waited_s = 0, 0.0

    def put(self, visit: Visit) -> None:
        """Have a visit checked."""
        self._waiting.add(asyncio.wrap_future(self._executor.submit(self._job, visit)))
        self.longest = max(self.longest, len(self._waiting))

    async def wait_for_room(self) -> None:
        """Wait until another visit may be put."""
        began = time.monotonic()
        while len(self._waiting) >= self._most:
            self._take(await asyncio.wait(self._waiting, return_when=asyncio.FIRST_COMPLETED))
        self.waited_s += time.monotonic() - began

    async def finish(self) -> None:
        """Wait until all have been checked."""
        while self._waiting:
            self._take(await asyncio.wait(self._waiting))

    def _take(self, states: tuple[set[asyncio.Future[dict[str, int]]], object]) -> None:
        for future in states[0] & self._waiting:  # several viewers wait for the same
            self._waiting.discard(future)
            self.found.update(future.result())


class Viewer:
    """One viewer.

    Args:
        link: What all share.
        number: Its own; the seed of its walk and its address.
        checks: Takes each visit once it has ended.

    Attributes:
        delays: (time, seconds) from an acknowledgement to the batch that it makes room for.
        openings: (time, seconds) from the first byte to WELCOME.
        visits: How many began.
        cut: (time, why) of each visit that the server ended, or did not let begin.
        nbytes: Bytes of batches.
    """

    def __init__(self, link: Link, number: int, checks: Checks) -> None:
        self._link, self._checks, self._rng = link, checks, np.random.default_rng(number)
        self._address = f"127.0.1.{1 if link.one_address else 1 + number}"
        self.delays: list[tuple[float, float]] = []
        self.openings: list[tuple[float, float]] = []
        self.cut: list[tuple[float, str]] = []
        self.visits, self.nbytes = 0, 0
        self._asked: float | None = None  # when the last acknowledgement was sent that no batch has followed
        self._heard = self._free = 0.0
        self._waiting = 0  # acknowledgements that the link holds back
        self._leaving = False

    async def run(self, until: float) -> None:
        """Visit again and again."""
        while time.monotonic() < until:
            await self._checks.wait_for_room()
            try:
                await self._visit(until)
            except (ConnectionClosed, InvalidHandshake, OSError, asyncio.TimeoutError, ProtocolError) as error:
                if time.monotonic() < until:
                    self.cut.append((time.monotonic(), f"{type(error).__name__}: {error}"[:200]))
                await asyncio.sleep(0.2)

    async def _visit(self, until: float) -> None:
        began = time.monotonic()
        options: dict[str, Any] = {} if self._link.tls is None else {"ssl": self._link.tls}
        async with connect(
            self._link.url, compression=None, max_size=None, ping_interval=None, proxy=None, close_timeout=1,
            open_timeout=30, local_addr=(self._address, 0), **options,
        ) as ws:  # fmt: skip
            await ws.send(Hello(VIEW).to_bytes())
            welcome = _bytes_of(await asyncio.wait_for(ws.recv(), 30))
            self._heard = self._free = time.monotonic()
            self.openings.append((self._heard, self._heard - began))
            self.visits += 1
            self._waiting, self._asked, self._leaving, visit = 0, None, False, Visit(welcome)
            await ws.send(Ack(0).to_bytes())
            apart = [asyncio.create_task(self._walk(ws)), asyncio.create_task(self._watch(ws, began, until))]
            try:
                while True:
                    self._take(ws, visit, _bytes_of(await ws.recv()))
            except ConnectionClosed:
                if not self._leaving:
                    raise
            finally:
                for task in apart:
                    task.cancel()
                await asyncio.gather(*apart, return_exceptions=True)
                self._checks.put(visit)

    def _take(self, ws: Any, visit: Visit, data: bytes) -> None:
        now = self._heard = time.monotonic()
        if self._asked is not None:
            self.delays.append((now, now - self._asked))
            self._asked = None
        visit.batches.append(data)
        self.nbytes += len(data)
        self._free = max(self._free, now) + len(data) / (self._link.mbit * 125_000)
        self._waiting += 1
        loop = asyncio.get_running_loop()
        sequence = int.from_bytes(data[4:8], "little")
        loop.call_later(self._free - now, lambda: loop.create_task(self._acknowledge(ws, sequence)))

    async def _acknowledge(self, ws: Any, sequence: int) -> None:
        self._waiting -= 1
        if self._asked is None:
            self._asked = time.monotonic()
        with suppress(ConnectionClosed):
            await ws.send(Ack(sequence).to_bytes())

    async def _watch(self, ws: Any, began: float, until: float) -> None:
        """End the visit when the server has nothing more to send: it answers two pings, and no batch comes."""
        silent = 0
        while (now := time.monotonic()) < min(began + VISIT_S, until) and silent < 2:
            since = max(self._heard, self._asked or 0.0)
            if self._waiting or now - since < DRY_S:
                silent = 0 if self._waiting else silent
                await asyncio.sleep(0.02)
                continue
            await (await ws.ping())
            await asyncio.sleep(DRY_S)
            silent = 0 if self._heard > since else silent + 1
        if self._asked is not None and silent < 2:  # it was waited for in vain
            self.delays.append((time.monotonic(), time.monotonic() - self._asked))
        self._leaving = True
        await ws.send(Bye().to_bytes())
        await ws.close()

    async def _walk(self, ws: Any) -> None:
        """Say ten times a second where the viewer is: half a cell a second, turning by 30 degrees a second."""
        stops, start = self._link.stops, time.monotonic()
        apart = np.linalg.norm(stops - stops[self._rng.integers(len(stops))], axis=1)
        stops, turn = stops[np.argsort(apart)[:40]], self._rng.uniform(0.0, 6.28)
        while True:
            t = time.monotonic() - start
            along = min(0.5 * t, len(stops) - 1.001) if len(stops) > 1 else 0.0
            k = int(along)
            place = stops[k] + (along - k) * (stops[min(k + 1, len(stops) - 1)] - stops[k])
            x, y, z = place.tolist()
            angle = turn + 0.52 * t
            i, j, l = (np.sin(angle / 2) * self._link.up).tolist()  # noqa: E741
            with suppress(ConnectionClosed):
                await ws.send(PoseAt(int(1e3 * t), (x, y, z), (float(np.cos(angle / 2)), i, j, l)).to_bytes())
            await asyncio.sleep(0.1)


def _bytes_of(data: bytes | str) -> bytes:
    if isinstance(data, str):
        raise ProtocolError("message: expected bytes, got text")
    if data[:1] == bytes([ERROR]):
        fault = ServerFault.parse(data)
        raise ProtocolError(fault.line, fault.code)
    return data


class Checker:
    """Compares visits with a package, in the process that it lives in.

    Args:
        package: The folder.
    """

    def __init__(self, package: Path) -> None:
        self._welcome = _welcome_of(json.loads((package / "manifest.json").read_text(encoding="utf-8")))
        self._identity = ""
        with Package.open(package) as opened:
            self._contents = c = opened.contents
            self._gaussians, colors = c.gaussians(), c.colors().dequantize()
            rgb = base_rgb(c.records, c.grids)
        self._sh0 = ((rgb - np.float32(0.5)) / np.float32(SH_C0))[:, None]  # in float32, as a client does it
        self._terms = colors.functions, colors.centers, colors.decays, colors.intensities
        self._base, self._starts = colors.base, c.table.starts[:-1]
        self._rows = {
            "origin": c.table.origins, "step": c.table.steps, "low": c.table.lows, "count": c.table.counts,
            "stride": c.table.strides, "first_level": c.chunk_levels[:, 0], "last_level": c.chunk_levels[:, 1],
        }  # fmt: skip

    def _owners(self, terms: np.ndarray) -> np.ndarray:
        """Gaussians of terms, by where the package says that the terms of each begin."""
        return np.searchsorted(self._contents.term_offsets, terms, side="right") - 1

    def check(self, visit: Visit) -> dict[str, int]:
        """Return how many bytes were right and wrong, of batches as they came and of what the viewer then holds."""
        found = {"bytes": 0, "wrong": 0, "gaussians": 0, "terms": 0, "batches": len(visit.batches), "refused": 0}
        try:
            receiver = Receiver(visit.welcome)
            found["bytes"] = len(visit.welcome)
            found["wrong"] = 0 if self._is_right(visit.welcome) else len(visit.welcome)
            terms = [np.zeros(0, np.int64)]
            for data in visit.batches:
                sections = Sections.parse(data, receiver.about)
                self._check_batch(sections, receiver.about.coding, found)
                terms.append(sections.terms)
                receiver.receive(data)
        except (ProtocolError, ValueError):
            found["refused"] += 1
            return found
        self._check_held(receiver, np.concatenate(terms), found)
        return found

    def _is_right(self, welcome: bytes) -> bool:
        """Whether WELCOME says of the package what its manifest does, read here by the rules of docs/streaming.md."""
        schema = pa.ipc.read_schema(pa.py_buffer(welcome[8:]))
        said = json.loads((schema.metadata or {}).get(b"gsvis", b"{}"))
        identity = said.pop("identity", "")
        said.pop("code", "")  # whose tables decide nothing: records are compared
        self._identity = self._identity or identity
        plain = pa.schema([pa.field("sections", pa.binary(), nullable=False)])
        return (
            struct.unpack_from("<BBHI", welcome) == (129, 3, 0, 0)
            and schema.remove_metadata().equals(plain)
            and len(identity) == 64
            and identity == self._identity
            and said == self._welcome
        )

    def _check_batch(self, s: Sections, coding: Coding, found: dict[str, int]) -> None:
        c = self._contents
        records = coding.decode_records(s.records, s.gaussians, c.chunks[s.gaussians], chunks_of(c.table))
        terms = coding.decode_terms(s.term_records, s.owners)
        if records is None or terms is None:
            raise ProtocolError(f"BATCH {s.sequence}: expected records, got other bytes")
        rows = np.searchsorted(self._starts, s.chunks)
        for got, expected in (
            (records, c.records[s.gaussians]), (terms, c.term_records[s.terms]),
            (s.owners, self._owners(s.terms)), (s.chunks, self._starts[rows]),
            *((s.rows[name], values[rows]) for name, values in self._rows.items()),
        ):  # fmt: skip
            _compare(got, expected, found)
        found["gaussians"] += len(s.gaussians)
        found["terms"] += len(s.terms)

    def _check_held(self, receiver: Receiver, terms: np.ndarray, found: dict[str, int]) -> None:
        """Compare what is drawn; terms are those that came, in their order."""
        g, colors = receiver.scene()
        ids = receiver.shown()
        _compare(g.sh0, self._sh0[ids], found)
        for name in ("means", "quats", "scales", "opacities"):
            _compare(getattr(g, name), getattr(self._gaussians, name)[ids], found)
        _compare(colors.base, self._base[ids], found)
        owners = self._owners(terms)
        slots = np.full(len(self._contents), -1)
        slots[ids] = np.arange(len(ids))
        terms, owners = terms[slots[owners] >= 0], owners[slots[owners] >= 0]
        terms = terms[np.argsort(slots[owners], kind="stable")]
        counts = np.bincount(slots[owners], minlength=len(ids))
        _compare(np.diff(colors.offsets), counts, found)
        mine = colors.functions, colors.centers, colors.decays, colors.intensities
        for got, expected in zip(mine, self._terms, strict=True):
            _compare(got, expected[terms], found)


def _welcome_of(manifest: dict[str, Any]) -> dict[str, Any]:
    """What WELCOME has to say of a package, but for its identity."""
    quantization = manifest["quantization"]
    colors, term = quantization["colors"], quantization["term"]
    bits = sum(term[name] for name in ("function", "theta", "phi", "decay")) + term["intensities"] * term["intensity"]
    return {
        "protocol": 3, "gaussians": manifest["gaussians"], "terms": manifest["terms"],
        "chunks": sum(part["count"] for part in manifest["chunks"]), "levels": manifest["levels"], "record_bytes": 16,
        "term_bits": bits, "colors": colors,
        "up": manifest["up"], "meters_per_unit": manifest["meters_per_unit"], "steps": None,
    }  # fmt: skip


def _compare(got: np.ndarray, expected: np.ndarray, found: dict[str, int]) -> None:
    """Count bytes, and those that differ; where lengths differ, all of them."""
    expected = np.ascontiguousarray(expected, got.dtype)
    found["bytes"] += expected.nbytes
    if got.shape != expected.shape:
        found["wrong"] += max(got.nbytes, expected.nbytes, 1)
        return
    a, b = (np.ascontiguousarray(values).reshape(-1).view(np.uint8) for values in (got, expected))
    found["wrong"] += int(np.count_nonzero(a != b))


_CHECKER: list[Checker] = []


def begin_checks(package: Path, cores: list[int]) -> None:
    """Make a process ready to check visits."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)
    os.nice(10)
    _CHECKER.append(Checker(package))


def check(visit: Visit) -> dict[str, int]:
    """Check a visit, in a process that `begin_checks` has made ready."""
    return _CHECKER[0].check(visit)
