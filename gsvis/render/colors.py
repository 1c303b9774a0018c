"""Colors that replace SH in `rasterize`: one set for all cameras, one for each camera, or SRBF colors.

SRBF colors are evaluated for one camera at a time, when it is drawn. `gsvis.render.colors_torch` does the same for
tensors.
"""

from __future__ import annotations

from collections.abc import Callable, Sized

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color.evaluate import Evaluator
from gsvis.color.srbf import SrbfColors
from gsvis.scene.cameras import Cameras

__all__ = ["Colors", "camera_colors", "check_color_shape", "check_count"]

F32 = NDArray[np.float32]
Colors = ArrayLike | SrbfColors | Evaluator | None


def camera_colors(colors: Colors, means: F32, cameras: Cameras) -> Callable[[int], F32 | None]:
    """Check the colors given to `rasterize`, and return a function that gives the colors for one camera.

    Args:
        colors: The argument `colors` of `rasterize`.
        means: (N, 3) centers of the Gaussians, world frame.
        cameras: The C cameras.

    Returns:
        Function from the number of a camera to (N, 3) RGB, or to None if the Gaussians have SH colors.

    Raises:
        ValueError: If there is not one color for each Gaussian, or a value is not finite.
    """
    if colors is None:
        return lambda c: None
    if not isinstance(colors, SrbfColors | Evaluator):
        n = len(means)
        given: F32 = _check.floats("colors", colors, np.shape(colors))
        check_color_shape(given.shape, n, len(cameras))
        each = given if given.ndim == 3 else given[None]
        return lambda c: each[c if len(each) > 1 else 0]
    check_count(colors, len(means))
    evaluator = colors if isinstance(colors, Evaluator) else Evaluator(colors)
    eyes = cameras.viewpoints
    return lambda c: evaluator.colors(means, eyes[c])


def check_color_shape(shape: tuple[int, ...], n: int, cameras: int) -> None:
    """Raise unless colors are (N, 3) or (C, N, 3)."""
    if tuple(shape) not in ((n, 3), (cameras, n, 3)):
        raise ValueError(f"colors: expected shape ({n}, 3) or ({cameras}, {n}, 3), got {tuple(shape)}")


def check_count(colors: Sized, n: int) -> None:
    """Raise unless there are SRBF colors for exactly N Gaussians."""
    if len(colors) != n:
        raise ValueError(f"colors: expected those of {n} Gaussians, got {len(colors)}; fit them to this scene")
