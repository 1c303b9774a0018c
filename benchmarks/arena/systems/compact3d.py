"""Compact-3D: a mask that leaves out Gaussians, shapes by residual codebooks, colors by a hash grid and a network.

Starts from half of a training as 3DGS. The other half of the budget trains a mask of each Gaussian, its opacity, the
codebooks of scales and rotations in several stages, and a hash grid with a network for all colors. Sent are the
network, the hash grid and the codebooks, which any color needs, then Gaussians in Morton order, which are shown as they
arrive.

References:
    Lee et al., "Compact 3D Gaussian Representation for Radiance Field", CVPR 2024.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import normalize

from arena.bags import sum_rows
from arena.budget import Allowance, Budget, descend
from arena.codebooks import fake_quantize, kmeans, nearest
from arena.course import Course
from arena.files import deflated, load_arrays, save_arrays
from arena.hash_grid import HashColors
from arena.planes import dequantize, quantize
from arena.stages import PARTS, Stages
from arena.systems.gaussians import HALF, HALVES, SCENE
from arena.systems.system import System, Training
from gsvis.errors import FormatError
from gsvis.io import load_scene
from gsvis.progress import Progress
from gsvis.render import GaussianTensors, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.morton import morton_order

__all__ = ["SYSTEMS", "Compact", "residual_codes", "sum_codes"]

FILE = "scene.npz"

_STAGES = 6
_CODES = 64
_MASK_WEIGHT = 5e-4
_MASKED = 0.01  # sigmoid of a mask below which a Gaussian is left out
_SEEN = 1.2
_FIRST = ("network", "tables", "scales", "quats")
"""Arrays that any Gaussian needs to be drawn in color."""


class Compact(nn.Module):
    """N Gaussians of which a mask leaves some out.

    Args:
        values: means (N, 3), logit_opacities (N, 1), masks (N, 1), and the codebooks scales and quats
            (stages, codes, 3 or 4), the first of logarithms.
        codes: Codes of scales and quats, (N, stages) each.
        colors: Colors of places and directions.
    """

    def __init__(self, values: dict[str, Tensor], codes: dict[str, Tensor], colors: HashColors) -> None:
        super().__init__()
        self.values = nn.ParameterDict({name: nn.Parameter(value) for name, value in values.items()})
        self.codes = codes
        self.colors = colors
        self.corners = colors.corners(values["means"])

    @classmethod
    def from_gaussians(cls, g: Gaussians) -> Compact:
        """Return a scene before training; colors are learned from nothing."""
        opacities = np.clip(g.opacities, 1e-6, 1.0 - 1e-6)
        quats = g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True)
        shapes = {
            "scales": torch.from_numpy(np.log(g.scales)),
            "quats": torch.from_numpy(quats * np.where(quats[:, :1] < 0, -1.0, 1.0).astype(np.float32)),
        }
        values = {
            "means": torch.tensor(g.means),
            "logit_opacities": torch.from_numpy(np.log(opacities / (1.0 - opacities)).astype(np.float32))[:, None],
            "masks": torch.full((len(g), 1), 2.0),
        }
        codes = {}
        for name, rows in shapes.items():
            values[name], codes[name] = residual_codes(rows)
        middle = torch.from_numpy(np.median(g.means, axis=0).astype(np.float32))
        size = float(np.quantile(np.linalg.norm(g.means - middle.numpy(), axis=1), 0.5))
        return cls(values, codes, HashColors(middle, size))

    def rates(self) -> dict[Tensor, float]:
        """Return the learning rate of each tensor."""
        rates = {"logit_opacities": 1e-2, "masks": 1e-2, "scales": 1e-3, "quats": 5e-4}
        found: dict[Tensor, float] = {self.values[name]: rate for name, rate in rates.items()}
        found |= dict.fromkeys(self.colors.network.parameters(), 5e-3)
        return found | {self.colors.tables: 2e-2}

    def draw(self, camera: Cameras) -> tuple[Tensor, Tensor]:
        """Return the image (H, W, 3), and the loss of the masks."""
        v = self.values
        soft = v["masks"][:, 0].sigmoid()
        mask = soft - soft.detach() + (soft.detach() > _MASKED).float()
        rows = self._rows(camera, mask.detach())
        some = {name: sum_codes(v[name], code[rows]) for name, code in self.codes.items()}
        means = v["means"][rows]
        opacities = fake_quantize(v["logit_opacities"])[rows, 0].sigmoid() * mask[rows]
        black = means.new_zeros(len(rows), 1, 3)
        scales = some["scales"].exp() * mask[rows, None]
        scene = GaussianTensors(means, some["quats"], scales.clamp(min=1e-8), opacities, black, black[:, :0])
        directions = normalize(means.detach() - torch.tensor(camera.viewpoints[0]).float(), dim=1)
        entries, weights = (part[:, rows] for part in self.corners)
        image = rasterize(scene, camera, colors=self.colors(entries, weights, directions)).images[0]
        return image, _MASK_WEIGHT * soft.mean()

    def first(self, count: int) -> Compact:
        """Return the first Gaussians, with the same codebooks and colors."""
        each = ("means", "logit_opacities", "masks")
        values = {name: v.detach()[:count] if name in each else v.detach() for name, v in self.values.items()}
        return Compact(values, {name: code[:count] for name, code in self.codes.items()}, self.colors)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what is sent, Gaussians that the mask keeps in Morton order."""
        keep = np.flatnonzero(self.values["masks"].detach()[:, 0].sigmoid().numpy() > _MASKED)
        means = self.values["means"].detach().numpy()[keep]
        order = keep[morton_order(means)]
        out: dict[str, NDArray[Any]] = {"means": self.values["means"].detach().numpy()[order].astype(np.float16)}
        opacities = self.values["logit_opacities"].detach().numpy()
        integers, out["ends"] = quantize(opacities, 8)
        out["logit_opacities"] = integers[order].astype(np.uint8)
        for name, code in self.codes.items():
            out[f"{name}_codes"] = code.numpy()[order].astype(np.uint8)
            out[name] = self.values[name].detach().numpy().astype(np.float16)
        tables, out["table_ends"] = quantize(self.colors.tables.detach().numpy().reshape(-1, 1), 8)
        out["tables"] = tables.astype(np.uint8)
        vector = nn.utils.parameters_to_vector(self.colors.network.parameters())
        out["network"] = vector.detach().numpy().astype(np.float16)
        out["frame"] = np.array([*self.colors.middle.tolist(), self.colors.size], np.float32)
        return out

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> Compact:
        """Return the scene of `arrays`, as a client draws it.

        Raises:
            KeyError: If an array is missing.
            RuntimeError: If the tables have another size.
        """
        frame = arrays["frame"]
        colors = HashColors(torch.tensor(frame[:3]), float(frame[3]))
        tables = dequantize(arrays["tables"], arrays["table_ends"], 8)
        with torch.no_grad():
            colors.tables.copy_(torch.from_numpy(tables.reshape(colors.tables.shape)))
        nn.utils.vector_to_parameters(
            torch.from_numpy(arrays["network"].astype(np.float32)), colors.network.parameters()
        )
        n = len(arrays["means"])
        values = {
            "means": torch.from_numpy(arrays["means"].astype(np.float32)),
            "logit_opacities": torch.from_numpy(dequantize(arrays["logit_opacities"], arrays["ends"], 8)),
            "masks": torch.full((n, 1), 2.0),
        }
        values |= {name: torch.from_numpy(arrays[name].astype(np.float32)) for name in ("scales", "quats")}
        codes = {name: torch.from_numpy(arrays[f"{name}_codes"].astype(np.int64)) for name in ("scales", "quats")}
        return cls(values, codes, colors)

    def _rows(self, camera: Cameras, mask: Tensor) -> Tensor:
        """Return the indices of Gaussians that are kept, in or beside the image: colors of others cost time."""
        with torch.no_grad():
            pose, k = torch.tensor(camera.viewmats[0]).float(), camera.Ks[0]
            local = self.values["means"] @ pose[:3, :3].T + pose[:3, 3]
            across = local[:, 0].abs() < float(_SEEN * 0.5 * camera.width / k[0, 0]) * local[:, 2]
            down = local[:, 1].abs() < float(_SEEN * 0.5 * camera.height / k[1, 1]) * local[:, 2]
            return torch.nonzero((local[:, 2] > 0.0) & across & down & (mask > 0.0))[:, 0]


