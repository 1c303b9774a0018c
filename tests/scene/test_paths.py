"""Head paths and similarity transforms: interpolation, cutting, moving."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsvis.scene.gaussians import rotations_from_quats
from gsvis.scene.paths import HeadPath
from gsvis.scene.similarity import Similarity

F64 = NDArray[np.float64]


def wander(count: int = 20, seed: int = 0, **more: Any) -> HeadPath:
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.01, 0.2, count - 1))])
    return HeadPath(times, rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), **more)


def some_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(float(np.exp(rng.normal())), rng.normal(size=4), 10 * rng.normal(size=3))


def angle(a: F64, b: F64) -> F64:
    """Radians between orientations (S, 4)."""
    return np.asarray(2.0 * np.arccos(np.clip(np.abs(np.sum(a * b, axis=-1)), 0.0, 1.0)))


def test_at_the_recorded_times_the_poses_are_the_recorded_ones() -> None:
    path = wander()
    positions, quats = path.at(path.times)
    assert np.allclose(positions, path.positions)
    assert angle(quats, path.quats).max() < 1e-6
    position, quat = path.at(path.times[3])
    assert position.shape == (3,)
    assert quat.shape == (4,)
    assert np.allclose(position, path.positions[3])


@pytest.mark.parametrize("count", [1, 2, 5])
def test_outside_its_time_the_head_stands_still(count: int) -> None:
    path = wander(count)
    positions, quats = path.at([-1e9, path.duration + 1e9])
    assert np.array_equal(positions, path.positions[[0, -1]])
    assert np.allclose(quats, path.quats[[0, -1]])


def test_between_poses_it_moves_straight_and_turns_at_constant_speed() -> None:
    half_turn = [np.cos(0.75 * np.pi / 2), 0.0, np.sin(0.75 * np.pi / 2), 0.0]  # 135 degrees about y
    path = HeadPath([0.0, 2.0], [[0, 0, 0], [4, 0, 2]], [[1, 0, 0, 0], half_turn])
    positions, quats = path.at(np.linspace(0, 2, 9))
    assert np.allclose(positions, np.linspace(0, 1, 9)[:, None] * [4, 0, 2])
    turned = angle(quats, np.array([1.0, 0.0, 0.0, 0.0]))
    assert np.allclose(turned, np.linspace(0, np.radians(135), 9))


def test_the_sign_of_a_quaternion_is_nothing() -> None:
    path = wander()
    flipped = HeadPath(path.times, path.positions, path.quats * np.random.default_rng(1).choice([-1, 1], (20, 1)))
    assert np.allclose(flipped.quats, path.quats)
    assert np.all(np.sum(path.quats[1:] * path.quats[:-1], axis=1) >= 0)


def test_lengths_of_quaternions_are_nothing_but_zero_is_refused() -> None:
    path = wander()
    for factor in (0.999, 1e-200, 1e200):
        assert np.allclose(HeadPath(path.times, path.positions, factor * path.quats).quats, path.quats)
    quats = path.quats.copy()
    quats[3] = 0.0
    with pytest.raises(ValueError, match="zero quaternion at index 3"):
        HeadPath(path.times, path.positions, quats)


@given(st.floats(0.5, 400.0))
def test_resampling_is_steady_and_stays_on_the_path(rate: float) -> None:
    path = wander()
    steady = path.resample(rate)
    assert np.allclose(np.diff(steady.times), 1.0 / rate)
    assert steady.duration <= path.duration + 1e-6 < steady.duration + 1.0 / rate + 2e-6
    assert steady.length <= path.length + 1e-9
    assert np.allclose(steady.positions, path.at(steady.times)[0])


def test_resampling_at_times_and_what_is_refused() -> None:
    path = wander()
    again = path.resample(times=path.times[4:9])
    assert np.allclose(again.times, path.times[4:9] - path.times[4])
    assert np.allclose(again.positions, path.positions[4:9])
    for wrong in (
        {},
        {"rate_hz": 1.0, "times": [0.0]},
        {"rate_hz": 0.0},
        {"rate_hz": 1e12},
        {"times": []},
        {"times": [0.2, 0.1]},
        {"times": [0.0, 1e9]},
    ):
        with pytest.raises(ValueError, match=r"rate_hz|times"):
            path.resample(**wrong)


def test_cuts_join_to_the_whole() -> None:
    path = wander()
    middle = 0.37 * path.duration
    first, second = path.cut(0.0, middle), path.cut(middle)
    assert first.duration + second.duration == pytest.approx(path.duration)
    assert first.length + second.length == pytest.approx(path.length)
    assert np.allclose(first.positions[-1], second.positions[0])
    assert np.allclose(second.at(0.1)[0], path.at(middle + 0.1)[0])
    for start, stop in ((-1.0, 1.0), (1.0, 1.0), (2.0, 1.0), (path.duration, np.inf)):
        with pytest.raises(ValueError, match="start"):
            path.cut(start, stop)


def test_cameras_stand_where_the_head_is_and_look_where_it_faces() -> None:
    path = wander()
    cameras = path.cameras(64, 48, 90.0)
    assert np.allclose(cameras.viewpoints, path.positions)
    assert np.allclose(cameras.forwards, path.forwards)
    assert np.allclose(-cameras.viewmats[:, 1, :3], path.head_ups)
    assert cameras.Ks[0, 0, 0] == pytest.approx(32.0)


def test_speed_times_time_is_length() -> None:
    path = wander()
    assert float(np.sum(path.speed() * np.diff(path.times))) == pytest.approx(path.length)
    assert wander(1).speed().shape == (0,)
    assert wander(1).length == 0.0


def test_upright_is_what_is_known_or_the_mean_of_the_head() -> None:
    path = wander(up=np.array([0.0, 0.0, 2.0]))
    assert np.allclose(path.upright, [0, 0, 1])
    level = HeadPath([0.0, 1.0], np.zeros((2, 3)), [[1, 0, 0, 0], [np.cos(0.5), 0, np.sin(0.5), 0]])
    assert np.allclose(level.upright, [0, -1, 0])  # turning about y keeps OpenCV's -y up
    over = HeadPath([0.0, 1.0], np.zeros((2, 3)), [[1, 0, 0, 0], [0, 0, 0, 1]])
    assert np.linalg.norm(over.upright) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, 1.0, 1.0], "index 2"),
        ([0.0, 2.0, 1.0], "rising"),
        ([1.0, 2.0, 3.0], "start at 0"),
        ([0.0, 1.0], "one length"),
    ],
)
def test_times_that_do_not_rise_from_zero_are_refused(times: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HeadPath(times, np.zeros((3, 3)), np.tile([1.0, 0, 0, 0], (3, 1)))  # type: ignore[arg-type]


def test_nothing_and_nonsense_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one pose"):
        HeadPath(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4)))
    with pytest.raises(ValueError, match="finite"):
        HeadPath(np.zeros(1), np.full((1, 3), np.nan), np.ones((1, 4)))
    with pytest.raises(ValueError, match="meters_per_unit"):
        wander(meters_per_unit=0.0)
    with pytest.raises(ValueError, match="read-only"):
        wander().positions[0] = 1.0


@given(st.integers(0, 2**31))
def test_a_similarity_keeps_angles_and_ratios_and_comes_back(seed: int) -> None:
    similarity = some_similarity(seed)
    points = np.random.default_rng(seed + 1).normal(size=(9, 3))
    moved = similarity.apply(points)
    between = np.linalg.norm(points[1:] - points[:-1], axis=1)
    assert np.allclose(np.linalg.norm(moved[1:] - moved[:-1], axis=1), similarity.scale * between)
    a, b = points[1:] - points[0], moved[1:] - moved[0]
    assert np.allclose(b @ b.T, similarity.scale**2 * (a @ a.T), atol=1e-9 * (1 + similarity.scale**2))
    assert np.linalg.det(similarity.rotation) == pytest.approx(1.0)
    assert np.allclose(similarity.inverse().apply(moved), points, atol=1e-9)
    again = Similarity.from_dict(json.loads(json.dumps(similarity.as_dict())))
    assert np.allclose(again.apply(points), moved, rtol=1e-12)


@given(st.integers(0, 2**31))
def test_a_moved_path_looks_at_the_moved_world(seed: int) -> None:
    path, similarity = wander(6, seed, up=np.array([0.0, 1.0, 0.0]), meters_per_unit=2.0), some_similarity(seed + 7)
    moved = path.transform(similarity)
    ahead = path.positions + 3.0 * path.forwards
    assert np.allclose(moved.positions + 3.0 * similarity.scale * moved.forwards, similarity.apply(ahead))
    assert moved.length == pytest.approx(similarity.scale * path.length)
    assert moved.meters_per_unit == pytest.approx(2.0 / similarity.scale)
    assert moved.up is not None
    assert path.up is not None
    assert np.allclose(moved.up, similarity.rotation @ path.up)
    back = moved.transform(similarity.inverse())
    assert np.allclose(back.positions, path.positions, atol=1e-9)
    assert np.allclose(rotations_from_quats(back.quats), rotations_from_quats(path.quats))


def test_what_is_no_similarity_is_refused() -> None:
    for scale in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="scale"):
            Similarity(scale)
    with pytest.raises(ValueError, match="quat"):
        Similarity(1.0, np.zeros(4))
