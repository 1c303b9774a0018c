"""The CPU rasterizer: numba kernels behind one differentiable torch function, one camera at a time.

Conventions are DESIGN decision 10 (docs/conventions.md). Nothing depends on the order of the Gaussians in the scene or
on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import get_num_threads
from numpy.typing import NDArray
from torch import Tensor

from gsvis import _check
from gsvis.color import _kernels_sh
from gsvis.render import _kernels_project, _kernels_tiles

__all__ = ["Projected", "View", "rasterize_cpu"]

_BLOCK = 2048
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class View:
    """One camera as the kernels take it.

    Attributes:
        viewmat: (4, 4) float64, camera from world.
        intrinsics: (fx, fy, cx, cy) in pixels.
        width: Pixels.
        height: Pixels.
    """

    viewmat: F64
    intrinsics: tuple[float, float, float, float]
    width: int
    height: int

    @classmethod
    def from_matrices(cls, viewmat: F64, K: F64, width: int, height: int) -> View:  # noqa: N803
        """From (4, 4) and (3, 3) matrices; skew is refused where cameras are checked."""
        fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        return cls(np.ascontiguousarray(viewmat, np.float64), (fx, fy, cx, cy), width, height)

    @property
    def eye(self) -> F64:
        """(3,) viewpoint, world frame."""
        return np.asarray(-self.viewmat[:3, :3].T @ self.viewmat[:3, 3])

    @property
    def tiles(self) -> tuple[int, int]:
        """Tiles across and down."""
        side = _kernels_tiles.TILE
        return -(-self.width // side), -(-self.height // side)


@dataclass(frozen=True, eq=False)
class Projected:
    """The M Gaussians that reach a pixel of one view, and the tiles' lists of them.

    Attributes:
        ids: (M,) int32, the Gaussian of each splat.
        splats: (M, 8) float64; see `_kernels_project`.
        depths: (M,) float32, camera z.
        order: (M,) int32 splats, front to back.
        offsets: (tiles + 1,) int64; tile t owns members[offsets[t]:offsets[t + 1]].
        members: (P,) int32 splats, front to back.
        pair_of: (P,) int32 number of each pair, along `order`; empty where not asked for.
        first_pair: (M + 1,) int64; splat order[k] owns pairs first_pair[k]:first_pair[k + 1].
    """

    ids: I32
    splats: F64
    depths: F32
    order: I32
    offsets: NDArray[np.int64]
    members: I32
    pair_of: I32
    first_pair: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Scene:
    """The arrays of a scene as the kernels take them."""

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32  # noqa: N815


def project(scene: Any, view: View, *, antialiased: bool, pairs: bool) -> Projected:
    """Project, sort by depth and cut into tiles.

    Args:
        scene: Anything with arrays means, quats, scales, opacities (and sh0, shN, that order equal depths).
        view: The camera.
        antialiased: Make opacity pay for the dilation.
        pairs: Number the (tile, splat) pairs, as gradients and weights need.
    """
    n = len(scene.means)
    blocks = -(-n // _BLOCK)
    counts = np.zeros(blocks, np.int64)
    ids, splats, depths = np.empty(n, np.int32), np.empty((n, 8)), np.empty(n, np.float32)
    size = (view.width, view.height)
    shapes = _check.read_only(scene.means, scene.quats, scene.scales, scene.opacities)
    _kernels_project.project(
        *shapes, view.viewmat, view.intrinsics, *size, antialiased,
        ids, splats, depths, counts,
    )  # fmt: skip
    starts = np.concatenate([[0], np.cumsum(counts)])
    m = int(starts[-1])
    packed = np.empty(m, np.int32), np.empty((m, 8)), np.empty(m, np.float32)
    _kernels_project.gather_blocks(counts, starts, ids, splats, depths, *packed)
    ids, splats, depths = packed
    order = np.argsort(depths).astype(np.int32)
    content = scene.means, scene.scales, scene.quats, scene.opacities[:, None], scene.sh0[:, 0]
    _kernels_tiles.order_ties(order, depths[order], ids, *_check.read_only(*content))
    tiles_x, tiles_y = view.tiles
    room = np.empty(m, np.int64)
    _kernels_tiles.count_candidates(splats, tiles_x, tiles_y, room)
    first_room = np.concatenate([[0], np.cumsum(room[order])])
    met, counts = np.empty(int(first_room[-1]), np.int32), np.empty(m, np.int32)
    histogram = np.zeros((get_num_threads(), tiles_x * tiles_y), np.int32)
    _kernels_tiles.meet_tiles(splats, order, first_room, tiles_x, tiles_y, met, counts, histogram)
    offsets = np.empty(tiles_x * tiles_y + 1, np.int64)
    _kernels_tiles.place_chunks(histogram, offsets)
    first_pair = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    members = np.empty(int(offsets[-1]), np.int32)
    pair_of = np.empty(len(members) if pairs else 0, np.int32)
    _kernels_tiles.fill_tiles(order, first_room, met, counts, first_pair, histogram, members, pair_of)
    return Projected(ids, splats, depths, order, offsets, members, pair_of, first_pair)


class _Rasterize(torch.autograd.Function):
    """means, quats, scales, opacities, sh0, shN, colours | None -> image, alpha, depth, median, means2d of one view."""

    @staticmethod
    def forward(
        ctx: Any, view: View, options: tuple[F32, int, bool, bool, int], probe: Tensor, *tensors: Tensor | None
    ) -> tuple[Tensor, ...]:
        background, degree, antialiased, with_gradient, _ = options
        arrays = [None if t is None else _array(t) for t in tensors]
        scene, colours = _Scene(*arrays[:6]), arrays[6]  # type: ignore[arg-type]
        projected = project(scene, view, antialiased=antialiased, pairs=with_gradient)
        features = np.empty((len(projected.ids), 4), np.float32)
        features[:, 3] = projected.depths
        if colours is None:
            _kernels_sh.colours_from_sh(
                projected.ids,
                *_check.read_only(scene.means, scene.sh0, scene.shN),
                degree,
                view.eye,
                np.float32(0.0),
                features,
            )
        else:
            features[:, :3] = colours[projected.ids]
        shape = (view.height, view.width)
        image = np.empty((*shape, 3), np.float32)
        transmittance, depth, median, stop_at = (np.empty(shape, np.float32) for _ in range(4))
        _kernels_tiles.blend_tiles(
            projected.splats, features, projected.offsets, projected.members, view.tiles[0], background,
            image, transmittance, depth, median, stop_at,
        )  # fmt: skip
        ctx.saved = (view, options, scene, colours, projected, features, transmittance, depth, stop_at)
        ctx.dtypes = [None if t is None else t.dtype for t in tensors]
        outputs = tuple(torch.from_numpy(a) for a in (image, np.float32(1.0) - transmittance, depth, median))
        ctx.mark_non_differentiable(outputs[3])
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *by_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        view, (background, degree, antialiased, _, frozen), scene, colours, projected, features, *forward = ctx.saved
        shape = (view.height, view.width)
        by_image, by_alpha, by_depth = (
            np.zeros((*shape, *extra), np.float32) if v is None else np.ascontiguousarray(v.numpy(), np.float32)
            for v, extra in zip(by_outputs[:3], ((3,), (), ()), strict=True)
        )
        pairs = np.empty((len(projected.members), 12), np.float32)
        _kernels_tiles.blend_tiles_backward(
            projected.splats, features, projected.offsets, projected.members, projected.pair_of, view.tiles[0],
            background, tuple(forward), (by_image, by_alpha, by_depth), pairs,
        )  # fmt: skip
        sums = np.empty((len(projected.ids), 10))
        _kernels_tiles.sum_pairs(projected.order, projected.first_pair, pairs, sums)
        v_means, v_quats, v_scales = (np.zeros_like(a) for a in (scene.means, scene.quats, scene.scales))
        v_opacities, v_sh0, v_shN = (np.zeros_like(a) for a in (scene.opacities, scene.sh0, scene.shN))
        v_means2d = np.empty((len(projected.ids), 2))
        stand = int(np.searchsorted(projected.ids, frozen))  # ids rise
        ids, moved = projected.ids[stand:], sums[stand:]
        v_means2d[:stand] = _by_centres(projected.splats[:stand], sums[:stand])
        _kernels_project.project_backward(
            *_check.read_only(scene.means, scene.quats, scene.scales, scene.opacities), view.viewmat, view.intrinsics,
            (view.width, view.height), antialiased, ids, moved, v_means2d[stand:], v_opacities,
            (v_means, v_quats, v_scales),
        )  # fmt: skip
        v_colours = None
        if colours is None:
            _kernels_sh.colours_from_sh_backward(
                ids, scene.means, scene.sh0, scene.shN, degree, view.eye, features[stand:], moved,
                v_sh0, v_shN, v_means,
            )  # fmt: skip
        else:
            v_colours = np.zeros_like(colours)
            v_colours[ids] = moved[:, :3]
        v_probe = None
        if ctx.needs_input_grad[2]:
            by_centre = np.zeros((len(scene.means), 2), np.float32)
            by_centre[projected.ids] = v_means2d
            v_probe = torch.from_numpy(by_centre)
        results = [v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN, v_colours]
        gradients = [
            None if v is None or dtype is None else torch.from_numpy(v).to(dtype)
            for v, dtype in zip(results, ctx.dtypes, strict=True)
        ]
        return None, None, v_probe, *gradients


def _by_centres(splats: F64, sums: F64) -> F64:
    """(M, 2) gradients by projected centres from the sums of the tiles, as `project_backward` has them."""
    a, b, c = (
        splats[:, 2] * (2.0 / _kernels_project.LOG2E),
        splats[:, 3] / _kernels_project.LOG2E,
        splats[:, 4] * (2.0 / _kernels_project.LOG2E),
    )
    return np.stack([a * sums[:, 5] + b * sums[:, 6], b * sums[:, 5] + c * sums[:, 6]], axis=1)


def _array(tensor: Tensor) -> F32:
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)


def rasterize_cpu(
    tensors: Any,
    view: View,
    *,
    background: F32,
    sh_degree: int,
    antialiased: bool = False,
    colors: Tensor | None = None,
    probe: Tensor | None = None,
    frozen: int = 0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render one view.

    Args:
        tensors: Has means, quats, scales, opacities, sh0, shN as CPU tensors.
        view: The camera.
        background: (3,) RGB behind everything.
        sh_degree: Degree to evaluate, at most that of the scene.
        antialiased: Make opacity pay for the dilation.
        colors: (N, 3) instead of SH.
        probe: (N, 2) zeros that require grad; receives the gradient by the projected centres, loss per pixel.
        frozen: The first so many Gaussians gather no gradient but the probe's.

    Returns:
        image (H, W, 3), alpha (H, W), expected depth (H, W), median depth (H, W).
    """
    inputs = [tensors.means, tensors.quats, tensors.scales, tensors.opacities, tensors.sh0, tensors.shN, colors]
    probe = torch.zeros((len(tensors.means), 2)) if probe is None else probe
    needs = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in (*inputs, probe))
    result: tuple[Tensor, Tensor, Tensor, Tensor] = _Rasterize.apply(  # type: ignore[no-untyped-call]
        view, (background, sh_degree, antialiased, needs, frozen), probe, *inputs
    )
    return result
