"""Draw the plots of a report on simulated sessions: figures 9 to 14 of the paper, and the first seconds alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from gsvis.abr.qoe import FIRST_FRAME_DB
from gsvis.abr.traces import BYTES, BandwidthTrace
from gsvis.report.session_page import PAPER_SENT
from gsvis.report.theme import PERCENT, Theme, draw_legend, draw_level
from gsvis.simulate.viewing import GOOD_DB, Viewing

__all__ = [
    "draw_bandwidth",
    "draw_bytes",
    "draw_latency",
    "draw_psnr",
    "draw_score",
    "draw_shares",
    "draw_start",
]

F64 = NDArray[np.float64]
Visits = Sequence[Sequence[Viewing]]


def draw_score(axes: Axes, theme: Theme, visits: Visits) -> None:
    """Draw the QoE of each step, all systems (figure 9)."""
    _over_time(axes, theme, visits, lambda session: session.score)
    axes.set_ylim(-5.3, 1.3)
    axes.set_ylabel("QoE of a step")


def draw_psnr(axes: Axes, theme: Theme, visits: Visits) -> None:
    """Draw PSNR of the shown images (figure 10)."""
    _over_time(axes, theme, visits, lambda session: session.psnr)
    scale = visits[0][0].config.qoe.psnr_scale
    axes.set_ylim(-0.02 * scale, 1.06 * scale)
    axes.set_ylabel("PSNR, dB")


def draw_latency(axes: Axes, theme: Theme, visits: Visits) -> None:
    """Draw the time from a pose until it is shown (figure 11)."""
    _over_time(axes, theme, visits, lambda session: session.latency)
    scale = visits[0][0].config.qoe.latency_scale
    axes.set_ylim(-0.03 * scale, 1.08 * scale)
    axes.set_ylabel("latency, seconds")


def draw_bandwidth(axes: Axes, theme: Theme, visits: Visits, trace: BandwidthTrace) -> None:
    """Draw the rate of the link (figure 12), means over half seconds."""
    end = visits[0][0].config.seconds * len(visits)
    edges = np.linspace(0.0, end, max(round(2 * end), 1) + 1)
    rates = [trace.bytes_between(a, b) / (b - a) / BYTES for a, b in pairwise(edges.tolist())]
    axes.stairs(rates, edges, color=theme.muted, fill=True, alpha=0.35, linewidth=0)
    axes.stairs(rates, edges, color=theme.muted, linewidth=1.4, baseline=None)
    _scenes(axes, theme, visits)
    axes.set_xlim(0.0, end)
    axes.set_ylim(0.0, 1.12 * max(*rates, 1e-6))
    axes.set_xlabel("seconds")
    axes.set_ylabel("Mbit/s")


def draw_start(axes: Axes, theme: Theme, visits: Visits) -> None:
    """Draw PSNR in the first seconds of the first scene, with the two target qualities."""
    end = min(max(visits[0][0].config.fine, 1.0), visits[0][0].config.seconds)
    for session, (color, style) in zip(visits[0], _styles(theme), strict=False):
        seen = _with_content(session, session.psnr)
        times = np.append(session.times, session.config.seconds)
        values = np.append(seen, seen[-1])
        axes.step(times, values, where="post", color=color, linestyle=style, linewidth=2.0, label=session.playback.name)
    for level, label in ((FIRST_FRAME_DB, "a first image"), (GOOD_DB, "a good one")):
        draw_level(axes, theme, level, f"{label}, {level:g} dB", theme.muted)
    axes.set_xlim(0.0, end)
    axes.set_ylim(-1.0, 1.06 * visits[0][0].config.qoe.psnr_scale)
    axes.set_xlabel("seconds since the scene was asked for")
    axes.set_ylabel("PSNR, dB")
    draw_legend(axes, 3)


def draw_shares(axes: Axes, theme: Theme, visits: Visits) -> None:
    """Draw the shares of Gaussians and of SRBFs that the first system has sent (figure 13), beside the paper's."""
    terms = False
    for k, sessions in enumerate(visits):
        session = sessions[0]
        p = session.playback
        times = np.append(session.times, session.config.seconds)
        dashes = "-" if k == 0 else (0, (4, 2))
        after = "" if len(visits) == 1 else f", scene {k + 1}"
        share = p.gaussians_at(times) / max(len(p.gaussian_at), 1)
        axes.plot(times, share, color=theme.gathered, linestyle=dashes, linewidth=2.0, label=f"Gaussians{after}")
        if len(p.term_at):
            terms = True
            share = p.terms_at(times) / len(p.term_at)
            axes.plot(times, share, color=theme.traced, linestyle=dashes, linewidth=2.0, label=f"SRBFs{after}")
    marks = [(30.0, PAPER_SENT["gaussians"], "paper's Gaussians")]
    if terms:
        marks += [(30.0, PAPER_SENT["terms"], "paper's SRBFs"), (0.0, PAPER_SENT["terms_first"], "")]
    end = visits[0][0].config.seconds
    for x, y, label in marks:
        if x > end + 1e-9:
            continue
        axes.plot([x], [y], marker="D", markersize=7, color=theme.published, clip_on=False, zorder=5, linestyle="none")
        if label:
            axes.annotate(
                f"{label} {y:.1%}",
                (x, y),
                xytext=(-9, 0),
                textcoords="offset points",
                ha="right",
                va="center",
                color=theme.published,
                fontsize=9,
                fontweight="bold",
                bbox={"facecolor": theme.paper, "edgecolor": "none", "alpha": 0.75, "pad": 0.5},
            )
    axes.set_xlim(0.0, end)
    axes.set_ylim(0.0, 1.03)
    axes.yaxis.set_major_formatter(PERCENT)
    axes.set_xlabel("seconds since the scene was asked for")
    axes.set_ylabel("share sent")
    draw_legend(axes, handle=2.2)


