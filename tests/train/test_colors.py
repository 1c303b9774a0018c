"""Learned colors: they approach the images, touch nothing else, and are the same each time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gsvis.color import FitConfig, SrbfColors, fit_srbf
from gsvis.color.srbf import unit_vectors
from gsvis.files.shelf import Shelf
from gsvis.render import rasterize
from gsvis.render.device_torch import DeviceView
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train.colors import LearnConfig, learn_colors, learn_sh
from gsvis.train.colors_reference import learn_colors_reference
from gsvis.train.images import PosedImages, render_views

FEW = LearnConfig(steps=40)


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    rng = np.random.default_rng(3)
    n = 40
    return Gaussians(
        rng.normal(size=(n, 3)) * 0.5,
        rng.normal(size=(n, 4)),
        np.full((n, 3), 0.15),
        np.full(n, 0.9),
        rng.normal(size=(n, 1, 3)),
        0.3 * rng.normal(size=(n, 3, 3)),
    )


@pytest.fixture(scope="module")
def colors(scene: Gaussians) -> SrbfColors:
    return fit_srbf(scene, None, FitConfig(mean_terms=1.0, max_terms=2)).colors


@pytest.fixture(scope="module")
def views(scene: Gaussians) -> PosedImages:
    """Images of the scene in other colors, from all around."""
    other = replace_sh(scene, scene.sh0 + 0.4, -scene.shN)
    return render_views(other, Cameras.orbit((0, 0, 0), 3.0, 8, width=32, height=24))


def replace_sh(g: Gaussians, sh0: np.ndarray, shN: np.ndarray) -> Gaussians:
    return Gaussians(g.means, g.quats, g.scales, g.opacities, sh0, shN, facts=g.facts)


def error(g: Gaussians, colors: SrbfColors | None, views: PosedImages) -> float:
    return float(np.mean(np.square(rasterize(g, views.cameras, colors=colors).images - views.images)))


@pytest.mark.parametrize("squared", [False, True])
def test_learning_halves_the_error(scene: Gaussians, colors: SrbfColors, views: PosedImages, squared: bool) -> None:
    learned = learn_colors(scene, colors, views, replace(FEW, squared=squared, base_rate=0.02, intensity_rate=0.02))
    assert error(scene, learned, views) < 0.5 * error(scene, colors, views)
    assert np.array_equal(learned.offsets, colors.offsets)
    assert np.array_equal(learned.functions, colors.functions)


def test_sh_learns_by_the_same_steps(scene: Gaussians, views: PosedImages) -> None:
    learned = learn_sh(scene, views, replace(FEW, base_rate=0.02, sh_rate=0.02))
    assert error(learned, None, views) < 0.5 * error(scene, None, views)
    assert np.array_equal(learned.means, scene.means)
    assert np.array_equal(learned.opacities, scene.opacities)


def test_what_no_view_shows_keeps_its_colors(scene: Gaussians, colors: SrbfColors, views: PosedImages) -> None:
    hidden = np.arange(len(scene)) % 4 == 0
    learned = learn_colors(scene, colors, views, FEW, shown=~hidden)
    terms = hidden[colors.gaussian_ids]
    assert np.array_equal(learned.base[hidden], colors.base[hidden])
    assert np.array_equal(learned.intensities[terms], colors.intensities[terms])
    assert np.array_equal(learned.decays[terms], colors.decays[terms])
    assert not np.array_equal(learned.base[~hidden], colors.base[~hidden])


def test_what_lies_behind_all_cameras_keeps_its_colors(
    scene: Gaussians, colors: SrbfColors, views: PosedImages
) -> None:
    away = np.arange(len(scene)) % 3 == 0
    means = scene.means + np.where(away, 50.0, 0.0)[:, None] * np.array([0.0, 0.0, 1.0])
    apart = Gaussians(means, scene.quats, scene.scales, scene.opacities, scene.sh0, scene.shN)
    # Decays and angles of many last digits: few of them are the same after logarithms or sines.
    some = np.random.default_rng(1).uniform(0.5, 3.0, (colors.num_terms, 3)).astype(np.float32)
    colors = replace(colors, decays=9.0 * some[:, 0], centers=some[:, 1:])
    learned = learn_colors(apart, colors, views, replace(FEW, steps=4))
    terms = away[colors.gaussian_ids]
    assert np.array_equal(learned.base[away], colors.base[away])
    for name in ("centers", "decays", "intensities"):
        assert np.array_equal(getattr(learned, name)[terms], getattr(colors, name)[terms])
        assert not np.array_equal(getattr(learned, name)[~terms], getattr(colors, name)[~terms])


def test_the_same_run_gives_the_same_colors(scene: Gaussians, colors: SrbfColors, views: PosedImages) -> None:
    one, two = (learn_colors(scene, colors, views, replace(FEW, steps=5)) for _ in range(2))
    for name in ("base", "centers", "decays", "intensities"):
        assert np.array_equal(getattr(one, name), getattr(two, name))


@pytest.mark.parametrize("squared", [False, True])
def test_learning_is_that_of_its_plain_twin(
    scene: Gaussians, colors: SrbfColors, views: PosedImages, squared: bool
) -> None:
    config = replace(FEW, steps=5, squared=squared)
    fast = learn_colors(scene, colors, views, config)
    plain = learn_colors_reference(scene, colors, views, config)
    for name in ("base", "decays", "intensities"):
        assert np.allclose(getattr(fast, name), getattr(plain, name), rtol=1e-4, atol=1e-5)
    assert np.allclose(unit_vectors(fast.centers), unit_vectors(plain.centers), atol=1e-4)


def test_colors_in_files_learn_the_same_to_the_bit(
    scene: Gaussians, colors: SrbfColors, views: PosedImages, tmp_path: Path
) -> None:
    config = replace(FEW, steps=20, squared=True)
    shelf = Shelf(tmp_path / "shelf")
    kept = learn_colors(scene, colors, views.cameras, config)
    filed = learn_colors(shelf.put(scene), shelf.put(colors), views.cameras, config, folder=tmp_path)
    for name in ("base", "centers", "decays", "intensities"):
        assert np.array_equal(getattr(kept, name), getattr(filed, name))
        assert not np.array_equal(getattr(kept, name), getattr(colors, name))


def test_cameras_alone_teach_what_images_of_the_scene_do(
    scene: Gaussians, colors: SrbfColors, views: PosedImages
) -> None:
    config = replace(FEW, steps=5, squared=True)
    own = learn_colors(scene, colors, views.cameras, config)
    images = learn_colors(scene, colors, render_views(scene, views.cameras), config)
    for name in ("base", "decays", "intensities"):
        assert np.allclose(getattr(own, name), getattr(images, name), rtol=1e-3, atol=1e-4)
    with pytest.raises(ValueError, match="views: expected images"):
        learn_colors(scene, colors, views.cameras, FEW)


def test_a_view_of_nothing_teaches_nothing(scene: Gaussians, colors: SrbfColors) -> None:
    away = Cameras.look_at([[0.0, 0.0, 9.0]], [[0.0, 0.0, 20.0]], width=16, height=12)
    learned = learn_colors(scene, colors, render_views(scene, away), replace(FEW, steps=2))
    assert np.array_equal(learned.base, colors.base)
    none = np.zeros(len(scene), bool)
    assert learn_colors(scene, colors, render_views(scene, away), FEW, shown=none) is colors


def test_no_steps_change_nothing(scene: Gaussians, colors: SrbfColors, views: PosedImages) -> None:
    assert learn_colors(scene, colors, views, LearnConfig(steps=0)) is colors
    assert learn_sh(scene, views, LearnConfig(steps=0)) is scene


def test_bad_input_is_refused(scene: Gaussians, colors: SrbfColors, views: PosedImages) -> None:
    with pytest.raises(ValueError, match="views: expected at least one"):
        learn_colors(scene, colors, views[:0], FEW)
    with pytest.raises(ValueError, match="colors"):
        learn_colors(scene, colors[:5], views, FEW)
    for name, value in (("steps", -1), ("base_rate", -1.0), ("rates_end", 0.0), ("ssim_weight", 2)):
        with pytest.raises(ValueError, match=name):
            LearnConfig(**{name: value})


@pytest.mark.parametrize("squared", [False, True])
def test_a_device_learns_the_same_colors(
    scene: Gaussians, colors: SrbfColors, views: PosedImages, squared: bool
) -> None:
    config = replace(FEW, squared=squared, steps=12)
    given = views.cameras if squared else views
    here = learn_colors(scene, colors, given, config)
    there = learn_colors(scene, colors, given, config, backend="reference")
    assert not np.array_equal(here.base, colors.base)
    images = [rasterize(scene, views.cameras, colors=each).images for each in (here, there)]
    changed = np.abs(images[0] - rasterize(scene, views.cameras, colors=colors).images).max()
    assert np.abs(images[0] - images[1]).max() < 0.01 * changed


@pytest.mark.parametrize("method", ["__init__", "image", "by_colors"])
def test_colors_are_learned_on_the_cpu_where_memory_runs_out(
    method: str,
    scene: Gaussians,
    colors: SrbfColors,
    views: PosedImages,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise torch.OutOfMemoryError

    config = replace(FEW, steps=3)
    here = learn_colors(scene, colors, views, config)
    monkeypatch.setattr(DeviceView, method, fail)
    there = learn_colors(scene, colors, views, config, backend="reference")
    for name in ("base", "centers", "decays", "intensities"):
        assert np.array_equal(getattr(here, name), getattr(there, name)), name
    assert caplog.messages == ["the memory of the GPU ran out; colors are learned on the CPU from here"]
