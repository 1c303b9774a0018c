"""Compute blending weights of every Gaussian in every view, and list the contributors to one pixel.

The weights are those of the rasterizer (EWA); `gsvis.raycast` computes weights along exact rays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.progress import Progress, silent
from gsvis.render._kernels import tiles as _kernels_tiles
from gsvis.render._kernels.lanes import TILE
from gsvis.render.reference import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from gsvis.render.splats import Projected, View, blend, color_splats, project
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = [
    "ColorsOf",
    "PixelContributors",
    "ViewWeights",
    "contributors",
    "draw_and_weigh",
    "share_out",
    "view_weights",
]

F32 = NDArray[np.float32]

ColorsOf = Callable[[NDArray[np.int64], NDArray[np.float64]], F32]
"""Function from Gaussians (M,) and an eye (3,) to the RGB (M, 3) that the eye sees."""


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
        pairs = _weigh_pairs(view, projected)
        _kernels_tiles.join_weights(projected.order, projected.ids, projected.first_pair, pairs, largest[c], summed[c])
        progress("views", c + 1, len(cameras))
    return ViewWeights(largest, summed)


def draw_and_weigh(g: Gaussians, camera: Cameras, colors_of: ColorsOf | None = None) -> tuple[F32, F32]:
    """Return the image of a camera before black, and the summed weights in it, from one projection.

    Both are those of `rasterize` and `view_weights`, to the byte.

    Args:
        g: N Gaussians.
        camera: One camera.
        colors_of: Colors of the Gaussians; None means their SH colors.

    Returns:
        (H, W, 3) RGB, and (N,) float32 sums of the weights over the pixels.
    """
    view, projected = _project(g, camera, None)
    if colors_of is None:
        features = color_splats(g, projected, view, g.sh_degree, None)
    else:
        features = np.empty((len(projected.ids), 4), np.float32)
        features[:, :3] = colors_of(projected.ids.astype(np.int64), view.eye)
        features[:, 3] = projected.depths
    image = blend(projected, view, features, np.zeros(3, np.float32))[0]
    largest = np.zeros(len(g), np.float32)
    summed = np.zeros(len(g), np.float32)
    pairs = _weigh_pairs(view, projected)
    _kernels_tiles.join_weights(projected.order, projected.ids, projected.first_pair, pairs, largest, summed)
    return image, summed


def share_out(g: Gaussians, camera: Cameras, images: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Share images out to the Gaussians that cover them, by blending weight.

    Args:
        g: N Gaussians.
        camera: One camera.
        images: (H, W, K) values of its pixels, such as squared errors. A Gaussian gets its weight in a tile of pixels
            times the mean value of the tile.

    Returns:
        (N, K) the values of each Gaussian, and (N,) its summed weights.
    """
    view, projected = _project(g, camera, None)
    values = _check.floats("images", images, (view.height, view.width, "K"))
    pairs = _weigh_pairs(view, projected)[:, 1].astype(np.float64)
    shares = np.zeros((len(g), values.shape[2]))
    weights = np.zeros(len(g))
    if len(pairs):
        of_pairs = np.empty((len(pairs), values.shape[2]))
        of_pairs[projected.pair_of] = np.repeat(_tile_means(values), np.diff(projected.offsets), axis=0)
        ids, starts = _met(projected)
        shares[ids] = np.add.reduceat(pairs[:, None] * of_pairs, starts)
        weights[ids] = np.add.reduceat(pairs, starts)
    return shares, weights


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
    tile = (y // TILE) * view.tiles[0] + x // TILE
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


def _tile_means(images: F32) -> NDArray[np.float64]:
    """Return (tiles, K) the mean of each tile of (H, W, K) images, row after row."""
    means = images.astype(np.float64)
    for axis in (0, 1):
        starts = np.arange(0, means.shape[axis], TILE)
        sizes = np.diff(np.append(starts, means.shape[axis]))
        means = np.add.reduceat(means, starts, axis=axis) / np.expand_dims(sizes, (1 - axis, 2))
    return means.reshape(-1, images.shape[2])


def _weigh_pairs(view: View, projected: Projected) -> F32:
    """Return (P, 2) the largest and the summed weight of each pair of a splat and a tile."""
    pairs = np.empty((len(projected.members), 2), np.float32)
    lists = projected.offsets, projected.members, projected.pair_of, view.tiles[0]
    _kernels_tiles.weigh_tiles(projected.splats, *lists, view.width, view.height, pairs)
    return pairs


def _met(projected: Projected) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the ids of the Gaussians with a pair, and the first pair of each: reduceat needs non-empty ranges."""
    met = np.flatnonzero(np.diff(projected.first_pair))
    return projected.ids[projected.order[met]].astype(np.int64), projected.first_pair[met]


def _project(g: Gaussians, camera: Cameras, antialiased: bool | None) -> tuple[View, Projected]:
    """Return the view of a camera and its projected Gaussians."""
    view = View.from_matrices(camera.viewmats[0], camera.Ks[0], camera.width, camera.height)
    arrays = SimpleNamespace(**{name: getattr(g, name) for name in ("means", "quats", "scales", "opacities", "sh0")})
    lowered = g.facts.antialiased if antialiased is None else antialiased
    return view, project(arrays, view, antialiased=lowered, pairs=True)
