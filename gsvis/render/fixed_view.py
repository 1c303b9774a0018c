"""One view of Gaussians whose geometry stays: its image is linear in their colors.

Projection, order and weights are found once, for any number of images and gradients. Conventions: docs/conventions.md.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.render._kernels import fixed as _kernels
from gsvis.render.splats import View, blend, project
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["FixedView"]

F32 = NDArray[np.float32]


class FixedView:
    """The Gaussians that one view blends, and the weight of each at each pixel.

    Args:
        g: N Gaussians.
        camera: One camera.
        antialiased: Lower opacities so that the blur of 0.3 square pixels keeps their integral. None follows the facts
            of the scene.

    Attributes:
        ids: (M,) int64, the Gaussians with a weight above 0 at a pixel, ascending.
        eye: (3,) viewpoint, world frame.

    Raises:
        ValueError: If there is not exactly one camera.
    """

    def __init__(self, g: Gaussians, camera: Cameras, *, antialiased: bool | None = None) -> None:
        if len(camera) != 1:
            raise ValueError(f"camera: expected one camera, got {len(camera)}; index it, as in cameras[0]")
        self._view = View.from_matrices(camera.viewmats[0], camera.Ks[0], camera.width, camera.height)
        names = ("means", "quats", "scales", "opacities", "sh0")
        arrays = SimpleNamespace(**{name: getattr(g, name) for name in names})
        lowered = g.facts.antialiased if antialiased is None else antialiased
        self._splats = project(arrays, self._view, antialiased=lowered, pairs=True)
        self._features = np.zeros((len(self._splats.ids), 4), np.float32)
        marks = np.zeros(len(self._features), np.uint8)
        _kernels.mark_blended(
            self._splats.splats, *self._lists, self._view.tiles[0], camera.width, camera.height, marks
        )
        self._places = np.flatnonzero(marks)
        self.ids = self._splats.ids[self._places].astype(np.int64)
        self.eye = self._view.eye

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def _lists(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """The offsets and the members of the tiles' lists."""
        return self._splats.offsets, self._splats.members

    def image(self, colors: ArrayLike) -> F32:
        """Return the image (H, W, 3) before black.

        Args:
            colors: (M, 3) RGB of the Gaussians `ids`, of any sign.
        """
        self._features[self._places, :3] = _check.floats("colors", colors, (len(self), 3))
        black = np.zeros(3, np.float32)
        return blend(self._splats, self._view, self._features, black)[0]

    def by_colors(self, by_image: ArrayLike) -> F32:
        """Return the gradient of a loss by the colors (M, 3), from its gradient by the image (H, W, 3)."""
        shape = (self._view.height, self._view.width, 3)
        pairs = np.empty((len(self._splats.members), 4), np.float32)
        splats = self._splats
        _kernels.gather_tiles(
            splats.splats,
            *self._lists,
            splats.pair_of,
            self._view.tiles[0],
            _check.floats("by_image", by_image, shape),
            pairs,
        )
        sums = np.empty((len(splats.ids), 3), np.float32)
        _kernels.sum_shares(splats.order, splats.first_pair, pairs, sums)
        return np.asarray(sums[self._places])