def residual_codes(rows: Tensor, stages: int = _STAGES, codes: int = _CODES) -> tuple[Tensor, Tensor]:
    """Return codebooks (stages, codes, F) and codes (N, stages): each stage codes what those before left."""
    left = rows.clone()
    books, found = [], []
    for stage in range(stages):
        book = kmeans(left, torch.ones(len(left)), codes, seed=stage)
        if len(book) < codes:
            book = torch.cat([book, torch.zeros(codes - len(book), rows.shape[1])])
        of = nearest(left, book)
        left = left - book[of]
        books.append(book)
        found.append(of)
    return torch.stack(books), torch.stack(found, dim=1)


def sum_codes(books: Tensor, codes: Tensor) -> Tensor:
    """Return rows (N, F) of codes (N, stages): the sum of their entries."""
    stages, count, _ = books.shape
    entries = codes + count * torch.arange(stages)
    return sum_rows(books.reshape(stages * count, -1), entries)


def _train(course: Course, allowance: Allowance, folder: Path, progress: Progress) -> None:
    budget = Budget(allowance, 1.0 - HALVES)
    scene = Compact.from_gaussians(load_scene(folder.parent / HALF.name / SCENE))
    descend(course, budget, scene.draw, scene.rates(), progress=progress)
    save_arrays(folder / FILE, **scene.arrays())


def _open(course: Course, folder: Path) -> Stages:
    path = folder / FILE
    try:
        arrays = load_arrays(path)
        scene = Compact.from_arrays(arrays)
    except (KeyError, ValueError, RuntimeError) as error:
        raise FormatError(
            path, "", "codes, a grid and a network", str(error), f"delete {folder} to train again"
        ) from None
    nbytes = path.stat().st_size
    n = len(arrays["means"])
    header = min(sum(deflated(arrays[name]) for name in _FIRST), nbytes - 1)
    counts = np.unique(np.linspace(0, n, PARTS + 1).astype(np.int64))[1:]
    ends = tuple(int(np.ceil(header + (nbytes - header) * count / n)) for count in counts)

    def draw(stage: int, camera: Cameras) -> NDArray[np.float32]:
        with torch.no_grad():
            image = scene.first(int(counts[stage])).draw(camera)[0]
        return np.asarray(image.clamp(0.0, 1.0).numpy(), np.float32)

    return Stages(ends, draw, n)


SYSTEMS = (
    System(
        "Compact-3D",
        Training("compact3d", _train, HALF),
        _open,
        "Lee et al., CVPR 2024",
        "3DGS for half of the budget, mask, codebooks and grid for the other half; positions stay, codes are chosen"
        " once; six levels of"
        " 8,192 entries; DEFLATE instead of Huffman codes",
        "16.4 MB, 31.98 dB; 35.4 MB, 32.08 dB without post-processing; 601,048 Gaussians",
    ),
)
