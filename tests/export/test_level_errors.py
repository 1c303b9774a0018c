"""Errors of levels: zero at the finest, larger where a level is worse, counted where it is seen alone."""

from __future__ import annotations

import numpy as np

from gsvis.export.leaves import cut_leaves
from gsvis.export.level_errors import measure_errors, pick_eyes
from gsvis.render import rasterize
from gsvis.render.weights import share_out, view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from tests.export.test_needs import two_heaps

EYE = np.zeros((1, 3))


def heaps_with_levels() -> Levels:
    """Two heaps; the lower level has the left one as it is, and the right one in black."""
    g = two_heaps(60)
    dark = g.sh0.copy()
    dark[60:] -= 2.0
    low = Gaussians(g.means, g.quats, g.scales, g.opacities, dark, g.shN)
    own = np.repeat([0, 1], len(g)).astype(np.uint8)
    return Levels(Gaussians.concatenate([low, g]), own, own, ("low", "high"))


def test_a_leaf_has_the_error_of_its_own_level() -> None:
    leaves = cut_leaves(heaps_with_levels(), most=60)
    left, right = (int(leaves.of_ids[k]) for k in (0, 60))
    errors = measure_errors(leaves, EYE)
    assert errors.shape == (2, 2)
    assert not errors[0].any()
    assert errors[1, left] < 1e-6
    assert 0.01 < errors[1, right] <= 1.0


def test_a_leaf_has_the_error_of_the_eye_that_shows_it_worst() -> None:
    leaves = cut_leaves(heaps_with_levels(), most=60)
    right = int(leaves.of_ids[60])
    eyes = np.array([[8.0, 0, 0], [-8.0, 0, 0]])
    alone = [measure_errors(leaves, eye)[1, right] for eye in eyes]
    both = measure_errors(leaves, eyes)[1, right]
    assert both == max(alone)
    assert min(alone) < max(alone)


def test_one_level_has_no_error_and_no_eye_finds_none() -> None:
    assert not measure_errors(cut_leaves(Levels.single(two_heaps(60)), most=60), EYE).any()
    assert not measure_errors(cut_leaves(heaps_with_levels(), most=60), np.zeros((0, 3))).any()


def test_eyes_are_cells_that_see_every_leaf_well() -> None:
    lights = np.array([[1.0, 0.0, 0.0], [0.9, 5.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 1.9]])
    assert pick_eyes(lights).tolist() == [1, 2, 0]
    assert pick_eyes(lights, 1).tolist() == [1]
    assert pick_eyes(np.zeros((3, 2))).tolist() == []


def test_an_image_is_shared_out_by_weight() -> None:
    g, camera = two_heaps(40), Cameras.look_at([[-3.0, 0, 0]], [[-10.0, 0, 0]], width=40, height=30)
    shares, weights = share_out(g, camera, np.ones((30, 40, 2)))
    np.testing.assert_allclose(weights, view_weights(g, camera).summed[0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(shares, np.stack([weights, weights], axis=1), rtol=1e-6, atol=1e-9)
    half = np.zeros((30, 40, 1))
    half[:, :16] = 1.0  # a border of tiles
    shares, _ = share_out(g, camera, half)
    assert np.isclose(shares.sum(), rasterize(g, camera).alphas[0][:, :16].sum(), rtol=1e-3)
