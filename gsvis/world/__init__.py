"""Worlds: many packages in one frame, so that no process has to hold more than a part of a city.

    prepare_world([("a.ply", None), ("b.ply", None)], "city.gsworld")
    world = World.open("city.gsworld")
    with world.package(world.tile_at(eye)) as package: ...

A single package is a world of one tile. docs/design/057-worlds.md explains the format, 058-graphs-of-tasks.md how
worlds are made. Modules that make worlds are imported on first use, so that a server needs no torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gsvis.world.beyond import Beyond, SeenNode
from gsvis.world.manifest import BeyondTable, District, Grid, Piece, Tile, WorldManifest
from gsvis.world.world import VerifiedWorld, World, is_world

if TYPE_CHECKING:
    from gsvis.world.coding import TileBytes
    from gsvis.world.config import WorldConfig
    from gsvis.world.estimate import WorldEstimate, estimate_world
    from gsvis.world.prepare import PreparedWorld, prepare_world
    from gsvis.world.stages import WrittenTile, write_tiles
    from gsvis.world.tiling import TilingConfig
    from gsvis.world.trial import Trial

__all__ = [
    "Beyond",
    "BeyondTable",
    "District",
    "Grid",
    "Piece",
    "PreparedWorld",
    "SeenNode",
    "Tile",
    "TileBytes",
    "TilingConfig",
    "Trial",
    "VerifiedWorld",
    "World",
    "WorldConfig",
    "WorldEstimate",
    "WorldManifest",
    "WrittenTile",
    "estimate_world",
    "is_world",
    "prepare_world",
    "write_tiles",
]

_HOMES = {
    "coding": ("TileBytes",),
    "config": ("WorldConfig",),
    "estimate": ("WorldEstimate", "estimate_world"),
    "prepare": ("PreparedWorld", "prepare_world"),
    "stages": ("WrittenTile", "write_tiles"),
    "tiling": ("TilingConfig",),
    "trial": ("Trial",),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"{__name__}.{home}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
