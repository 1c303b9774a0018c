"""The rasterizer in plain torch: short, differentiable, in any float type, and slow. Tests compare `cpu` to it.

Every pixel meets every Gaussian. Camera axes are OpenCV's, pixel centers lie at +0.5, depths are along the camera's
z axis in scene units; thresholds are those of docs/conventions.md. This module uses no tiles and no kernels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gsvis import _check
from gsvis.color.sh_torch import sh_colors_torch
from gsvis.render.reference import BLUR, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR
from gsvis.render.tensors import GaussianTensors, rotations_from_quats
from gsvis.scene.lengths import length_factor

__all__ = ["Projection", "ReferenceImage", "contributors_reference", "project_reference", "rasterize_reference"]

_PAIRS_AT_ONCE = 1 << 20
"""Most pixels times Gaussians of one chunk: tens of megabytes."""


@dataclass(frozen=True, eq=False)
class Projection:
    """N Gaussians projected into one camera. Ignore rows that are not `valid`.

    Attributes:
        means2d: (N, 2) projected centers, pixels.
        conics: (N, 3) inverse covariance on the screen as xx, xy, yy, per square pixel.
        depths: (N,) camera z, scene units.
        opacities: (N,) in [0, 1]; lowered to make up for the blur if antialiased.
        colors: (N, 3) RGB seen from this camera; >= 0 if they come from SH.
        radii: (N, 2) half width and half height of the box outside which alpha is below 1/255, pixels; 0 if alpha is
            below 1/255 everywhere. Without gradient.
        valid: (N,) bool, true beyond the near plane.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    colors: Tensor
    radii: Tensor
    valid: Tensor


