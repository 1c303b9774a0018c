"""Anchors with features and networks that make Gaussians of them, in levels or in one.

An anchor of level l stands for a voxel of half the side of those of level l - 1. Seen from afar only low levels are
drawn. World frame and units of the reconstruction.

References:
    Lu et al., "Scaffold-GS", CVPR 2024, section 3; the authors' networks of one hidden layer of 32.
    Ren et al., "Octree-GS", 2024, section 4.1: an anchor is drawn from distances up to `reach` over 2 to its level.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import normalize

from arena.course import Course
from gsvis.render import GaussianTensors, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.morton import morton_order
from gsvis.scene.points import PointCloud
from gsvis.train.initial import gaussians_from_points

__all__ = ["Anchors", "Places", "find_places", "levels_of"]

F32 = NDArray[np.float32]

_FEATURES = 32
_HIDDEN = 32
_SIZES_WEIGHT = 0.01  # of the volumes of Gaussians in the loss, as in the authors' code
_ROUNDS = 40
_BESIDE = 0.6  # half of an image and a margin, as a share of its sides
_OPAQUE = 0.3  # bias of opacities at the start, so that most Gaussians are drawn


class Anchors(nn.Module):
    """N anchors of `PER` Gaussians each.

    Args:
        values: centers (N, 3), features (N, 32), offsets (N, PER, 3) in units of `log_reach`, log_reach (N, 3),
            log_scales (N, 3).
        level: (N,) level of each anchor.
        reach: Distance beyond which only level 0 is drawn; inf with one level.
    """

    PER: ClassVar[int] = 5

    def __init__(self, values: dict[str, Tensor], level: Tensor, reach: float) -> None:
        super().__init__()
        self.values = nn.ParameterDict({name: nn.Parameter(value) for name, value in values.items()})
        self.level = level
        self.reach = reach
        self.networks = nn.ModuleDict({
            "opacities": _network(self.PER),
            "colors": _network(3 * self.PER),
            "shapes": _network(7 * self.PER),
        })  # fmt: skip

    @classmethod
    def from_places(cls, places: Places, reach: float) -> Anchors:
        """Return anchors before training; the first three numbers of a feature are its color.

        Args:
            places: Where they stand.
            reach: See the class.
        """
        torch.manual_seed(0)
        n = len(places.centers)
        sizes = 0.5 * places.sizes
        logs = torch.from_numpy(np.log(np.maximum(sizes, 1e-6))).float()[:, None].repeat(1, 3)
        values = {
            "centers": torch.tensor(places.centers),
            "features": 0.1 * torch.randn(n, _FEATURES),
            "offsets": 0.5 * torch.randn(n, cls.PER, 3),
            "log_reach": logs.clone(),
            "log_scales": logs.clone(),
        }
        values["features"][:, :3] = torch.tensor(4.0 * (places.colors - 0.5))
        anchors = cls(values, torch.from_numpy(places.level), reach)
        bias = list(anchors.networks["opacities"].parameters())[-1]
        nn.init.constant_(bias, _OPAQUE)
        return anchors

    def __len__(self) -> int:
        return len(self.level)

    def rates(self) -> dict[Tensor, float]:
        """Return the learning rate of each tensor."""
        rates = {"centers": 0.0, "features": 7.5e-3, "offsets": 1e-2, "log_reach": 7e-3, "log_scales": 7e-3}
        found: dict[Tensor, float] = {self.values[name]: rate for name, rate in rates.items()}
        found |= dict.fromkeys(self.networks.parameters(), 4e-3)
        return found | dict.fromkeys(self.networks["colors"].parameters(), 8e-3)

    def draw(self, camera: Cameras) -> tuple[Tensor, Tensor]:
        """Return the image (H, W, 3) and the mean volume of the Gaussians, weighted for the loss."""
        rows = self._rows(camera)
        v = {name: value[rows] for name, value in self.values.items()}
        apart = v["centers"] - torch.tensor(camera.viewpoints[0]).float()
        seen = torch.cat([v["features"], normalize(apart, dim=1)], dim=1)
        opacities = self.networks["opacities"](seen).tanh().reshape(-1)
        colors = self.networks["colors"](seen).sigmoid().reshape(-1, 3)
        shapes = self.networks["shapes"](seen).reshape(-1, 7)
        each = torch.arange(len(rows)).repeat_interleave(self.PER)
        keep = opacities > 0.0
        offsets = v["offsets"].reshape(-1, 3) * v["log_reach"].exp()[each]
        means = (v["centers"][each] + offsets)[keep]
        scales = (v["log_scales"].exp()[each] * shapes[:, :3].sigmoid())[keep]
        black = means.new_zeros((len(means), 1, 3))
        quats = shapes[keep, 3:] + shapes.new_tensor([1.0, 0.0, 0.0, 0.0])
        scene = GaussianTensors(means, quats, scales.clamp(min=1e-6), opacities[keep], black, black[:, :0])
        image = rasterize(scene, camera, colors=colors[keep]).images[0]
        return image, _SIZES_WEIGHT * scales.prod(dim=1).mean()

    def first(self, count: int) -> Anchors:
        """Return the first anchors, with the same networks."""
        part = Anchors({name: v.detach()[:count] for name, v in self.values.items()}, self.level[:count], self.reach)
        part.networks = self.networks
        return part

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what is sent: half floats, anchors by level and in Morton order."""
        centers = self.values["centers"].detach().numpy()
        morton = morton_order(centers)
        order = morton[np.argsort(self.level.numpy()[morton], kind="stable")]
        out: dict[str, NDArray[Any]] = {
            name: v.detach().numpy()[order].astype(np.float32 if name == "centers" else np.float16)
            for name, v in self.values.items()
        }
        out["level"] = self.level.numpy()[order].astype(np.uint8)
        out["reach"] = np.array(self.reach)
        out["networks"] = nn.utils.parameters_to_vector(self.networks.parameters()).detach().numpy().astype(np.float16)
        return out

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> Anchors:
        """Return the anchors of `arrays`.

        Raises:
            KeyError: If an array is missing.
            RuntimeError: If the networks have another size.
        """
        names = ("centers", "features", "offsets", "log_reach", "log_scales")
        values = {name: torch.from_numpy(arrays[name].astype(np.float32)) for name in names}
        anchors = cls(values, torch.from_numpy(arrays["level"].astype(np.int64)), float(arrays["reach"]))
        vector = torch.from_numpy(arrays["networks"].astype(np.float32))
        if len(vector) != sum(p.numel() for p in anchors.networks.parameters()):
            raise ValueError(f"networks: got {len(vector):,} numbers of another network")
        nn.utils.vector_to_parameters(vector, anchors.networks.parameters())
        return anchors

    @property
    def network_bytes(self) -> int:
        """Bytes of the networks."""
        return 2 * sum(p.numel() for p in self.networks.parameters())

    def _rows(self, camera: Cameras) -> Tensor:
        """Return the indices of anchors that are drawn: in or beside the image, of levels that suit the distance."""
        with torch.no_grad():
            centers = self.values["centers"]
            pose = torch.tensor(camera.viewmats[0]).float()
            local = centers @ pose[:3, :3].T + pose[:3, 3]
            k = camera.Ks[0]
            reach = 3.0 * self.values["log_scales"].exp().amax(dim=1) + 2.0 * self.values["log_reach"].exp().amax(dim=1)
            across = local[:, 0].abs() - reach < float(_BESIDE * camera.width / k[0, 0]) * local[:, 2]
            down = local[:, 1].abs() - reach < float(_BESIDE * camera.height / k[1, 1]) * local[:, 2]
            drawn = (local[:, 2] > 0.0) & across & down
            if np.isfinite(self.reach):
                eye = torch.tensor(camera.viewpoints[0]).float()
                distance = (centers - eye).norm(dim=1).clamp(min=1e-6)
                highest = torch.log2(self.reach / distance).clamp(min=0.0).round()
                drawn &= self.level <= highest
            return torch.nonzero(drawn)[:, 0]


