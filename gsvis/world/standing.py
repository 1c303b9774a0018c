"""Which nodes may stand around a place, by what the facts of districts say: no Gaussian is read. Scene frame and units.

From the coarsest district down: a district may stand if its spacing, over its distance from the place, is below an
angle. Where it may not, those that it was made of are asked, and in the end its tile stands itself.
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
    """Return (K,) the distance between a box and that of each of K nodes; 0 where they touch or overlap.

    Args:
        low: (3,) lowest corner.
        high: (3,) highest corner.
        nodes: Facts of the nodes, with their corners `low` and `high`.
    """
    lows, highs = (np.array([each[name] for each in nodes], np.float64).reshape(-1, 3) for name in ("low", "high"))
    apart = np.maximum(np.maximum(lows - high, low - highs), 0.0)
    return np.asarray(np.linalg.norm(apart, axis=1))


def own_districts(plans: Sequence[Facts]) -> dict[int, int]:
    """Return for each tile the number of the district that stands for it alone.

    Args:
        plans: `children` and `tiles` of each district.
    """
    return {plan["tiles"][0]: k for k, plan in enumerate(plans) if len(plan["tiles"]) == 1}


def nodes_around(params: Facts, districts: Sequence[Facts], distances: F64) -> tuple[list[int], list[int]]:
    """Return the coarsest districts that may stand, and the other tiles of which no district may, all ascending.

    Args:
        params: Those of `choose_nodes`: `tile`, `tiles`, `districts` and `angle`.
        districts: Facts of the districts, with their `spacing`.
        distances: (K,) of the districts.
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
