"""The CPU rasterizer with gradients: numba kernels behind one differentiable torch function, one camera at a time.

Conventions: docs/conventions.md. Results depend neither on the order of the Gaussians in the scene nor on the number of
threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsvis import _check
from gsvis.color.sh import write_sh_gradients
from gsvis.render._kernels import project as _kernels_project
from gsvis.render._kernels import tiles as _kernels_tiles
from gsvis.render.splats import View, blend, color_splats, in_usual_units, project
from gsvis.scene.lengths import length_factor

__all__ = ["Frozen", "rasterize_cpu"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Frozen:
    """The first Gaussians of a scene, which receive no gradient except by their projected centers.

    Attributes:
        count: Their number.
        shown: (count,) which of them are drawn; None for all.
    """

    count: int = 0
    shown: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class _Scene:
    """Arrays of a scene for the kernels."""

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32  # noqa: N815


class _Rasterize(torch.autograd.Function):
    """Rasterize one view differentiably: image, alpha, depth, median and means2d of Gaussians or given colors."""

    @staticmethod
    def forward(
        ctx: Any, view: View, options: tuple[F32, int, bool, bool, Frozen], probe: Tensor, *tensors: Tensor | None
    ) -> tuple[Tensor, ...]:
        """Render the view and keep what the backward pass needs."""
        background, degree, antialiased, with_gradient, frozen = options
        arrays = [None if t is None else _array(t) for t in tensors]
        scene, colors = _Scene(*arrays[:6]), arrays[6]  # type: ignore[arg-type]
        projected = project(scene, view, antialiased=antialiased, pairs=with_gradient, shown=frozen.shown)
        features = color_splats(scene, projected, view, degree, colors)
        image, transmittance, depth, median, stop_at = blend(projected, view, features, background)
        ctx.saved = (view, options, scene, colors, projected, features, transmittance, depth, stop_at)
        ctx.dtypes = [None if t is None else t.dtype for t in tensors]
        outputs = tuple(torch.from_numpy(a) for a in (image, np.float32(1.0) - transmittance, depth, median))
        ctx.mark_non_differentiable(outputs[3])
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *by_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        """Return the gradients by the tensors of `forward`."""
        view, (background, degree, antialiased, _, frozen), scene, colors, projected, features, *forward = ctx.saved
        shape = (view.height, view.width)
        by_image, by_alpha, by_depth = (
            np.zeros((*shape, *extra), np.float32) if v is None else np.ascontiguousarray(v.numpy(), np.float32)
            for v, extra in zip(by_outputs[:3], ((3,), (), ()), strict=True)
        )
        stand = int(np.searchsorted(projected.ids, frozen.count))  # ids ascend
        still = 0 if ctx.needs_input_grad[2] else stand
        pairs = np.empty((len(projected.members), 12), np.float32)
        _kernels_tiles.blend_tiles_backward(
            projected.splats, features, projected.offsets, projected.members, projected.pair_of, view.tiles[0],
            background, tuple(forward), (by_image, by_alpha, by_depth), still, pairs,
        )  # fmt: skip
        sums = np.empty((len(projected.ids), 10))
        _kernels_tiles.sum_pairs(projected.order, projected.first_pair, pairs, still, sums)
        v_means, v_quats, v_scales = (_zeros_of(a) for a in (scene.means, scene.quats, scene.scales))
        v_opacities, v_sh0, v_shN = (_zeros_of(a) for a in (scene.opacities, scene.sh0, scene.shN))
        ids = projected.ids[stand:]
        moved = sums[stand:]
        v_means2d = np.empty((len(moved), 2))
        factor = length_factor(scene.means)
        means, scales, viewmat = in_usual_units(scene, view, factor)
        if factor != 1.0:
            moved = moved * np.where(np.arange(10) == 3, 1.0 / factor, 1.0)  # the gradient by depth, of scene units
        _kernels_project.project_backward(
            *_check.read_only(means, scene.quats, scales, scene.opacities), viewmat, view.intrinsics,
            (view.width, view.height), antialiased, ids, moved, v_means2d, v_opacities,
            (v_means, v_quats, v_scales),
        )  # fmt: skip
        if factor != 1.0:
            v_means *= np.float32(factor)
            v_scales *= np.float32(factor)
        v_colors = None
        if colors is None:
            coefficients = (scene.means, scene.sh0, scene.shN)
            drawn = (features[stand:], moved)
            write_sh_gradients(ids, coefficients, degree, view.eye, drawn, (v_sh0, v_shN, v_means))
        else:
            v_colors = np.zeros_like(colors)
            v_colors[ids] = moved[:, :3]
        v_probe = None
        if ctx.needs_input_grad[2]:
            by_center = np.zeros((len(scene.means), 2), np.float32)
            by_center[ids] = v_means2d
            _kernels_project.write_by_centers(projected.ids[:stand], projected.splats, sums, by_center)
            v_probe = torch.from_numpy(by_center)
        results = [v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN, v_colors]
        gradients = [
            None if v is None or dtype is None else torch.from_numpy(v).to(dtype)
            for v, dtype in zip(results, ctx.dtypes, strict=True)
        ]
        return None, None, v_probe, *gradients


def _zeros_of(values: F32) -> F32:
    """Return zeros of the same shape; memory that nobody writes, such as that of frozen rows, is never touched."""
    return np.zeros(values.shape, np.float32)


def _array(tensor: Tensor) -> F32:
    """Return the values of a tensor as a contiguous array."""
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)


_NOTHING = Frozen()


def rasterize_cpu(
    tensors: Any,
    view: View,
    *,
    background: F32,
    sh_degree: int,
    antialiased: bool = False,
    colors: Tensor | None = None,
    probe: Tensor | None = None,
    frozen: Frozen = _NOTHING,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render one view.

    Args:
        tensors: Object with means, quats, scales, opacities, sh0, shN as CPU tensors.
        view: The camera.
        background: (3,) RGB behind everything.
        sh_degree: Degree to evaluate, at most that of the scene.
        antialiased: Lower opacities so that the dilation keeps their integral.
        colors: (N, 3) RGB instead of SH.
        probe: (N, 2) zeros that require grad; receives the gradient by the projected centers, loss per pixel. None
            saves most of the backward pass of what is frozen.
        frozen: The first Gaussians, which receive no gradient except through `probe`.

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
