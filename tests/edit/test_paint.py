"""Painted scenes: known quantities of known scenes, colors that keep their order, legends that count everything."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsvis.color.oklab import palette, ramp, srgb_to_oklab
from gsvis.edit import (
    QUANTITIES,
    Quantity,
    QuantityConfig,
    bands_of,
    colors_of,
    draw_legend,
    measure_quantity,
    paint,
    stored_quantity,
)
from gsvis.edit.paint import UNSEEN
from gsvis.errors import SceneError
from gsvis.io import load_scene, save_scene
from gsvis.pvs import CellGrid, CellSet, StoreInfo, VisibilityStore, write_store
from gsvis.raycast.directions import seen_directions
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import OccluderScene, nested_shells, random_scene
from gsvis.scene.sh import SH_C0
from gsvis.scene.view_sampling import ViewSampling

QUICK = QuantityConfig(eyes=4, views=ViewSampling(3, 32, 24, 90.0), size=48)


@cache
def shells() -> OccluderScene:
    return nested_shells(2500, sh_degree=1)


@cache
def measured(name: str) -> Quantity:
    return measure_quantity(shells().gaussians, name, shells().navigable, QUICK)


def quantity(values: list[float], *, cells: int = 0) -> Quantity:
    """Values of which 0 is unseen."""
    array = np.array(values, np.float32)
    return Quantity("visibility", array, array > 0.0, 0.0, 1.0, False, cells, "label")


@pytest.mark.parametrize("name", QUANTITIES)
def test_what_a_closed_shell_hides_is_unseen_and_gray(name: str) -> None:
    found = measured(name)
    inner = np.linalg.norm(shells().gaussians.means, axis=1) < 1.5
    assert np.mean(found.seen[inner]) < 0.01  # the hull accepts a few in doubt
    assert np.mean(found.seen[~inner]) > 0.1
    assert (found.values[~found.seen] == 0.0).all()
    assert (colors_of(found)[~found.seen] == UNSEEN).all()


@pytest.mark.parametrize("name", QUANTITIES)
def test_the_same_seed_gives_the_same_values(name: str) -> None:
    again = measure_quantity(shells().gaussians, name, shells().navigable, QUICK)
    assert np.array_equal(again.values, measured(name).values)


def test_shares_are_of_the_eyes() -> None:
    values = measured("visibility").values
    assert {0, 1, 2} <= set(np.round(4 * values).astype(int)) <= {0, 1, 2, 3, 4}
    np.testing.assert_allclose(4 * values, np.round(4 * values), atol=1e-6)


def test_an_eye_sees_each_gaussian_from_one_direction() -> None:
    faces = measured("directions").values
    assert np.array_equal(faces, np.round(faces))
    assert faces.max() <= 4.0
    one = measure_quantity(shells().gaussians, "directions", shells().navigable, QuantityConfig(eyes=1, size=48))
    assert set(one.values) == {0.0, 1.0}
    assert seen_directions(shells().gaussians[:1], [[1.0]], [[9.0, 0.0, 0.0]]).any()


def test_weights_are_weights_of_visible_gaussians() -> None:
    found = measured("weight")
    assert found.values[found.seen].min() >= np.float32(1.0 / 255.0)
    assert found.values.max() <= 1.0
    assert found.logarithmic


def test_cells_are_numbers_of_cells() -> None:
    found = measured("cell")
    assert 2 <= found.cells <= 4
    assert np.array_equal(found.values, np.round(found.values))
    assert set(found.values[found.seen].astype(int)) <= set(range(found.cells))


def test_a_scene_without_anything_to_see_is_refused() -> None:
    away = NavigableSpace.from_box((90.0, 0.0, 0.0), (91.0, 1.0, 1.0), 2)
    tiny = random_scene(np.random.default_rng(0), 3)
    faint = type(tiny)(tiny.means, tiny.quats, tiny.scales, np.full(3, 0.01), tiny.sh0)
    with pytest.raises(SceneError, match="nothing to paint"):
        measure_quantity(faint, "visibility", away, replace(QUICK, tau=0.5))
    with pytest.raises(ValueError, match="name: expected one of"):
        measure_quantity(tiny, "beauty", away, QUICK)


def test_painting_keeps_shapes_and_replaces_colors(tmp_path: Path) -> None:
    g, found = shells().gaussians, measured("visibility")
    painted = paint(g, found)
    assert painted.sh_degree == 0
    for name in ("means", "quats", "scales", "opacities"):
        assert np.array_equal(getattr(painted, name), getattr(g, name))
    save_scene(painted, tmp_path / "p.ply")
    shown = 0.5 + SH_C0 * load_scene(tmp_path / "p.ply").sh0[:, 0]
    np.testing.assert_allclose(shown, colors_of(found), atol=1e-6)


def test_values_of_another_scene_are_refused() -> None:
    with pytest.raises(ValueError, match="was it measured on this scene"):
        paint(shells().gaussians[:5], measured("visibility"))


def test_larger_values_are_lighter_and_equal_ones_alike() -> None:
    colors = colors_of(quantity([0.1, 0.2, 0.2, 0.9, 1.0]))
    lightness = srgb_to_oklab(colors)[:, 0]
    assert (np.diff(lightness[[0, 1, 3, 4]]) > 0.0).all()
    assert np.array_equal(colors[1], colors[2])


def test_equal_ratios_are_equal_steps_of_a_logarithmic_ramp() -> None:
    found = Quantity("weight", np.ones(1, np.float32), np.ones(1, bool), 0.01, 1.0, True, 0, "")
    np.testing.assert_allclose(found.parts(np.array([0.0, 0.01, 0.1, 1.0, 2.0])), [0.0, 0.0, 0.5, 1.0, 1.0])
    assert found.value_at(0.5) == pytest.approx(0.1)


def test_the_legend_counts_every_gaussian_once() -> None:
    for name in QUANTITIES:
        bands = bands_of(measured(name))
        assert sum(each.count for each in bands) == len(shells().gaussians)
        assert bands[-1].text == measured(name).unseen
        assert bands[-1].count == np.count_nonzero(~measured(name).seen)


def test_many_cells_share_a_line_of_the_legend() -> None:
    bands = bands_of(quantity(list(range(1, 21)), cells=21))
    assert len(bands) == 8 + 2
    assert (bands[8].text, bands[8].count) == ("12 other cells, each in its own color", 12)


def test_the_picture_of_the_legend_shows_the_ramp_and_the_cells() -> None:
    picture = np.asarray(Image.open(io.BytesIO(draw_legend(measured("weight")))))
    for part in (0.0, 1.0):
        color = np.rint(255 * ramp([part])[0])
        assert (np.abs(picture.astype(float) - color).max(axis=2) <= 1).any()
    cells = np.asarray(Image.open(io.BytesIO(draw_legend(measured("cell")))))
    color = np.rint(255 * palette(measured("cell").cells)[0])
    assert (np.abs(cells.astype(float) - color).max(axis=2) <= 1).any()


def test_quantities_of_visible_sets_are_what_the_sets_say(tmp_path: Path) -> None:
    space = NavigableSpace.from_box((0, 0, 0), (2, 1, 1), 2)
    grid = CellGrid.over(space, max_cells=2)
    edges = np.array([1 / 255, 1 / 16, 1 / 4])
    info = StoreInfo(4, "0" * 64, 1 / 255, edges, {})
    sets = np.zeros((4, 10), np.uint8)
    sets[1] = [255, 1, *[0] * 8]
    cells = [
        CellSet(np.array([0, 1]), np.array([0, 2], np.uint8)),
        CellSet(np.array([1, 2]), np.array([1, 1], np.uint8)),
    ]
    write_store(tmp_path / "s.pvs", grid, info, cells, sets)
    with VisibilityStore.open(tmp_path / "s.pvs") as store:
        found = {name: stored_quantity(store, name) for name in QUANTITIES if name != "importance"}
        with pytest.raises(ValueError, match="importance"):
            stored_quantity(store, "importance")
    assert found["visibility"].values.tolist() == [0.5, 1.0, 0.5, 0.0]
    assert found["directions"].values.tolist() == [0.0, 9.0, 0.0, 0.0]
    np.testing.assert_allclose(found["weight"].values, [1 / 255, 1 / 4, 1 / 16, 0.0], rtol=1e-6)
    assert found["cell"].values.tolist() == [0.0, 0.0, 1.0, 0.0]
    for each in found.values():
        assert each.seen.tolist() == [True, True, True, False]
