"""Draw figure 15 of the paper: a function on the sphere and its fits by more and more terms, seen from three sides.

Spheres are seen from outside, slightly from above, z up; they rotate about z. A function returns one number for each
unit vector, in the frame of the fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Circle
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.report.color_spheres import COUNTS, EYE, sphere_directions
from gsvis.report.theme import LIGHT, Theme, draw_png
from paper.sphere import SphereFit

__all__ = ["SIDES", "draw_sphere_figure", "sphere_figure"]

F64 = NDArray[np.float64]

SIDES = (0.0, 120.0, 240.0)
"""Degrees of rotation about z, as in the paper's figure."""

_SIDE = 240  # pixels of a sphere
# pixels from one sphere to the next
_STEP = 262
_ROW = 254
_GAP = 46  # above the row of differences, for the errors


def sphere_figure(
    function: Callable[[F64], ArrayLike],
    fit: SphereFit,
    *,
    errors: Sequence[float] | None = None,
    counts: Sequence[int] = COUNTS,
    title: str = "",
    theme: Theme = LIGHT,
) -> bytes:
    """Return the figure as PNG bytes; see `draw_sphere_figure`."""

    def draw(axes: Axes, theme: Theme) -> None:
        draw_sphere_figure(axes, theme, function, fit, errors=errors, counts=counts, title=title)

    return draw_png(draw, theme, (1.27 * (1 + len(counts)) + 0.75, 5.75))


def draw_sphere_figure(
    axes: Axes,
    theme: Theme,
    function: Callable[[F64], ArrayLike],
    fit: SphereFit,
    *,
    errors: Sequence[float] | None = None,
    counts: Sequence[int] = COUNTS,
    title: str = "",
) -> None:
    """Draw truth and fits from three sides, errors below, and at the bottom the differences on the first side.

    Args:
        axes: Axes to draw on; its limits and its frame are removed.
        theme: Colors.
        function: Maps (R, 3) unit vectors to (R,) values; the fitted function.
        fit: Its fits.
        errors: Mean squared error of each of `counts`; over the fitted directions by default.
        counts: Numbers of terms, at most those of the fit.
        title: Name of the function.

    Raises:
        ValueError: If a number of terms exceeds the fit, or the number of errors does not match.
    """
    mean_errors = [float(fit.errors[_count(fit, k)]) for k in counts] if errors is None else [float(e) for e in errors]
    if len(mean_errors) != len(counts):
        raise ValueError(f"errors: expected {len(counts)}, one for each number of terms, got {len(mean_errors)}")
    values = np.stack([_values(function, fit, counts, sphere_directions(side)[1]) for side in SIDES])
    cover = sphere_directions()[0]
    low, high = (float(v) for v in np.quantile(values[:, 0][:, cover > 0.5], [0.001, 0.999]))
    high = high if high > low else low + 1.0
    scale = Normalize(low - 0.1 * (high - low), high)  # nothing is drawn black
    spread = _spread(values[0, 1:, cover > 0.5] - values[0, 0, cover > 0.5][:, None])
    differences = Normalize(-spread, spread)
    columns = 1 + len(counts)
    rows = len(SIDES) + 1
    canvas = np.empty((rows * _ROW + _GAP, columns * _STEP, 3))
    canvas[:] = _rgb(theme.paper)
    lit = 0.8 + 0.2 * sphere_directions()[1] @ EYE
    for row, column in np.ndindex(rows, columns):
        y, x = _corner(row, column)
        if row < len(SIDES):
            image = colormaps["inferno"](scale(values[row, column]))[..., :3] * lit[..., None]
        elif column:
            image = colormaps["RdBu_r"](differences(values[0, column] - values[0, 0]))[..., :3]
        else:
            continue
        part = canvas[y : y + _SIDE, x : x + _SIDE]
        part += cover[..., None] * (image - part)
        center = x + 0.5 * _SIDE - 0.5, y + 0.5 * _SIDE - 0.5
        axes.add_patch(Circle(center, 0.5 * _SIDE, fill=False, edgecolor=theme.muted, linewidth=0.5, clip_on=False))
    axes.imshow(canvas, interpolation="bilinear")
    axes.set_axis_off()
    _label(axes, theme, counts, mean_errors)
    if title:
        axes.set_title(title, color=theme.ink, fontsize=11, fontweight="bold", pad=22)
    for norm, name, place, label in (
        (scale, "inferno", (1.012, 0.36, 0.014, 0.6), "value"),
        (differences, "RdBu_r", (1.012, 0.01, 0.014, 0.2), "difference"),
    ):
        bar = axes.figure.colorbar(ScalarMappable(norm, name), cax=axes.inset_axes(place))
        bar.outline.set_edgecolor(theme.muted)
        bar.ax.tick_params(labelsize=7)
        bar.ax.grid(visible=False)
        bar.set_label(label, fontsize=8, color=theme.ink)


def _count(fit: SphereFit, terms: int) -> int:
    if not 0 <= terms <= fit.max_terms:
        raise ValueError(f"counts: expected 0 to {fit.max_terms}, the terms of the fit, got {terms}")
    return terms


def _values(function: Callable[[F64], ArrayLike], fit: SphereFit, counts: Sequence[int], points: F64) -> F64:
    """Return (1 + counts, P, P) values of the truth and the fits."""
    flat = points.reshape(-1, 3)
    truth = _check.floats("function", function(flat), (len(flat),), np.float64)
    fits = [fit.evaluate(flat, _count(fit, k)) for k in counts]
    return np.stack([truth, *fits]).reshape(-1, *points.shape[:2])


def _spread(differences: F64) -> float:
    """Return the range of the difference scale: that of the middle columns, rounded; few terms must not dominate."""
    typical = float(np.quantile(np.abs(differences), 0.9)) if differences.size else 0.0
    if not typical > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(typical))
    return float(np.ceil(typical / power) * power)


def _corner(row: int, column: int) -> tuple[int, int]:
    below = _GAP if row == len(SIDES) else 0
    return row * _ROW + below, column * _STEP + (_STEP - _SIDE) // 2


def _label(axes: Axes, theme: Theme, counts: Sequence[int], errors: Sequence[float]) -> None:
    names = ["truth", *(f"{k} term{'' if k == 1 else 's'}" for k in counts)]
    for column, name in enumerate(names):
        middle = (column + 0.5) * _STEP
        axes.text(middle, -14, name, ha="center", va="bottom", fontsize=9, fontweight="bold", color=theme.ink)
        if column:
            text = f"MSE {errors[column - 1]:.2g}"
            place = len(SIDES) * _ROW - 4
            axes.text(middle, place, text, ha="center", va="top", fontsize=8.5, color=theme.gathered)
    for row, name in enumerate([*(f"{side:g}°" for side in SIDES)]):
        y = row * _ROW + 0.5 * _SIDE
        axes.text(-10, y, name, ha="right", va="center", fontsize=9, color=theme.muted)
    y, x = _corner(len(SIDES), 0)
    text = "fit minus\ntruth, 0°"
    axes.text(x + 0.5 * _SIDE, y + 0.5 * _SIDE, text, ha="center", va="center", fontsize=9, color=theme.muted)


def _rgb(color: str) -> F64:
    return np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
