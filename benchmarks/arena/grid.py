"""Sort rows of features into a square so that neighbors are alike.

A plain copy of the idea behind parallel linear assignment sorting: a first order by recursive halving, then swaps of
random pairs within blocks, kept where both rows come nearer to the blurred square.

References:
    Morgenstern et al., "Compact 3D Scene Representation via Self-Organizing Gaussian Grids", ECCV 2024, section 3.2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

__all__ = ["roughness", "sort_to_grid"]

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]


def sort_to_grid(features: F32, rounds: int = 120, seed: int = 0) -> I64:
    """Return the order of rows that makes a smooth square, row by row.

    Args:
        features: (S * S, F) rows.
        rounds: Rounds of swaps; blocks shrink from 8 to 2 a side.
        seed: Seed of the pairs.

    Raises:
        ValueError: If the number of rows is no square.
    """
    side = round(len(features) ** 0.5)
    if side * side != len(features):
        raise ValueError(f"features: expected a square number of rows, got {len(features):,}")
    order = np.empty((side, side), np.int64)
    _halve(np.asarray(features, np.float32), np.arange(len(features)), order)
    rng = np.random.default_rng(seed)
    for block in np.geomspace(min(max(side // 4, 2), 8), 2, rounds).astype(int):
        _swap(features, order, int(block), rng)
    return order.reshape(-1)


def roughness(grid: F32) -> float:
    """Return the mean squared difference of neighbors of a square (S, S, F)."""
    return float(np.square(np.diff(grid, axis=0)).mean() + np.square(np.diff(grid, axis=1)).mean())


def _halve(features: F32, rows: I64, out: I64) -> None:
    """Fill a rectangle with rows: split them in two along their main direction, and the rectangle along its longer
    side, until one row is left."""
    if out.size == 1:
        out[0, 0] = rows[0]
        return
    some = features[rows]
    some = some - some.mean(axis=0)
    axis = np.linalg.eigh(some.T @ some)[1][:, -1] if len(rows) > 4 else np.eye(some.shape[1])[0]
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])  # one sense for all parts
    rows = rows[np.argsort(some @ axis, kind="stable")]
    if out.shape[1] >= out.shape[0]:
        middle = out.shape[1] // 2
        halves = out[:, :middle], out[:, middle:]
    else:
        middle = out.shape[0] // 2
        halves = out[:middle], out[middle:]
    _halve(features, rows[: halves[0].size], halves[0])
    _halve(features, rows[halves[0].size :], halves[1])


def _swap(features: F32, order: I64, block: int, rng: np.random.Generator) -> None:
    """Swap random pairs within blocks of a square where that brings them nearer to the blurred square."""
    side = len(order)
    grid = features[order]
    target = uniform_filter(grid, size=(2 * block + 1, 2 * block + 1, 1), mode="nearest")
    down, right = rng.integers(0, block, 2)
    tall, wide = ((side - int(start)) // block for start in (down, right))
    if tall == 0 or wide == 0:
        return
    cells = np.arange(side * side).reshape(side, side)
    cells = cells[down : down + tall * block, right : right + wide * block]
    blocks = cells.reshape(tall, block, wide, block).swapaxes(1, 2).reshape(tall * wide, block * block)
    places = rng.permutation(block * block)
    half = len(places) // 2
    a = blocks[:, places[:half]].reshape(-1)
    b = blocks[:, places[half : 2 * half]].reshape(-1)
    flat = grid.reshape(side * side, -1)
    wanted = target.reshape(side * side, -1)
    gain = ((flat[a] - flat[b]) * (wanted[a] - wanted[b])).sum(axis=1)  # half of what a swap makes worse
    worth = gain < 0
    here = order.reshape(-1)
    here[a[worth]], here[b[worth]] = here[b[worth]], here[a[worth]].copy()
