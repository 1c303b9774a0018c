"""Image metrics of torch tensors, on their device; PSNR, SSIM and LPIPS are differentiable.

`gsvis.render.metrics` documents them and does the same for arrays.
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from gsvis import _check
from gsvis._extras import remedy_of
from gsvis.errors import BackendError
from gsvis.render._kernels.blur import blur
from gsvis.render.metrics_numpy import (
    WINDOW,
    check_pair,
    check_pixels,
    check_white,
    check_window,
    flip_maps,
    gaussian_window,
)

__all__ = ["flip_map_torch", "lpips_torch", "psnr_torch", "ssim_torch"]


def psnr_torch(image: Any, target: Any, data_range: float) -> Tensor:
    """Return PSNR in dB: a scalar for one image, (C,) for a stack."""
    a, b = _pair(image, target)
    error = (a - b).square().flatten(1).mean(dim=1)
    return _unstack(image, 10.0 * torch.log10(check_white(data_range) ** 2 / error))


def ssim_torch(image: Any, target: Any, data_range: float, padding: str) -> Tensor:
    """Return SSIM: a scalar for one image, (C,) for a stack."""
    a, b = _pair(image, target)
    check_window(a.shape, padding)
    white = check_white(data_range)
    c1 = (0.01 * white) ** 2
    c2 = (0.03 * white) ** 2
    count, height, width, _ = a.shape
    x, y = (v.permute(0, 3, 1, 2).reshape(3 * count, height, width) for v in (a, b))
    means = _blur(torch.cat([x, y, x * x, y * y, x * y]), WINDOW // 2 if padding == "same" else 0)
    mx, my, mxx, myy, mxy = means.chunk(5)
    luminance = (2.0 * mx * my + c1) / (mx * mx + my * my + c1)
    structure = (2.0 * (mxy - mx * my) + c2) / ((mxx - mx * mx) + (myy - my * my) + c2)
    return _unstack(image, (luminance * structure).mean(dim=(1, 2)).reshape(count, 3).mean(dim=1))


def flip_map_torch(image: Any, target: Any, pixels_per_degree: float) -> Tensor:
    """Return the (H, W) or (C, H, W) FLIP error of each pixel, without gradient."""
    a, b = _pair(image, target)
    maps = flip_maps(_check.plain(a.detach()), _check.plain(b.detach()), pixels_per_degree)
    return _unstack(image, torch.from_numpy(maps).to(a))


def lpips_torch(image: Any, target: Any, net: str) -> Tensor:
    """Return LPIPS: a scalar for one image, (C,) for a stack."""
    a, b = _pair(image, target)
    if min(a.shape[1:3]) < 32:
        raise ValueError(f"image: expected at least 32 x 32 pixels, got {a.shape[2]} x {a.shape[1]}")
    x, y = (v.float().permute(0, 3, 1, 2) for v in (a, b))
    model = _lpips_model(net, _lpips_weights(net), x.device)
    distances = [model(i[None], j[None], normalize=True).reshape(1) for i, j in zip(x, y, strict=True)]
    return _unstack(image, torch.cat([x.new_zeros(0), *distances]))


def _pair(image: Any, target: Any) -> tuple[Tensor, Tensor]:
    """Return both images as checked (C, H, W, 3) tensors of one float type."""
    a = _stack("image", image)
    b = _stack("target", target)
    check_pair(tuple(a.shape), tuple(b.shape), image, target)
    if isinstance(image, Tensor):
        b = b.to(a)
    elif isinstance(target, Tensor):
        a = a.to(b)
    return a, b


def _unstack(image: Any, values: Tensor) -> Tensor:
    return values[0] if np.ndim(image) == 3 else values


def _stack(name: str, value: Any) -> Tensor:
    """Return an image or a stack as a checked (C, H, W, 3) tensor."""
    shape: tuple[int | str, ...] = ("H", "W", 3) if np.ndim(value) == 3 else ("C", "H", "W", 3)
    if isinstance(value, Tensor):
        if value.ndim != len(shape) or value.shape[-1] != 3:
            raise ValueError(f"{name}: expected shape (H, W, 3) or (C, H, W, 3), got {tuple(value.shape)}")
        if not value.is_floating_point():
            raise ValueError(f"{name}: expected a float tensor, got {value.dtype}; divide bytes by 255")
        if not bool(torch.isfinite(value.detach()).all()):
            raise ValueError(f"{name}: expected finite values, got NaN or infinity")
        tensor = value.float() if value.dtype in (torch.float16, torch.bfloat16) else value
    else:
        if np.asarray(value).dtype == np.uint8:
            raise ValueError(f"{name}: expected floats, got bytes; divide them by 255")
        tensor = torch.tensor(_check.floats(name, value, shape, np.float64))
    check_pixels(name, tuple(tensor.shape))
    return tensor if tensor.ndim == 4 else tensor[None]


def _blur(planes: Tensor, margin: int) -> Tensor:
    """Return (B, H, W) planes, padded by `margin` zeros and blurred with the Gaussian window; only whole windows."""
    window = torch.from_numpy(gaussian_window()).to(planes)
    if planes.device.type == "cpu":
        blurred: Tensor = _Blur.apply(planes, window, margin)  # type: ignore[no-untyped-call]
        return blurred
    rows = conv2d(planes[:, None], window.reshape(1, 1, -1, 1), padding=(margin, 0))
    return conv2d(rows, window.reshape(1, 1, 1, -1), padding=(0, margin))[:, 0]


class _Blur(torch.autograd.Function):
    """Blur differentiably. The window is symmetric, so the adjoint is a blur with the remaining margin."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, window: Tensor, margin: int) -> Tensor:
        """Return the blurred planes; see the kernel `blur`."""
        ctx.window = window
        ctx.margin = margin
        less = 2 * margin - len(window) + 1
        count, height, width = planes.shape
        out = planes.new_empty(count, height + less, width + less)
        blur(planes.detach().contiguous().numpy(), window.numpy(), margin, out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradient by the planes."""
        rest = len(ctx.window) - 1 - ctx.margin
        return _Blur.apply(grads[0], ctx.window, rest), None, None  # type: ignore[no-untyped-call]


def _lpips_weights(net: str) -> Path:
    """Return the path where torch keeps the backbone's weights.

    Raises:
        BackendError: If a package or the file is missing.
    """
    try:
        import lpips  # noqa: F401
        from torchvision import models
    except (ImportError, RuntimeError) as error:  # a torchvision built for another torch raises the second
        raise BackendError(
            f"lpips: expected the packages lpips and torchvision, got '{error}'; {remedy_of('lpips')}, "
            "with torchvision and torch from one index"
        ) from error
    weights = models.VGG16_Weights if net == "vgg" else models.AlexNet_Weights
    url = weights.IMAGENET1K_V1.url
    path = Path(torch.hub.get_dir()) / "checkpoints" / Path(url).name
    if not path.is_file():
        raise BackendError(
            f"lpips: expected the weights of net {net!r} at {path}, got no such file; put {url} there, "
            "or set TORCH_HOME to a folder that has it"
        )
    return path


@lru_cache(maxsize=2)
def _lpips_model(net: str, weights: Path, device: torch.device) -> Any:
    """Return the frozen network. It is cached, because reading its weights takes longer than a comparison."""
    import lpips

    with warnings.catch_warnings():  # lpips calls torchvision with deprecated arguments
        warnings.simplefilter("ignore", UserWarning)
        return lpips.LPIPS(net=net, verbose=False).eval().requires_grad_(False).to(device)
