"""Bringing a recorded walk into the navigable space of another scene, by one similarity transform that is stated.

The walk is stood upright, turned, scaled and moved, all of it alike, so that its poses lie in navigable space. Scale:

1. the one that is given;
2. else, where the sizes of both are known in metres, the natural one;
3. else about the largest at which a share `enough` of the positions is inside.

With 2 and 3, and a recording in metres, people stand: the middle of the walk is put at eye height above what lies below
it, on the storey with the most room, not on roofs. Placements are tried in an order drawn from the seed; of the first
few with `enough` inside, the place and heading are taken with which the walk looks at the scene most often, not into
the void around it (with 3, also at scales somewhat below the largest). If none has enough, it is the one with the most.
What the recording's own frame was (its origin, its heading, with rule 3 its unit) has no influence.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsvis import _check
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.similarity import Similarity

__all__ = ["RetargetConfig", "RetargetedPath", "retarget"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PROBES = 64  # poses of the walk by which placements are screened
_BLOCK = 64  # placements screened at a time
_FINALISTS = 16
_STEP = 2.0**-0.25  # from one scale to the next
_TOLERANCE = 0.1  # of the eye height, and at least one voxel
_UNEVEN = 0.1  # of the eye height, and at least one voxel, by which a floor may rise or fall
_TIE = 1e-9  # of the walk's size: the first of poses that are equal but for rounding is taken
_UPRIGHT = np.cos(np.radians(1.0))


@dataclass(frozen=True)
class RetargetConfig:
    """How a walk is brought into a scene.

    Attributes:
        scale: Scene units for one unit of the walk; None finds it by the rule of this module.
        metres_per_unit: Size of a scene unit; None where it is not known.
        eye_height: Metres at which people carry their eyes; None lets a walk float.
        enough: Share of the positions, in (0, 1], that is to lie inside.
        yaws: Headings tried.
        placements: Voxels tried for the middle of the walk.
        choices: Placements with enough inside among which the one that looks at the scene most often is taken.
        shrink: Smallest share of the largest scale that rule 3 may take for the sake of looking; 1 takes the largest.
        project: Move positions that still lie outside into the nearest navigable voxel.
        keep: Leave a walk alone that is upright and inside as it is.
        seed: Of the order in which placements are tried: another seed, another place.
    """

    scale: float | None = None
    metres_per_unit: float | None = None
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
        for name in ("scale", "metres_per_unit", "eye_height"):
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
    """A walk in its new scene, and how it got there.

    Attributes:
        path: The walk, in the scene's frame and units.
        similarity: Takes the recorded frame to the scene's.
        inside: Share of the positions in navigable space, before any was moved.
        looking: Share of the poses that have something of the scene straight ahead, of up to 64 along the walk.
        moved: Number of positions that were moved into the nearest navigable voxel; 0 unless that was asked for.
        farthest_move: Longest of these moves, scene units.
        rule: Which rule chose the scale and the place.
    """

    path: HeadPath
    similarity: Similarity
    inside: float
    looking: float
    moved: int
    farthest_move: float
    rule: str

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, ready for JSON; without the poses."""
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
    """Bring a recorded walk into a scene's navigable space.

    Args:
        path: The walk, in any frame and unit.
        navigable: Where eyes may be in the scene.
        config: Scale, search and seed; None means `RetargetConfig()`.

    Returns:
        The walk in the scene's frame, its transform, and the share of positions inside. With the scale fixed (rules 1
        and 2) that share can be below `enough`; with rule 3 it cannot.
    """
    config = config or RetargetConfig()
    if config.keep and config.scale in (None, 1.0) and float(path.upright @ navigable.up) >= _UPRIGHT:
        share = float(navigable.contains(path.positions).mean())
        if share >= config.enough:
            return _finished(path, navigable, config, Similarity(), "kept: upright and inside as it is")
    similarity, rule = _search(path, navigable, config)
    return _finished(path, navigable, config, similarity, rule)


