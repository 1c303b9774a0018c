"""The reference rasterizer: formulas with known answers, invariances, and gradients against finite differences."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from gsvis.render import reference_torch as reference
from gsvis.render.reference_torch import (
    contributors_reference,
    project_reference,
    rasterize_reference,
)
from gsvis.render.tensors import GaussianTensors
from gsvis.scene.cameras import Cameras, intrinsics
from gsvis.scene.gaussians import Gaussians, quats_from_rotations, rotations_from_quats
from gsvis.scene.sh import SH_C0, sh_basis

EYE = np.eye(4)
FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def balls(depths: Any, opacities: Any, colors: Any, scale: float = 0.2) -> GaussianTensors:
    """Balls one behind the other on the axis of the camera at the origin, in float64."""
    n = len(depths)
    means = np.zeros((n, 3))
    means[:, 2] = depths
    sh0 = (np.asarray(colors, np.float64).reshape(n, 1, 3) - 0.5) / SH_C0
    arrays = (means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), scale), opacities, sh0, np.zeros((n, 0, 3)))
    return GaussianTensors(*(torch.tensor(np.asarray(a, np.float64)) for a in arrays))


def cloud(n: int, seed: int = 0, degree: int = 3, size: float = 0.3) -> GaussianTensors:
    """Random Gaussians in front of the camera at the origin, in float64, none near a cut-off."""
    rng = np.random.default_rng(seed)
    means = np.c_[rng.uniform(-0.7, 0.7, (n, 2)), rng.uniform(2, 4, n)]
    shN = rng.normal(0, 0.05, (n, (degree + 1) ** 2 - 1, 3))
    arrays = (
        means,
        rng.normal(size=(n, 4)),
        rng.uniform(size, 3 * size, (n, 3)),
        rng.uniform(0.3, 0.7, n),
        rng.uniform(-0.5, 1.5, (n, 1, 3)),
        shN,
    )
    return GaussianTensors(*(torch.tensor(a) for a in arrays))


def picked(tensors: GaussianTensors, index: Any) -> GaussianTensors:
    return GaussianTensors(*(getattr(tensors, name)[index] for name in FIELDS))


def draw(tensors: GaussianTensors, width: int = 9, height: int = 7, fov: float = 60.0, **options: Any) -> Any:
    return rasterize_reference(tensors, EYE, intrinsics(width, height, fov), width, height, **options)


# ---------------------------------------------------------------------------------------------- known answers


def test_one_gaussian_peaks_at_its_projected_pixel() -> None:
    scene = balls([2.0], [0.8], [[0.9, 0.4, 0.1]])
    drawn = draw(scene, 9, 7)  # the axis meets the center of pixel (4, 3)
    assert torch.allclose(drawn.means2d[0], torch.tensor([4.5, 3.5]).double())
    assert drawn.alpha[3, 4].item() == pytest.approx(0.8, abs=1e-12)
    assert drawn.image[3, 4].tolist() == pytest.approx([0.72, 0.32, 0.08], abs=1e-12)
    assert drawn.depth[3, 4].item() == pytest.approx(2.0)
    assert drawn.median_depth[3, 4].item() == pytest.approx(2.0)
    focal = intrinsics(9, 7, 60.0)[0, 0]
    variance = (focal * 0.2 / 2.0) ** 2 + 0.3
    assert drawn.alpha[3, 6].item() == pytest.approx(0.8 * np.exp(-0.5 * 4 / variance), abs=1e-12)
    assert drawn.alpha.argmax() == 3 * 9 + 4
    reach = np.sqrt(2 * np.log(255 * 0.8) * variance)
    assert drawn.radii[0].tolist() == pytest.approx([reach, reach])


def test_two_gaussians_blend_front_to_back_over_the_background() -> None:
    scene = balls([3.0, 2.0], [0.5, 0.4], [[1, 0, 0], [0, 1, 0]])
    drawn = draw(scene, background=[0.0, 0.2, 1.0])
    assert drawn.image[3, 4].tolist() == pytest.approx([0.6 * 0.5, 0.4 + 0.3 * 0.2, 0.3])
    assert drawn.alpha[3, 4].item() == pytest.approx(0.7)
    assert drawn.depth[3, 4].item() == pytest.approx((0.4 * 2 + 0.3 * 3) / 0.7)
    assert drawn.median_depth[3, 4].item() == 3.0  # 0.6 is left after the first, 0.3 after the second
    assert drawn.largest_weights.tolist() == pytest.approx([0.3, 0.4])


def test_weights_add_up_to_alpha() -> None:
    scene = cloud(30)
    drawn = draw(scene)
    assert drawn.summed_weights.sum().item() == pytest.approx(drawn.alpha.sum().item())
    assert (drawn.largest_weights <= drawn.summed_weights + 1e-15).all()
    ids, alphas, weights, depths = contributors_reference(scene, EYE, intrinsics(9, 7, 60.0), 9, 7, (2, 5))
    assert weights.sum() == pytest.approx(drawn.alpha[5, 2].item())
    assert weights == pytest.approx(alphas * np.cumprod(np.r_[1.0, 1.0 - alphas[:-1]]))
    assert (np.diff(depths) >= 0).all()
    assert depths == pytest.approx(scene.means[ids, 2].numpy())


def test_nothing_is_seen_where_no_gaussian_is() -> None:
    drawn = draw(balls([2.0], [0.8], [[1, 1, 1]], scale=0.01), 31, 31, background=[0.1, 0.2, 0.3])
    assert drawn.image[0, 0].tolist() == [0.1, 0.2, 0.3]
    assert drawn.alpha[0, 0] == drawn.depth[0, 0] == drawn.median_depth[0, 0] == 0


def test_blending_stops_before_the_gaussian_that_would_spend_transmittance() -> None:
    colors = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]
    scene = balls([1.0, 2.0, 3.0, 4.0], [0.99, 0.98, 0.96, 0.1], colors)  # 1e-2, 2e-4, 8e-6 are left
    drawn = draw(scene, 1, 1)
    assert drawn.image[0, 0].tolist() == pytest.approx([0.99, 0.01 * 0.98, 0.0], abs=1e-12)
    assert drawn.alpha[0, 0].item() == pytest.approx(1 - 2e-4, abs=1e-12)
    assert drawn.largest_weights[2:].tolist() == [0, 0]  # the last is faint, but stands behind the stop
    ids, *_ = contributors_reference(scene, EYE, intrinsics(1, 1, 60.0), 1, 1, (0, 0))
    assert ids.tolist() == [0, 1]


def test_alpha_is_capped_and_what_is_faint_is_skipped() -> None:
    assert draw(balls([2.0], [1.0], [[1, 1, 1]])).alpha[3, 4].item() == pytest.approx(0.999)
    just_below, just_above = 0.99 / 255, 1.01 / 255
    drawn = draw(balls([2.0], [just_below], [[1, 1, 1]]))
    assert drawn.alpha.max() == 0
    assert drawn.radii.max() == 0
    assert draw(balls([2.0], [just_above], [[1, 1, 1]])).alpha[3, 4].item() == pytest.approx(just_above)


@pytest.mark.parametrize(("depth", "seen"), [(-1.0, False), (0.0, False), (0.0099, False), (0.0101, True)])
def test_only_what_lies_beyond_the_near_plane_is_drawn(depth: float, seen: bool) -> None:
    drawn = draw(balls([depth], [0.5], [[1, 1, 1]], scale=0.001))
    assert (drawn.alpha[3, 4].item() > 0.4) == seen
    assert bool(drawn.radii.max() > 0) == seen


def test_a_gaussian_on_the_eye_spoils_no_gradient() -> None:
    scene = balls([0.0, 2.0], [0.5, 0.5], [[1, 1, 1], [0, 1, 0]])
    for name in FIELDS:
        getattr(scene, name).requires_grad_()
    drawn = draw(scene, antialiased=True)
    (drawn.image.sum() + drawn.depth.sum() + drawn.median_depth.sum()).backward()
    for name in FIELDS[:-1]:
        grad = getattr(scene, name).grad
        assert torch.isfinite(grad).all()
        assert grad[0].abs().max() == 0
    assert drawn.means2d.grad.shape == (2, 2)


def test_the_projection_is_the_ewa_formula() -> None:
    scene = cloud(40)
    width, height, K = 64, 40, intrinsics(64, 40, 50.0)
    found = project_reference(scene, EYE, K, width, height)
    rotations = rotations_from_quats((scene.quats / scene.quats.norm(dim=1, keepdim=True)).numpy())
    for i, (x, y, z) in enumerate(scene.means.tolist()):
        limit = np.array([width, height]) / 2 / K[0, 0] * 1.3  # the axis is in the middle here
        tx, ty = np.clip([x / z, y / z], -limit, limit) * z
        J = np.array([[K[0, 0] / z, 0, -K[0, 0] * tx / z**2], [0, K[1, 1] / z, -K[1, 1] * ty / z**2]])
        covar = rotations[i] @ np.diag(scene.scales[i].numpy() ** 2) @ rotations[i].T
        conic = np.linalg.inv(J @ covar @ J.T + 0.3 * np.eye(2))
        assert found.conics[i].tolist() == pytest.approx([conic[0, 0], conic[0, 1], conic[1, 1]], rel=1e-9)
        assert found.means2d[i].tolist() == pytest.approx([K[0, 0] * x / z + 32, K[1, 1] * y / z + 20])
        assert found.depths[i].item() == z


def test_the_jacobian_is_clamped_outside_the_view() -> None:
    K = np.array([[50.0, 0, 10], [0, 40, 25], [0, 0, 1]])  # 64 x 40 with the axis off the middle
    scene = balls([1.0, 1.0], [0.5, 0.5], np.full((2, 3), 0.5))
    slopes = [-10 / 50 - 0.3 * 0.5 * 64 / 50, (64 - 10) / 50 + 0.3 * 0.5 * 64 / 50]
    edge, beyond = scene.means.clone(), scene.means.clone()
    edge[:, 0] = torch.tensor(slopes).double()
    beyond[:, 0] = torch.tensor(slopes).double() * 3
    at_edge, outside = (project_reference(replace(scene, means=m), EYE, K, 64, 40) for m in (edge, beyond))
    assert torch.allclose(at_edge.conics, outside.conics)
    assert torch.allclose(outside.means2d[:, 0], 50 * beyond[:, 0] + 10)
    inside = project_reference(replace(scene, means=edge * 0.9), EYE, K, 64, 40)
    assert not torch.allclose(at_edge.conics, inside.conics)


def test_color_is_the_scene_s_harmonics_from_eye_to_gaussian_clipped_at_zero() -> None:
    scene = cloud(25)
    scene = replace(scene, sh0=scene.sh0 * 3 - 1)
    camera = Cameras.look_at([[1.0, -2.0, 0.5]], [0.0, 0.0, 3.0], up=[0, -1, 0])
    found = project_reference(scene, camera.viewmats[0], camera.Ks[0], camera.width, camera.height).colors
    directions = scene.means.numpy() - camera.viewpoints[0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    coefficients = np.concatenate([scene.sh0.numpy(), scene.shN.numpy()], axis=1)
    color = 0.5 + np.einsum("nk,nkc->nc", sh_basis(directions, 3), coefficients)
    assert color.min() < 0
    assert color.max() > 1
    assert found.numpy() == pytest.approx(np.maximum(color, 0), abs=1e-12)


@pytest.mark.parametrize("degree", range(4))
def test_a_lower_degree_leaves_the_higher_coefficients_out(degree: int) -> None:
    scene = cloud(10)
    truncated = replace(scene, shN=scene.shN[:, : (degree + 1) ** 2 - 1])
    assert torch.equal(draw(scene, sh_degree=degree).image, draw(truncated).image)


def test_given_colors_stand_in_for_the_harmonics() -> None:
    scene = cloud(10)
    K = intrinsics(9, 7, 60.0)
    own = project_reference(scene, EYE, K, 9, 7).colors
    assert torch.equal(draw(scene, colors=own).image, draw(scene).image)
    assert torch.allclose(draw(scene, colors=2 * own).image, 2 * draw(scene).image)


@pytest.mark.parametrize(("scale", "rel"), [(0.03, 0.05), (0.1, 0.01), (0.3, 0.01)])
def test_antialiasing_keeps_the_energy_that_the_blur_adds_to(scale: float, rel: float) -> None:
    ball = balls([2.0], [0.9], [[1, 1, 1]], scale=scale)
    variance = (intrinsics(41, 41, 60.0)[0, 0] * scale / 2.0) ** 2
    kept, blurred = (draw(ball, 41, 41, antialiased=a).alpha for a in (True, False))
    assert kept.sum().item() == pytest.approx(0.9 * 2 * np.pi * variance, rel=rel)  # but for the tail below 1/255
    assert blurred.sum().item() == pytest.approx(0.9 * 2 * np.pi * (variance + 0.3), rel=rel)
    assert kept.max().item() == pytest.approx(0.9 * variance / (variance + 0.3))


def test_antialiasing_dims_the_tiny() -> None:
    tiny = balls([2.0], [0.9], [[1, 1, 1]], scale=0.003)
    assert draw(tiny, antialiased=True).alpha.sum() < 0.1 * draw(tiny).alpha.sum()


# ------------------------------------------------------------------------------------------------ invariances


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("depth", [None, 3.0])
def test_the_order_of_the_gaussians_changes_nothing(dtype: torch.dtype, depth: float | None) -> None:
    scene = cloud(60)
    if depth is not None:
        scene.means[:, 2] = depth
        scene.means[:20] = scene.means[0]  # and twenty that differ in no more than the rest
        scene.scales[:10] = scene.scales[0]
        scene.quats[:5] = scene.quats[0]
        scene.opacities[:3] = scene.opacities[0]
    scene = GaussianTensors(*(getattr(scene, name).to(dtype) for name in FIELDS))
    drawn = draw(scene)
    for seed in range(3):
        order = torch.randperm(60, generator=torch.Generator().manual_seed(seed))
        again = draw(picked(scene, order))
        for name in ("image", "alpha", "depth", "median_depth"):
            assert torch.allclose(getattr(drawn, name), getattr(again, name), atol=4e-7, rtol=0), name
        assert torch.allclose(drawn.summed_weights[order], again.summed_weights, atol=1e-5)


def test_depths_equal_in_float32_are_ordered_by_content() -> None:
    a, b = 2.0, 2.0 + 1e-12
    scene = balls([b, a], [0.5, 0.5], [[1, 0, 0], [0, 1, 0]])
    scene.means[0, 0] = -1e-9  # farther by less than float32 holds, but first by its x
    assert draw(scene).image[3, 4].tolist() == pytest.approx([0.5, 0.25, 0.0])


def test_scene_and_camera_moved_together_give_the_same_image() -> None:
    scene = cloud(30)
    rng = np.random.default_rng(1)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    g = Gaussians(*(getattr(scene, name).numpy() for name in FIELDS))
    moved = g.transform(turn, [1.0, -2.0, 0.5])
    view = np.eye(4)
    view[:3, :3] = turn.T
    view[:3, 3] = -turn.T @ [1.0, -2.0, 0.5]
    K = intrinsics(16, 12, 60.0)
    still, after = (
        rasterize_reference(GaussianTensors.from_gaussians(s, torch.float64), v, K, 16, 12)
        for s, v in ((g, EYE), (moved, view))
    )
    for name in ("image", "alpha", "depth"):
        assert torch.allclose(getattr(still, name), getattr(after, name), atol=1e-5), name


def test_the_length_and_sign_of_a_quaternion_mean_nothing() -> None:
    scene = cloud(10)
    factors = torch.tensor([-3.0, 0.01, 50.0, 1.0, -1.0] * 2).double()[:, None]
    other = replace(scene, quats=scene.quats * factors)
    assert torch.allclose(draw(scene).image, draw(other).image, atol=1e-12)
    quats = torch.tensor(quats_from_rotations(rotations_from_quats(torch.nn.functional.normalize(scene.quats).numpy())))
    assert torch.allclose(draw(scene).image, draw(replace(scene, quats=quats)).image, atol=1e-9)


def test_chunks_of_pixels_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def run() -> tuple[Tensor, Tensor, Tensor]:
        scene = cloud(20)
        scene.means.requires_grad_()
        drawn = draw(scene)
        drawn.image.square().sum().backward()
        assert scene.means.grad is not None
        return drawn.image.detach(), scene.means.grad, drawn.summed_weights

    whole = run()
    monkeypatch.setattr(reference, "_PAIRS_AT_ONCE", 100)
    for one, other in zip(whole, run(), strict=True):
        assert torch.allclose(one, other, atol=1e-12)


def test_float32_follows_float64() -> None:
    scene = cloud(50)
    single = GaussianTensors(*(getattr(scene, name).float() for name in FIELDS))
    drawn = draw(single)
    assert drawn.image.dtype == torch.float32
    assert torch.allclose(drawn.image.double(), draw(scene).image, atol=1e-5)


# -------------------------------------------------------------------------------------------------- edge cases


def test_an_empty_scene_shows_the_background() -> None:
    scene = GaussianTensors.from_gaussians(Gaussians.empty(2), torch.float64, requires_grad=True)
    drawn = draw(scene, background=[0.1, 0.2, 0.3])
    assert torch.equal(drawn.image, torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64).expand(7, 9, 3))
    assert drawn.alpha.abs().max() == drawn.depth.abs().max() == drawn.median_depth.abs().max() == 0
    assert drawn.means2d.shape == drawn.radii.shape == (0, 2)
    assert drawn.largest_weights.shape == (0,)


def test_one_pixel() -> None:
    drawn = draw(balls([2.0], [0.8], [[1, 0.5, 0]]), 1, 1)
    assert drawn.image.shape == (1, 1, 3)
    assert drawn.image[0, 0].tolist() == pytest.approx([0.8, 0.4, 0.0])


@pytest.mark.parametrize("scales", [(1e4, 1e4, 1e4), (1e-8, 1e-8, 1e-8), (1e-8, 1e-8, 10.0), (1e5, 1e5, 1e-8)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extreme_shapes_stay_finite(scales: tuple[float, float, float], dtype: torch.dtype) -> None:
    scene = cloud(12)
    scene.means[0] = torch.tensor([0.0, 0.0, 0.011])
    scene = GaussianTensors(*(getattr(scene, name).to(dtype) for name in FIELDS))
    scene = replace(scene, scales=torch.tensor(scales, dtype=dtype).expand(12, 3).clone())
    for name in FIELDS:
        getattr(scene, name).requires_grad_()
    for antialiased in (False, True):
        drawn = draw(scene, antialiased=antialiased)
        (drawn.image.sum() + drawn.depth.sum()).backward()
        assert torch.isfinite(drawn.image).all()
        assert drawn.image.max() < 5
        for name in FIELDS:
            assert torch.isfinite(getattr(scene, name).grad).all(), name


def test_a_tensor_camera_keeps_its_gradient() -> None:
    scene = cloud(5)
    view = torch.eye(4, dtype=torch.float64, requires_grad=True)
    rasterize_reference(scene, view, intrinsics(5, 4, 60.0), 5, 4).image.sum().backward()
    assert view.grad is not None
    assert view.grad[:3].abs().min() > 0


# --------------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", [*FIELDS, "colors"])
def test_gradients_are_those_of_finite_differences(name: str, antialiased: bool) -> None:
    scene = cloud(4, size=0.5)
    tilted = Cameras.look_at([[0.3, -0.2, 0.1]], [0.1, 0.0, 3.0], up=[0, -1, 0], width=5, height=4, fov=50.0)
    K = tilted.Ks[0] + [[0, 0, 0.3], [0, 4.0, -0.2], [0, 0, 0]]
    colors = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def drawn(value: Tensor) -> tuple[Tensor, ...]:
        given = value if name == "colors" else None
        s = scene if name == "colors" else replace(scene, **{name: value})
        out = rasterize_reference(
            s, tilted.viewmats[0], K, 5, 4, background=[0.2, 0.5, 0.9], antialiased=antialiased, colors=given
        )
        return out.image, out.alpha, out.depth, out.median_depth

    start = colors if name == "colors" else getattr(scene, name)
    assert torch.autograd.gradcheck(drawn, start.clone().requires_grad_(), atol=1e-7, rtol=1e-5)


def test_gradients_outside_the_view_and_under_a_small_blur() -> None:
    scene = cloud(4, size=0.05)
    scene.means[:, 0] += torch.tensor([1.5, -1.6, 0.0, 0.1])  # two of them beyond the clamp of the Jacobian
    scene = replace(scene, scales=scene.scales * torch.tensor([[8.0], [8.0], [1.0], [1.0]]))
    assert (draw(scene, 5, 4, fov=30).summed_weights > 0).all()

    def drawn(means: Tensor, scales: Tensor, quats: Tensor) -> Tensor:
        return draw(replace(scene, means=means, scales=scales, quats=quats), 5, 4, fov=30).image

    values = tuple(getattr(scene, name).clone().requires_grad_() for name in ("means", "scales", "quats"))
    assert torch.autograd.gradcheck(drawn, values, atol=1e-7, rtol=1e-5)


def test_the_screen_space_gradient_is_that_of_moving_the_gaussian_on_the_screen() -> None:
    scene = balls([2.0], [0.5], [[1, 1, 1]])
    scene.means.requires_grad_()
    drawn = draw(scene)
    drawn.image[3, 6].sum().backward()
    focal = intrinsics(9, 7, 60.0)[0, 0]
    variance = (focal * 0.2 / 2.0) ** 2 + 0.3
    value = 3 * drawn.alpha[3, 6].item()
    assert drawn.means2d.grad[0].tolist() == pytest.approx([value * 2 / variance, 0.0], abs=1e-12)


# --------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmat": np.eye(3)}, "viewmat: expected shape"),
        ({"viewmat": np.diag([1.0, 1, 2, 1])}, "viewmat: expected a rotation"),
        ({"viewmat": np.eye(4) + np.eye(4, k=-3)}, "viewmat: expected a last row"),
        ({"viewmat": np.full((4, 4), np.nan)}, "viewmat: expected finite"),
        ({"viewmat": torch.full((4, 4), torch.inf)}, "viewmat: expected finite"),
        ({"K": np.zeros((3, 3))}, "K: expected focal lengths > 0"),
        ({"K": np.eye(3) + np.eye(3, k=1)}, "K: expected focal lengths > 0, no skew"),
        ({"K": np.eye(4)}, "K: expected shape"),
        ({"width": 0}, "width: expected an integer of at least 1"),
        ({"height": 2.0}, "height: expected an integer of at least 1"),
        ({"background": [0, 0]}, "background: expected shape"),
        ({"sh_degree": 4}, "sh_degree: expected 0 to 3"),
        ({"sh_degree": -1}, "sh_degree: expected 0 to 3"),
        ({"colors": torch.zeros(3, 3)}, "colors: expected shape"),
    ],
)
def test_bad_arguments_are_named(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"viewmat": EYE, "K": intrinsics(4, 4, 60.0), "width": 4, "height": 4} | change
    with pytest.raises(ValueError, match=message):
        rasterize_reference(cloud(2), **arguments)


def test_a_pixel_outside_the_image_is_named() -> None:
    with pytest.raises(ValueError, match="pixel: expected a column below 4"):
        contributors_reference(cloud(2), EYE, intrinsics(4, 4, 60.0), 4, 4, (4, 0))
