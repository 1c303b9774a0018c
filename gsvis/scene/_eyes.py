"""Find where eyes belong: around an object, in rooms, or near the ground of an open place, at a person's height.

Arrays are voxel grids of `_occupancy.py`; boxes are in the scene's frame. The rules are in docs/design,
033-kinds-of-space.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

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
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import WALKABLE, SpaceKind, find_kind, is_rooms

__all__ = ["above_ground", "eye_heights", "find_eyes", "find_mixed", "stand_around", "where_people_stand"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEAR, AROUND = 0.1, 0.5
"""Distance of eyes from the box of an object, in its longest side."""

_FOOT = 0.05  # the grid reaches below an object, in its longest side

STEEPEST = 45.0
"""Degrees above the middle of an object."""

PERSON = 3.0
"""Scene units above the ground, at most: twice what a person needs if a unit is a meter, as it is most often."""

_HELD = "in the parts that hold the cameras"
_SMALL = 4.0  # scene units; the sides of a smaller scene are not in meters
_OF_SIDE = 0.3  # greatest height of eyes in narrower sides of the scene
_LOWEST = 0.1  # least height, in greatest ones
_STANDING = 0.4, 0.65  # heights of the eyes of people who stand, in greatest ones: 1.2 to 2 m
_HEMMED = 0.7  # share of level directions that are stopped from which a place counts as hemmed in
_SKY = 0.25  # least share of directions above that lead out of an open place
_SKY_DIRECTIONS = 64  # over the sphere
_BLOCK = 4  # voxels along a side of the blocks that are tested together


def find_eyes(
    build: Callable[[F64, F64], Occupancy], low: F64, high: F64, seen: Gaussians, up: F64, seeds: F64
) -> tuple[Occupancy, Mask, str, SpaceKind]:
    """Find the voxels where eyes belong.

    Args:
        build: Makes a grid over a box.
        low: (3,) lowest corner of the scene without outliers.
        high: (3,) highest corner.
        seen: The Gaussians that can be seen.
        up: (3,) unit up axis.
        seeds: (S, 3) positions known to be navigable; if there are any, the parts that hold them are taken.

    Returns:
        The grid, (X, Y, Z) the voxels, the name of the rule that chose them, and what the scene is.

    Raises:
        SceneError: If no voxel is free, or most seeds lie away from free voxels.
    """
    try:
        space = build(low, high)
    except SceneError as full:
        if len(seeds):
            raise
        return _solid(build, low, high, up, full)
    free, rule, _ = space.choose(up, seeds)
    large = free if len(seeds) or free.mean() >= MIN_SHARE else np.zeros_like(free)
    evidence = gather(space, large, seen, up)
    if is_rooms(evidence):
        return space, free, rule, replace(find_kind(evidence), eyes=_HELD if len(seeds) else "inside")
    standing = above_ground(space, up)
    walked = footprint(standing, up) >= WALKABLE
    evidence = with_ground(evidence, space, standing if walked else large, seen, up)
    kind = find_kind(evidence)
    if len(seeds):
        return space, free, rule, replace(kind, eyes=_HELD)
    if kind.kind == "object":
        space, free, eyes = stand_around(build, low, high, up)
        return space, free, "free, around an object", replace(kind, eyes=eyes)
    if not walked:
        return space, free, rule, replace(kind, eyes="in the largest free space, for its ground is not known")
    least, greatest = eye_heights(space, up)
    eyes = f"{least:.2g} to {greatest:.2g} units above the ground"
    return space, standing, "free, ground below at the height of an eye", replace(kind, eyes=eyes)


def find_mixed(
    build: Callable[[F64, F64], Occupancy], low: F64, high: F64, up: F64
) -> tuple[Occupancy, Mask, str, SpaceKind]:
    """Find the voxels where eyes belong in a piece of something larger: in rooms, and on open ground.

    Args:
        build: Makes a grid over a box.
        low: (3,) lowest corner of the scene without outliers.
        high: (3,) highest corner.
        up: (3,) unit up axis.

    Returns:
        As `find_eyes`.

    Raises:
        SceneError: If it has neither.
    """
    space = build(low, high)
    inside, standing = space.enclosed_parts(up), above_ground(space, up)
    has_rooms, has_ground = inside.any(), footprint(standing, up) >= WALKABLE
    if has_rooms and has_ground:
        kind = SpaceKind("rooms", "enclosed space, and ground under the sky", None, "inside, and above the ground")
        return space, inside | standing, "free, enclosed or with ground below", kind
    if has_rooms:
        return space, inside, "free, enclosed", SpaceKind("rooms", "enclosed space", None, "inside")
    if has_ground:
        kind = SpaceKind("open place", "ground under the sky", None, "above the ground")
        return space, standing, "free, ground below", kind
    raise SceneError("no navigable space: no room and no open ground", "look at the scene as a whole")


def stand_around(build: Callable[[F64, F64], Occupancy], low: F64, high: F64, up: F64) -> tuple[Occupancy, Mask, str]:
    """Return a grid around the box of an object, the voxels where eyes belong, and a text that says where.

    Raises:
        SceneError: If none is free.
    """
    longest = float((high - low).max())
    below = (AROUND - _FOOT) * longest
    space = build(
        low - AROUND * longest + below * np.maximum(up, 0.0), high + AROUND * longest - below * np.maximum(-up, 0.0)
    )
    free = _around_object(space, low, high, up)
    if not free.any():
        raise SceneError(
            f"no navigable space: nothing is free between {NEAR * longest:.3g} and {AROUND * longest:.3g} units around"
            " the object",
            "give another center or radius",
        )
    return space, free, f"around it, {NEAR * longest:.2g} to {AROUND * longest:.2g} units away"


def _solid(
    build: Callable[[F64, F64], Occupancy], low: F64, high: F64, up: F64, full: SceneError
) -> tuple[Occupancy, Mask, str, SpaceKind]:
    """Return eyes around a scene whose box has no free voxel; raise `full`, the error of the box, if there are none."""
    try:
        space, free, eyes = stand_around(build, low, high, up)
    except SceneError:
        raise full from None
    return space, free, "free, around an object", SpaceKind("object", "nothing in its box is free", None, eyes)


def _around_object(space: Occupancy, low: F64, high: F64, up: F64) -> Mask:
    """Return the clear voxels around the box of an object: not below it, not too near, and not right above.

    Args:
        space: The grid, larger than the box.
        low: (3,) lowest corner of the box, scene frame.
        high: (3,) highest corner.
        up: (3,) unit up axis.
    """
    longest = float((high - low).max())
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    places = np.ogrid[tuple(slice(0.5, n) for n in space.clear.shape)]
    away = [space.origin[i] + space.voxel_size * at - middle[i] for i, at in enumerate(places)]  # broadcast together
    beside = np.sqrt(sum(np.maximum(np.abs(x) - half[i], 0.0) ** 2 for i, x in enumerate(away)))
    heights = sum(up[i] * x for i, x in enumerate(away))
    level = np.sqrt(np.maximum(sum(x**2 for x in away) - heights**2, 0.0))
    foot = -0.5 * float(np.abs(up) @ (high - low))
    there = (beside >= NEAR * longest) & (beside <= AROUND * longest) & (heights >= foot)
    return space.largest_part(there & (heights <= np.tan(np.radians(STEEPEST)) * level))


def where_people_stand(free: Mask, occupied: Mask, voxel_size: float, up: F64) -> Mask:
    """Return the free voxels (X, Y, Z) at the height of a standing person above what lies below; may be empty."""
    greatest = _greatest_height(free.shape, voxel_size, up)
    heights = voxel_size * _heights(occupied, up).astype(np.float64)
    low, high = (share * greatest for share in _STANDING)
    return np.asarray(free & (heights >= low) & (heights <= max(high, low + 2.0 * voxel_size)))


def eye_heights(space: Occupancy, up: F64) -> tuple[float, float]:
    """Return the least and the greatest height of an eye above the ground, scene units."""
    greatest = _greatest_height(space.depth.shape, space.voxel_size, up)
    return _LOWEST * greatest, greatest


def _greatest_height(shape: tuple[int, ...], voxel_size: float, up: F64) -> float:
    sides = np.array(shape) * voxel_size
    greatest = _OF_SIDE * float(np.delete(sides, int(np.abs(up).argmax())).min())
    if sides.max() >= _SMALL:
        greatest = min(greatest, PERSON)
    return max(greatest, 3.0 * voxel_size)


def above_ground(space: Occupancy, up: F64) -> Mask:
    """Return the clear voxels under the sky with ground below, at the height of an eye; may be empty.

    Where eyes are hemmed in, as between facades, only places that are: behind a facade half of the directions lead into
    the void.
    """
    least, greatest = (height / space.voxel_size for height in eye_heights(space, up))
    heights = _heights(space.occupied, up)
    part = space.largest_part(_under_the_sky(space, (heights >= least) & (heights <= greatest), up))
    level = level_directions(up)
    if not part.any() or np.quantile(stopped_share(space, some_voxels(part), level), 0.9) < _HEMMED:
        return part
    voxels, which = _blocks(part)
    shares = stopped_share(space, voxels.astype(np.float64) + 0.5, level)[which]
    hemmed = part.copy()
    hemmed[part] = shares >= _HEMMED * float(np.quantile(shares, 0.9))
    return space.largest_part(hemmed)


def _heights(occupied: Mask, up: F64) -> NDArray[np.float32]:
    """Return (X, Y, Z) voxels from each voxel down to the next occupied one, along the axis nearest to `up`."""
    axis = int(np.abs(up).argmax())
    layers = np.moveaxis(occupied, axis, 0)[:: 1 if up[axis] > 0 else -1]
    index = np.arange(len(layers), dtype=np.float32)[:, None, None]
    ground = np.where(layers, index, np.float32(-np.inf))
    np.maximum.accumulate(ground, axis=0, out=ground)
    np.subtract(index, ground, out=ground)
    return np.moveaxis(ground[:: 1 if up[axis] > 0 else -1], 0, axis)


def _under_the_sky(space: Occupancy, among: Mask, up: F64) -> Mask:
    """Return those of the clear voxels in a mask (X, Y, Z) from which enough of the directions above lead out."""
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
    """Return (B, 3) a voxel of the mask in each block of the grid, and for each voxel of the mask its block."""
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