@dataclass(frozen=True, eq=False)
class ReferenceImage:
    """The image of N Gaussians in one camera, with depths and weights.

    Attributes:
        image: (H, W, 3) colors over the background.
        alpha: (H, W) one minus the remaining transmittance.
        depth: (H, W) mean camera z, weighted by blending weights; 0 where alpha is 0.
        median_depth: (H, W) camera z of the first Gaussian behind which transmittance is at most 0.5; 0 if there is
            none.
        means2d: (N, 2) projected centers, pixels; after a backward pass its `grad` is the screen-space gradient.
        radii: (N, 2) half extents on the screen, pixels; 0 where not drawn. Without gradient.
        largest_weights: (N,) each Gaussian's largest weight over all pixels. Without gradient.
        summed_weights: (N,) each Gaussian's sum of weights over all pixels. Without gradient.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    median_depth: Tensor
    means2d: Tensor
    radii: Tensor
    largest_weights: Tensor
    summed_weights: Tensor


def project_reference(
    tensors: GaussianTensors,
    viewmat: ArrayLike | Tensor,
    K: ArrayLike | Tensor,  # noqa: N803  the field's own name
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    antialiased: bool = False,
    colors: Tensor | None = None,
) -> Projection:
    """Return the position, extent and color of each Gaussian on the screen.

    Args:
        tensors: N Gaussians, world frame.
        viewmat: (4, 4) camera from world, rigid.
        K: (3, 3) intrinsics in pixels, without skew.
        width: Pixels.
        height: Pixels.
        sh_degree: Highest degree of SH to evaluate; None for the degree of the scene.
        antialiased: Lower opacities so that the blur of 0.3 square pixels keeps their integral.
        colors: (N, 3) RGB instead of SH.

    Returns:
        Differentiable values of the dtype and device of `tensors`.

    Raises:
        ValueError: If a shape, a size, the intrinsics or the degree are out of range.

    References:
        Zwicker et al., "EWA splatting", TVCG 2002, section 4; Yu et al., "Mip-Splatting", CVPR 2024, equation 9.
    """
    view, intrinsic = _camera(tensors, viewmat, K, width, height)
    (fx, _, cx), (_, fy, cy), _ = intrinsic.tolist()
    rotation = view[:3, :3]
    translation = view[:3, 3]

    x, y, z = ((tensors.means[:, None, :] * rotation).sum(dim=2) + translation).unbind(dim=1)
    valid = z.detach() > NEAR / length_factor(tensors.means.detach().cpu().numpy())
    z = torch.where(valid, z, torch.ones_like(z))  # so that culled Gaussians do not divide by zero
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)

    # The Jacobian of the projection; its point is clamped to 0.3 half images outside the view.
    beyond_x = 0.3 * 0.5 * width / fx
    beyond_y = 0.3 * 0.5 * height / fy
    slope_x = (x / z).clamp(-cx / fx - beyond_x, (width - cx) / fx + beyond_x)
    slope_y = (y / z).clamp(-cy / fy - beyond_y, (height - cy) / fy + beyond_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * slope_x / z], dim=1), torch.stack([zero, fy / z, -fy * slope_y / z], dim=1)],
        dim=1,
    )
    # With A = J W R S the covariance on the screen is A A^T. Its determinant is the squared area that its rows span.
    # Computed this way, it cannot be negative for a needle.
    half = jacobian @ rotation @ (rotations_from_quats(tensors.quats) * tensors.scales[:, None, :])
    u, v = half.unbind(dim=1)
    xx = (u * u).sum(dim=1)
    xy = (u * v).sum(dim=1)
    yy = (v * v).sum(dim=1)
    sharp = torch.linalg.cross(u, v).square().sum(dim=1)
    det = sharp + BLUR * (xx + yy) + BLUR * BLUR
    conics = torch.stack([(yy + BLUR) / det, -xy / det, (xx + BLUR) / det], dim=1)

    opacities = tensors.opacities
    if antialiased:
        spans = sharp.detach() > 0
        kept = torch.where(spans, sharp, torch.ones_like(sharp)) / det
        opacities = torch.where(spans, opacities * kept.sqrt(), torch.zeros_like(opacities))
    with torch.no_grad():
        reach = (2.0 * torch.log((opacities * 255.0).clamp(min=1.0))).sqrt()
        radii = reach[:, None] * torch.stack([xx + BLUR, yy + BLUR], dim=1).sqrt() * valid[:, None]
    if colors is None:
        colors = _colors_from_sh(tensors, -rotation.T @ translation, sh_degree)
    elif tuple(colors.shape) != (len(tensors), 3):
        raise ValueError(f"colors: expected shape ({len(tensors)}, 3), got {tuple(colors.shape)}")
    return Projection(means2d, conics, z, opacities, colors.to(means2d), radii, valid)


def rasterize_reference(
    tensors: GaussianTensors,
    viewmat: ArrayLike | Tensor,
    K: ArrayLike | Tensor,  # noqa: N803
    width: int,
    height: int,
    *,
    background: ArrayLike | Tensor = (0.0, 0.0, 0.0),
    **options: Any,
) -> ReferenceImage:
    """Render Gaussians, every pixel against every Gaussian.

    Args:
        tensors: N Gaussians, world frame.
        viewmat: (4, 4) camera from world, rigid.
        K: (3, 3) intrinsics in pixels, without skew.
        width: Pixels.
        height: Pixels.
        background: (3,) color behind everything.
        options: `sh_degree`, `antialiased` and `colors` of `project_reference`.

    Returns:
        The image with its depths and weights, of the dtype and device of `tensors`. It is differentiable. Gradients
        ignore which Gaussians are drawn, in which order, and where blending stops.

    Raises:
        ValueError: If a shape, a size, the intrinsics or the degree are out of range.
    """
    projection = project_reference(tensors, viewmat, K, width, height, **options)
    return blend_reference(tensors, projection, width, height, background)


def blend_reference(
    tensors: GaussianTensors, projection: Projection, width: int, height: int, background: ArrayLike | Tensor
) -> ReferenceImage:
    """Render projected Gaussians; see `rasterize_reference`.

    Args:
        tensors: N Gaussians, world frame.
        projection: The same Gaussians, projected.
        width: Pixels.
        height: Pixels.
        background: (3,) color behind everything.
    """
    means2d = projection.means2d
    if means2d.requires_grad:
        means2d.retain_grad()
    behind = _small_tensor("background", background, (3,), means2d)
    order = _front_to_back(tensors, projection)
    front_to_back = Projection(*(getattr(projection, field.name)[order] for field in fields(Projection)))
    pixels = _pixel_centers(width, height, means2d)

    largest, summed = (torch.zeros_like(means2d[:, 0].detach()) for _ in range(2))
    parts = []
    for some in torch.split(pixels, max(1, _PAIRS_AT_ONCE // max(1, len(order)))):
        with torch.no_grad():  # skip Gaussians that stay well below 1/255 at all of these pixels
            reach = torch.log(255.0 * front_to_back.opacities) + 0.1
            hit = (_sigmas(front_to_back, slice(None), some) < reach).any(dim=0).nonzero()[:, 0]
        # The backward pass recomputes a chunk, so that it too holds one chunk at a time.
        *drawn, weights = checkpoint(_blend, front_to_back, hit, some, behind, use_reentrant=False)
        parts.append(drawn)
        if weights.numel():
            weights = weights.detach()
            ids = order[hit]
            largest[ids] = torch.maximum(largest[ids], weights.amax(dim=0))
            summed[ids] += weights.sum(dim=0)
    image, alpha, depth, median_depth = (torch.cat(part) for part in zip(*parts, strict=True))
    return ReferenceImage(
        image.reshape(height, width, 3),
        alpha.reshape(height, width),
        depth.reshape(height, width),
        median_depth.reshape(height, width),
        means2d,
        projection.radii,
        largest,
        summed,
    )


def contributors_reference(
    tensors: GaussianTensors,
    viewmat: ArrayLike | Tensor,
    K: ArrayLike | Tensor,  # noqa: N803
    width: int,
    height: int,
    pixel: tuple[int, int],
    *,
    antialiased: bool = False,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the Gaussians blended into one pixel.

    Args:
        tensors: N Gaussians, world frame.
        viewmat: (4, 4) camera from world, rigid.
        K: (3, 3) intrinsics in pixels, without skew.
        width: Pixels.
        height: Pixels.
        pixel: Column and row, from 0 at the top left.
        antialiased: Lower opacities so that the blur of 0.3 square pixels keeps their integral.

    Returns:
        Ids, alphas, weights and depths (camera z) of these Gaussians, front to back.

    Raises:
        ValueError: If the pixel lies outside the image, or a shape, a size or the intrinsics are out of range.
    """
    with torch.no_grad():
        projection = project_reference(tensors, viewmat, K, width, height, antialiased=antialiased)
        column, row = pixel
        if not (0 <= column < width and 0 <= row < height):
            raise ValueError(f"pixel: expected a column below {width} and a row below {height}, got {pixel}")
        order = _front_to_back(tensors, projection)
        center = _pixel_centers(width, height, projection.means2d)[row * width + column]
        alphas, before = _alphas_and_transmittance(projection, order, center[None])
        ids = order[alphas[0] > 0]
        alpha, weight = (values[0, alphas[0] > 0].double() for values in (alphas, alphas * before[:, :-1]))
        depth = projection.depths[ids].double()
        return ids.cpu().numpy(), alpha.cpu().numpy(), weight.cpu().numpy(), depth.cpu().numpy()


