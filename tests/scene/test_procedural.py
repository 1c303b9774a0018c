"""Occluder scenes: the closed form agrees with weights by the definition, and the sheets are opaque."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.scene._surfaces import OPACITY, Sheet, Shell
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import BUILTIN_SCENES, OCCLUDER_SCENES, OccluderScene, builtin_scene, random_scene
from gsvis.scene.sh import sh_basis

F64 = NDArray[np.float64]
NAMES = tuple(OCCLUDER_SCENES)
TAU = 1.0 / 255.0


class BruteForce:
    """Weights by docs/conventions.md, every Gaussian against every ray, in float64."""

    def __init__(self, g: Gaussians) -> None:
        self.g = g
        means, scales = g.means.astype(np.float64), g.scales.astype(np.float64)
        self.means = means
        self.whiten = np.swapaxes(g.rotations(), 1, 2) / scales[:, :, None]
        content = np.lexsort((*scales.T[::-1], *means.T[::-1]))
        self.rank = np.argsort(content)

    def along(self, eye: F64, toward: F64) -> tuple[NDArray[np.int64], F64, float]:
        """Ids front to back, their weights, and the transmittance behind them all."""
        direction = (toward - eye) / np.linalg.norm(toward - eye)
        start = np.einsum("nij,nj->ni", self.whiten, eye - self.means)
        step = self.whiten @ direction
        t = np.maximum(-np.einsum("ni,ni->n", start, step) / np.einsum("ni,ni->n", step, step), 0.0)
        least = start + t[:, None] * step
        alphas = np.minimum(self.g.opacities * np.exp(-0.5 * np.einsum("ni,ni->n", least, least)), 0.999)
        ids = np.flatnonzero(alphas >= TAU)
        ids = ids[np.lexsort((self.rank[ids], t[ids]))]
        left = np.concatenate([[1.0], np.cumprod(1.0 - alphas[ids])])
        return ids, alphas[ids] * left[:-1], float(left[-1])

    def weight(self, eye: F64, toward: F64, index: int) -> float:
        """Weight of one Gaussian on that ray."""
        ids, weights, _ = self.along(eye, toward)
        return float(weights[ids == index].sum())


@lru_cache
def small(name: str) -> OccluderScene:
    return OCCLUDER_SCENES[name](5000)


@lru_cache
def full(name: str) -> OccluderScene:
    return OCCLUDER_SCENES[name]()


def drawn(rng: np.random.Generator, mask: NDArray[np.bool_], count: int) -> list[int]:
    return [int(i) for i in rng.permutation(np.flatnonzero(mask))[:count]]


@pytest.mark.parametrize("name", NAMES)
class TestClosedForm:
    def test_surfaces_are_in_the_order_of_the_gaussians(self, name: str) -> None:
        scene, start = small(name), 0
        for surface in scene.surfaces:
            discs = scene.gaussians.means[start : start + surface.count]
            assert np.array_equal(discs, surface.patch().means.astype(np.float32))
            start += surface.count
        assert start == len(scene.gaussians)

    def test_visible_ones_are_seen_on_the_ray_to_their_center(self, name: str) -> None:
        scene, rng = small(name), np.random.default_rng(1)
        brute = BruteForce(scene.gaussians)
        for eye, visible in zip(scene.viewpoints, scene.visible, strict=True):
            for i in drawn(rng, visible, 40):
                assert brute.weight(eye, brute.means[i], i) >= 1.5 * TAU

    def test_hidden_ones_are_spent_wherever_a_ray_meets_them(self, name: str) -> None:
        scene, rng = small(name), np.random.default_rng(2)
        brute = BruteForce(scene.gaussians)
        frames = scene.gaussians.rotations() * scene.gaussians.scales.astype(np.float64)[:, None, :]
        for eye, hidden in zip(scene.viewpoints, scene.hidden, strict=True):
            for i in drawn(rng, hidden, 20):
                for spread in (0.0, 1.0, 2.0, 3.0):
                    toward = brute.means[i] + frames[i] @ (spread * unit(rng.normal(size=2), 3))
                    assert brute.weight(eye, toward, i) < TAU

    def test_verdicts_exclude_each_other_and_decide_most(self, name: str) -> None:
        scene = full(name)
        assert not (scene.visible & scene.hidden).any()
        assert scene.undecided.mean() < 0.1
        assert scene.undecided.mean(axis=1).max() < 0.15
        assert scene.visible.any(axis=1).all()
        assert scene.hidden.any(axis=1).all()

    def test_finer_scenes_decide_more(self, name: str) -> None:
        assert full(name).undecided.mean() < small(name).undecided.mean()

    def test_shapes_and_navigable_space(self, name: str) -> None:
        scene = small(name)
        v, n = len(scene.viewpoints), len(scene.gaussians)
        assert scene.visible.shape == scene.hidden.shape == (v, n)
        assert scene.visible.dtype == scene.hidden.dtype == bool
        assert abs(n - 5000) < 1000
        assert scene.navigable.contains(scene.viewpoints[:1]).all()
        assert scene.name == name
        cameras = scene.navigable.sample_cameras(5, np.random.default_rng(0))
        distance = np.linalg.norm(cameras.viewpoints[:, None] - scene.gaussians.means[None], axis=2).min(axis=1)
        assert (distance > 0.1).all()

    def test_colors_are_plausible_and_drift_with_the_view(self, name: str) -> None:
        g = small(name).gaussians
        assert g.sh_degree >= 2
        directions = unit(np.random.default_rng(3).normal(size=(12, 3)), 3)
        colors = 0.5 + np.einsum(
            "dk,nkc->dnc", sh_basis(directions, g.sh_degree), np.concatenate([g.sh0, g.shN], axis=1)
        )
        assert colors.min() > -0.2
        assert colors.max() < 1.3
        assert 0.01 < colors.std(axis=0).mean() < 0.2

    def test_the_same_every_time(self, name: str) -> None:
        again = OCCLUDER_SCENES[name](5000)
        assert np.array_equal(again.gaussians.means, small(name).gaussians.means)
        assert np.array_equal(again.visible, small(name).visible)


def unit(vectors: F64, width: int) -> F64:
    """Vectors at unit length, padded with zeros to `width`."""
    scaled = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.pad(scaled, [(0, 0)] * (vectors.ndim - 1) + [(0, width - vectors.shape[-1])])


def as_gaussians(surface: Sheet | Shell) -> Gaussians:
    patch = surface.patch()
    n = len(patch.means)
    return Gaussians(patch.means, patch.quats, patch.scales, np.full(n, OPACITY), np.zeros((n, 1, 3)))


class TestOpacity:
    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_no_light_through_a_sheet_at_any_angle(self, axis: int) -> None:
        brute = BruteForce(as_gaussians(Sheet(axis, 0.3, (0.0, 0.0), (2.0, 3.0), 0.1)))
        rng = np.random.default_rng(axis)
        for _ in range(150):
            through = np.insert(rng.uniform((0.12, 0.12), (1.88, 2.88)), axis, 0.3)
            eye = through + rng.normal(size=3) * 3.0 * (1.0 + 2.0 * (np.arange(3) != axis))
            assert brute.along(eye, through)[2] < TAU / 10.0

    def test_hardly_any_light_through_a_shell(self) -> None:
        brute = BruteForce(as_gaussians(Shell((0.0, 0.0, 0.0), 1.0, 0.1)))
        for toward in np.random.default_rng(5).normal(size=(150, 3)):
            assert brute.along(np.array([0.1, -0.2, 0.3]), toward)[2] < TAU / 2.0

    def test_no_light_into_a_room_through_its_partition_seams(self) -> None:
        scene = small("two_rooms")
        brute = BruteForce(scene.gaussians)
        rng, eye = np.random.default_rng(6), scene.viewpoints[0]
        for y, z in [(rng.uniform(0.3, 1.0), 0.0), (0.0, rng.uniform(0.5, 2.5)), (4.0, 1.3), (0.5, 3.0), (0.0, 0.0)]:
            assert brute.along(eye, np.array([4.0, y, z]))[2] < TAU / 10.0

    def test_a_hole_is_clear(self) -> None:
        sheet = Sheet(1, 0.0, (-1.0, -1.0), (1.0, 1.0), 0.05, (((-0.31, -0.3), (0.3, 0.33)),))
        brute = BruteForce(as_gaussians(sheet))
        low, _ = sheet.snapped[0]
        assert np.abs(low - [-0.3, -0.3]).max() < 0.026
        ids, _, left = brute.along(np.array([0.1, -2.0, 0.1]), np.array([0.0, 0.0, 0.0]))
        assert (len(ids), left) == (0, 1.0)

    @pytest.mark.parametrize("surface", [Sheet(2, 0.0, (0, 0), (1, 1), 0.1), Shell((0.0, 0.0, 0.0), 1.0, 0.1)])
    def test_discs_lie_in_their_surface(self, surface: Sheet | Shell) -> None:
        patch = surface.patch()
        thin = as_gaussians(surface).rotations()[:, :, 2]
        assert np.abs(np.einsum("ni,ni->n", thin, patch.normals)) == pytest.approx(1.0, abs=1e-6)
        assert surface.distance(patch.means).max() < 1e-9


class TestBuiltin:
    def test_unknown_name_lists_the_known(self) -> None:
        with pytest.raises(ValueError, match=r"name: expected one of 'flat', .*got 'castle'"):
            builtin_scene("castle")

    def test_bad_arguments(self) -> None:
        with pytest.raises(ValueError, match="count: expected"):
            BUILTIN_SCENES["two_rooms"](10)
        with pytest.raises(ValueError, match="sh_degree: expected"):
            BUILTIN_SCENES["two_rooms"](2000, sh_degree=4)

    @pytest.mark.parametrize("degree", [0, 1, 2, 3])
    def test_sh_degree(self, degree: int) -> None:
        assert BUILTIN_SCENES["nested_shells"](1500, sh_degree=degree).gaussians.sh_degree == degree


class TestRandomScene:
    @pytest.mark.parametrize("kind", ["blob", "discs", "needles", "nested", "coincident"])
    @pytest.mark.parametrize("n", [0, 1, 7, 300])
    def test_sizes_and_repeatability(self, kind: str, n: int) -> None:
        one, two = (random_scene(np.random.default_rng(n), n, 2, kind) for _ in range(2))
        assert (len(one), one.sh_degree) == (n, 2)
        assert np.array_equal(one.means, two.means)

    def test_kinds_are_what_they_say(self) -> None:
        rng = np.random.default_rng(0)
        assert np.all(random_scene(rng, 50, kind="discs").scales[:, 2] < 1e-3)
        needles = np.sort(random_scene(rng, 50, kind="needles").scales, axis=1)
        assert np.all(needles[:, 2] > 40 * needles[:, 1])
        coincident = random_scene(rng, 100, kind="coincident")
        assert len(np.unique(coincident.means, axis=0)) <= 26
        assert len(np.unique(coincident.scales, axis=0)) == 90

    def test_unknown_kind(self) -> None:
        with pytest.raises(ValueError, match="kind: expected one of"):
            random_scene(np.random.default_rng(0), 5, kind="cloud")
