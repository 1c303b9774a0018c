"""Paint a scene by a quantity, for any viewer: the same shapes, in plain colors of a ramp or a palette.

Unseen Gaussians are gray. The legend lists the colors, as text and as an image.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsvis.color.oklab import palette, ramp
from gsvis.edit.quantities import Quantity
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0

if TYPE_CHECKING:
    from PIL import Image

__all__ = ["UNSEEN", "Band", "bands_of", "colors_of", "draw_legend", "paint"]

F64 = NDArray[np.float64]

UNSEEN = (0.5, 0.5, 0.5)
"""sRGB of unseen Gaussians."""

_BANDS = 6  # of a ramp
_CELLS = 8  # of a palette: those with most Gaussians
_TICKS = 5
# pixels of the picture
_WIDTH = 720
_BAR = 36
_MARGIN = 24
_LINE = 30
_INK = (28, 36, 48)
_PAPER = (255, 255, 255)


@dataclass(frozen=True)
class Band:
    """One line of a legend.

    Attributes:
        color: sRGB, each channel in [0, 1].
        text: The values with about this color.
        count: Number of Gaussians with these values.
    """

    color: tuple[float, float, float]
    text: str
    count: int

    @property
    def hex(self) -> str:
        """The color as #rrggbb."""
        return "#" + "".join(f"{round(255 * channel):02x}" for channel in self.color)


def paint(g: Gaussians, quantity: Quantity) -> Gaussians:
    """Return a scene in the colors of a quantity: the same shapes and opacities, SH degree 0.

    Args:
        g: The scene, N Gaussians.
        quantity: A value for each of them.

    Raises:
        ValueError: If the number of values is not that of the Gaussians.
    """
    if len(quantity) != len(g):
        raise ValueError(
            f"quantity: expected {len(g):,} values, one for each Gaussian, got {len(quantity):,}; was"
            " it measured on this scene?"
        )
    sh0 = ((colors_of(quantity) - 0.5) / SH_C0).astype(np.float32)[:, None]
    return Gaussians(g.means, g.quats, g.scales, g.opacities, sh0, facts=g.facts)


def colors_of(quantity: Quantity) -> F64:
    """Return (N, 3) sRGB in [0, 1]."""
    colors = np.tile(np.array(UNSEEN), (len(quantity), 1))
    values = quantity.values[quantity.seen]
    if quantity.cells:
        colors[quantity.seen] = palette(quantity.cells)[values.astype(np.int64)]
    else:
        colors[quantity.seen] = ramp(quantity.parts(values))
    return colors


def bands_of(quantity: Quantity) -> list[Band]:
    """Return the lines of a legend: ranges of ascending values, or the largest cells; the unseen last."""
    seen = quantity.values[quantity.seen]
    if quantity.cells:
        counts = np.bincount(seen.astype(np.int64), minlength=quantity.cells)
        largest = np.argsort(-counts, kind="stable")[:_CELLS]
        shades = palette(quantity.cells)
        found = [Band(_triple(shades[k]), f"cell {k}", int(counts[k])) for k in largest.tolist() if counts[k]]
        rest = len(seen) - sum(each.count for each in found)
        if rest:
            others = int(np.count_nonzero(counts)) - len(found)
            found.append(Band((1.0, 1.0, 1.0), f"{others:,} other cells, each in its own color", rest))
    else:
        numbers = np.minimum((quantity.parts(seen) * _BANDS).astype(int), _BANDS - 1)
        counts = np.bincount(numbers, minlength=_BANDS)
        shades = ramp((np.arange(_BANDS) + 0.5) / _BANDS)
        edges = [_spell(quantity, k / _BANDS) for k in range(_BANDS + 1)]
        found = [Band(_triple(shades[k]), f"{edges[k]} to {edges[k + 1]}", int(counts[k])) for k in range(_BANDS)]
    unseen = len(quantity) - len(seen)
    return [*found, Band(UNSEEN, quantity.unseen, unseen)]


def draw_legend(quantity: Quantity) -> bytes:
    """Return the legend as the bytes of a PNG: the ramp with its values, or the colors of cells, and the unseen."""
    from PIL import Image, ImageDraw, ImageFont

    bands = bands_of(quantity)
    listed = bands if quantity.cells else bands[-1:]
    height = 2 * _MARGIN + _LINE * (1 + len(listed)) + (0 if quantity.cells else _BAR + 2 * _LINE)
    picture = Image.new("RGB", (_WIDTH, height), _PAPER)
    pen = ImageDraw.Draw(picture)
    font = ImageFont.load_default(18)
    title = f"{quantity.name}: {quantity.label}"
    pen.text((_MARGIN, _MARGIN), title, _INK, font)
    top = _MARGIN + _LINE
    if not quantity.cells:
        across = _WIDTH - 2 * _MARGIN
        row = np.rint(255.0 * ramp(np.linspace(0.0, 1.0, across))).astype(np.uint8)
        picture.paste(_image(np.repeat(row[None], _BAR, axis=0)), (_MARGIN, top + 4))
        for k in range(_TICKS):
            part = k / (_TICKS - 1)
            anchor = "la" if k == 0 else "ra" if k == _TICKS - 1 else "ma"
            pen.text((_MARGIN + part * across, top + _BAR + 8), _spell(quantity, part), _INK, font, anchor)
        top += _BAR + 2 * _LINE
    for band in listed:
        pen.rectangle((_MARGIN, top + 4, _MARGIN + 36, top + 22), band.hex, _INK)
        pen.text((_MARGIN + 48, top), f"{band.text}: {band.count / max(1, len(quantity)):.1%}", _INK, font)
        top += _LINE
    out = io.BytesIO()
    picture.save(out, "PNG")
    return out.getvalue()


def _image(pixels: NDArray[np.uint8]) -> Image.Image:
    """Return pixels as an image."""
    from PIL import Image

    return Image.fromarray(pixels)


def _spell(quantity: Quantity, part: float) -> str:
    """Return the value at a share of the ramp as text."""
    value = quantity.value_at(part)
    if quantity.name == "visibility":
        return f"{value:.0%}"
    return f"{value:.0f}" if quantity.name == "directions" else f"{value:.2g}"


def _triple(color: F64) -> tuple[float, float, float]:
    """Return a color as a tuple."""
    red, green, blue = color.tolist()
    return red, green, blue