def _finished(
    path: HeadPath, navigable: NavigableSpace, config: RetargetConfig, similarity: Similarity, rule: str
) -> RetargetedPath:
    there = replace(path.transformed(similarity), up=navigable.up)
    if config.metres_per_unit is not None:
        there = replace(there, metres_per_unit=config.metres_per_unit)
    inside = navigable.contains(there.positions)
    share, moved, farthest = float(inside.mean()), 0, 0.0
    if config.project and not inside.all():
        outside = np.flatnonzero(~inside)
        positions = there.positions.copy()
        positions[outside] = _nearest_inside(navigable, positions[outside])
        moves = np.linalg.norm(positions[outside] - there.positions[outside], axis=1)
        there = replace(there, positions=positions)
        moved, farthest = len(outside), float(moves.max())
        rule += "; positions outside moved into the nearest navigable voxel"
    some = _probes(len(there))
    looking = float(np.isfinite(_free_ahead(navigable, there.positions[some], there.forwards[some])).mean())
    return RetargetedPath(there, similarity, share, looking, moved, farthest, rule)


def _search(path: HeadPath, navigable: NavigableSpace, config: RetargetConfig) -> tuple[Similarity, str]:
    walk = _Walk.of(path, navigable, config.yaws)
    voxels = np.flatnonzero(navigable.free)
    order = np.random.default_rng(config.seed).permutation(len(voxels))[: 8 * config.placements]
    cells = np.stack(np.unravel_index(voxels[order], navigable.free.shape), axis=1)
    places = navigable.origin + navigable.voxel_size * (cells + 0.5)
    scale, told = config.scale, "given scale"
    if scale is None and config.metres_per_unit is not None and path.metres_per_unit is not None:
        scale, told = path.metres_per_unit / config.metres_per_unit, "natural scale"
    stand = None  # eye height in units of the walk
    if config.eye_height is not None and path.metres_per_unit is not None and config.scale is None:
        stand = config.eye_height / path.metres_per_unit
    floors = _Floors.below(places, navigable) if stand is not None else None
    if scale is not None:
        standing = floors.at_height(stand, scale) if floors is not None else None
        found = _place(walk, navigable, config, scale, places, standing)
        if found is not None and stand is not None:
            told += f", standing with the eyes at {config.eye_height:g} m"
        elif stand is not None:
            told += f", floating: no place {config.eye_height:g} m above a floor"
        found = found or _place(walk, navigable, config, scale, places, None)
        assert found is not None
        return found.similarity, told
    for height in (stand, None) if stand is not None else (None,):
        found = _largest(walk, navigable, config, places, floors, height)
        if found is not None:
            break
    assert found is not None  # a walk within one voxel is always inside
    told = f"largest scale with {config.enough:g} of the positions inside, or {config.shrink:g} of it to see more"
    if stand is None:
        return found.similarity, told
    standing_as = f"standing as if {config.eye_height:g} m above what lies below"
    return found.similarity, f"{told}, {'floating: no floor' if height is None else standing_as}"


def _largest(
    walk: _Walk,
    navigable: NavigableSpace,
    config: RetargetConfig,
    places: F64,
    floors: _Floors | None,
    stand: float | None,
) -> _Found | None:
    """About the largest scale with `enough` inside; None if there is none at that eye height."""
    best, largest = None, 0.0
    for scale in walk.scales(navigable):
        if best is not None and (best.look == 1.0 or scale < config.shrink * largest):
            break
        standing = floors.at_height(stand, scale) if floors is not None else None
        found = _place(walk, navigable, config, scale, places, standing)
        if found is not None and found.share >= config.enough and (best is None or found.look > best.look):
            best, largest = found, largest or scale
    return best


@dataclass(frozen=True, eq=False)
class _Found:
    """A placement: its share of positions inside, the share of poses that look at the scene, its transform."""

    share: float
    look: float
    similarity: Similarity


