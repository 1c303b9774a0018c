"""Find the place of a scene whose color changes most with the eye: what figure 17 shows from three sides.

Scene frame and units; `up` is that of the space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.color import sh_colors
from gsvis.raycast import TAU, EllipsoidProxies, Tracer, visible_from
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["Highlight", "find_highlight"]

F64 = NDArray[np.float64]

_EYES = 64
_CANDIDATES = 256
_SEED = 17
_FOV = 60.0


@dataclass(frozen=True, eq=False)
class Highlight:
    """A place, and three eyes that see it.

    Attributes:
        target: (3,) the place.
        eyes: (3, 3); the first and the last see colors that differ most.
        angles: (3,) degrees at the place between each eye and the first.
        up: (3,) upward in images.
    """

    target: F64
    eyes: F64
    angles: F64
    up: F64

    def cameras(self, width: int, height: int) -> Cameras:
        """Return cameras at the eyes that look at the place."""
        return Cameras.look_at(
            self.eyes, np.tile(self.target, (3, 1)), up=self.up, width=width, height=height, fov=_FOV
        )


def find_highlight(
    g: Gaussians, space: NavigableSpace, importance: ArrayLike, eyes: ArrayLike | None = None
) -> Highlight:
    """Return the place whose color changes most, of those that views show most.

    Args:
        g: N Gaussians.
        space: Where eyes may be.
        importance: (N,) how much views show each Gaussian.
        eyes: (E, 3) where eyes are; drawn from the space by default.

    Raises:
        ValueError: If no candidate is seen by two eyes.
    """
    strength = np.asarray(importance, np.float64) * np.sqrt((g.shN.astype(np.float64) ** 2).sum(axis=(1, 2)))
    ids = np.argsort(-strength, kind="stable")[:_CANDIDATES]
    drawn = space.sample_viewpoints(_EYES, np.random.default_rng(_SEED)) if eyes is None else eyes
    points = np.asarray(drawn, np.float64)
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    seen = visible_from(tracer, points, sampling="gaussians", ids=ids) >= TAU
    colors = np.stack([sh_colors(g[ids], eye) for eye in points])
    best = -1.0, 0, 0, 0
    for k in range(len(ids)):
        those = np.flatnonzero(seen[:, k])
        if len(those) < 2:
            continue
        apart = np.linalg.norm(colors[those, None, k] - colors[None, those, k], axis=2)
        one, other = np.unravel_index(int(apart.argmax()), apart.shape)
        best = max(best, (float(apart.max()), k, int(those[one]), int(those[other])))
    if best[0] < 0.0:
        raise ValueError("scene: expected a Gaussian that two eyes see, got none; take another scene")
    _, k, first, last = best
    target = g.means[ids[k]].astype(np.float64)
    ways = _unit(points - target)
    halfway = _unit((ways[first] + ways[last])[None])[0]
    between = np.where(seen[:, k], ways @ halfway, -2.0)
    between[[first, last]] = -2.0
    middle = int(between.argmax()) if between.max() > -2.0 else first
    chosen = [first, middle, last]
    angles = np.degrees(np.arccos(np.clip(ways[chosen] @ ways[first], -1.0, 1.0)))
    return Highlight(target, points[chosen], angles, np.asarray(space.up, np.float64))


def _unit(rows: F64) -> F64:
    """Return rows of length 1."""
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300))
