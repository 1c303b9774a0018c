"""Find the lattices on which the centers of Gaussians lie: SOG keeps 16 bits of the logarithm of each coordinate.

A coordinate x has the symmetric logarithm u = sign(x) log(1 + |x|). In a SOG file, u is one of 65,536 values with even
steps on each axis. With these steps, centers can be stored exactly, in fewer bits than in the box of a chunk. The steps
are found from the centers alone, so the scene may have been stored in other formats since. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.scene.symlog import symlog

__all__ = ["MOST_RUNS", "Lattices", "find_lattices"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MOST_RUNS = 256
"""Most runs of consecutive Gaussians in which a lattice is looked for."""

_RUN = 256  # consecutive Gaussians from which a step is estimated
_MOST = 64  # most lattices of a scene
_DIFFERENT = 32  # fewest different values of a coordinate in a run
_NEAR = 0.05  # largest distance of a center from its lattice, in steps
_LEAST_STEP = 16.0  # smallest step of a lattice, in rounding errors of float32
_PARTS = 32  # most steps between the two nearest values of a run
_SHARE = 0.01  # smallest share of the Gaussians on a lattice


@dataclass(frozen=True, eq=False)
class Lattices:
    """K lattices, and the places of N centers on them.

    Attributes:
        offsets: (K, 3) symmetric logarithm at place 0.
        steps: (K, 3) steps of the symmetric logarithm, > 0.
        of: (N,) lattice of each center; -1 for a center on no lattice.
        places: (N, 3) place of each center on its lattice; 0 for a center on no lattice.
    """

    offsets: F64
    steps: F64
    of: NDArray[np.int16]
    places: NDArray[np.int32]

    def __len__(self) -> int:
        """Number of lattices."""
        return len(self.steps)

    def __getitem__(self, ids: ArrayLike) -> Lattices:
        """Return the same lattices with the centers at an index array."""
        chosen = np.asarray(ids)
        return Lattices(self.offsets, self.steps, self.of[chosen], self.places[chosen])


def find_lattices(means: NDArray[np.float32], *, runs: int = MOST_RUNS) -> Lattices:
    """Return the lattices of centers, the one with most centers first; a scene that was never in a SOG file has none.

    Args:
        means: (N, 3) centers, in an order in which neighbors are near each other.
        runs: Runs that are examined, at most.
    """
    n = len(means)
    of = np.full(n, -1, np.int16)
    places = np.zeros((n, 3), np.int32)
    logs: F64 | None = None  # takes longer than to find that there is no lattice
    rest = np.arange(n)
    found = list[tuple[F64, F64]]()
    while len(found) < _MOST and len(rest) >= _RUN:
        lattice = _find_common(means, rest, runs)
        if lattice is None:
            break
        offset, step = lattice
        logs = symlog(means) if logs is None else logs
        along = (logs[rest] - offset) / step
        on = (np.abs(along - np.rint(along)) < _NEAR).all(axis=1) & (np.abs(along) < 1 << 30).all(axis=1)
        if on.sum() < max(_RUN, _SHARE * n):
            break
        of[rest[on]] = len(found)
        places[rest[on]] = np.rint(along[on]).astype(np.int32)
        found.append(lattice)
        rest = rest[~on]
    offsets = np.array([offset for offset, _ in found]).reshape(-1, 3)
    steps = np.array([step for _, step in found]).reshape(-1, 3)
    return Lattices(offsets, steps, of, places)


def _find_common(means: NDArray[np.float32], ids: I64, most: int) -> tuple[F64, F64] | None:
    """Return offset (3,) and step (3,) of the lattice with most of `most` runs of centers, or None.

    Args:
        means: (N, 3) centers.
        ids: (M,) those that are looked at.
        most: Number of runs.
    """
    heads = _RUN * np.unique(np.linspace(0, len(ids) // _RUN - 1, most).astype(int))
    logs = symlog(means[ids[(heads[:, None] + np.arange(_RUN)).ravel()]])
    runs = [slice(_RUN * k, _RUN * (k + 1)) for k in range(len(heads))]
    steps = np.array([[_find_step(np.sort(logs[run, axis])) for axis in range(3)] for run in runs])
    good = np.flatnonzero((steps > 0.0).all(axis=1))
    if len(good) == 0:
        return None
    same = [int((np.abs(steps[good] / steps[k] - 1.0) < 1e-3).all(axis=1).sum()) for k in good]
    best = int(good[int(np.argmax(same))])
    near = np.concatenate([logs[runs[k]] for k in good])
    fits = [_refine(near[:, axis], logs[runs[best], axis], float(steps[best, axis])) for axis in range(3)]
    return np.array([offset for offset, _ in fits]), np.array([step for _, step in fits])


def _find_step(u: F64) -> float:
    """Return the largest step that divides all differences of ascending values; 0 if there is none."""
    noise = 2.0**-23 * (1.0 - np.exp(-np.abs(u).max()))
    gaps = np.diff(u)
    gaps = gaps[gaps > 4.0 * noise]
    if len(gaps) < _DIFFERENT - 1:
        return 0.0
    least = float(gaps.min())
    for parts in range(1, 1 + _PARTS):
        step = least / parts
        for some in (gaps[gaps <= least * (24.0 / min(parts, 24))], gaps, np.cumsum(gaps)):
            times = np.rint(some / step)
            if np.abs(some / step - times).max() > 0.2:
                break
            step = float((some * times).sum() / (times * times).sum())
        else:
            off = np.cumsum(gaps) / step
            if step > _LEAST_STEP * noise and np.sqrt(np.mean((off - np.rint(off)) ** 2)) < _NEAR:
                return step
    return 0.0


def _refine(u: F64, run: F64, step: float) -> tuple[float, float]:
    """Return the offset and step of a lattice, fitted to all values on it: first those near the run, then farther ones.

    Both are rounded, but much more finely than float32, so that an edit of some Gaussians seldom changes them.

    Args:
        u: Values on the axis.
        run: Values of the run.
        step: Step estimated from the run.
    """
    offset = float(np.median(run))
    offset = float(run[np.argmin(np.abs(run - offset))])
    for reach, far in ((1 << 11, 0.2), (1 << 14, 0.1), (1 << 17, 0.1), (1 << 17, 0.02)):
        some = u[np.abs(u - offset) < reach * step]
        times = np.rint((some - offset) / step)
        on = np.abs((some - offset) / step - times) < far
        x = times[on]
        y = some[on] - offset
        spread = float(((x - x.mean()) ** 2).sum())
        if spread > 0.0:
            step = float(((x - x.mean()) * (y - y.mean())).sum()) / spread
        offset += float((y - step * x).mean())
    offset -= step * np.floor(offset / step)
    return round(offset * 2.0**44) / 2.0**44, round(step * 2.0**54) / 2.0**54
