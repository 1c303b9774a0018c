"""Judge by a few small views whether eyes in a navigable space see what a visitor would. Scene frame and units."""

from __future__ import annotations

import numpy as np

from gsvis.render.rasterizer import rasterize
from gsvis.render.weights import view_weights
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["find_implausible"]

_LOOKS = ViewSampling(8, 96, 72, 90.0)
_LEAST_SEEN = 0.01  # share of the Gaussians
_LEAST_LIGHT = 0.05  # mean alpha of a view that does not look into the void
_MUCH_LIGHT = 0.9  # mean alpha of a view that looks at something
_VISIBLE = 1.0 / 255.0
_CLOSE = 0.01  # of the scene's diagonal: views that end within it look into one surface
_MANY = 0.5  # share of the views that is reported


def find_implausible(g: Gaussians, space: NavigableSpace) -> list[str]:
    """Return a phrase for each way in which what eyes see is implausible; empty if nothing is.

    Args:
        g: The scene.
        space: Where eyes may be; eight views are drawn in it.

    Raises:
        SceneError: If no view can be drawn.
    """
    cameras = _LOOKS.cameras(g, space)
    seen = float((view_weights(g, cameras).largest >= _VISIBLE).mean())
    drawn = rasterize(g, cameras, backend="cpu", sh_degree=0)
    light = drawn.alphas.reshape(len(cameras), -1).mean(axis=1)
    depth = np.median(drawn.depths.reshape(len(cameras), -1), axis=1)
    diagonal = float(np.linalg.norm(np.subtract(*g.bounds(0.98)[::-1])))
    void = float(np.mean(light < _LEAST_LIGHT))
    close = float(np.mean((light > _MUCH_LIGHT) & (depth < _CLOSE * diagonal)))
    return [
        *([f"a view sees {seen:.2%} of the Gaussians on average"] if seen < _LEAST_SEEN else []),
        *([f"{void:.0%} of the views look into the void"] if void >= _MANY else []),
        *([f"{close:.0%} of the views look into one surface"] if close >= _MANY else []),
    ]
