"""A small scene as a package, a walk through it, and everything that is played in tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsvis.package import Package, PackageInfo, write_package
from gsvis.scene.paths import HeadPath
from gsvis.simulate import Stage, ViewingConfig
from gsvis.stream import StreamedScene
from tests.package.worlds import EPSILON, colors_of, levels_of, sets_of

QUICK = ViewingConfig(seconds=2.0, fine=1.0, every=0.5, width=48, height=36)


def package_of(folder: Path, n: int = 600, *, stores: bool = True, seed: int = 0) -> Package:
    levels = levels_of(n, seed)
    _, colors = colors_of(n, "rgb", seed)
    sets = sets_of(folder / "stores", levels) if stores else None
    info = PackageInfo(epsilon=EPSILON if stores else None)
    return write_package(folder / "scene.gsvis", levels, colors, info=info, visibility=sets)


def street(folder: Path, n: int = 600, *, stores: bool = True) -> tuple[StreamedScene, Stage]:
    scene = StreamedScene.open(package_of(folder, n, stores=stores))
    return scene, Stage(scene.contents)


def walk(seconds: float = 4.0, turn: float = 0.4) -> HeadPath:
    """Past the scene, turning about the vertical axis: +z looks along x at first."""
    times = np.arange(int(seconds * 10) + 1) / 10.0
    angles = turn * times
    ahead = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(times)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(ahead, up)
    rotations = np.stack([right, np.tile(-up, (len(times), 1)), ahead], axis=2)
    from gsvis.scene.gaussians import quats_from_rotations

    positions = np.stack([-1.0 + 0.2 * times, np.zeros_like(times), np.zeros_like(times)], axis=1)
    return HeadPath(times, positions, quats_from_rotations(rotations), up)
