"""Hold properties of a whole scene that are needed to clean a part of it: its box, its navigable space, its air.

Found from parts of which one is in memory at a time; the grids have a bounded number of voxels. Scene frame and units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.edit.classes import CleanConfig
from gsvis.edit.evidence import Air, find_air
from gsvis.edit.shape import Shape, Surfaces
from gsvis.errors import SceneError
from gsvis.files.archive import load_arrays, save_arrays
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import MIN_ALPHA
from gsvis.scene.navigable import NavigableSpace
from gsvis.world.tiles import load_space, save_space

__all__ = ["Whole", "core_within", "find_space", "load_whole", "save_whole"]

F64 = NDArray[np.float64]

_MOST_EYES = 1 << 12  # of a scene of many places


@dataclass(frozen=True, eq=False)
class Whole:
    """Properties of a whole scene.

    Attributes:
        low: (3,) lowest corner of its robust box.
        high: (3,) highest corner.
        navigable: Allowed viewpoints.
        air: Its air, and the eyes in it.
    """

    low: F64
    high: F64
    navigable: NavigableSpace
    air: Air

    @classmethod
    def from_parts(
        cls, parts: Iterable[Gaussians], sample: Gaussians, space: NavigableSpace, config: CleanConfig
    ) -> Whole:
        """Return the properties that `clean` finds in a complete scene.

        Args:
            parts: The scene, part by part; iterated over three times.
            sample: A random sample of its visible Gaussians.
            space: Navigable space. Each of its parcels gets as many eyes as a scene.
            config: Eyes, resolution, strength, seed.

        Raises:
            SceneError: If all eyes lie inside something solid.
        """
        low, high = sample.bounds(0.98)
        core = _Filtered(parts, lambda g: core_within(g, low, high))
        many = replace(config, eyes=max(config.eyes, min(config.eyes * space.parcels, _MOST_EYES)))
        return cls(low, high, space, find_air(core, low, high, space, many, np.zeros((0, 3))))


def find_space(parts: Iterable[Gaussians], sample: Gaussians, *, up: ArrayLike | str | None = None) -> NavigableSpace:
    """Find the navigable space of a scene that comes in parts, by one grid over all of it, between its surfaces.

    Args:
        parts: The scene, part by part; iterated over about five times.
        sample: A random sample of its visible Gaussians.
        up: (3,) direction or an axis such as "+z"; guessed by default.

    Raises:
        SceneError: If there is only haze, or no navigable space.
    """
    low, high = sample.bounds(0.98)
    core = _Filtered(parts, lambda g: core_within(g, low, high))
    some = core_within(sample, low, high)
    if not (len(some) and np.any(high > low)):
        raise SceneError("the scene has nothing but haze and Gaussians far outside: no surface is left to look at")
    found = Surfaces.over(core, low, high)
    kept = _Filtered(core, lambda g: g[~found.lonely(g.means)])
    return NavigableSpace.from_parts(kept, some[~found.lonely(some.means)], up=up)


def core_within(g: Gaussians, low: F64, high: F64) -> Gaussians:
    """Return the visible Gaussians of a part that hide others, by the robust box of the whole scene."""
    return g[Shape.within(g, low, high).core & (g.opacities >= MIN_ALPHA)]


def save_whole(out: Path, whole: Whole) -> None:
    """Write the properties of a scene to a folder."""
    save_space(out / "space", whole.navigable)
    air = whole.air
    arrays = {"labels": air.labels, "open_air": air.open_air, "eyes": air.eyes, "origin": air.origin}
    sizes = {"voxel_size": np.array([air.voxel_size]), "low": whole.low, "high": whole.high}
    save_arrays(out / "air", {**arrays, **sizes})


def load_whole(space: Path, air: Path) -> Whole:
    """Return the properties that `save_whole` wrote.

    Raises:
        FormatError: If a file is damaged.
    """
    found = load_arrays(air, sealed=True)
    known = Air(found["origin"], float(found["voxel_size"][0]), found["labels"], found["open_air"], found["eyes"])
    return Whole(found["low"], found["high"], load_space(space), known)


@dataclass(frozen=True)
class _Filtered:
    """Some Gaussians of each part of a scene, read again at each iteration."""

    parts: Iterable[Gaussians]
    keep: Callable[[Gaussians], Gaussians]

    def __iter__(self) -> Iterator[Gaussians]:
        for part in self.parts:
            kept = self.keep(part)
            if len(kept):
                yield kept
