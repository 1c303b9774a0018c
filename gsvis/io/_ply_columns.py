"""Find the columns of a PLY of Gaussians by the names that programs give them.

INRIA's names are the rule. CloudCompare prefixes names that it does not know with `scal_`, `scalar_` or `sf_`. 2DGS
has two scales. Mip-Splatting keeps its 3D filter in its own column. Some exporters write RGB instead of harmonics.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass

from gsvis.errors import FormatError
from gsvis.io._ply_header import Element, PlyHeader

__all__ = ["Columns", "find_columns", "refuse_other_kinds"]

MEANS = ("x", "y", "z")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
REQUIRED = (*MEANS, *SH0, "opacity", *SCALES, *QUATS)

_RGB = ("red", "green", "blue")
_FILTER = "filter_3d"
_PREFIX = re.compile(r"(?:scal_|scalar_|sf_)+")
_ALIASES = {"rotation": "rot", "scaling": "scale", "features_dc": "f_dc", "features_rest": "f_rest"}
_NUMBERED = re.compile(r"(.+)_(\d+)")
_PER_CHANNEL = 15  # coefficients of degree 1 to 3


@dataclass(frozen=True)
class Columns:
    """The names of the columns of Gaussians, as the file spells them.

    Attributes:
        means: Columns of x, y and z.
        quats: Columns of w, x, y and z.
        scales: Columns of the log scales; three, or two for flat Gaussians.
        opacity: Column of the logit of the opacity.
        sh0: Columns of the constant coefficients, or of RGB.
        is_rgb: Whether `sh0` names RGB.
        higher: Columns of the higher coefficients, in order; red, green and blue of each are adjacent.
        degree: SH degree of the file; `higher` stops at degree 3.
        filter: Column of the 3D filter of Mip-Splatting; empty without one.
    """

    means: tuple[str, ...]
    quats: tuple[str, ...]
    scales: tuple[str, ...]
    opacity: str
    sh0: tuple[str, ...]
    is_rgb: bool
    higher: tuple[str, ...]
    degree: int
    filter: str


def find_columns(path: str | os.PathLike[str], vertex: Element) -> Columns:
    """Return the columns of an element of Gaussians.

    Raises:
        FormatError: If a property is missing or the number of f_rest columns fits no SH degree.
    """
    spelled = _spellings(vertex)
    is_rgb = not any(name in spelled for name in SH0) and all(name in spelled for name in _RGB)
    colors = _RGB if is_rgb else SH0
    flat = all(name in spelled for name in SCALES[:2]) and SCALES[2] not in spelled
    scales = SCALES[:2] if flat else SCALES
    required = (*MEANS, *colors, "opacity", *scales, *QUATS)
    missing = [name for name in required if name not in spelled]
    if missing:
        raise FormatError(path, "element vertex", f"properties {', '.join(REQUIRED)}", f"no {', '.join(missing)}")
    higher, degree = _higher(path, spelled)
    return Columns(
        means=_named(spelled, MEANS),
        quats=_named(spelled, QUATS),
        scales=_named(spelled, scales),
        opacity=spelled["opacity"],
        sh0=_named(spelled, colors),
        is_rgb=is_rgb,
        higher=higher,
        degree=degree,
        filter=spelled.get(_FILTER, ""),
    )


def refuse_other_kinds(header: PlyHeader, vertex: Element) -> None:
    """Raise if the file is a mesh or a point cloud without Gaussians."""
    have = set(_spellings(vertex))
    if have & set(REQUIRED) - set(MEANS):
        return
    mesh = any(element.name in ("face", "tristrips") for element in header.elements)
    if mesh or set(MEANS) <= have:
        kind = "a mesh" if mesh else "a point cloud"
        expected = f"Gaussians ({', '.join(REQUIRED)})"
        remedy = f"this PLY is {kind}, not a trained scene"
        got = f"{kind} ({', '.join(sorted(vertex.properties))[:200]})"
        raise FormatError(header.path, "element vertex", expected, got, remedy)


def _named(spelled: dict[str, str], names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names as the file spells them."""
    return tuple(spelled[name] for name in names)


def _spellings(vertex: Element) -> dict[str, str]:
    """Return the file's spelling of each name of INRIA; an exact spelling wins over variants."""
    spelled: dict[str, str] = {}
    for name in vertex.properties:
        spelled.setdefault(_inria_name(name), name)
    return spelled | {name: name for name in vertex.properties}


def _inria_name(name: str) -> str:
    """Return INRIA's name of a column."""
    lower = name.lower()
    bare = _PREFIX.sub("", lower, count=1) if _PREFIX.match(lower) else lower
    numbered = _NUMBERED.fullmatch(bare)
    if numbered and numbered[1] in _ALIASES:
        return f"{_ALIASES[numbered[1]]}_{numbered[2]}"
    return bare


def _higher(path: str | os.PathLike[str], spelled: dict[str, str]) -> tuple[tuple[str, ...], int]:
    """Return the f_rest columns of degree 1 to 3 in the order of `shN`, and the degree of the file."""
    rest = sum(bool(re.fullmatch(r"f_rest_\d+", name)) and name == _inria_name(name) for name in spelled)
    side = math.isqrt(rest // 3 + 1)
    if rest % 3 or side * side != rest // 3 + 1 or any(f"f_rest_{i}" not in spelled for i in range(rest)):
        expected = "0, 9, 24 or 45 properties f_rest_0, f_rest_1, ... (SH degree 0 to 3)"
        raise FormatError(path, "element vertex", expected, f"{rest}")
    per_channel = rest // 3
    read = range(min(per_channel, _PER_CHANNEL))
    return tuple(spelled[f"f_rest_{channel * per_channel + k}"] for k in read for channel in range(3)), side - 1
