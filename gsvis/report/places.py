"""One picture of where people stand in a scene: what they see first, and a plan with their eyes.

Where a scene may be read in two ways, both are shown, each in a color of its own. Needs no matplotlib.
"""

from __future__ import annotations

import io
import textwrap
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from PIL.PngImagePlugin import PngInfo

from gsvis.render.device_scene import DeviceScene
from gsvis.report.marks import ALL, COLORS, GIVEN, INK, MUTED, PAPER, Color, Marks, blend, font, picture
from gsvis.report.plan import Plan
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["READINGS", "Places", "Reading", "draw_places"]

F64 = NDArray[np.float64]
Legend = list[tuple[Color | None, str]]

READINGS = 3
"""Most readings of a scene that are shown."""

_WIDTH = 1280
_EDGE = 24
_GAP = 16
_PLAN = 600  # pixels
_VIEW = 616  # pixels across a view
_HEIGHTS = {1: 346, 2: 300, 3: 270}  # pixels down each view, by their number
_FOV = 75.0
_DOTS = 40  # eyes that are drawn
_CAMERAS = 400  # cameras that are drawn, at most
_SAME_UP = 0.98  # cosine to the up axis of the plan from which on the eyes of a reading can be shown on it
_WHITE = (1.0, 1.0, 1.0)
_VOID = (0.07, 0.08, 0.1)


@dataclass(frozen=True, eq=False)
class Reading:
    """One way to read a scene.

    Attributes:
        title: What it is read as, such as "an object, up -y".
        space: Where eyes may be, read like this.
        view: The camera of the first view; None if no eye finds one.
    """

    title: str
    space: NavigableSpace
    view: Cameras | None


@dataclass(frozen=True, eq=False)
class Places:
    """What is known of where people stand.

    Attributes:
        title: Title of the picture.
        lines: What decided it, and what is doubtful.
        readings: The ways to read the scene, the likely one first; one if there is no doubt.
        space: Where eyes are: that of the one reading, or of all together.
        cameras: (C, 3) viewpoints of given cameras; none by default.
        walk: (T, 3) positions of a given walk; none by default.
    """

    title: str
    lines: tuple[str, ...]
    readings: tuple[Reading, ...]
    space: NavigableSpace
    cameras: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    walk: F64 = field(default_factory=lambda: np.zeros((0, 3)))


def draw_places(g: Gaussians, places: Places, *, backend: str = "auto") -> bytes:
    """Return the picture as PNG bytes; the same scene gives the same bytes on the CPU.

    Args:
        g: The scene, N > 0.
        places: What is known of where people stand.
        backend: Backend that draws the first views, see `DeviceScene`; the CPU draws the plan.
    """
    scene = DeviceScene(g, backend)
    shown = places.readings[:READINGS]
    text = [line for each in places.lines for line in textwrap.wrap(each, 150)]
    top = _EDGE + 40 + 20 * len(text) + 8
    view_height = _HEIGHTS[len(shown)]
    plan, legend = _draw_plan(g, places)
    height = top + max(len(shown) * (view_height + 40), _PLAN + 24 * len(legend) + 16) + _EDGE
    sheet = Image.new("RGB", (_WIDTH, height), PAPER)
    pen = ImageDraw.Draw(sheet)
    pen.text((_EDGE, _EDGE - 6), places.title, INK, font(24))
    for row, line in enumerate(text):
        pen.text((_EDGE, _EDGE + 34 + 20 * row), line, MUTED, font(15))
    for k, reading in enumerate(shown):
        at = top + k * (view_height + 40)
        sheet.paste(_draw_view(scene, reading.view, view_height), (_EDGE, at))
        number = f"{k + 1}. " if len(shown) > 1 else ""
        pen.text((_EDGE, at + view_height + 6), f"{number}First view: {reading.title}", COLORS[k], font(16))
    left = _WIDTH - _EDGE - _PLAN
    sheet.paste(plan, (left, top))
    for row, (color, line) in enumerate(legend):
        at = top + _PLAN + 10 + 24 * row
        if color is not None:
            pen.rounded_rectangle((left + 1, at + 3, left + 15, at + 17), 3, blend(color, 0.45), color)
        pen.text((left + (24 if color is not None else 0), at), line, INK if color else MUTED, font(15))
    out = io.BytesIO()
    about = PngInfo()
    about.add_text("Software", "gsvis")  # it may be replaced
    sheet.save(out, "PNG", compress_level=4, pnginfo=about)
    return out.getvalue()


def _draw_view(scene: DeviceScene, view: Cameras | None, height: int) -> Image.Image:
    """Return the picture of a camera at the size of a view; a gray one with a line without a camera."""
    if view is None:
        blank = Image.new("RGB", (_VIEW, height), (226, 230, 236))
        ImageDraw.Draw(blank).text((_VIEW // 2, height // 2), "no eye finds a view", MUTED, font(18), anchor="mm")
        return blank
    focal = 0.5 * _VIEW / np.tan(np.radians(_FOV) / 2.0)
    ks = np.array([[[focal, 0.0, _VIEW / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]]])
    camera = Cameras(view.viewmats[:1], ks, _VIEW, height)
    return picture(scene.draw(camera, background=_VOID).images[0])


def _draw_plan(g: Gaussians, places: Places) -> tuple[Image.Image, Legend]:
    """Return the plan with eyes, cameras, the walk and first views on it; and its legend."""
    readings = places.readings[:READINGS]
    views = [each.view.viewpoints[:1] for each in readings if each.view is not None]
    more = np.concatenate([places.walk, *views])
    plan = Plan.over(g, places.space, _PLAN, more=more, cut_by=readings[0].space)
    marks = Marks(plan, plan.draw(g, _WHITE))
    legend: Legend = [(None, plan.explain())]
    several = len(readings) > 1
    if several:
        marks.shade(places.space, ALL, 0.0)
        legend.append((ALL, "eyes go where any reading has them, until one is chosen"))
    upright = [k for k, each in enumerate(readings) if each.space.up @ plan.up > _SAME_UP]
    for k in upright:
        marks.shade(readings[k].space, COLORS[k], 0.2)
        legend.append((COLORS[k], f"eyes of {k + 1}: {readings[k].title}" if several else "where eyes are"))
    marks.dots(places.space.sample_viewpoints(_DOTS, np.random.default_rng(0)), ALL if several else COLORS[0], 2.5)
    if len(places.cameras):
        marks.dots(places.cameras[:: 1 + len(places.cameras) // _CAMERAS], GIVEN, 3.0)
        legend.append((GIVEN, f"{len(places.cameras):,} cameras given"))
    if len(places.walk):
        marks.line(places.walk, GIVEN)
        legend.append((GIVEN, "the walk given"))
    for k in upright:
        view = readings[k].view
        if view is not None:
            marks.forward(view, COLORS[k], str(k + 1) if several else "")
    legend.append((None, "Arrows: the first view, and what is forward in it. Dots: some of the eyes."))
    marks.scale_bar(g.facts.meters_per_unit)
    return marks.finish(), legend
