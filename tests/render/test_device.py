"""The device that draws: what decides it, the words for each failure, and views drawn there with less memory.

No GPU is needed: the backend "reference" goes the way of a GPU with tensors on the CPU, and memory runs out on demand.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsvis.errors import BackendError
from gsvis.render import rasterize
from gsvis.render.device import Device, OnDevice, choose_device, torch_device_of, why_no_cuda
from gsvis.render.device_scene import MOST_PARTS, DeviceScene
from gsvis.render.device_torch import DeviceView, draw_in_parts
from gsvis.render.fixed_view import FixedView
from gsvis.render.tensors import GaussianTensors
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from tests.render.pretended_gpu import pretend_gpu

NO_CUDA = why_no_cuda()
Patch = pytest.MonkeyPatch


@pytest.fixture(autouse=True)
def no_garbage(monkeypatch: Patch) -> None:
    """Collect no garbage where memory runs out: that takes a second in a process as large as that of tests."""
    monkeypatch.setattr(gc, "collect", lambda: 0)


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    rng = np.random.default_rng(8)
    n = 120
    return Gaussians(
        rng.normal(size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(0.02, 0.4, (n, 3)),
        rng.uniform(0.05, 1.0, n),
        rng.normal(size=(n, 1, 3)),
        rng.normal(scale=0.2, size=(n, 3, 3)),
    )


@pytest.fixture(scope="module")
def camera() -> Cameras:
    return Cameras.look_at([[0.0, 0.5, -3.0]], [[0.2, 0.0, 0.0]], width=29, height=23)


def with_torch(patch: Patch, *, built: str | None = "12.6", works: bool = True, error: str = "") -> None:
    """Make torch one that is built for CUDA, on a machine where it starts or fails with an error."""

    def start() -> None:
        if error:
            raise RuntimeError(error)

    patch.setattr(torch.version, "cuda", built)
    patch.setattr(torch.version, "hip", None)
    patch.setattr(torch.cuda, "is_available", lambda: works)
    patch.setattr(torch.cuda, "init", start)


def with_gsplat(patch: Patch, draw: Callable[[str], None] = lambda device: None) -> None:
    """Install a gsplat that draws, or fails to."""
    patch.setitem(sys.modules, "gsplat", SimpleNamespace())
    patch.setattr("gsvis.render.device.has", lambda package: True)
    patch.setattr("gsvis.render.cuda.draw_one", draw)
    patch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA H200")


def failing(error: Exception) -> Callable[..., Any]:
    def fail(*_: object, **__: object) -> None:
        raise error

    return fail


def test_a_gpu_that_works_is_taken(monkeypatch: Patch) -> None:
    with_torch(monkeypatch)
    with_gsplat(monkeypatch)
    assert choose_device("auto") == choose_device("cuda") == Device("cuda", "NVIDIA H200")
    assert choose_device("auto").line == "device: cuda, NVIDIA H200"
    assert choose_device("cpu") == Device("cpu")


def test_without_gsplat_nobody_imports_torch(monkeypatch: Patch) -> None:
    monkeypatch.setattr("gsvis.render.device.has", lambda package: package != "gsplat")
    monkeypatch.setattr("gsvis.render.device.why_no_cuda", failing(AssertionError("torch was imported")))
    assert choose_device("auto") == choose_device("cpu") == Device("cpu")


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^device: expected one of"):
        choose_device("tpu")


OLD = "The NVIDIA driver on your system is too old (found version 11040). Please update your GPU driver by\nmore"


@pytest.mark.parametrize(
    ("torches", "wanted"),
    [
        ({"built": None}, "expected a torch that is built for CUDA, got torch"),
        ({"works": False, "error": OLD}, "driver on your system is too old (found version 11040)'; update the driver"),
        ({"works": False, "error": "Found no NVIDIA driver on your system."}, "got 'Found no NVIDIA driver on your"),
        ({"works": False}, "got 'no GPU'"),
    ],
)
def test_each_failure_of_torch_has_its_words(torches: dict[str, Any], wanted: str, monkeypatch: Patch) -> None:
    with_torch(monkeypatch, **torches)
    with_gsplat(monkeypatch)
    with pytest.raises(BackendError) as caught:
        choose_device("cuda")
    message = str(caught.value)
    assert message.startswith("device 'cuda': expected ")
    assert wanted in message
    assert message.endswith("or use the device 'cpu'")
    assert "\n" not in message
    assert choose_device("auto").name == "cpu"
    reason = message.removeprefix("device 'cuda': ")
    assert choose_device("auto").line == f"device: cpu, because cuda: {reason}"


def test_a_missing_torch_and_gsplat_name_their_extras(monkeypatch: Patch) -> None:
    with_torch(monkeypatch)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(BackendError, match=r"expected an importable gsplat, got .*; pip install \"gsvis\[cuda\]\"$"):
        choose_device("cuda")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(BackendError, match=r"expected the package torch, got none; pip install \"gsvis\[torch\]\"$"):
        choose_device("cuda")


def test_a_gsplat_that_cannot_draw_is_found_before_any_work(monkeypatch: Patch) -> None:
    with_torch(monkeypatch)
    with_gsplat(monkeypatch, failing(RuntimeError("no kernel image is available for execution on the device\nmore")))
    with pytest.raises(BackendError, match=r"got 'no kernel image .* on the device'; install gsplat for this GPU"):
        choose_device("cuda")
    assert choose_device("auto").name == "cpu"


def test_work_goes_on_on_the_cpu_where_memory_runs_out(caplog: pytest.LogCaptureFixture) -> None:
    work = OnDevice("colors are learned")
    assert work.run(lambda: "there", lambda: "here") == "there"
    assert work.run(failing(torch.OutOfMemoryError()), lambda: "here") == "here"
    assert work.run(lambda: "there", lambda: "here") == "here"  # also from then on
    assert caplog.messages == ["the memory of the GPU ran out; colors are learned on the CPU from here"]


def test_work_is_tried_again_once_the_memory_is_emptied() -> None:
    tries: list[int] = []

    def there() -> str:
        tries.append(1)
        if len(tries) == 1:
            raise torch.OutOfMemoryError
        return "there"

    work = OnDevice("views are drawn")
    assert work.run(there, lambda: "here") == "there"
    assert work.works
    with pytest.raises(RuntimeError, match="another"):
        work.run(failing(RuntimeError("another")), lambda: "here")


@pytest.mark.parametrize("parts", [2, 3, 16])
def test_parts_by_depth_blend_to_the_whole(scene: Gaussians, camera: Cameras, parts: int) -> None:
    tensors = GaussianTensors.from_gaussians(scene)
    options: dict[str, Any] = {"backend": "reference", "sh_degree": None, "antialiased": False}
    options["background"] = np.array([0.2, 0.5, 0.9], np.float32)
    whole = draw_in_parts(tensors, camera, 1, **options)
    joined = draw_in_parts(tensors, camera, parts, **options)
    for one, other, tolerance in zip(whole[:3], joined[:3], (2e-4, 2e-4, 2e-3), strict=True):
        assert torch.allclose(one, other, atol=tolerance)
    assert torch.isnan(joined[3]).all()


def test_a_scene_on_a_device_is_drawn_as_on_the_cpu(scene: Gaussians, camera: Cameras) -> None:
    there = DeviceScene(scene, "reference").draw(camera, background=(0.2, 0.5, 0.9), sh_degree=1)
    here = rasterize(scene, camera, background=(0.2, 0.5, 0.9), sh_degree=1)
    for name in ("images", "alphas"):
        assert getattr(there, name).dtype == np.float32
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), atol=1e-4)
    same = DeviceScene(scene).draw(camera)
    assert np.array_equal(same.images, rasterize(scene, camera).images)


def test_a_view_that_does_not_fit_is_drawn_in_parts_then_on_the_cpu(
    scene: Gaussians, camera: Cameras, monkeypatch: Patch, caplog: pytest.LogCaptureFixture
) -> None:
    fits = 4

    def draw(tensors: GaussianTensors, camera: Cameras, parts: int, **options: Any) -> Any:
        if parts < fits:
            raise torch.OutOfMemoryError
        return draw_in_parts(tensors, camera, parts, **options)

    monkeypatch.setattr("gsvis.render.device_torch.draw_in_parts", draw)
    here = rasterize(scene, camera).images
    shown = DeviceScene(scene, "reference")
    for _ in range(2):
        assert np.allclose(shown.draw(camera).images, here, atol=3e-4)
    assert (shown.backend, shown.parts) == ("reference", 4)
    assert caplog.messages == ["the memory of the GPU ran out; views are drawn there in parts from here"]
    fits = MOST_PARTS + 1
    assert np.array_equal(shown.draw(camera).images, here)
    assert shown.backend == "cpu"
    assert caplog.messages[1:] == ["the memory of the GPU ran out; views are drawn on the CPU from here"]


@pytest.mark.parametrize("antialiased", [False, True])
def test_a_view_on_a_device_is_the_fixed_view(scene: Gaussians, camera: Cameras, antialiased: bool) -> None:
    rng = np.random.default_rng(2)
    here = FixedView(scene, camera, antialiased=antialiased)
    there = DeviceView(GaussianTensors.from_gaussians(scene), camera, "reference", antialiased=antialiased)
    assert np.array_equal(here.ids, there.ids)
    assert np.array_equal(here.eye, there.eye)
    colors = rng.normal(size=(len(here), 3))
    np.testing.assert_allclose(there.image(colors), here.image(colors), atol=1e-4)
    by_image = rng.normal(size=(camera.height, camera.width, 3))
    np.testing.assert_allclose(there.by_colors(by_image), here.by_colors(by_image), atol=1e-3)


def test_backends_have_devices() -> None:
    assert [torch_device_of(name) for name in ("auto", "cpu", "cuda", "reference")] == [None, None, "cuda", "cpu"]


def test_parts_have_the_near_plane_of_the_whole() -> None:
    """A small scene has a nearer one: a part of this scene would show what the whole does not."""
    rng = np.random.default_rng(4)
    means = rng.uniform(-0.25, 0.25, (60, 3))
    means[:, 2] += 0.26
    means[0] = [0.0, 0.0, 0.008]
    g = Gaussians(
        means, np.tile([1.0, 0, 0, 0], (60, 1)), np.full((60, 3), 0.004), np.full(60, 0.8), rng.normal(size=(60, 1, 3))
    )
    camera = Cameras.look_at([[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]], up=(0, -1, 0), width=16, height=12)
    shown = DeviceScene(g, "reference")
    whole = shown.draw(camera).images
    shown.parts = 16
    np.testing.assert_allclose(shown.draw(camera).images, whole, atol=2e-4)


def test_the_backend_of_gsplat_draws_and_has_gradients(scene: Gaussians, camera: Cameras, monkeypatch: Patch) -> None:
    pretend_gpu(monkeypatch)
    assert choose_device("cuda") == choose_device("auto") == Device("cuda", "a pretended GPU")
    here = FixedView(scene, camera, antialiased=True)
    shown = DeviceScene(scene, "cuda")
    image = rasterize(scene, camera, background=(0.1, 0.2, 0.3), antialiased=True).images
    for parts in (1, 3):
        shown.parts = parts
        found = shown.draw(camera, background=(0.1, 0.2, 0.3), antialiased=True).images
        np.testing.assert_allclose(found, image, atol=3e-4)
    there = DeviceView(shown.tensors, camera, "cuda", antialiased=True)
    assert np.array_equal(here.ids, there.ids)
    by_image = np.random.default_rng(2).normal(size=(camera.height, camera.width, 3))
    np.testing.assert_allclose(there.by_colors(by_image), here.by_colors(by_image), atol=1e-3)
    drawn = rasterize(GaussianTensors.from_gaussians(scene, requires_grad=True), camera, backend="cuda")
    drawn.images.square().sum().backward()
    assert drawn.means2d.grad is not None
    assert float(drawn.means2d.grad.abs().sum()) > 0.0


@pytest.mark.skipif(bool(NO_CUDA), reason=NO_CUDA or "a GPU is here")
def test_a_gpu_draws_as_the_cpu_does(scene: Gaussians, camera: Cameras) -> None:
    assert choose_device("auto").name == "cuda"
    here = FixedView(scene, camera, antialiased=False)
    shown = DeviceScene(scene, "cuda")
    np.testing.assert_allclose(shown.draw(camera).images, rasterize(scene, camera).images, atol=5e-3)
    there = DeviceView(shown.tensors, camera, "cuda", antialiased=False)
    both = np.intersect1d(here.ids, there.ids)
    assert len(both) >= 0.99 * len(here)
    shown.parts = 3
    np.testing.assert_allclose(shown.draw(camera).images, rasterize(scene, camera).images, atol=5e-3)
