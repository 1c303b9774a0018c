"""What is shown after so many bytes: more bytes never show less of a file, and quantizers keep what they promise."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from arena.anchors import Anchors, find_places
from arena.bags import sum_rows
from arena.codebooks import fake_quantize, kmeans, nearest
from arena.course import Course
from arena.grid import roughness, sort_to_grid
from arena.hash_grid import contract
from arena.links import drawn_links
from arena.planes import decode_jpeg_xl, dequantize, encode_jpeg_xl, quantize
from arena.stages import Stages, cut_rows
from arena.systems import compact3d, compressed3d, sogg

from gsvis.abr import BandwidthTrace
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.points import PointCloud
from gsvis.scene.procedural import random_scene
from gsvis.simulate import Link


def scene(count: int = 64, degree: int = 1) -> Gaussians:
    return random_scene(np.random.default_rng(3), count, degree)


def test_stages_arrive_in_order_and_bytes_only_grow(course: Course) -> None:
    stages = cut_rows(100, 50.0, scene())
    assert list(stages.ends) == sorted(set(stages.ends))
    assert stages.nbytes == 100 + 50 * 64
    for link in drawn_links(0.01, 2, 30.0):
        shown = stages.play(course, link)
        assert (np.diff(shown.times) > 0).all()
        arrived = [shown.bytes_at(t) for t in np.linspace(0.0, 10.0, 50)]
        assert arrived == sorted(arrived)
        assert arrived[-1] <= stages.nbytes
        assert shown.image(0, shown.times[0] - 1e-6) is None
        np.testing.assert_array_equal(shown.image(0, 1e6), stages.whole(course, 0))


def test_a_file_takes_its_bytes_over_the_rate_and_a_round_trip(course: Course) -> None:
    stages = Stages.at_once(125_000, scene())
    shown = stages.play(course, Link(BandwidthTrace.constant(1.0), 0.04))
    assert shown.times == pytest.approx([1.04])
    assert shown.bytes_at(0.54) == pytest.approx(62_500)


@pytest.mark.parametrize("ends", [(), (0, 1), (2, 2), (3, 1)])
def test_stages_that_do_not_rise_are_refused(ends: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="strictly rising bytes"):
        Stages(ends, lambda stage, camera: np.zeros((1, 1, 3), np.float32), 1)


@pytest.mark.parametrize("bits", [5, 8, 16])
def test_quantized_values_come_back_within_half_a_step(bits: int) -> None:
    values = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    values[:, 3] = 2.0  # one value alone
    integers, ends = quantize(values, bits)
    step = (ends[1] - ends[0]) / (2**bits - 1)
    assert (np.abs(dequantize(integers, ends, bits) - values) <= 0.5 * step + 1e-5).all()


def test_rounding_in_training_is_the_rounding_that_is_sent() -> None:
    values = torch.randn(100, 3, requires_grad=True)
    rounded = fake_quantize(values)
    sent = dequantize(*quantize(values.detach().numpy(), 8), 8)
    np.testing.assert_allclose(rounded.detach().numpy(), sent, atol=1e-5)
    np.testing.assert_allclose(fake_quantize(rounded).detach().numpy(), sent, atol=1e-5)
    rounded.sum().backward()
    assert values.grad is not None
    assert (values.grad == 1.0).all()


def test_codes_are_the_nearest_and_find_clear_clusters() -> None:
    places = torch.tensor([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    rows = places.repeat(50, 1) + 0.01 * torch.randn(150, 2)
    centers = kmeans(rows, torch.ones(150), 12)
    assert float((rows - centers[nearest(rows, centers)]).norm(dim=1).max()) < 1.0
    every = torch.cdist(rows, centers).argmin(dim=1)
    assert (every == nearest(rows, centers)).all()


def test_a_sorted_square_is_a_permutation_and_smoother() -> None:
    rows = np.random.default_rng(1).random((400, 3), np.float32)
    order = sort_to_grid(rows)
    assert sorted(order.tolist()) == list(range(400))
    before, after = (roughness(each.reshape(20, 20, 3)) for each in (rows, rows[order]))
    assert after < 0.3 * before
    with pytest.raises(ValueError, match="a square number of rows"):
        sort_to_grid(rows[:399])


def test_images_of_jpeg_xl_are_exact() -> None:
    pytest.importorskip("imagecodecs")
    rng = np.random.default_rng(2)
    for shape, kind in (((16, 16), np.uint8), ((16, 16, 3), np.uint8), ((9, 9, 3), np.uint16)):
        image = rng.integers(0, np.iinfo(kind).max, shape).astype(kind)
        np.testing.assert_array_equal(decode_jpeg_xl(encode_jpeg_xl(image)), image)
    with pytest.raises(ValueError, match="damaged"):
        decode_jpeg_xl(b"no image")


def test_grids_come_back_within_their_steps() -> None:
    pytest.importorskip("imagecodecs")
    g = scene(49)
    arrays = sogg.encode(g)
    back = sogg.decode(arrays)
    assert len(back) == 49
    for name, limit in (("means", 1e-3), ("opacities", 0.02), ("sh0", 0.03)):
        np.testing.assert_allclose(getattr(back, name), getattr(g, name), atol=limit * np.ptp(getattr(g, name)) + 1e-6)


def test_codebooks_that_are_sent_draw_what_training_drew(course: Course) -> None:
    packed = compressed3d.compress(scene(80, 3), course, codes=16)
    arrays = packed.arrays()
    assert arrays["color_of"].max() < len(arrays["colors"]) <= 16 + 4
    back = compressed3d.decode(arrays)
    camera = course.views.cameras[0]
    with torch.no_grad():
        trained = packed.draw(camera).clamp(0, 1).numpy()
    from gsvis.render import rasterize

    np.testing.assert_allclose(np.clip(rasterize(back, camera).images[0], 0, 1), trained, atol=5e-3)


def test_a_grid_of_colors_and_codes_that_are_sent_draw_nearly_the_same(course: Course) -> None:
    made = compact3d.Compact.from_gaussians(scene(80, 0))
    back = compact3d.Compact.from_arrays(made.arrays())
    with torch.no_grad():
        for camera in (course.views.cameras[k] for k in range(2)):
            np.testing.assert_allclose(made.draw(camera)[0].numpy(), back.draw(camera)[0].numpy(), atol=0.05)


def test_each_stage_of_codes_leaves_less() -> None:
    rows = torch.from_numpy(np.random.default_rng(5).normal(size=(300, 4)).astype(np.float32))
    books, codes = compact3d.residual_codes(rows, stages=4, codes=16)
    left = [float((rows - compact3d.sum_codes(books[:k], codes[:, :k])).square().mean()) for k in range(1, 5)]
    assert left == sorted(left, reverse=True)
    assert left[-1] < 0.3


def test_sums_of_rows_have_the_gradient_of_plain_indexing() -> None:
    rng = np.random.default_rng(7)
    table, weights = (torch.from_numpy(rng.normal(size=size)) for size in ((9, 2), (20, 3)))
    entries = torch.from_numpy(rng.integers(0, 9, (20, 3)))
    for some in (weights, None):
        plain, quick = (table.clone().requires_grad_() for _ in range(2))
        rows = plain[entries]
        expected = (rows if some is None else rows * some[:, :, None]).sum(dim=1)
        got = sum_rows(quick, entries, some)
        torch.testing.assert_close(got, expected)
        for each in (expected, got):
            each.square().sum().backward()
        torch.testing.assert_close(quick.grad, plain.grad)


def test_places_are_contracted_into_a_ball() -> None:
    places = 10.0 * torch.from_numpy(np.random.default_rng(6).normal(size=(200, 3)).astype(np.float32))
    places[:20] *= 0.01
    inside = contract(places)
    assert float(inside.norm(dim=1).max()) <= 2.0
    near = places.norm(dim=1) <= 1.0
    assert near.any()
    torch.testing.assert_close(inside[near], places[near])


def anchors(levels: int) -> Anchors:
    points = PointCloud(np.random.default_rng(4).random((500, 3)))
    return Anchors.from_places(find_places(points, 60, levels), 2.0 if levels > 1 else float("inf"))


@pytest.mark.parametrize("levels", [1, 3])
def test_anchors_that_are_sent_draw_nearly_the_same(course: Course, levels: int) -> None:
    made = anchors(levels)
    assert len(made) <= 60
    assert set(made.level.tolist()) == set(range(levels))
    back = Anchors.from_arrays(made.arrays())
    assert (np.diff(back.level.numpy()) >= 0).all()  # lower levels come first
    with torch.no_grad():
        for camera in (course.views.cameras[k] for k in range(2)):
            np.testing.assert_allclose(made.draw(camera)[0].numpy(), back.draw(camera)[0].numpy(), atol=0.02)


def test_networks_of_another_size_are_refused() -> None:
    arrays = anchors(1).arrays()
    arrays["networks"] = arrays["networks"][:-1]
    with pytest.raises(ValueError, match="another network"):
        Anchors.from_arrays(arrays)
