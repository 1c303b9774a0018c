"""Which blocks of a tile a Gaussian reaches: all that have a pixel which sees it, however thin and far it is."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from gsvis.render._kernels.lanes import (
    BLOCKS,
    CENTER_X,
    CENTER_Y,
    LOG2_255,
    RECORD,
    SIDE,
    TILE,
    find_reached_blocks,
)

COUNT = 4000


@njit
def _find_all(records, gates, out):  # type: ignore[no-untyped-def]
    for j in range(len(records)):
        out[j] = find_reached_blocks(records, j, gates, np.float32(0.0))


def thin_and_far(kind: str) -> NDArray[np.float32]:
    """Records of Gaussians near a tile: c, lx, ly, A, B, C of log2 alpha, and the center."""
    rng = np.random.default_rng(3)
    away = {"near": 4.0, "far": 300.0}[kind] * rng.normal(size=COUNT)
    turn = rng.uniform(0.0, np.pi, COUNT)
    short = 0.3 + rng.exponential(1.0, COUNT)  # variance in square pixels, at least that of the blur
    long = short + away**2 * rng.uniform(0.1, 1.0, COUNT)
    axes = np.stack([np.stack([np.cos(turn), np.sin(turn)], 1), np.stack([-np.sin(turn), np.cos(turn)], 1)], 1)
    center = rng.uniform(-2.0, TILE + 2.0, (COUNT, 2)) + away[:, None] * axes[:, 0]
    conic = np.einsum("nk,nki,nkj->nij", 1.0 / np.stack([long, short], 1), axes, axes)
    a, b, c = -0.5 / np.log(2.0) * np.stack([conic[:, 0, 0], 2.0 * conic[:, 0, 1], conic[:, 1, 1]])
    level = np.log2(rng.uniform(1.0 / 255.0, 1.0, COUNT))
    x, y = center.T
    records = np.zeros((COUNT, RECORD), np.float32)
    records[:, 0] = level + a * x * x + b * x * y + c * y * y
    records[:, 1] = -(2.0 * a * x + b * y)
    records[:, 2] = -(2.0 * c * y + b * x)
    records[:, 3:6] = np.stack([a, b, c], 1)
    records[:, CENTER_X] = x
    records[:, CENTER_Y] = y
    return records


@pytest.mark.parametrize("kind", ["near", "far"])
def test_no_block_with_a_pixel_that_sees_the_gaussian_is_left_out(kind: str) -> None:
    records = thin_and_far(kind)
    found = np.empty(COUNT, np.int64)
    _find_all(records, np.full(BLOCKS, np.inf, np.float32), found)
    reached = (found[:, None] >> np.arange(BLOCKS)) & 1 == 1
    c, lx, ly, a, b, square = records[:, :6].T.astype(np.float64)[:, :, None, None]
    y, x = np.mgrid[:TILE, :TILE]
    power = c + lx * x + ly * y + a * x * x + b * x * y + square * y * y
    sees = (power >= -LOG2_255).reshape(COUNT, SIDE, SIDE, SIDE, SIDE).any(axis=(2, 4)).reshape(COUNT, BLOCKS)
    assert sees.any(axis=1).sum() > COUNT // 20
    assert not (sees & ~reached).any()
    assert reached.sum() < 1.2 * sees.sum()  # and few for nothing


def test_blocks_behind_their_gates_are_not_reached() -> None:
    records = thin_and_far("near")
    found = np.empty(COUNT, np.int64)
    gates = np.where(np.arange(BLOCKS) % 3 == 0, -1.0, 1.0).astype(np.float32)
    _find_all(records, gates, found)
    assert np.bitwise_or.reduce(found) == sum(1 << block for block in range(BLOCKS) if block % 3)
