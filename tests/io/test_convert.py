"""`convert_scene`: what is kept, what is turned, what is refused."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from gsvis.errors import SceneError
from gsvis.io.convert import AXES, convert_scene, rotation_between_axes
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import sh_basis
from tests.io.scene_files import random_scene


def axis(name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.eye(3)["xyz".index(name[1])] * (1 if name[0] == "+" else -1)


def test_without_arguments_nothing_changes() -> None:
    scene = random_scene()
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(convert_scene(scene), name), getattr(scene, name))


def test_crop_keeps_the_box_with_its_borders_in_order() -> None:
    scene = random_scene(200)
    box = np.array([scene.means[3].astype(float) - 1, scene.means[3]])
    inside = ((scene.means >= box[0]) & (scene.means <= box[1])).all(axis=1)
    kept = convert_scene(scene, crop=box)
    assert inside[3]
    np.testing.assert_array_equal(kept.means, scene.means[inside])
    open_box = [[-np.inf, 0, -np.inf], [np.inf, np.inf, np.inf]]
    assert len(convert_scene(scene, crop=open_box)) == (scene.means[:, 1] >= 0).sum()


def test_min_opacity_includes_its_bound() -> None:
    scene = random_scene(50)
    kept = convert_scene(scene, min_opacity=float(scene.opacities[7]))
    assert kept.opacities.min() == scene.opacities[7]
    assert len(kept) == (scene.opacities >= scene.opacities[7]).sum()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("limit", [0, 1, 2, 3])
def test_harmonics_are_cut_never_added(degree: int, limit: int) -> None:
    scene = random_scene(sh_degree=degree)
    got = convert_scene(scene, max_sh_degree=limit)
    assert got.sh_degree == min(degree, limit)
    np.testing.assert_array_equal(got.shN, scene.shN[:, : got.shN.shape[1]])


@pytest.mark.parametrize(("old", "new"), list(itertools.product(AXES, AXES)))
def test_the_rotation_takes_one_axis_to_the_other(old: str, new: str) -> None:
    r = rotation_between_axes(old, new)
    np.testing.assert_array_equal(r @ axis(old), axis(new))
    np.testing.assert_array_equal(r @ r.T, np.eye(3))
    assert np.linalg.det(r) == pytest.approx(1.0)


def test_up_turns_centers_shapes_and_colors() -> None:
    scene = random_scene(sh_degree=3)
    got = convert_scene(scene, up=("-y", "+z"))
    r = rotation_between_axes("-y", "+z")
    np.testing.assert_allclose(got.means, scene.means @ r.T, atol=1e-6)
    np.testing.assert_allclose(got.covars(), r @ scene.covars() @ r.T, atol=1e-6)
    seen = np.random.default_rng(0).standard_normal((5, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    basis = [sh_basis(d, 3)[:, 1:] for d in (seen, seen @ r.T)]
    before, after = (np.einsum("dk,nkc->ndc", b, s.shN) for b, s in zip(basis, (scene, got), strict=True))
    np.testing.assert_allclose(after, before, atol=1e-5)
    back = convert_scene(got, up=("+z", "-y"))
    np.testing.assert_allclose(back.means, scene.means, atol=1e-6)


def test_crop_is_in_the_frame_before_the_turn() -> None:
    scene = random_scene(100)
    box = [[0, -np.inf, -np.inf], [np.inf] * 3]
    turned = convert_scene(scene, crop=box, up=("+x", "+z"))
    assert (turned.means[:, 2] >= 0).all()
    assert len(turned) == (scene.means[:, 0] >= 0).sum()


def test_nothing_left_says_where_the_scene_lies() -> None:
    with pytest.raises(SceneError, match="none of 70 Gaussians"):
        convert_scene(random_scene(), crop=[[50] * 3, [60] * 3])
    with pytest.raises(SceneError, match="opacities reach"):
        convert_scene(random_scene(), min_opacity=1.0)
    with pytest.raises(SceneError, match="empty before"):
        convert_scene(Gaussians.empty())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("crop", [[0, 0, 0]]),
        ("crop", [[1, 0, 0], [0, 1, 1]]),
        ("crop", [[np.nan, 0, 0], [1, 1, 1]]),
        ("crop", "box"),
        ("min_opacity", -0.1),
        ("min_opacity", 1.1),
        ("min_opacity", np.nan),
        ("max_sh_degree", 4),
        ("max_sh_degree", -1),
        ("max_sh_degree", True),
        ("up", "+z"),
        ("up", ("z", "+y")),
        ("up", ("+z",)),
        ("up", ("+z", 5)),
    ],
)
def test_bad_arguments_are_named(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        convert_scene(random_scene(), **{name: value})
