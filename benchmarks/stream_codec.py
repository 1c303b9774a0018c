"""What does the wire add to records, and how long do a server and a client take over a batch, on one core?

A session and a receiver without a link: every 100 ms the client, which turns and goes from cell to cell, is sent what a
link of 1, 10 or 100 Mbit/s would carry. Bytes are counted by what they are for. Entropy coding is tried on whole
messages: zstd at level 3, and deflate at level 1 as WebSockets have it. Encoding is what `next_message` takes besides
planning. A batch of 50,000 Gaussians is received with nothing held, and with as much held as the link of 1 Mbit/s had
brought; "ready to draw" is `receive` and `scene`. Times are of the thread, so that what else the machine does counts
less.

Given: a package, a client that turns and walks, three rates.
Measured: bytes by what they are for; thread time of encoding and of receiving.
Defaults chosen on: showroom and nika, the packages that are measured too.
"""

from __future__ import annotations

import argparse
import copy
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from _harness import add_arguments, need, write_result

from gsvis.abr.classes import FieldOfView
from gsvis.abr.predict import exponential
from gsvis.package.rounding import Quality
from gsvis.stream import Message, Receiver, Session, StreamedScene
from gsvis.stream.batch import CHUNK_ROW, FIXED_BYTES, Sections

VIEW = FieldOfView.from_degrees(90, 70, margin=8)
RATES = (1, 10, 100)


def pose(scene: StreamedScene, k: int) -> tuple[np.ndarray, np.ndarray]:
    """A walk over the cells, one in two seconds, while the head turns."""
    centers = scene.index.grid.centers
    at = k / 20 % len(centers)
    low, high = centers[int(at)], centers[(int(at) + 1) % len(centers)]
    return low + (at % 1.0) * (high - low), exponential(np.array([0.0, 0.06 * k, 0.1 * np.sin(k / 15)]))


class Clock:
    """Thread seconds of calls, and of planning within them."""

    def __init__(self, session: Session) -> None:
        self.planning = 0.0
        inner = session.planner.next_batch

        def timed(t: float, budget: float, rate: float, *, spare: float) -> Any:
            start = time.thread_time()
            try:
                return inner(t, budget, rate, spare=spare)
            finally:
                self.planning += time.thread_time() - start

        session.planner.next_batch = timed  # type: ignore[method-assign]

    def encode(self, session: Session, t: float, budget: float) -> tuple[Message | None, float]:
        start, before = time.thread_time(), self.planning
        message = session.next_message(t, budget)
        return message, time.thread_time() - start - (self.planning - before)


def measure_session(scene: StreamedScene, mbit: float, ticks: int) -> tuple[dict[str, Any], Receiver]:
    session, receiver = Session(scene, VIEW), Receiver(scene.header)
    clock, squeeze = Clock(session), zstandard.ZstdCompressor(level=3)
    bytes_of = dict.fromkeys(("records", "terms", "ids", "chunks", "fixed"), 0)
    encode, receive, ready, sizes, gaussians, terms, zstd, deflate = [], [], [], [], 0, 0, 0, 0
    for k in range(ticks):
        session.on_pose(k / 10, *pose(scene, k))
        message, seconds = clock.encode(session, k / 10, mbit * 12_500)
        if message is None:
            continue
        encode.append(seconds)
        start = time.thread_time()
        received = receiver.receive(message.data)
        receive.append(time.thread_time() - start)
        receiver.scene()
        ready.append(time.thread_time() - start)
        s = Sections.parse(message.data, scene.about)
        parts = {
            "records": s.records.nbytes, "terms": s.term_records.nbytes,
            "chunks": len(s.rows) * CHUNK_ROW.itemsize,
        }  # fmt: skip
        fixed = FIXED_BYTES - 8
        parts |= {"fixed": fixed, "ids": len(message.data) - fixed - sum(parts.values())}
        for name, size in parts.items():
            bytes_of[name] += size
        sizes.append(len(message.data))
        gaussians, terms = gaussians + len(received.gaussians), terms + len(received.terms)
        zstd += len(squeeze.compress(message.data))
        deflate += len(zlib.compress(message.data, 1))
    total = sum(sizes)
    record = {
        "batches": len(sizes), "gaussians": gaussians, "terms": terms, "wire_bytes": total, "bytes_of": bytes_of,
        "overhead": total / max(bytes_of["records"] + bytes_of["terms"], 1) - 1, "zstd": zstd / total,
        "deflate": deflate / total, "median_message": float(np.median(sizes)),
        "largest_over_budget": max(sizes[1:], default=0) / (mbit * 12_500),
        **{name: quartiles(values) for name, values in
           (("encode_ms", encode), ("receive_ms", receive), ("ready_ms", ready))},
    }  # fmt: skip
    return record, receiver


