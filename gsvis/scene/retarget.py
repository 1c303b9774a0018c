"""Transform a recorded walk into the navigable space of a scene, by one similarity transform.

The walk is set upright, rotated, scaled and moved as a whole, so that its poses lie in navigable space. Scale:

1. the given scale, if any;
2. else the natural scale, if the unit of both is known in meters;
3. else about the largest scale at which a share `enough` of the positions is inside.

With 2 and 3, and a recording in meters, people stand: the middle of the walk is put at eye height above the floor below
it, on the story with the most room, not on roofs. Placements are tried in an order drawn from the seed. Among the first
few with `enough` inside, the placement in which the walk faces the scene most often wins (with 3, also at scales
somewhat below the largest). If none has enough inside, the one with the most wins. The recording's own frame
(origin, heading, with rule 3 also the unit) has no influence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.scene._placement import Floors, Found, Search, Walk, best_placement, probe_indices
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.similarity import Similarity

__all__ = ["RetargetConfig", "RetargetedPath", "retarget"]

F64 = NDArray[np.float64]

_UPRIGHT = np.cos(np.radians(1.0))


@dataclass(frozen=True)
class RetargetConfig:
    """Options of `retarget`.

    Attributes:
        scale: Scene units per unit of the walk; None finds it by the rule of this module.
        meters_per_unit: Size of a scene unit; None if unknown.
        eye_height: Eye height of people in meters; None lets a walk float.
        enough: Required share of positions inside, in (0, 1].
        yaws: Number of headings to try.
        placements: Number of voxels to try for the middle of the walk.
        choices: Number of placements with enough inside to compare; the one that faces the scene most often wins.
        shrink: Smallest share of the largest scale that rule 3 may use to face the scene more often; 1 keeps the
            largest.
        project: Whether to move positions that still lie outside into the nearest navigable voxel.
        keep: Whether to keep a walk unchanged that is already upright and inside.
        seed: Seed of the order in which placements are tried; each seed gives a different place.
    """

    scale: float | None = None
    meters_per_unit: float | None = None
    eye_height: float | None = 1.6
    enough: float = 0.99
    yaws: int = 16
    placements: int = 1024
    choices: int = 8
    shrink: float = 0.7
    project: bool = False
    keep: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("scale", "meters_per_unit", "eye_height"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a finite number > 0 or None, got {value!r}")
        for name in ("enough", "shrink"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name}: expected a share in (0, 1], got {getattr(self, name)!r}")
        for name in ("yaws", "placements", "choices"):
            _check.positive_int(name, getattr(self, name))
        _check.positive_int("seed", self.seed, at_least=0)


@dataclass(frozen=True, eq=False)
class RetargetedPath:
    """A walk in its new scene, with its transform.

    Attributes:
        path: The walk, in the scene's frame and units.
        similarity: Transform from the recorded frame to the scene's.
        inside: Share of the positions in navigable space, before any move.
        looking: Share of poses with part of the scene straight ahead, over up to 64 poses along the walk.
        moved: Number of positions moved into the nearest navigable voxel; 0 without `project`.
        farthest_move: Length of the longest such move, scene units.
        rule: Name of the rule that chose the scale and the place.
    """

    path: HeadPath
    similarity: Similarity
    inside: float
    looking: float
    moved: int
    farthest_move: float
    rule: str

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists, ready for JSON; without the poses."""
        return {
            "similarity": self.similarity.as_dict(),
            "poses": len(self.path),
            "duration_s": self.path.duration,
            "length": self.path.length,
            "inside": self.inside,
            "looking": self.looking,
            "moved": self.moved,
            "farthest_move": self.farthest_move,
            "rule": self.rule,
        }


def retarget(path: HeadPath, navigable: NavigableSpace, config: RetargetConfig | None = None) -> RetargetedPath:
    """Transform a recorded walk into a scene's navigable space.

    Args:
        path: The walk, in any frame and unit.
        navigable: Allowed viewpoints in the scene.
        config: Scale, search and seed; None means `RetargetConfig()`.

    Returns:
        The walk in the scene's frame, its transform, and the share of positions inside. With a fixed scale (rules 1 and
        2) this share can be below `enough`; with rule 3 it cannot.
    """
    config = config or RetargetConfig()
    if config.keep and config.scale in (None, 1.0) and float(path.upright @ navigable.up) >= _UPRIGHT:
        share = float(navigable.contains(path.positions).mean())
        if share >= config.enough:
            return _finish(path, navigable, config, Similarity(), "kept: upright and inside as it is")
    similarity, rule = _search(path, navigable, config)
    return _finish(path, navigable, config, similarity, rule)


