"""Draw the plots of a report on colors: numbers of terms, the gain by terms, the effect of epsilon, and bytes."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from gsvis.prepare.color_quality import ColorQuality
from gsvis.prepare.fitted_colors import FittedColors
from gsvis.report.theme import PERCENT, Theme, draw_legend, draw_level

__all__ = [
    "ACTIVE_TARGET",
    "PAPER_EPSILONS",
    "draw_active",
    "draw_active_psnr",
    "draw_bytes",
    "draw_first_terms",
    "draw_term_counts",
]

F64 = NDArray[np.float64]

PAPER_EPSILONS = (0.01, 0.05)
"""Range of the paper's epsilons (SRBF-Gaussian, section 6.2)."""
ACTIVE_TARGET = 45.0
"""Target PSNR in dB of active terms against all terms."""


def draw_term_counts(axes: Axes, theme: Theme, fitted: FittedColors) -> None:
    """Draw the share of Gaussians with each number of terms, beside their share of the image content."""
    gaussians = fitted.by_count
    importance = fitted.importance_by_count
    at = np.arange(len(gaussians))
    axes.bar(at - 0.2, gaussians, width=0.4, color=theme.gathered, label="of the Gaussians")
    axes.bar(at + 0.2, importance, width=0.4, color=theme.traced, label="of what images show of them")
    top = max(float(gaussians.max()), float(importance.max()))
    if len(at) > 4:
        axes.axvspan(0.5, 4.5, color=theme.grid, alpha=0.55, linewidth=0, zorder=0)
        axes.annotate(
            "paper: 1 to 4 in most cases",
            (2.5, 1.13 * top),
            ha="center",
            va="top",
            color=theme.published,
            fontsize=9,
            fontweight="bold",
        )
    axes.set_ylim(0.0, 1.15 * top)
    axes.set_xlim(-0.6, len(at) - 0.4)
    axes.grid(visible=False, axis="x")
    axes.xaxis.set_major_locator(MaxNLocator(12, integer=True, min_n_ticks=1))
    axes.yaxis.set_major_formatter(PERCENT)
    axes.set_xlabel("terms of a Gaussian, over all its functions")
    axes.set_ylabel("share")
    draw_legend(axes, handle=1.2)


def draw_first_terms(axes: Axes, theme: Theme, quality: ColorQuality) -> None:
    """Draw PSNR against SH by the number of received terms of each Gaussian."""
    counts = quality.counts
    found = quality.psnr_by_count
    mean = found.mean(axis=1)
    worst = found.min(axis=1)
    x = np.arange(len(counts))
    axes.fill_between(x, worst, mean, color=theme.gathered, alpha=0.18, linewidth=0)
    axes.plot(x, mean, color=theme.gathered, marker="o", markersize=6, linewidth=2.0, label="mean of the views")
    axes.plot(x, worst, color=theme.gathered, marker=".", linewidth=1.2, linestyle=(0, (3, 2)), label="worst view")
    for place in {0, len(x) - 1}:
        axes.annotate(
            f"{mean[place]:.1f} dB",
            (place, mean[place]),
            xytext=(-4, 13) if place == 0 else (0, 7),
            textcoords="offset points",
            ha="left" if place == 0 else "right",
            va="bottom",
            fontsize=9,
            fontweight="bold",
            color=theme.gathered,
        )
    low = float(worst.min())
    high = float(mean.max())
    axes.set_ylim(max(0.0, low - 0.12 * (high - low) - 1.0), high + 0.14 * (high - low) + 1.0)
    axes.set_xlim(-0.35, len(x) - 0.65)
    labels = [f"{k}\n{m:.2f}" for k, m in zip(counts, quality.mean_terms, strict=True)]
    axes.xaxis.set_major_locator(FixedLocator(x.tolist()))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: labels[min(max(round(value), 0), len(labels) - 1)]))
    axes.set_xlabel("first terms of each Gaussian; below, what that is on average")
    axes.set_ylabel("PSNR against SH, dB")
    draw_legend(axes)