def _front_to_back(tensors: GaussianTensors, projection: Projection) -> Tensor:
    """Return indices of the valid Gaussians, sorted by depth as float32; ties sort by content, not by index."""
    columns = [
        projection.depths.float()[:, None],
        tensors.means,
        tensors.scales,
        tensors.quats,
        tensors.opacities[:, None],
        projection.colors,
    ]
    keys = [key for column in columns for key in column.detach().cpu().numpy().T]
    order = torch.as_tensor(np.lexsort(keys[::-1]), device=projection.valid.device)
    return order[projection.valid[order]]


def _sigmas(projection: Projection, ids: Tensor | slice, pixels: Tensor) -> Tensor:
    """Return (P, M) exponents of the Gaussians `ids` at (P, 2) pixel centers: the response is exp(-sigma)."""
    dx, dy = (projection.means2d[ids, axis] - pixels[:, axis, None] for axis in (0, 1))
    a = 0.5 * projection.conics[ids, 0]
    b = projection.conics[ids, 1]
    c = 0.5 * projection.conics[ids, 2]
    return a * dx * dx + b * dx * dy + c * dy * dy


def _alphas(projection: Projection, ids: Tensor, pixels: Tensor) -> Tensor:
    """Return (P, M) alphas of the Gaussians `ids` at (P, 2) pixel centers, 0 where below 1/255."""
    sigma = _sigmas(projection, ids, pixels)
    alphas = (projection.opacities[ids] * torch.exp(-sigma)).clamp(max=MAX_ALPHA)
    drawn = (alphas.detach() >= MIN_ALPHA) & (sigma.detach() >= 0)
    return torch.where(drawn, alphas, torch.zeros_like(alphas))


