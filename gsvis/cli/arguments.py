"""The commands and their arguments, as dataclasses that `tyro` turns into a command line and its help.

Nothing heavy is imported here: `gsvis --help` has to be quick.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg
from tyro.constructors import PrimitiveConstructorSpec

__all__ = ["Analyze", "Color", "Command", "Convert", "Inspect", "Pvs", "PvsReport", "Render"]


def _number(metavar: str, kind: type[int] | type[float], low: float, high: float, what: str) -> Any:
    """How tyro reads one number in [low, high]; `what` completes 'expected ...'."""

    def read(words: list[str]) -> float:
        try:
            value = kind(words[0])
        except ValueError:
            raise ValueError(f"expected {what}, got {words[0]!r}") from None
        if not low <= value <= high:
            raise ValueError(f"expected {what}, got {words[0]}")
        return value

    return _spec(1, metavar, read)


def _spec(nargs: int | Literal["*"], metavar: str, read: Callable[[list[str]], Any]) -> Any:
    return PrimitiveConstructorSpec(
        nargs=nargs,
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, int | float | tuple),
        str_from_instance=lambda value: [str(value)],
    )


def _read_box(words: list[str]) -> tuple[float, ...]:
    try:
        box = tuple(float(word) for word in words)
    except ValueError:
        raise ValueError(f"expected six numbers, got {' '.join(words)}") from None
    if not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise ValueError(f"expected X0 < X1, Y0 < Y1 and Z0 < Z1, got {' '.join(words)}")
    return box


def _numbers(metavar: str, low: float = -1e30, high: float = 1e30, what: str = "three finite numbers") -> Any:
    """How tyro reads as many numbers in [low, high] as `metavar` has words."""

    def read(words: list[str]) -> tuple[float, ...]:
        try:
            values = tuple(float(word) for word in words)
        except ValueError:
            values = ()
        if not values or not all(low <= value <= high for value in values):
            raise ValueError(f"expected {what}, got {' '.join(words)}")
        return values

    return _spec(len(metavar.split()), metavar, read)


def _read_indices(words: list[str]) -> tuple[int, ...]:
    if not words or not all(word.isdecimal() for word in words):
        raise ValueError(f"expected whole numbers of at least 0, got {' '.join(words) or 'none'}")
    return tuple(int(word) for word in words)


def _read_pixel(words: list[str]) -> tuple[int, int]:
    column, _, row = words[0].partition(",")
    if not (column.isdecimal() and row.isdecimal()):
        raise ValueError(f"expected a column and a row, such as 320,240, got {words[0]!r}")
    return int(column), int(row)


def _read_face_rays(words: list[str]) -> int:
    if words[0] not in ("1", "4", "16", "64"):
        raise ValueError(f"expected 1, 4, 16 or 64 rays, got {words[0]!r}")
    return int(words[0])


def _read_bytes(words: list[str]) -> int:
    found = re.fullmatch(r"(\d+(?:\.\d*)?)\s*([kmgt]?)(i?)b", words[0].strip().lower())
    size = float(found[1]) * (1024.0 if found[3] else 1000.0) ** " kmgt".index(found[2] or " ") if found else 0.0
    if not 1.0 <= size < 2.0**60:
        raise ValueError(f"expected a size such as 4GB, 2.5GiB or 500MB, got {words[0]!r}")
    return int(size)


def _read_mean_terms(words: list[str]) -> float:
    try:
        value = float("inf" if words[0] == "all" else words[0])
    except ValueError:
        value = -1.0
    if not value >= 0.0:
        raise ValueError(f"expected a number of at least 0 or all, got {words[0]!r}")
    return value


def _read_epsilon(words: list[str]) -> float:
    try:
        value = 0.0 if words[0] == "auto" else float(words[0])
    except ValueError:
        value = -1.0
    if not (0.0 < value <= 1.0 or words[0] == "auto"):
        raise ValueError(f"expected a change of colour in (0, 1] or auto, got {words[0]!r}")
    return value


_COUNT = 10**9
_WHOLE = _number("N", int, 0, _COUNT, "a whole number of at least 0")
_COUNTED = _number("N", int, 1, _COUNT, "a whole number of at least 1")
_PIXELS = _number("PX", int, 1, 16384, "1 to 16384 pixels")
_DEGREES = _number("DEG", float, 1.0, 179.0, "degrees in [1, 179]")
_WEIGHT = _number("W", float, 1e-6, 1.0, "a weight in [1e-6, 1]")
_OPACITY = _number("A", float, 0.0, 1.0, "a value in [0, 1]")
_SH_DEGREE = _number("D", int, 0, 3, "an SH degree of 0 to 3")
_FACE_RAYS = _spec(1, "K", _read_face_rays)
_BOX = _spec(6, "X0 Y0 Z0 X1 Y1 Z1", _read_box)
_POINT = _numbers("X Y Z")
_COLOUR = _numbers("R G B", 0.0, 1.0, "three numbers in [0, 1]")
_INDICES = _spec("*", "I [I ...]", _read_indices)
_PIXEL = _spec(1, "X,Y", _read_pixel)
_DISTANCE = _number("R", float, 1e-12, 1e12, "a distance above 0")
_ELEVATION = _number("DEG", float, -89.0, 89.0, "degrees in [-89, 89]")
_BYTES = _spec(1, "SIZE", _read_bytes)
_FACE_PIXELS = _number("PX", int, 4, 4096, "4 to 4096 pixels")
_TAU = _number("W", float, 1e-6, 0.5, "a weight in [1e-6, 0.5]")
_SHARE = _number("S", float, 0.0, 1.0, "a share in [0, 1]")
_CELLS = _number("N", int, 1, 100_000, "a whole number of 1 to 100000")
_TERMS = _number("N", int, 0, 32, "a whole number of 0 to 32")
_MEAN_TERMS = _spec(1, "X|all", _read_mean_terms)
_EPSILON = _spec(1, "E|auto", _read_epsilon)
_RATE = _number("F", float, 0.1, 50.0, "0.1 to 50 frames a second")


def _hint(text: str) -> Any:
    return arg(help_behavior_hint=f"(default: {text})")


_PLAIN = arg(help_behavior_hint="")
Scene = Annotated[Positional[str], arg(metavar="SCENE", help_behavior_hint="")]
Lod = Annotated[int | None, _WHOLE, _hint("the finest that is there")]
Flag = Annotated[bool, _PLAIN]


@dataclass(frozen=True)
class Inspect:
    """Tell what a scene holds and what looks wrong with it."""

    scene: Scene
    """File or folder (.ply, .compressed.ply, .splat, .spz, .sog, lod-meta.json), or builtin:NAME."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    json: Flag = False
    """Print one JSON document instead of tables."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Analyze:
    """Trace what views need and from where each Gaussian can be seen; write a report."""

    scene: Scene
    """File or folder (.ply, .compressed.ply, .splat, .spz, .sog, lod-meta.json), or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="DIR", help_behavior_hint="(required)")]
    """Folder for report.html (all in one file), report.json and the pictures; made if missing."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: sampled)")] = None
    """COLMAP model, transforms.json or cameras.json. Without it cameras are sampled in navigable space."""
    views: Annotated[int | None, _COUNTED, _hint("16; with --cameras all")] = None
    """Number of cameras to sample, or to take from FILE at even steps."""
    width: Annotated[int | None, _PIXELS, _hint("256")] = None
    """Pixel rays across a view."""
    height: Annotated[int | None, _PIXELS, _hint("192; with --cameras by its aspect")] = None
    """Pixel rays down a view."""
    fov: Annotated[float | None, _DEGREES, _hint("60; with --cameras its own")] = None
    """Horizontal field of view of sampled cameras."""
    seed: Annotated[int, _WHOLE] = 0
    """Seed of everything random: the same seed gives the same report."""
    tau: Annotated[float, _WEIGHT, _hint("1/255")] = 1.0 / 255.0
    """Weight from which a Gaussian counts as visible."""
    traced_sample: Annotated[int, _WHOLE] = 5000
    """Gaussians whose directions are traced outward; 0 for none."""
    rays_per_face: Annotated[int, _FACE_RAYS] = 16
    """Rays of that tracing over each of the 80 directions: 1, 4, 16 or 64; more find more."""
    json: Flag = False
    """Print report.json on standard output too."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Render:
    """Draw a scene as cameras see it; list who contributes to a pixel."""

    scene: Scene
    """File or folder (.ply, .compressed.ply, .splat, .spz, .sog, lod-meta.json), or builtin:NAME."""
    out: Annotated[
        str | None, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="(required without --contributors)")
    ] = None
    """A .png for one camera, a .gif for an animation, or a folder for 0000.png, 0001.png and on; made if missing."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    camera: Annotated[
        str | None,
        arg(
            aliases=["--cameras"],
            metavar="FILE",
            help_behavior_hint="(default: one camera, sampled in navigable space)",
        ),
    ] = None
    """COLMAP model, transforms.json or cameras.json; all its cameras, or those of --index."""
    index: Annotated[tuple[int, ...] | None, _INDICES, _hint("all")] = None
    """Which cameras of FILE, counted from 0."""
    orbit: Annotated[int | None, _COUNTED, _hint("no orbit")] = None
    """N cameras on a circle around the scene, or around --target."""
    radius: Annotated[float | None, _DISTANCE, _hint("shows the middle 90% of the scene")] = None
    """Distance of the orbit from what it goes around, scene units."""
    elevation: Annotated[float | None, _ELEVATION, _hint("20")] = None
    """Height of the orbit above what it goes around."""
    eye: Annotated[tuple[float, ...] | None, _POINT, _hint("none")] = None
    """One camera at this point."""
    target: Annotated[tuple[float, ...] | None, _POINT, _hint("the middle of the scene")] = None
    """What --eye looks at, or --orbit goes around."""
    up: Annotated[str | None, arg(metavar="AXIS", help_behavior_hint="(default: the likely one)")] = None
    """Axis that points upwards in the image, such as -y; not with --camera."""
    seed: Annotated[int, _WHOLE] = 0
    """Seed of the sampled camera: the same seed gives the same view."""
    width: Annotated[int | None, _PIXELS, _hint("640; with --camera that of FILE")] = None
    """Pixels across."""
    height: Annotated[int | None, _PIXELS, _hint("480; with --camera by its aspect")] = None
    """Pixels down."""
    fov: Annotated[float | None, _DEGREES, _hint("60; with --camera its own")] = None
    """Horizontal field of view."""
    background: Annotated[tuple[float, ...], _COLOUR, _hint("0 0 0")] = (0.0, 0.0, 0.0)
    """Colour behind everything, each channel in [0, 1]."""
    sh_degree: Annotated[int | None, _SH_DEGREE, _hint("all there is")] = None
    """Highest degree of spherical harmonics to evaluate."""
    antialiased: Flag = False
    """Lower opacities so that small Gaussians keep their light; for scenes trained that way."""
    depth: Flag = False
    """Write depth pictures too (NAME_depth.png or NAME_depth.gif)."""
    fps: Annotated[float | None, _RATE, _hint("12")] = None
    """Frames a second of a .gif."""
    contributors: Annotated[tuple[int, int] | None, _PIXEL, _hint("none")] = None
    """List the Gaussians blended into the pixel in column X and row Y, front to back; for one camera."""
    backend: Annotated[Literal["auto", "cpu", "cuda", "reference"], _PLAIN] = "auto"
    """What draws; auto takes a GPU where there is one that can. (default: auto)"""
    json: Flag = False
    """Print one JSON document instead of lines."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Convert:
    """Change a scene or its format; the suffix of OUT names the format."""

    scene: Annotated[Positional[str], arg(metavar="IN", help_behavior_hint="")]
    """File or folder (.ply, .compressed.ply, .splat, .spz, .sog, lod-meta.json), or builtin:NAME."""
    output: Annotated[Positional[str], arg(metavar="OUT", help_behavior_hint="")]
    """File to write; replaced if it exists."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    crop: Annotated[tuple[float, ...] | None, _BOX, _hint("no crop")] = None
    """Keep the Gaussians whose centre lies in this box, in the frame of IN."""
    min_opacity: Annotated[float, _OPACITY] = 0.0
    """Drop Gaussians fainter than this."""
    max_sh_degree: Annotated[int, _SH_DEGREE] = 3
    """Drop spherical harmonics above this degree."""
    up: Annotated[str | None, arg(metavar="FROM:TO", help_behavior_hint="(default: left as it is)")] = None
    """Turn the scene so that axis FROM becomes TO, as in -y:+z."""
    json: Flag = False
    """Print one JSON document instead of a line."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Pvs:
    """Find what can be seen from each cell of a scene; write it as a store."""

    scene: Scene
    """File or folder (.ply, .compressed.ply, .splat, .spz, .sog, lod-meta.json), or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """The store to write, such as scene.pvs; replaced, when the new one is whole, if it exists."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    cells: Annotated[int | None, _CELLS, _hint("512")] = None
    """Most cells to cut the space into; as small as that allows."""
    cell_size: Annotated[float | None, _DISTANCE, _hint("the smallest that --cells allows")] = None
    """Side of a cell, scene units."""
    box: Annotated[tuple[float, ...] | None, _BOX, _hint("the navigable space of the scene")] = None
    """Eyes may be anywhere in this box, frame of SCENE."""
    path: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: no path)")] = None
    """Eyes follow this walk: a CSV of poses (t,x,y,z,qw,qx,qy,qz) or an EyeNavGS recording, frame of SCENE."""
    margin: Annotated[float | None, _DISTANCE, _hint("3 voxels of the navigable space")] = None
    """How far eyes may be from --path, scene units."""
    retarget: Flag = False
    """Bring --path into the scene by a similarity transform, where it was recorded in another frame."""
    up: Annotated[str | None, arg(metavar="AXIS", help_behavior_hint="(default: the likely one)")] = None
    """Axis that points upwards in the scene, such as -y."""
    method: Annotated[Literal["hybrid", "raster", "raycast"], _PLAIN] = "hybrid"
    """z-buffer and hidden points, cubemap images, or rays. (default: hybrid)"""
    size: Annotated[int | None, _FACE_PIXELS, _hint("320")] = None
    """Pixels or rays along a side of the six faces around a viewpoint."""
    tau: Annotated[float, _TAU, _hint("1/255")] = 1.0 / 255.0
    """Weight from which a Gaussian counts as visible."""
    growth: Annotated[float | None, _SHARE, _hint("0.01")] = None
    """A cell is done when two viewpoints in turn made its set grow by at most this share."""
    max_viewpoints: Annotated[int | None, _COUNTED, _hint("24")] = None
    """Viewpoints after which a cell is done in any case."""
    workers: Annotated[int | None, _COUNTED, _hint("one for each core")] = None
    """Processes that look; fewer are started if --max-memory asks for it."""
    max_memory: Annotated[int | None, _BYTES, _hint("no bound")] = None
    """Memory that all processes together may take, such as 4GB or 2GiB."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="(default: this machine)")] = None
    """Work on the Dask cluster of this scheduler, such as tcp://10.0.0.5:8786; extra 'cluster'."""
    dry_run: Flag = False
    """Try a few cells, tell time, memory and disk, and write nothing."""
    json: Flag = False
    """Print one JSON document instead of tables."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class PvsReport:
    """Measure how good the sets of a store are; write a report."""

    store: Annotated[Positional[str], arg(metavar="STORE", help_behavior_hint="")]
    """What gsvis pvs wrote."""
    scene: Scene
    """The scene it was built from: a file or folder, or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="DIR", help_behavior_hint="(required)")]
    """Folder for report.html (all in one file), report.json and the pictures; made if missing."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    cells: Annotated[int, _COUNTED] = 10
    """Cells to measure, drawn at random; all if there are not more."""
    viewpoints: Annotated[int, _COUNTED] = 4
    """Fresh viewpoints in each of them."""
    dense: Annotated[int, _WHOLE] = 27
    """Further viewpoints whose union the set is compared with in size; 0 for none."""
    width: Annotated[int, _PIXELS] = 480
    """Pixels across the images."""
    height: Annotated[int, _PIXELS] = 360
    """Pixels down the images."""
    fov: Annotated[float, _DEGREES, _hint("70")] = 70.0
    """Horizontal field of view of the images."""
    rays: Flag = False
    """Ask by ray casting, too, what the fresh viewpoints see."""
    bytes_per_gaussian: Annotated[int | None, _COUNTED, _hint("32 bits for each attribute")] = None
    """What sending one Gaussian costs."""
    seed: Annotated[int, _WHOLE] = 0
    """Seed of everything random: the same seed gives the same report."""
    json: Flag = False
    """Print report.json on standard output instead of tables."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Color:
    """Put a base colour and a few terms in place of SH colours, to be sent in pieces."""

    scene: Scene
    """File or folder (.ply, .compressed.ply, .splat, .spz, .sog, lod-meta.json), or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """The Arrow file to write, such as scene.arrow: geometry, base colours and terms; replaced if it exists."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    pvs: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: directions are traced)")] = None
    """Visible sets of this scene (gsvis pvs): they tell from where each Gaussian is seen."""
    variant: Annotated[Literal["hsl", "hsl-l", "hsv", "yuv", "axis", "axes", "axes-split", "rgb"], _PLAIN] = "rgb"
    """How colours are split; the first four are the paper's. (default: rgb)"""
    max_terms: Annotated[int | None, _TERMS, _hint("8")] = None
    """Most terms of each function of a Gaussian; 0 leaves base colours alone."""
    mean_terms: Annotated[float | None, _MEAN_TERMS, _hint("2")] = None
    """Terms a Gaussian on average; they go where they serve most. With all, each that lowers an error."""
    no_refine: Flag = False
    """Leave terms on the grid that they are chosen from: quicker, and worse."""
    views: Annotated[int, _COUNTED] = 96
    """Views that tell how much each Gaussian counts."""
    held_out: Annotated[int, _WHOLE] = 8
    """Further views, for the comparison with SH; 0 for none."""
    width: Annotated[int, _PIXELS] = 480
    """Pixels across these, and across those of --epsilon auto and --staircase."""
    height: Annotated[int, _PIXELS] = 360
    """Pixels down."""
    up: Annotated[str | None, arg(metavar="AXIS", help_behavior_hint="(default: the likely one)")] = None
    """Axis that points upwards in the scene, such as -y; not with --pvs."""
    seed: Annotated[int, _WHOLE] = 0
    """Seed of everything random: the same seed gives the same file."""
    precision: Annotated[Literal["coarse", "wire", "fine", "exact"], _PLAIN] = "wire"
    """Bits of what is written; exact keeps 32 bits a number. (default: wire)"""
    epsilon: Annotated[float | None, _EPSILON, _hint("auto where it is needed")] = None
    """Change of colour from which a term is active; auto asks the metric FLIP what an eye would see."""
    active: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Write the terms that each cell of --pvs needs, such as scene.terms.arrow."""
    report: Annotated[str | None, arg(metavar="DIR", help_behavior_hint="(default: none)")] = None
    """Folder for report.html (all in one file), report.json and the pictures; made if missing."""
    staircase: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Write a web page on which a person finds their own epsilon, such as test.html."""
    json: Flag = False
    """Print one JSON document instead of tables."""
    debug: Flag = False
    """Show the traceback of an error."""


Command = Inspect | Analyze | Render | Pvs | PvsReport | Color | Convert
