"""Find where the feet of a walker can be, from the Gaussians and the cells of a scene.

The result is a grid of voxels that stands upright. A voxel is open if a body with its feet there fits: a cylinder that
ends a little above the eye. So a program that lets visitors walk moves a point in a mask, and no
part of the body enters a wall. Lengths are shares of the eye's height: a scene needs no unit. docs/static.md describes
the form in bytes.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs.cells import Cells
from gsvis.pvs.floor import level_axes
from gsvis.scene.density import Density
from gsvis.scene.gaussians import Gaussians

__all__ = ["WalkGrid", "find_walk"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MOST = 256  # voxels along a side
_FINEST = 16  # voxels in an eye's height
_SOLID = float(-np.log(0.75))  # optical depth of a solid voxel: an eye in it loses a quarter of the light
_EYE_M = 1.6  # height of a walker's eye, meters
_OF_ROOM = 0.6  # the same in heights of rooms
_OF_SIDE = 0.1  # the same in the narrower side of all cells, where there is no roof
_ROOFED = 0.3  # least share of places with a floor and a roof, of rooms
_STEP = 0.15  # highest step, eye heights: half of a knee
_HEAD = 1.06  # height of the body, eye heights
_RADIUS = 0.15  # of the body, eye heights
_HOLE = 1.0  # radius of holes in the ground that are closed, eye heights
_GROUNDED = 0.2  # least share of columns with ground; with less, the lowest voxels are the ground
_ISLAND = 0.05  # least area of a part to walk in, in that of the largest
_FOOT = 0.3  # the grid reaches below the cells, in their height
_LOOKS = 4  # tests along a side of a cell
_SAMPLE = 100_000  # Gaussians from which the height of rooms is found
_SPARE = 0.3  # height by which an eye may leave the cells, eye heights
_FOOT_SHARE = 0.01  # solid voxels below the foot of a scene without ground
_LEDGE = 4  # voxels beyond a ledge in which a walker falls


@dataclass(frozen=True, eq=False)
class WalkGrid:
    """Places of a walker's feet.

    Attributes:
        origin: (3,) lowest corner of voxel (0, 0, 0), scene frame.
        size: Side of a voxel, scene units.
        axes: (3, 3) unit axes of the grid, one a row, scene frame; the last one points upwards.
        eye: Height of the eye above the feet, scene units.
        step: Most voxels that the feet rise at once.
        open: (X, Y, Z) voxels in which the feet can be; everything else is solid.
    """

    origin: F64
    size: float
    axes: F64
    eye: float
    step: int
    open: Mask

    def to_bytes(self) -> bytes:
        """Return a line of JSON and one bit for each voxel, layer by layer, compressed by deflate."""
        said = {
            "version": 1,
            "origin": self.origin.tolist(),
            "size": self.size,
            "axes": self.axes.tolist(),
            "eye": self.eye,
            "step": self.step,
            "shape": list(self.open.shape),
        }
        bits = np.packbits(self.open.transpose(2, 1, 0), bitorder="little")
        return zlib.compress(json.dumps(said, separators=(",", ":")).encode() + b"\n" + bits.tobytes(), 9)


def find_walk(g: Gaussians, cells: Cells, meters_per_unit: float = 0.0) -> WalkGrid | None:
    """Return where a walker's feet can be in a scene; None if there is no such place.

    Args:
        g: The scene.
        cells: Where eyes may be. A walker's eye stays in them, give or take a part of its height.
        meters_per_unit: Meters in a scene unit, 0 if unknown.
    """
    axes = np.stack([*level_axes(cells.up), cells.up])
    corners = cells.corners() @ axes.T
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    low[2] -= _FOOT * (high[2] - low[2])
    near = _upright(g, axes, low, high)
    longest = float((high - low).max())
    if meters_per_unit > 0.0:
        eye = _EYE_M / meters_per_unit
    else:
        share = max(1, len(near) // _SAMPLE)
        rough = Density.from_scene(near[::share], low, high, _MOST // 2)
        eye = _eye_height(rough, np.asarray(rough.depth >= _SOLID / share), cells, axes)
    density = Density.from_scene(near, low, high, int(np.clip(_FINEST * longest / eye, 8, _MOST)))
    size = density.voxel_size
    inside = _in_cells(density, cells, axes)
    footprint = np.asarray(inside.any(axis=2))
    solid = _with_ground(np.asarray(density.depth >= _SOLID), inside, eye / size)
    step = max(1, int(np.ceil(_STEP * eye / size)))
    fits = _where_body_fits(solid, eye / size) & footprint[:, :, None]
    seen = _shift(_extend_vertically(inside, round(_SPARE * eye / size)), round(eye / size))
    places = _find_usable(fits, seen, step)
    if not places.any():
        return None
    x, y, z = (slice(int(found.min()), int(found.max()) + 1) for found in np.nonzero(places))
    corner = density.origin + size * np.array([x.start, y.start, z.start])
    return WalkGrid(corner @ axes, size, axes, float(eye), step, places[x, y, z])


def _upright(g: Gaussians, axes: F64, low: F64, high: F64) -> Gaussians:
    """Return the Gaussians that can reach a box of the upright frame, in that frame, with base colors only."""
    means = g.means.astype(np.float64) @ axes.T
    reach = 3.0 * g.scales.max(axis=1, keepdims=True)
    few = g[np.all((means >= low - reach) & (means <= high + reach), axis=1)]
    return Gaussians(few.means, few.quats, few.scales, few.opacities, few.sh0).transform(axes)


def _eye_height(density: Density, solid: Mask, cells: Cells, axes: F64) -> float:
    """Return the height of a walker's eye: a share of that of rooms, or of a side of the cells where there are none."""
    layers = np.arange(solid.shape[2])
    floor = np.maximum.accumulate(np.where(solid, layers, -np.inf), axis=2)
    roof = np.minimum.accumulate(np.where(solid, layers, np.inf)[:, :, ::-1], axis=2)[:, :, ::-1]
    rooms = (roof - floor)[_in_cells(density, cells, axes) & ~solid]
    roofed = rooms[np.isfinite(rooms)]
    if len(roofed) > _ROOFED * len(rooms):
        return _OF_ROOM * density.voxel_size * float(np.median(roofed))
    return _OF_SIDE * density.voxel_size * float(min(solid.shape[:2]))


