"""Choose views if no cameras are given: at random in navigable space, outside of solid parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, union_of
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.solid import buried

__all__ = ["ViewSampling"]

F64 = NDArray[np.float64]

_TRIES = 32  # draws of viewpoints until enough lie outside of solid parts


@dataclass(frozen=True)
class ViewSampling:
    """Draw cameras at random in navigable space, none inside something solid.

    Args:
        count: Number of cameras.
        width: Pixels.
        height: Pixels.
        fov: Horizontal field of view, degrees.
        seed: Seed of the random numbers.
        stream: Index of one of the independent random streams of the seed.
        standing: Share of the cameras at the eye height of standing people, in rooms; others are anywhere.

    Raises:
        ValueError: If a value is out of range.
    """

    count: int = 96
    width: int = 320
    height: int = 240
    fov: float = 60.0
    seed: int = 0
    stream: int = 0
    standing: float = 0.0

    def __post_init__(self) -> None:
        for name, least in (("count", 0), ("width", 1), ("height", 1), ("seed", 0), ("stream", 0)):
            _check.positive_int(name, getattr(self, name), at_least=least)
        if not 1.0 <= self.fov <= 179.0:
            raise ValueError(f"fov: expected degrees in [1, 179], got {self.fov!r}")
        if not 0.0 <= self.standing <= 1.0:
            raise ValueError(f"standing: expected a share in [0, 1], got {self.standing!r}")

    def cameras(self, g: Gaussians | Levels, navigable: NavigableSpace) -> Cameras:
        """Draw the cameras.

        Args:
            g: The scene, or levels; eyes lie outside of the solid parts of all levels.
            navigable: Allowed viewpoints.

        Raises:
            SceneError: If too few viewpoints lie outside of solid parts.
        """
        rng = np.random.default_rng([self.seed, self.stream])
        union = union_of(g)
        places = navigable.where_people_stand() if self.standing else None
        standing = 0 if places is None else round(self.standing * self.count)
        eyes = self._draw(union, navigable, self.count - standing, rng)
        if places is not None:
            eyes = np.concatenate([eyes, self._draw(union, places, standing, rng)])[rng.permutation(self.count)]
        return navigable.cameras_at(eyes, rng, width=self.width, height=self.height, fov=self.fov)

    def _draw(self, union: Gaussians, places: NavigableSpace, count: int, rng: np.random.Generator) -> F64:
        """Return (count, 3) viewpoints in navigable space, outside of solid parts."""
        eyes = np.zeros((0, 3))
        for _ in range(_TRIES):
            drawn = places.sample_viewpoints(count, rng)
            eyes = np.concatenate([eyes, drawn[~buried(union, drawn)]])
            if len(eyes) >= count:
                return eyes[:count]
        raise SceneError(
            f"only {len(eyes):,} of {count * _TRIES:,} viewpoints drawn in navigable space lie outside of solid parts;"
            " give cameras, or a different navigable space"
        )
