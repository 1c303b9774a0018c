"""Build the voxel grid of navigable space: which voxels stop light, and which of the others a visitor can reach.

Frame and units are the scene's own. This module knows no camera.

Rule. A voxel is free if an eye in it loses less than `max_alpha` to the Gaussians that overlap it, and nothing occupied
lies within `clearance` voxels. A visitor has ground below and things around. The free voxels are therefore reduced to
those that stop light in at least half of the grid directions within 60 degrees of straight down, and in a share of all
26 grid directions. Both are averaged over five voxels. The share is the first of 0.7, 0.3, 0.1 at which the largest
connected part still holds 5% of the box: rooms pass at 0.7, ground under the sky at 0.3. If no share passes, the
condition on the ground is dropped. The largest connected part of what remains is kept. Rooms need no door between them:
at 0.7 all parts of a tenth of the largest are kept, and hold 5% of the box together. `_eyes.py` replaces it where a
scene is no rooms.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.scene._kernels.voxels import splat_depth, sum_beyond
from gsvis.scene.core import middle_scales
from gsvis.scene.gaussians import Gaussians

__all__ = ["MIN_ALPHA", "MIN_SHARE", "SOLID", "Occupancy", "only_visible", "optical_depth"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Depth = NDArray[np.float32]

# docs/conventions.md
MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = 0.999
INFLATION = 0.5  # standard deviation, in voxels, by which Gaussians are blurred so that no sheet slips between centers
REACH = 3.0  # standard deviations
SOLID = float(np.log(2.0))  # optical depth along a grid direction that counts as seeing something: half the light
ENCLOSED = 0.7
RULES = ((0.5, ENCLOSED), (0.5, 0.3), (0.5, 0.1), (0.0, 0.3), (0.0, 0.1), (0.0, 0.0))  # least share below, around
MIN_SHARE = 0.05  # of the box, for a rule to be taken
ROOM = 0.1  # of the largest enclosed part, for another one to be taken for rooms
SMOOTHING = 5  # voxels: 26 directions see in stripes
NUM_TARGETS = 4096
_CHUNK = 1 << 17
_NO_SEEDS = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Occupancy on a grid over a box of the scene.

    Args:
        origin: (3,) lowest corner of voxel (0, 0, 0).
        voxel_size: Side of a voxel, scene units.
        depth: (X, Y, Z) optical depth that the Gaussians in a voxel add for an eye in it.
        occupied: (X, Y, Z) voxels that stop light.
        clear: (X, Y, Z) voxels far enough from occupied ones.
    """

    origin: F64
    voxel_size: float
    depth: Depth
    occupied: Mask
    clear: Mask

    @classmethod
    def from_gaussians(
        cls,
        parts: Iterable[Gaussians],
        low: F64,
        high: F64,
        *,
        resolution: int,
        max_alpha: float,
        clearance: float,
        widest: float = np.inf,
    ) -> Occupancy:
        """Build the grid of a scene in parts over a box, with `resolution` voxels along its longest side.

        Args:
            parts: The scene, part by part.
            low: (3,) lowest corner.
            high: (3,) highest corner.
            resolution: Voxels along the longest side.
            max_alpha: Share of lost light above which a voxel counts as occupied.
            clearance: Required distance from occupied voxels, in voxels.
            widest: Gaussians with a larger middle standard deviation are haze and are ignored.

        Raises:
            SceneError: If no voxel is clear.
        """
        voxel_size = float((high - low).max()) / resolution
        counts = np.clip(np.ceil((high - low) / voxel_size - 1e-6), 1, resolution).astype(int)
        origin = 0.5 * (low + high) - 0.5 * counts * voxel_size
        shape = int(counts[0]), int(counts[1]), int(counts[2])
        depth = np.zeros(shape, np.float32)
        for part in parts:
            counted = part if np.isinf(widest) else part[middle_scales(part) <= widest]
            depth += optical_depth(counted, origin, voxel_size, shape)
        occupied = np.asarray(depth >= -np.log1p(-max_alpha), bool)
        clear = ~_dilate(occupied, clearance)
        if not clear.any():
            raise SceneError(
                f"no navigable space: all {clear.size} voxels of {voxel_size:.3g} units are occupied or too close to an"
                " occupied one",
                "raise max_alpha or resolution, lower clearance, or give cameras",
            )
        return cls(origin, voxel_size, depth, occupied, clear)

    def choose(self, up: F64, seeds: F64 = _NO_SEEDS) -> tuple[Mask, str, bool]:
        """Return the connected part or parts of the clear voxels, by the first rule that leaves enough.

        Args:
            up: (3,) unit up axis.
            seeds: (S, 3) positions known to be navigable; may be empty.

        Returns:
            free: (X, Y, Z) the chosen voxels.
            rule: Name of the rule that chose them.
            enclosed: Whether it was the first rule.

        Raises:
            SceneError: If most seeds lie away from clear voxels.
        """
        from scipy import ndimage  # slow to import, seldom needed

        below, around = _surroundings(self.depth, up)
        voxels = np.clip(np.floor((seeds - self.origin) / self.voxel_size), -9, 1 << 20).astype(np.int64)
        for min_below, min_around in RULES:
            labels, count = ndimage.label(self.clear & (below >= min_below) & (around >= min_around))
            if count == 0:
                continue
            rule = f"free, {min_around:.0%} enclosed" + (", ground below" if min_below else "")
            enclosed = min_around == ENCLOSED
            if len(voxels):
                held = [found for found in _labels_near(labels, voxels) if found]
                if len(held) >= 0.5 * len(voxels):
                    return np.isin(labels, sorted(set().union(*held))), f"{rule}, holding seeds", enclosed
                continue
            part = _rooms(labels) if enclosed else _largest(labels)
            if np.count_nonzero(part) >= MIN_SHARE * labels.size or (min_below, min_around) == RULES[-1]:
                return part, rule, enclosed
        raise SceneError(
            f"no navigable space: fewer than half of the {len(seeds)} seeds, such as cameras, lie within two voxels of"
            " free space",
            "check that they are in the scene's frame, or raise max_alpha or lower clearance",
        )

    def enclosed_parts(self, up: F64) -> Mask:
        """Return the clear voxels enclosed as in rooms: all connected parts of at least a tenth of the largest.

        Empty if all of them together hold too little of the box for `choose` to take its first rule.

        Args:
            up: (3,) unit up axis.
        """
        from scipy import ndimage

        below, around = _surroundings(self.depth, up)
        min_below, min_around = RULES[0]
        labels, count = ndimage.label(self.clear & (below >= min_below) & (around >= min_around))
        if count == 0 or np.count_nonzero(rooms := _rooms(labels)) < MIN_SHARE * labels.size:
            return np.zeros(self.clear.shape, bool)
        return rooms

    def largest_part(self, among: Mask | None = None) -> Mask:
        """Return the largest connected part of the clear voxels, or of those in a mask (X, Y, Z); may be empty."""
        from scipy import ndimage

        labels, count = ndimage.label(self.clear if among is None else self.clear & among)
        return _largest(labels) if count else np.zeros(self.clear.shape, bool)

    def parts_with(self, among: Mask, places: F64) -> Mask:
        """Return the largest connected part of the clear voxels in a mask, and the parts that hold given places.

        Args:
            among: (X, Y, Z) the mask.
            places: (P, 3) places on the grid, in voxels; parts with few of them are ignored.
        """
        from scipy import ndimage

        labels, count = ndimage.label(self.clear & among)
        if not count:
            return np.zeros(self.clear.shape, bool)
        held = (
            np.bincount(labels[tuple(places.astype(np.int64).T)], minlength=count + 1) if len(places) else np.zeros(1)
        )
        chosen = np.zeros(count + 1, bool)
        chosen[: len(held)] = held >= max(1.0, ROOM * held[1:].max(initial=0))
        chosen[_sizes(labels).argmax()] = True
        chosen[0] = False
        return np.asarray(chosen[labels], bool)

    def voxels_of(self, points: NDArray[np.floating[Any]]) -> F64:
        """Return (M, 3) the points (P, 3) that lie on the grid, in voxels."""
        places = (points.astype(np.float64) - self.origin) / self.voxel_size
        return np.asarray(places[np.all((places >= 0) & (places < np.array(self.depth.shape)), axis=1)])

    def targets(self, seen: Gaussians) -> F64:
        """Return (T, 3) centers inside the grid, drawn by opacity times area, with a fixed seed."""
        shape = np.array(self.depth.shape)
        place = (seen.means - self.origin) / self.voxel_size
        inside = np.flatnonzero(np.all((place >= 0) & (place < shape), axis=1))
        if len(inside) == 0:
            return np.zeros((0, 3))
        cap = 0.05 * float(shape.max()) * self.voxel_size  # limits the weight of giants
        scales = np.minimum(np.sort(seen.scales[inside].astype(np.float64), axis=1), cap)
        total = np.cumsum(seen.opacities[inside] * scales[:, 1] * scales[:, 2])
        places = (np.arange(NUM_TARGETS) + 0.5) / NUM_TARGETS * total[-1]
        return np.asarray(seen.means[inside[np.searchsorted(total, places).clip(0, len(inside) - 1)]], np.float64)


