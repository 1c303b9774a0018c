"""Compressed-3D: codebooks that spare what images are sensitive to, fine-tuning while quantized, DEFLATE.

Starts from half of a training as 3DGS. How much images change with each color and each shape says how much it weighs in
a codebook; the most sensitive keep values of their own. The other half of the budget trains all values, rounded to the
integers that are sent. Integers in Morton order are deflated. Nothing is shown until the file is complete.

References:
    Niedermayr et al., "Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis", CVPR 2024.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arena.budget import Allowance, Budget, descend
from arena.codebooks import fake_quantize, kmeans, nearest
from arena.course import Course
from arena.files import load_arrays, save_arrays
from arena.planes import dequantize, quantize
from arena.stages import Stages
from arena.systems.gaussians import HALF, HALVES, SCENE
from arena.systems.system import System, Training
from gsvis.errors import FormatError
from gsvis.io import load_scene
from gsvis.progress import Progress
from gsvis.render import GaussianTensors, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians, quats_from_rotations, rotations_from_quats
from gsvis.scene.morton import morton_order

__all__ = ["SYSTEMS", "Compressed", "compress"]

FILE = "scene.npz"

_CODES = 4096
_OWN = 0.05  # share of Gaussians, the most sensitive, that keep a color or a shape of their own
_VIEWS = 40  # views that sensitivity is measured in
_RATES = {"means": 2e-5, "logit_opacities": 1e-2, "log_sizes": 1e-3, "colors": 5e-4, "scales": 1e-3, "quats": 2e-4}


@dataclass(eq=False)
class Compressed:
    """A scene as codebooks and indices.

    Attributes:
        values: Raw tensors that training changes: means (N, 3), logit_opacities (N, 1), log_sizes (N, 1) the length
            of the scales, colors (P, 48) and the shapes of Q codes, scales (Q, 3) of length 1 and quats (Q, 4).
        color_of: (N,) code of each Gaussian's color.
        shape_of: (N,) code of its shape.
    """

    values: dict[str, Tensor]
    color_of: Tensor
    shape_of: Tensor

    def draw(self, camera: Cameras) -> Tensor:
        """Return the image (H, W, 3) of the rounded values."""
        v = self.values
        half = v["means"].half().float().detach() - v["means"].detach()
        q = {name: fake_quantize(v[name]) for name in v if name != "means"}
        colors = q["colors"][self.color_of].reshape(len(self.color_of), -1, 3)
        scales = q["log_sizes"].exp() * q["scales"].clamp(min=1e-4)[self.shape_of]
        opacities = q["logit_opacities"][:, 0].sigmoid()
        scene = GaussianTensors(
            v["means"] + half, q["quats"][self.shape_of], scales, opacities, colors[:, :1], colors[:, 1:].contiguous()
        )
        return rasterize(scene, camera).images[0]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what is sent: integers, their ends, and indices, in Morton order."""
        means = self.values["means"].detach().numpy()
        order = morton_order(means)
        out: dict[str, NDArray[Any]] = {"means": means[order].astype(np.float16)}
        for name, value in self.values.items():
            if name == "means":
                continue
            rows = value.detach().numpy()
            integers, out[f"{name}_ends"] = quantize(rows[order] if len(rows) == len(order) else rows, 8)
            out[name] = integers.astype(np.uint8)
        out["color_of"] = _narrow(self.color_of.numpy()[order])
        out["shape_of"] = _narrow(self.shape_of.numpy()[order])
        return out


def decode(arrays: dict[str, NDArray[Any]]) -> Gaussians:
    """Return the scene of `Compressed.arrays`, as a client draws it.

    Raises:
        KeyError: If an array is missing.
        IndexError: If a code is beyond its codebook.
    """
    names = ("logit_opacities", "log_sizes", "colors", "scales", "quats")
    v = {name: dequantize(arrays[name], arrays[f"{name}_ends"], 8) for name in names}
    colors = v["colors"][arrays["color_of"]].reshape(len(arrays["color_of"]), -1, 3)
    scales = np.exp(v["log_sizes"]) * np.maximum(v["scales"], 1e-4)[arrays["shape_of"]]
    opacities = 1.0 / (1.0 + np.exp(-v["logit_opacities"][:, 0]))
    quats = v["quats"][arrays["shape_of"]]
    return Gaussians(arrays["means"].astype(np.float32), quats, scales, opacities, colors[:, :1], colors[:, 1:])


