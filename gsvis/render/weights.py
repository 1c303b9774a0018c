"""Compute blending weights of every Gaussian in every view, and list the contributors to one pixel.

The weights are those of the rasterizer (EWA); `gsvis.raycast` computes weights along exact rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from gsvis.progress import Progress, silent
from gsvis.render._kernels import tiles as _kernels_tiles
from gsvis.render.reference import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from gsvis.render.splats import Projected, View, project
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["PixelContributors", "ViewWeights", "contributors", "view_weights"]

F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ViewWeights:
    """Weights of N Gaussians in C views.

    Attributes:
        largest: (C, N) float32, largest weight over the pixels of the view; at least tau for a visible Gaussian.
        summed: (C, N) float32, sum of the weights over the pixels of the view.
    """

    largest: F32
    summed: F32


@dataclass(frozen=True, eq=False)
class PixelContributors:
    """The Gaussians blended into one pixel, front to back.

    Attributes:
        gaussian_ids: (K,) int64.
        alphas: (K,) float32 in [1/255, 0.999].
        weights: (K,) float32, alpha times the transmittance in front.
        depths: (K,) float32, camera z of the centers.
    """

    gaussian_ids: NDArray[np.int64]
    alphas: F32
    weights: F32
    depths: F32

    def __len__(self) -> int:
        return len(self.gaussian_ids)


def view_weights(
    g: Gaussians, cameras: Cameras, *, antialiased: bool | None = None, progress: Progress = silent
) -> ViewWeights:
    """Return the largest and the summed blending weight of each Gaussian in each view.

    Args:
        g: N Gaussians.
        cameras: C cameras.
        antialiased: Lower opacities so that the blur of 0.3 square pixels keeps their integral. None follows the facts
            of the scene.
        progress: Called with stage "views".
    """
    largest = np.zeros((len(cameras), len(g)), np.float32)
    summed = np.zeros((len(cameras), len(g)), np.float32)
    progress("views", 0, len(cameras))
    for c in range(len(cameras)):
        view, projected = _project(g, cameras[c], antialiased)
        pairs = np.empty((len(projected.members), 2), np.float32)
        colorless = np.zeros((len(projected.ids), 4), np.float32)
        lists = projected.offsets, projected.members, projected.pair_of, view.tiles[0]
        _kernels_tiles.weigh_tiles(projected.splats, colorless, *lists, view.width, view.height, pairs)
        if len(pairs):
            met = np.flatnonzero(np.diff(projected.first_pair))  # reduceat needs non-empty ranges
            starts = projected.first_pair[met]
            ids = projected.ids[projected.order[met]]
            largest[c, ids] = np.maximum.reduceat(pairs[:, 0], starts)
            summed[c, ids] = np.add.reduceat(pairs[:, 1], starts)
        progress("views", c + 1, len(cameras))
    return ViewWeights(largest, summed)


def contributors(
    g: Gaussians, camera: Cameras, pixel: tuple[int, int], *, antialiased: bool | None = None
) -> PixelContributors:
    """Return the Gaussians blended into one pixel, front to back.

    Args:
        g: N Gaussians.
        camera: One camera.
        pixel: Column and row, from 0 at the top left.
        antialiased: Lower opacities so that the blur of 0.3 square pixels keeps their integral. None follows the facts
            of the scene.

    Raises:
        ValueError: If there is not exactly one camera, or the pixel lies outside its image.
    """
    if len(camera) != 1:
        raise ValueError(f"camera: expected one camera, got {len(camera)}; index it, as in cameras[0]")
    x, y = pixel
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise ValueError(f"pixel: expected column and row inside {camera.width} x {camera.height}, got {pixel}")
    view, projected = _project(g, camera, antialiased)
    side = _kernels_tiles.TILE
    tile = (y // side) * view.tiles[0] + x // side
    members = projected.members[projected.offsets[tile] : projected.offsets[tile + 1]]
    splats = projected.splats[members]
    dx = x + 0.5 - splats[:, 0]
    dy = y + 0.5 - splats[:, 1]
    log2_alpha = splats[:, 5] + splats[:, 2] * dx * dx + splats[:, 3] * dx * dy + splats[:, 4] * dy * dy
    alphas = np.exp2(log2_alpha)
    seen = alphas >= MIN_ALPHA
    members = members[seen]
    alphas = np.minimum(alphas[seen], MAX_ALPHA)
    transmittance = np.cumprod(np.concatenate([[1.0], 1.0 - alphas]))
    lit = np.cumprod(transmittance[1:] > MIN_TRANSMITTANCE).astype(bool)
    return PixelContributors(
        projected.ids[members[lit]].astype(np.int64),
        alphas[lit].astype(np.float32),
        (alphas * transmittance[:-1])[lit].astype(np.float32),
        projected.depths[members[lit]],
    )


def _project(g: Gaussians, camera: Cameras, antialiased: bool | None) -> tuple[View, Projected]:
    """Return the view of a camera and its projected Gaussians."""
    view = View.from_matrices(camera.viewmats[0], camera.Ks[0], camera.width, camera.height)
    arrays = SimpleNamespace(**{name: getattr(g, name) for name in ("means", "quats", "scales", "opacities", "sh0")})
    lowered = g.facts.antialiased if antialiased is None else antialiased
    return view, project(arrays, view, antialiased=lowered, pairs=True)
