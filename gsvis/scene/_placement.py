"""Search for the place, heading and size at which a walk fits into navigable space; used by `retarget`.

A few poses of the walk screen each placement; all poses then check it. Scene frame and units.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.similarity import Similarity

__all__ = ["Floors", "Found", "Search", "Walk", "best_placement", "probe_indices"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PROBES = 64  # poses of the walk by which placements are screened
_BLOCK = 64  # placements screened at a time
_FINALISTS = 16
_STEP = 2.0**-0.25  # from one scale to the next
_TOLERANCE = 0.1  # of the eye height, and at least one voxel
_UNEVEN = 0.1  # of the eye height, and at least one voxel, by which a floor may rise or fall
_TIE = 1e-9  # of the walk's size: the first of poses that are equal but for rounding is taken


@dataclass(frozen=True, eq=False)
class Search:
    """Conditions on a placement, and how many placements to try.

    Attributes:
        navigable: Allowed viewpoints.
        enough: Required share of positions inside.
        placements: Number of voxels to try for the middle of the walk.
        choices: Number of placements with enough inside to compare; the one that faces the scene most often wins.
    """

    navigable: NavigableSpace
    enough: float
    placements: int
    choices: int


@dataclass(frozen=True, eq=False)
class Found:
    """A placement: its share of positions inside, its share of poses that face the scene, and its transform."""

    share: float
    look: float
    similarity: Similarity


@dataclass(frozen=True, eq=False)
class Walk:
    """A walk about its middle, for each of Y headings.

    Attributes:
        offsets: (T, 3) positions from the middle, recorded axes.
        rotations: (Y, 3, 3) scene from recorded axes, one for each heading.
        middle: (3,) recorded position that moves to the placement.
        probes: (P,) indices of the poses used for screening.
        forwards: (P, 3) view directions of those poses, recorded axes.
    """

    offsets: F64
    rotations: F64
    middle: F64
    probes: NDArray[np.int64]
    forwards: F64

    @classmethod
    def from_path(cls, path: HeadPath, navigable: NavigableSpace, yaws: int) -> Walk:
        """Return a path with `yaws` headings, about its middle."""
        up = path.upright
        mean = path.positions.mean(axis=0)
        spread = path.positions - mean
        heights = spread @ up
        # Take the pose nearest to the mean on the ground plane. Its height is the usual height, not that of the pose.
        flat = spread - heights[:, None] * up
        far = np.linalg.norm(flat, axis=1)
        size = float(np.linalg.norm(spread, axis=1).max())
        middle = path.positions[(far <= far.min() + _TIE * size).argmax()]
        middle = middle + (np.median(path.positions @ up) - middle @ up) * up
        ahead = flat[(far >= far.max() - _TIE * size).argmax()]
        if np.linalg.norm(ahead) <= 1e-9 * (1.0 + np.abs(path.positions).max()):  # the walk stays in place
            ahead = path.forwards[0] - (path.forwards[0] @ up) * up
            if np.linalg.norm(ahead) < 1e-6:
                ahead = np.eye(3)[np.abs(up).argmin()] - up[np.abs(up).argmin()] * up
        recorded = _frame(up, ahead)
        aim = np.eye(3)[np.abs(navigable.up).argmin()]
        scene = _frame(navigable.up, aim - (aim @ navigable.up) * navigable.up)
        turns = 2.0 * np.pi * np.arange(yaws) / yaws
        yawed = np.zeros((yaws, 3, 3))
        yawed[:, 0, 0] = yawed[:, 1, 1] = np.cos(turns)
        yawed[:, 1, 0], yawed[:, 0, 1] = np.sin(turns), -np.sin(turns)
        yawed[:, 2, 2] = 1.0
        probes = probe_indices(len(path))
        return cls(path.positions - middle, scene @ yawed @ recorded.T, middle, probes, path.forwards[probes])

    def scales(self, navigable: NavigableSpace) -> Iterator[float]:
        """Yield scales, from one at which the walk spans the grid down to one at which it fits into a voxel."""
        size = float(np.linalg.norm(self.offsets, axis=1).max())
        if size <= 1e-12:
            yield 1.0
            return
        scale = float(np.linalg.norm(navigable.free.shape)) * navigable.voxel_size / size
        while scale * size > 0.25 * navigable.voxel_size:
            yield scale
            scale *= _STEP
        yield scale

    def similarity(self, scale: float, yaw: int, place: F64) -> Similarity:
        """Return the transform that takes the middle of the walk to a place in the scene."""
        rotation = self.rotations[yaw]
        return Similarity.from_rotation(scale, rotation, place - scale * rotation @ self.middle)


@dataclass(frozen=True, eq=False)
class Floors:
    """Floors below M places.

    Attributes:
        heights: (M,) distance straight down to the first occupied voxel; infinite if there is none.
        levels: (M,) position of that voxel along the scene's up axis.
        voxel_size: Side of a voxel, scene units.
    """

    heights: F64
    levels: F64
    voxel_size: float

    @classmethod
    def below(cls, places: F64, navigable: NavigableSpace) -> Floors:
        """Return the floors below places (M, 3)."""
        heights = navigable.free_distances(places, np.tile(-navigable.up, (len(places), 1)))
        return cls(heights, places @ navigable.up - heights, navigable.voxel_size)

    def at_height(self, stand: float | None, scale: float) -> Mask | None:
        """Return a mask (M,): whether places are at eye height over the main floor; None without a required height."""
        if stand is None:
            return None
        height = stand * scale
        slack = max(_UNEVEN * height, self.voxel_size)
        levels = np.sort(self.levels[np.isfinite(self.levels)])
        if len(levels) == 0:
            return np.zeros(len(self.levels), bool)
        held = np.searchsorted(levels, levels + 2.0 * slack, side="right") - np.arange(len(levels))
        main = levels[held.argmax()] + slack  # the middle of the band with the most places
        fits = np.abs(self.heights - height) <= max(_TOLERANCE * height, self.voxel_size)
        return np.asarray(fits & (np.abs(self.levels - main) <= slack))


def best_placement(walk: Walk, search: Search, scale: float, places: F64, standing: Mask | None) -> Found | None:
    """Return the placement that faces the scene most often, among the first `choices` with `enough` inside.

    If no placement has enough inside, return the one with the most. Return None if there is no placement.
    """
    if standing is not None:
        places = places[standing]
    places = places[: search.placements]
    navigable = search.navigable
    probes = scale * np.einsum("yij,tj->yti", walk.rotations, walk.offsets[walk.probes])
    best = None
    chosen = 0
    tried: list[tuple[float, int, int]] = []
    for first in range(0, len(places), _BLOCK):
        block = places[first : first + _BLOCK]
        inside = navigable.contains((block[:, None, None, :] + probes[None]).reshape(-1, 3))
        shares = inside.reshape(len(block), len(probes), -1).mean(axis=2)
        likely = shares >= search.enough - 1.5 / len(walk.probes)
        for index in np.flatnonzero(likely.any(axis=1)):
            found = _best_heading(walk, navigable, scale, block[index], np.flatnonzero(likely[index]), search.enough)
            if found is not None:
                best = found if best is None or found.look > best.look else best
                chosen = chosen + 1
                if chosen == search.choices or best.look == 1.0:
                    return best
        for flat in np.argsort(-shares, axis=None, kind="stable")[:_FINALISTS]:
            place, yaw = divmod(int(flat), len(probes))
            tried.append((-float(shares[place, yaw]), first + place, yaw))
    if best is not None or not tried:
        return best
    finalists = [(places[place], yaw) for _, place, yaw in sorted(tried)[:_FINALISTS]]
    final = [_share(walk, navigable, scale, yaw, place) for place, yaw in finalists]
    place, yaw = finalists[int(np.argmax(final))]
    return Found(max(final), 0.0, walk.similarity(scale, yaw, place))


def _best_heading(
    walk: Walk, navigable: NavigableSpace, scale: float, place: F64, headings: NDArray[np.intp], enough: float
) -> Found | None:
    """Return the heading that faces the scene most often among those with enough inside; None without one."""
    best = None
    for yaw in headings.tolist():
        share = _share(walk, navigable, scale, yaw, place)
        if share >= enough:
            eyes = place + scale * walk.offsets[walk.probes] @ walk.rotations[yaw].T
            ahead = navigable.free_distances(eyes, walk.forwards @ walk.rotations[yaw].T)
            look = float(np.isfinite(ahead).mean())
            if best is None or look > best.look:
                best = Found(share, look, walk.similarity(scale, yaw, place))
    return best


def _share(walk: Walk, navigable: NavigableSpace, scale: float, yaw: int, place: F64) -> float:
    """Return the share of the positions that are inside for a placement."""
    return float(navigable.contains(place + scale * walk.offsets @ walk.rotations[yaw].T).mean())


def probe_indices(count: int) -> NDArray[np.int64]:
    """Return up to 64 evenly spaced pose indices."""
    return np.unique(np.linspace(0, count - 1, _PROBES).round().astype(np.int64))


def _frame(up: F64, ahead: F64) -> F64:
    """Return (3, 3) right-handed axes as columns: ahead (made level), left, up."""
    ahead = ahead - (ahead @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(up, ahead), up], axis=1)
