"""Proxies enclose the ellipsoids they stand for, follow opacity, and stay small."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.raycast import EllipsoidProxies
from gsvis.raycast._kernels.near import mark_near
from gsvis.raycast.proxies import reaches
from gsvis.raycast.reference import brute_force_contributions, brute_force_near
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.icosphere import icosphere
from tests.raycast.scenes import rays, scene


@pytest.mark.parametrize("subdivisions", [0, 1, 2, 3])
def test_icosphere_is_closed_round_and_outward(subdivisions: int) -> None:
    vertices, faces = icosphere(subdivisions)
    assert faces.shape == (20 * 4**subdivisions, 3)
    assert len(vertices) == 2 + len(faces) // 2  # Euler
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0)
    a, b, c = np.swapaxes(vertices[faces], 0, 1)
    assert (np.einsum("fi,fi->f", np.cross(b - a, c - a), a + b + c) > 0).all()
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert {tuple(e) for e in edges} == {tuple(e[::-1]) for e in edges}  # every edge once in each sense


def test_the_order_of_the_80_faces_never_changes() -> None:
    vertices, faces = icosphere(1)
    coarse, base = icosphere(0)
    np.testing.assert_array_equal(vertices[:12], coarse)
    for f in range(20):
        np.testing.assert_array_equal(faces[4 * f : 4 * f + 3, 0], base[f])  # corner parts start at their corner
    assert faces[0].tolist() == [0, 12, 15]
    assert faces[79].tolist() == [38, 41, 39]


@pytest.mark.parametrize("faces", [20, 80])
@pytest.mark.parametrize("kind", ["blobs", "needles", "mixed", "far"])
def test_proxies_enclose_where_alpha_matters(kind: str, faces: int) -> None:
    g = scene(kind)
    proxies = EllipsoidProxies.from_scene(g, faces=faces)
    vertices, triangles = proxies.meshes()
    rng = np.random.default_rng(2)
    sphere = rng.normal(size=(200, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    rotations = g[proxies.ids].rotations()
    corners = vertices.astype(np.float64)[triangles].reshape(len(proxies), faces, 3, 3)
    for m in range(0, len(proxies), 7):
        surface = g.means[proxies.ids[m]] + (sphere * proxies.radii[m]) @ rotations[m].T
        normals = np.cross(corners[m, :, 1] - corners[m, :, 0], corners[m, :, 2] - corners[m, :, 0])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        outside = np.einsum("sfi,fi->sf", surface[:, None] - corners[m, :, 0], normals / lengths)
        slack = 1e-4 * proxies.radii[m].max() + 4e-7 * np.abs(corners[m]).max()
        assert outside.max() <= slack
        reach = np.abs(corners[m] - g.means[proxies.ids[m]]).max()
        assert reach <= 1.3 * proxies.radii[m].max() + slack


def test_size_follows_opacity() -> None:
    opacities = np.array([0.0, 1 / 255 - 1e-6, 1 / 255 + 1e-6, 0.5, 1.0], np.float32)
    reach = reaches(opacities)
    assert np.isnan(reach[:2]).all()
    np.testing.assert_allclose(opacities[2:] * np.exp(-0.5 * reach[2:] ** 2), 1 / 255, rtol=1e-6)
    g = Gaussians(np.zeros((5, 3)), [[1, 0, 0, 0]] * 5, np.ones((5, 3)), opacities, np.zeros((5, 1, 3)))
    assert EllipsoidProxies.from_scene(g).ids.tolist() == [2, 3, 4]
    assert EllipsoidProxies.from_scene(g, min_alpha=0.9).ids.tolist() == [4]


def test_a_part_of_the_meshes_is_that_part_of_the_whole() -> None:
    proxies = EllipsoidProxies.from_scene(scene("blobs"))
    whole, faces = proxies.meshes()
    part, part_faces = proxies.meshes(5, 9)
    np.testing.assert_array_equal(part[part_faces], whole[faces][5 * 20 : 9 * 20])
    mesh = proxies.to_trimesh()
    assert mesh.is_volume
    assert len(mesh.faces) == 20 * len(proxies)


def test_refusals() -> None:
    with pytest.raises(ValueError, match=r"^faces: expected 20 or 80, got 21"):
        EllipsoidProxies.from_scene(scene("one"), faces=21)
    with pytest.raises(ValueError, match=r"^min_alpha: expected a value in \(0, 1\)"):
        EllipsoidProxies.from_scene(scene("one"), min_alpha=0.0)


@pytest.mark.parametrize("kind", ["blobs", "needles", "mixed", "far"])
def test_what_lies_near_rays_is_what_brute_force_finds_and_holds_all_that_they_meet(kind: str) -> None:
    g = scene(kind)
    rays_o, rays_d = rays(kind)
    rays_d = rays_d / np.linalg.norm(rays_d, axis=1, keepdims=True)
    rng = np.random.default_rng(0)
    centers, reaches_of = g.means.astype(np.float64), g.scales.max(axis=1) * rng.random(len(g))
    marked = np.empty(len(g), bool)
    mark_near(centers, reaches_of, np.empty((0, 3, 3)), rays_o, rays_d, 1e-6, marked)
    assert 0 < marked.sum() < len(g)
    np.testing.assert_array_equal(marked, brute_force_near(centers, reaches_of, rays_o, rays_d, 1e-6))
    proxies = EllipsoidProxies.from_scene(g)
    met = np.unique(brute_force_contributions(g, rays_o, rays_d).gaussian_ids)
    near = proxies.near(rays_o, rays_d)
    assert np.isin(met, proxies.ids[near]).all()
    np.testing.assert_array_equal(proxies[np.flatnonzero(near)].ids, proxies.ids[near])


@pytest.mark.parametrize(("beside", "is_near"), [(0.0, True), (0.05, True), (0.5, False)])
def test_a_ray_along_a_needle_is_near_it_only_where_it_meets_it(beside: float, is_near: bool) -> None:
    needle = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1.0, 0.02, 0.02]], [0.9], np.zeros((1, 1, 3)))
    proxies = EllipsoidProxies.from_scene(needle)
    origin = np.array([[-9.0, beside, 0.0]])
    assert proxies.near(origin, np.array([[1.0, 0.0, 0.0]])).tolist() == [is_near]
    assert not proxies.near(origin, np.array([[-1.0, 0.0, 0.0]])).any()  # behind the eye
