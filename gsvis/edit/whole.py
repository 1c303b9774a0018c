"""What is known of a scene as a whole, so that a part of it can be judged alone: its box, where eyes may be, its air.

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
    """What is known of a scene as a whole.

    Attributes:
        low: (3,) lowest corner of its robust box.
        high: (3,) highest corner.
        navigable: Where eyes may be.
        air: Its air, and the eyes that look around.
    """

    low: F64
    high: F64
    navigable: NavigableSpace
    air: Air

    @classmethod
    def from_parts(
        cls, parts: Iterable[Gaussians], sample: Gaussians, space: NavigableSpace, config: CleanConfig
    ) -> Whole:
        """Find what `clean` finds of a scene at once.

        Args:
            parts: The scene, part by part; iterated over three times.
            sample: Some of its Gaussians that can be seen, drawn at random.
            space: Where eyes may be. Each of its parcels gets as many eyes as one scene has.
            config: Eyes, resolution, strength, seed.

        Raises:
            SceneError: If all eyes lie inside something solid.
        """
        low, high = sample.bounds(0.98)
        core = _Filtered(parts, lambda g: core_within(g, low, high))
        many = replace(config, eyes=max(config.eyes, min(config.eyes * space.parcels, _MOST_EYES)))
        return cls(low, high, space, find_air(core, low, high, space, many, np.zeros((0, 3))))


def find_space(parts: Iterable[Gaussians], sample: Gaussians, *, up: ArrayLike | str | None = None) -> NavigableSpace:
    """Find where eyes may be in a scene that comes in parts, by one grid over all of it, between its surfaces.

    Args:
        parts: The scene, part by part; iterated over five times or so.
        sample: Some of its Gaussians that can be seen, drawn at random.
        up: (3,) direction or an axis such as "+z"; guessed by default.

    Raises:
        SceneError: If nothing but haze is there, or no eye can be anywhere.
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
    """Return the Gaussians of a part that can be seen and hide things, by the robust box of the whole scene."""
    return g[Shape.within(g, low, high).core & (g.opacities >= MIN_ALPHA)]


def save_whole(out: Path, whole: Whole) -> None:
    """Write what is known of a scene into a folder."""
    save_space(out / "space", whole.navigable)
    air = whole.air
    arrays = {"labels": air.labels, "open_air": air.open_air, "eyes": air.eyes, "origin": air.origin}
    sizes = {"voxel_size": np.array([air.voxel_size]), "low": whole.low, "high": whole.high}
    save_arrays(out / "air", {**arrays, **sizes})


def load_whole(space: Path, air: Path) -> Whole:
    """Return what `save_whole` wrote.

    Raises:
        FormatError: If a file is damaged.
    """
    found = load_arrays(air, sealed=True)
    known = Air(found["origin"], float(found["voxel_size"][0]), found["labels"], found["open_air"], found["eyes"])
    return Whole(found["low"], found["high"], load_space(space), known)


@dataclass(frozen=True)
class _Filtered:
    """Some Gaussians of each part of a scene, read again whenever they are iterated over."""

    parts: Iterable[Gaussians]
    keep: Callable[[Gaussians], Gaussians]

    def __iter__(self) -> Iterator[Gaussians]:
        for part in self.parts:
            kept = self.keep(part)
            if len(kept):
                yield kept
