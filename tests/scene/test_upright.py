"""Up: a turned scene has a turned up axis, cameras and statements go first, and nothing is said without evidence."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.scene import upright
from gsvis.scene._up_sample import Sample, sample_surface
from gsvis.scene.axes import describe_direction, nearest_axis, tilt_of
from gsvis.scene.cameras import Cameras
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians, quats_from_rotations
from gsvis.scene.procedural import box_in_room, nested_shells, two_rooms, wall_with_hole
from gsvis.scene.upright import SURE, doubt_up, find_up

F64 = NDArray[np.float64]
Z = np.array([0.0, 0.0, 1.0])


def euler(x: float, y: float, z: float) -> F64:
    """Return the rotation about z, then y, then x, degrees."""
    a, b, c = np.radians([x, y, z])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return about_x @ about_y @ about_z


TURNS = [euler(25, 0, 0), euler(45, 0, 20), euler(110, 50, -70), euler(180, 0, 30)]


def patch(corner: object, across: object, along: object, count: int, rng: np.random.Generator) -> Gaussians:
    """Return discs spread at random over a parallelogram."""
    u, v = np.asarray(across, np.float64), np.asarray(along, np.float64)
    at = rng.uniform(size=(count, 2))
    means = np.asarray(corner, np.float64) + at[:, :1] * u + at[:, 1:] * v
    normal = np.cross(u, v)
    area = float(np.linalg.norm(normal))
    east = u / np.linalg.norm(u)
    frame = np.stack([east, np.cross(normal / area, east), normal / area], axis=1)
    wide = np.sqrt(area / count)
    return Gaussians(
        means,
        np.repeat(quats_from_rotations(frame[None]), count, axis=0),
        np.array([wide, wide, 0.05 * wide]) * rng.uniform(0.7, 1.4, (count, 1)),
        rng.uniform(0.4, 0.95, count),
        rng.normal(size=(count, 1, 3)),
    )


def block(low: object, high: object, count: int, rng: np.random.Generator) -> Gaussians:
    """Return the six sides of a box."""
    a, b = np.asarray(low, np.float64), np.asarray(high, np.float64)
    x, y, z = np.diag(b - a)
    sides = [(a, x, y), (a + z, x, y), (a, y, z), (a + x, y, z), (a, x, z), (a + y, x, z)]
    areas = np.array([np.linalg.norm(np.cross(u, v)) for _, u, v in sides])
    parts = [patch(*side, int(n) + 2, rng) for side, n in zip(sides, count * areas / areas.sum(), strict=True)]
    return Gaussians.concatenate(parts)


def flat(seed: int = 0) -> Gaussians:
    """A furnished room of 6 x 4 x 2.6, z up."""
    rng = np.random.default_rng(seed)
    parts = [block((0, 0, 0), (6, 4, 2.6), 6000, rng)]
    for _ in range(8):
        size = rng.uniform((0.4, 0.4, 0.3), (1.6, 1.0, 1.1))
        corner = rng.uniform((0.1, 0.1), np.array([5.9, 3.9]) - size[:2])
        turned = block((0, 0, 0), size, 700, rng).transform(euler(0, 0, rng.uniform(0, 90)))
        parts.append(turned.transform(np.eye(3), (*corner, 0.0)))
    return Gaussians.concatenate(parts)


def meadow(seed: int = 0, rough: float = 0.15) -> Gaussians:
    """Rough ground, 20 wide, with bushes, trunks and a hut, z up."""
    rng = np.random.default_rng(seed)
    ground = patch((-10, -10, 0), (20, 0, 0), (0, 20, 0), 9000, rng)
    hills = rough * np.sin(ground.means[:, :1]) * np.cos(0.7 * ground.means[:, 1:2])
    parts = [ground.transform(np.eye(3)), block((-3, -2, 0), (0, 1, 2.2), 2000, rng)]
    parts[0] = Gaussians(
        ground.means + np.concatenate([np.zeros((len(hills), 2)), hills], axis=1),
        ground.quats, ground.scales, ground.opacities, ground.sh0,
    )  # fmt: skip
    for _ in range(6):
        x, y = rng.uniform(-8, 8, 2)
        parts.append(block((x, y, 0), (x + 0.3, y + 0.3, 4), 250, rng))
        bush = rng.normal(size=(300, 3)) * (0.5, 0.5, 0.4) + (*rng.uniform(-8, 8, 2), 0.4)
        bush[:, 2] = np.abs(bush[:, 2])
        parts.append(cloud(bush, 0.08, rng))
    return Gaussians.concatenate(parts)


def cloud(means: F64, size: float, rng: np.random.Generator) -> Gaussians:
    """Return Gaussians of all shapes at the given centers."""
    n = len(means)
    scales = size * np.exp(rng.normal(0, 0.5, (n, 3)))
    return Gaussians(means, rng.normal(size=(n, 4)), scales, rng.uniform(0.1, 0.9, n), rng.normal(size=(n, 1, 3)))


def with_outliers(g: Gaussians, seed: int = 3, share: float = 0.04, reach: float = 5000.0) -> Gaussians:
    """Return a scene in a shell of Gaussians that lie up to `reach` scene sizes away."""
    rng = np.random.default_rng(seed)
    low, high = g.bounds(1.0)
    n = int(share * len(g))
    ways = rng.normal(size=(n, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    far = np.linalg.norm(high - low) * reach ** rng.uniform(0.05, 1.0, (n, 1))
    return Gaussians.concatenate([g, cloud(0.5 * (low + high) + far * ways, float(np.median(far)) * 0.01, rng)])


class TestTurnedScenes:
    @pytest.mark.parametrize("turn", TURNS)
    @pytest.mark.parametrize("make", [flat, meadow])
    def test_up_is_found_in_any_direction(self, make: object, turn: F64) -> None:
        g = with_outliers(make(1))  # type: ignore[operator]
        found = find_up(g.transform(turn, (5.0, -3.0, 1.0), 40.0))
        assert tilt_of(found.up, turn @ Z) < 2.0
        assert found.sure

    @pytest.mark.parametrize("turn", TURNS[1:2])
    @pytest.mark.parametrize("make", [box_in_room, two_rooms])
    def test_empty_rooms_are_found_upright_or_nothing_is_said(self, make: object, turn: F64) -> None:
        found = find_up(make().gaussians.transform(turn))  # type: ignore[operator]
        assert min(tilt_of(found.up, turn @ Z), tilt_of(found.up, -turn @ Z)) < 1.0

    def test_scale_and_shift_do_not_matter(self) -> None:
        g = flat(2)
        found = find_up(g)
        for scale in (1e-3, 1e3):
            moved = find_up(g.transform(np.eye(3), scale * np.array([7.0, -20.0, 3.0]), scale))
            assert tilt_of(moved.up, found.up) < 0.5
            assert moved.confidence == pytest.approx(found.confidence, abs=0.02)

    def test_order_does_not_matter(self) -> None:
        g = meadow(2)
        found, mixed = find_up(g), find_up(g[np.random.default_rng(4).permutation(len(g))])
        assert np.allclose(mixed.up, found.up, atol=1e-9)
        assert mixed.confidence == pytest.approx(found.confidence, abs=1e-9)

    def test_things_stand_plumb_on_a_slope(self) -> None:
        rng = np.random.default_rng(9)
        rise = np.tan(np.radians(15.0))
        slope = patch((-10, -10, -10 * rise), (20, 0, 0), (0, 20, 20 * rise), 6000, rng)
        poles = []
        for x, y in rng.uniform(-9, 9, (14, 2)):
            pole = block((x, y, y * rise), (x + 0.3, y + 0.3, y * rise + 4.0), 300, rng)
            turned = euler(0, 0, rng.uniform(0, 90))
            poles.append(pole.transform(turned, pole.means.mean(axis=0) - turned @ pole.means.mean(axis=0)))
        turn = TURNS[1]
        assert tilt_of(find_up(Gaussians.concatenate([slope, *poles]).transform(turn)).up, turn @ Z) < 3.0

    @pytest.mark.parametrize("turn", TURNS[:2])
    def test_what_may_as_well_be_a_wall_is_not_sure(self, turn: F64) -> None:
        rng = np.random.default_rng(10)
        sills = [block((x, -0.3, z), (x + 1.2, 0, z + 0.1), 60, rng) for x in range(-7, 7, 3) for z in (1, 4, 7)]
        boards = [block((0, -0.35, z), (3, 0, z + 0.03), 700, rng) for z in (0.1, 0.6, 1.1, 1.6, 2.1)]
        facade = Gaussians.concatenate([patch((-8, 0, 0), (16, 0, 0), (0, 0, 9), 5000, rng), *sills])
        shelf = Gaussians.concatenate([patch((0, 0, 0), (3, 0, 0), (0, 0, 2.2), 3000, rng), *boards])
        corridor = block((0, 0, 0), (1.6, 14, 2.5), 7000, rng)
        for g in (facade, shelf, corridor):
            found = find_up(g.transform(turn))
            assert not found.sure or tilt_of(found.up, turn @ Z) < 5.0


class TestNothingToTell:
    @pytest.mark.parametrize("count", [0, 1, 2, 40])
    def test_few_gaussians(self, count: int) -> None:
        found = find_up(cloud(np.random.default_rng(0).normal(size=(count, 3)), 0.1, np.random.default_rng(1)))
        assert nearest_axis(found.up) == "-y"
        assert found.confidence < 0.5

    def test_one_place(self) -> None:
        found = find_up(cloud(np.ones((200, 3)), 0.1, np.random.default_rng(1)))
        assert found.confidence < SURE

    @pytest.mark.parametrize("turn", TURNS[1:2])
    def test_sheets_skies_and_shells_have_no_up(self, turn: F64) -> None:
        rng = np.random.default_rng(5)
        ways = rng.normal(size=(4000, 3))
        sky = ways / np.linalg.norm(ways, axis=1, keepdims=True)
        wall = patch((0, 0, 0), (4, 0, 0), (0, 0, 3), 4000, rng)
        dome = cloud(np.abs(sky) * np.sign(sky) * 100.0, 2.0, rng)
        half = dome[dome.means[:, 2] > 0.0]
        scenes = [wall, dome, half, nested_shells(4000).gaussians, wall_with_hole(6000).gaussians]
        for g in scenes:
            assert not find_up(g.transform(turn)).sure

    def test_places_far_apart_are_no_lie(self) -> None:
        rng = np.random.default_rng(6)
        for way in ((200.0, 0, 0), (0, 0, 200.0)):
            found = find_up(Gaussians.concatenate([flat(1), flat(2).transform(np.eye(3), way)]))
            assert not found.sure or tilt_of(found.up, Z) < 5.0
        ball = cloud(rng.normal(size=(3000, 3)), 0.1, rng)
        assert not find_up(Gaussians.concatenate([ball, ball.transform(np.eye(3), (500.0, 0, 0))])).sure


class TestStatements:
    def test_a_statement_wins_and_its_doubt_is_said(self) -> None:
        g = flat(3)
        right = find_up(g.with_facts(SceneFacts(up=(0.0, 0.0, 1.0), up_source="comment Vertical Axis")))
        assert (right.confidence, right.doubt) == (1.0, "")
        assert right.reason == "stated by comment Vertical Axis"
        over = find_up(g.with_facts(SceneFacts(up=(0.0, 0.0, -1.0), up_source="a test")))
        assert over.up.tolist() == [0.0, 0.0, -1.0]
        assert over.confidence == 1.0
        assert "upside down" in over.doubt
        aside = find_up(g.with_facts(SceneFacts(up=(0.0, 1.0, 0.0), up_source="a test")))
        assert "90 degrees off" in aside.doubt
        assert "+z" in aside.doubt

    def test_a_tilt_is_no_contradiction(self) -> None:
        assert doubt_up(flat(3), euler(20, 0, 0) @ Z) == ""

    def test_what_is_unsure_contradicts_nothing(self) -> None:
        assert doubt_up(nested_shells(3000).gaussians, (1.0, 0.0, 0.0)) == ""
        assert doubt_up(Gaussians.empty(), (1.0, 0.0, 0.0)) == ""

    def test_what_cameras_say(self) -> None:
        assert "cameras" in doubt_up(Gaussians.empty(), (1.0, 0.0, 0.0), cameras=around(Z))


def around(up: F64, count: int = 16, roll: float = 0.0, elevation: float = 25.0) -> Cameras:
    """Return cameras on a circle, each rolled by up to `roll` degrees."""
    made = Cameras.orbit((0, 0, 0), 3.0, count, up=up, elevation=elevation, width=64, height=48, fov=60.0)
    rng = np.random.default_rng(8)
    turned = made.viewmats.copy()
    for k, degrees in enumerate(rng.uniform(-roll, roll, count)):
        turned[k, :3] = euler(0, 0, degrees) @ turned[k, :3]
    return Cameras(turned, made.Ks, 64, 48)


class TestCameras:
    @pytest.mark.parametrize("turn", TURNS)
    def test_level_cameras_give_up_in_any_direction(self, turn: F64) -> None:
        up = turn @ Z
        found = find_up(Gaussians.empty(), cameras=around(up, roll=4.0))
        assert tilt_of(found.up, up) < 2.0
        assert found.sure
        assert "16 cameras" in found.reason

    def test_some_in_portrait_do_not_mislead(self) -> None:
        made = around(Z)
        turned = made.viewmats.copy()
        for k in range(0, 16, 3):
            turned[k, :3] = euler(0, 0, 90) @ turned[k, :3]
        found = find_up(Gaussians.empty(), cameras=Cameras(turned, made.Ks, 64, 48))
        assert tilt_of(found.up, Z) < 1.0

    def test_cameras_that_look_down_are_above(self) -> None:
        found = find_up(Gaussians.empty(), cameras=around(Z, elevation=85.0))
        assert tilt_of(found.up, Z) < 1.0

    def test_one_way_is_not_sure(self) -> None:
        made = around(Z, 1)
        many = Cameras(np.repeat(made.viewmats, 9, axis=0), np.repeat(made.Ks, 9, axis=0), 64, 48)
        assert not find_up(Gaussians.empty(), cameras=many).sure

    def test_cameras_go_before_the_gaussians(self) -> None:
        tilted = euler(8, 0, 0) @ Z
        found = find_up(flat(1), cameras=around(tilted))
        assert tilt_of(found.up, tilted) < 0.5
        assert found.doubt == ""
        assert "ground and walls" in find_up(flat(1), cameras=around(euler(90, 0, 0) @ Z)).doubt

    def test_no_cameras(self) -> None:
        none = Cameras(np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), 64, 48)
        assert find_up(Gaussians.empty(), cameras=none).confidence < 0.5


def test_words_for_directions() -> None:
    assert describe_direction((0, 0, 2.0)) == "+z"
    assert describe_direction(euler(0.9, 0, 0) @ -Z) == "-z"
    assert describe_direction((0.12, -0.98, 0.08)) == "(0.12, -0.99, 0.08), 8 degrees off -y"
    assert nearest_axis((0.3, -0.8, 0.5)) == "-y"
    assert nearest_axis((1.0, 1.0, 1.0)) == "+x"
    with pytest.raises(ValueError, match="direction: expected non-zero"):
        nearest_axis((0, 0, 0))


def test_the_gaussians_are_searched_once_whoever_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[Gaussians] = []

    def sample(g: Gaussians) -> Sample | None:
        searched.append(g)
        return sample_surface(g)

    monkeypatch.setattr(upright, "sample_surface", sample)
    g, other = two_rooms(1000).gaussians, two_rooms(1200).gaussians
    first = find_up(g)
    first.up[:] = 0.0  # what a caller does with the answer
    again = find_up(g)
    assert np.linalg.norm(again.up) == pytest.approx(1.0)
    assert (again.confidence, again.reason) == (first.confidence, first.reason)
    assert doubt_up(g, -again.up) == doubt_up(g.with_facts(SceneFacts(up_source="said")), -again.up)
    assert [len(each) for each in searched] == [len(g), len(g)]  # the second object could be another scene
    find_up(other)
    assert searched[-1] is other


def test_what_was_found_goes_with_its_scene() -> None:
    g = two_rooms(1000).gaussians
    find_up(g)
    assert g in upright._likely
    scene = weakref.ref(g)
    del g
    gc.collect()
    assert scene() is None