def _in_cells(density: Density, cells: Cells, axes: F64) -> Mask:
    """Return (X, Y, Z) whether voxels of an upright grid lie in cells; blocks of voxels are tested at their middles."""
    block = max(1, int(cells.cell_size / (_LOOKS * density.voxel_size)))
    shape = density.depth.shape
    middles = [
        density.origin[k] + density.voxel_size * block * (np.arange(-(-n // block)) + 0.5) for k, n in enumerate(shape)
    ]
    points = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1)
    found = (cells.cell_at(points.reshape(-1, 3) @ axes) >= 0).reshape(points.shape[:3])
    for axis in range(3):
        found = np.repeat(found, block, axis=axis)
    return found[: shape[0], : shape[1], : shape[2]]


def _with_ground(solid: Mask, inside: Mask, eye: float) -> Mask:
    """Return solid voxels (X, Y, Z) with ground in small holes, or at the foot of a scene that has no ground.

    Args:
        solid: The solid voxels.
        inside: (X, Y, Z) voxels in which eyes can be.
        eye: Height of the eye in voxels.
    """
    from scipy import ndimage

    layers = np.arange(solid.shape[2])
    footprint = inside.any(axis=2)
    grounded = solid.any(axis=2) & (solid.argmax(axis=2) <= inside.argmax(axis=2) + eye)
    if np.count_nonzero(grounded & footprint) < _GROUNDED * np.count_nonzero(footprint):
        foot = int(np.quantile(np.nonzero(solid)[2], _FOOT_SHARE)) if solid.any() else 0
        return np.asarray(solid | (layers <= foot))
    away, (x, y) = ndimage.distance_transform_edt(~grounded, return_indices=True)
    hole = ~grounded & (away <= _HOLE * eye)
    ground = np.where(hole, solid.argmax(axis=2)[x, y], -1)
    return np.asarray(solid | (layers <= ground[:, :, None]))


def _where_body_fits(solid: Mask, eye: float) -> Mask:
    """Return (X, Y, Z) voxels of feet whose body meets nothing solid; beyond the sides and below all is solid.

    Args:
        solid: The solid voxels.
        eye: Height of the eye in voxels.
    """
    radius = _RADIUS * eye
    reach = int(radius)
    sides = ((reach, reach), (reach, reach), (0, 0))
    body = np.pad(_any_within(solid, int(np.ceil(_HEAD * eye))), sides, constant_values=True)
    blocked = np.zeros_like(solid)
    x, y, _ = solid.shape
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            if i * i + j * j <= radius * radius:
                blocked |= body[reach + i : reach + i + x, reach + j : reach + j + y]
    return np.asarray(~blocked)


def _any_within(solid: Mask, height: int) -> Mask:
    """Return (X, Y, Z) whether any of `height` voxels is solid, from each voxel upwards."""
    counts = np.cumsum(np.pad(solid, ((0, 0), (0, 0), (1, height))), axis=2, dtype=np.int32)
    return np.asarray(counts[:, :, height:][:, :, : solid.shape[2]] > counts[:, :, : solid.shape[2]])


def _find_usable(fits: Mask, seen: Mask, step: int) -> Mask:
    """Return the voxels of feet (X, Y, Z) that a walker can use: in parts that are large, and at their edges.

    Args:
        fits: Voxels of feet whose body fits.
        seen: Voxels of feet whose eye may be there.
        step: Most voxels that the feet rise at once.
    """
    from scipy import ndimage

    standing = fits & ~_shift(fits, -1) & seen
    near = _extend_up(standing, fits, step)
    labels, count = ndimage.label(near)
    areas = np.bincount(labels[standing], minlength=count + 1)
    areas[0] = 0
    large = (areas >= max(1.0, _ISLAND * areas.max()))[labels]
    above = ndimage.binary_dilation(large & near, np.ones((2 * _LEDGE + 1, 2 * _LEDGE + 1, 1), bool))
    over = _extend_up(standing & large, fits, fits.shape[2])  # all above a floor of such a part
    kept = np.zeros_like(fits)
    last = np.zeros(fits.shape[:2], bool)
    for z in range(fits.shape[2] - 1, -1, -1):
        last = over[:, :, z] & (above[:, :, z] | last)
        kept[:, :, z] = last
    return kept


def _extend_up(start: Mask, through: Mask, most: int) -> Mask:
    """Return (X, Y, Z) the start voxels, and up to `most` voxels above each as long as a mask holds."""
    left = np.where(start[:, :, 0], most, -1)
    found = np.zeros_like(through)
    for z in range(through.shape[2]):
        left = np.where(start[:, :, z], most, np.where(through[:, :, z], left - 1, -1))
        found[:, :, z] = left >= 0
    return found


def _shift(mask: Mask, voxels: int) -> Mask:
    """Return a mask whose voxel z is voxel z + `voxels` of the given one; False beyond it."""
    shifted = np.zeros_like(mask)
    depth = mask.shape[2]
    low = max(0, -voxels)
    high = min(depth, depth - voxels)
    if low < high:
        shifted[:, :, low:high] = mask[:, :, low + voxels : high + voxels]
    return shifted


def _extend_vertically(mask: Mask, voxels: int) -> Mask:
    """Return a mask that reaches further up and down."""
    from scipy import ndimage

    return np.asarray(ndimage.binary_dilation(mask, np.ones((1, 1, 2 * voxels + 1), bool)))
