"""Choose which nodes may be used around a tile, from facts of districts alone: no Gaussian is read.

The search goes from the coarsest district to finer ones. A district may be used if its spacing, divided by its distance
from the tile, is below an angle. If not, its children are tried, and in the end the tile itself is used. Scene frame
and units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["distances_of", "nodes_around", "own_districts"]

F64 = NDArray[np.float64]
Facts = Mapping[str, Any]


def distances_of(low: F64, high: F64, nodes: Sequence[Facts]) -> F64:
    """Return the distance (K,) between a box and the box of each of K nodes; 0 if they touch or overlap.

    Args:
        low: (3,) lowest corner.
        high: (3,) highest corner.
        nodes: Facts of the nodes, with their corners `low` and `high`.
    """
    lows, highs = (np.array([each[name] for each in nodes], np.float64).reshape(-1, 3) for name in ("low", "high"))
    apart = np.maximum(np.maximum(lows - high, low - highs), 0.0)
    return np.asarray(np.linalg.norm(apart, axis=1))


def own_districts(plans: Sequence[Facts]) -> dict[int, int]:
    """Return for each tile the number of the district that replaces only this tile.

    Args:
        plans: `children` and `tiles` of each district.
    """
    return {plan["tiles"][0]: k for k, plan in enumerate(plans) if len(plan["tiles"]) == 1}


def nodes_around(params: Facts, districts: Sequence[Facts], distances: F64) -> tuple[list[int], list[int]]:
    """Return the coarsest districts that may be used, and the tiles whose districts may not, both ascending.

    Args:
        params: Params of `choose_nodes`: `tile`, `tiles`, `districts` and `angle`.
        districts: Facts of the districts, with their `spacing`.
        distances: (K,) distance of each district.
    """
    plans = params["districts"]
    count = params["tiles"]
    stack = sorted(set(range(len(plans))) - {child - count for plan in plans for child in plan["children"]})
    standing = list[int]()
    tiles = list[int]()
    while stack:
        k = stack.pop()
        members = plans[k]["tiles"]
        spacing = districts[k]["spacing"]
        if params["tile"] not in members and spacing <= params["angle"] * distances[k]:
            standing.append(k)
        elif len(members) == 1:
            tiles += [tile for tile in members if tile != params["tile"]]
        else:
            stack += [child - count for child in plans[k]["children"]]
    return sorted(standing), sorted(tiles)
