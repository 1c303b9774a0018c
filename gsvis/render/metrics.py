"""How far an image is from its target: PSNR, SSIM, FLIP, LPIPS.

Images are RGB, channels last, sRGB values where 0 is black and `data_range` (1 unless told otherwise) is white. One
image (H, W, 3) gives one value, a stack (C, H, W, 3) gives C. NumPy arrays give NumPy values or a float, torch tensors
give tensors on their device, differentiable in PSNR, SSIM and LPIPS.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torch.nn.functional import conv2d

from gsvis import _check
from gsvis.errors import BackendError
from gsvis.render._kernels.blur import blur

__all__ = ["flip", "flip_map", "lpips", "psnr", "ssim"]

Values = float | NDArray[np.float64]

_WINDOW = 11
_SIGMA = 1.5


@overload
def psnr(image: Tensor, target: Tensor, data_range: float = 1.0) -> Tensor: ...
@overload
def psnr(image: ArrayLike, target: ArrayLike, data_range: float = 1.0) -> Values: ...
def psnr(image: Any, target: Any, data_range: float = 1.0) -> Tensor | Values:
    """Peak signal-to-noise ratio in dB; infinite for equal images.

    Args:
        image: (H, W, 3) or (C, H, W, 3).
        target: Of the same shape.
        data_range: Value of white, > 0.

    Returns:
        One value for one image, C values for a stack.

    Raises:
        ValueError: If shapes differ or are wrong, a value is not finite or `data_range` is not positive.

    Examples:
        >>> round(psnr(np.full((4, 4, 3), 0.6), np.full((4, 4, 3), 0.5)), 6)
        20.0
    """
    a, b, like_input = _pair(image, target)
    error = (a - b).square().flatten(1).mean(dim=1)
    return like_input(10.0 * torch.log10(_white(data_range) ** 2 / error))


@overload
def ssim(image: Tensor, target: Tensor, data_range: float = 1.0, *, padding: str = "valid") -> Tensor: ...
@overload
def ssim(image: ArrayLike, target: ArrayLike, data_range: float = 1.0, *, padding: str = "valid") -> Values: ...
def ssim(image: Any, target: Any, data_range: float = 1.0, *, padding: str = "valid") -> Tensor | Values:
    """Structural similarity, mean over pixels and channels: 1 for equal images.

    Windows are Gaussian, 11 x 11 with a standard deviation of 1.5 pixels; K1 = 0.01, K2 = 0.03.

    Args:
        image: (H, W, 3) or (C, H, W, 3).
        target: Of the same shape.
        data_range: Value of white, > 0.
        padding: "valid" takes only windows inside the image, as in the paper; "same" takes one window a pixel over
            black surroundings, as in the training loss of 3DGS.

    Returns:
        One value for one image, C values for a stack.

    Raises:
        ValueError: If shapes differ or are wrong, a value is not finite, `data_range` is not positive, or no window
            fits into the image.

    References:
        Wang et al., "Image quality assessment: from error visibility to structural similarity", TIP 2004.
    """
    _check.one_of("padding", padding, ("valid", "same"))
    a, b, like_input = _pair(image, target)
    if padding == "valid" and min(a.shape[1:3]) < _WINDOW:
        raise ValueError(
            f"image: expected at least {_WINDOW} x {_WINDOW} pixels, got {a.shape[2]} x {a.shape[1]}; "
            "padding='same' takes any size"
        )
    white = _white(data_range)
    c1, c2 = (0.01 * white) ** 2, (0.03 * white) ** 2
    count, height, width, _ = a.shape
    x, y = (v.permute(0, 3, 1, 2).reshape(3 * count, height, width) for v in (a, b))
    means = _blur(torch.cat([x, y, x * x, y * y, x * y]), _WINDOW // 2 if padding == "same" else 0)
    mx, my, mxx, myy, mxy = means.chunk(5)
    luminance = (2.0 * mx * my + c1) / (mx * mx + my * my + c1)
    structure = (2.0 * (mxy - mx * my) + c2) / ((mxx - mx * mx) + (myy - my * my) + c2)
    return like_input((luminance * structure).mean(dim=(1, 2)).reshape(count, 3).mean(dim=1))


@overload
def flip(image: Tensor, target: Tensor, pixels_per_degree: float = 67.0) -> Tensor: ...
@overload
def flip(image: ArrayLike, target: ArrayLike, pixels_per_degree: float = 67.0) -> Values: ...
def flip(image: Any, target: Any, pixels_per_degree: float = 67.0) -> Tensor | Values:
    """Mean of the FLIP error map: what an observer who flips between two images sees, 0 to 1.

    Args:
        image: (H, W, 3) or (C, H, W, 3), sRGB; clipped to [0, 1] as a display does.
        target: Of the same shape.
        pixels_per_degree: Of the observer's field of view; 67 is a 0.7 m wide 4K display seen from 0.7 m.

    Returns:
        One value for one image, C values for a stack. Without gradient.

    Raises:
        ValueError: If shapes differ or are wrong, a value is not finite or `pixels_per_degree` is not positive.
        BackendError: If the package flip-evaluator is absent.

    References:
        Andersson et al., "FLIP: a difference evaluator for alternating images", HPG 2020.
    """
    a, b, like_input = _pair(image, target)
    return like_input(_flip_maps(a, b, pixels_per_degree).mean(dim=(1, 2)))


@overload
def flip_map(image: Tensor, target: Tensor, pixels_per_degree: float = 67.0) -> Tensor: ...
@overload
def flip_map(image: ArrayLike, target: ArrayLike, pixels_per_degree: float = 67.0) -> NDArray[np.float64]: ...
def flip_map(image: Any, target: Any, pixels_per_degree: float = 67.0) -> Tensor | Values:
    """(H, W) or (C, H, W) FLIP error of each pixel, 0 to 1. Arguments and errors as for `flip`."""
    a, b, like_input = _pair(image, target)
    return like_input(_flip_maps(a, b, pixels_per_degree))


@overload
def lpips(image: Tensor, target: Tensor, net: str = "vgg") -> Tensor: ...
@overload
def lpips(image: ArrayLike, target: ArrayLike, net: str = "vgg") -> Values: ...
def lpips(image: Any, target: Any, net: str = "vgg") -> Tensor | Values:
    """Learned perceptual distance: 0 for equal images.

    Nothing is downloaded: the backbone's ImageNet weights must lie where torch keeps them.

    Args:
        image: (H, W, 3) or (C, H, W, 3), values in [0, 1]; at least 32 x 32 pixels.
        target: Of the same shape.
        net: "vgg", the one papers on radiance fields report, or "alex", its authors' choice for comparing images.

    Returns:
        One value for one image, C values for a stack.

    Raises:
        ValueError: If shapes differ or are wrong, a value is not finite or `net` is unknown.
        BackendError: If the package lpips or the weights are absent.

    References:
        Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric", CVPR 2018.
    """
    _check.one_of("net", net, ("vgg", "alex"))
    a, b, like_input = _pair(image, target)
    if min(a.shape[1:3]) < 32:
        raise ValueError(f"image: expected at least 32 x 32 pixels, got {a.shape[2]} x {a.shape[1]}")
    x, y = (v.float().permute(0, 3, 1, 2) for v in (a, b))
    model = _lpips_model(net, _lpips_weights(net), x.device)
    distances = [model(i[None], j[None], normalize=True).reshape(1) for i, j in zip(x, y, strict=True)]
    return like_input(torch.cat([x.new_zeros(0), *distances]))


def _pair(image: Any, target: Any) -> tuple[Tensor, Tensor, Callable[[Tensor], Tensor | Values]]:
    """Both as checked (C, H, W, 3) tensors of one float type, and what turns (C, ...) values into the caller's kind."""
    tensors = isinstance(image, Tensor) or isinstance(target, Tensor)
    a, b = _stack("image", image), _stack("target", target)
    if a.shape != b.shape or np.ndim(image) != np.ndim(target):
        raise ValueError(
            f"target: expected the shape of image, {tuple(np.shape(image))}, got {tuple(np.shape(target))}"
        )
    if isinstance(image, Tensor):
        b = b.to(a)
    elif isinstance(target, Tensor):
        a = a.to(b)
    single = np.ndim(image) == 3

    def like_input(values: Tensor) -> Tensor | Values:
        values = values[0] if single else values
        if tensors:
            return values
        array: NDArray[np.float64] = values.detach().double().cpu().numpy()
        return array if array.ndim else float(array)

    return a, b, like_input