def quartiles(seconds: list[float]) -> dict[str, float]:
    low, middle, high = (1e3 * float(v) for v in np.quantile(seconds, [0.25, 0.5, 0.75]))
    return {"median": middle, "iqr": high - low, "least": 1e3 * min(seconds), "most": 1e3 * max(seconds)}


def per_gaussian(scene: StreamedScene, ticks: int) -> dict[str, float]:
    """Bytes of a Gaussian with all that it needs, terms left out: id, share of rows of chunks and of what is fixed."""
    session = Session(scene, VIEW)
    sizes, records, zstd, count, squeeze = 0, 0, 0, 0, zstandard.ZstdCompressor(level=3)
    for k in range(ticks):
        session.on_pose(k / 10, *pose(scene, k))
        message = session.next_message(k / 10, 125e3)
        if message is None:
            continue
        s = Sections.parse(message.data, scene.about)
        none = s.terms[:0]
        bare = Sections(
            s.sequence, s.chunks, s.rows, s.gaussians, s.records, none, none, s.term_records[:0], s.gone
        ).to_message(scene.about)
        sizes, zstd, count = sizes + len(bare), zstd + len(squeeze.compress(bare)), count + len(s.gaussians)
        records += s.records.nbytes
    return {"record": records / count, "with all": sizes / count, "with all, zstd": zstd / count, "gaussians": count}


def large(scene: StreamedScene, held: Receiver | None, repeats: int) -> dict[str, Any]:
    """A batch of 50,000 Gaussians and the terms that come with them."""
    hello = None if held is None else held.hello(VIEW)
    session = Session(scene, VIEW) if hello is None else Session.from_hello(scene, hello)
    for k in range(0, 1800, 7):  # somewhere there is that much to be sent
        session.on_pose(k / 10, *pose(scene, k))
        message = session.next_message(k / 10, 50_000 * 16.0 * (1.25, 1.4, 1.6, 1.9)[k % 4])
        if message is not None and len(message.batch.gaussians) >= 50_000:
            break
        session = Session(scene, VIEW) if hello is None else Session.from_hello(scene, hello)
    else:
        return {}
    seconds, walls = [], []
    for _ in range(repeats + 1):
        receiver = Receiver(scene.header) if held is None else copy.deepcopy(held)
        if held is not None:
            receiver.resume(scene.header)
            receiver.scene()
        start, wall = time.thread_time(), time.perf_counter()
        receiver.receive(message.data)
        receiver.scene()
        seconds.append(time.thread_time() - start)
        walls.append(time.perf_counter() - wall)
    batch = message.batch
    return {
        "gaussians": len(batch.gaussians), "terms": len(batch.terms), "bytes": len(message.data),
        "held": 0 if held is None else len(held.shown()), "thread_ms": quartiles(seconds[1:]),
        "wall_ms": quartiles(walls[1:]),
    }  # fmt: skip


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("packages", nargs="*", type=Path, help="what `gsvis prepare` made")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    need(args.packages, "what `gsvis prepare` made")
    figures: list[dict[str, Any]] = []
    details: dict[str, Any] = {}

    def figure(name: str, reached: float, unit: str, target: float | None = None) -> None:
        figures.append({"name": name, "target": target, "reached": reached, "unit": unit, "better": "lower"})

    chosen = [(path, quality) for path in args.packages for quality in (None, Quality())]
    for path, quality in chosen:
        scene, name = StreamedScene.open(path, quality=quality), path.stem + (", coarse" if quality else "")
        record: dict[str, Any] = {"gaussians": len(scene), "terms": scene.about.terms}
        each = per_gaussian(scene, 100)
        figure(f"{name}: record of a Gaussian, coded", each["record"], "bytes")
        figure(
            f"{name}: a Gaussian with id, rows of chunks and the message, at 10 Mbit/s", each["with all"], "bytes", 10.0
        )
        figure(f"{name}: the same after zstd of the message", each["with all, zstd"], "bytes")
        record["per_gaussian"] = each
        receivers = {}
        for mbit in RATES:
            found, receivers[mbit] = measure_session(scene, mbit, int(10 * args.seconds))
            record[f"{mbit} Mbit/s"] = found
            figure(f"{name}, {mbit} Mbit/s: what the wire adds to records", 100 * found["overhead"], "%")
            least = 1.0 if mbit == 10 else None
            figure(f"{name}, {mbit} Mbit/s: encoding, median", found["encode_ms"]["median"], "ms", least)
        for key, held in (("nothing held", None), ("much held", receivers[1])):
            record[f"50,000, {key}"] = found = large(scene, held, args.repeats)
            if found:
                reached = found["thread_ms"]["median"]
                figure(f"{name}: {found['gaussians']:,} Gaussians ready to draw, {key}", reached, "ms", 50.0)
        details[name] = record
    write_result(args.out, "What does the wire add, and how long do its two ends take over a batch?", figures, details)


if __name__ == "__main__":
    main()
