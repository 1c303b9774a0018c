"""Layers of Gaussians that add up: segments by utility, as L3GS, or one whole layer after the other, as LapisGS."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.predict import Pose, predictor
from gsvis.package.contents import Contents
from gsvis.scene.gaussians import rotations_from_quats
from paper.rivals.flow import Files, Window
from paper.rivals.pieces import Sender, distances_to
from paper.rivals.segments import Segments, layers_by_importance, level_layers

__all__ = ["LayerByLayer", "Layers"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# radians, and share of the half size of the scene, before utilities are computed again
_TURN = 0.087
_MOVE = 0.01
_NEAR = 0.05  # share of the half size: nearer Gaussians count as this far


class Layers(Sender):
    """Segments and layers by utility, in the manner of L3GS.

    L3GS splits a scene into segments, trains layers that add splats to each, and downloads what has the largest utility
    for the predicted view: the sum over the splats of a layer of the pixels that it covers, its opacity and the inverse
    of its distance, subject to the predicted bandwidth.

    Simplified: segments are boxes of space, not objects. The knapsack of each time slot becomes its greedy solution,
    the largest utility for each byte, so bandwidth need not be predicted. With `source` "levels" our trained levels are
    the layers, and replace Gaussians, as its trained ones need not; with "importance" the highest level is sorted by
    opacity times area, without training. What is out of view comes last, by distance.

    Args:
        contents: The package.
        view: Field of view of the client.
        gaussian_bytes: Measured bytes of a Gaussian with full SH.
        source: "levels" or "importance".
        segments: Segments; None makes some of about 8,192 Gaussians.
        config: Window and estimator, and `lead`, the seconds to predict ahead; None means `AbrConfig()`.
        measured: How the bytes were measured.

    References:
        Tsai et al., "L3GS: Layered 3D Gaussian Splats for Efficient 3D Scene Delivery", 2025, and its `Utility.py`.
    """

    def __init__(
        self,
        contents: Contents,
        view: FieldOfView,
        gaussian_bytes: float,
        source: str = "levels",
        *,
        segments: Segments | None = None,
        config: AbrConfig | None = None,
        measured: str = "",
    ) -> None:
        if source not in ("levels", "importance"):
            raise ValueError(f'source: expected "levels" or "importance", got {source!r}')
        found = segments or Segments.of_contents(contents)
        cut = level_layers if source == "levels" else layers_by_importance
        config = config or AbrConfig()
        super().__init__(contents, cut(contents, found, gaussian_bytes), Window(config), measured=measured)
        self.name = f"layers, L3GS, {source}"
        self._view = view
        self._lead = config.lead
        self._source = source
        self._predictor = predictor("linear")
        ids = self.pieces.gaussians
        self._ids = np.concatenate(list(ids))
        self._owner = np.repeat(np.arange(len(ids)), [len(some) for some in ids])
        self._means = found.means[self._ids].astype(np.float32)
        self._worth = (found.opacities * found.areas)[self._ids].astype(np.float32)
        self._radii = 3.0 * found.scales[self._ids].max(axis=1)
        low = found.boxes[:, 0].min(axis=0)
        high = found.boxes[:, 1].max(axis=0)
        self._half = max(float(np.linalg.norm(high - low)) / 2.0, 1e-9)
        self._seen: tuple[Pose, F64] | None = None

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Take a pose, also for the predictor; see `Delivery`."""
        super().on_pose(t, position, quat)
        self._predictor.observe(t, position, quat)

    def urgency(self, t: float, pose: Pose) -> F64:
        """Return the utility of each layer of a segment for each byte; see `Sender`."""
        ahead = self._predictor.predict(t + self._lead)
        if self._seen is not None:
            then, found = self._seen
            if then.turn_to(ahead) < _TURN and then.distance_to(ahead) < _MOVE * self._half:
                return found
        found = self._utilities(ahead)
        self._seen = ahead, found
        return found

    def describe(self) -> dict[str, Any]:
        """Return facts for reports; see `Delivery`."""
        return {**super().describe(), "source": self._source, "lead": self._lead}

    def _utilities(self, pose: Pose) -> F64:
        p = self.pieces
        eye = np.asarray(pose.position, np.float64)
        axes = rotations_from_quats(pose.quat[None])[0].astype(np.float32)
        local = (self._means - eye.astype(np.float32)) @ axes
        v = self._view
        depth = local[:, 2]
        spread = np.float32(1.4) * self._radii
        inside = (
            (depth > v.near)
            & (local[:, 0] <= v.right * depth + spread)
            & (-local[:, 0] <= v.left * depth + spread)
            & (local[:, 1] <= v.bottom * depth + spread)
            & (-local[:, 1] <= v.top * depth + spread)
        )
        distances = np.maximum(np.linalg.norm(local, axis=1), _NEAR * self._half)
        utility = np.where(inside, self._worth / distances**3, 0.0)  # area over distance squared, and closeness
        sums = np.bincount(self._owner, weights=utility, minlength=len(p))
        rate = sums / np.maximum(p.nbytes, 1)
        least = rate[rate > 0].min(initial=1.0)
        out_of_view = least * 1e-3 / (1.0 + distances_to(eye, p.boxes) / self._half)
        return np.asarray(np.where(rate > 0, rate, out_of_view))


class LayerByLayer(Sender):
    """One whole layer after the other, in the manner of LapisGS: each level adds to the one below.

    LapisGS trains layers at rising resolution, which add up; a client loads the layers of an object one by one. There
    is one object here, the scene, so the view does not matter. A layer is shown when all of it has arrived.

    Simplified: our trained levels are the layers. They replace some Gaussians where LapisGS changes their opacity.

    Args:
        contents: The package.
        gaussian_bytes: Measured bytes of a Gaussian with full SH.
        measured: How the bytes were measured.

    References:
        Shi et al., "LapisGS: Layered Progressive 3D Gaussian Splatting for Adaptive Streaming", 2025.
    """

    name = "layers, LapisGS"

    def __init__(self, contents: Contents, gaussian_bytes: float, *, measured: str = "") -> None:
        one = Segments.of_contents(contents, np.zeros(len(contents), np.int64))
        super().__init__(contents, level_layers(contents, one, gaussian_bytes), Files(2), measured=measured)

    def urgency(self, t: float, pose: Pose) -> F64:
        """Return the urgency of each layer: the lowest first; see `Sender`."""
        return -np.arange(len(self.pieces), dtype=np.float64)
