"""Compute how images change without one Gaussian, for every Gaussian at once, in one pass over each image.

The color of a pixel is linear in the alpha of any one Gaussian. Without it the pixel changes by w (B - c): w is its
weight, c its color, and B the color of everything behind it at full transmittance, background included. Each effect is
that of removing one Gaussian while all others stay. Effects do not add up for Gaussians behind each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color.sh import write_sh_colors
from gsvis.progress import Progress, silent
from gsvis.render._kernels import removal as _kernels_removal
from gsvis.render.colors import Colors, camera_colors
from gsvis.render.splats import Projected, View, blend, check_no_skew, color_splats, project
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["RemovalEffects", "Removals", "removal_effects"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RemovalEffects:
    """The effect of removing each of N Gaussians alone, summed over the pixels of all views and averaged over RGB.

    Attributes:
        absolute: (N,) float64, absolute change of the values.
        squared: (N,) float64, squared change: the increase of the squared error against the scene's own images.
        error_change: (N,) float64, change of the squared error against the target images; negative if the images match
            better without the Gaussian. Equal to `squared` if no targets are given and all Gaussians are present.
        pixels: Number of pixels in the sums; a sum divided by it is a change of a mean error.
    """

    absolute: F64
    squared: F64
    error_change: F64
    pixels: int


def removal_effects(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    images: NDArray[Any] | None = None,
    colors: Colors = None,
    background: ArrayLike = (0.0, 0.0, 0.0),
    presence: ArrayLike | None = None,
    shown: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
) -> RemovalEffects:
    """Return the effect of removing each Gaussian, alone, on the images of some cameras.

    A rendered image stops blending where transmittance falls to 1e-4, so it lacks Gaussians that a removal would
    uncover. This function blends down to 1e-6 instead. Its effects are exact for images that never stop, except for at
    most 1e-6 / (1 - alpha) of a color. For images that do stop, they differ by what the stop hides. That matters for a
    nearly opaque Gaussian behind others; `rasterize` drops it if it would bring transmittance to 1e-4.

    Args:
        gaussians: N Gaussians.
        cameras: C cameras.
        images: (C, H, W, 3) targets, photographs or renders of a fuller scene; uint8 where 255 is white, or floats
            where 1 is white. None for the scene's own images.
        colors: Colors that replace SH, as in `rasterize` for arrays.
        background: (3,) RGB behind everything.
        presence: (N,) in [0, 1], factor on the alpha of each Gaussian while the effects of others are computed: 0 for
            an absent Gaussian, a value between for one that may or may not stay. The effect of a Gaussian always
            compares none of it with all of it. None for 1.
        shown: (N,) bool; the others are not there, as if they were not given. None for all.
        progress: Called with stage "removal", in views.

    Returns:
        Sums over all pixels and views; zeros for Gaussians that no view shows. Independent of the number of threads.

    Raises:
        ValueError: If an argument has the wrong shape or type, or is not finite.
    """
    check_no_skew(cameras)
    behind = _check.floats("background", background, (3,))
    shape = (len(cameras), cameras.height, cameras.width, 3)
    if images is not None:
        images = np.asarray(images)
        if images.dtype != np.uint8 and not np.issubdtype(images.dtype, np.floating):
            raise ValueError(f"images: expected uint8 or floats, got dtype {images.dtype}")
        if images.shape != shape:
            raise ValueError(f"images: expected shape {shape} to go with the cameras, got {images.shape}")
    there = np.ones(len(gaussians), np.float32)
    if presence is not None:
        there = _check.floats("presence", presence, (len(gaussians),))
        _check.in_range("presence", there, 0.0, 1.0)
    if shown is not None and (shown.dtype != bool or shown.shape != (len(gaussians),)):
        raise ValueError(f"shown: expected bool of shape ({len(gaussians)},), got {shown.dtype} of {shown.shape}")
    color_of = camera_colors(colors, gaussians.means, cameras)
    sums = np.zeros((len(gaussians), 3))
    progress("removal", 0, len(cameras))
    for c in range(len(cameras)):
        view = View.from_matrices(cameras.viewmats[c], cameras.Ks[c], cameras.width, cameras.height)
        projected = project(gaussians, view, antialiased=gaussians.facts.antialiased, pairs=True, shown=shown)
        features = color_splats(gaussians, projected, view, gaussians.sh_degree, color_of(c))
        features[:, 3] = there[projected.ids]
        residual = np.zeros(shape[1:], np.float32)
        if images is not None:
            residual = _blend(view, projected, features, behind) - _as_target(images[c])
        pairs = _remove_each(view, projected, features, behind, residual)
        _kernels_removal.add_pairs(pairs, projected.first_pair, projected.order, projected.ids, sums)
        progress("removal", c + 1, len(cameras))
    sums /= 3.0
    absolute, squared, error_change = (np.ascontiguousarray(column) for column in sums.T)
    return RemovalEffects(absolute, squared, error_change, len(cameras) * cameras.height * cameras.width)


class Removals:
    """`RemovalEffects.squared` of Gaussians among others, camera by camera.

    A camera costs as much as it shows, beside the projection of all. The harmonics of the two scenes are not copied.

    Args:
        gaussians: K Gaussians whose effects are wanted.
        others: Gaussians that are drawn with them, of the same facts; None for none.
    """

    def __init__(self, gaussians: Gaussians, others: Gaussians | None = None) -> None:
        self._parts = [gaussians] if others is None or len(others) == 0 else [gaussians, others]
        bare = [part.without_harmonics() for part in self._parts]
        self._all = bare[0] if len(bare) == 1 else Gaussians.concatenate(bare)

    def seen_by(
        self, camera: Cameras, presence: F32, shown: NDArray[np.bool_] | None
    ) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """Return those of the K Gaussians that one camera without skew shows, by index (S,), and their effects (S,).

        Takes checked arguments: `presence` (N,) in [0, 1] and `shown` (N,) of all Gaussians, as in `removal_effects`.
        """
        view = View.from_matrices(camera.viewmats[0], camera.Ks[0], camera.width, camera.height)
        antialiased = self._all.facts.antialiased
        projected = project(self._all, view, antialiased=antialiased, pairs=True, shown=shown)
        features = np.empty((len(projected.ids), 4), np.float32)
        self._write_colors(projected.ids, view, features)
        features[:, 3] = presence[projected.ids]
        residual = np.zeros((camera.height, camera.width, 3), np.float32)
        pairs = _remove_each(view, projected, features, np.zeros(3, np.float32), residual)
        effects = np.empty(len(projected.ids))
        _kernels_removal.sum_squares(pairs, projected.first_pair, projected.order, effects)
        own = int(np.searchsorted(projected.ids, len(self._parts[0])))
        return projected.ids[:own], effects[:own]

    def _write_colors(self, ids: NDArray[np.int32], view: View, features: F32) -> None:
        """Write the colors (M, 3) of splats, whose ids ascend, from each part."""
        first = 0
        for part in self._parts:
            some = slice(*np.searchsorted(ids, [first, first + len(part)]))
            arrays = part.means, part.sh0, part.shN
            write_sh_colors(ids[some] - np.int32(first), arrays, part.sh_degree, view.eye, features[some])
            first += len(part)


def _remove_each(view: View, projected: Projected, features: F32, background: F32, residual: F32) -> F32:
    """Return the (P, 4) sums of every pair of a tile and a splat; see `remove_tiles`."""
    pairs = np.empty((len(projected.members), 4), np.float32)
    _kernels_removal.remove_tiles(
        projected.splats,
        features,
        projected.offsets,
        projected.members,
        projected.pair_of,
        view.tiles[0],
        background,
        residual,
        pairs,
    )
    return pairs


def _blend(view: View, projected: Projected, features: F32, background: F32) -> F32:
    """Return the (H, W, 3) image that `rasterize` draws with opacities times presence."""
    splats = projected.splats
    if (features[:, 3] != 1.0).any():
        splats = splats.copy()
        splats[:, 5] += np.log2(np.maximum(features[:, 3], 1e-30))  # log2 of the opacity
    return blend(replace(projected, splats=splats), view, features, background)[0]


def _as_target(image: NDArray[Any]) -> F32:
    """Return one target as (H, W, 3) float32, where 1 is white."""
    values = image / np.float32(255.0) if image.dtype == np.uint8 else image
    return np.asarray(_check.floats("images", values, image.shape), np.float32)
