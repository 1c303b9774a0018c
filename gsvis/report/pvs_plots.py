"""Draw the plots of a report on visible sets: what cells see, their viewpoints, what sets miss, the cost of classes."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray

from gsvis.pvs.quality import TARGETS, Quality
from gsvis.report.theme import PERCENT, Theme, draw_legend, draw_level

__all__ = ["LEAST_MISSING", "draw_bounds", "draw_missing", "draw_shares", "draw_trades", "draw_viewpoints"]

F64 = NDArray[np.float64]

LEAST_MISSING = 1e-6
"""Shares of light below this are drawn at this value, because the axis is logarithmic."""


def draw_shares(axes: Axes, theme: Theme, shares: ArrayLike, ever: float) -> None:
    """Draw the visible share of each cell, highest first, with the mean and what any cell sees.

    Args:
        axes: Axes to draw on.
        theme: Colors.
        shares: (C,) visible shares of the scene.
        ever: Share that at least one cell sees.
    """
    values = np.sort(np.asarray(shares, np.float64))[::-1]
    _draw_bars(axes, values, theme.gathered)
    mean = float(values.mean())
    top = max(ever, float(values.max()))
    axes.set_ylim(0.0, 1.16 * top)
    draw_level(axes, theme, ever, f"seen from any cell {ever:.1%}", theme.published)
    draw_level(axes, theme, mean, f"mean of the cells {mean:.1%}", theme.traced, above=ever - mean > 0.12 * top)
    axes.yaxis.set_major_formatter(PERCENT)
    axes.set_xlabel("cells, sorted")
    axes.set_ylabel("visible share of the scene")


def draw_viewpoints(axes: Axes, theme: Theme, shared: NDArray[np.int64], inner: NDArray[np.int64]) -> None:
    """Draw the number of viewpoints of the cells, separately for cells that needed inner ones.

    Args:
        axes: Axes to draw on.
        theme: Colors.
        shared: (C,) number of shared viewpoints of each cell.
        inner: (C,) number of further viewpoints that a certificate asked for.
    """
    total = shared + inner
    low = int(total.min())
    high = int(total.max())
    at = np.arange(low, high + 1)
    alone, more = (
        np.array([np.count_nonzero((total == v) & chosen) for v in at]) for chosen in (inner == 0, inner > 0)
    )
    axes.bar(at, alone, width=0.72, color=theme.gathered, label="shared ones alone")
    if (inner > 0).any():
        axes.bar(at, more, bottom=alone, width=0.72, color=theme.traced, label="with inner ones")
        draw_legend(axes, handle=1.2)
    axes.set_xlim(low - 0.7, high + 0.7)
    axes.grid(visible=False, axis="x")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(8, integer=True, min_n_ticks=1))
    axes.set_xlabel("viewpoints of a cell")
    axes.set_ylabel("cells")


def draw_bounds(axes: Axes, theme: Theme, bound: F64, limit: float | None) -> None:
    """Draw the bound of the light that each set misses, highest first, with the limit of the build.

    Args:
        axes: Axes to draw on.
        theme: Colors.
        bound: (C,) upper confidence bound of each cell; NaN without a certificate.
        limit: Bound at which the build finished a cell.
    """
    values = np.sort(bound[~np.isnan(bound)])[::-1]
    _draw_bars(axes, values if len(values) else np.zeros(1), theme.gathered)
    top = max(float(values.max(initial=0.0)), limit or 0.0, 1e-9)
    axes.set_ylim(0.0, 1.2 * top)
    if limit is not None:
        draw_level(axes, theme, limit, f"limit of building {limit:.2%}", theme.published)
    axes.yaxis.set_major_formatter(PERCENT)
    axes.set_xlabel("certified cells, sorted")
    axes.set_ylabel("light missed, at most")


def draw_missing(axes: Axes, theme: Theme, quality: Quality) -> None:
    """Draw the share of light that each measured set misses, at fresh viewpoints and on average, worst cell first."""
    missing = np.maximum(1.0 - quality.weighted_recall[..., 0], LEAST_MISSING)
    means = missing.mean(axis=1)
    order = np.argsort(-means, kind="stable")
    x = np.arange(1, len(order) + 1)
    eyes = np.repeat(x, missing.shape[1]), missing[order].ravel()
    axes.plot(*eyes, linestyle="none", marker="o", markersize=3.5, alpha=0.55, color=theme.muted, label="a viewpoint")
    own = {"linestyle": "none", "marker": "D", "markersize": 5, "color": theme.gathered}
    axes.plot(x, means[order], **own, markeredgecolor=theme.paper, label="mean of a cell", zorder=4)  # type: ignore[arg-type]
    axes.set_yscale("log")
    good, worst = (1.0 - value for value in TARGETS["weighted_recall"] if value is not None)
    draw_level(axes, theme, worst, f"target of the worst cell {worst:.1%}", theme.published)
    draw_level(axes, theme, good, f"target of the mean {good:.1%}", theme.traced)
    axes.set_ylim(0.5 * min(float(missing.min()), good), 3.0 * max(float(missing.max()), worst))
    axes.set_xlim(0.3, len(order) + 0.7)
    axes.grid(visible=False, axis="x")
    axes.xaxis.set_major_locator(MaxNLocator(10, integer=True, min_n_ticks=1))
    axes.yaxis.set_major_locator(LogLocator(10.0))
    axes.yaxis.set_major_formatter(PERCENT)
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("measured cells, worst first")
    axes.set_ylabel("light that the set misses")
    draw_legend(axes, handle=1.2)


def draw_trades(axes: Axes, theme: Theme, quality: Quality) -> None:
    """Draw PSNR by the megabytes sent for a cell, as faint classes are dropped, with the ceiling."""
    trades = quality.trades()
    x = [each.bytes / 1e6 for each in trades]
    mean = [each.psnr for each in trades]
    worst = [each.psnr_worst for each in trades]
    axes.fill_between(x, worst, mean, color=theme.gathered, alpha=0.18, linewidth=0)
    axes.plot(x, mean, color=theme.gathered, marker="o", markersize=6, linewidth=2.0, label="mean of the images")
    axes.plot(x, worst, color=theme.gathered, marker=".", linewidth=1.2, linestyle=(0, (3, 2)), label="worst image")
    ceiling = float(quality.ceiling.mean())
    top = max(mean)
    target = TARGETS["psnr"][0]
    assert target is not None
    draw_level(axes, theme, ceiling, f"exactly what an image shows {ceiling:.1f} dB", theme.traced, left=True)
    if abs(ceiling - target) > 0.06 * max(top, ceiling):
        draw_level(axes, theme, target, f"target of the mean {target:g} dB", theme.published, left=True)
    for each, size in zip(trades, x, strict=True):
        beyond = size < 0.3 * max(x)  # no room for text on its left
        axes.annotate(
            "whole set" if each.least_class == 0 else f"from {each.least_weight:.2g}",
            (size, each.psnr),
            xytext=(8, -3) if beyond else (-7, 2),
            textcoords="offset points",
            ha="left" if beyond else "right",
            va="top" if beyond else "bottom",
            fontsize=9,
            bbox={"facecolor": theme.paper, "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
        )
    axes.set_xlim(0.0, 1.06 * max(max(x), 1e-9))
    axes.set_ylim(0.0, 1.14 * max(ceiling, target, top))
    axes.xaxis.set_major_locator(MaxNLocator(7))
    axes.set_xlabel("megabytes sent for a cell, on average")
    axes.set_ylabel("PSNR against the full scene, dB")
    draw_legend(axes)


def _draw_bars(axes: Axes, values: F64, color: str) -> None:
    """Draw bars without gaps, from the first to the last."""
    edges = np.arange(len(values) + 1) + 0.5
    axes.stairs(values, edges, fill=True, color=color, linewidth=0)
    axes.set_xlim(0.5, len(values) + 0.5)
    axes.grid(visible=False, axis="x")
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True, min_n_ticks=1))
