"""Measure the similarity of a scene to images: PSNR and SSIM of each view, clipped to [0, 1] as on a display."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsvis.progress import Progress, silent
from gsvis.render.metrics import psnr, ssim
from gsvis.scene.gaussians import Gaussians
from gsvis.train.history import MOST_PSNR
from gsvis.train.images import PosedImages, display_image

if TYPE_CHECKING:
    from gsvis.render.tensors import GaussianTensors

__all__ = ["ViewLikeness", "mean_psnr", "measure_views"]


@dataclass(frozen=True, eq=False)
class ViewLikeness:
    """Similarity of a scene to C images.

    Attributes:
        names: C names of views.
        psnr: (C,) dB, at most 100.
        ssim: (C,), at most 1, over windows that lie inside the image.
    """

    names: tuple[str, ...]
    psnr: NDArray[np.float64]
    ssim: NDArray[np.float64]

    def as_dict(self) -> dict[str, Any]:
        """Return JSON values: mean and worst, and every view."""
        return {
            "views": len(self.names),
            "psnr": {"mean": float(self.psnr.mean()), "worst": float(self.psnr.min())},
            "ssim": {"mean": float(self.ssim.mean()), "worst": float(self.ssim.min())},
            "each": [
                {"name": name, "psnr": float(p), "ssim": float(s)}
                for name, p, s in zip(self.names, self.psnr, self.ssim, strict=True)
            ],
        }


def measure_views(
    gaussians: Gaussians, views: PosedImages, *, device: str = "cpu", progress: Progress = silent
) -> ViewLikeness:
    """Render a scene with the cameras of some images, and compare.

    Args:
        gaussians: The scene.
        views: C images and cameras, C >= 1.
        device: Device to render on, such as "cuda".
        progress: Called for every view; stage "measure".

    Raises:
        ValueError: If there are no views.
    """
    if len(views) == 0:
        raise ValueError("views: expected at least one to compare with, got none")
    scene: Any = gaussians
    if device != "cpu":
        from gsvis.render.tensors import GaussianTensors

        scene = GaussianTensors.from_gaussians(gaussians, device=device)
    found = np.empty((2, len(views)))
    progress("measure", 0, len(views))
    for index in range(len(views)):
        drawn = display_image(scene, views.cameras[index])
        target = np.clip(views.image(index), 0.0, 1.0)
        found[:, index] = min(float(psnr(drawn, target)), MOST_PSNR), float(ssim(drawn, target))
        progress("measure", index + 1, len(views))
    return ViewLikeness(views.cameras.names, *found)


def mean_psnr(
    gaussians: Gaussians | GaussianTensors,
    views: PosedImages,
    backend: str = "auto",
    antialiased: bool | None = None,
) -> float:
    """Return the mean PSNR over views in dB, of images clipped to [0, 1] as on a display.

    Args:
        gaussians: The scene.
        views: The views.
        backend: Backend of the rasterizer.
        antialiased: As for `rasterize`.
    """
    drawn = (display_image(gaussians, views.cameras[index], backend, antialiased) for index in range(len(views)))
    targets = (np.clip(views.image(index), 0.0, 1.0) for index in range(len(views)))
    return float(np.mean([psnr(image, target) for image, target in zip(drawn, targets, strict=True)]))
