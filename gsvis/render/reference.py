"""The rasterizer in plain NumPy, float64, to test `cpu`: short and slow, every pixel against every Gaussian.

Camera axes are OpenCV's, pixel centers lie at +0.5, depths are along the camera's z axis in scene units; thresholds are
those of docs/conventions.md. `gsvis.render.reference_torch` does the same with gradients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.render.splats import View
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.lengths import length_factor
from gsvis.scene.sh import sh_basis

__all__ = [
    "BLUR",
    "MAX_ALPHA",
    "MIN_ALPHA",
    "MIN_TRANSMITTANCE",
    "NEAR",
    "Projection",
    "composite",
    "draw_reference",
    "pixel_centers",
    "project_reference",
]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

NEAR = 0.01
"""Gaussians are not drawn if the camera z of their center is at most this; scene units."""
BLUR = 0.3
"""Added to the diagonal of each projected covariance; square pixels."""
MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4

_PAIRS_AT_ONCE = 1 << 20
"""Most pixels times Gaussians of one chunk: tens of megabytes."""


@dataclass(frozen=True, eq=False)
class Projection:
    """The M Gaussians in front of one camera, front to back.

    Attributes:
        ids: (M,) indices into the scene.
        means2d: (M, 2) projected centers, pixels.
        conics: (M, 3) inverse covariance on the screen as xx, xy, yy, per square pixel.
        depths: (M,) camera z, scene units.
        opacities: (M,) in [0, 1]; lowered to make up for the blur if antialiased.
        colors: (M, 3) RGB seen from this camera.
    """

    ids: NDArray[np.int64]
    means2d: F64
    conics: F64
    depths: F64
    opacities: F64
    colors: F64

    def alphas(self, pixels: F64) -> F64:
        """Return the (P, M) alphas at (P, 2) pixel centers, 0 where below 1/255."""
        dx, dy = (self.means2d[:, axis] - pixels[:, axis, None] for axis in (0, 1))
        a = 0.5 * self.conics[:, 0]
        b = self.conics[:, 1]
        c = 0.5 * self.conics[:, 2]
        sigma = a * dx * dx + b * dx * dy + c * dy * dy
        alphas = np.minimum(self.opacities * np.exp(-sigma), MAX_ALPHA)
        return np.where((alphas >= MIN_ALPHA) & (sigma >= 0.0), alphas, 0.0)


def project_reference(
    g: Gaussians,
    view: View,
    *,
    sh_degree: int | None = None,
    antialiased: bool = False,
    colors: ArrayLike | None = None,
) -> Projection:
    """Return the position, extent and color of Gaussians on the screen.

    Args:
        g: N Gaussians, world frame.
        view: The camera.
        sh_degree: Degree of SH to evaluate; None for the degree of the scene.
        antialiased: Lower opacities so that the blur of 0.3 square pixels keeps their integral.
        colors: (N, 3) RGB instead of SH.

    References:
        Zwicker et al., "EWA splatting", TVCG 2002, section 4; Yu et al., "Mip-Splatting", CVPR 2024, equation 9.
    """
    fx, fy, cx, cy = view.intrinsics
    rotation = view.viewmat[:3, :3]
    translation = view.viewmat[:3, 3]
    centers = g.means.astype(np.float64) @ rotation.T + translation
    ids = np.flatnonzero(centers[:, 2] > NEAR / length_factor(g.means))
    x, y, z = centers[ids].T
    # The Jacobian of the projection; its point is clamped to 0.3 half images outside the view.
    beyond_x = 0.15 * view.width / fx
    beyond_y = 0.15 * view.height / fy
    slope_x = np.clip(x / z, -cx / fx - beyond_x, (view.width - cx) / fx + beyond_x)
    slope_y = np.clip(y / z, -cy / fy - beyond_y, (view.height - cy) / fy + beyond_y)
    jacobian = np.zeros((len(ids), 2, 3))
    jacobian[:, 0, 0] = fx / z
    jacobian[:, 0, 2] = -fx * slope_x / z
    jacobian[:, 1, 1] = fy / z
    jacobian[:, 1, 2] = -fy * slope_y / z
    # With A = J W R S the covariance on the screen is A A^T. Its determinant is the squared area that its rows span.
    some = g[ids]
    half = jacobian @ rotation @ (some.rotations().astype(np.float64) * some.scales[:, None, :])
    xx, xy, yy = (half[:, i] * half[:, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    xx, xy, yy = (part.sum(axis=1) for part in (xx, xy, yy))
    sharp = np.square(np.cross(half[:, 0], half[:, 1])).sum(axis=1)
    det = sharp + BLUR * (xx + yy) + BLUR * BLUR
    conics = np.stack([(yy + BLUR) / det, -xy / det, (xx + BLUR) / det], axis=1)
    opacities = some.opacities.astype(np.float64)
    if antialiased:
        opacities = opacities * np.sqrt(sharp / det)
    shown = _sh_colors(some, view.eye, sh_degree) if colors is None else np.asarray(colors, np.float64)[ids]
    content = [z.astype(np.float32)[:, None], some.means, some.scales, some.quats, some.opacities[:, None], shown]
    keys = [key for columns in content for key in columns.T]  # ties sort by content, not by index
    order = np.lexsort(keys[::-1])
    means2d = np.stack([fx * x / z + cx, fy * y / z + cy], axis=1)
    return Projection(
        ids[order], means2d[order], conics[order], np.asarray(z[order]), opacities[order], np.asarray(shown[order])
    )


def draw_reference(
    g: Gaussians,
    view: View,
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    antialiased: bool = False,
    colors: ArrayLike | None = None,
) -> tuple[F32, F32, F32, F32]:
    """Render one view.

    Args:
        g: N Gaussians, world frame.
        view: The camera.
        background: (3,) color behind everything.
        sh_degree: Degree of SH to evaluate; None for the degree of the scene.
        antialiased: Lower opacities so that the blur of 0.3 square pixels keeps their integral.
        colors: (N, 3) RGB instead of SH.

    Returns:
        image (H, W, 3), alpha (H, W), expected depth (H, W), median depth (H, W).
    """
    splats = project_reference(g, view, sh_degree=sh_degree, antialiased=antialiased, colors=colors)
    behind = np.asarray(background, np.float64)
    pixels = pixel_centers(view)
    chunk = max(1, _PAIRS_AT_ONCE // max(1, len(splats.ids)))
    parts: list[tuple[Any, ...]] = []
    for first in range(0, len(pixels), chunk):
        alphas = splats.alphas(pixels[first : first + chunk])
        # Drop the first Gaussian that would bring transmittance to the minimum, and all behind it.
        alphas[np.cumprod(1.0 - alphas, axis=1) <= MIN_TRANSMITTANCE] = 0.0
        image, weights, left = composite(alphas, splats.colors, behind)
        alpha = 1.0 - left[:, -1]
        depth = np.divide(weights @ splats.depths, alpha, out=np.zeros_like(alpha), where=alpha > 0)
        half = left[:, 1:] <= 0.5
        median = np.zeros_like(alpha)
        reached = half.any(axis=1)
        if reached.any():
            median[reached] = splats.depths[half[reached].argmax(axis=1)]
        parts.append((image, alpha, depth, median))
    shape = (view.height, view.width)
    whole = [np.concatenate(part).astype(np.float32) for part in zip(*parts, strict=True)]
    return whole[0].reshape(*shape, 3), *(plane.reshape(shape) for plane in whole[1:])  # type: ignore[return-value]


def composite(alphas: F64, colors: F64, background: F64) -> tuple[F64, F64, F64]:
    """Blend M Gaussians, front to back, at P pixels.

    Args:
        alphas: (P, M) alpha of each Gaussian at each pixel.
        colors: (M, 3) RGB.
        background: (3,) RGB behind everything.

    Returns:
        image (P, 3), weights (P, M), and transmittance (P, M + 1) before each Gaussian and behind the last.
    """
    transmittance = np.cumprod(np.concatenate([np.ones((len(alphas), 1)), 1.0 - alphas], axis=1), axis=1)
    weights = alphas * transmittance[:, :-1]
    return (
        np.asarray(weights @ colors + transmittance[:, -1:] * background),
        np.asarray(weights),
        np.asarray(transmittance),
    )


def pixel_centers(view: View) -> F64:
    """Return (H * W, 2) pixel centers x and y, row by row."""
    rows, columns = np.indices((view.height, view.width))
    return np.asarray(np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5, np.float64)


def _sh_colors(g: Gaussians, eye: F64, sh_degree: int | None) -> F64:
    """Return (N, 3) colors seen from `eye`, clipped below at 0; a Gaussian centered at the eye is seen along +z."""
    degree = g.sh_degree if sh_degree is None else sh_degree
    offsets = g.means - eye
    lengths = np.linalg.norm(offsets, axis=1, keepdims=True)
    directions = np.where(lengths > 0, offsets / np.where(lengths > 0, lengths, 1.0), [0.0, 0.0, 1.0])
    coefficients = np.concatenate([g.sh0, g.shN], axis=1).astype(np.float64)[:, : (degree + 1) ** 2]
    return np.asarray(np.maximum(0.5 + np.einsum("nk,nkc->nc", sh_basis(directions, degree), coefficients), 0.0))
