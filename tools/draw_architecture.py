"""Draw the pictures of docs/architecture as SVG: boxes on a grid, and arrows between them.

`python tools/draw_architecture.py` writes all of them to docs/images/architecture. They have a light background of
their own, so dark pages show them as light ones do.
"""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import NamedTuple

OUT = Path(__file__).parents[1] / "docs" / "images" / "architecture"
WIDTH = 168  # of a box, pixels
HEIGHT = 72
GAP_X = 52
GAP_Y = 46
EDGE = 24
FILLS = {"work": "#d9efec", "data": "#fff3d6", "out": "#fde3d8"}  # what computes, what is kept, what people use
HEAD = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {w} {h}" width="{w}" height="{h}" role="img" \
font-family="Arial, Helvetica, sans-serif" font-size="13" fill="#1b2b2a">
<title>{title}</title>
<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" orient="auto">\
<path d="M0 0 8 4 0 8z" fill="#35605b"/></marker></defs>
<rect width="{w}" height="{h}" rx="10" fill="#fbfcfc" stroke="#c6d5d3"/>
"""


class Box(NamedTuple):
    """A box: its column and row on the grid, its kind, its name, and lines below it."""

    x: float
    y: float
    kind: str
    name: str
    lines: tuple[str, ...] = ()

    @property
    def left(self) -> float:
        """Left border, pixels."""
        return EDGE + self.x * (WIDTH + GAP_X)

    @property
    def top(self) -> float:
        """Upper border, pixels."""
        return EDGE + self.y * (HEIGHT + GAP_Y)


class Picture(NamedTuple):
    """A picture: its file, its title, its boxes, and arrows as (from, to, label) by the number of the box."""

    file: str
    title: str
    boxes: tuple[Box, ...]
    arrows: tuple[tuple[int, int, str], ...]


def draw_box(box: Box) -> str:
    """Return a box with its name and its lines."""
    middle = box.left + WIDTH / 2
    first = box.top + HEIGHT / 2 + 5 - 8 * len(box.lines)
    shown = [
        f'<rect x="{box.left:g}" y="{box.top:g}" width="{WIDTH}" height="{HEIGHT}" rx="7" fill="{FILLS[box.kind]}" '
        'stroke="#35605b"/>',
        f'<text x="{middle:g}" y="{first:g}" text-anchor="middle" font-weight="bold">{escape(box.name)}</text>',
    ]
    for k, line in enumerate(box.lines, 1):
        y = first + 16 * k
        shown.append(f'<text x="{middle:g}" y="{y:g}" text-anchor="middle" font-size="12">{escape(line)}</text>')
    return "\n".join(shown)


def draw_arrow(start: Box, end: Box, label: str) -> str:
    """Return an arrow between the borders of two boxes that face each other, with its label."""
    if start.y == end.y:
        side = 1 if end.x > start.x else -1
        x1 = start.left + (WIDTH if side > 0 else 0)
        x2 = end.left + (0 if side > 0 else WIDTH)
        y1 = start.top + HEIGHT / 2
        y2 = y1
        at = f'x="{(x1 + x2) / 2:g}" y="{y1 - 7:g}" text-anchor="middle"'
    else:
        side = 1 if end.y > start.y else -1
        x1 = start.left + WIDTH / 2
        x2 = end.left + WIDTH / 2
        y1 = start.top + (HEIGHT if side > 0 else 0)
        y2 = end.top + (0 if side > 0 else HEIGHT)
        at = f'x="{(x1 + x2) / 2 + 8:g}" y="{(y1 + y2) / 2 + 4:g}"'
    line = f'<path d="M{x1:g} {y1:g} {x2:g} {y2:g}" stroke="#35605b" stroke-width="1.6" marker-end="url(#tip)"/>'
    return line + (f'\n<text {at} font-size="11" fill="#35605b">{escape(label)}</text>' if label else "")


def draw(picture: Picture) -> str:
    """Return a picture as SVG."""
    width = max(box.left for box in picture.boxes) + WIDTH + EDGE
    height = max(box.top for box in picture.boxes) + HEIGHT + EDGE
    parts = [HEAD.format(w=f"{width:g}", h=f"{height:g}", title=escape(picture.title))]
    parts += [draw_arrow(picture.boxes[a], picture.boxes[b], label) + "\n" for a, b, label in picture.arrows]
    parts += [draw_box(box) + "\n" for box in picture.boxes]
    return "".join(parts) + "</svg>\n"


PICTURES = (
    Picture(
        "flow",
        "How does a file become a view?",
        (
            Box(0, 0, "data", "a file", ("PLY, SPZ, SOG, ...",)),
            Box(1, 0, "work", "io/", ("bytes to a scene",)),
            Box(2, 0, "data", "scene/", ("Gaussians, facts,", "where eyes may be")),
            Box(0, 1, "data", "photos", ("with their cameras",)),
            Box(1, 1, "work", "train/", ("photos to a scene,", "scene to levels")),
            Box(2, 1, "work", "pvs/", ("visible sets of cells",)),
            Box(3, 1, "work", "raycast/ hpr/", ("render/", "what an eye sees")),
            Box(2, 2, "work", "prepare/", ("stages in their order,", "colors by color/")),
            Box(2, 3, "data", "package/", ("a folder of parts",)),
            Box(3, 3, "work", "abr/ stream/", ("what to send next,", "as messages")),
            Box(3, 4, "out", "serve/", ("viewers on sockets",)),
            Box(2, 4, "out", "simulate/", ("viewers on a", "recorded link")),
            Box(1, 4, "out", "export/", ("files for any host",)),
            Box(1, 3, "data", "world/", ("many packages",)),
        ),
        (
            (0, 1, ""),
            (1, 2, ""),
            (3, 4, ""),
            (2, 5, ""),
            (4, 5, "levels"),
            (6, 5, "looks"),
            (5, 7, "sets"),
            (7, 8, ""),
            (8, 13, ""),
            (8, 9, ""),
            (9, 10, ""),
            (9, 11, ""),
            (8, 12, ""),
        ),
    ),
    Picture(
        "visibility",
        "How is the visible set of a cell found and checked?",
        (
            Box(0, 0, "data", "navigable space", ("where eyes may be",)),
            Box(1, 0, "work", "cells", ("boxes of the space",)),
            Box(2, 0, "work", "viewpoints", ("shared by neighbors",)),
            Box(3, 0, "work", "look", ("z-buffer and hull,", "six faces")),
            Box(3, 1, "work", "set of the cell", ("union of its looks",)),
            Box(2, 1, "work", "certificate", ("fresh rays, bound 95%",)),
            Box(1, 1, "data", "store", ("sets and weight", "classes")),
            Box(0, 1, "out", "judge's eyes", ("drawn by another rule",)),
            Box(3, 2, "work", "mend", ("add what rays found,", "look at the worst ray")),
        ),
        (
            (0, 1, ""),
            (1, 2, ""),
            (2, 3, ""),
            (3, 4, ""),
            (4, 5, ""),
            (5, 6, "passes"),
            (6, 7, "check"),
            (5, 8, ""),
            (8, 4, "larger set"),
        ),
    ),
    Picture(
        "color",
        "How is color cut into pieces, and which pieces are sent?",
        (
            Box(0, 0, "data", "SH colors", ("of the scene",)),
            Box(0, 1, "work", "directions", ("which of 80 faces", "see a Gaussian")),
            Box(1, 0, "work", "split", ("base color and", "functions of direction")),
            Box(2, 0, "work", "pursuit", ("one term at a time,", "then move all")),
            Box(3, 0, "work", "quantize", ("integers that index", "tables")),
            Box(1, 1, "work", "importance", ("weight over pixels",)),
            Box(2, 1, "work", "price", ("who gets one more", "term")),
            Box(3, 1, "data", "records", ("base color: 3 bytes", "term: 36 bits")),
            Box(3, 2, "work", "active terms", ("by cell and eye, eq. 7",)),
            Box(2, 2, "out", "client", ("base color, then terms",)),
        ),
        (
            (0, 2, ""),
            (1, 2, ""),
            (2, 3, ""),
            (5, 6, ""),
            (6, 3, ""),
            (3, 4, ""),
            (4, 7, ""),
            (7, 8, ""),
            (8, 9, ""),
        ),
    ),
    Picture(
        "package",
        "What do levels share, and what lies in a package?",
        (
            Box(0, 0, "data", "preview", ("2%, all merged",)),
            Box(1, 0, "data", "low", ("25%, 0.9 of it stays",)),
            Box(2, 0, "data", "medium", ("50%, 0.96 of it stays",)),
            Box(3, 0, "data", "high", ("the scene itself",)),
            Box(1.5, 1, "work", "union of levels", ("one order, one id each",)),
            Box(0, 2, "data", "chunk rows", ("origin, step, levels",)),
            Box(1, 2, "data", "Gaussians", ("coded, 16 bytes each", "when read")),
            Box(2, 2, "data", "terms", ("coded, 36 bits each",)),
            Box(3, 2, "data", "visible sets", ("the store, in pieces",)),
            Box(1.5, 3, "data", "manifest.json", ("names all parts by hash,", "written last")),
        ),
        (
            (0, 1, "then"),
            (1, 2, "reused"),
            (2, 3, "reused"),
            (1, 4, ""),
            (2, 4, ""),
            (4, 5, ""),
            (4, 6, ""),
            (4, 7, ""),
            (4, 8, ""),
            (5, 9, ""),
            (6, 9, ""),
            (7, 9, ""),
            (8, 9, ""),
        ),
    ),
    Picture(
        "planning",
        "How does a pose become the next message?",
        (
            Box(0, 0, "out", "client", ("pose, field of view",)),
            Box(1, 0, "work", "predict", ("pose in 0.25 s,", "cell in 1 s")),
            Box(2, 0, "work", "candidates", ("what the cell and its", "neighbors see")),
            Box(3, 0, "work", "rank", ("by gain, in view or", "not, and level")),
            Box(3, 1, "work", "take", ("what is not held, up", "to the budget")),
            Box(2, 1, "work", "encode", ("ids, rows, records,", "terms")),
            Box(1, 1, "data", "BATCH", ("one message",)),
            Box(0, 1, "work", "receiver", ("decodes, draws",)),
            Box(0, 2, "data", "ACK", ("arrived",)),
            Box(1, 2, "work", "link meter", ("times of transfers",)),
            Box(2, 2, "work", "estimator", ("budget of a message",)),
            Box(3, 2, "data", "holdings", ("never sent twice",)),
        ),
        (
            (0, 1, "POSE"),
            (1, 2, ""),
            (2, 3, ""),
            (3, 4, ""),
            (4, 5, ""),
            (5, 6, ""),
            (6, 7, ""),
            (7, 8, ""),
            (8, 9, ""),
            (9, 10, ""),
            (10, 4, ""),
            (11, 4, ""),
        ),
    ),
    Picture(
        "server",
        "What is between a socket and the bytes of a scene?",
        (
            Box(0, 0, "out", "socket", ("page or program",)),
            Box(1, 0, "work", "Door", ("accepts, counts",)),
            Box(2, 0, "work", "Guard", ("one phase, one deadline",)),
            Box(3, 0, "work", "uvicorn", ("whole requests only",)),
            Box(3, 1, "work", "app", ("pages, parts, streams",)),
            Box(2, 1, "work", "Connection", ("two loops, one viewer",)),
            Box(1, 1, "work", "Session", ("no socket, no clock",)),
            Box(0, 1, "data", "StreamedScene", ("shared by viewers",)),
            Box(0, 2, "data", "tables", ("mapped from files",)),
            Box(1, 2, "work", "Turns", ("one viewer plans", "at a time")),
            Box(2, 2, "work", "Precedence", ("sockets of viewers", "first")),
            Box(3, 2, "work", "Supervisor", ("processes, one port",)),
        ),
        (
            (0, 1, ""),
            (1, 2, ""),
            (2, 3, ""),
            (3, 4, ""),
            (4, 5, ""),
            (5, 6, ""),
            (6, 7, ""),
            (8, 7, ""),
            (9, 6, ""),
            (10, 5, ""),
            (11, 4, "starts"),
        ),
    ),
    Picture(
        "worlds",
        "How do scenes of any size become a world?",
        (
            Box(0, 0, "data", "scenes", ("read in batches",)),
            Box(1, 0, "work", "split", ("equal counts a tile",)),
            Box(2, 0, "work", "levels, space", ("of each tile",)),
            Box(3, 0, "work", "districts", ("few Gaussians for", "what is far")),
            Box(3, 1, "work", "choose nodes", ("what stands around", "a tile")),
            Box(2, 1, "work", "packages", ("sets, colors, records",)),
            Box(1, 1, "data", "world.json", ("written last",)),
            Box(0, 1, "out", "one stream", ("ids of all nodes",)),
            Box(0, 2, "work", "graph of tasks", ("pure, named by content",)),
            Box(1, 2, "work", "workers", ("here, processes,", "executor, Dask")),
            Box(2, 2, "data", "object store", ("results, notes",)),
            Box(3, 2, "work", "resumed run", ("asks for notes first",)),
        ),
        (
            (0, 1, ""),
            (1, 2, ""),
            (2, 3, ""),
            (3, 4, ""),
            (4, 5, ""),
            (5, 6, ""),
            (6, 7, ""),
            (8, 9, "names"),
            (9, 10, ""),
            (10, 11, ""),
        ),
    ),
    Picture(
        "exports",
        "Which files serve which viewer?",
        (
            Box(0, 0, "data", "package", ("or levels, or any scene",)),
            Box(1, 0, "work", "parts", ("1,024 neighbors in space",)),
            Box(2, 0, "data", "static site", ("parts, rows of cells",)),
            Box(3, 0, "out", "page of gsvis", ("plans by itself, asks", "for whole files")),
            Box(1, 1, "work", "leaves", ("boxes of a binary tree",)),
            Box(2, 1, "data", "streamed SOG", ("and what cells need",)),
            Box(3, 1, "out", "PlayCanvas, Spark", ("with or without it",)),
            Box(2, 2, "data", "3D Tiles, glTF", ("boxes of cells",)),
            Box(3, 2, "out", "CesiumJS, three.js", ()),
            Box(0, 1, "data", "one HTML page", ("site inside a file",)),
            Box(0, 2, "out", "any browser", ("opens from disk",)),
        ),
        (
            (0, 1, ""),
            (1, 2, ""),
            (2, 3, ""),
            (0, 4, ""),
            (4, 5, ""),
            (5, 6, ""),
            (4, 7, ""),
            (7, 8, ""),
            (0, 9, ""),
            (9, 10, ""),
        ),
    ),
)


def main() -> None:
    """Write all pictures."""
    OUT.mkdir(parents=True, exist_ok=True)
    for picture in PICTURES:
        (OUT / f"{picture.file}.svg").write_text(draw(picture), encoding="utf-8")


if __name__ == "__main__":
    main()
