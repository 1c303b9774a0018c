"""The commands and their arguments, as dataclasses that `tyro` turns into a command line and its help.

Nothing heavy is imported here: `gsvis --help` has to be quick.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import Positional, arg
from tyro.constructors import PrimitiveConstructorSpec

__all__ = ["Analyze", "Command", "Convert", "Inspect"]


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


def _spec(nargs: int, metavar: str, read: Callable[[list[str]], Any]) -> Any:
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


def _read_face_rays(words: list[str]) -> int:
    if words[0] not in ("1", "4", "16", "64"):
        raise ValueError(f"expected 1, 4, 16 or 64 rays, got {words[0]!r}")
    return int(words[0])


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


Command = Inspect | Analyze | Convert
