"""Recorded links of a class: drawn once by a seed, scaled so that they carry a given rate during the walk.

All systems play over the same links. Mbit/s, seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsvis.abr import BandwidthTrace, load_trace
from gsvis.errors import SceneError
from gsvis.simulate import Link

__all__ = ["CLASSES", "ROUND_TRIP", "drawn_links", "recorded_links"]

CLASSES = (3.0, 10.0, 30.0)
"""Mean rates of the links, Mbit/s."""

ROUND_TRIP = 0.04
"""Seconds."""

_SETS = ("cooked_3gp", "traces_oboe", "5g_download")
_SEED = 46
_LEAST = 0.05  # Mbit/s that a recording has on average, or it says nothing about a link


def recorded_links(traces: Path, mbit: float, count: int, seconds: float) -> list[Link]:
    """Return links of one class.

    Args:
        traces: Folder with the sets of recordings.
        mbit: Mean rate while the walk lasts, Mbit/s.
        count: Number of links; they take turns among the sets.
        seconds: Duration of the walk.

    Raises:
        SceneError: If there are too few recordings.
    """
    found = [_shuffled(traces / name, mbit) for name in _SETS]
    links: list[Link] = []
    turn = 0
    while len(links) < count and turn < count * len(_SETS):
        scaled = (_scaled(path, mbit, seconds) for path in found[turn % len(_SETS)])
        links += [link for link in (next(filter(None, scaled), None),) if link is not None]
        turn += 1
    if len(links) < count:
        raise SceneError(f"{traces}: expected {count} recorded links in {', '.join(_SETS)}, got {len(links)}")
    return links


def drawn_links(mbit: float, count: int, seconds: float) -> list[Link]:
    """Return links whose rate changes every second by chance, for runs without recordings."""
    rng = np.random.default_rng([_SEED, round(mbit)])
    length = int(np.ceil(seconds))
    links = []
    for k in range(count):
        rates = rng.gamma(4.0, mbit / 4.0, length)
        times = np.arange(1.0, length + 1.0)
        links.append(Link(BandwidthTrace(times, rates * (mbit / rates.mean()), f"drawn {k}"), ROUND_TRIP))
    return links


def _shuffled(folder: Path, mbit: float) -> Iterator[Path]:
    """Return the recordings of a set in an order that the class draws."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith((".", "LICENSE")))
    order = np.random.default_rng([_SEED, round(mbit)]).permutation(len(files))
    return (files[k] for k in order)


def _scaled(path: Path, mbit: float, seconds: float) -> Link | None:
    """Return a recording at a mean rate; None if it is silent."""
    trace = load_trace(path)
    carried = trace.bytes_between(0.0, seconds) / seconds / 125e3
    if carried < _LEAST:
        return None
    scaled = trace.scaled(mbit / carried)
    return Link(BandwidthTrace(scaled.times, scaled.mbit_per_s, trace.name), ROUND_TRIP)
