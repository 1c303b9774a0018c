"""Chunks of one level with full SH, those in view first: what remains without sets, levels and terms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.predict import Pose
from gsvis.package.contents import Contents
from gsvis.scene.morton import morton_order
from paper.rivals.flow import Window
from paper.rivals.pieces import Pieces, Sender, boxes_in_view, boxes_of, distances_to

__all__ = ["FrustumChunks"]

F64 = NDArray[np.float64]

_FAR = 1e9


class FrustumChunks(Sender):
    """Chunks of the highest level with full SH: in view before out of view, the nearest first.

    This is the plain system that reviewers ask about: a server that culls by the frustum. It knows no occlusion, no
    levels and no terms. It is given the current pose and our own window, so a pose costs it half a round trip, as ours.

    Args:
        contents: The package.
        view: Field of view of the client, with its margin.
        gaussian_bytes: Measured bytes of a Gaussian with full SH.
        count: Gaussians of a chunk, neighbors along a Morton curve.
        config: Window and estimator; None means `AbrConfig()`.
        measured: How the bytes were measured.
    """

    name = "frustum chunks"

    def __init__(
        self,
        contents: Contents,
        view: FieldOfView,
        gaussian_bytes: float,
        *,
        count: int = 256,
        config: AbrConfig | None = None,
        measured: str = "",
    ) -> None:
        g = contents.gaussians()
        highest = np.flatnonzero(contents.last == len(contents.names) - 1)
        ordered = highest[morton_order(g.means[highest])]
        groups = np.split(ordered, np.arange(count, len(ordered), count))
        none = [np.zeros(0, np.int64)] * len(groups)
        nbytes = np.array([int(np.ceil(len(ids) * gaussian_bytes)) for ids in groups], np.int64)
        boxes = boxes_of(g.means, g.scales, groups)
        pieces = Pieces(groups, none, nbytes, boxes, np.full(len(groups), -1))
        super().__init__(contents, pieces, Window(config), measured=measured)
        self._view = view

    def urgency(self, t: float, pose: Pose) -> F64:
        """Return the urgency of each chunk; see `Sender`."""
        boxes = self.pieces.boxes
        inside = boxes_in_view(self._view.planes(pose.position, pose.quat), boxes)
        return np.asarray(np.where(inside, _FAR, 0.0) - distances_to(np.asarray(pose.position, np.float64), boxes))
