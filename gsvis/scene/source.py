"""A scene as it was opened: its Gaussians, all levels if it has some, its name, and which way is up if that is known.

`gsvis.io.sources` opens one from a path. Scene frame and units.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.errors import SceneError
from gsvis.scene.axes import axis_vector, nearest_axis
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.stated import stated_space
from gsvis.scene.upright import find_up

__all__ = ["SOME", "Source"]

SOME = 100_000
"""Gaussians of a thin scene: enough to find where eyes may be and to draw a small view."""

_TURNED = 0.5  # least confidence at which a scene is rotated by an oblique angle
_HELD = 0.5  # least share of known positions in a stated box


@dataclass(frozen=True, eq=False)
class Source:
    """A scene and what is known about it besides its Gaussians.

    Attributes:
        name: Name of the scene in a report.
        gaussians: The scene; of a folder of levels the highest level, which pictures show.
        path: File or folder of the scene; None for a built-in scene.
        lod: The LOD that was read; None for a scene without.
        lods: LODs that are present in a streamed scene; empty for any other.
        levels: All levels of a folder of levels; None for any other scene.
        known_up: The (3,) up axis: that of a built-in scene, +y of glTF, or what a folder of levels states; None where
            it has to be guessed.
    """

    name: str
    gaussians: Gaussians
    path: Path | None = None
    lod: int | None = None
    lods: tuple[int, ...] = ()
    levels: Levels | None = None
    known_up: NDArray[np.float64] | None = None

    @property
    def whole(self) -> Gaussians | Levels:
        """The scene, or all levels."""
        return self.gaussians if self.levels is None else self.levels

    @property
    def union(self) -> Gaussians:
        """The Gaussians of the scene, or those of all levels together."""
        return self.gaussians if self.levels is None else self.levels.union

    @property
    def up(self) -> NDArray[np.float64]:
        """The (3,) up axis: the known one, else the likely one."""
        return find_up(self.union, check=False).up if self.known_up is None else self.known_up

    @property
    def steady_up(self) -> NDArray[np.float64]:
        """The (3,) up axis to rotate the scene by: as `up`, but an uncertain one is the nearest coordinate axis."""
        if self.known_up is not None:
            return self.known_up
        found = find_up(self.union, check=False)
        return found.up if found.confidence >= _TURNED else axis_vector(nearest_axis(found.up))

    def thin(self, most: int | None = None) -> Source:
        """Return the scene with a random sample of its Gaussians, enlarged so that their total area stays the same.

        Args:
            most: Largest number of Gaussians; `SOME` by default.
        """
        g = self.gaussians
        most = most or SOME
        if len(g) > most:
            some = np.sort(np.random.default_rng(0).choice(len(g), most, replace=False))
            g = replace(g[some], scales=g.scales[some] * np.float32(np.sqrt(len(g) / most)))
        return replace(self, gaussians=g, levels=None)

    def navigable(
        self, *, up: ArrayLike | None = None, seeds: ArrayLike | None = None
    ) -> tuple[NavigableSpace | None, str]:
        """Return the navigable space of the scene and ""; None and the reason if there is none.

        A box that the scene states comes before its Gaussians; seeds that mostly lie outside of it come before both.

        Args:
            up: (3,) up axis; None means the known one, else a guess.
            seeds: (S, 3) positions known to be navigable.
        """
        axis = self.known_up if up is None else up
        try:
            stated = stated_space(self.gaussians, up=axis)
        except SceneError:  # nothing in the box is free
            stated = None
        if stated is not None and (seeds is None or np.mean(stated.contains(seeds)) >= _HELD):
            return stated, ""
        try:
            return NavigableSpace.from_scene(self.gaussians, up=axis, seeds=seeds), ""
        except SceneError as error:
            return None, error.problem

    def spaces_of_build(self, up: ArrayLike) -> Iterator[NavigableSpace]:
        """Yield the navigable spaces in which visible sets of the scene may have been built.

        Where up was certain, the space was found with it; where it was a guess, with eyes on all sides.

        Args:
            up: (3,) up axis that was stored with the sets.
        """
        for axis in (up, None):
            space, _ = self.navigable(up=axis)
            if space is not None:
                yield space
