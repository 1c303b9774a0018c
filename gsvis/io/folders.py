"""Remedies for a folder in place of a file: what in it, or below it, was probably meant. Knows names, reads nothing."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from gsvis.io.colmap import find_colmap

__all__ = ["cameras_remedy", "scene_remedy"]

_SCENES = (".ply", ".spz", ".sog", ".splat", ".pt", ".pth", ".ckpt")
_INDICES = ("lod-meta.json", "meta.json")
_NO_SCENES = ("input.ply", "points3d.ply", "sparse_pc.ply")  # the points that training starts from
_DEEPEST = 4  # output/point_cloud/iteration_30000/point_cloud.ply is three below
_MOST_ENTRIES = 5000


def scene_remedy(folder: Path) -> str:
    """Return the file in or below a folder that was probably meant as the scene, as advice; '' where there is none.

    Of several files the one with the highest numbers in its path is named: trainers count their steps there.
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
    """Return the first folder below that holds cameras of photographs, as advice; '' where there is none."""
    found = _cameras_in(folder)
    return f"name the folder of one model, such as {found}" if found else ""


def _cameras_in(folder: Path) -> str:
    return next((p for p, names in _walk(folder) if find_colmap(Path(p)) or "transforms.json" in names), "")


def _parts(path: Path) -> list[str]:
    """Return the path as texts and numbers in turn."""
    return re.split(r"(\d{1,18})", str(path))


def _walk(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Folders, this one first, with the names of their files; not too deep and not too many."""
    seen, base = 0, len(folder.parts)
    for parent, folders, names in os.walk(folder):
        seen += len(folders) + len(names)
        if seen > _MOST_ENTRIES:
            return
        if len(Path(parent).parts) - base >= _DEEPEST:
            folders.clear()
        folders.sort()
        yield parent, names
