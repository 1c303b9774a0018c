"""Opacities of merged Gaussians: right where nothing else stands, faint where others cover the place."""

from __future__ import annotations

import numpy as np

from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train.fill_in import fit_opacities
from gsvis.train.images import PosedImages, render_views


def balls(xs: list[float], opacities: list[float], shades: list[float]) -> Gaussians:
    n = len(xs)
    means = np.stack([np.array(xs), np.zeros(n), np.zeros(n)], axis=1)
    return Gaussians(means, [[1, 0, 0, 0]] * n, [[0.2] * 3] * n, opacities, np.repeat(shades, 3).reshape(n, 1, 3))


def error(g: Gaussians, views: PosedImages) -> float:
    return float(np.square(rasterize(g, views.cameras).images - views.images).mean())


def test_opacities_move_toward_the_images() -> None:
    cameras = Cameras.orbit((0, 0, 0), 4.0, 6, width=48, height=32)
    scene = balls([-1.0, 1.0, 0.0], [0.8, 0.9, 0.5], [1.0, 1.0, -0.5])
    views = render_views(scene, cameras)
    stays = scene[[1]]
    merged = balls([-1.0, 1.0, 0.0], [0.4, 0.6, 0.5], [1.0, -1.0, -0.5])
    merged = Gaussians.concatenate([merged, Gaussians([[0, 0, 50]], [[1, 0, 0, 0]], [[0.2] * 3], [0.7], [[[0, 0, 0]]])])
    fitted = fit_opacities(merged, stays, views)
    assert fitted.opacities[0] > 0.55  # its part of the scene is twice as opaque
    assert fitted.opacities[1] < 0.3  # where one that stays shows another color
    np.testing.assert_allclose(fitted.opacities[2], 0.5, atol=0.05)
    assert fitted.opacities[3] == merged.opacities[3]  # no view shows it
    before, after = (error(Gaussians.concatenate([stays, each]), views) for each in (merged, fitted))
    assert after < 0.5 * before
    for name in ("means", "quats", "scales", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(fitted, name), getattr(merged, name))
    np.testing.assert_array_equal(fit_opacities(merged, stays, views).opacities, fitted.opacities)


def test_one_view_is_enough() -> None:
    views = render_views(balls([0.0], [0.8], [1.0]), Cameras.orbit((0, 0, 0), 4.0, 1, width=24, height=16))
    fitted = fit_opacities(balls([0.0], [0.4], [1.0]), Gaussians.empty(), views)
    assert 0.6 < fitted.opacities[0] <= 0.81
