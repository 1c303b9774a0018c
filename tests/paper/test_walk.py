"""What a walk has ever seen: by cameras against the weights themselves, and by cells with known sets."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from paper.walk import VisibleCells, WalkConfig, WalkVisibility, measure_walk

from gsvis.raycast import EllipsoidProxies, Tracer, visible_in
from gsvis.render.weights import view_weights
from gsvis.scene.paths import HeadPath
from gsvis.scene.procedural import OccluderScene, two_rooms

SMALL = WalkConfig(seconds=4.0, rate=2.0, width=32, height=24)


@cache
def rooms() -> OccluderScene:
    return two_rooms(1500, sh_degree=0)


@cache
def turning(count: int = 21) -> HeadPath:
    """A slow turn on the spot, in the middle of a room, over 5 s."""
    eye = rooms().viewpoints[0]
    a = np.linspace(0.0, np.pi, count)
    zeros = np.zeros(count)
    turn = np.stack([np.cos(a / 2), zeros, zeros, np.sin(a / 2)], axis=1)  # about +z
    level = np.array([1.0, -1.0, 0.0, 0.0]) / np.sqrt(2.0)  # camera -y along +z
    w, z = turn[:, 0], turn[:, 3]
    quats = np.stack([w * level[0], w * level[1], z * level[1], z * level[0]], axis=1)
    return HeadPath(np.linspace(0.0, 5.0, count), np.tile(eye, (count, 1)), quats, up=np.array([0.0, 0.0, 1.0]))


def tracer() -> Tracer:
    return Tracer(EllipsoidProxies.from_scene(rooms().gaussians))


def lawful(found: WalkVisibility) -> WalkVisibility:
    """What holds for every walk."""
    assert np.all(np.diff(found.seen) >= 0)
    assert np.all(found.seen >= np.maximum.accumulate(found.visible) - 1e-12)
    assert np.all(found.seen <= np.minimum(np.cumsum(found.visible), 1.0) + 1e-12)
    counted = np.array([np.mean(found.first_seen <= np.float32(time)) for time in found.times])
    assert np.allclose(counted, found.seen)
    assert json.loads(json.dumps(found.as_dict()))["seen_at_end"] == pytest.approx(found.seen[-1])
    return found


@pytest.mark.parametrize("by", ["raster", "raycast"])
def test_by_cameras_it_is_the_union_of_what_each_sees(by: str) -> None:
    g = rooms().gaussians
    scene = g if by == "raster" else tracer()
    found = lawful(measure_walk(scene, turning(), SMALL))
    assert found.by == by
    assert found.times.tolist() == [0.5 * i for i in range(9)]
    cameras = turning().cut(0.0, 4.0).resample(2.0).cameras(32, 24, 90.0)
    weights = view_weights(g, cameras).largest if by == "raster" else visible_in(tracer(), cameras)
    seen = weights >= np.float32(SMALL.tau)
    assert np.allclose(found.visible, seen.mean(axis=1))
    assert np.allclose(found.seen, np.logical_or.accumulate(seen, axis=0).mean(axis=1))
    assert 0.0 < found.visible.max() < found.seen[-1]


def test_more_time_more_instants_and_a_lower_tau_see_more() -> None:
    g = rooms().gaussians
    base = measure_walk(g, turning(), SMALL).seen[-1]
    assert measure_walk(g, turning(), WalkConfig(5.0, 2.0, 32, 24)).seen[-1] >= base
    assert measure_walk(g, turning(), WalkConfig(4.0, 4.0, 32, 24)).seen[-1] >= base
    assert measure_walk(g, turning(), WalkConfig(4.0, 2.0, 32, 24, tau=0.0001)).seen[-1] >= base
    assert measure_walk(g, turning(), WalkConfig(4.0, 2.0, 32, 24, tau=0.5)).seen[-1] < base


def test_a_still_head_sees_nothing_new() -> None:
    path = turning()
    still = HeadPath(path.times, path.positions, np.tile(path.quats[0], (len(path), 1)))
    found = lawful(measure_walk(rooms().gaussians, still, SMALL))
    assert np.all(found.seen == found.visible[0])
    assert set(np.unique(found.first_seen)) == {0.0, np.float32(np.inf)}


def test_what_is_certainly_hidden_is_not_seen_from_there() -> None:
    found = measure_walk(tracer(), turning(), SMALL)
    assert not np.any(np.isfinite(found.first_seen) & rooms().hidden[0])


class Strip:
    """Cells one unit long along x, from 0 to 4; cell i sees Gaussians 10 i to 10 i + 14."""

    def __init__(self, kind: Any = np.array, outside: Any = -1) -> None:
        self.kind, self.outside, self.asked = kind, outside, 0

    def cell_at(self, position: NDArray[np.float64]) -> Any:
        cell = int(np.floor(position[0]))
        return cell if 0 <= cell < 4 else self.outside

    def visible(self, cell: int) -> Any:
        self.asked += 1
        return self.kind(range(10 * cell, 10 * cell + 15))


def along(stop: float) -> HeadPath:
    times = np.array([0.0, 10.0])
    return HeadPath(times, np.array([[0.5, 0, 0], [stop, 0, 0]]), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))


@pytest.mark.parametrize("kind", [np.array, set, list, tuple])
@pytest.mark.parametrize("outside", [-1, None])
def test_by_cells_it_is_the_union_of_their_sets(kind: Any, outside: Any) -> None:
    cells = Strip(kind, outside)
    assert isinstance(cells, VisibleCells)
    found = lawful(measure_walk(cells, along(5.6), WalkConfig(10.0, 2.0), gaussians=100))
    assert found.by == "cells"
    assert found.seen[0] == 0.15
    assert found.seen[-1] == 0.45
    assert cells.asked == 4  # each cell once
    assert found.outside == 7  # x = 4.07 to 5.6 in steps of 0.255
    assert np.all(found.visible[-found.outside :] == 0.0)


def test_a_store_knows_how_many_gaussians_there_are() -> None:
    cells = Strip()
    cells.gaussians = 100  # type: ignore[attr-defined]
    assert len(measure_walk(cells, along(1.0)).first_seen) == 100
    with pytest.raises(ValueError, match="gaussians: expected 100"):
        measure_walk(cells, along(1.0), gaussians=99)


def test_a_short_walk_is_watched_to_its_end() -> None:
    found = measure_walk(Strip(), along(1.4), WalkConfig(30.0, 1.0), gaussians=45)
    assert found.times[-1] == 10.0


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="gaussians: expected their number"):
        measure_walk(Strip(), along(1.0))
    with pytest.raises(ValueError, match="gaussians: expected more than"):
        measure_walk(Strip(), along(1.0), gaussians=10)
    with pytest.raises(ValueError, match=f"gaussians: expected {len(rooms().gaussians)}"):
        measure_walk(rooms().gaussians, turning(), gaussians=7)
    with pytest.raises(ValueError, match="scene"):
        measure_walk("a scene", along(1.0))  # type: ignore[arg-type]
    for wrong in ({"seconds": 0.0}, {"rate": -1.0}, {"width": 0}, {"fov": 180.0}, {"tau": 0.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            WalkConfig(**wrong)
