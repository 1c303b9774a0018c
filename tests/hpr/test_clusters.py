"""Clusters of Gaussians: their bounds hold for every member, on every face, from every eye."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.hpr import Splats
from gsvis.hpr._kernels.clusters import list_clusters, place_clusters
from gsvis.hpr._kernels.reach import CLUSTER
from gsvis.scene.gaussians import Gaussians

NEAR, CLAMP, DILATION = 0.01, 1.3, 0.3


def scattered(seed: int, count: int = 700) -> Gaussians:
    """Gaussians in a few clumps, of all sizes, some of them around the eye."""
    rng = np.random.default_rng(seed)
    clumps = rng.normal(size=(12, 3)) * 3.0
    means = clumps[rng.integers(0, 12, count)] + rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-2, 0.3, (count, 1))
    quats = rng.normal(size=(count, 4))
    scales = 10.0 ** rng.uniform(-4, 0.5, (count, 3))
    opacities = rng.uniform(0.01, 1.0, count)
    return Gaussians(means, quats, scales, opacities, np.zeros((count, 1, 3)))


def squares_of_members(splats: Splats, eye: np.ndarray, face: int, size: int) -> np.ndarray:
    """First and last column and row that each row of the table may reach, in float64; -1 where none."""
    axis = face // 2
    u, v = (a for a in range(3) if a != axis)
    toward = splats.near[:, :3].astype(np.float64) - eye
    z = toward[:, axis] * (1.0 if face % 2 == 0 else -1.0)
    found = np.full((len(z), 4), -1, np.int64)
    tangents = toward[:, [u, v]] / np.where(z > NEAR, z, 1.0)[:, None]
    clamped = np.clip(tangents, -CLAMP, CLAMP)
    wide = splats.near[:, 3] * 0.5 * size / np.where(z > NEAR, z, 1.0)
    radius = splats.near[:, 4] * np.sqrt(wide**2 * (1.0 + (clamped**2).sum(axis=1)) + DILATION)
    center = 0.5 * size * (tangents + 1.0)
    low = np.maximum(np.ceil(center - radius[:, None] - 0.5), 0)
    high = np.minimum(np.floor(center + radius[:, None] - 0.5), size - 1)
    reaches = (z > NEAR) & (low <= high).all(axis=1)
    found[reaches] = np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], axis=1)[reaches]
    return found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", [5, 200, 4096])
def test_a_cluster_bounds_its_members(seed: int, size: int) -> None:
    splats = Splats.from_gaussians(scattered(seed))
    eye = np.random.default_rng(seed + 9).normal(size=3).astype(np.float32)
    count = len(splats.bounds)
    assert count == -(-len(splats.near) // CLUSTER)
    nearest, boxes = np.empty(count, np.float32), np.empty((6, count, 4), np.int16)
    place_clusters(splats.bounds, eye, size, nearest, boxes)
    lists, counts = np.empty((6, count), np.int64), np.empty(6, np.int64)
    placed = np.empty_like(boxes)
    list_clusters(np.argsort(nearest, kind="stable"), boxes, lists, placed, counts)
    cluster = np.arange(len(splats.near)) // CLUSTER
    x, y, z = (splats.near[:, :3] - eye).T
    assert (x * x + y * y + z * z >= nearest[cluster]).all()
    for face in range(6):
        reached = squares_of_members(splats, eye.astype(np.float64), face, size)
        reaches = reached[:, 0] >= 0
        box, own = boxes[face][cluster[reaches]].astype(np.int64), reached[reaches]
        assert (box[:, [0, 2]] <= own[:, [0, 2]]).all()
        assert (box[:, [1, 3]] >= own[:, [1, 3]]).all()
        listed = lists[face, : counts[face]]
        assert np.isin(cluster[reaches], listed).all()
        assert (np.diff(nearest[listed]) >= 0).all()
        assert (placed[face, : counts[face]] == boxes[face][listed]).all()


def test_clusters_of_other_directions_are_left_out() -> None:
    rng = np.random.default_rng(0)
    means = rng.normal(size=(CLUSTER, 3)) * 0.1 + np.array([5.0, 0.0, 0.0])
    g = Gaussians(means, np.tile([1.0, 0, 0, 0], (CLUSTER, 1)), np.full((CLUSTER, 3), 0.01), np.full(CLUSTER, 0.9),
                  np.zeros((CLUSTER, 1, 3)))  # fmt: skip
    splats = Splats.from_gaussians(g)
    nearest, boxes = np.empty(1, np.float32), np.empty((6, 1, 4), np.int16)
    place_clusters(splats.bounds, np.zeros(3, np.float32), 320, nearest, boxes)
    lists, counts = np.empty((6, 1), np.int64), np.empty(6, np.int64)
    list_clusters(np.zeros(1, np.int64), boxes, lists, np.empty_like(boxes), counts)
    assert counts.tolist() == [1, 0, 0, 0, 0, 0]
    assert (boxes[0, 0, 1] - boxes[0, 0, 0]) < 60
