"""Contributions against the brute-force oracle, first hits against each other, and the laws both keep."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.errors import BackendError
from gsvis.raycast import Contributions, EllipsoidProxies, Tracer
from gsvis.raycast.reference import brute_force_contributions
from gsvis.scene.gaussians import Gaussians
from tests.raycast.scenes import KINDS, rays, scene


def tracer_of(g: Gaussians, **options: Any) -> Tracer:
    return Tracer(EllipsoidProxies.from_scene(g, **options))


def assert_same(got: Contributions, want: Contributions) -> None:
    np.testing.assert_array_equal(got.ray_offsets, want.ray_offsets)
    np.testing.assert_array_equal(got.gaussian_ids, want.gaussian_ids)
    np.testing.assert_allclose(got.alphas, want.alphas, atol=1e-5)
    np.testing.assert_allclose(got.weights, want.weights, atol=1e-5)
    np.testing.assert_allclose(got.depths, want.depths, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("search", ["hierarchy", "faces"])
def test_contributions_equal_the_oracle(kind: str, search: str) -> None:
    g = scene(kind)
    rays_o, rays_d = rays(kind)
    got = tracer_of(g).contributions(rays_o, rays_d, search=search)
    assert_same(got, brute_force_contributions(g, rays_o, rays_d))


@pytest.mark.parametrize("kind", KINDS)
def test_the_tracer_of_the_paper_asks_embree_and_agrees(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    g, (rays_o, rays_d), asked = scene(kind), rays(kind), list[int]()
    proxies = EllipsoidProxies.from_scene(g)
    embree = Tracer.named("embree", proxies)
    all_faces = embree.embree.all_faces

    def noting(*some: Any) -> Any:
        asked.append(len(some[0]))
        return all_faces(*some)

    monkeypatch.setattr(embree.embree, "all_faces", noting)
    assert_same(embree.contributions(rays_o, rays_d), Tracer.named("hierarchy", proxies).contributions(rays_o, rays_d))
    assert sum(asked) == len(rays_o)


def test_a_tracer_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="tracer: expected one of"):
        Tracer.named("optix", EllipsoidProxies.from_scene(scene("blobs")))


@pytest.mark.parametrize("search", ["hierarchy", "faces"])
def test_discs_of_one_wall_are_all_found(search: str) -> None:
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 12), np.linspace(-1.0, 1.0, 12))
    n = x.size
    means = np.stack([x.ravel(), y.ravel(), np.zeros(n)], axis=1)
    scales = np.tile([0.2, 0.2, 0.004], (n, 1))
    g = Gaussians(means, np.tile([1.0, 0, 0, 0], (n, 1)), scales, np.full(n, 0.2), np.zeros((n, 1, 3)))
    rng = np.random.default_rng(0)
    rays_o = rng.uniform(-1.0, 1.0, (300, 3)) + np.array([0.0, 0.0, 2.0])
    rays_d = rng.uniform(-1.0, 1.0, (300, 3)) * [1.0, 1.0, 0.0] - rays_o
    assert_same(tracer_of(g).contributions(rays_o, rays_d, search=search), brute_force_contributions(g, rays_o, rays_d))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("proxies", [7, 100, 1000])
def test_parts_change_nothing(kind: str, proxies: int) -> None:
    g = scene(kind)
    rays_o, rays_d = rays(kind)
    got = tracer_of(g).contributions_by_parts(rays_o, rays_d, proxies=proxies)
    assert_same(got, brute_force_contributions(g, rays_o, rays_d))


@given(seed=st.integers(0, 10_000), kind=st.sampled_from(KINDS), n=st.integers(2, 60))
def test_contributions_equal_the_oracle_on_any_scene(seed: int, kind: str, n: int) -> None:
    g = scene(kind, seed, max(n, 10))
    rays_o, rays_d = rays(kind, seed, 24)
    assert_same(tracer_of(g).contributions(rays_o, rays_d), brute_force_contributions(g, rays_o, rays_d))


def test_rays_with_more_hits_than_a_row_holds() -> None:
    n = 700
    means = np.zeros((n, 3))
    means[:, 2] = np.linspace(1.0, 2.0, n)
    g = Gaussians(
        means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), 1e-3), np.full(n, 0.0045), np.zeros((n, 1, 3))
    )
    rays_o, rays_d = np.zeros((5, 3)), np.array([[0, 0, 1.0], [0, 0, -1.0], [0, 0, 1.0], [1.0, 0, 0], [0, 1e-6, 1.0]])
    want = brute_force_contributions(g, rays_o, rays_d)
    assert np.diff(want.ray_offsets).tolist() == [n, 0, n, 0, n]
    assert_same(tracer_of(g).contributions(rays_o, rays_d, max_memory=4096), want)


def test_chunks_change_nothing() -> None:
    g = scene("mixed")
    rays_o, rays_d = rays("mixed", count=500)
    whole = tracer_of(g).contributions(rays_o, rays_d)
    assert_same(tracer_of(g).contributions(rays_o, rays_d, max_memory=1), whole)
    starts = [start for start, _ in tracer_of(g).iter_contributions(rays_o, rays_d, max_memory=1)]
    assert starts == list(range(0, 500, 64))


def test_no_rays_and_no_gaussians() -> None:
    empty = tracer_of(Gaussians.empty())
    for search in ("hierarchy", "faces"):
        assert len(tracer_of(scene("blobs")).contributions(np.zeros((0, 3)), np.zeros((0, 3)), search=search)) == 0
        none = empty.contributions(np.zeros((2, 3)), np.ones((2, 3)), search=search)
        assert none.ray_offsets.tolist() == [0, 0, 0]
    for engine in ("open3d", "embreex"):
        hits = Tracer(empty.proxies, engine).first_hit(np.zeros((2, 3)), np.ones((2, 3)))
        assert hits.gaussian_ids.tolist() == [-1, -1]
        assert np.isinf(hits.t_hit).all()


def test_an_opaque_gaussian_in_front_stops_the_ray() -> None:
    n = 4
    means = np.array([[0, 0, 1.0], [0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0]])
    opacities = np.array([0.5, 1.0, 1.0, 1.0])
    g = Gaussians(means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), 0.1), opacities, np.zeros((n, 1, 3)))
    found = tracer_of(g).contributions([[0, 0, 0]], [[0, 0, 2.0]])
    assert found.gaussian_ids.tolist() == [0, 1, 2]  # 0.5 * 0.001 * 0.001 < 1e-4 in front of the last
    np.testing.assert_allclose(found.weights, [0.5, 0.5 * 0.999, 0.5 * 0.001 * 0.999], rtol=1e-5)
    np.testing.assert_allclose(found.depths, [1.0, 2.0, 3.0], rtol=1e-6)
    np.testing.assert_allclose(found.transmittance, [0.5 * 0.001 * 0.001], rtol=1e-3)


def test_an_eye_past_the_center_looks_through_what_is_left() -> None:
    g = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1.0, 1.0, 1.0]], [0.8], [[[0, 0, 0]]])
    found = tracer_of(g).contributions([[0, 0, 1.0]], [[0, 0, 1.0]])
    np.testing.assert_allclose(found.alphas, [0.8 * np.exp(-0.5)], rtol=1e-6)
    assert found.depths.tolist() == [0.0]


@pytest.mark.parametrize("kind", ["blobs", "discs", "nested", "coincident", "mixed"])
def test_permutation_changes_nothing(kind: str) -> None:
    g = scene(kind)
    rays_o, rays_d = rays(kind)
    order = np.random.default_rng(5).permutation(len(g))
    plain, turned = tracer_of(g).contributions(rays_o, rays_d), tracer_of(g[order]).contributions(rays_o, rays_d)
    np.testing.assert_array_equal(order[turned.gaussian_ids], plain.gaussian_ids)
    np.testing.assert_array_equal(turned.weights, plain.weights)


@pytest.mark.parametrize("kind", ["blobs", "needles", "nested"])
def test_rigid_motion_changes_nothing(kind: str) -> None:
    g = scene(kind)
    rays_o, rays_d = rays(kind, count=300)
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    shift = np.array([0.3, -2.0, 1.0])
    moved = tracer_of(g.transform(rotation, shift)).contributions(rays_o @ rotation.T + shift, rays_d @ rotation.T)
    still = tracer_of(g).contributions(rays_o, rays_d)
    # The moved scene is rounded to float32, so weights near a cut may move a little; sums per Gaussian must not.
    want = np.bincount(still.gaussian_ids, still.weights, minlength=len(g))
    got = np.bincount(moved.gaussian_ids, moved.weights, minlength=len(g))
    np.testing.assert_allclose(got, want, rtol=2e-3, atol=2e-2 if kind == "needles" else 2e-3)


def test_scale_of_the_scene_changes_only_depths() -> None:
    g = scene("blobs")
    rays_o, rays_d = rays("blobs")
    small, large = tracer_of(g).contributions(rays_o, rays_d), tracer_of(g.transform(np.eye(3), scale=64.0))
    grown = large.contributions(64.0 * rays_o, rays_d)
    np.testing.assert_array_equal(grown.gaussian_ids, small.gaussian_ids)
    np.testing.assert_allclose(grown.weights, small.weights, atol=1e-6)
    np.testing.assert_allclose(grown.depths, 64.0 * small.depths, rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("faces", [20, 80])
def test_engines_agree_on_first_hits(kind: str, faces: int) -> None:
    proxies = EllipsoidProxies.from_scene(scene(kind), faces=faces)
    rays_o, rays_d = rays(kind, count=600)
    a, b = Tracer(proxies, "open3d").first_hit(rays_o, rays_d), Tracer(proxies, "embreex").first_hit(rays_o, rays_d)
    np.testing.assert_array_equal(np.isinf(a.t_hit), np.isinf(b.t_hit))
    hit = np.isfinite(a.t_hit)
    # Both work in float32; faces of needles are slivers, whose planes it knows less well.
    np.testing.assert_allclose(a.t_hit[hit], b.t_hit[hit], rtol=1e-5, atol=5e-5 if kind == "needles" else 1e-5)
    apart = a.gaussian_ids != b.gaussian_ids  # only where two proxies are hit at one depth
    assert apart.mean() <= (0.02 if kind == "far" else 0.005)


def test_first_hit_is_the_nearest_proxy() -> None:
    g = Gaussians([[0, 0, 5.0], [0, 0, 2.0]], [[1, 0, 0, 0]] * 2, [[0.1] * 3] * 2, [0.9, 0.9], np.zeros((2, 1, 3)))
    hits = Tracer(EllipsoidProxies.from_scene(g)).first_hit([[0, 0, 0], [0, 0, 3.5], [0, 0, 9]], [[0, 0, 3]] * 3)
    assert hits.gaussian_ids.tolist() == [1, 0, -1]
    reach = 0.1 * np.sqrt(2 * np.log(255 * 0.9))
    assert 2.0 - 1.26 * reach <= hits.t_hit[0] <= 2.0 - reach


def test_refusals_name_the_argument() -> None:
    proxies = EllipsoidProxies.from_scene(scene("one"))
    tracer = Tracer(proxies)
    with pytest.raises(ValueError, match=r"^rays_o: expected shape"):
        tracer.contributions(np.zeros((2, 2)), np.ones((2, 3)))
    with pytest.raises(ValueError, match=r"^rays_o / rays_d: expected one length"):
        tracer.contributions(np.zeros((2, 3)), np.ones((3, 3)))
    with pytest.raises(ValueError, match=r"^rays_d: expected non-zero"):
        tracer.contributions(np.zeros((1, 3)), np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"^rays_o: expected finite"):
        tracer.first_hit([[np.nan, 0, 0]], [[1, 0, 0]])
    with pytest.raises(ValueError, match=r"^search: expected one of"):
        tracer.contributions(np.zeros((1, 3)), np.ones((1, 3)), search="magic")
    with pytest.raises(ValueError, match=r"^engine: expected one of 'open3d', 'embreex'"):
        Tracer(proxies, "optix")
    with pytest.raises(BackendError, match=r"engine 'embreex' lists first hits only"):
        Tracer(proxies, "embreex").contributions(np.zeros((1, 3)), np.ones((1, 3)), search="faces")
