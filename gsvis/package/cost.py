"""Measure how much quality is lost by rounding to records: PSNR of images of the decoded against the exact scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.color.evaluate import Evaluator
from gsvis.color.records import QuantizedColors
from gsvis.color.srbf import SrbfColors
from gsvis.files.mapped import release_mapped
from gsvis.package.manifest import Cost
from gsvis.package.order import PackageOrder
from gsvis.package.rounding import Limits, rounded_contents
from gsvis.progress import Progress, silent
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

__all__ = ["measure_cost"]

_CAP = 100.0


def measure_cost(
    levels: Levels,
    exact: SrbfColors,
    colors: QuantizedColors,
    cameras: Cameras,
    *,
    limits: Limits | None = None,
    order: PackageOrder | None = None,
    progress: Progress = silent,
) -> Cost:
    """Measure the PSNR of the highest level, decoded from records, against the original.

    Args:
        levels: Levels in the order of a package.
        exact: Colors of the union before rounding.
        colors: Colors of the union after rounding.
        cameras: C > 0 views.
        limits: How records are rounded; None for records that have all bits.
        order: The order of these levels, if it is known; None finds it.
        progress: Called with stage "cost", in images: two of each view.

    Raises:
        ValueError: If lengths do not match or there is no camera.
    """
    if len(cameras) == 0:
        raise ValueError("cameras: expected at least one, got none")
    if len(exact) != len(levels.union):
        raise ValueError(f"exact: expected colors of {len(levels.union):,} Gaussians, got {len(exact):,}")
    contents = rounded_contents(levels, colors, limits, order)
    release_mapped([*vars(levels.union).values(), *vars(colors).values()])
    member = levels.member(len(levels) - 1)
    done = 0

    def draw(g: Gaussians, evaluator: Evaluator) -> list[NDArray[np.float32]]:
        """Return the images of all views."""
        nonlocal done
        images = []
        for c in range(len(cameras)):
            colors = evaluator.colors(g.means, cameras[c].viewpoints[0])
            images.append(np.clip(rasterize(g, cameras[c], colors=colors).images[0], 0.0, 1.0))
            done += 1
            progress("cost", done, 2 * len(cameras))
        return images

    progress("cost", 0, 2 * len(cameras))
    wanted = draw(levels.union.without_harmonics().showing(member), Evaluator(exact, keep=False))
    after = Evaluator(contents.colors().dequantize(), keep=False)
    rounded = draw(contents.gaussians().showing(member), after)
    found = [min(_CAP, float(psnr(image, other))) for image, other in zip(rounded, wanted, strict=True)]
    return Cost(float(np.mean(found)), float(np.min(found)), len(cameras), cameras.width, cameras.height)
