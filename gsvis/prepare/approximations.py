"""Render a scene with all terms of its colors, and with only the terms active at an epsilon.

The metric that replaces a person in the staircase compares these images.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gsvis.color import Evaluator
from gsvis.color.activation import Activation
from gsvis.color.srbf import SrbfColors
from gsvis.render.metrics import flip_map
from gsvis.render.rasterizer import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["Approximations", "flip_difference"]

F32 = NDArray[np.float32]


class Approximations:
    """Views of one scene, rendered with all terms or without the terms below an epsilon.

    Args:
        g: N Gaussians.
        colors: Their colors, with T terms.
        cameras: C cameras of one size.

    Attributes:
        reference: (C, H, W, 3) images with all terms, not clipped.

    Raises:
        ValueError: If lengths differ or there is no camera.
    """

    def __init__(self, g: Gaussians, colors: SrbfColors, cameras: Cameras) -> None:
        if len(g) != len(colors):
            raise ValueError(f"colors: expected those of {len(g)} Gaussians, got {len(colors)}")
        if len(cameras) == 0:
            raise ValueError("cameras: expected at least one, got none")
        self._gaussians = g
        self._cameras = cameras
        self._evaluator = Evaluator(colors)
        activation = Activation(colors, g.means, 0.0)
        self._eyes = cameras.viewpoints
        self._contributions = [activation.contributions(eye) for eye in self._eyes]
        self.reference = np.stack([self._draw(view, None) for view in range(len(cameras))])

    def images(self, epsilon: float) -> F32:
        """Return (C, H, W, 3) images with the terms that change a channel by more than epsilon."""
        return np.stack([self._draw(view, epsilon) for view in range(len(self._cameras))])

    def shares(self, epsilon: float) -> NDArray[np.float64]:
        """Return (C,) shares of active terms, for each view's eye; 0 if there are no terms."""
        counts = [int((found > np.float32(epsilon)).sum()) for found in self._contributions]
        return np.asarray(counts) / max(1, len(self._contributions[0]))

    def _draw(self, view: int, epsilon: float | None) -> F32:
        """Return the image of a view at an epsilon."""
        active = None if epsilon is None else self._contributions[view] > np.float32(epsilon)
        colors = self._evaluator.colors(self._gaussians.means, self._eyes[view], active=active)
        image: F32 = rasterize(self._gaussians, self._cameras[view], colors=colors).images[0]
        return image


def flip_difference(
    pictures: Approximations, *, percentile: float = 99.0, pixels_per_degree: float = 67.0
) -> Callable[[float], float]:
    """Return the metric for `MetricObserver`: the difference that an epsilon makes in the worst view.

    Args:
        pictures: The views.
        percentile: Percentile of the FLIP map of a view: 99 is the error that the worst hundredth of the image
            exceeds. A single pixel is invisible to an eye; the mean hides an error in a small part of the image.
        pixels_per_degree: Resolution of the observer's field of view.

    Returns:
        A function from epsilon to the largest percentile over the views.

    Raises:
        ValueError: If the percentile is not in [0, 100].
        BackendError: When called, if the package flip-evaluator is missing.
    """
    if not 0.0 <= percentile <= 100.0:
        raise ValueError(f"percentile: expected a value in [0, 100], got {percentile!r}")

    def difference(epsilon: float) -> float:
        """Return the largest percentile over the views."""
        maps = flip_map(pictures.images(epsilon), pictures.reference, pixels_per_degree)
        return float(np.percentile(maps, percentile, axis=(1, 2)).max())

    return difference
