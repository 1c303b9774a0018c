"""Render pictures of the views that need the most, the median and the least of a scene, by ray casting."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsvis import _check
from gsvis.progress import Progress, silent
from gsvis.raycast import Tracer, ray_image, visible_in
from gsvis.raycast.analysis import Analysis
from gsvis.report.frames import eight_bit
from gsvis.report.html import Figure

__all__ = ["ViewPicture", "picture_figures", "picture_views"]

_LEVEL = 6  # of compression; the highest saves 5% of the bytes of a rendered picture and takes eight times as long


@dataclass(frozen=True, eq=False)
class ViewPicture:
    """One view of a report.

    Attributes:
        role: "most", "median" or "least", by visible share.
        camera: Index of the camera in the analysis.
        image: (H, W, 3) float32, 0 black to 1 white; brighter values are kept.
        visible: (N,) whether the camera sees each Gaussian, with the analysis's rays.
    """

    role: str
    camera: int
    image: NDArray[np.float32]
    visible: NDArray[np.bool_]


def picture_views(
    tracer: Tracer, analysis: Analysis, *, longest_side: int = 512, progress: Progress = silent
) -> list[ViewPicture]:
    """Render the views with the largest, the median and the smallest visible share.

    Args:
        tracer: The analyzed scene.
        analysis: The analysis.
        longest_side: Pixels of the longer side of the pictures.
        progress: Called with stage "pictures".

    Returns:
        Up to three pictures; fewer if there are fewer cameras.
    """
    _check.positive_int("longest_side", longest_side)
    order = np.argsort(-analysis.visible, kind="stable")
    roles = {int(order[len(order) // 2]): "median", int(order[-1]): "least", int(order[0]): "most"}
    cameras = analysis.cameras
    factor = longest_side / max(cameras.width, cameras.height)
    size = [max(1, round(factor * side)) for side in (cameras.width, cameras.height)]
    pictures = []
    progress("pictures", 0, len(roles))
    for index, role in sorted(roles.items(), key=lambda item: ("most", "median", "least").index(item[1])):
        camera = cameras[index]
        visible = visible_in(tracer, camera)[0] >= np.float32(analysis.config.tau)
        pictures.append(ViewPicture(role, index, ray_image(tracer, camera.resize(*size)), visible))
        progress("pictures", len(pictures), len(roles))
    return pictures


def picture_figures(images: Mapping[str, NDArray[np.float32]]) -> dict[str, Figure]:
    """Return images (H, W, 3) as figures by name; values outside [0, 1] are clipped."""
    return {name: Figure(f"{name}.png", _png(image)) for name, image in images.items()}


def _png(image: NDArray[np.float32]) -> bytes:
    """Return an image (H, W, 3) as the bytes of a PNG."""
    out = io.BytesIO()
    Image.fromarray(eight_bit(image)).save(out, "PNG", compress_level=_LEVEL)
    return out.getvalue()
