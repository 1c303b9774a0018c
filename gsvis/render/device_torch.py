"""Draw views of tensors on any device: in parts by depth, or as a linear function of colors.

Two parts of a scene, one all in front of the other, are blended by the transmittance of the front one. That is the
order in which Gaussians are blended anyway, so that the image stays the same to rounding.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from gsvis import _check
from gsvis.render.rasterizer import rasterize
from gsvis.render.reference import NEAR
from gsvis.render.tensors import GaussianTensors
from gsvis.scene.cameras import Cameras
from gsvis.scene.lengths import length_factor

__all__ = ["DeviceView", "draw_in_parts"]

F32 = NDArray[np.float32]


def draw_in_parts(
    tensors: GaussianTensors,
    camera: Cameras,
    parts: int,
    *,
    backend: str,
    background: F32,
    sh_degree: int | None,
    antialiased: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return images (1, H, W, 3), alphas, expected depths and median depths (1, H, W) of one camera, without gradients.

    Args:
        tensors: N Gaussians, also their device.
        camera: One camera.
        parts: Number of parts by depth that are drawn one after the other, each with its share of the memory.
        backend: Backend of `rasterize` that draws tensors of this device.
        background: (3,) RGB behind everything.
        sh_degree: Highest degree to evaluate; None means that of the tensors.
        antialiased: As for `rasterize`.
    """
    options: dict[str, Any] = {"backend": backend, "sh_degree": sh_degree, "antialiased": antialiased}
    with torch.no_grad():
        if parts == 1:
            drawn = rasterize(tensors, camera, background=background, **options)
            return drawn.images, drawn.alphas, drawn.depths, drawn.median_depths
        size = (1, camera.height, camera.width)
        image = torch.zeros((*size, 3)).to(tensors.means)
        light = torch.ones(size).to(tensors.means)
        reached = torch.zeros_like(light)
        for part in _split_by_depth(tensors, camera, parts):
            drawn = rasterize(part, camera, **options)
            image += light[..., None] * drawn.images
            reached += light * drawn.alphas * drawn.depths
            light *= 1.0 - drawn.alphas
        image += light[..., None] * torch.tensor(background).to(image)
        alphas = 1.0 - light
        depths = torch.where(alphas > 0.0, reached / alphas.clamp(min=1e-12), 0.0)
        return image, alphas, depths, torch.full_like(depths, torch.nan)


def _split_by_depth(tensors: GaussianTensors, camera: Cameras, parts: int) -> Iterator[GaussianTensors]:
    """Yield the Gaussians beyond the near plane in parts, front to back by the camera z of their centers.

    The near plane is that of the whole scene: a part, which is smaller, may have a nearer one.
    """
    row = torch.tensor(camera.viewmats[0, 2], dtype=tensors.means.dtype, device=tensors.means.device)
    depths = tensors.means @ row[:3] + row[3]
    some = tensors.means[:: max(1, len(tensors) // 4096)]  # a sample: to copy all would take long
    seen = torch.nonzero(depths > NEAR / length_factor(some.cpu().numpy()))[:, 0]
    order = seen[torch.argsort(depths[seen], stable=True)]
    for rows in order.chunk(parts) if len(order) else ():
        yield GaussianTensors(**{name: tensor[rows] for name, tensor in vars(tensors).items()})


class DeviceView:
    """One view of Gaussians whose geometry stays, drawn on their device; the twin of `gsvis.render.FixedView`.

    Args:
        tensors: N Gaussians.
        camera: One camera.
        backend: Backend of `rasterize` that draws tensors of this device.
        antialiased: As for `rasterize`.

    Attributes:
        ids: (M,) int64, the Gaussians with a weight above 0 at a pixel, ascending.
        eye: (3,) viewpoint, world frame.

    Raises:
        torch.OutOfMemoryError: If the memory of the device does not suffice, also in its methods.
    """

    def __init__(self, tensors: GaussianTensors, camera: Cameras, backend: str, *, antialiased: bool) -> None:
        self._tensors = tensors
        self._camera = camera
        self._options: dict[str, Any] = {"backend": backend, "antialiased": antialiased}
        self._colors = torch.zeros_like(tensors.means, requires_grad=True)
        self._drawn = rasterize(tensors, camera, colors=self._colors, **self._options).images
        self.eye = camera.viewpoints[0]
        weights = self._by_colors(torch.ones_like(self._drawn))[:, 0]  # summed over the pixels
        self._rows = torch.nonzero(weights > 0.0)[:, 0]
        self.ids = self._rows.cpu().numpy().astype(np.int64)

    def __len__(self) -> int:
        return len(self.ids)

    def image(self, colors: ArrayLike) -> F32:
        """Return the image (H, W, 3) before black.

        Args:
            colors: (M, 3) RGB of the Gaussians `ids`, of any sign.
        """
        given = torch.from_numpy(_check.floats("colors", colors, (len(self), 3)).copy())
        everyone = torch.zeros_like(self._tensors.means)
        everyone[self._rows] = given.to(everyone)
        with torch.no_grad():
            drawn = rasterize(self._tensors, self._camera, colors=everyone, **self._options).images[0]
        return np.asarray(drawn.cpu().numpy(), np.float32)

    def by_colors(self, by_image: ArrayLike) -> F32:
        """Return the gradient of a loss by the colors (M, 3), from its gradient by the image (H, W, 3)."""
        shape = tuple(self._drawn.shape[1:])
        given = torch.from_numpy(_check.floats("by_image", by_image, shape).copy())
        found = self._by_colors(given.to(self._drawn)[None])
        return np.asarray(found[self._rows].cpu().numpy(), np.float32)

    def _by_colors(self, by_image: Tensor) -> Tensor:
        """Return the gradient (N, 3) by all colors; the image is linear in them, so that one drawing serves all."""
        (found,) = torch.autograd.grad(self._drawn, [self._colors], by_image, retain_graph=True)
        return found
