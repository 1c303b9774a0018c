"""Measure overdraw: how many splats cover each pixel of a view, and how many splats a view has.

The fill of a pixel is the number of splats with an alpha of at least 1/255 at its center. Players on a GPU blend all of
them, whatever stands in front, so the mean fill times the pixels is the work of a frame. The fill until opaque counts
only the splats before the transmittance is 1e-4 or less, the one that brings it there included.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.progress import Progress, silent
from gsvis.render._kernels.fill import count_fill, sample_fill
from gsvis.render.reference import MIN_TRANSMITTANCE, pixel_centers, project_reference
from gsvis.render.splats import View, project, project_splats
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = [
    "SIDE",
    "STEP",
    "Fill",
    "SampledFill",
    "ViewFill",
    "fill_around",
    "fill_reference",
    "measure_fill",
    "sample_fill_around",
    "sampled_view_fill",
    "view_fill",
]

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

SIDE = 512
"""Pixels of a side of the six square views around an eye: about those of a screen. In fewer, splats blur over more."""

STEP = 4
"""Pixels from one sampled pixel to the next."""

_PARTS = 4  # of the splats of a view, for threads


@dataclass(frozen=True, eq=False)
class ViewFill:
    """The fill of one view, and the share of each splat in it.

    Attributes:
        fill: (H, W) splats over each pixel.
        until: (H, W) splats over each pixel until it is opaque.
        ids: (M,) Gaussians that cover a pixel.
        covered: (M,) pixels that each of them covers.
        light: (M,) sum of the blending weights of each of them.
    """

    fill: I32
    until: I32
    ids: I64
    covered: F64
    light: F64


@dataclass(frozen=True, eq=False)
class Fill:
    """The fill of C views, or the largest around each of C eyes.

    Attributes:
        splats: (C,) Gaussians that cover at least one pixel.
        mean: (C,) mean fill of a pixel.
        worst: (C,) largest fill of a pixel.
        until: (C,) mean fill of a pixel until it is opaque.
    """

    splats: F64
    mean: F64
    worst: F64
    until: F64

    def around(self) -> Fill:
        """Return the largest of each six views: of those of a cube around an eye."""
        return Fill(*(values.reshape(-1, 6).max(axis=1) for values in self._columns()))

    def largest(self) -> dict[str, float]:
        """Return the largest value of each figure by name; 0 without views."""
        return {
            name.name: float(values.max(initial=0.0))
            for name, values in zip(fields(self), self._columns(), strict=True)
        }

    def _columns(self) -> tuple[F64, F64, F64, F64]:
        """Return the arrays in order."""
        return self.splats, self.mean, self.worst, self.until


class SampledFill(NamedTuple):
    """The largest fill of the six views around each of E eyes, from every fourth pixel along both axes.

    Attributes:
        splats: (E,) Gaussians whose box in the image reaches a pixel.
        mean: (E,) mean fill of a pixel.
        worst: (E,) largest fill of a sampled pixel, so not more than that of all pixels.
    """

    splats: F64
    mean: F64
    worst: F64


def view_fill(g: Gaussians, camera: Cameras) -> ViewFill:
    """Return the fill of the view of one camera."""
    view = _view_of(camera)
    projected = project(_arrays_of(g), view, antialiased=g.facts.antialiased, pairs=True)
    fill = np.zeros((view.height, view.width), np.int32)
    until = np.zeros_like(fill)
    pairs = np.zeros((len(projected.members), 2), np.float32)
    lists = projected.offsets, projected.members, projected.pair_of, view.tiles[0]
    count_fill(projected.splats, *lists, fill, until, pairs)
    met = np.flatnonzero(np.diff(projected.first_pair))
    sums = np.zeros((0, 2))
    if len(met):
        sums = np.add.reduceat(pairs.astype(np.float64), projected.first_pair[met], axis=0)
    some = sums[:, 0] > 0.0
    ids = projected.ids[projected.order[met]].astype(np.int64)
    return ViewFill(fill, until, ids[some], sums[some, 0], sums[some, 1])


def measure_fill(g: Gaussians, cameras: Cameras, *, progress: Progress = silent) -> Fill:
    """Return the fill of the views of C cameras.

    Args:
        g: N Gaussians.
        cameras: C cameras.
        progress: Called with stage "fill", in views.
    """
    rows = np.zeros((len(cameras), 4))
    progress("fill", 0, len(cameras))
    for c in range(len(cameras)):
        found = view_fill(g, cameras[c])
        rows[c] = len(found.ids), found.fill.mean(), found.fill.max(), found.until.mean()
        progress("fill", c + 1, len(cameras))
    return Fill(*rows.T)


def fill_around(g: Gaussians, eyes: ArrayLike, *, progress: Progress = silent) -> Fill:
    """Return the largest fill of the six square views of 90 degrees around each of E eyes.

    Args:
        g: N Gaussians.
        eyes: (E, 3) eyes, world frame.
        progress: Called with stage "fill", in views.
    """
    around = _check.floats("eyes", eyes, ("E", 3), np.float64)
    return measure_fill(g, Cameras.cubemap(around, SIDE), progress=progress).around()


def sampled_view_fill(g: Gaussians, camera: Cameras, step: int = STEP) -> tuple[int, I32]:
    """Return the number of splats of the view of one camera, and the fill of every `step`-th pixel along both axes.

    The pixels are those of `view_fill(g, camera).fill[step // 2 :: step, step // 2 :: step]`. There are no lists and no
    sorting, so this takes a fraction of the time.
    """
    view = _view_of(camera)
    _, splats, _ = project_splats(_arrays_of(g), view, antialiased=g.facts.antialiased)
    rows, columns = (len(range(step // 2, size, step)) for size in (view.height, view.width))
    fills = np.zeros((_PARTS, rows, columns), np.int32)
    sample_fill(splats, step, fills)
    return len(splats), fills.sum(axis=0, dtype=np.int32)


def sample_fill_around(g: Gaussians, eyes: ArrayLike) -> SampledFill:
    """Return what `fill_around` does but the fill until opaque, from sampled pixels.

    Args:
        g: N Gaussians.
        eyes: (E, 3) eyes, world frame.
    """
    around = _check.floats("eyes", eyes, ("E", 3), np.float64)
    cameras = Cameras.cubemap(around, SIDE)
    rows = np.zeros((len(cameras), 3))
    for c in range(len(cameras)):
        splats, fill = sampled_view_fill(g, cameras[c])
        rows[c] = splats, fill.mean(), fill.max()
    return SampledFill(*rows.reshape(-1, 6, 3).max(axis=1).T)


def fill_reference(g: Gaussians, camera: Cameras) -> ViewFill:
    """Return the fill of a view as `view_fill` does, from the alpha of every Gaussian at every pixel; slow."""
    view = _view_of(camera)
    splats = project_reference(g, view, antialiased=g.facts.antialiased)
    alphas = splats.alphas(pixel_centers(view))
    before = np.cumprod(np.concatenate([np.ones((len(alphas), 1)), 1.0 - alphas], axis=1), axis=1)[:, :-1]
    lit = (alphas > 0.0) & (before > MIN_TRANSMITTANCE)
    covered = (alphas > 0.0).sum(axis=0).astype(np.float64)
    some = covered > 0.0
    shape = (view.height, view.width)
    fill = (alphas > 0.0).sum(axis=1).astype(np.int32).reshape(shape)
    light = np.where(lit, alphas * before, 0.0).sum(axis=0)
    until = lit.sum(axis=1).astype(np.int32).reshape(shape)
    return ViewFill(fill, until, splats.ids[some], covered[some], light[some])


def _arrays_of(g: Gaussians) -> Any:
    """Return the arrays of Gaussians that kernels take."""
    return SimpleNamespace(**{key: getattr(g, key) for key in ("means", "quats", "scales", "opacities", "sh0")})


def _view_of(camera: Cameras) -> View:
    """Return the view of one camera for kernels."""
    return View.from_matrices(camera.viewmats[0], camera.Ks[0], camera.width, camera.height)
