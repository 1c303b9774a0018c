"""What the package of a tile needs follows its largest level and all that stands around it."""

from __future__ import annotations

from typing import Any

from gsvis.prepare.config import PrepareConfig
from gsvis.pvs.config import PvsConfig
from gsvis.world.memory import needed_memory, tile_memory

RUN = "gsvis.world.packages:prepare_tile"
SPACE = {"voxels": 9}


def tile(low: int, high: int) -> dict[str, Any]:
    return {"gaussians": high, "levels": [["low", low], ["high", high]], "spacings": [0.2, 0.1]}


def need(*around: dict[str, Any], voxels: int = 9) -> int:
    params = {"outside": False, "config": PrepareConfig().as_dict()}
    return needed_memory(RUN, params, [tile(2_000, 9_000), {"voxels": voxels}, *around])


def test_only_the_largest_level_is_in_memory() -> None:
    sets = PvsConfig()
    alone = tile_memory(50, [800], 1000, 0, sets)
    assert tile_memory(50, [300, 700, 800], 1000, 0, sets) == alone
    grown = [(60, [800], 1000, 0), (50, [801], 1000, 0), (50, [800], 1001, 0), (50, [800], 1000, 1)]
    assert all(tile_memory(*each, sets) > alone for each in grown)


def test_districts_stand_whole_and_tiles_in_part_but_never_below_their_lowest_level() -> None:
    district = {"gaussians": 6_000, "levels": [["far", 6_000]], "spacing": 1.0}
    assert need(district) == need(tile(6_000, 6_001))
    assert need() < need(tile(1, 6_000)) < need(district) < need(district, district)


def test_a_tile_without_eyes_needs_nothing_around_it() -> None:
    assert need(tile(2_000, 10**7), voxels=0) == need(voxels=0)