def _alphas_and_transmittance(projection: Projection, ids: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return (P, M) alphas, 0 where not blended, and (P, M + 1) transmittance before each and after the last."""
    alphas = _alphas(projection, ids, pixels)
    with torch.no_grad():  # drop the first that would bring it to the minimum, and all behind
        blended = torch.cumprod(1.0 - alphas, dim=1) > MIN_TRANSMITTANCE
    alphas = torch.where(blended, alphas, torch.zeros_like(alphas))
    after = torch.cumprod(1.0 - alphas, dim=1)
    return alphas, torch.cat([after.new_ones(len(after), 1), after], dim=1)


def _blend(projection: Projection, ids: Tensor, pixels: Tensor, background: Tensor) -> tuple[Tensor, ...]:
    """Return image (P, 3), alpha (P,), depth (P,), median depth (P,) and weights (P, M); `ids` are front to back."""
    alphas, transmittance = _alphas_and_transmittance(projection, ids, pixels)
    weights = alphas * transmittance[:, :-1]
    left = transmittance[:, -1]
    image = weights @ projection.colors[ids] + left[:, None] * background
    alpha = 1.0 - left
    something = alpha.detach() > 0
    depths = projection.depths[ids]
    depth = torch.where(something, weights @ depths / torch.where(something, alpha, torch.ones_like(alpha)), 0.0)
    if len(ids) == 0:
        return image, alpha, depth, torch.zeros_like(depth), weights
    half = transmittance[:, 1:].detach() <= 0.5
    median = torch.where(half.any(dim=1), depths[half.byte().argmax(dim=1)], 0.0)
    return image, alpha, depth, median, weights


def _colors_from_sh(tensors: GaussianTensors, eye: Tensor, sh_degree: int | None) -> Tensor:
    """Return (N, 3) colors seen from `eye`, clipped below at 0."""
    degree = tensors.sh_degree if sh_degree is None else sh_degree
    if isinstance(degree, bool) or degree not in range(tensors.sh_degree + 1):
        raise ValueError(f"sh_degree: expected 0 to {tensors.sh_degree}, the scene's own, got {sh_degree!r}")
    shN = tensors.shN[:, : (degree + 1) ** 2 - 1]
    return sh_colors_torch(tensors.means, tensors.sh0, shN, eye)


def _pixel_centers(width: int, height: int, like: Tensor) -> Tensor:
    """Return (H * W, 2) pixel centers x and y, row by row."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y], dim=2).reshape(-1, 2).to(like) + 0.5


def _camera(
    tensors: GaussianTensors,
    viewmat: ArrayLike | Tensor,
    K: ArrayLike | Tensor,  # noqa: N803
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """Return the checked pose and intrinsics, of the dtype and device of the Gaussians."""
    _check.positive_int("width", width)
    _check.positive_int("height", height)
    view = _small_tensor("viewmat", viewmat, (4, 4), tensors.means)
    rotation = view[:3, :3].detach().double()
    eye = torch.eye(3, dtype=torch.float64, device=view.device)
    if not torch.allclose(rotation @ rotation.T, eye, atol=1e-4) or torch.linalg.det(rotation) < 0:
        raise ValueError("viewmat: expected a rotation (orthonormal, determinant 1), got a pose that is not rigid")
    if not torch.allclose(view[3].detach().double(), view.new_tensor([0.0, 0.0, 0.0, 1.0]).double(), atol=1e-6):
        got = " ".join(f"{value:g}" for value in view[3].tolist())
        raise ValueError(f"viewmat: expected a last row of 0 0 0 1, got {got}; is the matrix transposed?")
    intrinsic = _small_tensor("K", K, (3, 3), tensors.means).detach()
    (fx, skew, _), (zero, fy, _), last = intrinsic.tolist()
    if min(fx, fy) <= 0 or skew != 0 or zero != 0 or last != [0.0, 0.0, 1.0]:
        got = str(intrinsic.tolist())
        raise ValueError(f"K: expected focal lengths > 0, no skew and a last row of 0 0 1, got {got}")
    return view, intrinsic


def _small_tensor(name: str, value: ArrayLike | Tensor, shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Return a checked, finite tensor of the dtype and device of `like`; keep its gradient."""
    if not isinstance(value, Tensor):
        value = torch.tensor(_check.floats(name, value, shape, np.float64))
    if tuple(value.shape) != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {tuple(value.shape)}")
    if not bool(torch.isfinite(value.detach()).all()):
        raise ValueError(f"{name}: expected finite values, got NaN or infinity")
    return value.to(like)
