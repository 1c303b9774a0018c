"""Navigable space: known rooms, the splatting law, seeds, sampling, and the three real scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.scene import procedural
from gsvis.scene._occupancy import INFLATION, REACH, optical_depth
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import space_hash
from gsvis.scene.gaussians import Gaussians, rotations_from_quats
from gsvis.scene.navigable import NavigableSpace
from tests.scene.places import apartment


def dots(means: NDArray[np.float64], scales: tuple[float, float, float], opacity: float = 0.95) -> Gaussians:
    """Axis-aligned Gaussians of one shape."""
    n = len(means)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    return Gaussians(means, quats, np.tile(scales, (n, 1)), np.full(n, opacity), np.zeros((n, 1, 3)))


def wall(axis: int, at: float, low: tuple[float, float], high: tuple[float, float], step: float = 0.08) -> Gaussians:
    """A rectangle of thin discs across `axis`; `low` and `high` run over the two other axes in order."""
    across = [i for i in range(3) if i != axis]
    u, v = np.meshgrid(*(np.arange(a, b + 1e-9, step) for a, b in zip(low, high, strict=True)), indexing="ij")
    means = np.full((u.size, 3), at, np.float64)
    means[:, across[0]], means[:, across[1]] = u.ravel(), v.ravel()
    scales = [step, step, step]
    scales[axis] = 1e-3 * step
    return dots(means, (scales[0], scales[1], scales[2]))


def room(low: tuple[float, float, float], high: tuple[float, float, float]) -> Gaussians:
    """Six walls."""
    parts = []
    for axis in range(3):
        a, b = (i for i in range(3) if i != axis)
        parts += [wall(axis, at, (low[a], low[b]), (high[a], high[b])) for at in (low[axis], high[axis])]
    return Gaussians.concatenate(parts)


def two_rooms(door: bool) -> Gaussians:
    """5 x 4 and 3 x 4 floor, 3 high, with a door 1 wide and 2 high in the wall at x = 5."""
    partition = wall(0, 5.0, (0, 0), (4, 3))
    if door:
        partition = partition[~((np.abs(partition.means[:, 1] - 2) < 0.5) & (partition.means[:, 2] < 2))]
    return Gaussians.concatenate([room((0, 0, 0), (8, 4, 3)), partition])


MIDDLES = [[2.5, 2.0, 1.5], [6.5, 2.0, 1.5]]


@pytest.fixture(scope="module")
def joined() -> NavigableSpace:
    return NavigableSpace.from_scene(two_rooms(door=True), resolution=64, up="+z")


class TestRooms:
    def test_a_door_joins_two_rooms(self, joined: NavigableSpace) -> None:
        assert joined.contains(MIDDLES).all()
        assert joined.contains([[5.0, 2.0, 1.0]]).all()  # in the door
        assert not joined.contains([[5.0, 0.8, 1.0], [5.0, 2.0, 2.6], [-0.5, 2, 1], [2, 2, 3.5]]).any()

    def test_volume_lies_below_the_true_one_by_about_two_voxels_a_wall(self, joined: NavigableSpace) -> None:
        h = joined.voxel_size
        assert (5 - 6 * h) * (4 - 6 * h) * (3 - 6 * h) < joined.volume < 8 * 4 * 3

    def test_without_a_door_both_rooms_stay(self) -> None:
        space = NavigableSpace.from_scene(two_rooms(door=False), resolution=64, up="+z")
        assert space.contains(MIDDLES).tolist() == [True, True]

    def test_a_gap_in_a_wall_is_no_room(self) -> None:
        g = Gaussians.concatenate([two_rooms(door=True), wall(0, 8.7, (0, 0), (4, 3))])
        space = NavigableSpace.from_scene(g, resolution=64, up="+z")
        assert space.contains([*MIDDLES, [8.35, 2.0, 1.5]]).tolist() == [True, True, False]

    def test_seeds_choose_the_room(self) -> None:
        g = two_rooms(door=False)
        space = NavigableSpace.from_scene(g, resolution=64, up="+z", seeds=[[6.4, 1.0, 1.0]])
        assert space.contains(MIDDLES).tolist() == [False, True]
        both = NavigableSpace.from_scene(g, resolution=64, up="+z", seeds=MIDDLES)
        assert both.contains(MIDDLES).all()

    def test_floaters_change_nothing(self, joined: NavigableSpace) -> None:
        away = dots(np.random.default_rng(0).normal(0.0, 1e5, (20, 3)), (30.0, 30.0, 30.0), 0.003)
        g = Gaussians.concatenate([two_rooms(door=True), away])
        space = NavigableSpace.from_scene(g, resolution=64, up="+z")
        assert space.contains(MIDDLES).all()
        assert space.voxel_size == pytest.approx(joined.voxel_size, rel=0.05)

    def test_follows_a_change_of_frame(self, joined: NavigableSpace) -> None:
        turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        g = two_rooms(door=True).transform(turn, (10.0, -20.0, 5.0), 7.0)
        space = NavigableSpace.from_scene(g, resolution=64, up="+z")
        assert space.volume == pytest.approx(joined.volume * 7.0**3, rel=0.02)
        assert space.contains(7.0 * np.array(MIDDLES) @ turn.T + [10.0, -20.0, 5.0]).all()

    def test_a_lone_object_is_looked_at_from_outside(self) -> None:
        filled = np.random.default_rng(1).normal(size=(20_000, 3)).clip(-2, 2) * [0.25, 0.25, 0.75]
        space = NavigableSpace.from_scene(dots(filled, (0.05, 0.05, 0.05)), resolution=64, up="+z")
        assert "object" in space.rule
        assert not space.contains([[0.0, 0.0, 0.0]])[0]
        assert space.contains([[1.5, 0.0, 0.0], [0.0, -1.5, 1.0]]).all()


class TestOccupancy:
    @pytest.mark.parametrize("offset", np.linspace(0.0, 1.0, 7))
    def test_no_thin_sheet_slips_between_voxel_centers(self, offset: float) -> None:
        sheet = wall(2, 4.0 + offset, (-2, -2), (12, 12), 0.5)
        depth = optical_depth(sheet, np.zeros(3), 1.0, (10, 10, 10))
        assert np.all(depth.max(axis=2) > -np.log(0.25))
        assert np.all((depth > -np.log(0.75)).sum(axis=2) <= 3)

    def test_faint_gaussians_add_up(self) -> None:
        one = dots(np.array([[0.5, 0.5, 0.5]]), (1.0, 1.0, 1.0), 0.02)
        single = optical_depth(one, np.zeros(3), 1.0, (1, 1, 1))
        many = optical_depth(Gaussians.concatenate([one] * 40), np.zeros(3), 1.0, (1, 1, 1))
        assert many == pytest.approx(40 * single, rel=1e-5)
        assert single[0, 0, 0] < 0.05 < 0.3 < many[0, 0, 0]

    def test_tiny_gaussian_stops_the_light_that_it_covers(self) -> None:
        depth = optical_depth(dots(np.full((1, 3), 0.5), (0.01, 0.01, 0.01), 0.9), np.zeros(3), 1.0, (1, 1, 1))
        covered = 0.9 * 0.01**2 / (0.01**2 + INFLATION**2)
        assert float(depth[0, 0, 0]) == pytest.approx(covered, rel=1e-3)

    @given(st.integers(0, 2**32 - 1), st.floats(-4.0, 3.0))
    def test_kernel_equals_the_plain_formula(self, seed: int, log_scale: float) -> None:
        rng = np.random.default_rng(seed)
        n, shape = 6, (5, 7, 4)
        scales = 10.0 ** (log_scale + rng.uniform(-1, 1, (n, 3)))
        g = Gaussians(
            rng.uniform(-2, 9, (n, 3)), rng.normal(size=(n, 4)), scales, rng.uniform(0, 1, n), np.zeros((n, 1, 3))
        )
        centers = np.stack(np.meshgrid(*(np.arange(k) + 0.5 for k in shape), indexing="ij"), axis=-1)
        expected = np.zeros(shape)
        for mean, quat, scale, opacity in zip(g.means, g.quats, g.scales.astype(np.float64), g.opacities, strict=True):
            blurred = np.sqrt(scale**2 + INFLATION**2)
            local = (centers - mean) @ rotations_from_quats(quat[None])[0] / blurred
            m = (local**2).sum(axis=-1)
            cover = np.prod(np.sort(scale)[1:] / np.sort(blurred)[1:])
            alpha = min(float(opacity), 0.999) * cover * np.exp(-0.5 * m)
            expected -= np.where(m <= REACH**2, np.log1p(-alpha), 0.0)
        # Only voxels on the very edge of a Gaussian may fall to either side.
        close = np.isclose(optical_depth(g, np.zeros(3), 1.0, shape), expected, rtol=1e-3, atol=1e-6)
        assert close.mean() > 0.98

    def test_huge_and_far_gaussians_are_harmless(self) -> None:
        means = np.array([[1e30, 0, 0], [-1e30, 1e30, 2], [2, 2, 2], [0, 1e12, 0]], np.float64)
        for size in (1e-30, 1.0, 1e25):
            depth = optical_depth(dots(means, (size, size, size)), np.zeros(3), 1.0, (4, 4, 4))
            assert np.isfinite(depth).all()


class TestSampling:
    def test_viewpoints_lie_inside_and_repeat(self, joined: NavigableSpace) -> None:
        points = joined.sample_viewpoints(500, np.random.default_rng(3))
        assert joined.contains(points).all()
        assert np.array_equal(points, joined.sample_viewpoints(500, np.random.default_rng(3)))
        assert len(joined.sample_viewpoints(0, np.random.default_rng(3))) == 0

    def test_viewpoints_are_uniform(self) -> None:
        space = NavigableSpace.from_box((0, 0, 0), (4, 2, 1), 16)
        points = space.sample_viewpoints(20_000, np.random.default_rng(4))
        counts, _ = np.histogramdd(points, bins=(4, 2, 2), range=((0, 4), (0, 2), (0, 1)))
        assert counts.min() > 0.85 * counts.mean()
        assert counts.max() < 1.15 * counts.mean()

    def test_cameras_are_upright_inside_and_see_something(self, joined: NavigableSpace) -> None:
        cameras = joined.sample_cameras(100, np.random.default_rng(5), width=64, height=48, fov=70.0)
        assert (len(cameras), cameras.width, cameras.height) == (100, 64, 48)
        assert joined.contains(cameras.viewpoints).all()
        right, down, forward = np.moveaxis(cameras.viewmats[:, :3, :3], 1, 0)
        assert np.abs(right @ joined.up).max() < 1e-9
        assert (down @ joined.up < 0).all()
        assert np.abs(forward @ joined.up).max() <= np.sqrt(0.5) + 1e-9
        ahead = cameras.viewpoints + 0.3 * forward  # 5% of 8 and less
        assert not joined.contains(cameras.viewpoints + 20.0 * forward).any()
        assert np.mean(joined.contains(ahead)) > 0.9

    def test_cameras_repeat(self, joined: NavigableSpace) -> None:
        one, two = (joined.sample_cameras(9, np.random.default_rng(6)) for _ in range(2))
        assert np.array_equal(one.viewmats, two.viewmats)

    def test_cameras_without_targets(self) -> None:
        space = NavigableSpace.from_box((-1, -1, -1), (1, 1, 1), 8, up=(0, -1, 0))
        cameras = space.sample_cameras(20, np.random.default_rng(7))
        assert isinstance(cameras, Cameras)
        assert space.contains(cameras.viewpoints).all()


class TestBox:
    def test_fills_the_box(self) -> None:
        space = NavigableSpace.from_box((1, 2, 3), (3, 3, 7), 20)
        assert space.volume == pytest.approx(8.0)
        inside = space.contains([[1.01, 2.01, 3.01], [2.99, 2.99, 6.99], [0.99, 2.5, 5], [2, 3.01, 5], [2, 2.5, 7.5]])
        assert inside.tolist() == [True, True, False, False, False]

    def test_flat_box(self) -> None:
        space = NavigableSpace.from_box((0, 0, 0), (10, 10, 0.1), 4)
        assert space.contains(space.sample_viewpoints(50, np.random.default_rng(0))).all()
        assert space.volume == pytest.approx(10.0)

    def test_arrays_are_read_only(self) -> None:
        space = NavigableSpace.from_box((0, 0, 0), (1, 1, 1), 4)
        with pytest.raises(ValueError, match="read-only"):
            space.free[0, 0, 0] = False


class TestErrors:
    @pytest.mark.parametrize(
        ("kwargs", "name"),
        [
            ({"resolution": 4}, "resolution"),
            ({"resolution": 1000}, "resolution"),
            ({"max_alpha": 0.0}, "max_alpha"),
            ({"max_alpha": 1.0}, "max_alpha"),
            ({"clearance": -1.0}, "clearance"),
            ({"coverage": 0.0}, "coverage"),
            ({"up": "z"}, "axis"),
            ({"up": (0.0, 0.0, 0.0)}, "up"),
            ({"seeds": [[0.0, 1.0]]}, "seeds"),
        ],
    )
    def test_bad_arguments_are_named(self, kwargs: dict[str, Any], name: str) -> None:
        with pytest.raises(ValueError, match=f"^{name}: expected"):
            NavigableSpace.from_scene(room((0, 0, 0), (1, 1, 1)), **kwargs)

    @pytest.mark.parametrize("g", [Gaussians.empty(), dots(np.zeros((5, 3)), (1.0, 1.0, 1.0), 0.001)])
    def test_nothing_to_see(self, g: Gaussians) -> None:
        with pytest.raises(SceneError, match="no Gaussian"):
            NavigableSpace.from_scene(g)

    def test_solid_scene(self) -> None:
        fog = dots(np.random.default_rng(0).uniform(0, 1, (500, 3)), (0.5, 0.5, 0.5), 0.9)
        with pytest.raises(SceneError, match="raise max_alpha"):
            NavigableSpace.from_scene(fog, resolution=16)

    @pytest.mark.parametrize("seeds", [[[0.0, 0.0, 0.0]], [[0.5, 0.5, 0.5]], [[900.0, 0.0, 0.0]], [[3.0, 0.0, 0.0]]])
    def test_no_seed_is_refused(self, seeds: list[list[float]]) -> None:
        space = NavigableSpace.from_scene(
            room((0, 0, 0), (1, 1, 1)), up="+z", resolution=16, seeds=seeds, clearance=4.0
        )
        far = seeds[0][0] > 100.0
        assert space.contains(seeds).all() != far
        assert far == ("far outside of the scene" in space.kind.doubt)
        assert not space.kind.sure or not space.kind.doubt

    @pytest.mark.parametrize("count", [1, 2])
    def test_tiny_scenes_work_or_say_why(self, count: int) -> None:
        space = NavigableSpace.from_scene(dots(np.eye(3)[:count], (0.01, 0.01, 0.01)), resolution=16, up="+z")
        assert space.volume > 0

    def test_bad_box(self) -> None:
        with pytest.raises(ValueError, match="high: expected"):
            NavigableSpace.from_box((0, 0, 0), (1, 0, 1))

    def test_bad_fields(self) -> None:
        with pytest.raises(SceneError, match="no voxel"):
            NavigableSpace(np.zeros(3), 1.0, np.zeros((2, 2, 2), bool), np.eye(3)[2])
        with pytest.raises(ValueError, match="voxel_size"):
            NavigableSpace(np.zeros(3), 0.0, np.ones((2, 2, 2), bool), np.eye(3)[2])
        with pytest.raises(ValueError, match="occupied"):
            NavigableSpace(np.zeros(3), 1.0, np.ones((2, 2, 2), bool), np.eye(3)[2], np.ones((1, 2, 2), bool))


@pytest.mark.realdata
class TestRealScenes:
    def test_rooms_of_the_showroom_are_joined(
        self, realdata: Path, real_space: Callable[[Gaussians], NavigableSpace]
    ) -> None:
        from gsvis.io import load_scene

        space = real_space(load_scene(realdata / "scenes/showroom/lod-meta.json", lod=3))
        assert space.up.tolist() == [0.0, 0.0, 1.0]
        assert "70%" in space.rule
        assert 300.0 < space.volume < 550.0  # an apartment, not the garden around it

    def test_people_stand_on_the_platform_and_not_only_over_the_meadow(self, realdata: Path) -> None:
        from gsvis.io import load_scene

        space = NavigableSpace.from_scene(load_scene(realdata / "scenes/nika_sh3/lod-meta.json", lod=0), up="-y")
        x, z = np.meshgrid(np.linspace(-2.0, 1.0, 5), np.linspace(-0.5, 1.5, 5))
        eyes = np.stack([x.ravel(), np.full(x.size, -1.4), z.ravel()], axis=1)
        assert space.contains(eyes).mean() > 0.9

    @pytest.mark.parametrize("lod", [1, 3])
    def test_a_patch_of_lawn_is_seen_from_around_and_from_near(self, realdata: Path, lod: int) -> None:
        from gsvis.io import load_scene

        g = load_scene(realdata / "scenes/flowers_sh2/lod-meta.json", lod=lod)
        space = NavigableSpace.from_scene(g, up="-y")
        assert not space.kind.sure
        low, high = g.bounds(0.98)
        eyes = space.sample_viewpoints(2000, np.random.default_rng(0))
        within = np.all((eyes > low) & (eyes < high), axis=1)
        assert 0.0 < within.mean() < 0.5


def test_cameras_at_given_eyes_stand_there_and_are_those_that_are_sampled() -> None:
    space = NavigableSpace.from_box((0, 0, 0), (3, 2, 2), 12)
    eyes = space.sample_viewpoints(4, rng := np.random.default_rng(3))
    cameras = space.cameras_at(eyes, rng, width=8, height=6)
    assert cameras.viewpoints == pytest.approx(eyes)
    sampled = space.sample_cameras(4, np.random.default_rng(3), width=8, height=6)
    assert np.array_equal(sampled.viewmats, cameras.viewmats)


def test_the_hash_of_a_space_depends_on_its_free_voxels() -> None:
    space = NavigableSpace.from_box((0, 0, 0), (3, 2, 2), 12)
    free = space.free.copy()
    free[0, 0, 0] = False
    others = (replace(space, free=free), replace(space, origin=space.origin + 1.0), replace(space, voxel_size=0.3))
    assert space_hash(space) == space_hash(replace(space, up=np.array([0.0, 1.0, 0.0])))
    assert len({space_hash(space), *(space_hash(other) for other in others)}) == 4


def test_a_piece_of_a_city_has_eyes_in_its_rooms_and_on_the_open_ground_beside_them() -> None:
    scene = procedural.two_rooms(12_000, sh_degree=0)
    low, high = scene.gaussians.means.min(axis=0), scene.gaussians.means.max(axis=0)
    corners = (float(low[0]), float(high[1]) + 0.5), (float(high[0]), float(high[1]) + 6.5)
    beside = wall(2, float(low[2]), *corners, step=0.15)
    both = Gaussians.concatenate([scene.gaussians, beside])
    eyes = scene.navigable.sample_viewpoints(1000, np.random.default_rng(0))
    for mixed in (False, True):
        space = NavigableSpace.from_scene(both, up=scene.up, resolution=96, mixed=mixed)
        assert space.contains(eyes).mean() >= 0.99
        found = space.sample_viewpoints(1000, np.random.default_rng(0))
        outside = found[found[:, 1] > high[1]]
        assert (len(outside) > 0) == mixed
        assert np.all(outside[:, 2] > low[2])
    high_up = np.array([[low[0] + 1.0, high[1] + 3.0, low[2] + 2.9]])  # a camera on a pole
    assert not space.contains(high_up).any()
    seeded = NavigableSpace.from_scene(both, up=scene.up, resolution=96, mixed=True, seeds=high_up)
    assert seeded.contains(high_up).all()
    assert seeded.contains(eyes).mean() >= 0.99
    assert space.volume < seeded.volume < 1.05 * space.volume


def test_a_piece_of_a_city_has_eyes_in_rooms_that_no_door_connects() -> None:
    """The largest has a quarter of them; a closet of a hundredth of it counts for nothing."""
    rooms = [room((5.0 * k, 0.0, 0.0), (5.0 * k + 4.0, 4.0, 3.0)) for k in range(4)]
    closet = room((20.0, 0.0, 0.0), (21.0, 1.0, 1.0))
    space = NavigableSpace.from_scene(Gaussians.concatenate([*rooms, closet]), up="+z", resolution=96, mixed=True)
    for k in range(4):
        assert space.contains([[5.0 * k + 2.0, 2.0, 1.5]]).all()
        assert not space.contains([[5.0 * k + 4.5, 2.0, 1.5]]).any()
    assert not space.contains([[20.5, 0.5, 0.5]]).any()


@pytest.mark.parametrize("degrees", [25.0, 61.0])
def test_a_room_turned_about_up_has_the_space_of_the_room(degrees: float) -> None:
    g, turn = apartment(), np.radians(degrees)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    here = NavigableSpace.from_scene(g, up="+z", resolution=64)
    there = NavigableSpace.from_scene(g.transform(rotation), up="+z", resolution=64)
    assert there.kind.kind == here.kind.kind == "rooms"
    assert there.volume == pytest.approx(here.volume, rel=0.05)
    eyes = here.sample_viewpoints(500, np.random.default_rng(0))
    assert there.contains(eyes @ rotation.T).mean() > 0.9
