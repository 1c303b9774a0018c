"""Measure the similarity of a scene to images: PSNR and SSIM of each view, clipped to [0, 1] as on a display."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.progress import Progress, silent
from gsvis.render.device_scene import DeviceScene
from gsvis.render.metrics import psnr, ssim
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train.history import MOST_PSNR
from gsvis.train.images import PosedImages

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
    gaussians: Gaussians, views: PosedImages, *, backend: str = "auto", progress: Progress = silent
) -> ViewLikeness:
    """Render a scene with the cameras of some images, and compare.

    Args:
        gaussians: The scene.
        views: C images and cameras, C >= 1.
        backend: Backend that renders, see `DeviceScene`.
        progress: Called for every view; stage "measure".

    Raises:
        ValueError: If there are no views.
    """
    if len(views) == 0:
        raise ValueError("views: expected at least one to compare with, got none")
    scene = DeviceScene(gaussians, backend)
    found = np.empty((2, len(views)))
    progress("measure", 0, len(views))
    for index in range(len(views)):
        drawn = _display(scene, views.cameras[index])
        target = np.clip(views.image(index), 0.0, 1.0)
        found[:, index] = min(float(psnr(drawn, target)), MOST_PSNR), float(ssim(drawn, target))
        progress("measure", index + 1, len(views))
    return ViewLikeness(views.cameras.names, *found)


def mean_psnr(
    gaussians: Gaussians, views: PosedImages, backend: str = "auto", antialiased: bool | None = None
) -> float:
    """Return the mean PSNR over views in dB, of images clipped to [0, 1] as on a display.

    Args:
        gaussians: The scene.
        views: The views.
        backend: Backend that renders, see `DeviceScene`.
        antialiased: As for `rasterize`.
    """
    scene = DeviceScene(gaussians, backend)
    drawn = (_display(scene, views.cameras[index], antialiased) for index in range(len(views)))
    targets = (np.clip(views.image(index), 0.0, 1.0) for index in range(len(views)))
    return float(np.mean([psnr(image, target) for image, target in zip(drawn, targets, strict=True)]))


def _display(scene: DeviceScene, camera: Cameras, antialiased: bool | None = None) -> NDArray[np.float32]:
    """Return the (H, W, 3) image of one camera as a display shows it: clipped to [0, 1]."""
    return np.asarray(np.clip(scene.draw(camera, antialiased=antialiased).images[0], 0.0, 1.0), np.float32)
