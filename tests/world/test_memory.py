"""What the package of a tile needs follows its largest level and all that stands around it."""

from __future__ import annotations

import itertools
from dataclasses import asdict
from typing import Any

from gsvis.jobs.cost import needed_memory
from gsvis.prepare.config import PrepareConfig
from gsvis.pvs.config import PvsConfig
from gsvis.world.build import plan_districts
from gsvis.world.packages import tile_memory

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


def chosen(side: int) -> tuple[int, int]:
    """Bytes of the choice of nodes of a tile in the middle of a square of tiles, and Gaussians of all districts."""

    def tree(x: int, y: int, size: int) -> Any:
        half = size // 2
        return (
            x * side + y if size == 1 else [tree(x + a, y + b, half) for a, b in itertools.product((0, half), repeat=2)]
        )

    plans = [asdict(plan) for plan in plan_districts(tree(0, 0, side), range(side**2), side**2)]
    facts = []
    for plan in plans:
        x, y = zip(*(divmod(tile, side) for tile in plan["tiles"]), strict=True)
        corners = {"low": [min(x), min(y), 0.0], "high": [max(x) + 1.0, max(y) + 1.0, 0.1]}
        facts.append({**corners, "spacing": 0.015 * len(x) ** 0.5, "gaussians": 8_000})
    params = {"tile": side // 2 * (side + 1), "tiles": side**2, "districts": plans, "angle": 0.006}
    own = {"gaussians": 9_000, "levels": [["low", 1_000], ["high", 9_000]]}
    return needed_memory("gsvis.world.pieces:choose_nodes", params, [own, SPACE, *facts]), 8_000 * len(plans)


def test_a_choice_of_nodes_needs_memory_for_what_stands_around_a_tile_not_for_the_world() -> None:
    (small, few), (large, many) = chosen(16), chosen(64)
    assert many > 15 * few
    assert large < 3.0 * small
    assert large < 150 * many  # 550 bytes for each that stands
