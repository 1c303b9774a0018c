"""Read and write files: one format, one module; cameras and poses too."""

from __future__ import annotations

from gsvis.io.cameras import load_cameras
from gsvis.io.checkpoint import from_gsplat
from gsvis.io.convert import convert_scene, merge_scenes
from gsvis.io.points import load_points
from gsvis.io.scenes import load_scene, save_scene

__all__ = ["convert_scene", "from_gsplat", "load_cameras", "load_points", "load_scene", "merge_scenes", "save_scene"]


def __dir__() -> list[str]:
    return sorted(__all__)