class Places(NamedTuple):
    """Where anchors stand.

    Attributes:
        centers: (N, 3).
        colors: (N, 3) in [0, 1].
        sizes: (N,) distances to their neighbors.
        level: (N,) their levels.
    """

    centers: F32
    colors: F32
    sizes: F32
    level: NDArray[np.int64]


def find_places(points: PointCloud, most: int, levels: int) -> Places:
    """Return anchors at the voxels that hold points.

    The side of the lowest level is bisected so that all levels together have at most `most` anchors. Centers are the
    means of the points in a voxel; sizes are distances to neighbors, as in `gaussians_from_points`.
    """
    extent = float(np.ptp(points.means, axis=0).max())
    low, high = np.log(extent * 1e-5), np.log(extent * 2.0 ** (levels + 3))
    for _ in range(_ROUNDS):
        middle = 0.5 * (low + high)
        count = sum(len(_voxels(points, float(np.exp(middle)) / 2**k)) for k in range(levels))
        low, high = (low, middle) if count <= most else (middle, high)
    found = [_voxels(points, float(np.exp(high)) / 2**k) for k in range(levels)]
    rows = np.concatenate(found).astype(np.float32)
    sizes = np.concatenate([_spacing(part[:, :3]) for part in found])
    level = np.concatenate([np.full(len(part), k) for k, part in enumerate(found)])
    return Places(rows[:, :3], rows[:, 3:], sizes, level)


def levels_of(course: Course, levels: int) -> float:
    """Return the reach of levels: the distance from which the lowest is enough for nine of ten points; inf for one."""
    if levels == 1:
        return float("inf")
    middle = course.views.cameras.viewpoints.mean(axis=0)
    return float(np.quantile(np.linalg.norm(course.start.means - middle, axis=1), 0.9)) * 2.0


def _voxels(points: PointCloud, side: float) -> NDArray[np.float64]:
    """Return the means of the rows of the points of each voxel that holds any."""
    rows = np.concatenate([points.means, points.colors], axis=1)
    cells = np.floor(points.means / side).astype(np.int64)
    _, of = np.unique(cells, axis=0, return_inverse=True)
    of = of.reshape(-1)
    counts = np.bincount(of)
    return np.stack([np.bincount(of, row) / counts for row in rows.T], axis=1)


def _spacing(centers: NDArray[np.float64]) -> F32:
    """Return the distance of each center to its neighbors, at most that of nine in ten; 1 for a single one."""
    if len(centers) < 2:
        return np.ones(len(centers), np.float32)
    cloud = PointCloud(centers.astype(np.float32), np.zeros_like(centers, np.float32))
    apart = gaussians_from_points(cloud).scales[:, 0]
    return np.asarray(np.minimum(apart, np.quantile(apart, 0.9)), np.float32)


def _network(outputs: int) -> nn.Sequential:
    """Return a network of one hidden layer, from a feature and a direction."""
    first = nn.Linear(_FEATURES + 3, _HIDDEN)
    with torch.no_grad():
        first.weight[:, _FEATURES:] = 0.0  # nothing depends on the direction until a photograph says so
    return nn.Sequential(first, nn.ReLU(), nn.Linear(_HIDDEN, outputs))
