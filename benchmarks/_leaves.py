"""What the benchmarks of scenes in leaves share: scenes, visible sets, walks, arguments, figures."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, realdata

from gsvis.io import load_scene
from gsvis.io.eyenav import read_eyenav
from gsvis.pvs import CellGrid, PvsConfig, VisibilityStore, build_pvs
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.retarget import RetargetConfig, retarget

_SCENES = {"showroom": ("showroom", 3), "nika": ("nika_sh3", 0)}
_USERS = (110, 119)
COARSE = PvsConfig(method="raster", size=256, lower_size=128, probes=4, limit=0.01, tile_limit=0.5)
"""Visible sets that take a third of the time."""


def parse_arguments(description: str | None) -> argparse.Namespace:
    """Return the arguments, after checking that there is data; create the folder of --work."""
    parser = add_arguments(argparse.ArgumentParser(description=description))
    parser.add_argument("--work", type=Path, help="folder for visible sets and exports; visible sets in it are used")
    parser.add_argument("--scene", default="showroom", choices=list(_SCENES))
    parser.add_argument("--cells", type=int, default=512)
    parser.add_argument("--coarse", action="store_true", help="build visible sets from cubemaps of 256 pixels")
    parser.add_argument("--leaf", type=int, default=8192)
    parser.add_argument("--eyes", type=int, default=10, help="on each of the two walks")
    args = parser.parse_args()
    need(args.work, "--work DIR: visible sets of the scenes take some minutes each")
    realdata()
    args.work.mkdir(parents=True, exist_ok=True)
    return args


def open_scene(name: str) -> tuple[Gaussians, NavigableSpace]:
    """Return a scene and its navigable space."""
    folder, lod = _SCENES[name]
    g = load_scene(realdata() / "scenes" / folder / "lod-meta.json", lod=lod)
    return g, NavigableSpace.from_scene(g)


def visible_sets(
    work: Path, name: str, g: Gaussians, space: NavigableSpace, cells: int, coarse: bool = False
) -> VisibilityStore:
    """Return the visible sets of a scene; build them if the folder has none."""
    path = work / f"{name}.pvs"
    if not path.exists():
        config = COARSE if coarse else None
        build_pvs(g, CellGrid.over(space, max_cells=cells), space, path, config).close()
    return VisibilityStore.open(path, scene=g)


def walks(space: NavigableSpace, eyes: int) -> Iterator[tuple[int, HeadPath, Cameras]]:
    """Yield each user, the walk of so many eyes, evenly spaced in time, and their cameras."""
    for user in _USERS:
        recorded = read_eyenav(realdata() / "traces" / "eyenav_rutgers" / "room" / f"user{user}_room.csv.gz")
        moved = retarget(recorded, space, RetargetConfig(seed=user, project=True)).path
        walk = moved.resample(times=np.linspace(0.0, moved.duration, eyes))
        yield user, walk, walk.cameras(480, 360, 80.0)


def name_figures(scene: str, rows: Sequence[tuple[Any, ...]]) -> list[dict[str, Any]]:
    """Return rows of (name, target, reached, unit, better) as figures of a scene."""
    keys = ("name", "target", "reached", "unit", "better")
    return [dict(zip(keys, (f"{scene}: {row[0]}", *row[1:]), strict=True)) for row in rows]


def facts_of(report: Any) -> dict[str, Any]:
    """Return the fields of the report of an export, without its path."""
    return {key: value for key, value in vars(report).items() if key != "path"}
