"""A scene that is drawn view by view on a device, and with less memory where that of the device runs out.

It is sent to the device once. torch is imported only for a device. Conventions: docs/conventions.md, as `rasterize`.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from gsvis.render.device import OnDevice, torch_device_of
from gsvis.render.rasterizer import Rendering, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from gsvis.render.tensors import GaussianTensors

__all__ = ["MOST_PARTS", "DeviceScene"]

MOST_PARTS = 16
"""Parts of a scene, by depth, that a view is drawn in before the CPU draws it."""

_LOG = logging.getLogger(__name__)


class DeviceScene:
    """A scene on the device of a backend.

    A view that does not fit the memory of the device is drawn in two parts by depth, one over the other, then in four,
    up to `MOST_PARTS`; after that the CPU draws it. One line is logged when parts begin, and one when the CPU begins.

    Args:
        gaussians: The scene, N Gaussians.
        backend: "cuda"; or "reference", the same way on the CPU with plain torch; others draw the arrays on the CPU.

    Attributes:
        backend: The backend that draws the next view.
        parts: Number of parts that it is drawn in.
    """

    def __init__(self, gaussians: Gaussians, backend: str = "auto") -> None:
        self.backend = backend
        self.parts = 1
        self._gaussians = gaussians
        self._tensors: GaussianTensors | None = None

    @property
    def on_device(self) -> bool:
        """Whether the next view is drawn on a device."""
        return torch_device_of(self.backend) is not None

    @property
    def tensors(self) -> GaussianTensors:
        """The scene on the device, sent there on first use.

        Raises:
            torch.OutOfMemoryError: If it does not fit.
        """
        if self._tensors is None:
            from gsvis.render.tensors import GaussianTensors

            device = torch_device_of(self.backend)
            assert device is not None
            self._tensors = GaussianTensors.from_gaussians(self._gaussians, device=device)
        return self._tensors

    def draw(
        self,
        camera: Cameras,
        *,
        background: ArrayLike = (0.0, 0.0, 0.0),
        sh_degree: int | None = None,
        antialiased: bool | None = None,
    ) -> Rendering:
        """Return the images of one camera, as arrays; arguments are those of `rasterize`.

        Median depths are NaN if the view was drawn by a GPU or in parts.
        """
        lowered = self._gaussians.facts.antialiased if antialiased is None else antialiased
        while self.on_device:
            drawn = OnDevice.attempt(lambda: self._draw_there(camera, background, sh_degree, lowered))
            if drawn is not None:
                return drawn
            self._take_less()
        return rasterize(
            self._gaussians,
            camera,
            backend=self.backend,
            background=background,
            sh_degree=sh_degree,
            antialiased=lowered,
        )

    def _draw_there(self, camera: Cameras, background: ArrayLike, sh_degree: int | None, lowered: bool) -> Rendering:
        """Return the images of one camera, drawn on the device."""
        from gsvis.render.device_torch import draw_in_parts

        behind = np.asarray(background, np.float32)
        drawn = draw_in_parts(
            self.tensors,
            camera,
            self.parts,
            backend=self.backend,
            background=behind,
            sh_degree=sh_degree,
            antialiased=lowered,
        )
        return Rendering(*(part.cpu().numpy() for part in drawn))

    def _take_less(self) -> None:
        """Draw in twice as many parts from here; after `MOST_PARTS` draw on the CPU."""
        if self.parts >= MOST_PARTS:
            _LOG.warning("the memory of the GPU ran out; views are drawn on the CPU from here")
            self.backend = "cpu"
            self._tensors = None
            return
        if self.parts == 1:
            _LOG.warning("the memory of the GPU ran out; views are drawn there in parts from here")
        self.parts *= 2
