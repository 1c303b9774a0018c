"""Draw the plots of a report: visible fraction of each camera, the direction CDF, and whether it has settled."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator, PercentFormatter

from gsvis.raycast.analysis import PAPER, Analysis, DirectionCdf
from gsvis.report.theme import PERCENT, Theme, draw_legend, draw_level

__all__ = ["draw_cdf", "draw_settling", "draw_visible"]

_BARS = 48  # more cameras are drawn as one sorted curve

_PAPER_POINTS = ((33, PAPER["below_33_faces"]), (48, PAPER["below_48_faces"]))


def draw_visible(axes: Axes, theme: Theme, analysis: Analysis, *, published: bool) -> None:
    """Draw the visible fraction of each camera, highest first, with the mean and, if `published`, the paper's mean."""
    fractions = np.sort(analysis.visible_fractions)[::-1]
    count = len(fractions)
    if count <= _BARS:
        axes.bar(np.arange(1, count + 1), fractions, width=0.72, color=theme.gathered)
        axes.set_xlim(0.3, count + 0.7)
        axes.xaxis.set_major_locator(FixedLocator([1, *range(4, count + 1, 4)] if count > 8 else range(1, count + 1)))
    else:
        axes.fill_between(np.arange(1, count + 1), fractions, step="mid", color=theme.gathered, linewidth=0)
        axes.set_xlim(1, count)
    mean = float(fractions.mean())
    paper = PAPER["mean_visible"]
    top = max(float(fractions.max()), paper if published else 0.0, 1e-6)
    axes.set_ylim(0.0, 1.22 * top)
    apart = abs(mean - paper) > 0.08 * top or not published
    lines = [(mean, f"mean here {mean:.1%}", theme.traced, mean > paper or apart)]
    if published:
        lines.append((paper, f"paper's mean {paper:.2%}", theme.published, paper >= mean or apart))
    for value, text, color, above in lines:
        draw_level(axes, theme, value, text, color, above=above)
    axes.grid(visible=False, axis="x")
    axes.yaxis.set_major_formatter(PERCENT)
    axes.set_xlabel("cameras, sorted")
    axes.set_ylabel("visible share of all Gaussians")


def draw_cdf(axes: Axes, theme: Theme, analysis: Analysis, *, published: bool) -> None:
    """Draw the CDF of direction counts, gathered and traced; if `published`, with the paper's two points."""
    gathered = analysis.gathered
    traced = analysis.traced
    if traced is not None:
        _curve(axes, traced, theme.traced, "traced outward")
    if traced is None or analysis.has_settled:  # else it shows how many cameras there were
        unsettled = "" if analysis.has_settled else ", not settled"
        _curve(axes, gathered, theme.gathered, f"from {len(analysis.cameras):,} cameras{unsettled}")
    axes.plot([], [], color=theme.muted, linestyle=(0, (3, 2)), linewidth=1.4, label="of those seen at all")
    if analysis.solid_angles is not None:
        below = np.sort(analysis.solid_angles)
        shares = np.arange(1, len(below) + 1) / len(below)
        axes.plot(below, shares, color=theme.ink, linestyle=(0, (1, 1)), linewidth=1.8, label="traced, by solid angle")
    if published:
        _paper_points(axes, theme)
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 1.02)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("share of the 80 directions")
    axes.set_ylabel("Gaussians seen from less")
    draw_legend(axes)


def _paper_points(axes: Axes, theme: Theme) -> None:
    """Draw the two points of the curve that the paper states."""
    axes.plot(
        *np.array([(k / 80.0, share) for k, share in _PAPER_POINTS]).T,
        linestyle="none",
        marker="D",
        markersize=7,
        color=theme.published,
        markeredgecolor=theme.paper,
        label="paper",
        zorder=5,
    )
    for faces, share in _PAPER_POINTS:
        axes.annotate(
            f"{share:.1%} below {100.0 * faces / 80.0:g}%",
            (faces / 80.0, share),
            xytext=(9, -5),
            textcoords="offset points",
            va="top",
            color=theme.published,
            fontsize=9,
            fontweight="bold",
            bbox={"facecolor": theme.paper, "edgecolor": "none", "alpha": 0.75, "pad": 0.5},
        )


def _curve(axes: Axes, cdf: DirectionCdf, color: str, label: str) -> None:
    """Draw a CDF of direction fractions: of all Gaussians, and dashed of those seen."""
    x = np.arange(82) / 80.0
    for values, style, width in ((cdf.values, "-", 2.2), (cdf.values_of_seen, (0, (3, 2)), 1.4)):
        below = np.concatenate([[0.0], values])
        axes.plot(x[:81], below[:81], color=color, linestyle=style, linewidth=width, label=label if width > 2 else None)


def draw_settling(axes: Axes, theme: Theme, analysis: Analysis) -> None:
    """Draw the two shares of the gathered CDF after part of the cameras."""
    steps = analysis.settling
    cameras = [step.cameras for step in steps]
    lines = (
        ("below 60%, of all", [s.below_48_of_all for s in steps], theme.traced, "-"),
        ("below 60%, of seen", [s.below_48_of_seen for s in steps], theme.traced, (0, (3, 2))),
        ("below 41.25%, of all", [s.below_33_of_all for s in steps], theme.gathered, "-"),
        ("below 41.25%, of seen", [s.below_33_of_seen for s in steps], theme.gathered, (0, (3, 2))),
    )
    for label, values, color, style in lines:
        axes.plot(cameras, values, color=color, linestyle=style, linewidth=1.8, marker="o", markersize=4, label=label)
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_locator(FixedLocator(cameras))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{round(value):,}"))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylim(0.0, 1.04)
    axes.set_xlabel("number of cameras, taken in random order")
    axes.set_ylabel("Gaussians seen from less")
    draw_legend(axes)
