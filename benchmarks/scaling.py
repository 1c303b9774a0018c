"""What does a package cost on disk, in a server's memory and for each client, and what would 10^9 Gaussians need?

Measured here, each in a process of its own: bytes of a package by what they are for, memory of an open scene and of
one with every cell decoded, memory of a client that has been sent everything its view asks for. From these, by plain
proportion: a city of 10^9 Gaussians at the same density, cut into scenes of the size measured. docs/scaling.md puts
them together with what the other benchmarks measured of processors and links.

Given: packages of showroom and nika.
Measured: bytes on disk, in a server and in a client; a city of 10^9 follows by proportion, it is not measured.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from _harness import add_arguments, need, write_result

from gsvis.abr.classes import FieldOfView
from gsvis.package import Package
from gsvis.stream import Session, StreamedScene

CITY = 1_000_000_000
CLIENTS = 20
VIEW = FieldOfView.from_degrees(90, 70, margin=8)


def resident() -> int:
    """Bytes of memory of this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def disk(path: Path) -> dict[str, Any]:
    """Bytes of a package by what they are for."""
    with Package.open(path) as package:
        m = package.manifest
        blobs = {"visible sets": m.visibility, "lists of active terms": m.active_terms}
        parts = {part.name: part.nbytes for part in m.parts()}
        return {
            "gaussians": m.gaussians,
            "highest_level": m.counts[-1],
            "terms": m.terms,
            "cells": len(package.visibility),
            "parts": len(parts),
            "largest_part": max(parts.values()),
            "bytes": {
                "manifest": (path / "manifest.json").stat().st_size,
                "rows of chunks": sum(part.nbytes for part, _ in m.tables),
                "records": sum(block.gaussians.nbytes for block in m.blocks),
                "terms": sum(part.nbytes for block in m.blocks for part, _ in block.terms),
                **{name: blob.nbytes if blob else 0 for name, blob in blobs.items()},
            },
        }


def memory(path: Path) -> dict[str, float]:
    """Memory of a scene, of its cells, of clients; seconds to open it."""
    before, start = resident(), time.perf_counter()
    scene = StreamedScene.open(path, max_cache_bytes=1 << 34)
    seconds, opened = time.perf_counter() - start, resident()
    for cell in range(len(scene.index.grid)):
        scene.candidates.in_cell(cell)
    cells = resident()
    sessions = []
    for k in range(CLIENTS):
        session = Session(scene, VIEW)
        session.on_pose(0.0, scene.index.grid.centers[k % len(scene.index.grid)], (1.0, 0.0, 0.0, 0.0))
        while session.next_message(0.0, 1e6) is not None:
            pass
        sessions.append(session)
    clients = resident()
    return {"open_seconds": seconds, "open": opened - before, "cells": cells - opened,
            "client": (clients - cells) / len(sessions)}  # fmt: skip


def apart(work: Any, path: Path) -> Any:
    """The work in a fresh process."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, path).result()


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("packages", nargs="*", metavar="NAME=FOLDER")
    args = parser.parse_args()
    need(args.packages, "what `gsvis prepare` made")
    figures: list[dict[str, Any]] = []
    details: dict[str, Any] = {}

    def figure(name: str, reached: float, unit: str) -> None:
        figures.append({"name": name, "target": None, "reached": reached, "unit": unit, "better": "lower"})

    for entry in args.packages:
        name, _, folder = entry.partition("=")
        path = Path(folder)
        apart(memory, path)  # compiles
        found, held = disk(path), apart(memory, path)
        n, total = found["gaussians"], sum(found["bytes"].values())
        scenes = CITY / n
        details[name] = {**found, "memory": held, "scenes_of_a_city": scenes}
        figure(f"{name}: package on disk for each Gaussian", total / n, "bytes")
        figure(f"{name}: visible sets for each Gaussian", found["bytes"]["visible sets"] / n, "bytes")
        figure(f"{name}: parts", found["parts"], "parts")
        figure(f"{name}: memory of an open scene for each Gaussian", held["open"] / n, "bytes")
        figure(f"{name}: memory of a decoded cell", held["cells"] / found["cells"] / 1e6, "MB")
        figure(f"{name}: memory of a client", held["client"] / 1e6, "MB")
        figure(f"{name}: open", held["open_seconds"], "s")
        figure(f"{name}, a city of 10^9 Gaussians at its density: scenes of this size", scenes, "scenes")
        figure(f"{name}, a city of 10^9 Gaussians at its density: on disk", scenes * total / 1e9, "GB")
        figure(f"{name}, a city of 10^9 Gaussians at its density: cells", scenes * found["cells"], "cells")
        figure(f"{name}, a city of 10^9 Gaussians at its density: memory with all open", scenes * held["open"] / 1e9,
               "GB")  # fmt: skip
    write_result(args.out, "What do packages cost on disk and in memory, and what would 10^9 Gaussians need?", figures,
                 details)  # fmt: skip


if __name__ == "__main__":
    main()
