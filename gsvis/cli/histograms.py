"""Histograms as lines of text: bars that fit 80 columns, in ASCII where the encoding has no blocks."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Sequence

from gsvis.scene.histograms import Band, Histogram

__all__ = ["TITLES", "band_lines", "can_draw_blocks", "histogram_lines", "line_width"]

_EIGHTHS = "▏▎▍▌▋▊▉█"
_LABEL = 20
_SHARE = 7

TITLES = {
    "opacity": "opacity",
    "log10_scale": "largest scale, scene units",
    "log10_anisotropy": "largest scale over smallest",
    "log10_distance": "distance from the median center, scene units",
}
"""Heads of the histograms by their names."""


def can_draw_blocks() -> bool:
    """Return whether standard output can show block characters."""
    try:
        _EIGHTHS.encode(sys.stdout.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def line_width() -> int:
    """Return the columns of a line: 79, or fewer on a narrower terminal."""
    return max(40, min(80, shutil.get_terminal_size().columns if sys.stdout.isatty() else 80) - 1)


def histogram_lines(name: str, found: Histogram, *, width: int = 79, blocks: bool = True) -> Iterator[str]:
    """Yield a head and a line for each bin; bins without Gaussians at the ends of an open side are left out.

    Args:
        name: A key of `TITLES`; names that begin with log10 are labeled by the values, not by their logarithms.
        found: The histogram.
        width: Most columns of a line.
        blocks: Draw with block characters; else with ASCII.
    """
    is_log = name.startswith("log10")
    middle = "" if found.median is None else f"; median {_value(found.median, is_log)}"
    yield f" {TITLES[name]}{middle}"
    labels = [_value(edge, is_log) for edge in found.edges]
    rows = [(f"{a:>8} to {b:<8}", n) for a, b, n in zip(labels, labels[1:], found.counts, strict=False)]
    rows = [(f"{'below':>8}    {labels[0]:<8}", found.below)] * bool(found.below) + rows
    rows += [(f"{'above':>8}    {labels[-1]:<8}", found.above)] * bool(found.above)
    yield from _bars(rows, width, blocks)


def band_lines(bands: Sequence[Band], *, width: int = 79, blocks: bool = True) -> Iterator[str]:
    """Yield a head and a line for each SH band.

    Args:
        bands: What `measure_bands` found.
        width: Most columns of a line.
        blocks: Draw with block characters; else with ASCII.
    """
    yield " color in each SH band, root mean square in [0, 1] units"
    most = max((band.rms for band in bands), default=0.0)
    size = width - _LABEL - _SHARE - 4
    for band in bands:
        label = "0, from gray" if band.band == 0 else str(band.band)
        drawn = _bar(band.rms / most if most else 0.0, size, blocks)
        yield f" {label:>{_LABEL}}  {drawn:<{size}} {band.rms:{_SHARE}.3f}".rstrip()


def _bars(rows: list[tuple[str, int]], width: int, blocks: bool) -> Iterator[str]:
    """Yield a line with a bar for each row."""
    total = sum(n for _, n in rows) or 1
    most = max((n for _, n in rows), default=0) or 1
    size = width - _LABEL - _SHARE - 4
    for label, n in rows:
        share = "0" if n == 0 else "<0.1%" if n / total < 0.0005 else f"{n / total:.1%}"
        yield f" {label:<{_LABEL}}  {_bar(n / most, size, blocks):<{size}} {share:>{_SHARE}}"


def _bar(share: float, size: int, blocks: bool) -> str:
    """Return a bar of at most `size` characters; something is seen of any share above 0."""
    if share <= 0.0:
        return ""
    if not blocks:
        return "#" * round(share * size) or "."
    eighths = max(1, round(share * size * 8))
    return _EIGHTHS[-1] * (eighths // 8) + (_EIGHTHS[eighths % 8 - 1] if eighths % 8 else "")


def _value(edge: float, is_log: bool) -> str:
    """Return an edge as text; a logarithm as the value that it is of."""
    value = 10.0 ** min(edge, 300.0) if is_log else edge
    return f"{value:,.0f}" if 99.5 <= value < 1e5 else f"{value:.2g}"
