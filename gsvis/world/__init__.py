"""Worlds: many packages over one frame, so that no step and no process holds more than a piece of a city.

    world = World.open("city.gsworld")
    with world.package(world.tile_at(eye)) as package: ...

A package alone is a world of one tile. docs/design/057-worlds.md says why worlds are so.
"""

from __future__ import annotations

from gsvis.world.beyond import Beyond, Seen
from gsvis.world.manifest import BeyondTable, District, Grid, Piece, Tile, WorldManifest
from gsvis.world.world import VerifiedWorld, World, is_world

__all__ = [
    "Beyond",
    "BeyondTable",
    "District",
    "Grid",
    "Piece",
    "Seen",
    "Tile",
    "VerifiedWorld",
    "World",
    "WorldManifest",
    "is_world",
]
