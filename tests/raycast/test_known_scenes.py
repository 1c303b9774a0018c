"""Scenes whose visibility is known in closed form, and real ones against the brute-force oracle."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gsvis.io import load_scene
from gsvis.raycast import TAU, EllipsoidProxies, GaussianRays, Tracer, visible_from
from gsvis.raycast.reference import brute_force_contributions
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import OCCLUDER_SCENES


@pytest.mark.parametrize("name", sorted(OCCLUDER_SCENES))
def test_what_must_be_seen_is_seen_and_what_is_hidden_is_not(name: str) -> None:
    known = OCCLUDER_SCENES[name]()
    tracer = Tracer(EllipsoidProxies.from_scene(known.gaussians))
    by_gaussians = visible_from(tracer, known.viewpoints, sampling="gaussians", rays=GaussianRays(ring=0))
    by_ring = visible_from(tracer, known.viewpoints, sampling="gaussians", rays=GaussianRays(ring=4))
    by_pixels = visible_from(tracer, known.viewpoints, sampling="pixels", size=64)
    # Discs of one sheet overlap, and a disc that content puts behind its neighbors can be lost on the one ray to its
    # center; visible is what some ray sees.
    assert (by_ring[known.visible] >= TAU).all()
    assert (by_gaussians[known.visible] >= TAU).mean() > 0.9999
    for weights in (by_gaussians, by_ring, by_pixels):
        assert (weights[known.hidden] < TAU).all()
    assert known.visible.any()
    assert known.hidden.any()


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "lod"), [("showroom", 3), ("nika_sh3", 0), ("flowers_sh2", 1)])
def test_real_scenes_equal_the_oracle(
    realdata: Path, real_space: Callable[[Gaussians], NavigableSpace], name: str, lod: int
) -> None:
    g = load_scene(realdata / "scenes" / name / "lod-meta.json", lod=lod)
    rng = np.random.default_rng(0)
    rays_o = real_space(g).sample_viewpoints(6, rng)
    rays_d = rng.normal(size=(6, 3))
    rays_d[::2] = g.means[rng.integers(len(g), size=3)] - rays_o[::2]  # an object is seen from around it
    got = Tracer(EllipsoidProxies.from_scene(g)).contributions(rays_o, rays_d)
    want = brute_force_contributions(g, rays_o, rays_d)
    np.testing.assert_array_equal(got.ray_offsets, want.ray_offsets)
    np.testing.assert_array_equal(got.gaussian_ids, want.gaussian_ids)
    np.testing.assert_allclose(got.weights, want.weights, atol=1e-5)
    assert len(want.gaussian_ids) > 50
