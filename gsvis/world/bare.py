"""Write packages without cells: districts, and tiles in which no eye can be. Base colors only, no visible sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsvis.color import quantize
from gsvis.files.limits import digest_of
from gsvis.package import Package, PackageInfo, in_package_order, write_package
from gsvis.package.manifest import MANIFEST, Manifest
from gsvis.prepare.colors import prepare_colors
from gsvis.scene.levels import Levels
from gsvis.world.rows import box_of, flatten

__all__ = ["PACKAGE", "Reach", "facts_of_package", "reach_of", "write_bare_package"]

Reach = Sequence[tuple[float, float]]
"""Least and largest value of each of three color components."""

PACKAGE = "package"
"""Name of the folder of a package among the files of a result."""


def write_bare_package(
    out: Path, levels: Levels, up: Sequence[float], meters_per_unit: float, reach: Reach | None = None
) -> tuple[Levels, dict[str, Any]]:
    """Write levels as a package with base colors.

    Args:
        out: Folder of the result of a task, in which the package is written.
        levels: The levels.
        up: (3,) unit axis that points upward.
        meters_per_unit: Meters in a scene unit; 0 if unknown.
        reach: Least and largest value of each component of base colors in the world.

    Returns:
        The levels in the order of the package, and its facts.
    """
    flat = Levels(flatten(levels.union), levels.first, levels.last, levels.names)
    ordered = in_package_order(flat)
    colors = quantize(prepare_colors(ordered, None).fit.colors, "wire", reach=reach)
    x, y, z = (float(v) for v in up)
    info = PackageInfo((x, y, z), meters_per_unit)
    with write_package(out / PACKAGE, ordered, colors, info=info) as package:
        return ordered, facts_of_package(package, ordered)


def facts_of_package(package: Package, levels: Levels) -> dict[str, Any]:
    """Return the facts of a package for the manifest of a world: name, sizes, and the box around its centers."""
    m: Manifest = package.manifest
    path = package.path / MANIFEST
    parts = {part.name: part.nbytes for part in m.parts()}
    return {
        "package": digest_of(path),
        "bytes": path.stat().st_size + sum(parts.values()),
        "gaussians": m.gaussians,
        "levels": [[name, count] for name, count in zip(m.names, m.counts, strict=True)],
        **box_of(levels.union.means),
    }


def reach_of(params: Mapping[str, Any]) -> tuple[tuple[float, float], ...]:
    """Return the reach of base colors from the params of a task."""
    return tuple((float(low), float(high)) for low, high in params["reach"])
