"""A walk through a scene of rooms in copies: from room to room of one, over the street, through another and back."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from _worlds import copies
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from gsvis.scene.gaussians import Gaussians, quats_from_rotations
from gsvis.scene.navigable import NavigableSpace
from gsvis.world.districts import merge_down

F64 = NDArray[np.float64]
Pose = tuple[F64, tuple[float, ...]]

_UP = (0.0, 0.0, 1.0)
_FINE = 384  # voxels along the longest side
_BODY = 0.3, 0.2  # scene units below and above the eyes that have to be clear
_ROOMS = 3  # visited in each copy


def two_copies(scene: Gaussians, gaussians: int) -> tuple[Gaussians, list[Gaussians]]:
    """Return two copies of a scene merged to so many Gaussians, whose doors face each other, with a street; and both.

    The first copy is turned by nothing, the second by half; `copies` mirrors and jitters them by its seed.
    """
    low, high = scene.bounds(0.98)
    near = np.abs(scene.means - 0.5 * (low + high)).max(axis=1) <= float((high - low)[:2].max())
    parts = list(copies(merge_down(scene[near], gaussians), 2, turns=(0, 2)))
    return Gaussians.concatenate(parts), parts[::2]


def walk_of(whole: Gaussians, rooms: list[Gaussians], step: float, seed: int = 0) -> F64:
    """Return (T, 3) positions of a walk through places of all copies and back to the first place.

    Places are drawn where people stand in each copy by itself, the walk is the shortest at the height of an eye that
    keeps away from what is solid.

    Args:
        whole: The world.
        rooms: The copies in it.
        step: Distance between two positions, scene units.
        seed: Seed of the places.
    """
    rng = np.random.default_rng(seed)
    standing = [NavigableSpace.from_scene(each, up=_UP).where_people_stand() for each in rooms]
    drawn = [place.sample_viewpoints(64, rng) for place in standing if place is not None]
    height = float(np.median(np.concatenate(drawn)[:, 2]))
    space = NavigableSpace.from_scene(whole, up=_UP, resolution=_FINE)
    rows = (np.array([height - _BODY[0], height + _BODY[1]]) - space.origin[2]) / space.voxel_size
    solid = space.occupied[:, :, int(rows[0]) : int(rows[1]) + 1].any(axis=2)
    away = ndimage.distance_transform_edt(~solid)
    graph, number = _grid_graph(away)
    reached = np.isfinite(dijkstra(graph, indices=number[np.unravel_index(int(away.argmax()), away.shape)]))
    places = []
    for some in drawn:
        squares = np.floor((some[:, :2] - space.origin[:2]) / space.voxel_size).astype(int)
        inside = ((squares >= 0) & (squares < solid.shape)).all(axis=1)
        found = number[tuple(squares[inside].T)]
        places += [k for k in found.tolist() if k >= 0 and reached[k]][:_ROOMS]
    way = [places[0]]
    for start, end in pairwise([*places, places[0]]):
        before = dijkstra(graph, indices=start, return_predecessors=True)[1]
        leg = [end]
        while leg[-1] != start:
            leg.append(int(before[leg[-1]]))
        way += leg[-2::-1]
    flat = np.argwhere(number >= 0)[way]
    points = space.origin[:2] + space.voxel_size * (flat + 0.5)
    smooth = ndimage.uniform_filter1d(points, 5, axis=0, mode="nearest")
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    at = np.arange(0.0, lengths[-1], step)
    return np.stack([*(np.interp(at, lengths, smooth[:, k]) for k in (0, 1)), np.full(len(at), height)], axis=1)


def poses_along(positions: F64) -> list[Pose]:
    """Return the poses of somebody who looks where the walk leads, and a little to both sides in turn."""
    ahead = ndimage.uniform_filter1d(np.gradient(positions, axis=0)[:, :2], 5, axis=0, mode="nearest")
    angles = np.arctan2(ahead[:, 1], ahead[:, 0]) + 0.5 * np.sin(0.4 * np.arange(len(positions)))
    poses = []
    for position, angle in zip(positions, angles, strict=True):
        forward = np.array([np.cos(angle), np.sin(angle), 0.0])
        right = np.cross(forward, _UP)
        rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
        poses.append((position, tuple(quats_from_rotations(rotation[None])[0].tolist())))
    return poses


def _grid_graph(away: F64) -> tuple[coo_matrix, NDArray[np.int64]]:
    """Return a graph of the squares that are clear by a square or more, and (X, Y) their numbers, -1 for others."""
    number = np.full(away.shape, -1)
    clear = away > 1.5
    number[clear] = np.arange(int(clear.sum()))
    parts = []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        x, y = number.shape
        a = number[: x - dx, max(0, -dy) : y - max(0, dy)]
        b = number[dx:, max(0, dy) : y - max(0, -dy)]
        both = (a >= 0) & (b >= 0)
        near = np.minimum(away[: x - dx, max(0, -dy) : y - max(0, dy)], away[dx:, max(0, dy) : y - max(0, -dy)])[both]
        parts.append((a[both], b[both], np.hypot(dx, dy) * (1.0 + 4.0 / near)))
    first, second, cost = (np.concatenate(column) for column in zip(*parts, strict=True))
    count = int(clear.sum())
    rows, columns = np.concatenate([first, second]), np.concatenate([second, first])
    return coo_matrix((np.tile(cost, 2), (rows, columns)), (count, count)).tocsr(), number