def _stack(name: str, value: Any) -> Tensor:
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
    if 0 in tensor.shape[-3:]:
        raise ValueError(f"{name}: expected at least one pixel, got shape {tuple(tensor.shape)}")
    return tensor if tensor.ndim == 4 else tensor[None]


def _white(data_range: float) -> float:
    if not 0.0 < data_range < math.inf:
        raise ValueError(f"data_range: expected a finite number > 0, got {data_range!r}")
    return float(data_range)


def _blur(planes: Tensor, margin: int) -> Tensor:
    """(B, H, W) with `margin` zeros around, under the Gaussian window; only whole windows."""
    offsets = torch.arange(_WINDOW, dtype=torch.float64) - _WINDOW // 2
    window = torch.exp(-0.5 * (offsets / _SIGMA) ** 2)
    window = (window / window.sum()).to(planes)
    if planes.device.type == "cpu":
        blurred: Tensor = _Blur.apply(planes, window, margin)  # type: ignore[no-untyped-call]
        return blurred
    rows = conv2d(planes[:, None], window.reshape(1, 1, -1, 1), padding=(margin, 0))
    return conv2d(rows, window.reshape(1, 1, 1, -1), padding=(0, margin))[:, 0]


class _Blur(torch.autograd.Function):
    """The kernel, and its adjoint: the same with the rest of the margin, as the window is symmetric."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, window: Tensor, margin: int) -> Tensor:
        ctx.window, ctx.margin = window, margin
        less = 2 * margin - len(window) + 1
        count, height, width = planes.shape
        out = planes.new_empty(count, height + less, width + less)
        blur(planes.detach().contiguous().numpy(), window.numpy(), margin, out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        rest = len(ctx.window) - 1 - ctx.margin
        return _Blur.apply(grads[0], ctx.window, rest), None, None  # type: ignore[no-untyped-call]


def _flip_maps(image: Tensor, target: Tensor, pixels_per_degree: float) -> Tensor:
    if not 0.0 < pixels_per_degree < math.inf:
        raise ValueError(f"pixels_per_degree: expected a finite number > 0, got {pixels_per_degree!r}")
    try:
        from flip_evaluator import evaluate
    except ImportError as error:
        raise BackendError(
            f"flip: expected the package flip-evaluator, got '{error}'; pip install 'gsvis[metrics]'"
        ) from error
    a, b = (v.detach().clamp(0.0, 1.0).float().cpu().contiguous().numpy() for v in (image, target))
    maps = [
        evaluate(
            reference,
            test,
            "LDR",
            inputsRGB=True,
            applyMagma=False,
            computeMeanError=False,
            parameters={"ppd": float(pixels_per_degree)},
        )[0]
        for test, reference in zip(a, b, strict=True)
    ]
    return torch.tensor(np.stack(maps)[..., 0] if maps else np.zeros(a.shape[:3])).to(image)


def _lpips_weights(net: str) -> Path:
    """Where torch keeps the backbone's weights, if they are there."""
    try:
        import lpips  # noqa: F401
        from torchvision import models
    except (ImportError, RuntimeError) as error:  # a torchvision built for another torch raises the second
        raise BackendError(
            f"lpips: expected the packages lpips and torchvision, got '{error}'; pip install 'gsvis[metrics]', "
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
    """The network, frozen; kept because reading its weights takes longer than a comparison."""
    import lpips

    with warnings.catch_warnings():  # lpips asks torchvision in the words of an older version
        warnings.simplefilter("ignore", UserWarning)
        return lpips.LPIPS(net=net, verbose=False).eval().requires_grad_(False).to(device)
