"""One held-out view by every method at every size, on one sheet; those of real scenes are to be looked at, not kept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from levels import Rivals

__all__ = ["write_sheet"]

_WIDTH, _DPI = 3.0, 110  # inches of an image


def write_sheet(path: Path, made: Rivals, rows: list[dict[str, Any]], methods: Sequence[str], view: int) -> None:
    """Write a PNG: a row for each size, the target first, then each method with the PSNR of this view.

    Args:
        path: The file.
        made: Gives the images.
        rows: Numbers of each size and method, with `each_psnr`.
        methods: Columns.
        view: Which held-out view.
    """
    shares = sorted({row["share"] for row in rows})
    target = made.case.target[view]
    height = _WIDTH * target.shape[0] / target.shape[1]
    figure = Figure(
        figsize=(_WIDTH * (1 + len(methods)), (height + 0.35) * len(shares)), dpi=_DPI, layout="constrained"
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(shares), 1 + len(methods), squeeze=False)
    found = {(row["share"], row["method"]): row for row in rows}
    for line, share in zip(axes, shares, strict=True):
        for place in line:
            place.set_axis_off()
        line[0].imshow(target)
        line[0].set_title(f"{made.case.against}; {share:.1%} of it:", fontsize=9)
        for place, method in zip(line[1:], methods, strict=True):
            if (row := found.get((share, method))) is not None:
                place.imshow(made.images(method, share, slice(view, view + 1))[1][0])
                place.set_title(f"{method}, {row['each_psnr'][view]:.1f} dB", fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
