"""Find navigable space, the voxels where a visitor's eye can be: free of opacity, inside robust bounds, connected.

A voxel grid in the scene's frame and units, built from the Gaussians alone or from a box. It can sample viewpoints and
cameras. Knows no file and no renderer.

`_occupancy.py` decides which voxels count, `kinds.py` what the scene is, `_eyes.py` where eyes belong; their first
lines state the rules.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.scene._eyes import (
    Around,
    Found,
    Look,
    find_eyes,
    find_mixed,
    heights_above,
    stand_around,
    where_people_stand,
)
from gsvis.scene._looking import MAX_RESOLUTION, look_upright
from gsvis.scene._of_kind import find_stated
from gsvis.scene._turned import Pose, bring_back
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import KINDS, Kind, SpaceKind
from gsvis.scene.witnesses import Witnesses

__all__ = ["MAX_RESOLUTION", "NavigableSpace"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_STANDING = 0.01  # share of the space below which places to stand are taken for chance
_TRIES = 16  # targets tried for a camera
_GIVEN = SpaceKind("given", "navigable space given by hand")


@dataclass(frozen=True, eq=False, repr=False)
class NavigableSpace:
    """The voxels where an eye may be, and the points at which cameras look.

    Args:
        origin: (3,) lowest corner of voxel (0, 0, 0), scene frame.
        voxel_size: Side of a voxel, scene units.
        free: (X, Y, Z) navigable voxels.
        up: (3,) unit up axis of cameras.
        occupied: (X, Y, Z) voxels that stop light; none by default.
        targets: (T, 3) points worth looking at; if empty, cameras look at points of the box.
        rule: Name of the rule that chose the voxels, for reports.
        kind: The kind of the scene, with reasons.
        parcels: Number of grids in the search: 1, or one for the whole and one for each parcel.
        witnesses: Poses of people that were not used to find the space and judge results; None without any.

    Raises:
        ValueError: If a shape or a value is wrong.
        SceneError: If no voxel is free.
    """

    origin: F64
    voxel_size: float
    free: Mask
    up: F64
    occupied: Mask = field(default_factory=lambda: np.zeros((0, 0, 0), bool))
    targets: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    rule: str = "given"
    kind: SpaceKind = _GIVEN
    parcels: int = 1
    witnesses: Witnesses | None = None

    def __post_init__(self) -> None:
        free = np.ascontiguousarray(self.free, dtype=bool)
        if free.ndim != 3:
            raise ValueError(f"free: expected shape (X, Y, Z), got {free.shape}")
        if not free.any():
            raise SceneError("no navigable space: no voxel is free")
        occupied = np.ascontiguousarray(self.occupied, dtype=bool)
        if occupied.size == 0:
            occupied = np.zeros(free.shape, bool)
        if occupied.shape != free.shape:
            raise ValueError(f"occupied: expected shape {free.shape}, as free, got {occupied.shape}")
        if not (np.isfinite(self.voxel_size) and self.voxel_size > 0):
            raise ValueError(f"voxel_size: expected a finite number > 0, got {self.voxel_size!r}")
        arrays = {
            "origin": _check.floats("origin", self.origin, (3,), np.float64),
            "free": free,
            "up": _check.unit_vectors("up", np.reshape(np.asarray(self.up, np.float64), (1, -1)))[0],
            "occupied": occupied,
            "targets": _check.floats("targets", self.targets, ("T", 3), np.float64),
        }
        for name, array in arrays.items():
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)
        object.__setattr__(self, "voxel_size", float(self.voxel_size))

    @classmethod
    def from_scene(
        cls,
        g: Gaussians,
        *,
        resolution: int = 160,
        max_alpha: float = 0.25,
        clearance: float = 1.0,
        coverage: float = 0.98,
        up: ArrayLike | str | None = None,
        seeds: ArrayLike | None = None,
        mixed: bool = False,
    ) -> NavigableSpace:
        """Find the navigable space of a scene: around an object, in rooms, or above the ground of an open place.

        Args:
            g: The scene.
            resolution: Voxels along the longest side of the box, 8 to 384.
            max_alpha: Share of lost light, in (0, 1), above which a voxel counts as occupied.
            clearance: Required distance from occupied voxels, in voxels, between centers.
            coverage: Share of the centers inside the box on each axis; others are ignored.
            up: (3,) direction or an axis such as "+z"; guessed by default.
            seeds: (S, 3) positions known to be navigable, such as captured cameras. The box grows to hold them. The
                connected parts that hold them are kept instead of the largest ones.
            mixed: Whether the scene is a part of a larger one, such as a city: then eyes are in all rooms, on open
                ground and near `seeds`, never around the part.

        Raises:
            ValueError: If an argument is out of range.
            SceneError: If the scene has no free space.
        """
        for name, value, least, most in (
            ("max_alpha", max_alpha, 1e-6, 1.0 - 1e-6),
            ("clearance", clearance, 0.0, 32.0),
        ):
            if not least <= value <= most:
                raise ValueError(f"{name}: expected a value in [{least:g}, {most:g}], got {value!r}")
        points = _points_of(seeds)
        look, pose = look_upright(
            g, up, resolution, max_alpha=max_alpha, clearance=clearance, coverage=coverage, seeds=points
        )
        return cls._over(look, pose, find_mixed(look) if mixed else find_eyes(look))

    @classmethod
    def of_kind(
        cls, g: Gaussians, kind: Kind, *, resolution: int = 160, up: ArrayLike | str | None = None
    ) -> NavigableSpace:
        """Find the navigable space of a scene of known kind; only the up axis may be guessed.

        Args:
            g: The scene.
            kind: "object" (eyes around it), "rooms" (inside) or "open place" (above its ground, within its detail).
            resolution: Voxels along the longest side of the box, 8 to 384.
            up: (3,) direction or an axis such as "+z"; guessed by default.

        Raises:
            ValueError: If an argument is out of range.
            SceneError: If the scene has no free space.
        """
        if kind not in KINDS.values():
            raise ValueError(f"kind: expected one of {', '.join(KINDS.values())}, got {kind!r}")
        look, pose = look_upright(g, up, resolution)
        return cls._over(look, pose, find_stated(look, kind))

    @classmethod
    def from_parts(
        cls,
        parts: Iterable[Gaussians],
        sample: Gaussians,
        *,
        resolution: int = 160,
        up: ArrayLike | str | None = None,
        seeds: ArrayLike | None = None,
        mixed: bool = False,
    ) -> NavigableSpace:
        """Find the navigable space of a scene that is large, or does not fit into memory; see `from_scene`.

        Args:
            parts: The scene, part by part; iterated over once for each grid.
            sample: A random sample of its Gaussians, which determines the box, the up axis and the kind of the scene.
            resolution: Voxels along the longest side of the box, 8 to 384.
            up: (3,) direction or an axis such as "+z"; guessed by default.
            seeds: (S, 3) positions known to be navigable.
            mixed: Whether the scene is a part of a larger one.

        Raises:
            ValueError: If an argument is out of range.
            SceneError: If the scene has no free space.
        """
        points = _points_of(seeds)
        look, pose = look_upright(sample, up, resolution, parts=parts, seeds=points)
        return cls._over(look, pose, find_mixed(look) if mixed else find_eyes(look))

    @classmethod
    def around(
        cls,
        g: Gaussians,
        center: ArrayLike | None = None,
        radius: float | None = None,
        *,
        resolution: int = 160,
        up: ArrayLike | str | None = None,
    ) -> NavigableSpace:
        """Find the navigable space around an object: beside and above it.

        Without a center, eyes surround the whole scene, up to 1.5 of its longest side from its middle. With a center,
        they stay near the object, 0.1 to 0.5 of its longest side away from its box.

        Args:
            g: The scene.
            center: (3,) middle of the object; the whole scene is the object by default.
            radius: Radius of the object around `center`; required with it.
            resolution: Voxels along the longest side of the grid, 8 to 384.
            up: (3,) direction or an axis such as "+z"; guessed by default.

        Raises:
            ValueError: If an argument is out of range, or one of `center` and `radius` is missing.
            SceneError: If nothing around the object is free.
        """
        if (center is None) != (radius is None):
            raise ValueError("radius: expected center and radius together, got one; give both, or none")
        middle = None if center is None else _check.floats("center", center, (3,), np.float64)
        if radius is not None and not (np.isfinite(radius) and radius > 0.0):
            raise ValueError(f"radius: expected a finite number > 0, got {radius!r}")
        look, pose = look_upright(g, up, resolution)
        around = Around(look.core.low, look.core.high, look.up)
        if middle is not None and radius is not None:
            middle = middle if pose is None else pose.points(middle[None])[0]
            around = Around(middle - radius, middle + radius, look.up, given=True)
        space, free = stand_around(look.build, around)
        kind = SpaceKind("given", "an object given by hand", None, str(around))
        return cls._over(look, pose, (space, free, "free, around an object", kind))

    @classmethod
    def _over(cls, look: Look, pose: Pose | None, found: Found) -> NavigableSpace:
        """Return the result of a search in the frame of the scene."""
        space, free, rule, kind = found
        targets = space.targets(look.seen)
        if pose is None:
            return cls(space.origin, space.voxel_size, free, look.up, space.occupied, targets, rule, kind)
        masks = [free, space.occupied]
        origin, size, (turned, occupied) = bring_back(space.origin, space.voxel_size, masks, pose)
        return cls(origin, size, turned, pose.rotation[2], occupied & ~turned, pose.back(targets), rule, kind)

    @classmethod
    def from_box(
        cls, low: ArrayLike, high: ArrayLike, resolution: int = 32, *, up: ArrayLike = (0.0, 0.0, 1.0)
    ) -> NavigableSpace:
        """Return all voxels of a box as free; the grid fits its longest side.

        Args:
            low: (3,) lowest corner.
            high: (3,) highest corner, above `low` on every axis.
            resolution: Voxels along the longest side; the other sides are rounded down, to at least one voxel.
            up: (3,) up direction.

        Raises:
            ValueError: If the box is empty or `resolution` is out of range.
        """
        corner = _check.floats("low", low, (3,), np.float64)
        side = _check.floats("high", high, (3,), np.float64) - corner
        if not side.min() > 0:
            raise ValueError(f"high: expected a corner above low on every axis, got sides {side.tolist()}")
        if _check.positive_int("resolution", resolution) > MAX_RESOLUTION:
            raise ValueError(f"resolution: expected at most {MAX_RESOLUTION}, got {resolution}")
        size = min(float(side.max()) / resolution, float(side.min()))
        shape = np.maximum(np.floor(side / size + 1e-9).astype(int), 1)
        start = corner + 0.5 * (side - shape * size)
        kind = SpaceKind("given", "a box given by hand")
        return cls(start, size, np.ones(shape, bool), np.asarray(up, np.float64), rule="box", kind=kind)

    def __repr__(self) -> str:
        x, y, z = self.free.shape
        return f"NavigableSpace({self.free.mean():.1%} of {x} x {y} x {z} voxels of {self.voxel_size:.3g}; {self.rule})"

    @property
    def volume(self) -> float:
        """Volume of the free voxels, scene units cubed."""
        return float(np.count_nonzero(self.free)) * self.voxel_size**3

    def contains(self, points: ArrayLike) -> Mask:
        """Return (M,) whether each of the (M, 3) points lies in a navigable voxel."""
        array = _check.floats("points", points, ("M", 3), np.float64)
        return self._look_up(self.free, array)

    def on_grid(
        self, origin: ArrayLike, voxel_size: float, shape: tuple[int, int, int]
    ) -> tuple[tuple[slice, slice, slice], Mask, Mask]:
        """Return the part of a second grid in which this space lies, and which of its voxels are free, and occupied.

        Voxels are looked up at their middles.

        Args:
            origin: (3,) lowest corner of voxel (0, 0, 0) of the second grid, scene frame.
            voxel_size: Side of its voxels, scene units.
            shape: Number of its voxels along each axis.
        """
        corner = _check.floats("origin", origin, (3,), np.float64)
        index = list[NDArray[np.int64]]()
        blocks = list[slice]()
        for axis, count in enumerate(shape):
            middles = corner[axis] + voxel_size * (np.arange(count) + 0.5)
            places = np.floor((middles - self.origin[axis]) / self.voxel_size).astype(np.int64)
            first, last = np.searchsorted(places, [0, self.free.shape[axis]])
            blocks.append(slice(int(first), int(last)))
            index.append(places[first:last])
        inside = np.ix_(*index)
        return (blocks[0], blocks[1], blocks[2]), self.free[inside], self.occupied[inside]

    def covered(self) -> Mask:
        """Return (X, Y, Z) voxels with an occupied voxel somewhere above them in the grid, along any up axis."""
        return np.asarray(np.isfinite(heights_above(self.occupied, -self.up)))

    def where_people_stand(self) -> NavigableSpace | None:
        """Return the part at the eye height of standing people; None outside of rooms, or if it is too small.

        Only rooms need this: elsewhere viewpoints are at such heights anyway, or around an object.
        """
        if self.kind.kind != "rooms":
            return None
        standing = where_people_stand(self.free, self.occupied, self.voxel_size, self.up)
        if np.count_nonzero(standing) < _LEAST_STANDING * np.count_nonzero(self.free):
            return None
        return replace(self, free=standing, rule=f"{self.rule}, where people stand")

    def sample_viewpoints(self, count: int, rng: np.random.Generator) -> F64:
        """Return (count, 3) positions, uniform in the navigable space.

        Args:
            count: Number of viewpoints.
            rng: Source of randomness; the same state gives the same viewpoints.
        """
        _check.positive_int("count", count, at_least=0)
        flat = np.flatnonzero(self.free)
        voxels = np.stack(np.unravel_index(flat[rng.integers(len(flat), size=count)], self.free.shape), axis=1)
        # Keep off the faces of the voxel, so that rounding never puts a viewpoint into the next one.
        return np.asarray(self.origin + self.voxel_size * (voxels + 0.001 + 0.998 * rng.random((count, 3))))

    def sample_cameras(
        self, count: int, rng: np.random.Generator, *, width: int = 256, height: int = 192, fov: float = 60.0
    ) -> Cameras:
        """Return cameras as a visitor would hold them: anywhere in the space, upright, looking at something.

        Each looks at a random target within 45 degrees of the horizon whose line of sight stays free for at least 5% of
        the grid's longest side. If 16 draws find none, the draw with the longest free line is used.

        Args:
            count: Number of cameras.
            rng: Source of randomness; the same state gives the same cameras.
            width: Pixels.
            height: Pixels.
            fov: Horizontal field of view, degrees.
        """
        eyes = self.sample_viewpoints(count, rng)
        return self.cameras_at(eyes, rng, width=width, height=height, fov=fov)

    def cameras_at(
        self, eyes: ArrayLike, rng: np.random.Generator, *, width: int = 256, height: int = 192, fov: float = 60.0
    ) -> Cameras:
        """Return one camera at each given eye, directed as in `sample_cameras`.

        Args:
            eyes: (C, 3) viewpoints, scene frame.
            rng: Source of randomness.
            width: Pixels.
            height: Pixels.
            fov: Horizontal field of view, degrees.
        """
        eyes = _check.floats("eyes", eyes, ("C", 3), np.float64)
        count = len(eyes)
        shape = np.array(self.free.shape)
        if len(self.targets):
            aims = self.targets[rng.integers(len(self.targets), size=(count, _TRIES))]
        else:
            aims = self.origin + self.voxel_size * shape * rng.random((count, _TRIES, 3))
        sight = aims - eyes[:, None, :]
        distances = np.maximum(np.linalg.norm(sight, axis=2), 1e-9 * self.voxel_size)
        directions = sight / distances[:, :, None]
        runs = self._free_runs(np.repeat(eyes, _TRIES, axis=0), directions.reshape(-1, 3), distances.reshape(-1))
        runs = runs.reshape(count, _TRIES)
        level = np.abs(directions @ self.up) <= np.sqrt(0.5)
        good = level & (runs >= 0.05 * float(shape.max()) * self.voxel_size)
        best = np.where(good.any(axis=1), good.argmax(axis=1), np.where(level, runs, runs - 1e9).argmax(axis=1))
        chosen = directions[np.arange(count), best]
        chosen[~np.any(chosen, axis=1)] = np.eye(3)[np.abs(self.up).argmin()]  # the eye coincides with all its targets
        return Cameras.look_at(eyes, eyes + self.voxel_size * chosen, up=self.up, width=width, height=height, fov=fov)

    def free_distances(self, points: ArrayLike, directions: ArrayLike) -> F64:
        """Return (M,) the distance to the first occupied voxel, to half a voxel; infinite if there is none.

        Args:
            points: (M, 3) starts, scene frame.
            directions: (M, 3) unit vectors.
        """
        starts = _check.floats("points", points, ("M", 3), np.float64)
        ahead = _check.floats("directions", directions, (len(starts), 3), np.float64)
        shape = np.array(self.free.shape)
        found = np.full(len(starts), np.inf)
        going = np.arange(len(starts))
        step = 0.5 * self.voxel_size
        for count in range(1, 4 * int(shape.sum())):
            cells = np.floor((starts[going] + count * step * ahead[going] - self.origin) / self.voxel_size)
            within = np.all((cells >= 0) & (cells < shape), axis=1)
            going = going[within]
            cells = cells[within].astype(np.int64)
            if len(going) == 0:
                break
            hit = self.occupied[tuple(cells.T)]
            found[going[hit]] = count * step
            going = going[~hit]
        return found

    def _look_up(self, grid: Mask, points: F64) -> Mask:
        """Return the values of a mask at points; False outside the grid."""
        shape = np.array(grid.shape)
        with np.errstate(over="ignore"):
            place = (points - self.origin) / self.voxel_size
        inside = np.all((place >= 0) & (place < shape), axis=1)
        result = np.zeros(len(points), bool)
        result[inside] = grid[tuple(place[inside].astype(np.int64).T)]
        return result

    def _free_runs(self, starts: F64, directions: F64, lengths: F64) -> F64:
        """Return (M,) distances along each line, at most its length, before it enters an occupied voxel."""
        runs = lengths.copy()
        going = np.arange(len(starts))
        t = 0.0
        while len(going):
            t += 0.5 * self.voxel_size
            going = going[lengths[going] > t]
            hit = self._look_up(self.occupied, starts[going] + t * directions[going])
            runs[going[hit]] = t
            going = going[~hit]
            if t > 2.0 * sum(self.free.shape) * self.voxel_size:  # targets far outside the grid
                break
        return np.asarray(runs)


def _points_of(seeds: ArrayLike | None) -> F64:
    """Return seeds as an array (S, 3); empty without any."""
    return np.zeros((0, 3)) if seeds is None else _check.floats("seeds", seeds, ("S", 3), np.float64)