def draw_active(axes: Axes, theme: Theme, quality: ColorQuality, epsilon: float | None) -> None:
    """Draw the share of terms that are active for an eye, by epsilon."""
    shares = quality.active_shares
    _by_epsilon(axes, theme, quality.epsilons, shares.mean(axis=1), (shares.min(axis=1), shares.max(axis=1)))
    axes.set_ylim(0.0, max(1.05 * float(shares.max()), 1e-3))
    axes.yaxis.set_major_formatter(PERCENT)
    axes.set_ylabel("active terms of all terms")
    _mark_epsilon(axes, theme, epsilon)


def draw_active_psnr(axes: Axes, theme: Theme, quality: ColorQuality, epsilon: float | None) -> None:
    """Draw PSNR of active terms against all terms, by epsilon."""
    found = quality.active_psnr
    _by_epsilon(axes, theme, quality.epsilons, found.mean(axis=1), (found.min(axis=1), found.max(axis=1)))
    draw_level(axes, theme, ACTIVE_TARGET, f"target {ACTIVE_TARGET:g} dB", theme.traced, above=False, left=True)
    low = min(float(found.min()), ACTIVE_TARGET)
    high = max(float(found.max()), ACTIVE_TARGET)
    axes.set_ylim(max(0.0, low - 0.1 * (high - low)), high + 0.08 * (high - low))
    axes.set_ylabel("PSNR against all terms, dB")
    _mark_epsilon(axes, theme, epsilon)


def draw_bytes(axes: Axes, theme: Theme, fitted: FittedColors) -> None:
    """Draw the bytes of the color of a Gaussian: records, their bases alone, and SH."""
    sizes = fitted.sizes()
    rows = [
        ("SH, 32 bits", sizes["sh_32"], theme.hidden),
        ("SH, 16 bits", sizes["sh_16"], theme.hidden),
        ("SH, 8 bits", sizes["sh_8"], theme.hidden),
        ("base and all terms", sizes["records"], theme.gathered),
        ("base alone", sizes["base"], theme.gathered),
    ]
    at = np.arange(len(rows))[::-1]
    values = [value for _, value, _ in rows]
    axes.barh(at, values, height=0.66, color=[color for _, _, color in rows])
    for place, value in zip(at, values, strict=True):
        axes.annotate(f"{value:.1f}", (value, place), xytext=(4, 0), textcoords="offset points", va="center")
    axes.set_xlim(0.0, 1.12 * max(values))
    axes.grid(visible=False, axis="y")
    axes.yaxis.set_major_locator(FixedLocator(at.tolist()))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: rows[len(rows) - 1 - round(value)][0]))
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel("bytes of the color of a Gaussian")


def _by_epsilon(axes: Axes, theme: Theme, epsilons: F64, mean: F64, spread: tuple[F64, F64]) -> None:
    """Draw a mean and its spread over epsilon, with the paper's range of epsilons behind."""
    axes.axvspan(*PAPER_EPSILONS, color=theme.published, alpha=0.13, linewidth=0)
    axes.fill_between(epsilons, *spread, color=theme.gathered, alpha=0.18, linewidth=0)
    axes.plot(epsilons, mean, color=theme.gathered, marker="o", markersize=5, linewidth=2.0)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(10.0))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("epsilon: change of color from which a term counts")


def _mark_epsilon(axes: Axes, theme: Theme, epsilon: float | None) -> None:
    """Label the bands above the plot, and draw the epsilon of this scene as a line."""
    axes.fill_between([], [], [], color=theme.published, alpha=0.2, linewidth=0, label="the paper's epsilons")
    if epsilon is not None:
        axes.axvline(epsilon, color=theme.ink, linewidth=1.4, dashes=(4, 2), label=f"here {epsilon:.3g}")
    draw_legend(axes, handle=1.6)
