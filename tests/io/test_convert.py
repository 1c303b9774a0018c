"""`convert_scene`: what is kept, what is turned, what is refused."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from gsvis.errors import SceneError
from gsvis.io.convert import AXES, convert_scene, merge_scenes, rotation_about_axes, rotation_between_axes
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
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
    with pytest.raises(SceneError, match="the scene is empty"):
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
        ("scale", 0.0),
        ("scale", -1.0),
        ("scale", np.nan),
        ("scale", np.inf),
        ("scale", True),
        ("rotate", (1, 2)),
        ("rotate", (1, 2, np.nan)),
        ("translate", (1, 2, 3, 4)),
        ("translate", (1, 2, np.inf)),
    ],
)
def test_bad_arguments_are_named(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        convert_scene(random_scene(), **{name: value})


def views(directions: np.ndarray[Any, Any], scene: Gaussians) -> np.ndarray[Any, Any]:
    """What the bands above 0 add to the color in each direction."""
    return np.einsum("dk,nkc->ndc", sh_basis(directions, scene.sh_degree)[:, 1:], scene.shN)


def same(a: Gaussians, b: Gaussians, atol: float = 1e-5) -> None:
    np.testing.assert_allclose(a.means, b.means, atol=atol, rtol=1e-5)
    np.testing.assert_allclose(a.covars(), b.covars(), atol=atol, rtol=1e-4)
    np.testing.assert_allclose(a.shN, b.shN, atol=atol)
    np.testing.assert_array_equal(a.opacities, b.opacities)
    np.testing.assert_array_equal(a.sh0, b.sh0)


def test_angles_turn_about_x_then_y_then_z() -> None:
    x, y, z = (rotation_about_axes(turn) for turn in np.eye(3) * 90)
    np.testing.assert_array_equal(x @ [0, 1, 0], [0, 0, 1])
    np.testing.assert_array_equal(y @ [0, 0, 1], [1, 0, 0])
    np.testing.assert_array_equal(z @ [1, 0, 0], [0, 1, 0])
    np.testing.assert_array_equal(rotation_about_axes((90, 90, 90)), z @ y @ x)
    np.testing.assert_array_equal(rotation_about_axes((360, -360, 720)), np.eye(3))
    a = rotation_about_axes((10, -200, 33.3))
    np.testing.assert_allclose(a @ a.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(rotation_about_axes((20, 0, 0)) @ rotation_about_axes((25, 0, 0)),
                               rotation_about_axes((45, 0, 0)), atol=1e-15)  # fmt: skip
    np.testing.assert_allclose(a, rotation_about_axes((0, 0, 33.3)) @ rotation_about_axes((10, -200, 0)), atol=1e-15)


def test_the_order_is_up_scale_rotate_translate_whatever_is_asked_together() -> None:
    scene = random_scene(60, 3)
    whole = convert_scene(scene, up=("-y", "+z"), scale=2.5, rotate=(10, 20, -30), translate=(1, 2, 3))
    steps = convert_scene(scene, up=("-y", "+z"))
    for step in ({"scale": 2.5}, {"rotate": (10, 20, -30)}, {"translate": (1, 2, 3)}):
        steps = convert_scene(steps, **step)
    same(whole, steps)
    r = rotation_about_axes((10, 20, -30)) @ rotation_between_axes("-y", "+z")
    np.testing.assert_allclose(whole.means, 2.5 * scene.means @ r.T + [1, 2, 3], atol=1e-5)


def test_placements_compose_and_have_inverses() -> None:
    scene = random_scene(60, 3)
    twice = convert_scene(convert_scene(scene, scale=2.0, rotate=(0, 0, 40)), scale=3.0, rotate=(0, 0, 50))
    same(twice, convert_scene(scene, scale=6.0, rotate=(0, 0, 90)), atol=1e-4)
    there = convert_scene(scene, scale=0.2, rotate=(35, 0, 0), translate=(4, 5, 6))
    back = convert_scene(convert_scene(there, translate=(-4, -5, -6)), scale=5.0, rotate=(-35, 0, 0))
    same(back, scene)


def test_a_placement_keeps_ratios_of_lengths_and_norms_of_colors() -> None:
    scene = random_scene(80, 3)
    got = convert_scene(scene, scale=3.0, rotate=(12, 34, 56), translate=(7, 8, 9))
    np.testing.assert_allclose(got.scales, 3.0 * scene.scales, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(got.quats, axis=1), 1.0, atol=1e-6)
    lengths = [np.linalg.norm(s.means[1:] - s.means[:-1], axis=1) for s in (scene, got)]
    np.testing.assert_allclose(lengths[1], 3.0 * lengths[0], rtol=1e-5)
    for first, last in ((0, 3), (3, 8), (8, 15)):
        norms = [np.linalg.norm(s.shN[:, first:last], axis=1) for s in (scene, got)]
        np.testing.assert_allclose(norms[1], norms[0], rtol=1e-5)
    seen = np.random.default_rng(0).standard_normal((6, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    turned = seen @ rotation_about_axes((12, 34, 56)).T
    np.testing.assert_allclose(views(turned, got), views(seen, scene), atol=1e-5)


def test_a_moved_scene_looks_to_a_moved_camera_as_before() -> None:
    scene = random_scene(120, 3)
    cameras = Cameras.look_at([[9.0, 2, 3]], (0, 0, 0), up=(0, 0, 1), width=40, height=30)
    r, t, s = rotation_about_axes((20, -70, 110)), np.array([3.0, -4, 5]), 1.7
    moved = np.eye(4)
    moved[:3, :3] = cameras.viewmats[0, :3, :3] @ r.T
    moved[:3, 3] = s * cameras.viewmats[0, :3, 3] - moved[:3, :3] @ t
    after = Cameras(moved[None], cameras.Ks, cameras.width, cameras.height)
    placed = convert_scene(scene, scale=s, rotate=(20, -70, 110), translate=t)
    images = [rasterize(g, c, backend="reference").images for g, c in ((scene, cameras), (placed, after))]
    assert images[0].max() > 0.3
    np.testing.assert_allclose(images[1], images[0], atol=2e-4)


def test_merging_is_concatenation_in_order_with_the_highest_degree() -> None:
    parts = [random_scene(7, 1, 1), random_scene(5, 3, 2), random_scene(4, 0, 3)]
    whole = merge_scenes(parts)
    assert (len(whole), whole.sh_degree) == (16, 3)
    for name in ("means", "quats", "scales", "opacities", "sh0"):
        np.testing.assert_array_equal(getattr(whole, name), np.concatenate([getattr(p, name) for p in parts]))
    np.testing.assert_array_equal(whole.shN[:7, :3], parts[0].shN)
    np.testing.assert_array_equal(whole.shN[7:12], parts[1].shN)
    assert not whole.shN[:7, 3:].any()
    assert not whole.shN[12:].any()
    same(merge_scenes([merge_scenes(parts[:2]), parts[2]]), whole, atol=0)
    assert merge_scenes([parts[0]]) is parts[0]
    with pytest.raises(ValueError, match="scenes: expected at least one"):
        merge_scenes([])


def test_the_thinnest_gaussians_survive_a_small_scale() -> None:
    tiny = float(np.finfo(np.float32).tiny)
    scene = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, tiny]], [0.5], [[[0, 0, 0]]])
    assert convert_scene(scene, scale=1e-9).scales[0, 2] == np.float32(tiny)


@pytest.mark.parametrize(
    "change", [{"scale": 1e38}, {"translate": (0, 3.5e38, 0)}, {"scale": 1e37, "rotate": (0, 0, 45)}]
)
def test_a_placement_beyond_float32_is_refused(change: dict[str, Any]) -> None:
    scene = random_scene(20, 0)
    far = Gaussians(scene.means * 40, scene.quats, scene.scales, scene.opacities, scene.sh0)
    with pytest.raises(ValueError, match=r"^scale, translate: expected a scene within 3.4e38"):
        convert_scene(far, **change)
