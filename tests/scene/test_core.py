"""The core of a scene: outliers and skies change nothing, and no frame does."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsvis.scene.core import find_core
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from tests.scene.places import apartment, ball, box, discs, sheet, statue


def outside(count: int) -> Gaussians:
    """What is seen far below a place where people stood: it gets coarser with the distance."""
    rng = np.random.default_rng(4)
    away = np.exp(rng.uniform(np.log(6.0), np.log(80.0), count))
    turns = rng.uniform(0.0, 2.0 * np.pi, count)
    heights = -4.0 + rng.normal(0.0, 0.3, count) + 0.2 * away * rng.random(count)
    means = np.column_stack([away * np.cos(turns), away * np.sin(turns), heights])
    scales = 0.02 * away[:, None] * np.exp(rng.normal(0.0, 0.3, (count, 3)))
    plain = discs(means, (1.0, 1.0, 1.0), 0.7)
    return Gaussians(means, plain.quats, scales, plain.opacities, plain.sh0, facts=plain.facts)


def platform() -> Gaussians:
    """A platform with railings above a meadow."""
    fences = [sheet(1, y, (-3.0, 0.0), (3.0, 1.0), 0.06) for y in (-1.5, 1.5)]
    parts = [sheet(2, 0.0, (-3.0, -1.5), (3.0, 1.5), 0.05), box((1.0, -0.4, 0.0), (1.8, 0.4, 0.8), 0.05), *fences]
    fine = Gaussians.concatenate(parts)
    return Gaussians.concatenate([fine, outside(len(fine) // 2)])


def shelled(g: Gaussians, share: float, farthest: float = 5000.0) -> Gaussians:
    """A scene in a shell of outliers of every distance, large as they are far."""
    rng = np.random.default_rng(9)
    count = round(share / (1.0 - share) * len(g))
    ways = rng.normal(size=(count, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    size = float(np.ptp(g.means, axis=0).max())
    distances = size * np.exp(rng.uniform(np.log(3.0), np.log(farthest), count))
    scales = distances[:, None] * np.exp(rng.uniform(np.log(0.002), np.log(0.05), (count, 3)))
    zeros = np.zeros((count, 1, 3))
    far = Gaussians(distances[:, None] * ways, rng.normal(size=(count, 4)), scales, np.full(count, 0.5), zeros)
    return Gaussians.concatenate([g, far])


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
def test_outliers_change_nothing(share: float) -> None:
    g = apartment()
    bare, core = find_core(g), find_core(shelled(g, share, 1e5))
    assert core.low == pytest.approx(bare.low, abs=0.02 * bare.size)
    assert core.high == pytest.approx(bare.high, abs=0.02 * bare.size)
    assert core.members[: len(g)].all()
    assert core.members[len(g) :].mean() < 0.1


def test_a_sky_changes_nothing() -> None:
    g = statue()
    bare, core = find_core(g), find_core(Gaussians.concatenate([g, ball((0.0, 0.0, 0.0), 300.0, 1500)]))
    assert core.low == pytest.approx(bare.low, abs=0.02 * bare.size)
    assert core.high == pytest.approx(bare.high, abs=0.02 * bare.size)


def test_no_frame_and_no_order_changes_the_core() -> None:
    g = platform()
    core = find_core(g)
    turn = Rotation.from_euler("zyx", [30.0, 50.0, 10.0], degrees=True).as_matrix()
    for scale in (1e-3, 1e3):
        moved = find_core(g.transform(turn, (5.0 * scale, 0.0, -9.0 * scale), scale))
        expected = scale * (turn @ core.center + (5.0, 0.0, -9.0))
        assert moved.center == pytest.approx(expected, abs=0.01 * scale * core.size)
        assert np.mean(moved.members != core.members) < 0.01
    order = np.random.default_rng(0).permutation(len(g))
    mixed = find_core(g[order])
    assert np.array_equal(mixed.members, core.members[order])
    assert mixed.detail_low == pytest.approx(core.detail_low)


def test_two_places_far_apart_are_one_core() -> None:
    g = apartment()
    both = find_core(Gaussians.concatenate([g, g.transform(np.eye(3), (200.0, 0.0, 0.0))]))
    assert both.members.all()
    assert both.high[0] - both.low[0] > 200.0


def test_the_detail_of_a_capture_is_where_people_stood() -> None:
    core = find_core(platform())
    assert core.has_surroundings
    assert core.size < 10.0
    assert not find_core(apartment()).has_surroundings


def test_rooms_are_found_in_what_their_windows_show() -> None:
    rooms = apartment()
    middle = (4.0, 2.5, 0.0)
    around = outside(len(rooms) // 2).transform(np.eye(3), middle)
    g = Gaussians.concatenate([rooms, around])
    assert find_core(g).has_surroundings
    space = NavigableSpace.from_scene(g, up=(0.0, 0.0, 1.0), resolution=96)
    assert space.kind is not None
    assert space.kind.kind == "rooms"
    assert space.kind.sure
    eyes = space.sample_viewpoints(200, np.random.default_rng(0))
    assert (eyes > (0.0, 0.0, 0.0)).all()
    assert (eyes < (8.0, 5.0, 2.7)).all()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_people_stand_on_a_platform_of_any_size_and_tilt(scale: float) -> None:
    """It may be an object; eyes are on it all the same."""
    turn = Rotation.from_euler("zyx", [20.0, 35.0, 15.0], degrees=True).as_matrix()
    g = shelled(platform(), 0.02).transform(turn, scale=scale)
    space = NavigableSpace.from_scene(g, up=turn[:, 2], resolution=96)
    x, y, z = np.meshgrid(np.linspace(-2.5, 0.5, 5), np.linspace(-1.0, 1.0, 5), [1.2, 1.6], indexing="ij")
    eyes = scale * np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1) @ turn.T
    assert space.contains(eyes).mean() >= 0.9
    assert space.up == pytest.approx(turn[:, 2])
    assert space.kind.other is not None
    assert "uncertain" in space.kind.doubt
    assert "\n" not in space.kind.doubt
