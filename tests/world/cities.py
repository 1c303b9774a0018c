"""A small city for tests: a street of a few thousand Gaussians, with options that take seconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from benchmarks._worlds import small_street
from gsvis.io.ply import save_ply
from gsvis.prepare.config import PrepareConfig
from gsvis.pvs.config import PvsConfig
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.levels import LevelsConfig
from gsvis.world.config import WorldConfig
from gsvis.world.prepare import prepare_world
from gsvis.world.tiling import TilingConfig

__all__ = ["config", "content", "street", "write", "write_city", "write_long_city"]


def street() -> Gaussians:
    return small_street(houses=2, step=0.4, flyaways=12)


def config(levels: LevelsConfig | None = None, most: int = 700) -> WorldConfig:
    views = {
        "level_views": ViewSampling(4, 48, 36, 90.0),
        "cost_views": ViewSampling(1, 32, 24, 60.0, stream=3),
        "fidelity_views": ViewSampling(1, 32, 24, 60.0, stream=5),
    }
    sets = PvsConfig(size=24, lower_size=16, limit=0.05, rays=128, max_inner=1)
    package = PrepareConfig(levels=levels, level_held_out=0, cells=2, sets=sets, **views)
    return WorldConfig(TilingConfig(most, up="+z"), package, far=64, angle=0.1, looks=6, resolution=32)


def write(g: Gaussians, path: Path) -> tuple[str, None]:
    save_ply(g, path)
    return str(path), None


def write_city(folder: Path) -> None:
    """Write the street and a world of it, with the options of `config`."""
    prepare_world([write(street(), folder / "street.ply")], folder / "city.gsworld", config())


def write_long_city(folder: Path) -> None:
    """Write a long world of two levels with districts that are seen; what lies outside has one level."""
    levels = LevelsConfig((0.3,), (0.8,), ("low", "high"), iterations=2, preview=0.0)
    scene = write(small_street(houses=4, step=0.5, flyaways=12), folder / "street.ply")
    prepare_world([scene], folder / "city.gsworld", replace(config(levels, most=320), angle=0.8))


def content(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
