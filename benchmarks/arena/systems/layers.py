"""LapisGS-like and L3GS-like layers, of `benchmarks/paper/rivals`: our trained levels in another order and codec.

They show our records, with all of the terms of our colors, and cost the bytes of SOG. So they differ from gsvis by
what is sent when, and are no copies of what their authors train.

References:
    Shi et al., "LapisGS: Layered Progressive 3D Gaussian Splatting for Adaptive Streaming", 2025.
    Tsai et al., "L3GS: Layered 3D Gaussian Splats for Efficient 3D Scene Delivery", 2025.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from paper.rivals import LayerByLayer, Layers, Sender

from arena.course import Course
from arena.streams import Streamed
from arena.systems.gaussians import HALF, SCENE
from arena.systems.ours import OURS, open_package
from arena.systems.system import System
from gsvis.abr import FieldOfView
from gsvis.files.temporary import temporary_folder
from gsvis.io import load_scene, save_scene
from gsvis.package.contents import Contents
from gsvis.simulate import Stage

__all__ = ["SYSTEMS"]


def _lapis(contents: Contents, view: FieldOfView, gaussian_bytes: float) -> Sender:
    """Return one whole layer after the other."""
    return LayerByLayer(contents, gaussian_bytes, measured="SOG of the scene")


def _l3gs(contents: Contents, view: FieldOfView, gaussian_bytes: float) -> Sender:
    """Return segments of layers by their utility for the view."""
    return Layers(contents, view, gaussian_bytes, measured="SOG of the scene")


def _open(make: Callable[[Contents, FieldOfView, float], Sender]) -> Callable[[Course, Path], Streamed]:
    """Return an opener of the package of gsvis that is sent in layers."""

    def open_here(course: Course, folder: Path) -> Streamed:
        _, streamed = open_package(folder)
        scene = load_scene(folder.parent / HALF.name / SCENE)
        with temporary_folder() as work:
            file = Path(work) / "scene.sog"
            save_scene(scene, file)
            gaussian_bytes = file.stat().st_size / len(scene)
        stage = Stage(streamed.contents)

        def deliver() -> Sender:
            sender = make(streamed.contents, course.field_of_view, gaussian_bytes)
            sender.exact = False  # the records are what was trained, not the scene before
            return sender

        nbytes = int(deliver().pieces.nbytes.sum())
        return Streamed(stage, deliver, nbytes, int(stage.highest.sum()))

    return open_here


_SIMPLIFIED = "our trained levels are the layers; they show our records and cost the bytes of SOG"

SYSTEMS = (
    System("layers, LapisGS", OURS, _open(_lapis), "Shi et al., 2025", _SIMPLIFIED),
    System("layers, L3GS", OURS, _open(_l3gs), "Tsai et al., 2025", _SIMPLIFIED),
)
