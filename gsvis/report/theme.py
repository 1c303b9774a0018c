"""Colors and fonts of plots, for light and for dark pages; parts that several plots share; plots as PNG bytes.

Figures use their own Agg canvases: no screen is needed, and the settings of matplotlib are restored.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import FuncFormatter

from gsvis.progress import Progress
from gsvis.report.html import Figure

__all__ = ["DARK", "LIGHT", "PERCENT", "Plot", "Theme", "draw_legend", "draw_level", "draw_plots", "draw_png"]

PERCENT = FuncFormatter(lambda value, _: f"{100.0 * value:g}%")
"""Format of shares on an axis."""

_DPI = 220


@dataclass(frozen=True)
class Theme:
    """Colors as #rrggbb.

    Attributes:
        paper: Background, the one of the page's cards.
        ink: Text.
        muted: Axes and secondary text.
        grid: Grid lines.
        gathered: What cameras saw; also what is visible.
        traced: What tracing outward found.
        published: The paper's figures.
        hidden: What is not visible.
    """

    paper: str
    ink: str
    muted: str
    grid: str
    gathered: str
    traced: str
    published: str
    hidden: str


LIGHT = Theme("#ffffff", "#1c2430", "#667080", "#e4e8ee", "#2463d6", "#d2600a", "#b0126f", "#b9c1cc")
DARK = Theme("#1a2029", "#e8ecf2", "#9aa5b4", "#2f3845", "#75a6ff", "#ff9d4d", "#ff7ac6", "#525d6c")


Plot = tuple[Callable[[Axes, Theme], None], tuple[float, float]]
"""A function that draws on axes, and the width and height of the plot in inches."""


def draw_plots(plots: Mapping[str, Plot], progress: Progress) -> dict[str, Figure]:
    """Return plots by name, each drawn for light and for dark pages; `progress` is called with stage "writing"."""
    figures = {}
    progress("writing", 0, len(plots))
    for done, (name, (draw, size)) in enumerate(plots.items(), 1):
        figures[name] = Figure(f"{name}.png", draw_png(draw, LIGHT, size), draw_png(draw, DARK, size))
        progress("writing", done, len(plots))
    return figures


def draw_level(
    axes: Axes, theme: Theme, value: float, text: str, color: str, *, above: bool = True, left: bool = False
) -> None:
    """Draw a dashed line across the plot with its meaning on it."""
    axes.axhline(value, color=color, linewidth=1.6, dashes=(5, 2))
    axes.annotate(
        text,
        (0.0 if left else 1.0, value),
        xycoords=("axes fraction", "data"),
        xytext=(3 if left else -2, 3 if above else -4),
        textcoords="offset points",
        ha="left" if left else "right",
        va="bottom" if above else "top",
        color=color,
        fontweight="bold",
        fontsize=9,
        bbox={"facecolor": theme.paper, "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
    )


def draw_legend(axes: Axes, columns: int = 2, *, handle: float = 1.8) -> None:
    """Draw the legend above the plot, with `handle` ems of each line."""
    axes.figure.legend(loc="outside upper center", ncols=columns, handlelength=handle, columnspacing=1.4)


def draw_png(
    draw: Callable[[Axes, Theme], None], theme: Theme = LIGHT, size: tuple[float, float] = (5.2, 3.5)
) -> bytes:
    """Return a plot as PNG bytes.

    Args:
        draw: Draws on the axes it is given.
        theme: Colors.
        size: Width and height in inches; type is 10 points, so that 5.2 inches stay legible on a phone.
    """
    with rc_context(_style(theme)):
        figure = Canvas(figsize=size, dpi=_DPI, layout="constrained")
        canvas: Any = FigureCanvasAgg(figure)
        draw(figure.add_subplot(), theme)
        out = io.BytesIO()
        canvas.print_png(out, metadata={"Software": None})  # the bytes of savefig, which draws twice
    return out.getvalue()


def _style(theme: Theme) -> dict[Any, Any]:
    """Return the settings of matplotlib for a theme."""
    return {
        "figure.facecolor": theme.paper,
        "savefig.facecolor": theme.paper,
        "axes.facecolor": theme.paper,
        "axes.edgecolor": theme.muted,
        "axes.labelcolor": theme.ink,
        "axes.labelsize": 10,
        "axes.linewidth": 0.8,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": theme.grid,
        "grid.linewidth": 0.8,
        "text.color": theme.ink,
        "xtick.color": theme.muted,
        "ytick.color": theme.muted,
        "xtick.labelsize": 9,
        "ytick.labelsize": 9,
        "legend.frameon": False,
        "legend.fontsize": 9,
        "font.family": "DejaVu Sans",
        "font.size": 10,
        "lines.solid_capstyle": "round",
    }