def optical_depth(seen: Gaussians, origin: F64, voxel_size: float, shape: tuple[int, int, int]) -> Depth:
    """Return (X, Y, Z), the sum of -log(1 - alpha) over the Gaussians that reach each voxel.

    A Gaussian is blurred by half a voxel, so that a thin disc between voxel centers is found. Its alpha falls by the
    share of a voxel's cross-section that it covers, so that many faint or tiny ones add up correctly.
    """
    depth = np.zeros(shape, np.float32)
    for start in range(0, len(seen), _CHUNK):
        part = seen[start : start + _CHUNK]
        scales = np.minimum(part.scales.astype(np.float64) / voxel_size, 1e5)
        blurred = scales**2 + INFLATION**2
        wide = np.sort(scales, axis=1)[:, 1:]
        wide_blurred = np.sort(blurred, axis=1)[:, 1:]
        alphas = np.minimum(part.opacities, MAX_ALPHA) * (wide / np.sqrt(wide_blurred)).prod(axis=1)
        rotations = part.rotations()
        inverse = (rotations / blurred[:, None, :]) @ np.swapaxes(rotations, 1, 2)
        rows, columns = np.triu_indices(3)
        splat_depth(
            depth,
            (part.means.astype(np.float64) - origin) / voxel_size,
            np.ascontiguousarray(inverse[:, rows, columns]),
            alphas.astype(np.float64),
            REACH,
        )
    return depth


