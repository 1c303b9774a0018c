"""Hold the measured quality of visible sets: the light that a set keeps, its size, and the loss in images.

M cells are measured from V fresh viewpoints each. The last axis of some arrays runs over the K weight classes: entry k
is for the set without the classes below k, entry 0 for the whole set. PSNR in dB, capped at 100.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.pvs.certified_cells import CertifiedCells
from gsvis.scene.cameras import Cameras, intrinsics

__all__ = ["PSNR_CAP", "TARGETS", "Figure", "Quality", "QualityConfig", "Trade"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

PSNR_CAP = 100.0
"""PSNR of equal images, dB, in place of infinity."""

TARGETS = MappingProxyType(
    {
        "weighted_recall": (0.999, 0.995),
        "psnr": (45.0, 40.0),
        "size_over_dense": (1.3, None),
        "missed_light": (0.0005, 0.0015),
    }
)
"""Targets of a good store: for the mean, and for the worst case."""


@dataclass(frozen=True)
class QualityConfig:
    """Options of a measurement of visible sets.

    Attributes:
        cells: Number of cells to measure, drawn at random; None measures all.
        viewpoints: Fresh viewpoints in each cell.
        size: Pixels along a side of the six faces around a viewpoint.
        dense: Viewpoints of the dense union that a set is compared with; 0 for no dense union.
        dense_size: Pixels along a side of the six faces around each of them; None takes `size`.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        fov: Horizontal field of view of the images, degrees.
        rays: Also find by ray casting which Gaussians the fresh viewpoints see.
        certify: Random rays in each cell that bound the light its set misses; 0 for none.
        bytes_per_gaussian: Bytes to send one Gaussian; None takes its 32-bit attributes in an uncompressed 3DGS file.
        seed: Random seed of the cells, the viewpoints and the directions of the images.
    """

    cells: int | None = 10
    viewpoints: int = 4
    size: int = 128
    dense: int = 27
    dense_size: int | None = None
    width: int = 480
    height: int = 360
    fov: float = 70.0
    rays: bool = False
    certify: int = 8192
    bytes_per_gaussian: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("viewpoints", "size", "width", "height"):
            _check.positive_int(name, getattr(self, name))
        for name in ("dense", "certify", "seed"):
            _check.positive_int(name, getattr(self, name), at_least=0)
        for name in ("cells", "dense_size", "bytes_per_gaussian"):
            if getattr(self, name) is not None:
                _check.positive_int(name, getattr(self, name))
        if not 0.0 < self.fov < 180.0:
            raise ValueError(f"fov: expected degrees in (0, 180), got {self.fov!r}")


@dataclass(frozen=True)
class Figure:
    """One figure of the summary.

    Attributes:
        key: Name in JSON.
        label: Label for tables.
        mean: Mean over all measurements.
        worst: Worst measurement; None if no direction is better.
        worst_of: Kind of the worst measurement: "cell", "viewpoint" or "image"; empty if `worst` is None.
        targets: Targets of the mean and of the worst; None where there is none.
        better: "higher" or "lower"; empty if neither is better.
        unit: "share", "dB" or "times".
    """

    key: str
    label: str
    mean: float
    worst: float | None
    worst_of: str
    targets: tuple[float | None, float | None]
    better: str
    unit: str

    def met(self, which: int) -> bool | None:
        """Return whether the mean (0) or the worst (1) reaches its target; None without a target."""
        target = self.targets[which]
        value = (self.mean, self.worst)[which]
        if target is None or value is None:
            return None
        return value >= target if self.better == "higher" else value <= target


@dataclass(frozen=True)
class Trade:
    """Savings and losses when the faint classes are not sent; means over all measurements.

    Attributes:
        least_class: The lowest class that is sent; 0 for the whole set.
        least_weight: Lowest weight of this class.
        gaussians: Gaussians sent for a cell.
        bytes: Bytes of these Gaussians.
        weighted_recall: Share of the light that is kept.
        psnr: PSNR of the image against the full scene, dB.
        psnr_worst: PSNR of the worst image, dB.
        saved: Bytes saved against the whole set.
        lost: PSNR lost against the whole set, dB.
    """

    least_class: int
    least_weight: float
    gaussians: float
    bytes: float
    weighted_recall: float
    psnr: float
    psnr_worst: float
    saved: float
    lost: float

    @property
    def lost_per_megabyte(self) -> float | None:
        """Decibels lost for each million bytes saved; None where nothing is saved."""
        return self.lost / (self.saved / 1e6) if self.saved > 0.0 else None


@dataclass(frozen=True, eq=False)
class Quality:
    """The quality of the visible sets of M cells, measured from V fresh viewpoints in each.

    Attributes:
        config: Options of the measurement.
        gaussians: N, the number of Gaussians measured.
        tau: Weight from which a Gaussian counts as visible.
        class_edges: (K,) lowest weight of each class.
        bytes_per_gaussian: Bytes to send one Gaussian.
        cells: (M,) numbers of the measured cells, ascending.
        centers: (M, 3) centers of the measured cells, scene frame and units.
        left_out: Cells skipped because too few viewpoints outside everything solid were found.
        eyes: (M, V, 3) the fresh viewpoints.
        viewmats: (M, V, 4, 4) camera from world, of the cameras of the images.
        kept: (M, K) number of Gaussians in the set.
        weighted_recall: (M, V, K) share of the weights around the viewpoint, summed over pixels, that the set keeps.
        recall: (M, V) share of the Gaussians visible from the viewpoint that the set has.
        ray_recall: (M, V) share of the Gaussians visible on pixel rays that the set has; None without `config.rays`.
        psnr: (M, V, K) PSNR of the image drawn from the set against that of the full scene.
        ceiling: (M, V) PSNR of the image drawn from exactly the Gaussians visible in it.
        exact: (M, V) number of Gaussians visible in the image.
        confirmed: (M,) precision: share of the set that a fresh viewpoint, or one of the dense union, sees.
        dense: (M,) number of Gaussians in the dense union; None without a dense union.
        dense_shared: (M,) number of Gaussians in both the dense union and the set; None without a dense union.
        dense_psnr: (M, V) PSNR of the image drawn from the dense union; None without a dense union.
        shown: (U,) bool, for a union of U Gaussians: the N Gaussians of its highest level, which were measured. None
            if all Gaussians were measured.
        light: The certificates of the measured cells; None without `config.certify`, or where too little of a cell lies
            outside everything solid.
    """

    config: QualityConfig
    gaussians: int
    tau: float
    class_edges: F64
    bytes_per_gaussian: int
    cells: I64
    centers: F64
    left_out: tuple[int, ...]
    eyes: F64
    viewmats: F64
    kept: I64
    weighted_recall: F64
    recall: F64
    ray_recall: F64 | None
    psnr: F64
    ceiling: F64
    exact: I64
    confirmed: F64
    dense: I64 | None
    dense_shared: I64 | None
    dense_psnr: F64 | None
    shown: NDArray[np.bool_] | None = None
    light: CertifiedCells | None = None

    def __len__(self) -> int:
        return len(self.cells)

    @property
    def size_over_dense(self) -> F64 | None:
        """(M,) size of each set over the size of its dense union; None without a dense union."""
        return None if self.dense is None else self.kept[:, 0] / np.maximum(self.dense, 1)

    @property
    def dense_recall(self) -> F64 | None:
        """(M,) share of the dense union that each set has; None without a dense union."""
        if self.dense is None or self.dense_shared is None:
            return None
        return np.where(self.dense > 0, self.dense_shared / np.maximum(self.dense, 1), 1.0)

    def camera(self, m: int, v: int) -> Cameras:
        """Return the camera of the image at viewpoint v of row m."""
        width = self.config.width
        height = self.config.height
        return Cameras(self.viewmats[m, v][None], intrinsics(width, height, self.config.fov)[None], width, height)

    def figures(self) -> tuple[Figure, ...]:
        """Return the figures of the summary."""
        whole = self.weighted_recall[..., 0]
        images = self.psnr[..., 0]
        cell = whole.mean(axis=1)
        eye = "viewpoint"
        found = [
            *self._light_figures(),
            _figure("weighted_recall", "light that the set keeps", cell, "cell", "higher", "share"),
            _figure("weighted_recall_viewpoint", "the same, viewpoint by viewpoint", whole, eye, "higher", "share"),
            _figure("psnr", "image from the set", images, "image", "higher", "dB"),
            _figure("ceiling", "image from exactly what it shows", self.ceiling, "image", "higher", "dB"),
        ]
        if self.dense_psnr is not None:
            label = "image from the dense union"
            found.append(_figure("dense_psnr", label, self.dense_psnr, "image", "higher", "dB"))
        if self.size_over_dense is not None and self.dense_recall is not None:
            label = "size of set over dense union"
            found.append(_figure("size_over_dense", label, self.size_over_dense, "cell", "lower", "times"))
            label = "dense union that the set has"
            found.append(_figure("dense_recall", label, self.dense_recall, "cell", "higher", "share"))
        label = "visible Gaussians that it has"
        found.append(_figure("recall", label, self.recall, "viewpoint", "higher", "share"))
        if self.ray_recall is not None:
            label = "the same, by pixel rays"
            found.append(_figure("ray_recall", label, self.ray_recall, "viewpoint", "higher", "share"))
        label = "set that some viewpoint confirms"
        found.append(_figure("precision", label, self.confirmed, "cell", "higher", "share"))
        shares = self.kept[:, 0] / self.gaussians
        found.append(
            Figure("visible_share", "set over the whole scene", _mean(shares), None, "", (None, None), "", "share")
        )
        return tuple(found)

    def _light_figures(self) -> list[Figure]:
        """Return the figures of the certificates; the means are over the rays of all cells."""
        if self.light is None:
            return []
        missed = self.light.missed_by_cell
        bound = self.light.bound_by_cell
        key = "missed_light"
        percent = f"{1.0 - self.light.error:.0%}"
        shown = (
            (key, "light missed on random rays", self.light.missed, float(missed.max())),
            (f"{key}_bound", f"{percent} upper bound of it", self.light.bound, float(bound.max())),
        )
        return [
            Figure(name, label, mean, worst, "cell", TARGETS.get(name, (None, None)), "lower", "share")
            for name, label, mean, worst in shown
        ]

    def worst(self, count: int = 5) -> I64:
        """Return the rows of the `count` measured cells that keep the least light, worst first."""
        return np.lexsort((self.psnr[..., 0].mean(axis=1), self.weighted_recall[..., 0].mean(axis=1)))[:count]

    def trades(self) -> tuple[Trade, ...]:
        """Return one trade for each class: from the whole set to the highest class alone."""
        kept = self.kept.mean(axis=0)
        recall = self.weighted_recall.mean(axis=(0, 1))
        psnr = self.psnr.mean(axis=(0, 1))
        size = float(self.bytes_per_gaussian)
        return tuple(
            Trade(
                k,
                float(self.class_edges[k]),
                float(kept[k]),
                size * float(kept[k]),
                float(recall[k]),
                float(psnr[k]),
                float(self.psnr[..., k].min()),
                size * float(kept[0] - kept[k]),
                float(psnr[0] - psnr[k]),
            )
            for k in range(len(self.class_edges))
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the measurements as plain numbers, strings and lists for JSON."""
        return {
            "config": asdict(self.config),
            "gaussians": self.gaussians,
            "tau": self.tau,
            "bytes_per_gaussian": self.bytes_per_gaussian,
            "cells_measured": len(self),
            "cells_left_out": list(self.left_out),
            "figures": {
                each.key: {
                    "label": each.label,
                    "mean": each.mean,
                    "worst": each.worst,
                    "worst_of": each.worst_of,
                    "target_mean": each.targets[0],
                    "target_worst": each.targets[1],
                    "met_mean": each.met(0),
                    "met_worst": each.met(1),
                    "better": each.better,
                    "unit": each.unit,
                }
                for each in self.figures()
            },
            "classes": [{**asdict(each), "lost_per_megabyte": each.lost_per_megabyte} for each in self.trades()],
            "certificate": None if self.light is None else self.light.as_dict(),
            "worst_cells": self.cells[self.worst(10)].tolist(),
            "cells": [self._row(m) for m in range(len(self))],
        }

    def _row(self, m: int) -> dict[str, Any]:
        """Return the record of one measured cell."""
        row = {
            "cell": int(self.cells[m]),
            "center": self.centers[m].tolist(),
            "kept": self.kept[m].tolist(),
            "precision": float(self.confirmed[m]),
            "viewpoints": self.eyes[m].tolist(),
            "viewmats": self.viewmats[m].tolist(),
            "weighted_recall": self.weighted_recall[m].tolist(),
            "recall": self.recall[m].tolist(),
            "psnr": self.psnr[m].tolist(),
            "ceiling": self.ceiling[m].tolist(),
            "exact": self.exact[m].tolist(),
        }
        for name in ("ray_recall", "dense", "dense_shared", "dense_psnr"):
            values = getattr(self, name)
            row[name] = None if values is None else values[m].tolist()
        row["certificate"] = None if self.light is None else self.light.certificates[m].as_dict()
        return row


def _figure(key: str, label: str, values: F64, worst_of: str, better: str, unit: str) -> Figure:
    """Return a figure with mean, worst value and targets."""
    worst = float(values.max() if better == "lower" else values.min())
    return Figure(key, label, _mean(values), worst, worst_of, TARGETS.get(key, (None, None)), better, unit)


def _mean(values: F64) -> float:
    return float(np.mean(values))
