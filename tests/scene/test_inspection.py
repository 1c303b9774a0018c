"""Scene inspection: the up axis of rooms, objects and real scenes, counts that are known, and problems by name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.scene.axes import AXES, axis_vector, nearest_axis
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import inspect_scene
from gsvis.scene.procedural import random_scene
from gsvis.scene.upright import find_up


def scene(
    means: NDArray[np.float64], scales: object = 0.02, opacities: object = 0.7, sh0: object = None, degree: int = 0
) -> Gaussians:
    n = len(means)
    rng = np.random.default_rng(n)
    return Gaussians(
        means,
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.broadcast_to(np.asarray(scales, np.float64), (n, 3)) * rng.uniform(0.8, 1.2, (n, 1)),
        np.broadcast_to(np.asarray(opacities, np.float64), (n,)),
        rng.normal(size=(n, 1, 3)) if sh0 is None else np.full((n, 1, 3), sh0),
        np.zeros((n, (degree + 1) ** 2 - 1, 3)),
    )


def ground() -> Gaussians:
    """A patch of ground, z up, with bushes on it and a few floaters."""
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-5, 5, (6000, 2)), rng.normal(0, 0.02, 6000)])
    bushes = np.column_stack([rng.normal(0, 1.5, (2000, 2)), rng.exponential(0.8, 2000)])
    far = rng.normal(0, 300, (10, 3))
    return Gaussians.concatenate([scene(flat, (0.1, 0.1, 0.002)), scene(bushes, 0.05), scene(far, 2.0, 0.1)])


def rotation_to(axis: str) -> NDArray[np.float64]:
    """A rotation that takes +z to the axis."""
    up = axis_vector(axis)
    side = np.roll(np.abs(up), 1)
    return np.stack([side, np.cross(up, side), up], axis=1)


class TestUp:
    @pytest.mark.parametrize("axis", AXES)
    def test_ground_lies_below(self, axis: str) -> None:
        found = find_up(ground().transform(rotation_to(axis)))
        assert nearest_axis(found.up) == axis
        assert found.confidence > 0.6

    def test_without_evidence_it_is_minus_y_and_unsure(self) -> None:
        for g in (Gaussians.empty(), scene(np.zeros((50, 3))), scene(np.eye(3))):
            found = find_up(g)
            assert nearest_axis(found.up) == "-y"
            assert found.confidence < 0.4

    def test_order_and_scale_do_not_matter(self) -> None:
        g = ground()
        found = find_up(g)
        mixed = find_up(g[np.random.default_rng(2).permutation(len(g))])
        larger = find_up(g.transform(np.eye(3), scale=1000.0))
        for other in (mixed, larger):
            assert np.allclose(other.up, found.up, atol=1e-3)
            assert other.confidence == pytest.approx(found.confidence, abs=1e-3)

    def test_axis_vector(self) -> None:
        assert axis_vector("-y").tolist() == [0.0, -1.0, 0.0]
        with pytest.raises(ValueError, match="axis: expected one of"):
            axis_vector("up")


class TestReport:
    def test_known_numbers(self) -> None:
        means = np.random.default_rng(3).uniform(-1, 1, (1000, 3))
        shapes = np.tile([0.02, 0.02, 0.02], (1000, 1))
        shapes[:100] = [0.05, 0.002, 0.002]  # needles
        shapes[100:300] = [0.02, 0.02, 0.001]  # discs
        shapes[300:310] = 1.0  # giants
        opacities = np.full(1000, 0.7)
        opacities[:250] = 0.001
        report = inspect_scene(scene(means, shapes, opacities, degree=2))
        assert (report.count, report.sh_degree) == (1000, 2)
        assert report.needle_share == pytest.approx(0.1)
        assert report.disc_share == pytest.approx(0.2)
        assert report.giant_share == pytest.approx(0.01)
        assert report.invisible_share == pytest.approx(0.25)
        assert report.opaque_share == pytest.approx(0.75)
        assert (report.floaters, report.duplicates) == (0, 0)
        assert np.allclose(report.bounds, [means.min(axis=0), means.max(axis=0)], atol=1e-6)
        assert report.opacities["p50"] == pytest.approx(0.7)

    def test_floaters_and_duplicates_are_counted(self) -> None:
        g = scene(np.concatenate([np.random.default_rng(4).uniform(-1, 1, (1000, 3)), np.full((7, 3), 1e4)]))
        report = inspect_scene(Gaussians.concatenate([g, g[:12]]))
        assert report.floaters == 7
        assert report.duplicates == 12
        radius = np.quantile(np.linalg.norm(g.means[:1000], axis=1), 0.98)
        assert report.farthest == pytest.approx(1e4 * np.sqrt(3.0) / (2.0 * radius), rel=0.02)

    @pytest.mark.parametrize("kind", ["blob", "discs", "needles", "nested", "coincident"])
    @pytest.mark.parametrize("n", [0, 1, 2, 500])
    def test_any_scene_has_a_report_that_json_takes(self, kind: str, n: int) -> None:
        report = inspect_scene(random_scene(np.random.default_rng(5), n, 1, kind))
        again = json.loads(json.dumps(report.as_dict(), allow_nan=False))
        assert again["count"] == n
        assert np.linalg.norm(again["up_vector"]) == pytest.approx(1.0)
        assert any(axis in again["up"] for axis in AXES)
        assert 0.0 < again["up_confidence"] <= 1.0


def cloud(n: int = 400) -> NDArray[np.float64]:
    return np.random.default_rng(6).uniform(-1, 1, (n, 3))


class TestProblems:
    def test_a_sound_scene_has_none(self) -> None:
        rng = np.random.default_rng(7)
        g = ground()[:8000]
        varied = Gaussians(g.means, g.quats, g.scales, rng.uniform(0.1, 1, len(g)), g.sh0)
        assert inspect_scene(varied).problems == []

    @pytest.mark.parametrize(
        ("g", "words"),
        [
            (Gaussians.empty(), "no Gaussians"),
            (scene(np.concatenate([cloud(), np.full((1, 3), 900.0)])), "1 Gaussian lies outside"),
            (scene(cloud(), opacities=np.repeat([0.001, 0.7], 200)), "50% of the Gaussians have an opacity below"),
            (scene(cloud()), "all opacities equal 0.7"),
            (scene(cloud(), opacities=np.linspace(0.5, 0.731, 400)), "activated twice"),
            (scene(cloud(), opacities=np.linspace(0.01, 0.3, 400)), "faint"),
            (scene(cloud(), scales=1.2), "do not look activated"),
            (scene(cloud(), scales=np.linspace(0.01, 0.4, 400)[:, None]), "wider than a tenth"),
            (scene(cloud(), scales=(0.1, 0.001, 0.001)), "needles"),
            (Gaussians.concatenate([scene(cloud())] * 2), "400 Gaussians repeat"),
            (scene(np.zeros((9, 3))), "coincide"),
            (scene(1e4 * cloud()), "meters are unlikely"),
            (scene(1e-3 * cloud()), "meters are unlikely"),
            (scene(cloud(), sh0=0.4), "look like colors"),
            (scene(cloud(), degree=3), "coefficients are zero"),
            (scene(cloud()), "up axis is uncertain"),
        ],
    )
    def test_what_looks_wrong_is_reported(self, g: Gaussians, words: str) -> None:
        assert any(words in problem for problem in inspect_scene(g).problems)


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("path", "lod", "up"),
    [
        ("showroom/lod-meta.json", 3, "+z"),
        ("nika_sh3/lod-meta.json", 0, "-y"),
        ("nika_sh3/lod-meta.json", 2, "-y"),
        ("flowers_sh2/lod-meta.json", 1, "-y"),
    ],
)
def test_up_axis_of_real_scenes(realdata: Path, path: str, lod: int | None, up: str) -> None:
    from gsvis.io import load_scene

    g = load_scene(realdata / "scenes" / path, lod=lod)
    found = find_up(g)
    assert nearest_axis(found.up) == up
    assert found.confidence > 0.6
