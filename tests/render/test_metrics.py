"""Image metrics: known answers, an independent slow SSIM, and what they say when something is missing."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gsvis.errors import BackendError
from gsvis.render import metrics_torch
from gsvis.render.metrics import flip, flip_map, lpips, psnr, ssim

METRICS = {"psnr": psnr, "ssim": ssim, "flip": flip, "lpips": lpips}


def pair(height: int = 24, width: int = 17, noise: float = 0.1, seed: int = 0) -> tuple[NDArray[Any], NDArray[Any]]:
    rng = np.random.default_rng(seed)
    ramp = np.linspace(0.1, 0.9, width)[None, :, None] * np.linspace(0.5, 1, height)[:, None, None]
    target = np.repeat(ramp, 3, axis=2) * [1.0, 0.8, 0.6]
    return np.clip(target + noise * rng.normal(size=target.shape), 0, 1), target


def slow_ssim(x: NDArray[Any], y: NDArray[Any], white: float, padding: str) -> float:
    """The definition, one window after the other, variances about the window's own means."""
    i = np.arange(11) - 5
    window = np.exp(-(i[:, None] ** 2 + i[None, :] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[:, :, None]
    if padding == "same":
        x, y = (np.pad(v, ((5, 5), (5, 5), (0, 0))) for v in (x, y))
    values = []
    for row in range(x.shape[0] - 10):
        for column in range(x.shape[1] - 10):
            a, b = (v[row : row + 11, column : column + 11] for v in (x, y))
            ma, mb = (window * a).sum((0, 1)), (window * b).sum((0, 1))
            va, vb = (window * (a - ma) ** 2).sum((0, 1)), (window * (b - mb) ** 2).sum((0, 1))
            vab = (window * (a - ma) * (b - mb)).sum((0, 1))
            c1, c2 = (0.01 * white) ** 2, (0.03 * white) ** 2
            values.append((2 * ma * mb + c1) * (2 * vab + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    return float(np.mean(values))


# ------------------------------------------------------------------------------------------------ known answers


def test_psnr_of_a_known_error() -> None:
    target = np.zeros((5, 4, 3))
    assert psnr(target + 0.1, target) == pytest.approx(20.0)
    assert psnr(255 * (target + 0.1), target, 255.0) == pytest.approx(20.0)
    assert psnr(target, target) == np.inf
    assert type(psnr(target + 0.1, target)) is float


@pytest.mark.parametrize("padding", ["valid", "same"])
@pytest.mark.parametrize("white", [1.0, 255.0])
def test_ssim_is_its_definition(padding: str, white: float) -> None:
    image, target = pair()
    slow = slow_ssim(white * image, white * target, white, padding)
    assert ssim(white * image, white * target, white, padding=padding) == pytest.approx(slow, abs=1e-12)
    single = ssim(torch.tensor(image).float(), torch.tensor(target).float(), padding=padding)
    assert single.dtype == torch.float32
    assert single.item() == pytest.approx(slow, abs=2e-5)


def test_ssim_of_equal_and_of_opposite_images() -> None:
    image, target = pair()
    assert ssim(target, target) == pytest.approx(1.0)
    assert ssim(target, image) == pytest.approx(ssim(image, target))
    board = (np.indices((16, 16)).sum(0) % 2)[..., None].repeat(3, axis=2).astype(float)
    assert ssim(board, 1 - board) < -0.9


def test_flip_of_equal_and_of_opposite_images() -> None:
    image, target = pair()
    white, black = np.ones((16, 16, 3)), np.zeros((16, 16, 3))
    assert flip(target, target) == 0.0
    assert flip(white, black) > 0.9
    assert 0 < flip(target + 0.4 * (image - target), target) < flip(image, target) < 1
    assert flip(3 * white, white) == 0.0  # a display clips both alike


def test_flip_sees_less_of_what_is_far_away() -> None:
    image, target = pair(40, 40)
    near, far = (flip(image, target, pixels_per_degree=p) for p in (20.0, 120.0))
    assert far < near


def test_the_map_of_flip_is_where_the_images_differ() -> None:
    _, target = pair(40, 40)
    image = target.copy()
    image[4:8, 30:34] = [1.0, 0.0, 0.0]
    errors = flip_map(image, target)
    assert errors.shape == (40, 40)
    row, column = np.unravel_index(errors.argmax(), errors.shape)
    assert 3 <= row <= 8
    assert 29 <= column <= 34
    assert errors[30:, :15].max() < 1e-6
    assert errors.mean() == pytest.approx(flip(image, target))


# ------------------------------------------------------------------------------------------- kinds of arguments


@pytest.mark.parametrize("metric", [psnr, ssim, flip])
def test_a_stack_gives_one_value_for_each_image(metric: Any) -> None:
    pairs = [pair(noise=n, seed=i) for i, n in enumerate((0.02, 0.1, 0.3))]
    images, targets = (np.stack(side) for side in zip(*pairs, strict=True))
    values = metric(images, targets)
    assert values.dtype == np.float64
    assert values.tolist() == pytest.approx([metric(a, b) for a, b in pairs])
    assert metric(images[:0], targets[:0]).shape == (0,)


@pytest.mark.parametrize("metric", [psnr, ssim, flip])
def test_tensors_give_tensors(metric: Any) -> None:
    image, target = pair()
    value = metric(torch.tensor(image), torch.tensor(target))
    assert value.shape == ()
    assert value.dtype == torch.float64
    assert value.item() == pytest.approx(metric(image, target))
    mixed = metric(torch.tensor(image).float(), target)
    assert mixed.dtype == torch.float32
    assert mixed.item() == pytest.approx(metric(image, target), rel=1e-4)
    read_only = target.copy()
    read_only.flags.writeable = False
    assert metric(image.astype(np.float32), read_only) == pytest.approx(metric(image, target), rel=1e-4)
    transposed = np.ascontiguousarray(image.transpose(2, 0, 1)).transpose(1, 2, 0)
    assert metric(transposed, target) == pytest.approx(metric(image, target))


@pytest.mark.parametrize("padding", ["valid", "same"])
def test_ssim_is_a_loss(padding: str) -> None:
    image, target = (torch.tensor(side[:12, :13]) for side in pair())

    def value(x: torch.Tensor) -> torch.Tensor:
        return ssim(x, target, padding=padding)

    assert torch.autograd.gradcheck(value, image.requires_grad_(), fast_mode=True)
    assert torch.autograd.gradcheck(lambda x: psnr(x, target), image)
    better = (image + 1e-3 * torch.autograd.grad(value(image), image)[0]).detach()
    assert value(better) > value(image)


def test_ssim_has_second_derivatives() -> None:
    image, target = (torch.tensor(side[:11, :12]) for side in pair())
    assert torch.autograd.gradgradcheck(lambda x: ssim(x, target), image.requires_grad_(), fast_mode=True)


def test_half_precision_is_taken_in_full() -> None:
    image, target = (torch.tensor(side).half() for side in pair())
    assert ssim(image, target).item() == pytest.approx(ssim(image.float(), target.float()).item())
    assert ssim(image, target).dtype == torch.float32


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("padding", ["valid", "same"])
def test_a_gpu_gives_the_same_ssim(padding: str) -> None:
    image, target = (torch.tensor(side) for side in pair())
    found = ssim(image.cuda(), target.cuda(), padding=padding)
    assert found.device.type == "cuda"
    assert found.item() == pytest.approx(ssim(image, target, padding=padding).item(), abs=1e-12)


# ---------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize("name", METRICS)
@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a, b: (a[..., :2], b), "image: expected shape"),
        (lambda a, b: (a, b[..., 0]), "target: expected shape"),
        (lambda a, b: (a, b[1:]), "target: expected the shape of image"),
        (lambda a, b: (a, b[None]), "target: expected the shape of image"),
        (lambda a, b: (a, b * np.nan), "target: expected finite values"),
        (lambda a, b: (a + np.inf, b), "image: expected finite values"),
        (lambda a, b: (a[:0], b[:0]), "image: expected at least one pixel"),
        (lambda a, b: ((255 * a).astype(np.uint8), b), "image: expected .*255"),
    ],
)
def test_bad_images_are_named(name: str, kind: Any, change: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        METRICS[name](*(kind(side) for side in change(*pair(40, 40))))


def test_bad_options_are_named() -> None:
    image, target = pair(10, 40)
    with pytest.raises(ValueError, match="data_range: expected a finite number > 0, got 0"):
        psnr(image, target, 0)
    with pytest.raises(ValueError, match="padding: expected one of 'valid', 'same'"):
        ssim(image, target, padding="reflect")
    with pytest.raises(ValueError, match="image: expected at least 11 x 11 pixels, got 40 x 10; padding='same'"):
        ssim(image, target)
    assert 0 < ssim(image, target, padding="same") < 1
    with pytest.raises(ValueError, match="pixels_per_degree: expected a finite number > 0"):
        flip(image, target, 0.0)
    with pytest.raises(ValueError, match="net: expected one of 'vgg', 'alex'"):
        lpips(image, target, net="squeeze")
    with pytest.raises(ValueError, match="image: expected at least 32 x 32 pixels, got 40 x 10"):
        lpips(image, target)


# ---------------------------------------------------------------------------------------------- what is missing


def test_flip_without_its_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(BackendError, match=r"flip: expected the package flip-evaluator.*gsvis\[metrics\]"):
        flip(*pair())


@pytest.mark.parametrize("name", ["lpips", "torchvision"])
def test_lpips_without_its_packages_says_what_to_install(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setitem(sys.modules, "lpips", ModuleType("lpips"))
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(BackendError, match=r"lpips: expected the packages lpips and torchvision.*gsvis\[metrics\]"):
        lpips(*pair(40, 40))


class SquaredError(torch.nn.Module):
    """In the place of LPIPS: takes (1, 3, H, W) images and gives (1, 1, 1, 1)."""

    def __init__(self, net: str, verbose: bool) -> None:
        super().__init__()
        assert not verbose
        self.net = net

    def forward(self, image: torch.Tensor, target: torch.Tensor, normalize: bool) -> torch.Tensor:
        assert normalize
        assert image.shape[:2] == (1, 3)
        return (image - target).square().mean().reshape(1, 1, 1, 1)


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_lpips_runs_only_where_its_weights_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, net: str) -> None:
    entry = SimpleNamespace(IMAGENET1K_V1=SimpleNamespace(url=f"https://example.org/models/{net}-0123.pth"))
    packages: dict[str, Any] = {name: ModuleType(name) for name in ("lpips", "torchvision", "torchvision.models")}
    packages["lpips"].LPIPS = SquaredError
    packages["torchvision"].models = packages["torchvision.models"]
    packages["torchvision.models"].VGG16_Weights = packages["torchvision.models"].AlexNet_Weights = entry
    for name, module in packages.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    metrics_torch._lpips_model.cache_clear()
    image, target = pair(40, 40)
    with pytest.raises(
        BackendError, match=rf"lpips: expected the weights of net '{net}' at .*{net}-0123.pth.*TORCH_HOME"
    ):
        lpips(image, target, net)
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / f"{net}-0123.pth").touch()
    expected = np.square(image - target).mean()
    assert lpips(image, target, net) == pytest.approx(expected, rel=1e-5)
    stack = lpips(torch.tensor(np.stack([image, target])), torch.tensor(np.stack([target, target])), net)
    assert stack.tolist() == pytest.approx([expected, 0.0], rel=1e-5)
    assert lpips(np.zeros((0, 40, 40, 3)), np.zeros((0, 40, 40, 3)), net).shape == (0,)
    metrics_torch._lpips_model.cache_clear()
