"""3DGS by the trainer of gsvis, sent as one file: PLY, SPZ or SOG.

The rows of a PLY are shown as they arrive, the largest and most opaque first, as converters of web viewers sort them.
SPZ and SOG hold one plane after another for all Gaussians, so nothing is shown until the file is complete.

References:
    Kerbl et al., "3D Gaussian splatting for real-time radiance field rendering", TOG 2023.
    antimatter15/splat, `convert.py`: rows by volume times opacity.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from arena.budget import Allowance, Budget, train_gaussians
from arena.course import Course
from arena.stages import Stages, cut_rows
from arena.systems.system import System, Training
from gsvis.io import load_scene, save_scene
from gsvis.progress import Progress
from gsvis.scene.gaussians import Gaussians

__all__ = ["FULL", "HALF", "HALVES", "SYSTEMS"]

SCENE = "scene.ply"

HALVES = 0.5
"""Share of the budget of the plain training that systems with a second phase continue."""

_SOURCE = "Kerbl et al., TOG 2023"


def _train(course: Course, allowance: Allowance, folder: Path, progress: Progress, share: float = 1.0) -> None:
    """Train and write the scene, and the same as SPZ and SOG."""
    scene = train_gaussians(course, Budget(allowance, share), progress)
    save_scene(_sort_rows(scene), folder / SCENE)


def _train_full(course: Course, allowance: Allowance, folder: Path, progress: Progress) -> None:
    """Spend the whole budget, and write all three files."""
    _train(course, allowance, folder, progress)
    scene = load_scene(folder / SCENE)
    for suffix in (".spz", ".sog"):
        save_scene(scene, folder / f"scene{suffix}")


def _train_half(course: Course, allowance: Allowance, folder: Path, progress: Progress) -> None:
    """Spend the first half of the budget."""
    _train(course, allowance, folder, progress, HALVES)


def _sort_rows(g: Gaussians) -> Gaussians:
    """Return the same Gaussians, the largest and most opaque first."""
    weight = g.opacities * np.prod(g.scales.astype(np.float64), axis=1)
    return g[np.argsort(-weight, kind="stable")]


def _open_ply(course: Course, folder: Path) -> Stages:
    """Return the PLY, shown as it arrives."""
    scene = load_scene(folder / SCENE)
    nbytes = (folder / SCENE).stat().st_size
    row = 4.0 * (17 + 3 * scene.shN.shape[1])
    return cut_rows(nbytes - int(row * len(scene)), row, scene)


def _open_whole(suffix: str) -> Callable[[Course, Path], Stages]:
    """Return an opener of a file that shows nothing until it is complete."""

    def open_file(course: Course, folder: Path) -> Stages:
        path = folder / f"scene{suffix}"
        return Stages.at_once(path.stat().st_size, load_scene(path))

    return open_file


FULL = Training("3dgs", _train_full)
HALF = Training("half", _train_half)

SYSTEMS = (
    System("3DGS, PLY", FULL, _open_ply, _SOURCE),
    System("3DGS, SPZ", FULL, _open_whole(".spz"), f"{_SOURCE}; the format of Niantic, 2024"),
    System("3DGS, SOG", FULL, _open_whole(".sog"), f"{_SOURCE}; the format of PlayCanvas, 2025"),
)
