"""Where a scene is solid: many points at once are tested like each alone, and like every Gaussian by hand."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.solid import BURIED, Solid, buried


def clutter(seed: int, n: int = 400) -> Gaussians:
    rng = np.random.default_rng(seed)
    scales = rng.uniform(0.001, 0.3, (n, 3))
    scales[:3] = 4.0
    opacities = rng.uniform(0.0, 1.0, n)
    opacities[:3] = (0.5, 0.501, 0.3)
    return Gaussians(rng.normal(size=(n, 3)), rng.normal(size=(n, 4)), scales, opacities, np.zeros((n, 1, 3)))


def largest_alpha(g: Gaussians, point: np.ndarray) -> float:
    best = 0.0
    for mean, axes, scales, opacity in zip(g.means, g.rotations(), g.scales, g.opacities, strict=True):
        along = axes.T @ (point - mean.astype(np.float64)) / scales
        best = max(best, float(opacity) * float(np.exp(-0.5 * along @ along)))
    return best


@pytest.mark.parametrize("few", [0, 8192], ids=["bins", "runs"])
@pytest.mark.parametrize("seed", range(3))
def test_points_together_are_tested_as_each_alone(seed: int, few: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.scene.solid._FEW", few)
    g = clutter(seed)
    points = np.random.default_rng([1, seed]).normal(scale=1.5, size=(700, 3))
    points[5:200] = points[4]  # equal points cannot be halved by a plane
    together = Solid.from_scene(g).buries(points)
    assert together.tolist() == [bool(buried(g, point[None])[0]) for point in points]
    for point, inside in zip(points[200:300], together[200:300], strict=True):
        assert inside == (largest_alpha(g, point) >= BURIED)
    assert 0 < np.count_nonzero(together) < len(points)


def test_nothing_is_solid_without_opaque_gaussians_or_points() -> None:
    g = clutter(0)
    faint = Gaussians(g.means, g.quats, g.scales, 0.4 * g.opacities, g.sh0)
    assert not buried(faint, g.means.astype(np.float64)).any()
    assert buried(g, np.zeros((0, 3))).tolist() == []
    assert not buried(Gaussians.empty(), np.zeros((2, 3))).any()


def test_what_is_solid_near_a_box_buries_the_same_points_of_it() -> None:
    g = clutter(7)
    low, high = np.array([-0.5, 0.1, -1.0]), np.array([0.4, 0.9, 0.3])
    points = np.random.default_rng(2).uniform(low, high, (300, 3))
    whole = Solid.from_scene(g)
    near = whole.near(low, high)
    assert 3 <= len(near.ids) < len(whole.ids)
    assert near.buries(points).tolist() == whole.buries(points).tolist()


def test_points_in_a_plane_on_a_line_and_on_the_faces_of_boxes_are_found() -> None:
    g = clutter(4)
    solid = Solid.from_scene(g)
    flat = np.random.default_rng(3).normal(size=(300, 3)) * (1.0, 0.0, 0.5)
    line = np.linspace(-2.0, 2.0, 200)[:, None] * (0.0, 1.0, 0.0)
    corners = np.concatenate([solid.low, solid.high, g.means.astype(np.float64)])
    for points in (flat, line, corners):
        together = solid.buries(points)
        assert together.tolist() == [bool(solid.buries(point[None])[0]) for point in points]
        assert 0 < np.count_nonzero(together) < len(points)
