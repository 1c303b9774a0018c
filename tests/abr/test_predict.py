"""Predictors of the pose: motions they must follow exactly, and recorded ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.abr.predict import (
    PREDICTORS,
    KalmanPose,
    LastPose,
    LinearPose,
    Pose,
    conjugate,
    exponential,
    predictor,
    product,
    rotation_vector,
)
from gsvis.io.eyenav import read_eyenav


def turn_between(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(rotation_vector(product(conjugate(a), b))))


@given(st.lists(st.floats(-1.8, 1.8), min_size=3, max_size=3))
def test_rotation_vectors_and_quaternions_are_inverse(values: list[float]) -> None:
    vector = np.array(values)
    assert rotation_vector(exponential(vector)) == pytest.approx(vector, abs=1e-9)
    assert rotation_vector(-exponential(vector)) == pytest.approx(vector, abs=1e-9)


@given(st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3), st.lists(st.floats(-1, 1), min_size=3, max_size=3))
def test_poses_measure_how_far_they_are_apart(values: list[float], step: list[float]) -> None:
    start = Pose.from_arrays([1, 2, 3], exponential(np.array([0.3, -0.2, 0.9])))
    turned = product(start.quat, exponential(np.array(values)))
    for quat in (turned, -turned):
        other = Pose.from_arrays(start.position + step, quat)
        assert start.turn_to(other) == pytest.approx(np.linalg.norm(values), abs=1e-7)
        assert start.distance_to(other) == pytest.approx(np.linalg.norm(step))
    assert start.turn_to(start) == 0.0


@pytest.mark.parametrize("made", [LinearPose(), KalmanPose()])
def test_steady_motion_is_followed(made) -> None:
    velocity, spin = np.array([1.0, -0.5, 0.2]), np.array([0.3, -0.8, 0.5])
    start = exponential(np.array([0.1, 2.0, 0.3]))
    for k in range(60):
        t = k / 30
        made.observe(t, t * velocity, product(start, exponential(t * spin)))
    last = 59 / 30
    for ahead in (0.0, 0.1, 0.5):
        pose = made.predict(last + ahead)
        assert pose.position == pytest.approx((last + ahead) * velocity, abs=2e-3)
        assert turn_between(pose.quat, product(start, exponential((last + ahead) * spin))) < 5e-3


@pytest.mark.parametrize("name", PREDICTORS)
def test_at_rest_nothing_is_predicted_to_move(name: str) -> None:
    made, quat = predictor(name), exponential(np.array([0.4, 0.1, -2.0]))
    assert np.array_equal(made.predict(3.0).quat, [1, 0, 0, 0])
    for k in range(20):
        made.observe(k / 10, [1, 2, 3], 3 * (-1) ** k * quat)
    pose = made.predict(5.0)
    assert pose.position == pytest.approx([1, 2, 3])
    assert turn_between(pose.quat, quat) < 1e-6
    assert np.linalg.norm(pose.quat) == pytest.approx(1.0)


@pytest.mark.parametrize("name", PREDICTORS)
def test_what_is_late_or_wrong_changes_nothing(name: str) -> None:
    made = predictor(name)
    for k in range(5):
        made.observe(float(k), [k, 0, 0], [1, 0, 0, 0])
    before = made.predict(4.5)
    made.observe(4.0, [9, 9, 9], [0, 1, 0, 0])
    made.observe(2.0, [9, 9, 9], [0, 1, 0, 0])
    for position, quat, t in (
        ([np.nan, 0, 0], [1, 0, 0, 0], 5.0),
        ([0, 0, 0], [0, 0, 0, 0], 5.0),
        ([0, 0], [1, 0, 0, 0], 5.0),
        ([0, 0, 0], [1, 0, 0, 0], np.nan),
    ):
        with pytest.raises(ValueError, match=r"^(position|quat|t): expected"):
            made.observe(t, position, quat)
    after = made.predict(4.5)
    assert np.array_equal(after.position, before.position)
    assert np.array_equal(after.quat, before.quat)


def test_the_filter_is_steadier_than_a_line_through_noise() -> None:
    rng = np.random.default_rng(0)
    errors = {}
    for made in (LinearPose(), KalmanPose(noise=0.02, acceleration=0.3)):
        found = []
        for k in range(200):
            t = k / 30
            made.observe(t, np.array([t, 0, 0]) + rng.normal(0, 0.02, 3), [1, 0, 0, 0])
            found.append(np.linalg.norm(made.predict(t + 0.25).position - [t + 0.25, 0, 0]))
        errors[type(made)] = np.median(found[50:])
    assert errors[KalmanPose] < 0.5 * errors[LinearPose]


@pytest.mark.realdata
def test_recorded_heads(realdata: Path) -> None:
    """Median errors at 100, 250 and 500 ms; at the shortest both models beat the head at rest."""
    files = sorted((realdata / "traces" / "eyenav_rutgers").rglob("*.csv.gz"))[::11]
    errors: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for file in files:
        path = read_eyenav(file).resample(30.0).cut(5.0, 25.0)
        for name in PREDICTORS:
            made = predictor(name)
            for k, t in enumerate(path.times):
                made.observe(float(t), path.positions[k], path.quats[k])
                for ahead in (100, 250, 500):
                    if k % 5 == 0 and t + ahead / 1000 <= path.duration:
                        pose, (position, quat) = made.predict(t + ahead / 1000), path.at(t + ahead / 1000)
                        apart = float(np.linalg.norm(pose.position - position))
                        errors.setdefault((name, ahead), []).append((apart, np.degrees(turn_between(pose.quat, quat))))
    medians = {key: np.median(values, axis=0) for key, values in errors.items()}
    for name in ("linear", "kalman"):
        assert (medians[name, 100] < medians["last", 100]).all()
    assert isinstance(predictor("last"), LastPose)
