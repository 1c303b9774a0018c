"""What `streaming_rivals.py` compares: ours, ours without one idea each, and the rivals, with measured sizes.

What is measured of a scene is kept in a folder, because a streamed SOG takes a minute to write.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from _packaged import Packaged
from paper.ablation import ABLATIONS, ablated, without_levels, without_sets, without_terms
from paper.rivals import RIVALS, LeafFiles, Measured, rival
from paper.rivals.leaves import leaf_sizes

from gsvis.abr import AbrConfig, FieldOfView
from gsvis.export.leaves import cut_leaves
from gsvis.io import save_scene
from gsvis.io.streamed_sog_writer import save_streamed_sog
from gsvis.package import Package
from gsvis.package.manifest import MANIFEST
from gsvis.package.unpack import unpack_levels
from gsvis.scene.gaussians import Gaussians
from gsvis.simulate import Adaptive, Delivery, MortonProgressive, WholeFile, morton_order
from gsvis.stream import StreamedScene

__all__ = ["ABLATED", "OTHERS", "OURS", "SYSTEMS", "VARIANTS", "Scene"]

CHUNK = 1024
"""Gaussians of a chunk of `frustum chunks`."""
OURS = "gsvis"
ABLATED = tuple(f"gsvis without {name}" for name in ABLATIONS)
OTHERS = ("whole file", "Morton order", *RIVALS)
VARIANTS: dict[str, dict[str, Any]] = {
    "gsvis, fov-first": {"policy": "fov-first"},
    "gsvis, low-first": {"policy": "low-first"},
    "gsvis, links not filled": {"fill": False},
}
"""Ours with other settings of the scheduler."""
SYSTEMS = (OURS, *VARIANTS, *ABLATED, *OTHERS)


class Scene:
    """A package, opened for all systems.

    Args:
        name: Name of the scene.
        package: Its open package.
        original: The scene before it was packaged, and its published files.
        work: Folder where measured sizes are kept.
        config: Settings of our scheduler.
    """

    def __init__(self, name: str, package: Package, original: Packaged, work: Path, config: AbrConfig) -> None:
        self.name = name
        self.full = original.gaussians
        self.file_bytes = original.file_bytes
        self.file = original.file
        self.meters_per_unit = original.meters_per_unit
        self.config = config
        self.streamed = StreamedScene.open(package)
        self.sizes = _sizes(name, package, self.full, work)
        self._views: dict[str, StreamedScene] = {}

    @property
    def file_gaussian_bytes(self) -> float:
        """Bytes of a Gaussian with full SH in a large file: the fewest of SPZ, published SOG and leaves of SOG."""
        highest = np.sum(self.sizes["leaf_sizes"][0]) / self.sizes["leaf_counts"][0]
        return float(min(self.sizes["spz"], self.file_bytes / len(self.full), highest))

    @property
    def sh_bytes(self) -> float:
        """Bytes of the SH coefficients of a Gaussian beyond its base color, in chunks as SPZ."""
        return max(self.sizes["spz_chunk"] - self.sizes["spz_chunk_base"], 0.0)

    @cached_property
    def measured(self) -> Measured:
        s = self.sizes
        files = LeafFiles(
            np.array(s["leaf_of"]), leaf_sizes(s["leaf_sizes"]), s["header"], np.array(s["environment"], np.int64),
            s["environment_bytes"],
        )  # fmt: skip
        lowest = float(np.sum(s["leaf_sizes"][-1]) / s["leaf_counts"][-1])
        return Measured(
            self.streamed.contents, files, s["spz_chunk"], lowest, self.file_gaussian_bytes, CHUNK,
            f"chunks of {CHUNK} as SPZ; layers of segments as leaves of SOG; whole layers as SOG",
        )  # fmt: skip

    def system(self, name: str, view: FieldOfView) -> Delivery:
        """A fresh delivery of a system by name."""
        contents = self.streamed.contents
        if name == OURS:
            return Adaptive(self.streamed, view, self.config, name=OURS)
        if name in VARIANTS:
            return Adaptive(self.streamed, view, replace(self.config, **VARIANTS[name]), name=name)
        if name in ABLATED:
            left_out = name.removeprefix("gsvis without ")
            return ablated(self._without(left_out), left_out, view, self.config, sh_bytes=self.sh_bytes)
        if name == "whole file":
            return WholeFile(contents, self.file_bytes, self.file)
        if name == "Morton order":
            records = 16.0 * len(self.full) + contents.term_records.shape[1] * self._terms
            per = self.file_gaussian_bytes
            if per * len(self.full) < records:
                return MortonProgressive(contents, per, 1e-6, "the fewest bytes of SPZ and SOG")
            return MortonProgressive(contents)
        return rival(name, self.measured, view)

    @property
    def _terms(self) -> int:
        contents = self.streamed.contents
        return int(contents.term_counts[contents.last == len(contents.names) - 1].sum())

    def _without(self, left_out: str) -> StreamedScene:
        if left_out not in self._views:
            self._views[left_out] = {
                "sets": without_sets,
                "levels": without_levels,
                "terms": lambda scene: without_terms(scene, self.sh_bytes),
                "prediction": lambda scene: scene,
            }[left_out](self.streamed)
        return self._views[left_out]


def _sizes(name: str, package: Package, full: Gaussians, work: Path) -> dict[str, Any]:
    """Bytes of the streamed SOG of a package, leaf by leaf, and of a Gaussian as SPZ with and without SH."""
    digest = hashlib.sha256((Path(package.path) / MANIFEST).read_bytes()).hexdigest()[:12]
    kept = work / f"{name}-{digest}-sizes-2.json"
    if kept.exists():
        found: dict[str, Any] = json.loads(kept.read_text())
        return found
    work.mkdir(parents=True, exist_ok=True)
    leaves = cut_leaves(unpack_levels(package))
    base = Gaussians(full.means, full.quats, full.scales, full.opacities, full.sh0)
    with tempfile.TemporaryDirectory(dir=work) as folder:
        out = Path(folder) / "sog"
        written = save_streamed_sog(leaves.as_scene(), out)
        meta = out / "lod-meta.json"
        document = json.loads(meta.read_text())
        beside = 0
        if "environment" in document:
            beside = sum(file.stat().st_size for file in (out / document["environment"]).parent.iterdir())
        sizes = {
            "leaf_of": leaves.of_ids.tolist(), "leaf_sizes": written.sizes.tolist(), "header": meta.stat().st_size,
            "environment": leaves.environment.tolist(), "environment_bytes": beside,
            "leaf_counts": leaves.counts.sum(axis=1).tolist(),
            "spz": _spz_bytes(full, Path(folder)),
            "spz_chunk": _spz_bytes(full, Path(folder), CHUNK),
            "spz_chunk_base": _spz_bytes(base, Path(folder), CHUNK),
        }  # fmt: skip
    kept.write_text(json.dumps(sizes))
    return sizes


def _spz_bytes(g: Gaussians, folder: Path, chunk: int | None = None) -> float:
    """Bytes of a Gaussian as SPZ in Morton order: in one file, or in 32 chunks of the scene, each a file of its own."""
    path, ordered = folder / "scene.spz", g[morton_order(g.means)]
    if chunk is None:
        save_scene(ordered, path)
        return path.stat().st_size / len(g)
    nbytes = 0
    for start in np.linspace(0, max(len(g) - chunk, 0), 32).astype(int).tolist():
        save_scene(ordered[start : start + chunk], path)
        nbytes += path.stat().st_size
    return nbytes / (32 * min(chunk, len(g)))
