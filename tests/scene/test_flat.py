"""The furnished flat looks like a trained capture, is closed, and knows where eyes can be. A small one, made once."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.flat.pieces import Canvas, cut
from gsvis.scene.flat.plan import ROOMS
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import BuiltinScene, furnished_flat
from gsvis.scene.sh import sh_basis
from gsvis.scene.stated import stated_space

COUNT = 8000


@pytest.fixture(scope="module")
def flat() -> BuiltinScene:
    return furnished_flat(COUNT)


def test_it_has_about_as_many_gaussians_as_asked_for(flat: BuiltinScene) -> None:
    assert len(flat.gaussians) == pytest.approx(COUNT, rel=0.1)
    assert flat.gaussians.sh_degree == 3


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match="count: expected"):
        furnished_flat(10)
    with pytest.raises(ValueError, match="sh_degree: expected"):
        furnished_flat(2000, sh_degree=4)


def test_eyes_can_be_in_every_room_and_nowhere_else(flat: BuiltinScene) -> None:
    space = flat.navigable
    at = np.floor((flat.viewpoints - space.origin) / space.voxel_size).astype(int)
    assert space.free[tuple(at.T)].all()
    centers = eyes_in_every_room(space)
    assert centers.min() > 0.24
    assert (centers.max(axis=0) < (9.76, 8.36, 2.1)).all()


def test_its_box_has_eyes_in_every_room(flat: BuiltinScene) -> None:
    """A grid that shows too much of what the windows show closes the doors."""
    space = stated_space(flat.gaussians)
    assert space is not None
    eyes_in_every_room(space)
    assert space.voxel_size < 0.1


def eyes_in_every_room(space: NavigableSpace) -> NDArray[np.float64]:
    """Return (P, 3) the middles of free voxels, after a check that many are in each room."""
    centers = space.origin + space.voxel_size * (np.argwhere(space.free) + 0.5)
    for room in ROOMS:
        inside = (centers[:, 0] > room.x[0]) & (centers[:, 0] < room.x[1])
        inside &= (centers[:, 1] > room.y[0]) & (centers[:, 1] < room.y[1])
        assert inside.sum() > 100, room.name
    return np.asarray(centers)


def test_what_is_known_of_it_goes_with_its_gaussians(flat: BuiltinScene) -> None:
    facts = flat.gaussians.facts
    assert (facts.up, facts.meters_per_unit) == ((0.0, 0.0, 1.0), 1.0)
    assert facts.box is not None
    low, high = np.array(facts.box)
    assert (low < flat.viewpoints).all()
    assert (flat.viewpoints < high).all()


def test_no_view_looks_out_through_a_wall(flat: BuiltinScene) -> None:
    seen = rasterize(flat.gaussians, Cameras.cubemap(flat.viewpoints, 32))
    assert seen.alphas.mean() > 0.97
    assert np.quantile(seen.alphas, 0.02) > 0.7


def test_gaussians_are_of_many_sizes_and_longer_than_wide(flat: BuiltinScene) -> None:
    scales = np.sort(flat.gaussians.scales, axis=1)
    low, high = np.quantile(scales[:, 2], [0.05, 0.95])
    assert high > 6.0 * low
    assert np.median(scales[:, 2] / scales[:, 1]) > 1.15
    assert np.median(scales[:, 1] / scales[:, 0]) > 4.0  # they are flat


def test_colors_are_plausible_and_polished_things_change_with_the_view(flat: BuiltinScene) -> None:
    g = flat.gaussians
    directions = np.random.default_rng(3).normal(size=(16, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = sh_basis(directions, 3)
    colors = 0.5 + np.einsum("dk,nkc->dnc", basis, np.concatenate([g.sh0, g.shN], axis=1))
    assert np.quantile(colors, 0.01) > -0.3
    assert np.quantile(colors, 0.99) < 1.4
    change = colors.std(axis=0).mean(axis=1)
    assert np.median(change) < 0.03
    assert np.quantile(change, 0.99) > 0.06


def test_pieces_end_where_colors_do_and_cover_everything_once() -> None:
    colors = np.zeros((40, 60, 3))
    colors[:, 37:] = 1.0
    solid = np.ones((40, 60), bool)
    solid[10:20, 5:25] = False
    canvas = Canvas(colors, solid, (0.6, 0.4), 1.0, 0.0, 1.0)
    found, again = (cut([canvas], 300, np.random.default_rng(0)) for _ in range(2))
    assert np.array_equal(found.low, again.low)
    area = (found.high - found.low).prod(axis=1) * found.cover
    assert area.sum() == pytest.approx(solid.mean(), abs=0.01)
    mixed = (found.spread > 0.05) @ area
    assert mixed < 0.03