def compress(g: Gaussians, course: Course, codes: int = _CODES) -> Compressed:
    """Return a scene with codebooks of colors and shapes, before fine-tuning.

    Args:
        g: N Gaussians of SH degree 3, or less.
        course: Whose training views say what images are sensitive to.
        codes: Codes of each codebook.
    """
    by_color, by_shape = _sensitivity(g, course)
    colors = torch.from_numpy(np.concatenate([g.sh0, g.shN], axis=1).reshape(len(g), -1))
    size = np.linalg.norm(g.scales, axis=1, keepdims=True)
    rotations = rotations_from_quats(g.quats)
    covariances = np.einsum("nij,nj,nkj->nik", rotations, (g.scales / size) ** 2, rotations).astype(np.float32)
    rows, columns = np.triu_indices(3)
    upper = torch.from_numpy(covariances[:, rows, columns])
    color_codes, color_of = _codebook(colors, by_color, codes)
    shape_codes, shape_of = _codebook(upper, by_shape, codes)
    scales, quats = _shapes(shape_codes.numpy())
    opacities = np.clip(g.opacities, 1e-6, 1 - 1e-6)
    raw = {
        "means": torch.tensor(g.means),
        "logit_opacities": torch.from_numpy(np.log(opacities / (1 - opacities))[:, None].astype(np.float32)),
        "log_sizes": torch.from_numpy(np.log(size).astype(np.float32)),
        "colors": color_codes,
        "scales": torch.from_numpy(scales),
        "quats": torch.from_numpy(quats),
    }
    return Compressed({name: value.requires_grad_() for name, value in raw.items()}, color_of, shape_of)


def _sensitivity(g: Gaussians, course: Course) -> tuple[Tensor, Tensor]:
    """Return (N,) for colors and (N,) for shapes: the largest change of the images' sum by one of their values."""
    scene = GaussianTensors.from_gaussians(g, requires_grad=True)
    views = np.unique(np.linspace(0, len(course.views) - 1, _VIEWS).astype(int))
    for view in views.tolist():
        rasterize(scene, course.views.cameras[view]).images.sum().backward()  # type: ignore[no-untyped-call]
    assert scene.sh0.grad is not None
    assert scene.scales.grad is not None
    by_color = scene.sh0.grad.abs().amax(dim=(1, 2))
    by_shape = (scene.scales.grad * scene.scales).abs().amax(dim=1).detach()
    return by_color + 1e-9, by_shape + 1e-9


def _codebook(rows: Tensor, weights: Tensor, codes: int) -> tuple[Tensor, Tensor]:
    """Return codes (P, F) and the code of each row; the most sensitive rows are codes of their own."""
    own = torch.argsort(weights, descending=True)[: int(_OWN * len(rows))]
    centers = kmeans(rows, weights / weights.mean(), codes)
    of = nearest(rows, centers)
    of[own] = len(centers) + torch.arange(len(own))
    used, of = torch.unique(of, return_inverse=True)
    return torch.cat([centers, rows[own]])[used].clone(), of


def _shapes(upper: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return scales (Q, 3) and quaternions (Q, 4) of covariances, given by their upper triangles (Q, 6)."""
    full = np.zeros((len(upper), 3, 3))
    rows, columns = np.triu_indices(3)
    full[:, rows, columns] = upper
    full[:, columns, rows] = upper
    values, axes = np.linalg.eigh(full)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    scales = np.sqrt(np.maximum(values, 1e-8))
    return scales.astype(np.float32), quats_from_rotations(axes).astype(np.float32)


def _narrow(codes: NDArray[np.int64]) -> NDArray[np.unsignedinteger[Any]]:
    """Return codes in two bytes where they fit."""
    return codes.astype(np.uint16 if codes.max(initial=0) < 65_536 else np.uint32)


def _train(course: Course, allowance: Allowance, folder: Path, progress: Progress) -> None:
    budget = Budget(allowance, 1.0 - HALVES)
    scene = compress(load_scene(folder.parent / HALF.name / SCENE), course)
    nothing = torch.zeros(())
    rates = {scene.values[name]: rate for name, rate in _RATES.items()}
    descend(course, budget, lambda camera: (scene.draw(camera), nothing), rates, progress=progress)
    save_arrays(folder / FILE, **scene.arrays())


def _open(course: Course, folder: Path) -> Stages:
    path = folder / FILE
    try:
        scene = decode(load_arrays(path))
    except (KeyError, IndexError, ValueError) as error:
        raise FormatError(path, "", "codebooks and indices", str(error), f"delete {folder} to train again") from None
    return Stages.at_once(path.stat().st_size, scene)


SYSTEMS = (
    System(
        "Compressed-3D",
        Training("compressed3d", _train, HALF),
        _open,
        "Niedermayr et al., CVPR 2024",
        "3DGS for half of the budget, fine-tuning for the other half; sensitivity in 40 views; the most sensitive 5%"
        " keep their own values instead of those above a threshold",
        "none found for bonsai; mean of nine scenes 30.2 MB, 26.98 dB (3DGS.zip)",
    ),
)
