"""A small manifest of a world: three tiles, of which one lies outside, and their districts."""

from __future__ import annotations

from gsvis.world.manifest import BeyondTable, District, Grid, Piece, Tile, WorldManifest

__all__ = ["example"]

A, B, C = ("a" * 64, "b" * 64, "c" * 64)
LOW, HIGH = (0.0, 0.0, 0.0), (1.0, 2.0, 3.0)


def example() -> WorldManifest:
    pieces = (Piece(1, 1, ((0, 4), (6, 2))), Piece(1, 0, ((4, 2),)), Piece(2, 0, ((0, 3),)))
    tiles = (
        Tile((0, 0), LOW, HIGH, A, 10, (("low", 2), ("high", 6)), 8, 3, BeyondTable(B, 5, pieces)),
        Tile((1, 0), LOW, HIGH, B, 10, (("low", 2), ("high", 6)), 8, 0, shape=(2, 1)),
        Tile(None, LOW, HIGH, C, 10, (("high", 5),), 5, 0),
    )
    districts = (
        District((0,), (0,), LOW, HIGH, 0.1, A, 4, 3),
        District((1,), (1,), LOW, HIGH, 0.1, B, 4, 3),
        District((3, 4), (0, 1), LOW, HIGH, 0.2, C, 4, 3),
    )
    grid = Grid((0.0, -1.0, 5.0), 2.0, (0, 1), (3, 1))
    return WorldManifest((0.0, 0.0, 1.0), 0.5, grid, tiles, districts, {"made_by": "a test"})
