"""Build the fixed parts: floors, ceilings, walls with openings, frames, doors, skirting boards."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gsvis.scene.flat.charts import Chart, Look, box, move, plain, rectangle
from gsvis.scene.flat.materials import carpet, checkered, leaves, planks, plaster, tiles
from gsvis.scene.flat.plan import DOORS, HEIGHT, ROOMS, WINDOWS, Opening, Room

__all__ = ["shell"]

WHITE = (0.90, 0.89, 0.86)
FRAME = plain((0.93, 0.92, 0.90), gloss=0.03, texel=0.02)
DOOR = plain((0.90, 0.885, 0.85), gloss=0.03, texel=0.02)
OAK = (0.66, 0.48, 0.32)


@dataclass(frozen=True)
class Finish:
    """Floor and walls of a room; `accent` names walls with a look of their own."""

    floor: Look
    wall: Look
    accent: dict[str, Look]


FINISHES = {
    "living": Finish(planks(OAK, 0.17, 1.7), plaster((0.90, 0.88, 0.83)), {"north": plaster((0.30, 0.43, 0.44))}),
    "kitchen": Finish(checkered((0.87, 0.85, 0.80), (0.27, 0.30, 0.31), 0.45), plaster((0.91, 0.88, 0.80)), {}),
    "bedroom": Finish(
        carpet((0.70, 0.66, 0.60)),
        plaster((0.88, 0.87, 0.86)),
        {"north": leaves((0.83, 0.87, 0.85), (0.46, 0.60, 0.54), (0.86, 0.62, 0.52))},
    ),
    "hall": Finish(planks(OAK, 0.17, 1.7, seed=4), plaster((0.92, 0.90, 0.86)), {}),
    "study": Finish(
        planks((0.44, 0.29, 0.18), 0.12, 1.2, seed=9),
        plaster((0.86, 0.83, 0.75)),
        {"east": plaster((0.22, 0.31, 0.27))},
    ),
    "bath": Finish(
        tiles((0.80, 0.82, 0.82), (0.62, 0.63, 0.63), (0.15, 0.15), gloss=0.06),
        tiles((0.55, 0.72, 0.76), (0.86, 0.88, 0.88), (0.2, 0.1), bond=0.5, vary=0.12),
        {},
    ),
}
SIDES = ("west", "east", "south", "north")


def shell() -> list[Chart]:
    """Return all charts of the shell; borders of walls are corners, so they need not be sharp."""
    found: list[Chart] = []
    for room in ROOMS:
        found += [replace(chart, look=replace(chart.look, rim=0.1)) for chart in _room(room)]
    for opening in DOORS:
        found += _reveal(opening, FRAME, sill=False)
        found += _casing(opening)
    for opening in WINDOWS:
        found += _reveal(opening, plain(WHITE, texel=0.03), sill=True)
        found += _sash(opening)
    return found + _door_leaves()


def _room(room: Room) -> list[Chart]:
    """Return floor, ceiling and walls of a room."""
    finish = FINISHES[room.name]
    (x0, x1), (y0, y1) = room.x, room.y
    wide = x1 - x0
    deep = y1 - y0
    found = [
        rectangle((x0, y0, 0.0), (wide, 0.0, 0.0), (0.0, deep, 0.0), finish.floor),
        rectangle((x0, y0, HEIGHT), (wide, 0.0, 0.0), (0.0, deep, 0.0), plaster((0.94, 0.935, 0.92)), side=-1.0),
    ]
    for side in SIDES:
        found += _wall(room, side, finish)
    return found


def _wall(room: Room, side: str, finish: Finish) -> list[Chart]:
    """Return one wall of a room, with its openings."""
    axis = 0 if side in ("west", "east") else 1
    span, across = (room.y, room.x) if axis == 0 else (room.x, room.y)
    at = across[0] if side in ("west", "south") else across[1]
    holes = [
        each for each in (*DOORS, *WINDOWS) if each.axis == axis and min(abs(each.low - at), abs(each.high - at)) < 1e-6
    ]
    holes = [each for each in holes if span[0] <= each.span[0] and each.span[1] <= span[1]]
    cut = [(each.span[0] - span[0], each.z[0], each.span[1] - span[0], each.z[1]) for each in holes]
    corner = (at, span[0], 0.0) if axis == 0 else (span[0], at, 0.0)
    along = (0.0, span[1] - span[0], 0.0) if axis == 0 else (span[1] - span[0], 0.0, 0.0)
    outward = {"west": 1.0, "east": -1.0, "south": -1.0, "north": 1.0}[side]
    look = finish.accent.get(side, finish.wall)
    wall = rectangle(corner, along, (0.0, 0.0, HEIGHT), look, holes=cut, side=outward)
    return [wall, *_skirting(room, side, holes)]


def _skirting(room: Room, side: str, holes: list[Opening]) -> list[Chart]:
    """Return boards along the foot of a wall, with gaps at openings that reach the floor."""
    if room.name == "bath":
        return []
    axis = 0 if side in ("west", "east") else 1
    span, across = (room.y, room.x) if axis == 0 else (room.x, room.y)
    ends = [span[0]]
    for each in sorted(holes, key=lambda hole: hole.span):
        if each.z[0] < 0.1:
            ends += [each.span[0] - 0.07, each.span[1] + 0.07]
    ends.append(span[1])
    low, high = (across[0], across[0] + 0.015) if side in ("west", "south") else (across[1] - 0.015, across[1])
    found: list[Chart] = []
    for begin, end in zip(ends[::2], ends[1::2], strict=True):
        if end - begin < 0.05:
            continue
        first = (low, begin, 0.0) if axis == 0 else (begin, low, 0.0)
        last = (high, end, 0.09) if axis == 0 else (end, high, 0.09)
        faces = {"west": "XZ", "east": "xZ", "south": "YZ", "north": "yZ"}[side]
        found += box(first, last, FRAME, faces=faces)
    return found


def _reveal(opening: Opening, look: Look, *, sill: bool) -> list[Chart]:
    """Return the four inner faces of an opening; the lower face only for a window."""
    low, high, (begin, end), (bottom, top) = opening.low, opening.high, opening.span, opening.z
    first = (low, begin, bottom)
    last = (high, end, top)
    if opening.axis == 1:
        first = (begin, low, bottom)
        last = (end, high, top)
    faces = "yYZ" if opening.axis == 0 else "xXZ"
    inward = [_turned(chart) for chart in box(first, last, look, faces=faces + ("z" if sill else ""))]
    if sill:
        inner = 0.0 if low < 0.0 else low
        board_low, board_high = (inner - 0.02, inner + 0.10) if low < 0.0 else (inner - 0.10, inner + 0.02)
        first = (
            (begin - 0.04, board_low, bottom - 0.03) if opening.axis == 1 else (board_low, begin - 0.04, bottom - 0.03)
        )
        last = (end + 0.04, board_high, bottom) if opening.axis == 1 else (board_high, end + 0.04, bottom)
        if bottom > 0.3:
            inward += box(first, last, plain((0.88, 0.87, 0.85), gloss=0.05, texel=0.02), faces="xXyYzZ")
    return inward


def _turned(chart: Chart) -> Chart:
    """Return a chart with its other side visible."""
    return replace(chart, side=-chart.side)


def _casing(opening: Opening) -> list[Chart]:
    """Return flat boards around a door, on both faces of the wall."""
    found: list[Chart] = []
    (begin, end), top = opening.span, opening.z[1]
    for low, high in ((opening.low - 0.014, opening.low), (opening.high, opening.high + 0.014)):
        for first, last, bottom, upper in (
            (begin - 0.07, begin, 0.0, top + 0.07),
            (end, end + 0.07, 0.0, top + 0.07),
            (begin, end, top, top + 0.07),
        ):
            if opening.axis == 0:
                found += box((low, first, bottom), (high, last, upper), FRAME, faces="xXyYzZ")
            else:
                found += box((first, low, bottom), (last, high, upper), FRAME, faces="xXyYzZ")
    return found


def _sash(opening: Opening) -> list[Chart]:
    """Return the frame of a window: a rim and a bar in the middle."""
    (begin, end), (bottom, top) = opening.span, opening.z
    low = opening.low + 0.10 if opening.low < 0.0 else opening.high - 0.16
    high = low + 0.06
    middle = 0.5 * (begin + end)
    bar = 0.055
    found: list[Chart] = []
    upright = [(begin, begin + bar), (middle - bar, middle + bar), (end - bar, end)]
    if end - begin < 1.0:
        upright.pop(1)
    beams = [(bottom, bottom + bar), (top - bar, top)]
    parts = [(a, b, bottom, top) for a, b in upright] + [(begin, end, c, d) for c, d in beams]
    for a, b, c, d in parts:
        if opening.axis == 0:
            found += box((low, a, c), (high, b, d), FRAME, faces="xXyYzZ")
        else:
            found += box((a, low, c), (b, high, d), FRAME, faces="xXyYzZ")
    return found


def _door_leaves() -> list[Chart]:
    """Return open doors with handles, each hinged at the origin along +x before it is moved."""

    def leaf(width: float) -> list[Chart]:
        """Return a door leaf with its handles."""
        handle = plain((0.72, 0.66, 0.52), gloss=0.3, texel=0.01)
        found = box((0.0, -0.02, 0.01), (width, 0.02, 2.04), DOOR, faces="xXyYZ")
        for low, high in ((0.25, 0.95), (1.15, 1.85)):
            for side in (-0.026, 0.02):
                found += box((0.14, side, low), (width - 0.14, side + 0.006, high), DOOR, faces="xXyYzZ")
        for side in (-0.06, 0.045):
            found += box((width - 0.17, side, 1.0), (width - 0.04, side + 0.015, 1.025), handle, rounded=0.006)
        return found

    return [
        *move(leaf(0.88), (5.52, 4.46, 0.0), 14.0),
        *move(leaf(0.88), (4.06, 5.47, 0.0), 170.0),
        *move(leaf(0.88), (6.27, 5.86, 0.0), 82.0),
        *move(leaf(0.83), (8.82, 5.86, 0.0), 78.0),
    ]
