"""Judge's eyes: they stand around the detail, follow the scene, and know no navigable space."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.judging import draw_judges
from gsvis.scene.solid import buried


def platform(seed: int = 3, count: int = 1500) -> Gaussians:
    """Return a platform 10 units wide with a wall, in the open, and a shell of outliers far away."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform([-5, -3, -0.05], [5, 3, 0.05], (count, 3))
    wall = rng.uniform([4.8, -3, 0], [5, 3, 2], (count // 2, 3))
    far = rng.normal(size=(count // 10, 3))
    far *= 2000.0 / np.linalg.norm(far, axis=1, keepdims=True)
    means = np.concatenate([floor, wall, far])
    scales = np.full((len(means), 3), 0.15)
    scales[len(floor) + len(wall) :] = 40.0
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1))
    return Gaussians(means, quats, scales, np.full(len(means), 0.95), rng.uniform(-1, 1, (len(means), 1, 3)))


def look_at(g: Gaussians):
    def look(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
        drawn = rasterize(g, cameras, backend="cpu")
        return drawn.alphas, drawn.depths

    return look


def test_eyes_are_near_the_detail_outside_of_solid_and_outliers_set_no_scale() -> None:
    g = platform()
    found = draw_judges(g, 16, look_at(g))
    assert len(found) == 16
    eyes = found.viewpoints
    assert np.linalg.norm(eyes, axis=1).max() < 20.0
    assert not buried(g, eyes).any()


def test_the_same_seed_gives_the_same_eyes_and_another_gives_others() -> None:
    g = platform()
    first, again, other = (draw_judges(g, 6, look_at(g), seed=seed).viewpoints for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_eyes_do_not_depend_on_how_many_are_tested_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    g = platform()
    found = []
    for pairs in (1 << 12, 1 << 16, 1 << 24):
        monkeypatch.setattr("gsvis.scene.judging._AT_ONCE", pairs)
        found.append(draw_judges(g, 10, look_at(g)).viewpoints)
    assert len(found[0]) == 10
    for each in found[1:]:
        np.testing.assert_allclose(each, found[0], rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-2, 1.0, 300.0])
def test_eyes_move_with_the_scene(scale: float) -> None:
    g = platform()

    # Every eye is free here: which one is taken must not hang on a rounded depth.
    def look(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
        alphas = np.ones((len(cameras), cameras.height, cameras.width), np.float32)
        return alphas, np.full_like(alphas, np.inf)

    turn, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    shift = scale * np.array([3.0, -2.0, 1.0])
    moved = g.transform(scale=scale, rotation=turn, translation=shift)
    before = draw_judges(g, 12, look).viewpoints
    after = draw_judges(moved, 12, look).viewpoints
    assert np.allclose(after, scale * before @ turn.T + shift, atol=1e-3 * scale)


def test_a_scene_without_detail_has_no_judges() -> None:
    g = platform()[:3]
    assert len(draw_judges(g, 4, look_at(g))) == 0
