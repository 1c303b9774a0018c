"""Draw on a plan with Pillow: where eyes may be, dots, lines, arrows, a scale bar; its colors and its font.

Lines are drawn at twice the size and made smaller, so that they are smooth. Needs no matplotlib.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gsvis.report.frames import eight_bit
from gsvis.report.plan import Plan, nice_length
from gsvis.scene.cameras import Cameras
from gsvis.scene.navigable import NavigableSpace

__all__ = ["ALL", "COLORS", "GIVEN", "INK", "MUTED", "PAPER", "Color", "Marks", "blend", "font", "picture"]

F64 = NDArray[np.float64]
Color = tuple[int, int, int]
Font = ImageFont.FreeTypeFont | ImageFont.ImageFont

PAPER: Color = (255, 255, 255)
INK: Color = (28, 36, 48)
MUTED: Color = (90, 100, 116)
ALL: Color = (96, 106, 122)
"""The color of eyes of any reading."""
GIVEN: Color = (176, 18, 111)
"""The color of what was given: cameras, a walk."""
COLORS: tuple[Color, ...] = ((36, 99, 214), (210, 96, 10), (20, 130, 80))
"""The colors of readings; they differ for any color vision."""

_FINE = 2
_ARROW = 0.1  # length of an arrow, in the side of the plan
_BAR = 0.25  # greatest length of the scale bar, in the side of the plan
_FADED = 0.75  # of the colors of the scene that remain


class Marks:
    """A plan that is drawn on.

    Args:
        plan: The frame.
        ground: (H, W, 3) the plan itself, in [0, 1].
    """

    def __init__(self, plan: Plan, ground: NDArray[np.float32]) -> None:
        self.plan = plan
        side = _FINE * plan.pixels
        faded = picture((1.0 - _FADED) + _FADED * ground)
        self.image = faded.resize((side, side), Image.Resampling.BICUBIC)

    def shade(self, space: NavigableSpace, color: Color, strength: float) -> None:
        """Tint where an eye may be, and draw the edge of it."""
        from scipy import ndimage

        covered = self.plan.covered(space)
        alpha = strength * covered.astype(np.float64)
        alpha[covered & ~ndimage.binary_erosion(covered, iterations=2, border_value=1)] = 0.9
        mask = Image.fromarray(np.rint(255.0 * alpha).astype(np.uint8)).resize(
            self.image.size, Image.Resampling.BICUBIC
        )
        self.image.paste(color, (0, 0), mask)

    def dots(self, points: F64, color: Color, radius: float) -> None:
        """Draw dots at points (P, 3); the radius is in pixels."""
        pen = ImageDraw.Draw(self.image)
        size = _FINE * radius
        for x, y in self._at(points):
            pen.ellipse((x - size, y - size, x + size, y + size), color, PAPER, 1)

    def line(self, points: F64, color: Color) -> None:
        """Draw a line through points (P, 3)."""
        ImageDraw.Draw(self.image).line(self._at(points), color, 2 * _FINE, "curve")

    def forward(self, view: Cameras, color: Color, name: str) -> None:
        """Draw a camera as a dot, with its name in it, and an arrow to where it looks."""
        pen = ImageDraw.Draw(self.image)
        eye = view.viewpoints[:1]
        ahead = view.forwards[:1] - (view.forwards[:1] @ self.plan.up)[:, None] * self.plan.up
        length = float(np.linalg.norm(ahead))
        ((x, y),) = self._at(eye)
        if length > 1e-6:
            ((tip_x, tip_y),) = self._at(eye + (_ARROW * self.plan.side / length) * ahead)
            along = np.array([tip_x - x, tip_y - y])
            along /= np.linalg.norm(along)
            aside = np.array([-along[1], along[0]])
            tip = np.array([tip_x, tip_y])
            size = 7.0 * _FINE
            for width, drawn in ((8, PAPER), (4, color)):
                pen.line([(x, y), tuple(tip - 0.3 * size * along)], drawn, width * _FINE // 2)
                grown = size + (width - 4) * 0.5 * _FINE
                head = [
                    tip + 0.4 * grown * along,
                    tip - grown * (along - 0.6 * aside),
                    tip - grown * (along + 0.6 * aside),
                ]
                pen.polygon([(float(each[0]), float(each[1])) for each in head], drawn)
        size = (9.0 if name else 5.0) * _FINE
        pen.ellipse((x - size, y - size, x + size, y + size), color, PAPER, _FINE)
        if name:
            pen.text((x, y), name, PAPER, font(13 * _FINE), anchor="mm")

    def scale_bar(self, meters_per_unit: float | None) -> None:
        """Draw a bar of a round length: in meters where the size of a unit is known, else in scene units."""
        unit = meters_per_unit or 1.0
        length = nice_length(_BAR * self.plan.side * unit)
        word = "m" if meters_per_unit else "unit" if length == 1.0 else "units"
        pen = ImageDraw.Draw(self.image)
        side = self.image.size[0]
        across = length / unit / self.plan.side * side
        x = 16.0 * _FINE
        y = side - 16.0 * _FINE
        text = f"{length:g} {word}"
        size = font(14 * _FINE)
        wide = max(across, pen.textlength(text, size)) + 16 * _FINE
        pen.rounded_rectangle((x - 8 * _FINE, y - 28 * _FINE, x - 8 * _FINE + wide, y + 8 * _FINE), 4 * _FINE, PAPER)
        pen.text((x, y - 8 * _FINE), text, INK, size, anchor="ls")
        pen.line([(x, y - 4 * _FINE), (x, y), (x + across, y), (x + across, y - 4 * _FINE)], INK, 2 * _FINE)

    def finish(self) -> Image.Image:
        """Return the plan with a frame, at its size."""
        side = self.image.size[0]
        ImageDraw.Draw(self.image).rectangle((0, 0, side - 1, side - 1), outline=(200, 206, 214), width=_FINE)
        return self.image.resize((self.plan.pixels, self.plan.pixels), Image.Resampling.LANCZOS)

    def _at(self, points: F64) -> list[tuple[float, float]]:
        """Return the pixels of points (P, 3) of the scene."""
        return [(float(x), float(y)) for x, y in _FINE * self.plan.places(points)]


def font(size: int) -> Font:
    """Return the font of pictures, in pixels; one of fixed size where Pillow has no FreeType."""
    try:
        return ImageFont.load_default(size)
    except (ImportError, OSError):
        return ImageFont.load_default()


def picture(image: NDArray[np.floating]) -> Image.Image:
    """Return an image (H, W, 3) in [0, 1] as a picture; values outside are clipped."""
    return Image.fromarray(eight_bit(image))


def blend(color: Color, share: float) -> Color:
    """Return a color on paper."""
    red, green, blue = (round(share * value + (1.0 - share) * white) for value, white in zip(color, PAPER, strict=True))
    return red, green, blue
