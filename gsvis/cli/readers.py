"""Parsers of single command-line values for `tyro`, with their error messages.

This module imports nothing heavy, so that `gsvis --help` is quick.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg
from tyro.constructors import PrimitiveConstructorSpec


def _number(metavar: str, kind: type[int] | type[float], low: float, high: float, what: str) -> Any:
    """Return a tyro parser of one number in [low, high]; `what` completes the message 'expected ...'."""

    def read(words: list[str]) -> float:
        try:
            value = kind(words[0])
        except ValueError:
            raise ValueError(f"expected {what}, got {words[0]!r}") from None
        if not low <= value <= high:
            raise ValueError(f"expected {what}, got {words[0]}")
        return value

    return _spec(1, metavar, read)


def spell(value: Any) -> list[str]:
    """Return a value as the words that are read as it."""
    if isinstance(value, tuple):
        return [word for each in value for word in spell(each)]
    return [f"{value:.9g}" if isinstance(value, float) else str(value)]


def _spec(
    nargs: int | Literal["*"],
    metavar: str,
    read: Callable[[list[str]], Any],
    write: Callable[[Any], list[str]] = spell,
) -> Any:
    """Return a tyro parser of `nargs` words; `write` undoes `read`."""
    return PrimitiveConstructorSpec(
        nargs=nargs,
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, int | float | str | tuple),
        str_from_instance=lambda value: [] if value is None else write(value),
    )


def _floats(words: Sequence[str]) -> tuple[float, ...]:
    """Return words as numbers; none if one of them is no number."""
    try:
        return tuple(map(float, words))
    except ValueError:
        return ()


def _read_box(words: list[str]) -> tuple[float, ...]:
    """Return the corners of a box, the low one first."""
    box = _floats(words)
    if not box:
        raise ValueError(f"expected six numbers, got {' '.join(words)}")
    if not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise ValueError(f"expected X0 < X1, Y0 < Y1 and Z0 < Z1, got {' '.join(words)}")
    return box


def _read_kind(words: list[str]) -> str:
    """Return the name of a kind of scene, or auto."""
    from gsvis.scene.kinds import KINDS

    known = ("auto", *KINDS)
    if words[0] not in known:
        raise ValueError(f"expected one of {', '.join(known)}, got {words[0]!r}")
    return words[0]


def _read_around(words: list[str]) -> tuple[float, ...]:
    """Return a center and a radius; none for auto."""
    if words == ["auto"]:
        return ()
    values = _floats(words)
    if len(values) != 4 or not all(abs(value) <= 1e30 for value in values) or not values[3] > 0.0:
        raise ValueError(f"expected auto, or a center X Y Z and a radius above 0, got {' '.join(words) or 'nothing'}")
    return values


def _numbers(metavar: str, low: float = -1e30, high: float = 1e30, what: str = "three finite numbers") -> Any:
    """Return a tyro parser of as many numbers in [low, high] as `metavar` has words."""

    def read(words: list[str]) -> tuple[float, ...]:
        values = _floats(words)
        if not values or not all(low <= value <= high for value in values):
            raise ValueError(f"expected {what}, got {' '.join(words)}")
        return values

    return _spec(len(metavar.split()), metavar, read)


def _words(metavar: str, what: str = "") -> Any:
    """Return a tyro parser of any number of words; at least one if `what` completes the message "expected ..."."""

    def read(words: list[str]) -> tuple[str, ...]:
        if what and not words:
            raise ValueError(f"expected {what}, got none")
        return tuple(words)

    return _spec("*", metavar, read)


def _read_indices(words: list[str]) -> tuple[int, ...]:
    """Return whole numbers, at least one."""
    if not words or not all(word.isdecimal() for word in words):
        raise ValueError(f"expected whole numbers of at least 0, got {' '.join(words) or 'none'}")
    return tuple(int(word) for word in words)


def _read_shares(words: list[str]) -> tuple[float, ...]:
    """Return shares in (0, 1], at least one."""
    values = _floats(words)
    if not values or not all(0.0 < value <= 1.0 for value in values):
        raise ValueError(f"expected shares in (0, 1], got {' '.join(words) or 'none'}")
    return values


def _read_pixel(words: list[str]) -> tuple[int, int]:
    """Return the column and the row of a pixel."""
    column, _, row = words[0].partition(",")
    if not (column.isdecimal() and row.isdecimal()):
        raise ValueError(f"expected a column and a row, such as 320,240, got {words[0]!r}")
    return int(column), int(row)


def _read_face_rays(words: list[str]) -> int:
    """Return a number of rays that divide a face evenly."""
    if words[0] not in ("1", "4", "16", "64"):
        raise ValueError(f"expected 1, 4, 16 or 64 rays, got {words[0]!r}")
    return int(words[0])


def _read_lods(words: list[str]) -> tuple[int, ...]:
    """Return levels of detail that commas separate."""
    parts = words[0].split(",")
    if not all(part.strip().isdecimal() and int(part) <= _COUNT for part in parts):
        raise ValueError(f"expected a whole number of at least 0, or several as in 3,2, got {words[0]!r}")
    return tuple(map(int, parts))


def _read_bytes(words: list[str]) -> int:
    """Return a number of bytes from a size with a unit."""
    found = re.fullmatch(r"(\d+(?:\.\d*)?)\s*([kmgt]?)(i?)b", words[0].strip().lower())
    size = float(found[1]) * (1024.0 if found[3] else 1000.0) ** " kmgt".index(found[2] or " ") if found else 0.0
    if not 1.0 <= size < 2.0**60:
        raise ValueError(f"expected a size such as 4GB, 2.5GiB or 500MB, got {words[0]!r}")
    return int(size)


def _read_mean_terms(words: list[str]) -> float:
    """Return a mean number of terms; infinity for all."""
    (value,) = (math.inf,) if words[0] == "all" else _floats(words[:1]) or (-1.0,)
    if not value >= 0.0:
        raise ValueError(f"expected a number of at least 0 or all, got {words[0]!r}")
    return value


def _read_epsilon(words: list[str]) -> float:
    """Return a change of color; 0 for auto."""
    if words[0] == "auto":
        return 0.0
    (value,) = _floats(words[:1]) or (-1.0,)
    if not 0.0 < value <= 1.0:
        raise ValueError(f"expected a change of color in (0, 1] or auto, got {words[0]!r}")
    return value


_COUNT = 10**9
WHOLE = _number("N", int, 0, _COUNT, "a whole number of at least 0")
COUNTED = _number("N", int, 1, _COUNT, "a whole number of at least 1")
PIXELS = _number("PX", int, 1, 16384, "1 to 16384 pixels")
DECIBELS = _number("DB", float, 0.0, 100.0, "0 to 100 dB")
DEGREES = _number("DEG", float, 1.0, 179.0, "degrees in [1, 179]")
WEIGHT = _number("W", float, 1e-6, 1.0, "a weight in [1e-6, 1]")
OPACITY = _number("A", float, 0.0, 1.0, "a value in [0, 1]")
SH_DEGREE = _number("D", int, 0, 3, "an SH degree of 0 to 3")
FACE_RAYS = _spec(1, "K", _read_face_rays)
BOX = _spec(6, "X0 Y0 Z0 X1 Y1 Z1", _read_box)
KIND = _spec(1, "KIND", _read_kind)
AROUND = _spec("*", "X Y Z R|auto", _read_around, lambda value: spell(value) or ["auto"])
POINT = _numbers("X Y Z")
ANGLES = _numbers("DEG DEG DEG", -36000.0, 36000.0, "three angles in [-36000, 36000] degrees")
SCALE = _number("S", float, 1e-9, 1e9, "a factor above 0, 1e-9 to 1e9")
COMPRESSION = _number("N", int, 0, 2, "0, 1 or 2")
COLOR = _numbers("R G B", 0.0, 1.0, "three numbers in [0, 1]")
INDICES = _spec("*", "I [I ...]", _read_indices)
PIXEL = _spec(1, "X,Y", _read_pixel, lambda value: [",".join(map(str, value))])
DISTANCE = _number("R", float, 1e-12, 1e12, "a distance above 0")
ELEVATION = _number("DEG", float, -89.0, 89.0, "degrees in [-89, 89]")
BYTES = _spec(1, "SIZE", _read_bytes, lambda value: [f"{value}B"])
FACE_PIXELS = _number("PX", int, 4, 4096, "4 to 4096 pixels")
TAU = _number("W", float, 1e-6, 0.5, "a weight in [1e-6, 0.5]")
SHARE = _number("S", float, 0.0, 1.0, "a share in [0, 1]")
PREVIEW_SHARE = _number("S", float, 0.0, 0.1, "a share in [0, 0.1]")
SHARES = _spec("*", "S [S ...]", _read_shares)
SHARES_OR_NONE = _spec(
    "*",
    "S [S ...]|none",
    lambda words: () if words == ["none"] else _read_shares(words),
    lambda value: spell(value) or ["none"],
)
NAMES = _words("NAME [NAME ...]", "a name for each level")
LODS = _spec(1, "N[,N...]", _read_lods, lambda value: [",".join(map(str, value))])
PATHS = _words("IN [IN ...] [OUT]")
SCENES = _words("SCENE [SCENE ...]")
RADIANS = _number("RAD", float, 1e-5, 1.0, "radians in [1e-5, 1]")
PACKAGES = _words("PACKAGE [PACKAGE ...]", "the folder of a package")
ORIGINS = _words("ORIGIN [ORIGIN ...]")
HOSTS = _words("NAME [NAME ...]")
ADDRESSES = _words("ADDRESS [ADDRESS ...]")
PORT = _number("N", int, 0, 65535, "a port of 0 to 65535")
SECONDS = _number("S", float, 0.01, 86400.0, "seconds in [0.01, 86400]")
CELLS = _number("N", int, 1, 100_000, "a whole number of 1 to 100000")
LEAF = _number("N", int, 64, 1 << 19, "a whole number of 64 to 524288")
FILL = _number("X", float, 0.1, 1e6, "0.1 to 1000000 splats")
TERMS = _number("N", int, 0, 32, "a whole number of 0 to 32")
MEAN_TERMS = _spec(1, "X|all", _read_mean_terms, lambda value: ["all"] if value == math.inf else spell(value))
WIDTH_PRICE = _number("X", float, 0.0, 1000.0, "a price of 0 to 1000")
WIDTH_LOSS = _number("DB", float, 0.0, 100.0, "dB of 0 to 100")
EPSILON = _spec(1, "E|auto", _read_epsilon, lambda value: spell(value) if value else ["auto"])
FACTOR = _number("F", float, 1.0, 64.0, "a factor of 1 to 64")
STEPS = _number("N", int, 1, 10_000_000, "a whole number of 1 to 10000000")
STRENGTH = _number("S", float, 0.01, 2.0, "a strength of 0.01 to 2")
RATE = _number("F", float, 0.1, 50.0, "0.1 to 50 frames a second")
FILES = _words("FILE [FILE ...]")
MBIT = _number("MBIT", float, 0.001, 100_000.0, "Mbit/s in [0.001, 100000]")
MILLISECONDS = _number("MS", float, 0.0, 10_000.0, "milliseconds in [0, 10000]")


def hint(text: str, metavar: str | None = None, about: str | None = None) -> Any:
    """Return the tyro setting that shows a text as the default in the help, a metavar, and what the option does."""
    return arg(metavar=metavar, help_behavior_hint=f"(default: {text})", help=about)


def out(metavar: str, missing: str = "(required)", about: str | None = None) -> Any:
    """Return the tyro setting of -o, with what the help says of a command without it, and what is written."""
    return arg(aliases=["-o"], metavar=metavar, help_behavior_hint=missing, help=about)


PLAIN = arg(help_behavior_hint="")

# Options of many commands, with their help. A string below a field says something else.
_SCENE = "File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."
_LOD = "Level of detail of a streamed scene; 0 is the finest."
_REPORT = "Folder for report.html (all in one file), report.json and the pictures; made if missing."
_SEED = "Seed of everything random: the same seed gives the same result."
_MEMORY = "Memory limit, such as 8GB: a scene that needs more is refused before it is read."
_PAPER = (
    "Take every piece as SRBF-Gaussian has it, save those that are given as well: short for a row of options, which"
    " docs/how-to/paper.md lists."
)
_FACE = "Pixels along a side of the six faces around an eye."

Scene = Annotated[Positional[str], arg(metavar="SCENE", help_behavior_hint="", help=_SCENE)]
Lod = Annotated[int | None, WHOLE, hint("the finest that is there", about=_LOD)]
Flag = Annotated[bool, PLAIN]
Overwrite = Annotated[bool, arg(help_behavior_hint="", help="Replace files that exist.")]
AsInPaper = Annotated[bool, arg(help_behavior_hint="", help=_PAPER)]
Count = Annotated[int | None, COUNTED]
Seed = Annotated[int, WHOLE, arg(help=_SEED)]
Units = Annotated[float | None, DISTANCE]
File = Annotated[str | None, hint("none", "FILE")]
Report = Annotated[str, out("DIR", about=_REPORT)]
Memory = Annotated[int | None, BYTES, hint("no bound", about=_MEMORY)]
FaceSize = Annotated[int | None, FACE_PIXELS, hint("512", about=_FACE)]
Up = Annotated[str | None, hint("the likely one", "UP")]
Device = Annotated[Literal["auto", "cpu", "cuda"], PLAIN]