def draw_bytes(axes: Axes, theme: Theme, visits: Visits) -> None:
    """Draw the megabytes that have arrived, all systems (figure 14), and the capacity of the link."""
    top = 0.0
    start = 0.0
    for k, sessions in enumerate(visits):
        for session, (color, style) in zip(sessions, _styles(theme), strict=False):
            times = np.append(session.times, session.config.seconds)
            values = session.playback.bytes_at(times) / 1e6
            top = max(top, float(values.max()))
            label = session.playback.name if k == 0 else None
            axes.plot(start + times, values, color=color, linestyle=style, linewidth=2.0, label=label)
        start += sessions[0].config.seconds
    _scenes(axes, theme, visits)
    axes.set_xlim(0.0, start)
    axes.set_ylim(0.0, 1.08 * max(top, 1e-6))
    axes.set_xlabel("seconds")
    axes.set_ylabel("megabytes arrived")
    draw_legend(axes, 3)


def _over_time(axes: Axes, theme: Theme, visits: Visits, value: Callable[[Viewing], F64]) -> None:
    """Draw a value of each step of all systems, scene after scene."""
    start = 0.0
    for k, sessions in enumerate(visits):
        for session, (color, style) in zip(sessions, _styles(theme), strict=False):
            times = np.append(session.times, session.config.seconds)
            values = _with_content(session, value(session))
            axes.step(
                start + times,
                np.append(values, values[-1]),
                where="post",
                color=color,
                linestyle=style,
                linewidth=2.0,
                label=session.playback.name if k == 0 else None,
            )
        start += sessions[0].config.seconds
    _scenes(axes, theme, visits)
    axes.set_xlim(0.0, start)
    axes.xaxis.set_major_locator(MaxNLocator(7))
    axes.set_xlabel("seconds")
    draw_legend(axes, 3)


def _with_content(session: Viewing, values: F64) -> F64:
    """Return (S,) values of the steps, NaN if a view shows nothing: a gap in the curve."""
    return np.where(session.content, values, np.nan)


def _scenes(axes: Axes, theme: Theme, visits: Visits) -> None:
    """Mark the start of each new scene."""
    for k in range(1, len(visits)):
        at = k * visits[0][0].config.seconds
        axes.axvline(at, color=theme.ink, linewidth=1.0, dashes=(2, 2))
        axes.annotate(
            "a new scene",
            (at, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(3, 1),
            textcoords="offset points",
            ha="left",
            va="bottom",
            fontsize=9,
            color=theme.muted,
        )


def _styles(theme: Theme) -> list[tuple[str, Any]]:
    """Return color and line style of each system."""
    colors = (theme.gathered, theme.published, theme.traced, theme.muted)
    styles = ("-", (0, (4, 2)), (0, (1, 1)))
    return [(color, style) for style in styles for color in colors]
