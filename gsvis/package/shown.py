"""Load a scene or a package to look at it: a package gives its levels, with SH colors fitted to its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsvis.io.sources import check_source, is_builtin, load_source, title_of
from gsvis.scene.source import Source

__all__ = ["check_shown", "is_package", "judged_of", "load_shown"]


def is_package(path: str) -> bool:
    """Return whether a path is the folder of a package."""
    from gsvis.package.manifest import MANIFEST

    return not is_builtin(path) and (Path(path) / MANIFEST).is_file()


def judged_of(path: str) -> dict[str, Any] | None:
    """Return how a package was checked by other eyes when it was made; None for a scene, or where it was not."""
    if not is_package(path):
        return None
    from gsvis.package.package import Package

    with Package.open(path) as package:
        judged = package.manifest.info.provenance.get("judged")
    return judged if isinstance(judged, dict) and isinstance(judged.get("line"), str) else None


def check_shown(scene: str, lod: int | None) -> None:
    """Raise unless there is a scene or a package of that name and `lod` fits it.

    Raises:
        ValueError: If there is no built-in scene of that name, or `lod` is given for what has none.
        FileNotFoundError: If there is no such file.
    """
    if lod is not None and is_package(scene):
        raise ValueError(f"--lod: expected none for a package, got {lod}; its highest level is shown")
    if not is_package(scene):
        check_source(scene, lod)


def load_shown(scene: str, lod: int | None) -> Source:
    """Load a scene as `load_source` does, or a package.

    A package gives its levels. Its colors are those that a viewer shows, fitted with SH.

    Raises:
        GsvisError: If the file cannot be read as a scene, or the package is damaged.
        ValueError: If there is no built-in scene of that name, or `lod` is given for a package.
        FileNotFoundError: If there is no such file.
    """
    check_shown(scene, lod)
    if not is_package(scene):
        return load_source(scene, lod)
    from gsvis.package.package import Package
    from gsvis.package.unpack import unpack_levels

    with Package.open(scene) as package:
        levels = unpack_levels(package)
        up = np.array(package.manifest.info.up)
    return Source(title_of(scene), levels.level(len(levels) - 1), Path(scene), levels=levels, known_up=up)