@dataclass(frozen=True, eq=False)
class _Walk:
    """A walk about its middle: (T, 3) offsets in its own unit with the scene's up, under each heading's rotation.

    Attributes:
        offsets: (T, 3) positions from the middle, recorded axes.
        rotations: (Y, 3, 3) scene from recorded axes, one for each heading.
        middle: (3,) recorded position that goes to the placement.
        probes: (P,) indices of the poses that screen placements.
        forwards: (P, 3) their directions of view, recorded axes.
    """

    offsets: F64
    rotations: F64
    middle: F64
    probes: NDArray[np.int64]
    forwards: F64

    @classmethod
    def of(cls, path: HeadPath, navigable: NavigableSpace, yaws: int) -> _Walk:
        up = path.upright
        mean = path.positions.mean(axis=0)
        spread = path.positions - mean
        heights = spread @ up
        # The pose nearest to the mean, on the ground plan; its height is the usual one, whatever that pose's is.
        flat = spread - heights[:, None] * up
        far = np.linalg.norm(flat, axis=1)
        size = float(np.linalg.norm(spread, axis=1).max())
        middle = path.positions[(far <= far.min() + _TIE * size).argmax()]
        middle = middle + (np.median(path.positions @ up) - middle @ up) * up
        ahead = flat[(far >= far.max() - _TIE * size).argmax()]
        if np.linalg.norm(ahead) <= 1e-9 * (1.0 + np.abs(path.positions).max()):  # it never leaves its place
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
        probes = _probes(len(path))
        return cls(path.positions - middle, scene @ yawed @ recorded.T, middle, probes, path.forwards[probes])

    def scales(self, navigable: NavigableSpace) -> Iterator[float]:
        """From one at which the walk spans the grid down to one at which it fits into a voxel."""
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
        """The transform that takes the middle of the walk to a place of the scene."""
        rotation = self.rotations[yaw]
        return Similarity.from_rotation(scale, rotation, place - scale * rotation @ self.middle)


@dataclass(frozen=True, eq=False)
class _Floors:
    """What M places stand on.

    Attributes:
        heights: (M,) how far straight below each the first occupied voxel is; infinite without one.
        levels: (M,) how high that lies along the scene's up.
        voxel_size: Side of a voxel.
    """

    heights: F64
    levels: F64
    voxel_size: float

    @classmethod
    def below(cls, places: F64, navigable: NavigableSpace) -> _Floors:
        heights = _free_ahead(navigable, places, np.tile(-navigable.up, (len(places), 1)))
        return cls(heights, places @ navigable.up - heights, navigable.voxel_size)

    def at_height(self, stand: float | None, scale: float) -> Mask | None:
        """(M,) which places are at eye height over the main floor; None where nobody has to stand."""
        if stand is None:
            return None
        height = stand * scale
        slack = max(_UNEVEN * height, self.voxel_size)
        levels = np.sort(self.levels[np.isfinite(self.levels)])
        if len(levels) == 0:
            return np.zeros(len(self.levels), bool)
        held = np.searchsorted(levels, levels + 2.0 * slack, side="right") - np.arange(len(levels))
        main = levels[held.argmax()] + slack  # the middle of the band that most places stand on
        fits = np.abs(self.heights - height) <= max(_TOLERANCE * height, self.voxel_size)
        return np.asarray(fits & (np.abs(self.levels - main) <= slack))