def _finish(
    path: HeadPath, navigable: NavigableSpace, config: RetargetConfig, similarity: Similarity, rule: str
) -> RetargetedPath:
    """Return the transformed walk with its figures."""
    there = replace(path.transform(similarity), up=navigable.up)
    if config.meters_per_unit is not None:
        there = replace(there, meters_per_unit=config.meters_per_unit)
    inside = navigable.contains(there.positions)
    share = float(inside.mean())
    moved = 0
    farthest = 0.0
    if config.project and not inside.all():
        outside = np.flatnonzero(~inside)
        positions = there.positions.copy()
        positions[outside] = _nearest_inside(navigable, positions[outside])
        moves = np.linalg.norm(positions[outside] - there.positions[outside], axis=1)
        there = replace(there, positions=positions)
        moved = len(outside)
        farthest = float(moves.max())
        rule += "; positions outside moved into the nearest navigable voxel"
    some = probe_indices(len(there))
    looking = float(np.isfinite(navigable.free_distances(there.positions[some], there.forwards[some])).mean())
    return RetargetedPath(there, similarity, share, looking, moved, farthest, rule)


def _search(path: HeadPath, navigable: NavigableSpace, config: RetargetConfig) -> tuple[Similarity, str]:
    """Return the transform of the best placement, and the rule that found it."""
    walk = Walk.from_path(path, navigable, config.yaws)
    search = Search(navigable, config.enough, config.placements, config.choices)
    voxels = np.flatnonzero(navigable.free)
    order = np.random.default_rng(config.seed).permutation(len(voxels))[: 8 * config.placements]
    cells = np.stack(np.unravel_index(voxels[order], navigable.free.shape), axis=1)
    places = navigable.origin + navigable.voxel_size * (cells + 0.5)
    scale = config.scale
    rule = "given scale"
    if scale is None and config.meters_per_unit is not None and path.meters_per_unit is not None:
        scale = path.meters_per_unit / config.meters_per_unit
        rule = "natural scale"
    stand = None  # eye height in units of the walk
    if config.eye_height is not None and path.meters_per_unit is not None and config.scale is None:
        stand = config.eye_height / path.meters_per_unit
    floors = Floors.below(places, navigable) if stand is not None else None
    if scale is not None:
        standing = floors.at_height(stand, scale) if floors is not None else None
        found = best_placement(walk, search, scale, places, standing)
        if found is not None and stand is not None:
            rule += f", standing with the eyes at {config.eye_height:g} m"
        elif stand is not None:
            rule += f", floating: no place {config.eye_height:g} m above a floor"
        found = found or best_placement(walk, search, scale, places, None)
        assert found is not None
        return found.similarity, rule
    for height in (stand, None) if stand is not None else (None,):
        found = _largest(walk, search, config.shrink, places, floors, height)
        if found is not None:
            break
    assert found is not None  # a walk within one voxel is always inside
    rule = f"largest scale with {config.enough:g} of the positions inside, or {config.shrink:g} of it to see more"
    if stand is None:
        return found.similarity, rule
    standing_as = f"standing as if {config.eye_height:g} m above what lies below"
    return found.similarity, f"{rule}, {'floating: no floor' if height is None else standing_as}"


def _largest(
    walk: Walk, search: Search, shrink: float, places: F64, floors: Floors | None, stand: float | None
) -> Found | None:
    """Return a placement at about the largest scale with `enough` inside; None if none has that eye height."""
    best = None
    largest = 0.0
    for scale in walk.scales(search.navigable):
        if best is not None and (best.look == 1.0 or scale < shrink * largest):
            break
        standing = floors.at_height(stand, scale) if floors is not None else None
        found = best_placement(walk, search, scale, places, standing)
        if found is not None and found.share >= search.enough and (best is None or found.look > best.look):
            best = found
            largest = largest or scale
    return best


def _nearest_inside(navigable: NavigableSpace, points: F64) -> F64:
    """Return (M, 3) points moved into the navigable voxel nearest to their own (or to their nearest on the grid)."""
    from scipy import ndimage  # slow to import, seldom needed

    shape = np.array(navigable.free.shape)
    cells = np.clip(np.floor((points - navigable.origin) / navigable.voxel_size), 0, shape - 1).astype(np.int64)
    nearest = ndimage.distance_transform_edt(~navigable.free, return_distances=False, return_indices=True)
    target = np.stack([nearest[axis][tuple(cells.T)] for axis in range(3)], axis=1)
    low = navigable.origin + navigable.voxel_size * target
    margin = 1e-3 * navigable.voxel_size  # off the faces, so that rounding never puts a point into the next one
    return np.asarray(np.clip(points, low + margin, low + navigable.voxel_size - margin))
