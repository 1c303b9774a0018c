"""Place eyes where people look from: around an object, in rooms, or near the ground of an open place.

If a scene may be two of these, eyes are placed by both rules. Arrays are voxel grids of `_occupancy.py`; boxes are
in the frame of the scene, or in its upright frame. The rules are in docs/design, 033-kinds-of-space.md
and 101-where-people-stand.md.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.scene._evidence import (
    footprint,
    gather,
    level_directions,
    some_voxels,
    sphere_directions,
    stopped_share,
    with_ground,
)
from gsvis.scene._occupancy import MIN_SHARE, Occupancy
from gsvis.scene._seeds import box_with_seeds, doubt_far, doubt_seeds, hold_seeds
from gsvis.scene._turned import is_level, level_frame, on_lattice
from gsvis.scene.core import Core
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SURE, WALKABLE, SpaceKind, find_kind, is_rooms, with_surroundings

__all__ = [
    "Around",
    "Look",
    "above_ground",
    "eye_heights",
    "find_eyes",
    "find_mixed",
    "heights_above",
    "stand_around",
    "where_people_stand",
]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Found = tuple[Occupancy, Mask, str, SpaceKind]

NEAR = 0.1
AROUND = 0.5
"""Distance of eyes from the box of an object that is given by hand, in its longest side."""

REACH = 1.5
"""Greatest distance of eyes from the middle of a scene that is looked at from around, in its longest side."""

STEEPEST = 45.0
"""Degrees above the middle of an object."""

PERSON = 3.0
"""Meters above the ground, at most: twice what a person needs. For scenes whose unit is known."""

_FOOT = 0.05  # the grid reaches below an object, in its longest side
_HELD = "in the parts that hold the cameras"
_OF_SIDE = 0.3  # greatest height of eyes in narrower sides of the scene
_LOWEST = 0.1  # least height, in greatest ones
_STANDING = 0.4, 0.65  # heights of the eyes of people who stand, in greatest ones: 1.2 to 2 m
_HEMMED = 0.7  # share of level directions that are stopped from which a place counts as hemmed in
_SKY = 0.25  # least share of directions above that lead out of an open place
_SKY_DIRECTIONS = 64  # over the sphere
_WIDE = 4.0  # greatest heights of eyes from which on a side is that of a place
_SOLID_ALPHA = 0.99  # share of lost light that counts as occupied where else nothing is free
_WARY = 0.75 * SURE  # most confidence in a kind that something speaks against
_BLOCK = 4  # voxels along a side of the blocks that are tested together


@dataclass(frozen=True, eq=False)
class Look:
    """Input of the search for eyes.

    Attributes:
        build: Function that builds a grid over a box.
        seen: The Gaussians that can be seen.
        core: Their core, without outliers.
        up: (3,) unit up axis.
        up_sure: Whether the up axis is certain; if not, it excludes nothing.
        seeds: (S, 3) positions known to be navigable; the parts that hold them are chosen.
        person: Greatest height of eyes above the ground, scene units; None if the size of a unit is not known.
    """

    build: Callable[..., Occupancy]
    seen: Gaussians
    core: Core
    up: F64
    up_sure: bool
    seeds: F64
    person: float | None = None


@dataclass(frozen=True, eq=False)
class Around:
    """A region of eyes around a box.

    Attributes:
        low: (3,) lowest corner of the box.
        high: (3,) highest corner.
        up: (3,) unit up axis; None if it is uncertain, so that eyes are above and below too.
        inside: Whether eyes are also in the box.
        given: Whether the user gave the box, such as that of a thing in a room; then eyes stay near it.
    """

    low: F64
    high: F64
    up: F64 | None
    inside: bool = False
    given: bool = False

    @property
    def longest(self) -> float:
        """Longest side of the box."""
        return float((self.high - self.low).max())

    @property
    def middle(self) -> F64:
        """(3,) middle of the box."""
        return np.asarray(0.5 * (self.low + self.high))

    def grid_box(self) -> tuple[F64, F64]:
        """Return the corners of the box that holds all eyes."""
        if self.given:
            low = self.low - AROUND * self.longest
            high = self.high + AROUND * self.longest
        else:
            low = self.middle - REACH * self.longest
            high = self.middle + REACH * self.longest
        if self.up is None:
            return low, high
        foot = (self.low, self.high)
        below = _FOOT * self.longest
        axis = int(np.abs(self.up).argmax())
        if self.up[axis] > 0.0:
            low[axis] = foot[0][axis] - below
        else:
            high[axis] = foot[1][axis] + below
        return low, high

    def __str__(self) -> str:
        if self.given:
            return f"around it, {NEAR * self.longest:.2g} to {AROUND * self.longest:.2g} units away"
        where = "around it and in it" if self.inside else "around it"
        return f"{where}, up to {REACH * self.longest:.2g} units from its middle"


def find_eyes(look: Look) -> Found:
    """Find the voxels where eyes belong.

    Args:
        look: The scene to search.

    Returns:
            The grid, the mask (X, Y, Z) of voxels, the name of the rule that chose them, and the kind of the scene.

    Raises:
        SceneError: If no voxel is free.
    """
    if len(look.seeds):
        return _hold_seeds(look)
    core = look.core
    up = look.up
    try:
        space = look.build(core.low, core.high)
    except SceneError as full:
        return _eyes_around_solid(look, full)
    free, rule, _ = space.choose(up)
    large = free if free.mean() >= MIN_SHARE else np.zeros_like(free)
    evidence = gather(space, large, look.seen, up)
    if is_rooms(evidence):
        kind = find_kind(evidence)
        if kind.sure:
            return space, free, rule, replace(kind, eyes="inside")
        return _eyes_of_both_kinds(look, kind, space, free)
    if core.has_surroundings:
        return _amid_surroundings(look, with_surroundings(evidence, core.beyond))
    standing = above_ground(space, up, look.person)
    walked = footprint(standing, up) >= WALKABLE
    kind = find_kind(with_ground(evidence, space, standing if walked else large, up))
    kind = _with_size(look, kind)
    if not look.up_sure:
        other = kind.other or ("object" if kind.kind == "open place" else "open place")
        kind = replace(kind, confidence=min(kind.confidence, _WARY), other=other)
    if kind.sure and kind.kind == "object":
        around = Around(core.low, core.high, up)
        space, free = stand_around(look.build, around)
        return space, free, "free, around an object", replace(kind, eyes=str(around))
    if kind.sure and walked:
        least, greatest = eye_heights(space, up, look.person)
        eyes = f"{least:.2g} to {greatest:.2g} units above the ground"
        return space, standing, "free, ground below at the height of an eye", replace(kind, eyes=eyes)
    if kind.sure:  # an open place without ground to stand on
        kind = replace(kind, confidence=_WARY, other="object")
    return _eyes_of_both_kinds(look, kind, space if walked else None, standing)


def find_mixed(look: Look) -> Found:
    """Find the voxels where eyes belong in a part of a larger scene: in rooms, on open ground, and at seeds.

    Args:
        look: The scene to search. The surroundings of a seed are free; seeds change nothing elsewhere.

    Returns:
            See `find_eyes`.

    Raises:
        SceneError: If there are no such voxels.
    """
    up = look.up
    low, high, near = box_with_seeds(look.core, look.seeds)
    space = look.build(low, high) if not near.any() else _build_lenient(look, low, high)
    inside = space.enclosed_parts(up)
    standing = above_ground(space, up, look.person)
    has_rooms = bool(inside.any())
    has_ground = footprint(standing, up) >= WALKABLE
    if has_rooms and has_ground:
        kind = SpaceKind("rooms", "enclosed space, and ground under the sky", None, "inside, and above the ground")
        free = inside | standing
        rule = "free, enclosed or with ground below"
    elif has_rooms:
        kind = SpaceKind("rooms", "enclosed space", None, "inside")
        free = inside
        rule = "free, enclosed"
    elif has_ground:
        kind = SpaceKind("open place", "ground under the sky", None, "above the ground")
        free = standing
        rule = "free, ground below"
    elif near.any():  # cameras around a thing
        kind = SpaceKind("object", "cameras around it", None, _HELD)
        free = np.zeros_like(inside)
        rule = "free"
        with suppress(SceneError):
            free, rule, _ = space.choose(up, look.seeds[near])
    else:
        raise SceneError("no navigable space: no room and no open ground", "look at the scene as a whole")
    if near.any():
        space, free = hold_seeds(space, free, look.seeds[near])
        rule = f"{rule}, and at cameras"
    return space, free, rule, kind


def stand_around(build: Callable[..., Occupancy], around: Around, *, widest: float = np.inf) -> tuple[Occupancy, Mask]:
    """Return a grid around a box, and the voxels where eyes belong.

    Args:
        build: Makes a grid over a box.
        around: The region of eyes.
        widest: Gaussians with a larger middle standard deviation are haze and are ignored.

    Raises:
        SceneError: If none is free.
    """
    space = build(*around.grid_box(), widest=widest)
    free = space.largest_part(_region(space, around))
    if not free.any():
        raise SceneError(
            f"no navigable space: nothing is free {around}",
            "give another center or radius",
        )
    return space, free


def _eyes_of_both_kinds(look: Look, kind: SpaceKind, space: Occupancy | None, free: Mask | None) -> Found:
    """Return eyes around the detail of a scene and in it, because the kind of the scene is uncertain.

    Args:
        look: The scene to search.
        kind: Its most likely kind.
        space: A grid with eyes that are kept; None for none.
        free: (X, Y, Z) mask of these eyes; None for none.
    """
    around = Around(look.core.detail_low, look.core.detail_high, look.up if look.up_sure else None, inside=True)
    wide = look.build(*around.grid_box(), widest=look.core.widest)
    region = _region(wide, around)
    kept = np.zeros((0, 3))
    if space is not None and free is not None:
        kept = (np.argwhere(free) + 0.5) * space.voxel_size + space.origin
    found = wide.parts_with(region, wide.voxels_of(kept))
    if not found.any():
        raise SceneError(f"no navigable space: nothing is free {around}", "give a box")
    doubt = f"the kind of this scene is uncertain, {kind.kind} or {kind.other}; viewpoints follow both"
    if not look.up_sure:
        doubt += ", on all sides, because the up axis is uncertain too"
    return wide, found, "free, around and inside", replace(kind, eyes=str(around), doubt=doubt)


def _amid_surroundings(look: Look, kind: SpaceKind) -> Found:
    """Return eyes in rooms if windows show the outside; else eyes around the detail and in it.

    A grid over everything seen through windows is too coarse for rooms; a grid over the detail resolves them.

    Args:
        look: The scene to search.
        kind: Its kind if there are no rooms.
    """
    low = look.core.detail_low
    high = look.core.detail_high
    try:
        space = look.build(low, high)
    except SceneError:
        return _eyes_of_both_kinds(look, kind, None, None)
    free, rule, _ = space.choose(look.up)
    enclosed = free if free.mean() >= MIN_SHARE else np.zeros_like(free)
    within = np.all((look.seen.means >= low) & (look.seen.means <= high), axis=1)
    evidence = gather(space, enclosed, look.seen[within], look.up)
    if not is_rooms(evidence):
        return _eyes_of_both_kinds(look, kind, None, None)
    kind = find_kind(evidence)
    if not kind.sure:
        return _eyes_of_both_kinds(look, kind, space, free)
    return space, free, rule, replace(kind, eyes="inside")


def _with_size(look: Look, kind: SpaceKind) -> SpaceKind:
    """Return the kind, corrected if the size of a unit is known: a wide place is not a relief."""
    if kind.kind != "open place" or look.person is None:
        return kind
    sides = np.delete(look.core.high - look.core.low, int(np.abs(look.up).argmax()))
    if sides.min() < _WIDE * look.person:
        return kind
    return replace(kind, confidence=1.0, other=None)


def _hold_seeds(look: Look) -> Found:
    """Return eyes near the seeds, and in the free parts that hold them."""
    up = look.up
    seeds = look.seeds
    low, high, near = box_with_seeds(look.core, seeds)
    if not near.any():  # no seed is near the scene
        doubt = doubt_far(len(seeds), len(seeds))
        space, free, rule, kind = find_eyes(replace(look, seeds=seeds[near]))
        return space, free, rule, replace(kind, confidence=min(kind.confidence, 0.5), doubt=doubt)
    space = _build_lenient(look, low, high)
    doubt = doubt_seeds(space, seeds, near, look.seen)
    try:
        free, rule, _ = space.choose(up, seeds[near])
    except SceneError:
        free = np.zeros(space.clear.shape, bool)
        rule = "free, near the seeds"
    space, free = hold_seeds(space, free, seeds[near])
    evidence = gather(space, free, look.seen, up)
    if not is_rooms(evidence):
        standing = above_ground(space, up, look.person)
        walked = footprint(standing, up) >= WALKABLE
        evidence = with_ground(evidence, space, standing if walked else free, up)
    kind = replace(find_kind(evidence), eyes=_HELD, confidence=0.5 if doubt else 1.0, other=None, doubt=doubt)
    return space, free, rule, kind


def _build_lenient(look: Look, low: F64, high: F64) -> Occupancy:
    """Return a grid over a box; if nothing is free, count only solid voxels as occupied."""
    try:
        return look.build(low, high)
    except SceneError:
        return look.build(low, high, max_alpha=_SOLID_ALPHA, clearance=0.0)


def _eyes_around_solid(look: Look, full: SceneError) -> Found:
    """Return eyes around a scene whose box has no free voxel; raise `full`, the error of the box, if there are none."""
    around = Around(look.core.low, look.core.high, look.up if look.up_sure else None)
    try:
        space, free = stand_around(look.build, around)
    except SceneError:
        raise full from None
    kind = SpaceKind("object", "nothing in its box is free", None, str(around))
    return space, free, "free, around an object", kind


def _region(space: Occupancy, around: Around) -> Mask:
    """Return the voxels (X, Y, Z) around a box: not below it, not too near, and not right above; or also in it."""
    middle = around.middle
    half = 0.5 * (around.high - around.low)
    places = np.ogrid[tuple(slice(0.5, n) for n in space.clear.shape)]
    away = [space.origin[i] + space.voxel_size * at - middle[i] for i, at in enumerate(places)]  # broadcast together
    beside = np.sqrt(sum(np.maximum(np.abs(x) - half[i], 0.0) ** 2 for i, x in enumerate(away)))
    distances = np.sqrt(sum(x**2 for x in away))
    longest = around.longest
    there = beside <= AROUND * longest if around.given else distances <= REACH * longest
    if not around.inside:
        there &= beside >= NEAR * longest
    if around.up is None:
        return np.asarray(there, bool)
    heights = sum(around.up[i] * x for i, x in enumerate(away))
    level = np.sqrt(np.maximum(distances**2 - heights**2, 0.0))
    foot = -float(np.abs(around.up) @ half)
    beside_it = heights <= np.tan(np.radians(STEEPEST)) * level
    return np.asarray(there & (heights >= foot) & (around.inside | beside_it), bool)


def where_people_stand(free: Mask, occupied: Mask, voxel_size: float, up: F64) -> Mask:
    """Return the free voxels (X, Y, Z) at the height of a standing person above what lies below; may be empty."""
    greatest = _room_height(free, occupied, voxel_size, up)
    heights = voxel_size * heights_above(occupied, up).astype(np.float64)
    low, high = (share * greatest for share in _STANDING)
    return np.asarray(free & (heights >= low) & (heights <= max(high, low + 2.0 * voxel_size)))


def eye_heights(space: Occupancy, up: F64, person: float | None = None) -> tuple[float, float]:
    """Return the least and the greatest height of an eye above the ground, scene units.

    Args:
        space: The grid over the scene.
        up: (3,) unit up axis, near one of the grid.
        person: Greatest height of eyes, scene units; None if the size of a unit is not known.
    """
    sides = np.array(space.depth.shape) * space.voxel_size
    greatest = _OF_SIDE * float(np.delete(sides, int(np.abs(up).argmax())).min())
    if person is not None:
        greatest = min(greatest, person)
    greatest = max(greatest, 3.0 * space.voxel_size)
    return _LOWEST * greatest, greatest


def _room_height(free: Mask, occupied: Mask, voxel_size: float, up: F64) -> float:
    """Return the greatest height of eyes in rooms: that of most rooms, unless they are narrower than high."""
    columns = heights_above(occupied, up)[free] + heights_above(occupied, -up)[free]
    columns = columns[np.isfinite(columns)]
    if is_level(up):
        sides = np.delete(np.array(free.shape) * voxel_size, int(np.abs(up).argmax()))
    else:
        places = voxel_size * (np.argwhere(free) @ level_frame(up)[:2].T)
        sides = np.ptp(places, axis=0) + 2.0 * voxel_size
    greatest = _OF_SIDE * float(sides.min())
    if len(columns):
        greatest = min(greatest, voxel_size * float(np.median(columns)))
    return max(greatest, 3.0 * voxel_size)


def above_ground(space: Occupancy, up: F64, person: float | None = None) -> Mask:
    """Return the clear voxels under the sky with ground below, at eye height; may be empty.

    If eyes stand between facades, only such places count: behind a facade, half of the directions lead into the void.
    """
    least, greatest = (height / space.voxel_size for height in eye_heights(space, up, person))
    heights = heights_above(space.occupied, up)
    part = space.largest_part(_under_the_sky(space, (heights >= least) & (heights <= greatest), up))
    level = level_directions(up)
    if not part.any() or np.quantile(stopped_share(space, some_voxels(part), level), 0.9) < _HEMMED:
        return part
    voxels, which = _blocks(part)
    shares = stopped_share(space, voxels.astype(np.float64) + 0.5, level)[which]
    hemmed = part.copy()
    hemmed[part] = shares >= _HEMMED * float(np.quantile(shares, 0.9))
    return space.largest_part(hemmed)


def heights_above(occupied: Mask, up: F64) -> NDArray[np.float32]:
    """Return (X, Y, Z) voxels from each voxel down to the next occupied one; infinite if there is none."""
    if not is_level(up):
        return _oblique_heights(occupied, up)
    axis = int(np.abs(up).argmax())
    layers = np.moveaxis(occupied, axis, 0)[:: 1 if up[axis] > 0 else -1]
    index = np.arange(len(layers), dtype=np.float32)[:, None, None]
    ground = np.where(layers, index, np.float32(-np.inf))
    np.maximum.accumulate(ground, axis=0, out=ground)
    np.subtract(index, ground, out=ground)
    return np.moveaxis(ground[:: 1 if up[axis] > 0 else -1], 0, axis)


def _oblique_heights(occupied: Mask, up: F64) -> NDArray[np.float32]:
    """Return `heights_above` along any direction, computed on an upright grid and transferred back."""
    frame = level_frame(up)
    shape = np.array(occupied.shape)
    middle = 0.5 * (shape - 1.0)
    counts = np.ceil(np.abs(frame) @ shape).astype(np.int64)
    first = middle - frame.T @ (0.5 * (counts - 1.0))
    upright = on_lattice(occupied, frame.T, first, counts)
    found = heights_above(upright, np.array([0.0, 0.0, 1.0]))
    return on_lattice(found, frame, -frame @ first, shape, beyond=np.inf)


def _under_the_sky(space: Occupancy, among: Mask, up: F64) -> Mask:
    """Return the clear voxels of a mask (X, Y, Z) from which enough of the upward directions are free."""
    voxels, which = _blocks(space.clear)
    wanted = among[space.clear]
    asked = np.unique(which[wanted])
    above = sphere_directions(_SKY_DIRECTIONS)
    is_open = np.zeros(len(voxels), bool)
    eyes = voxels[asked].astype(np.float64) + 0.5
    is_open[asked] = stopped_share(space, eyes, above[above @ up >= 0.5]) <= 1.0 - _SKY
    found: Mask = space.clear & among
    found[space.clear] &= is_open[which]
    return found


def _blocks(mask: Mask) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return one voxel (B, 3) of the mask for each block of the grid, and the block of each voxel of the mask."""
    counts = -(-np.array(mask.shape) // _BLOCK)
    padded = np.zeros(counts * _BLOCK, bool)
    padded[tuple(slice(n) for n in mask.shape)] = mask
    sides = [part for n in counts.tolist() for part in (n, _BLOCK)]
    blocks = padded.reshape(sides).transpose(0, 2, 4, 1, 3, 5).reshape(-1, _BLOCK**3)
    held = blocks.sum(axis=1, dtype=np.int64)
    places = np.flatnonzero(held)
    # The middle one of a block's voxels, in their order.
    inside = (np.cumsum(blocks[places], axis=1, dtype=np.uint8) > (held[places] // 2)[:, None]).argmax(axis=1)
    corners = np.stack(np.unravel_index(places, tuple(counts)), axis=1) * _BLOCK
    numbers = np.zeros(len(held), np.int64)
    numbers[places] = np.arange(len(places))
    which = np.broadcast_to(numbers.reshape(counts)[:, None, :, None, :, None], sides).reshape(padded.shape)
    return corners + np.stack(np.unravel_index(inside, (_BLOCK,) * 3), axis=1), which[
        tuple(slice(n) for n in mask.shape)
    ][mask]
