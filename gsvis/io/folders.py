"""Suggest a file to a user who gave a folder. Looks at names only, reads no file."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from gsvis.io.colmap import find_colmap

__all__ = ["cameras_remedy", "scene_remedy"]

_SCENES = (".ply", ".spz", ".sog", ".splat", ".ksplat", ".pt", ".pth", ".ckpt")
_INDICES = ("lod-meta.json", "meta.json")
_NO_SCENES = ("input.ply", "points3d.ply", "sparse_pc.ply")  # points that training starts from
_DEEPEST = 4  # output/point_cloud/iteration_30000/point_cloud.ply is three below
_MOST_ENTRIES = 5000


def scene_remedy(folder: Path) -> str:
    """Return advice that names the most likely scene file in or below a folder; '' if there is none.

    Of several files it names the one with the highest numbers in its path, because trainers put step counts there.
    """
    found = []
    for parent, names in _walk(folder):
        for name in names:
            lowered = name.lower()
            if lowered in _INDICES or (lowered.endswith(_SCENES) and lowered not in _NO_SCENES):
                found.append(Path(parent, name))
    if found:
        best = max(found, key=lambda path: [int(part) if i % 2 else part for i, part in enumerate(_parts(path))])
        return f"name a file in it, such as {best}" + (f" (of {len(found)})" if len(found) > 1 else "")
    photos = _cameras_in(folder)
    return f"cameras of photographs are in {photos}: gsvis train makes a scene of them" if photos else ""


def cameras_remedy(folder: Path) -> str:
    """Return advice that names the first folder below with cameras of photographs; '' if there is none."""
    found = _cameras_in(folder)
    return f"name the folder of one model, such as {found}" if found else ""


def _cameras_in(folder: Path) -> str:
    """Return the first folder with cameras in or below a folder; '' if there is none."""
    return next((p for p, names in _walk(folder) if find_colmap(Path(p)) or "transforms.json" in names), "")


def _parts(path: Path) -> list[str]:
    """Split the path into texts and numbers in turn."""
    return re.split(r"(\d{1,18})", str(path))


def _walk(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield folders, this one first, with the names of their files; limited in depth and number."""
    seen = 0
    base = len(folder.parts)
    for parent, folders, names in os.walk(folder):
        seen += len(folders) + len(names)
        if seen > _MOST_ENTRIES:
            return
        if len(Path(parent).parts) - base >= _DEEPEST:
            folders.clear()
        folders.sort()
        yield parent, names
