"""Kernels that count the splats that cover each pixel, and what each of them covers and shows.

Players on a GPU blend every splat of a pixel, also those behind a wall. So all are counted, and apart from them those
up to where the pixel is opaque.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel, njit
from gsvis._kernels.shared import take_next
from gsvis._kernels.threads import in_threads
from gsvis.render._kernels.lanes import LOG2_255, TILE

__all__ = ["count_fill", "sample_fill"]

_OPAQUE = 1e-4  # transmittance at which a pixel is opaque, as in images
_MOST = 0.999  # largest alpha
_MARGIN = 1e-3  # pixels beside the ends of a row, which are tested again


@njit(cache=True)
def _cover(splat, left, top, rows, columns, fill, until, light):
    """Add one splat to the pixels of a tile; return how many it covers, and the sum of its blending weights."""
    covered = 0
    shown = 0.0
    low = max(int(np.ceil(splat[1] - splat[7] - top - 0.5)), 0)
    high = min(int(np.floor(splat[1] + splat[7] - top - 0.5)), rows - 1)
    for r in range(low, high + 1):
        dy = top + r + 0.5 - splat[1]
        # log2 alpha + log2 255 is a parabola along the row; it is positive half a root to either side of its peak
        slope = splat[3] * dy
        level = splat[5] + splat[4] * dy * dy
        root = np.sqrt(max(slope * slope - 4.0 * splat[2] * (level + LOG2_255), 0.0)) / (-2.0 * splat[2])
        peak = splat[0] - slope / (2.0 * splat[2]) - left - 0.5
        first = max(int(np.ceil(peak - root - _MARGIN)), 0)
        last = min(int(np.floor(peak + root + _MARGIN)), columns - 1)
        for k in range(first, last + 1):
            dx = left + k + 0.5 - splat[0]
            log2_alpha = level + dx * (slope + splat[2] * dx)
            if log2_alpha < -LOG2_255:
                continue
            covered += 1
            fill[top + r, left + k] += 1
            if light[r, k] <= _OPAQUE:
                continue
            until[top + r, left + k] += 1
            alpha = min(2.0**log2_alpha, _MOST)
            shown += alpha * light[r, k]
            light[r, k] *= 1.0 - alpha
    return covered, shown


@in_threads(lambda splats, offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def count_fill(taken, splats, offsets, members, pair_of, tiles_x, fill, until, pairs):
    """Write the splats over each pixel, those until it is opaque, and pixels and weight of each pair.

    `fill` and `until` are (H, W) int32 zeros; `pairs` (P, 2) float32.
    """
    height, width = fill.shape
    tiles = len(offsets) - 1
    tile = take_next(taken)
    while tile < tiles:
        left = (tile % tiles_x) * TILE
        top = (tile // tiles_x) * TILE
        rows = min(TILE, height - top)
        columns = min(TILE, width - left)
        light = np.ones((rows, columns))
        for place in range(offsets[tile], offsets[tile + 1]):
            covered, shown = _cover(splats[members[place]], left, top, rows, columns, fill, until, light)
            pairs[pair_of[place], 0] = covered
            pairs[pair_of[place], 1] = shown
        tile = take_next(taken)


@njit(cache=True)
def _sample_part(splats, begin, end, step, fill):
    """Count splats begin..end over sampled pixels; see `sample_fill`."""
    first = step // 2 + 0.5
    for m in range(begin, end):
        splat = splats[m]
        low = max(int(np.ceil((splat[1] - splat[7] - first) / step)), 0)
        high = min(int(np.floor((splat[1] + splat[7] - first) / step)), fill.shape[0] - 1)
        left = max(int(np.ceil((splat[0] - splat[6] - first) / step)), 0)
        right = min(int(np.floor((splat[0] + splat[6] - first) / step)), fill.shape[1] - 1)
        for r in range(low, high + 1):
            dy = r * step + first - splat[1]
            level = splat[5] + splat[4] * dy * dy
            for k in range(left, right + 1):
                dx = k * step + first - splat[0]
                if level + dx * (splat[3] * dy + splat[2] * dx) >= -LOG2_255:
                    fill[r, k] += 1


@in_threads(lambda splats, step, fills: len(fills))
@kernel(error_model="numpy")
def sample_fill(taken, splats, step, fills):
    """Count the splats over every `step`-th pixel along both axes, beginning with the middle of the first `step`.

    `splats` (M, 8); `fills` (P, rows, columns) int32 zeros, one for each of P parts of the splats; their sum is the
    fill. A splat covers a pixel as in `count_fill`.
    """
    part = take_next(taken)
    while part < len(fills):
        _sample_part(
            splats, len(splats) * part // len(fills), len(splats) * (part + 1) // len(fills), step, fills[part]
        )
        part = take_next(taken)