def _place(
    walk: _Walk, navigable: NavigableSpace, config: RetargetConfig, scale: float, places: F64, standing: Mask | None
) -> _Found | None:
    """Of the first `choices` placements with `enough` inside the one that looks at the scene most often.

    If none has enough inside it is the one with the most; None if there is no placement at all.
    """
    if standing is not None:
        places = places[standing]
    places = places[: config.placements]
    probes = scale * np.einsum("yij,tj->yti", walk.rotations, walk.offsets[walk.probes])
    best, chosen = None, 0
    tried: list[tuple[float, int, int]] = []
    for first in range(0, len(places), _BLOCK):
        block = places[first : first + _BLOCK]
        inside = navigable.contains((block[:, None, None, :] + probes[None]).reshape(-1, 3))
        shares = inside.reshape(len(block), len(probes), -1).mean(axis=2)
        likely = shares >= config.enough - 1.5 / len(walk.probes)
        for index in np.flatnonzero(likely.any(axis=1)):
            found = _head(walk, navigable, scale, block[index], np.flatnonzero(likely[index]), config.enough)
            if found is not None:
                best, chosen = found if best is None or found.look > best.look else best, chosen + 1
                if chosen == config.choices or best.look == 1.0:
                    return best
        for flat in np.argsort(-shares, axis=None, kind="stable")[:_FINALISTS]:
            place, yaw = divmod(int(flat), len(probes))
            tried.append((-float(shares[place, yaw]), first + place, yaw))
    if best is not None or not tried:
        return best
    finalists = [(places[place], yaw) for _, place, yaw in sorted(tried)[:_FINALISTS]]
    final = [_share(walk, navigable, scale, yaw, place) for place, yaw in finalists]
    place, yaw = finalists[int(np.argmax(final))]
    return _Found(max(final), 0.0, walk.similarity(scale, yaw, place))


def _head(
    walk: _Walk, navigable: NavigableSpace, scale: float, place: F64, headings: NDArray[np.intp], enough: float
) -> _Found | None:
    """Of the headings with enough inside at a place the one that looks at the scene most often; None without any."""
    best = None
    for yaw in headings.tolist():
        share = _share(walk, navigable, scale, yaw, place)
        if share >= enough:
            eyes = place + scale * walk.offsets[walk.probes] @ walk.rotations[yaw].T
            ahead = _free_ahead(navigable, eyes, walk.forwards @ walk.rotations[yaw].T)
            look = float(np.isfinite(ahead).mean())
            if best is None or look > best.look:
                best = _Found(share, look, walk.similarity(scale, yaw, place))
    return best


def _share(walk: _Walk, navigable: NavigableSpace, scale: float, yaw: int, place: F64) -> float:
    return float(navigable.contains(place + scale * walk.offsets @ walk.rotations[yaw].T).mean())


def _free_ahead(navigable: NavigableSpace, points: F64, directions: F64) -> F64:
    """(M,) how far in its unit direction each point has the first occupied voxel; infinite without one."""
    shape = np.array(navigable.free.shape)
    found = np.full(len(points), np.inf)
    going = np.arange(len(points))
    step = 0.5 * navigable.voxel_size
    for count in range(1, 4 * int(shape.sum())):
        cells = np.floor((points[going] + count * step * directions[going] - navigable.origin) / navigable.voxel_size)
        within = np.all((cells >= 0) & (cells < shape), axis=1)
        going, cells = going[within], cells[within].astype(np.int64)
        if len(going) == 0:
            break
        hit = navigable.occupied[tuple(cells.T)]
        found[going[hit]] = count * step
        going = going[~hit]
    return found


def _nearest_inside(navigable: NavigableSpace, points: F64) -> F64:
    """(M, 3) the points moved into the navigable voxel nearest to the one they lie in (or nearest to on the grid)."""
    shape = np.array(navigable.free.shape)
    cells = np.clip(np.floor((points - navigable.origin) / navigable.voxel_size), 0, shape - 1).astype(np.int64)
    nearest = ndimage.distance_transform_edt(~navigable.free, return_distances=False, return_indices=True)
    target = np.stack([nearest[axis][tuple(cells.T)] for axis in range(3)], axis=1)
    low = navigable.origin + navigable.voxel_size * target
    margin = 1e-3 * navigable.voxel_size  # off the faces, so that rounding never puts a point into the next one
    return np.asarray(np.clip(points, low + margin, low + navigable.voxel_size - margin))


def _probes(count: int) -> NDArray[np.int64]:
    """Indices of up to 64 of so many poses, evenly spread."""
    return np.unique(np.linspace(0, count - 1, _PROBES).round().astype(np.int64))


def _frame(up: F64, ahead: F64) -> F64:
    """(3, 3) right-handed axes as columns: ahead (made level), to its left, up."""
    ahead = ahead - (ahead @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(up, ahead), up], axis=1)
