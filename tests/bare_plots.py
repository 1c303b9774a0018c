"""Plots of reports without axes and words, which take most of the time to draw."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

__all__ = ["draw_bare_plots"]


@contextmanager
def draw_bare_plots() -> Iterator[None]:
    """Draw what the plots of reports show, and nothing around it."""
    from gsvis.report import theme

    draw_png = theme.draw_png

    def drawn(
        draw: Callable[..., None], colors: theme.Theme = theme.LIGHT, size: tuple[float, float] = (5, 3)
    ) -> bytes:
        def draw_marks(axes: Any, colors: theme.Theme) -> None:
            draw(axes, colors)
            axes.set_axis_off()
            for part in (axes.xaxis, axes.yaxis, axes.title, axes.get_legend(), *axes.texts):
                if part is not None:
                    part.set_visible(False)

        return draw_png(draw_marks, colors, size)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(theme, "draw_png", drawn)
        yield
