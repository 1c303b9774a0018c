from __future__ import annotations

import numpy as np
import pytest

from gsvis.color.activation import active
from gsvis.color.epsilon import MetricObserver, calibrate_epsilon
from gsvis.color.evaluate import evaluate
from gsvis.color.srbf import SrbfColors
from gsvis.prepare import Approximations, flip_difference
from gsvis.render.rasterizer import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import two_rooms
from tests.color.samples import random_colors

VIEWS = 2


@pytest.fixture(scope="module")
def scene() -> tuple[Gaussians, SrbfColors, Cameras]:
    made = two_rooms(1500, sh_degree=0)
    rng = np.random.default_rng(2)
    colors = random_colors(rng, len(made.gaussians))
    return made.gaussians, colors, made.navigable.sample_cameras(VIEWS, rng, width=24, height=16)


@pytest.fixture(scope="module")
def pictures(scene: tuple[Gaussians, SrbfColors, Cameras]) -> Approximations:
    return Approximations(*scene)


def test_images_are_those_of_the_active_terms(
    scene: tuple[Gaussians, SrbfColors, Cameras], pictures: Approximations
) -> None:
    g, colors, cameras = scene
    for epsilon in (0.0, 0.05, 10.0):
        images = pictures.images(epsilon)
        for view in range(VIEWS):
            eye = cameras.viewpoints[view]
            mask = active(colors, g.means, eye, epsilon)
            shown = evaluate(colors, g.means, eye, active=mask)
            assert np.array_equal(images[view], rasterize(g, cameras[view], colors=shown).images[0])
            assert pictures.shares(epsilon)[view] == mask.mean()


def test_nothing_left_out_is_the_reference_and_everything_the_base(
    scene: tuple[Gaussians, SrbfColors, Cameras], pictures: Approximations
) -> None:
    g, colors, cameras = scene
    assert np.allclose(pictures.images(0.0), pictures.reference, atol=1e-5)
    assert np.array_equal(pictures.images(100.0), Approximations(g, colors.first(0), cameras).reference)
    assert pictures.shares(100.0).tolist() == [0.0] * VIEWS


def test_flip_finds_the_view_that_shows_it_most(pictures: Approximations) -> None:
    metrics = pytest.importorskip("gsvis.render.metrics")
    pytest.importorskip("flip_evaluator")
    difference = flip_difference(pictures, percentile=90.0, pixels_per_degree=20.0)
    maps = metrics.flip_map(pictures.images(0.1), pictures.reference, 20.0)
    assert difference(0.1) == max(np.percentile(each, 90.0) for each in maps)
    assert difference(0.0) < 1e-3
    found = calibrate_epsilon(MetricObserver(difference, 0.5 * difference(0.1)))
    assert found.converged
    assert 0.005 < found.epsilon < 0.12
    with pytest.raises(ValueError, match="percentile: expected a value in"):
        flip_difference(pictures, percentile=101.0)


def test_what_does_not_fit_is_refused(scene: tuple[Gaussians, SrbfColors, Cameras]) -> None:
    g, colors, cameras = scene
    with pytest.raises(ValueError, match="colors: expected those of 3 Gaussians, got"):
        Approximations(g[:3], colors, cameras)
    with pytest.raises(ValueError, match="cameras: expected at least one"):
        Approximations(g, colors, cameras[:0])


def test_colors_without_terms_have_no_share() -> None:
    made = two_rooms(1000, sh_degree=0)
    cameras = made.navigable.sample_cameras(1, np.random.default_rng(0), width=8, height=8)
    plain = Approximations(made.gaussians, SrbfColors.without_terms(made.gaussians.sh0[:, 0] * 0.28 + 0.5), cameras)
    assert plain.shares(0.01).tolist() == [0.0]
    assert np.array_equal(plain.images(0.01), plain.reference)
