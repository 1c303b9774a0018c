"""Preparing colors of a scene and comparing them: what is found, kept, resumed and refused."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import gsvis.prepare.colors as module
from gsvis.color.fit import FitConfig, fit_srbf
from gsvis.color.srbf import SrbfColors
from gsvis.errors import SceneError
from gsvis.prepare.color_quality import PSNR_CAP, ColorQualityConfig, measure_colors
from gsvis.prepare.colors import ColorConfig, find_kept, prepare_colors
from gsvis.prepare.fitted_colors import FittedColors, round_colors
from gsvis.prepare.importance import direction_weights, importance_from_views
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.raycast.directions import face_of, trace_directions
from gsvis.render import view_weights
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import OccluderScene, two_rooms
from gsvis.scene.view_sampling import ViewSampling

QUICK = ColorConfig(FitConfig(max_terms=3, mean_terms=1.0), ViewSampling(3, 48, 36))


@cache
def rooms(sh_degree: int = 1) -> OccluderScene:
    return two_rooms(1000, sh_degree=sh_degree)


def same(a: SrbfColors, b: SrbfColors) -> bool:
    names = ("base", "offsets", "functions", "centers", "decays", "intensities")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def test_directions_are_those_of_tracing_and_of_the_views() -> None:
    scene, g = rooms(), rooms().gaussians
    found = prepare_colors(g, scene.navigable, QUICK)
    traced = trace_directions(Tracer(EllipsoidProxies.from_scene(g)), scene.navigable)
    seen = importance_from_views(g, QUICK.views.cameras(g, scene.navigable))
    assert np.array_equal(found.sets, traced | seen.sets)
    assert np.array_equal(found.importance, seen.importance)
    given = prepare_colors(g, scene.navigable, QUICK, sets=traced)
    assert np.array_equal(given.sets, found.sets)
    assert same(given.fit.colors, found.fit.colors)


def test_importance_is_the_squared_weight_by_the_face_toward_the_eye() -> None:
    scene, g = rooms(), rooms().gaussians
    cameras = QUICK.views.cameras(g, scene.navigable)
    expected = np.zeros((len(g), 80))
    for c in range(len(cameras)):
        seen = view_weights(g, cameras[c])
        faces = face_of(cameras[c].viewpoints - g.means)
        expected[np.arange(len(g)), faces] += seen.largest[0].astype(np.float64) * seen.summed[0]
    expected /= len(cameras) * cameras.width * cameras.height
    found = importance_from_views(g, cameras).faces
    assert np.count_nonzero(expected) > 1000
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-12)


def test_faces_of_the_paper_are_gathered_from_views_and_all_count_alike() -> None:
    scene, g = rooms(), rooms().gaussians
    config = ColorConfig(FitConfig("hsl", max_terms=3, mean_terms=1.0, refine=False), QUICK.views, 0, "faces")
    found = prepare_colors(g, scene.navigable, config)
    seen = importance_from_views(g, QUICK.views.cameras(g, scene.navigable))
    assert np.array_equal(found.sets, seen.sets)
    assert same(found.fit.colors, fit_srbf(g, seen.sets, config.fit, importance=seen.importance).colors)
    assert found.fit.colors.variant == "hsl"


def test_directions_weigh_by_their_set_and_by_what_views_see_of_them() -> None:
    sets = np.zeros((3, 80), np.uint8)
    sets[0, :40] = sets[1, :40] = 1
    shares = np.zeros((3, 80), np.uint8)
    shares[1, 0], shares[1, 1] = 85, 170
    weights = direction_weights(np.packbits(sets, axis=1, bitorder="little"), shares)
    assert weights.dtype == np.float32
    assert (weights[0, :40] == 1.0).all()  # no view sees it
    assert (weights[2] == 0.0).all()  # no direction
    assert ((weights[:2, 40:] > 0.0) & (weights[:2, 40:] < 0.01)).all()
    assert weights[1, :40].sum() == pytest.approx(40.0, rel=1e-5)  # the views move weight and add none
    assert weights[1, 2] < weights[1, 0] < weights[1, 1]
    even = direction_weights(np.packbits(sets, axis=1, bitorder="little"), None)
    np.testing.assert_array_equal(even[1], weights[0])


def test_shares_are_those_of_the_importance(monkeypatch: pytest.MonkeyPatch) -> None:
    g, scene = rooms().gaussians, rooms()
    seen = importance_from_views(g, QUICK.views.cameras(g, scene.navigable))
    share = seen.faces / np.maximum(seen.faces.sum(axis=1, keepdims=True), 1e-30)
    np.testing.assert_allclose(seen.shares / 255.0, share, atol=0.5 / 255.0 + 1e-6)
    whole = seen.shares, seen.sets
    monkeypatch.setattr("gsvis.prepare.importance._PART", 300)
    assert np.array_equal(seen.shares, whole[0])
    assert np.array_equal(seen.sets, whole[1])


def test_a_preparation_that_was_stopped_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, g = rooms(), rooms().gaussians
    out = tmp_path / "rooms.arrow"
    monkeypatch.setattr(module, "_BLOCK", 300)
    stages: list[tuple[str, int]] = []

    def stopping(stage: str, done: int, total: int) -> None:
        if stage == "directions" and done >= 600:
            raise KeyboardInterrupt

    def noting(stage: str, done: int, total: int) -> None:
        stages.append((stage, done))

    with pytest.raises(KeyboardInterrupt):
        prepare_colors(g, scene.navigable, QUICK, keep=out, progress=stopping)
    kept = find_kept(g, scene.navigable, QUICK, out)
    assert kept is not None
    assert [path.name for path in tmp_path.iterdir()] == [kept.folder.name]
    found = prepare_colors(g, scene.navigable, QUICK, keep=out, progress=noting)
    assert stages[0] == ("directions", 300)
    assert same(found.fit.colors, prepare_colors(g, scene.navigable, QUICK).fit.colors)
    stages.clear()
    again = prepare_colors(g, scene.navigable, QUICK, keep=out, progress=noting)
    assert {stage for stage, _ in stages} == {"directions", "price", "fit"}
    assert stages[0] == ("directions", len(g))
    assert same(found.fit.colors, again.fit.colors)
    other = ColorConfig(QUICK.fit, ViewSampling(3, 48, 36, seed=1))
    another = find_kept(g, scene.navigable, other, out)
    assert another is not None
    assert another.folder != kept.folder
    (entry,) = kept.folder.iterdir()
    entry.write_bytes(entry.read_bytes()[:-30])  # damaged: it counts as missing
    assert same(prepare_colors(g, scene.navigable, QUICK, keep=out).fit.colors, found.fit.colors)


def test_views_of_different_streams_differ_and_lie_outside_of_what_is_solid() -> None:
    scene, g = rooms(), rooms().gaussians
    first, second = (ViewSampling(5, 16, 12, stream=k).cameras(g, scene.navigable).viewpoints for k in (0, 1))
    assert not np.isin(first, second).any()
    assert scene.navigable.contains(first).all()
    block = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[9, 9, 9]], [0.99], np.zeros((1, 1, 3)))
    with pytest.raises(SceneError, match="lie outside of solid parts"):
        ViewSampling(2).cameras(block, NavigableSpace.from_box((-1, -1, -1), (1, 1, 1), 4))


def test_scenes_without_view_dependence_need_no_space() -> None:
    g = rooms(0).gaussians
    found = prepare_colors(g, None, QUICK)
    assert found.fit.colors.num_terms == 0
    assert found.views is None
    assert find_kept(g, None, QUICK, "x.arrow") is None
    with pytest.raises(ValueError, match="navigable"):
        prepare_colors(rooms().gaussians, None, QUICK)


def test_what_is_wrong_is_refused_by_name() -> None:
    scene, g = rooms(), rooms().gaussians
    for sets in (np.zeros((len(g), 9), np.uint8), np.zeros((5, 10), np.uint8), np.zeros((len(g), 10))):
        with pytest.raises(ValueError, match="sets: expected uint8"):
            prepare_colors(g, scene.navigable, QUICK, sets=sets)
    with pytest.raises(ValueError, match="rays_per_face"):
        ColorConfig(rays_per_face=2)
    with pytest.raises(ValueError, match="rays_per_face"):
        ColorConfig(views=ViewSampling(0), rays_per_face=0)
    with pytest.raises(ValueError, match="directions: expected one of"):
        ColorConfig(directions="all")
    with pytest.raises(ValueError, match="fov"):
        ViewSampling(fov=0.5)
    with pytest.raises(ValueError, match="epsilons"):
        ColorQualityConfig(epsilons=(0.0,))
    cameras = ViewSampling(1, 16, 12).cameras(g, scene.navigable)
    with pytest.raises(ValueError, match="colors"):
        measure_colors(g, SrbfColors.without_terms(np.zeros((3, 3))), cameras)


def test_comparison_of_colors_that_do_not_depend_on_direction_finds_no_difference() -> None:
    scene, g = rooms(0), rooms(0).gaussians
    colors = prepare_colors(g, None, QUICK).fit.colors
    cameras = ViewSampling(2, 32, 24, stream=1).cameras(g, scene.navigable)
    found = measure_colors(g, colors, cameras, ColorQualityConfig(flip=False))
    assert (found.all_terms.psnr >= 90.0).all()
    assert (found.all_terms.psnr <= PSNR_CAP).all()
    assert found.all_terms.ssim == pytest.approx(1.0, abs=1e-6)
    assert found.counts.tolist() == [0]
    assert (found.active_shares == 0.0).all()
    assert (found.active_psnr == PSNR_CAP).all()


def test_more_terms_and_smaller_epsilons_keep_more() -> None:
    scene, g = rooms(), rooms().gaussians
    found = prepare_colors(g, scene.navigable, QUICK)
    cameras = ViewSampling(3, 48, 36, stream=1).cameras(g, scene.navigable)
    quality = measure_colors(g, found.fit.colors, cameras, ColorQualityConfig(flip=False))
    assert quality.counts.tolist() == [0, 1, 2, 3]
    assert (np.diff(quality.mean_terms) > 0).all()
    assert quality.mean_terms[-1] == pytest.approx(found.fit.colors.num_terms / len(g))
    assert np.array_equal(quality.psnr_by_count[-1], quality.all_terms.psnr)
    assert np.array_equal(quality.psnr_by_count[0], quality.base_only.psnr)
    assert quality.all_terms.psnr.mean() > quality.base_only.psnr.mean() + 3.0
    assert (np.diff(quality.active_shares, axis=0) <= 0).all()
    along = quality.active_psnr.mean(axis=1)
    assert (np.diff(along) < 1e-3).all()  # a term that hardly counts may help or harm
    assert along[-1] < along[0] - 30.0


def test_the_figures_of_fitted_colors_add_up() -> None:
    scene, g = rooms(), rooms().gaussians
    found = prepare_colors(g, scene.navigable, QUICK)
    for precision in ("exact", "wire"):
        colors = round_colors(found.fit.colors, precision)
        fitted = FittedColors(g, colors, found, precision, 1)
        assert fitted.by_count.sum() == pytest.approx(1.0)
        assert (fitted.by_count * np.arange(len(fitted.by_count))).sum() == pytest.approx(fitted.mean_terms)
        sizes = fitted.sizes()
        counting = 2 / 8  # bits that count the terms of a Gaussian, at most 3
        expected = sizes["base"] + counting + fitted.mean_terms * sizes["term"]
        assert sizes["records"] == pytest.approx(expected, abs=1e-3)
    assert fitted.as_dict()["quality"] is None