def _dilate(mask: Mask, radius: float) -> Mask:
    """Return the mask, grown by `radius` voxels (between centers)."""
    from scipy import ndimage

    reach = int(radius)
    if reach < 1 or not mask.any():
        return mask
    steps = np.arange(-reach, reach + 1)
    ball = steps[:, None, None] ** 2 + steps[:, None] ** 2 + steps**2 <= radius**2
    return np.asarray(ndimage.binary_dilation(mask, ball), bool)


def _surroundings(depth: Depth, up: F64) -> tuple[Depth, Depth]:
    """Return (X, Y, Z) shares of directions that stop half the light: within 60 degrees of down, and of all 26."""
    below = np.zeros(depth.shape, np.uint8)
    around = np.zeros(depth.shape, np.uint8)
    beyond = np.empty_like(depth)
    downward = 0
    for step in np.array([step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)]):
        sum_beyond(depth, step, beyond)
        solid = beyond >= SOLID
        around += solid
        if step @ up <= -0.5 * np.linalg.norm(step) + 1e-9:
            below += solid
            downward += 1
    return _smooth(below, max(downward, 1)), _smooth(around, 26)


def _smooth(counts: NDArray[np.uint8], of: int) -> Depth:
    """Return counts as shares, averaged over neighboring voxels."""
    from scipy import ndimage

    shares = counts.astype(np.float32)
    shares /= of
    return np.asarray(ndimage.uniform_filter(shares, SMOOTHING, mode="nearest"), np.float32)


def only_visible(g: Gaussians) -> Gaussians:
    """Return the Gaussians that can be seen, without SH above degree 0, which no search for space reads.

    Raises:
        SceneError: If there is none.
    """
    seen = g.without_harmonics()[g.opacities >= MIN_ALPHA]
    if len(seen) == 0:
        raise SceneError("no navigable space: the scene has no Gaussian with an opacity of at least 1/255")
    return seen


def _largest(labels: NDArray[np.int32]) -> Mask:
    """Return (X, Y, Z) the largest part of a grid with labels, at least one above 0."""
    return np.asarray(labels == _sizes(labels).argmax(), bool)


def _rooms(labels: NDArray[np.int32]) -> Mask:
    """Return (X, Y, Z) all parts of a tenth of the largest or more, of a grid with labels, at least one above 0."""
    sizes = _sizes(labels)
    return np.asarray((sizes >= max(1.0, ROOM * sizes.max()))[labels], bool)


def _sizes(labels: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the number of voxels of each part by its label; 0 for label 0, which is not a part."""
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return sizes


def _labels_near(labels: NDArray[np.int32], voxels: NDArray[np.int64]) -> list[set[int]]:
    """Return the labels within two voxels of each of the given voxels."""
    found = []
    for voxel in voxels:
        start = np.maximum(voxel - 2, 0)
        stop = np.maximum(voxel + 3, 0)
        around = labels[tuple(slice(a, b) for a, b in zip(start, stop, strict=True))]
        found.append(set(np.unique(around).tolist()) - {0})
    return found
