"""Define posed images, the targets of training: photos or renders of a finished scene, with their cameras.

Images are sRGB as displayed, in one frame with the scene; OpenCV cameras of one size. This module knows no file.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.jobs.in_order import in_order
from gsvis.progress import Progress, silent
from gsvis.render.device import torch_device_of
from gsvis.render.device_scene import DeviceScene
from gsvis.render.rasterizer import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from gsvis.render.tensors import GaussianTensors

__all__ = ["PosedImages", "display_image", "display_images", "render_views"]


@dataclass(frozen=True, eq=False, repr=False)
class PosedImages:
    """C images and their cameras.

    Args:
        cameras: C cameras of one size.
        images: (C, H, W, 3); uint8 with white at 255, or float32 with white at 1 and brighter values kept.

    Raises:
        ValueError: If the number, size or type of the images does not fit, or a value is not finite.

    Examples:
        >>> views = PosedImages(Cameras.cubemap([[0, 0, 0]], 16), np.zeros((6, 16, 16, 3), np.uint8))
        >>> views.split(every=3)
        (PosedImages(4 of 16 x 16), PosedImages(2 of 16 x 16))
    """

    cameras: Cameras
    images: NDArray[Any]

    def __post_init__(self) -> None:
        shape = (len(self.cameras), self.cameras.height, self.cameras.width, 3)
        if not isinstance(self.images, np.ndarray) or self.images.dtype not in (np.uint8, np.float32):
            got = self.images.dtype if isinstance(self.images, np.ndarray) else type(self.images).__name__
            raise ValueError(f"images: expected an array of uint8 or float32, got {got}")
        if self.images.shape != shape:
            raise ValueError(f"images: expected shape {shape} to go with the cameras, got {self.images.shape}")
        if self.images.dtype == np.float32:
            _check.floats("images", self.images, shape)

    def __len__(self) -> int:
        return len(self.cameras)

    def __repr__(self) -> str:
        return f"PosedImages({len(self)} of {self.cameras.width} x {self.cameras.height})"

    def __getitem__(self, index: Any) -> PosedImages:
        """Select views by a slice, a mask, an index array, or one integer (one view)."""
        where = np.arange(len(self))[index].reshape(-1)
        return PosedImages(self.cameras[where], self.images[where])

    def image(self, index: int) -> NDArray[np.float32]:
        """Return one view as (H, W, 3); 1 is white."""
        image = self.images[index]
        return np.asarray(image / np.float32(255.0) if image.dtype == np.uint8 else image, np.float32)

    def split(self, every: int = 8) -> tuple[PosedImages, PosedImages]:
        """Split into training views and held-out views; the first and every `every`th after it are held out.

        Raises:
            ValueError: If `every` is below 2, or one side would be empty.
        """
        _check.positive_int("every", every, at_least=2)
        held_out = np.arange(len(self)) % every == 0
        if held_out.all() or not held_out.any():
            raise ValueError(f"images: expected at least 2 to hold some out, got {len(self)}")
        return self[~held_out], self[held_out]


def render_views(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    backend: str = "auto",
    progress: Progress = silent,
) -> PosedImages:
    """Render images of a finished scene as training targets, with brighter values kept.

    Args:
        gaussians: The scene.
        cameras: C cameras.
        background: (3,) RGB behind everything.
        backend: Backend that renders, see `DeviceScene`.
        progress: Called with stage "views"; counts cameras.
    """
    scene = DeviceScene(gaussians, backend)
    images = np.empty((len(cameras), cameras.height, cameras.width, 3), np.float32)

    def draw(c: int) -> None:
        """Draw the image of one camera."""
        images[c] = scene.draw(cameras[c], background=background).images[0]

    side_by_side = map if scene.on_device else in_order
    progress("views", 0, len(cameras))
    for c, _ in enumerate(side_by_side(draw, range(len(cameras)))):
        progress("views", c + 1, len(cameras))
    return PosedImages(cameras, images)


def display_images(
    gaussians: Gaussians, cameras: Sequence[Cameras], backend: str = "auto"
) -> Iterator[NDArray[np.float32]]:
    """Yield `display_image` of each of some single cameras, in order; on the CPU they are drawn side by side."""
    draw = partial(display_image, gaussians, backend=backend)
    return in_order(draw, cameras) if torch_device_of(backend) is None else map(draw, cameras)


def display_image(
    gaussians: Gaussians | GaussianTensors, camera: Cameras, backend: str = "auto", antialiased: bool | None = None
) -> NDArray[np.float32]:
    """Return the (H, W, 3) image of one camera as a display shows it: clipped to [0, 1]."""
    image = _check.plain(rasterize(gaussians, camera, backend=backend, antialiased=antialiased).images[0])
    return np.asarray(np.clip(image, 0.0, 1.0), np.float32)
