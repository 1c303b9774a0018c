"""Voxel grids: the fast sums and blocks are those of the plain definitions."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gsvis.scene._eyes import _blocks
from gsvis.scene._kernels.voxels import sum_beyond

SHAPES = [(1, 1, 1), (4, 4, 4), (5, 1, 7), (1, 9, 2), (8, 3, 13)]


@pytest.mark.parametrize("shape", SHAPES)
def test_what_lies_beyond_a_voxel_is_summed_up_to_the_edge(shape: tuple[int, int, int]) -> None:
    depth = np.random.default_rng(0).integers(0, 9, shape).astype(np.float32)  # sums are exact
    for step in itertools.product((-1, 0, 1), repeat=3):
        if not any(step):
            continue
        beyond = np.full(shape, np.nan, np.float32)
        sum_beyond(depth, np.array(step), beyond)
        for voxel in np.ndindex(*shape):
            total, at = 0.0, np.add(voxel, step)
            while np.all((at >= 0) & (at < shape)):
                total, at = total + depth[tuple(at)], at + step
            assert beyond[voxel] == total, (step, voxel)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 1.0])
def test_a_block_gives_the_middle_one_of_its_voxels(shape: tuple[int, int, int], share: float) -> None:
    mask = np.random.default_rng(1).random(shape) < share
    voxels, which = _blocks(mask)
    held: dict[tuple[int, ...], list[tuple[int, ...]]] = {}
    for voxel in map(tuple, np.argwhere(mask).tolist()):
        held.setdefault(tuple(i // 4 for i in voxel), []).append(voxel)
    blocks = sorted(held)
    assert [tuple(voxel) for voxel in voxels.tolist()] == [held[block][len(held[block]) // 2] for block in blocks]
    assert [blocks[i] for i in which] == [tuple(i // 4 for i in voxel) for voxel in np.argwhere(mask).tolist()]
