"""Draw Gaussians of a scene as spheres of their color in each direction: by SH, and by more and more terms.

Figure 15 of the paper for real colors: 2, 6, 10, 15, 20 and 30 terms. The fits are made only for the picture, over all
directions and without a price for terms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from numpy.typing import NDArray

from gsvis.color.evaluate import evaluate_along
from gsvis.color.fit import FitConfig, fit_srbf
from gsvis.color.sh import sh_colors_along, towards_gaussian
from gsvis.prepare.fitted_colors import FittedColors
from gsvis.report.theme import Theme
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.icosphere import face_directions, face_shares

__all__ = ["COUNTS", "EYE", "Spheres", "draw_spheres", "fit_spheres", "sphere_directions"]

COUNTS = (2, 6, 10, 15, 20, 30)
"""Numbers of terms in the paper's figure."""
EYE = np.array([np.cos(np.radians(20.0)), 0.0, np.sin(np.radians(20.0))])
"""Direction from the center of a sphere to the eye: 20 degrees above the equator."""

_SIDE = 180  # pixels of a sphere
# pixels from one sphere to the next, with its figure below
_STEP = 195
_ROW = 222


@dataclass(frozen=True, eq=False)
class Spheres:
    """M Gaussians, drawn as spheres.

    Attributes:
        ids: (M,) indices of the Gaussians.
        images: (M, 2 + len(COUNTS), S, S, 3) by SH, by the base color, by each number of terms.
        errors: (M, 1 + len(COUNTS)) squared RGB error, mean over directions and channels, of base and terms.
    """

    ids: NDArray[np.int64]
    images: NDArray[np.float32]
    errors: NDArray[np.float64]


def sphere_directions(side: float = 0.0, pixels: int = 240) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what a distant eye sees of the unit sphere: the cover of each pixel, and its point on the sphere.

    Args:
        side: Rotation of the sphere about z in degrees, counter-clockwise from above; at 0 the eye is at +x.
        pixels: P, the width in pixels.

    Returns:
        cover: (P, P) in [0, 1].
        points: (P, P, 3) unit vectors, from the center of the sphere; beyond the rim those of the rim.
    """
    at = (np.arange(pixels) + 0.5) / pixels * 2.0 - 1.0
    right, up = np.meshgrid(at, -at)
    radius = np.hypot(right, up)
    toward = np.sqrt(np.maximum(1.0 - radius**2, 0.0))
    right = right / np.maximum(radius, 1.0)
    up = up / np.maximum(radius, 1.0)
    forward, _, rise = EYE
    turn = -np.radians(side)
    out = toward * forward - up * rise
    z = toward * rise + up * forward
    points = [out * np.cos(turn) - right * np.sin(turn), out * np.sin(turn) + right * np.cos(turn), z]
    return np.clip((1.0 - radius) * 0.5 * pixels + 0.5, 0.0, 1.0), np.stack(points, axis=-1)


def fit_spheres(fitted: FittedColors, count: int = 3, variant: str | None = None) -> Spheres:
    """Select visible Gaussians whose color depends most on direction, and fit them with more and more terms.

    Args:
        fitted: A scene and its colors.
        count: Number of Gaussians; fewer if the scene has fewer.
        variant: How to split colors; None takes that of `fitted`.
    """
    g = fitted.gaussians
    weight = fitted.preparation.importance
    shown = weight >= np.quantile(weight, 0.9) if len(weight) else np.zeros(0, bool)
    richness = np.where(shown, np.square(g.shN.astype(np.float64)).sum(axis=(1, 2)), -1.0)
    ids = _pick_different(np.argsort(-richness, kind="stable"), g, count)
    some = g[ids]
    config = FitConfig(variant or fitted.colors.variant, max_terms=max(COUNTS), mean_terms=None, tolerance=1e-3)
    colors = fit_srbf(some, None, config).colors
    toward = sphere_directions(pixels=_SIDE)[1].reshape(-1, 3)
    parts = face_directions(4).reshape(-1, 3)
    shares = face_shares(4).reshape(-1)
    steps = [colors.first(k) for k in (0, *COUNTS)]
    exact = sh_colors_along(some.sh0, some.shN, towards_gaussian(parts))
    shape = (len(ids), _SIDE, _SIDE, 3)
    images = np.zeros((len(ids), 2 + len(COUNTS), *shape[1:]), np.float32)
    images[:, 0] = sh_colors_along(some.sh0, some.shN, towards_gaussian(toward)).reshape(shape)
    errors = np.zeros((len(ids), len(steps)))
    for column, step in enumerate(steps):
        images[:, column + 1] = evaluate_along(step, towards_gaussian(toward)).reshape(shape)
        squared = np.square(evaluate_along(step, towards_gaussian(parts)).astype(np.float64) - exact)
        errors[:, column] = np.einsum("mdc,d->m", squared, shares) / (3.0 * shares.sum())
    return Spheres(ids, images, errors)


def draw_spheres(axes: Axes, theme: Theme, spheres: Spheres) -> None:
    """Draw a row for each Gaussian: SH, base color, and 2 to 30 terms, with the error below each."""
    rows, columns = spheres.images.shape[:2]
    cover = sphere_directions(pixels=_SIDE)[0][..., None]
    paper = np.array([int(theme.paper[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    mosaic = np.empty((rows * _ROW, columns * _STEP, 3))
    mosaic[:] = paper
    for m, c in np.ndindex(rows, columns):
        y = m * _ROW
        x = c * _STEP + (_STEP - _SIDE) // 2
        shown = np.clip(spheres.images[m, c], 0.0, 1.0)
        mosaic[y : y + _SIDE, x : x + _SIDE] = cover * shown + (1.0 - cover) * paper
    axes.imshow(mosaic, interpolation="bilinear")
    for m, c in np.ndindex(rows, columns):  # a rim, for spheres as bright or as dark as the page
        center = (c + 0.5) * _STEP - 0.5, m * _ROW + 0.5 * _SIDE - 0.5
        axes.add_patch(Circle(center, 0.5 * _SIDE, fill=False, edgecolor=theme.muted, linewidth=0.4))
    axes.set_axis_off()
    for c, name in enumerate(("SH", "base", *(f"{k} terms" for k in COUNTS))):
        middle = (c + 0.5) * _STEP
        axes.text(middle, -12, name, ha="center", va="bottom", fontsize=8, fontweight="bold", color=theme.ink)
        for m in range(rows if c else 0):
            text = f"{spheres.errors[m, c - 1]:.1e}"
            axes.text(middle, m * _ROW + _SIDE + 5, text, ha="center", va="top", fontsize=7, color=theme.muted)


def _pick_different(order: NDArray[np.int64], g: Gaussians, count: int) -> NDArray[np.int64]:
    """Return the first few of an order whose base colors differ, so that the rows do not all look alike."""
    chosen: list[int] = []
    candidates = order[: 200 * count]
    for least in (0.5, 0.2, 0.0):
        for i in candidates.tolist():
            apart = [float(np.abs(g.sh0[i] - g.sh0[j]).max()) for j in chosen]
            if len(chosen) < count and i not in chosen and all(gap >= least for gap in apart):
                chosen.append(i)
    return np.array(chosen, np.int64)
