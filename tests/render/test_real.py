"""The rasterizer on a real scene: against the reference, and against exact rays."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gsvis.io import load_scene
from gsvis.raycast import TAU, EllipsoidProxies, Tracer, visible_in
from gsvis.render import rasterize, view_weights
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

pytestmark = pytest.mark.realdata


def test_a_real_scene_equals_the_reference(realdata: Path, real_space: Callable[[Gaussians], NavigableSpace]) -> None:
    g = load_scene(realdata / "scenes/flowers_sh2/lod-meta.json", lod=3)
    space = real_space(g)
    cameras = space.sample_cameras(2, np.random.default_rng(0), width=33, height=25, fov=60)
    for c in range(len(cameras)):
        fast = rasterize(g, cameras[c])
        slow = rasterize(g, cameras[c], backend="reference")
        np.testing.assert_allclose(fast.images, slow.images, atol=1e-3, rtol=0)
        np.testing.assert_allclose(fast.alphas, slow.alphas, atol=1e-3, rtol=0)


def test_rasterized_and_ray_traced_sets_nearly_agree(
    realdata: Path, real_space: Callable[[Gaussians], NavigableSpace]
) -> None:
    g = load_scene(realdata / "scenes/flowers_sh2/lod-meta.json", lod=1)
    space = real_space(g)
    # Small pixels: eyes stand around this object and in it, and the two differ by what is smaller than a pixel.
    cameras = space.sample_cameras(1, np.random.default_rng(0), width=720, height=540, fov=60)
    by_rays = visible_in(Tracer(EllipsoidProxies.from_scene(g)), cameras)
    by_raster = view_weights(g, cameras).largest
    for a, b in ((by_rays, by_raster), (by_raster, by_rays)):
        assert a[b >= TAU].sum() > 0.9 * a.sum()
