"""Find where eyes may be in a scene of many places, such as flats along a street, piece by piece.

A grid over a whole scene shows its rooms as long as they are many voxels wide. In a larger scene they close up, and
eyes are left above roofs or on the street alone, for which nothing inside counts. Therefore each piece is looked at by
itself, with what is around it, as a tile of a world is: rooms, and open ground. Where the grid over the whole shows
most of what pieces show, it stays: it knows better what is inside and what is outside. Else eyes are in both. From far
enough, a city is an object: such a scene is one only if most of its pieces are, too.
Scene frame and units. docs/design/099-many-places.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import AXES, axis_vector
from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace
from gsvis.world.graph import Facts
from gsvis.world.tiles import MARGIN, mixed_space_of_tile, near_tile
from gsvis.world.tiling import sampling_interval, thin_out

__all__ = [
    "AROUND",
    "PIECE",
    "Piece",
    "find_in_pieces",
    "is_well_known",
    "join_pieces",
    "lay_pieces",
    "space_near",
    "space_of_piece",
]

F64 = NDArray[np.float64]

PIECE = 500_000
"""Gaussians of a piece, about."""

AROUND = 0.75
"""How far beyond a piece it is looked at, in its side."""

Piece = tuple[int, NavigableSpace | None]
"""The Gaussians of a piece, and where eyes may be in it."""

_SEEN = 0.5  # least share of the Gaussians that eyes see from rooms that are all there is
_SHOWN = 0.5  # least share of the space of pieces that the whole has, for it to stay as it is
_HELD = 0.5  # least share of the Gaussians in pieces with a place, for an object to be none
_VOXELS = 100  # along the side of a piece
_ALONE = 96  # along the longest side of a piece that may be an object
_CELLS = 256  # along the longer side of a scene, in which it is counted how dense it is
_FEWEST = 4  # Gaussians of the sample in a piece
_COVERAGE = 0.98  # of the centers on each axis, within the lattice
_MOST_VOXELS = 1 << 24  # of the grid of all pieces
_TARGETS = 4096


def is_well_known(space: NavigableSpace) -> bool:
    """Return whether the grid over a whole scene shows it: rooms from which most of its Gaussians are seen."""
    found = space.kind
    return found.kind == "rooms" and found.evidence is not None and found.evidence.seen_within >= _SEEN


def find_in_pieces(core: Gaussians, whole: NavigableSpace, *, most: int = PIECE) -> NavigableSpace:
    """Return where eyes may be in a scene, by its pieces if the grid over all of it does not show them.

    Args:
        core: What hides things.
        whole: Where eyes may be by a grid over all of it.
        most: Gaussians of a piece, about.
    """
    if is_well_known(whole) or len(core) <= most:
        return whole
    every = sampling_interval(len(core))
    is_object, pieces = whole.kind.kind == "object", list[Piece]()
    for square in lay_pieces(thin_out(core, every), every, _axis_of(whole.up), most):
        near, own = core[near_tile(core.means, square, AROUND)], near_tile(core.means, square, 0.0)
        pieces.append((int(np.count_nonzero(own)), space_of_piece(near, square, is_object)))
    return join_pieces(whole, pieces)


def lay_pieces(sample: Gaussians, every: int, up: str, most: int = PIECE) -> list[Facts]:
    """Lay a lattice of squares over a scene, as wide as what holds so many Gaussians where it is as dense as mostly.

    Args:
        sample: One in `every` of its Gaussians that can be seen.
        every: One of how many.
        up: Axis that points upward, such as "+z".
        most: Gaussians of a piece, about.

    Returns:
        Of each square that holds some of the sample: `low` and `high` on the two `axes` that are level, `up`, and the
        `resolution` of its space.
    """
    axes = [k for k in range(3) if k != int(np.abs(axis_vector(up)).argmax())]
    low, high = (each[axes] for each in sample.bounds(_COVERAGE))
    across = sample.means[:, axes].astype(np.float64)
    across = across[((across >= low) & (across <= high)).all(axis=1)]
    longest = float((high - low).max())
    if not longest > 0.0:
        return []
    cells = np.floor((across - low) / longest * (_CELLS - 1e-6)).astype(np.int64)
    counts = np.bincount(cells[:, 0] * _CELLS + cells[:, 1])
    most_often = float(np.median(np.repeat(counts, counts)))  # of the cells of all Gaussians
    side = longest / _CELLS * float(np.sqrt(most / (every * most_often)))
    places, held = np.unique(np.floor((across - low) / side).astype(np.int64), axis=0, return_counts=True)
    low_high = [(low + side * at, low + side * (at + 1)) for at in places[held >= _FEWEST]]
    same = {"axes": axes, "up": up, "resolution": round(_VOXELS * (1.0 + 2.0 * MARGIN))}
    return [{"low": first.tolist(), "high": last.tolist(), **same} for first, last in low_high]


def space_of_piece(near: Gaussians, square: Facts, is_object: bool) -> NavigableSpace | None:
    """Return where eyes may be in a piece; None if nowhere.

    Args:
        near: What hides things in it and around it.
        square: Where it lies, see `lay_pieces`.
        is_object: Whether the whole scene was taken for an object. A piece that looks like one has no place then.
    """
    if is_object:
        try:
            alone = NavigableSpace.from_scene(near, resolution=_ALONE, up=square["up"])
        except SceneError:
            return None
        if alone.kind.kind == "object":
            return None
    return mixed_space_of_tile(near, square)


def join_pieces(whole: NavigableSpace, pieces: Sequence[Piece]) -> NavigableSpace:
    """Return where eyes may be by a grid over a scene and by its pieces; that of the grid if it shows most of theirs.

    Args:
        whole: The space of the scene.
        pieces: The space of each piece within its squares.
    """
    spaces = [space for _, space in pieces if space is not None]
    volume = sum(space.volume for space in spaces)
    shown = sum(_volume_within(space, whole) for space in spaces)
    if shown >= _SHOWN * volume:
        return whole
    held = sum(count for count, space in pieces if space is not None)
    if whole.kind.kind == "object" and held < _HELD * sum(count for count, _ in pieces):
        return whole
    return _join(whole, spaces)


def space_near(space: NavigableSpace, square: Facts) -> NavigableSpace | None:
    """Return a space within the margin of a tile or piece; None if nothing of it is there."""
    low, high, axes = (np.array(square[name]) for name in ("low", "high", "axes"))
    margin = MARGIN * float((high - low).max())
    first, last = np.zeros(3, int), np.array(space.free.shape)
    places = (np.stack([low - margin, high + margin]) - space.origin[axes]) / space.voxel_size
    first[axes] = np.clip(np.floor(places[0]), 0, last[axes] - 1)
    last[axes] = np.clip(np.ceil(places[1]), first[axes] + 1, last[axes])
    some = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
    if not space.free[some].any():
        return None
    origin, end = space.origin + space.voxel_size * first, space.origin + space.voxel_size * last
    targets = space.targets[((space.targets >= origin) & (space.targets < end)).all(axis=1)]
    return replace(space, origin=origin, free=space.free[some], occupied=space.occupied[some], targets=targets)


def _volume_within(piece: NavigableSpace, whole: NavigableSpace) -> float:
    """Return how much of the space of a piece lies in that of the whole scene."""
    middles = piece.origin + piece.voxel_size * (np.argwhere(piece.free) + 0.5)
    return float(np.count_nonzero(whole.contains(middles))) * piece.voxel_size**3


def _join(whole: NavigableSpace, spaces: Sequence[NavigableSpace]) -> NavigableSpace:
    """Return the space of a scene and that of its pieces on one grid, with voxels as in most pieces, or larger."""
    every = spaces if whole.kind.kind == "object" else [whole, *spaces]  # no object, so nobody looks from around it
    low = np.min([each.origin for each in every], axis=0)
    high = np.max([each.origin + each.voxel_size * np.array(each.free.shape) for each in every], axis=0)
    finest = float(np.cbrt((high - low).prod() / _MOST_VOXELS))
    size = max(float(np.median([each.voxel_size for each in spaces])), finest)
    x, y, z = (int(n) for n in np.ceil((high - low) / size))
    free, occupied, by_piece = (np.zeros((x, y, z), bool) for _ in range(3))
    for each in reversed(every):  # the whole comes last: its walls are wider
        block, free_there, occupied_there = each.on_grid(low, size, (x, y, z))
        free[block] |= free_there
        occupied[block] |= occupied_there & ~by_piece[block] if each is whole else occupied_there
        by_piece[block] = True
    targets = np.concatenate([each.targets for each in spaces])
    some = np.linspace(0, len(targets) - 1, min(len(targets), _TARGETS)).astype(np.int64)
    places = f"in rooms and on open ground of {len(spaces)} pieces of it"
    if every is spaces:
        kind = SpaceKind("rooms", "many places", whole.kind.evidence, places)
    else:
        kind = replace(whole.kind, eyes=f"{whole.kind.eyes}, and {places}")
    rule, occupied = f"{whole.rule}; and by pieces", occupied & ~free
    return NavigableSpace(low, size, free, whole.up, occupied, targets[some], rule, kind, 1 + len(spaces))


def _axis_of(up: F64) -> str:
    """Return the name of the axis nearest to a direction."""
    return max(AXES, key=lambda name: float(axis_vector(name) @ up))
