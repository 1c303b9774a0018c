"""Numba kernels of the scene room: mark the voxels that rays cross before they are stopped, and what lies near them.

They take checked, contiguous arrays, never raise and know no classes. `in_sight.py` prepares and calls them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import kernel, uncounted
from gsvis._kernels.threads import in_parts

__all__ = ["grow", "mark_crossed", "mark_seen"]

_STEP = 0.7  # voxels


@kernel
def mark_crossed(
    occupied: NDArray[np.bool_],
    start: NDArray[np.float64],
    directions: NDArray[np.float64],
    walls: int,
    crossed: NDArray[np.uint64],
) -> Any:
    """Mark the voxels on rays from one point, up to and including the last occupied step that a ray is allowed.

    Args:
        occupied: (X, Y, Z) voxels that stop light.
        start: (3,) origin in voxel units; may lie outside of the grid.
        directions: (R, 3) unit vectors.
        walls: Number of steps in occupied voxels after which a ray ends.
        crossed: (X, Y, W) uint64 result, a bit for each voxel along Z; the bits of voxels on a ray are set.
    """
    shape = occupied.shape
    for r in range(len(directions)):
        # where the ray enters and leaves the grid
        near = 0.0
        far = np.inf
        for i in range(3):
            step = directions[r, i]
            at = start[i]
            if step == 0.0:
                if not 0.0 <= at < shape[i]:
                    far = -1.0
                continue
            one = -at / step
            two = (shape[i] - at) / step
            near = max(near, min(one, two))
            far = min(far, max(one, two))
        t = near + 1e-6
        met = 0
        while t < far and met < walls:
            x = int(np.floor(start[0] + t * directions[r, 0]))
            y = int(np.floor(start[1] + t * directions[r, 1]))
            z = int(np.floor(start[2] + t * directions[r, 2]))
            if 0 <= x < shape[0] and 0 <= y < shape[1] and 0 <= z < shape[2]:
                crossed[x, y, z >> 6] |= np.uint64(1) << np.uint64(z & 63)
                if occupied[x, y, z]:
                    met += 1
            t += _STEP


@uncounted
def _add(words, to):
    """Set the bits of words in a row of the same length."""
    for k in range(len(to)):
        to[k] |= words[k]


@uncounted
def _grow_columns(words, steps, out):
    """Write columns of words (Y, W), grown along their bits by fewer than 64 of them, into out."""
    back = np.uint64(64 - steps)
    by = np.uint64(steps)
    last = words.shape[1] - 1
    for y in range(words.shape[0]):
        for w in range(last + 1):
            word = words[y, w]
            out[y, w] = word | (word << by) | (word >> by)
        for w in range(last):
            out[y, w + 1] |= words[y, w] >> back
            out[y, w] |= words[y, w + 1] << back


@kernel
def grow(words, steps, room, grown):
    """Write words (X, Y, W) uint64, grown by 1 to 63 voxels along each axis, into grown; room has the same shape."""
    width, depth, count = words.shape
    size = depth * count
    shift = min(steps, depth) * count
    for x in range(width):
        _grow_columns(words[x], steps, grown[x])
        row = grown[x].reshape(size)
        wide = room[x].reshape(size)
        wide[:] = row
        _add(row[shift:], wide[: size - shift])
        _add(row[: size - shift], wide[shift:])
    for x in range(width):
        row = grown[x].reshape(size)
        row[:] = room[x].reshape(size)
        if x >= steps:
            _add(room[x - steps].reshape(size), row)
        if x + steps < width:
            _add(room[x + steps].reshape(size), row)


@in_parts(lambda voxels, *_: len(voxels))
@kernel
def mark_seen(first, last, voxels, reaches, near, seen):
    """Mark the Gaussians of a range of rows that may be in sight.

    Args:
        first: First row of the range.
        last: Row after the last one.
        voxels: (N,) int32 or int64, the bit of the voxel of each among the bits of all words; negative for those always
            in sight.
        reaches: (N,) int8 index of the reach of each.
        near: (R, V) uint64; the bit of a voxel in row r is set if it lies within reach r of a voxel in sight.
        seen: (N,) bool result.
    """
    for k in range(first, last):
        voxel = voxels[k]
        word = near[reaches[k], voxel >> 6] if voxel >= 0 else np.uint64(1)
        seen[k] = voxel < 0 or (word >> np.uint64(voxel & 63)) & np.uint64(1) != 0
