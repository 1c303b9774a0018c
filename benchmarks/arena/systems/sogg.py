"""Self-organizing Gaussian grids (SOGG): attributes in a square where neighbors are alike, compressed as images.

The first half of the budget trains as 3DGS. Then the faintest rows go until the rest is a square, rows are sorted into
it, and a further loss draws each row toward its neighbors; now and then they are sorted again. Attributes become
integers, and images of JPEG XL without loss. Nothing is shown until all images are there.

References:
    Morgenstern et al., "Compact 3D Scene Representation via Self-Organizing Gaussian Grids", ECCV 2024.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad, smooth_l1_loss

from arena.budget import GROWS, Allowance, Budget, BudgetTrainer
from arena.course import Course
from arena.files import load_arrays, save_arrays
from arena.grid import sort_to_grid
from arena.planes import decode_jpeg_xl, dequantize, encode_jpeg_xl, quantize
from arena.stages import Stages
from arena.systems.system import System, Training
from gsvis.errors import FormatError
from gsvis.progress import Progress
from gsvis.scene.gaussians import Gaussians
from gsvis.train.parameters import Parameters

__all__ = ["SYSTEMS", "decode", "encode"]

FILE = "scene.npz"

BITS = {"means": 16, "log_scales": 8, "quats": 8, "logit_opacities": 8, "sh0": 8, "shN": 5}
"""Bits of each attribute."""

_SORTED_BY = ("means", "log_scales", "logit_opacities", "sh0")
_SMOOTH = {"means": 1.0, "log_scales": 0.3, "quats": 0.3, "logit_opacities": 0.3, "sh0": 1.0, "shN": 0.3}
_WEIGHT = 0.3
_EVERY = 4  # steps between smoothness losses, which count so many times then
_SORTS = 5


class GridTrainer(BudgetTrainer):
    """The trainer, with rows in a square from the middle of the budget on."""

    def __init__(self, course: Course, budget: Budget) -> None:
        super().__init__(course, budget, penalty=self._roughness)
        self._sorted = 0
        self._side = 0
        self._spread: dict[str, Tensor] = {}

    def advance(self) -> float:
        """Sort if it is time, then take one step; return its loss without smoothness."""
        late = (self.budget.share - GROWS) / (1.0 - GROWS)
        if late > self._sorted / _SORTS:
            self.arrange()
            self._sorted += 1
        return super().advance()

    def arrange(self) -> None:
        """Drop the faintest rows until a square is left, and sort the others into it."""
        p = self.parameters
        with torch.no_grad():
            self._side = int(len(p) ** 0.5)
            opaque = torch.argsort(p.values["logit_opacities"], descending=True, stable=True)[: self._side**2]
            p.keep(torch.sort(opaque).values)
            self._spread = {
                name: v.detach().reshape(len(p), -1).std(dim=0, correction=0) + 1e-6
                for name, v in p.values.items()
                if v.numel()
            }
            rows = [p.values[name].reshape(len(p), -1) / self._spread[name] for name in _SORTED_BY]
            p.keep(torch.from_numpy(sort_to_grid(torch.cat(rows, dim=1).detach().numpy())))

    def _roughness(self, parameters: Parameters, step: int) -> Tensor:
        """Return the distance of rows from the mean of their neighbors, weighted by attribute."""
        if not self._side or step % _EVERY or len(parameters) != self._side**2:
            return torch.zeros((), requires_grad=True)
        total = torch.zeros(())
        for name, weight in _SMOOTH.items():
            if name not in self._spread:  # colors without higher degrees
                continue
            values = parameters.values[name].reshape(self._side, self._side, -1)
            planes = (values / self._spread[name]).permute(2, 0, 1)[None]
            with torch.no_grad():
                around = avg_pool2d(pad(planes, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
            total = total + weight * smooth_l1_loss(planes, around)
        return _EVERY * _WEIGHT * 0.01 * total


def encode(g: Gaussians) -> dict[str, NDArray[np.uint8 | np.float32]]:
    """Return a scene of a square number of rows as images: arrays of bytes, and the ends of their values.

    Raises:
        BackendError: If `imagecodecs` is not installed.
    """
    side = round(len(g) ** 0.5)
    out: dict[str, NDArray[np.uint8 | np.float32]] = {}
    for name, values in _raw(g).items():
        integers, ends = quantize(values, BITS[name])
        out[f"{name}_ends"] = ends
        kind = np.uint16 if BITS[name] > 8 else np.uint8
        for k in range(0, integers.shape[1], 3):
            image = integers[:, k : k + 3].astype(kind).reshape(side, side, -1)
            planes = [image] if image.shape[2] == 3 else [image[:, :, c] for c in range(image.shape[2])]
            for c, plane in enumerate(planes):
                out[f"{name}_{k + c:02d}"] = np.frombuffer(encode_jpeg_xl(plane), np.uint8)
    return out


def decode(arrays: dict[str, NDArray[np.uint8 | np.float32]]) -> Gaussians:
    """Return the scene of `encode`, as a client draws it.

    Raises:
        KeyError: If an attribute is missing.
        ValueError: If an image is damaged.
    """
    found: dict[str, NDArray[np.float32]] = {}
    for name, bits in BITS.items():
        ends = np.asarray(arrays[f"{name}_ends"], np.float32)
        planes = [
            decode_jpeg_xl(arrays[key].tobytes())
            for key in sorted(arrays)
            if key.startswith(f"{name}_") and key != f"{name}_ends"
        ]
        columns = [plane.reshape(plane.shape[0] * plane.shape[1], -1) for plane in planes]
        integers = np.concatenate(columns, axis=1) if columns else np.zeros((len(found["means"]), 0), np.uint8)
        found[name] = dequantize(integers, ends, bits)
    n = len(found["means"])
    return Gaussians(
        found["means"],
        found["quats"],
        np.exp(found["log_scales"]),
        1.0 / (1.0 + np.exp(-found["logit_opacities"][:, 0])),
        found["sh0"].reshape(n, 1, 3),
        found["shN"].reshape(n, -1, 3),
    )


def _raw(g: Gaussians) -> dict[str, NDArray[np.float32]]:
    """Return raw values (N, F) of each attribute; quaternions have a positive first number."""
    opacities = np.clip(g.opacities, 1e-6, 1.0 - 1e-6)
    quats = g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True)
    return {
        "means": g.means,
        "log_scales": np.log(g.scales),
        "quats": quats * np.where(quats[:, :1] < 0, -1.0, 1.0),
        "logit_opacities": np.log(opacities / (1.0 - opacities))[:, None],
        "sh0": g.sh0[:, 0],
        "shN": g.shN.reshape(len(g), -1),
    }


def _train(course: Course, allowance: Allowance, folder: Path, progress: Progress) -> None:
    encode_jpeg_xl(np.zeros((8, 8), np.uint8))  # say what is missing before the training
    trainer = GridTrainer(course, Budget(allowance))
    trainer.spend(progress)
    side = int(len(trainer.parameters) ** 0.5)
    if len(trainer.parameters) != side * side:
        trainer.arrange()
    save_arrays(folder / FILE, **encode(trainer.gaussians()))


def _open(course: Course, folder: Path) -> Stages:
    path = folder / FILE
    try:
        scene = decode(load_arrays(path))
    except (KeyError, ValueError) as error:
        raise FormatError(path, "", "images of all attributes", str(error), f"delete {folder} to train again") from None
    return Stages.at_once(path.stat().st_size, scene)


SYSTEMS = (
    System(
        "SOGG",
        Training("sogg", _train),
        _open,
        "Morgenstern et al., ECCV 2024",
        "sorted by halving and swaps of pairs instead of PLAS, five times; smoothness every fourth step over 3 x 3"
        " neighbors; bits are ours",
        "23.8 MB, 31.54 dB; 9.9 MB, 30.52 dB without SH",
    ),
)
