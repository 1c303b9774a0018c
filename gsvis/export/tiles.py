"""Write scenes as glTF, one `.glb` or 3D Tiles 1.1, for CesiumJS and other existing viewers; and as one file of USD.

glTF holds Gaussians with the extension KHR_gaussian_splatting; see `gsvis.io.gltf_splats_writer`. docs/tiles.md says
what a tileset holds, and which viewers showed it.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.export.leaves import LEAF, Leaves, cut_leaves
from gsvis.export.levels import Known, ever_seen, open_levels
from gsvis.export.needs import LOST, find_needs
from gsvis.export.tileset import DOCUMENT, Volumes, find_volumes, tileset_document
from gsvis.files.atomic import atomic_folder
from gsvis.files.folders import check_replaceable, remove_earlier
from gsvis.io.gltf_splats_writer import Compression, check_size, encode_glb, report_antialiased, save_glb
from gsvis.io.spz import report_spz_losses
from gsvis.io.usd_writer import check_usd, save_usd
from gsvis.package.package import Package
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.similarity import upright_matrix

__all__ = ["FileReport", "TilesOptions", "TilesReport", "check_tiles_target", "write_glb", "write_tiles", "write_usd"]

_OURS = re.compile(r"(?:\d+_\d+|env)-[0-9a-f]{8}\.glb")


@dataclass(frozen=True)
class TilesOptions:
    """Options of glTF and 3D Tiles.

    Attributes:
        leaf: Largest number of Gaussians of a leaf at one level.
        never_seen: "keep" writes Gaussians that no cell sees; "drop" omits them.
        compression: "none" keeps every value; "spz" is about a fifth of the size, and what CesiumJS reads.
        request_volumes: Make viewers request tiles only from the box of the cells that need them. From outside of all
            cells they then draw little.
        lost: Largest share of the light of a cell in the leaves that it does not need.
        up: (3,) axis that points upwards; None means that of the package or the visible sets, or +z.
        meters_per_unit: Length of a scene unit; None means that of the package, or 1.

    Raises:
        ValueError: If a value is out of its range.
    """

    leaf: int = LEAF
    never_seen: Literal["keep", "drop"] = "keep"
    compression: Compression = "spz"
    request_volumes: bool = False
    lost: float = LOST
    up: tuple[float, float, float] | None = None
    meters_per_unit: float | None = None

    def __post_init__(self) -> None:
        _check.positive_int("leaf", self.leaf, at_least=64)
        _check.one_of("never_seen", self.never_seen, ("keep", "drop"))
        _check.one_of("compression", self.compression, ("none", "spz"))
        if not 0.0 <= self.lost < 1.0:
            raise ValueError(f"lost: expected a share in [0, 1), got {self.lost!r}")
        if self.up is not None:
            _check.unit_vectors("up", np.reshape(np.asarray(self.up, np.float64), (1, -1)))
        meters = self.meters_per_unit
        if meters is not None and not (np.isfinite(meters) and meters > 0.0):
            raise ValueError(f"meters_per_unit: expected a finite number > 0, got {meters!r}")


@dataclass(frozen=True)
class FileReport:
    """Result of `write_glb` and `write_usd`.

    Attributes:
        path: The file.
        gaussians: Gaussians in it.
        sh_degree: Degree of their colors.
        nbytes: Its bytes.
    """

    path: Path
    gaussians: int
    sh_degree: int
    nbytes: int


@dataclass(frozen=True)
class TilesReport:
    """Result of `write_tiles`.

    Attributes:
        path: The folder.
        counts: Gaussians of each level in leaves, finest first.
        environment: Gaussians far outside, which are a tile of their own.
        leaves: Leaves with a tile.
        tiles: Tiles with content.
        cells: Cells of the visible sets; 0 without visible sets.
        volumes: Leaves with a volume in which the eye must be.
        unneeded: Leaves that no cell needs, left out because of volumes.
        requested: Mean share of the bytes of the finest level that the middle of a cell requests; 1 without volumes.
        needed: Mean share of the bytes of the leaves that a cell needs; 1 without volumes. Boxes are tight if it is
            close to `requested`.
        never_seen: Gaussians that no cell sees; None without visible sets.
        dropped: Whether these were left out.
        nbytes: Bytes of everything.
    """

    path: Path
    counts: tuple[int, ...]
    environment: int
    leaves: int
    tiles: int
    cells: int
    volumes: int
    unneeded: int
    requested: float
    needed: float
    never_seen: int | None
    dropped: bool
    nbytes: int


def write_glb(
    path: str | PathLike[str],
    scene: Package | Levels | Gaussians,
    options: TilesOptions | None = None,
    *,
    progress: Progress = silent,
) -> FileReport:
    """Write the highest level of a scene as one `.glb`, atomically. The same scene gives the same bytes.

    Args:
        path: The file.
        scene: A package, levels, or Gaussians.
        options: Options, of which compression, up axis and length of a unit apply; None means
            `TilesOptions(compression="none")`.
        progress: Called with stage "export", and by the fit of SH colors for a package with terms.

    Raises:
        ValueError: If the scene does not fit into 4 GB.
        SceneError: If the scene is empty.
        OSError: If the file cannot be written.
    """
    said = options or TilesOptions(compression="none")
    if isinstance(scene, Package) and said.compression == "none":  # before the fit of its colors, which takes long
        check_size(scene.manifest.counts[-1], 3 if scene.manifest.terms else 0)
    return _write_one(path, scene, said, partial(save_glb, compression=said.compression), progress)


def write_usd(
    path: str | PathLike[str],
    scene: Package | Levels | Gaussians,
    options: TilesOptions | None = None,
    *,
    progress: Progress = silent,
) -> FileReport:
    """Write the highest level of a scene as OpenUSD, atomically; see `gsvis.io.usd_writer`.

    Args:
        path: The file: `.usdz`, `.usdc`, `.usda` or `.usd`.
        scene: A package, levels, or Gaussians.
        options: Options, of which up axis and length of a unit apply; None means `TilesOptions()`.
        progress: As for `write_glb`.

    Raises:
        ValueError: If the suffix is none of these.
        MissingExtraError: If `usd-core` is not installed.
        SceneError: If the scene is empty.
        OSError: If the file cannot be written.
    """
    check_usd(path)
    return _write_one(path, scene, options or TilesOptions(), save_usd, progress)


def _write_one(
    path: str | PathLike[str],
    scene: Package | Levels | Gaussians,
    said: TilesOptions,
    save: Callable[..., int],
    progress: Progress,
) -> FileReport:
    """Write the highest level of a scene as one file with +y up.

    Args:
        path: The file.
        scene: A package, levels, or Gaussians.
        said: Options, of which up axis and length of a unit apply.
        save: Writes Gaussians to a path, turned by the matrix `upright`; returns bytes.
        progress: Called with stage "export".
    """
    levels, _, known = open_levels(scene, None, progress)
    g = levels.level(len(levels) - 1)
    progress("export", 0, 1)
    upright = upright_matrix(np.asarray(_up(said, known, None), np.float64), _meters(said, known))
    size = save(g, path, upright=upright)
    progress("export", 1, 1)
    return FileReport(_check.path("path", path), len(g), g.sh_degree, size)


def check_tiles_target(folder: str | PathLike[str], overwrite: bool) -> None:
    """Raise unless a folder can take a tileset: it is new, empty, or holds one of gsvis to replace.

    Raises:
        ValueError: If it holds something else, or an earlier tileset and `overwrite` is false.
    """
    check_replaceable(_check.path("folder", folder), DOCUMENT, _OURS, overwrite)


def write_tiles(
    folder: str | PathLike[str],
    scene: Package | Levels | Gaussians,
    options: TilesOptions | None = None,
    *,
    visibility: VisibilityStore | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> TilesReport:
    """Write 3D Tiles: `tileset.json` and a `.glb` for each leaf and level. The same scene gives the same bytes.

    `tileset.json` moves into the folder last, and files of an earlier tileset are removed after that.

    Args:
        folder: Folder of the tileset; new, empty, or with `overwrite` one that gsvis wrote before.
        scene: A package; levels; or Gaussians.
        options: How it is cut; None means `TilesOptions()`.
        visibility: Visible sets of the scene; None means those of the package, or none.
        overwrite: Replace an earlier tileset.
        progress: Called with stages "sets" and "export", and by the fit of SH colors for a package with terms.

    Raises:
        ValueError: If the folder holds something else, or volumes or dropping unseen Gaussians need visible sets.
        SceneError: If the scene is empty, or nothing would be left.
        FormatError: If the visible sets belong to a different scene, or the package is damaged.
        OSError: If the folder cannot be written.
    """
    target = _check.path("folder", folder)
    said = options or TilesOptions()
    check_tiles_target(target, overwrite)
    drop = said.never_seen == "drop"
    sets = visibility is not None or (isinstance(scene, Package) and scene.manifest.visibility is not None)
    if not sets and (drop or said.request_volumes):
        name = "never_seen" if drop else "request_volumes"
        raise ValueError(f"{name}: expected visible sets to know what is seen from where, got none; give some")
    levels, store, known = open_levels(scene, visibility, progress)
    seen = None if store is None else ever_seen(store, len(levels.union))
    if drop and seen is not None and not seen.any():
        raise SceneError("everything would go: no cell sees a Gaussian; nothing written")
    leaves = cut_leaves(levels, most=said.leaf, kept=seen if drop else None, lowest=levels.previews)
    volumes = None
    needs = None
    if said.request_volumes:
        needs = find_needs(leaves, store, lost=said.lost, progress=progress)
        volumes = find_volumes(needs)
    upright = upright_matrix(np.asarray(_up(said, known, store), np.float64))
    _report_losses(levels.union, target, said.compression)
    skipped = None if volumes is None else ~volumes.needed
    files = _TileFiles(leaves, upright, said.compression, skipped)
    with atomic_folder(target, last=(DOCUMENT,)) as partial:
        files.write(partial, progress)
        document = tileset_document(
            leaves, files.contents, upright[:3, :3], environment=files.environment, volumes=volumes,
            meters=_meters(said, known), packed=said.compression == "spz",
        )  # fmt: skip
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        (partial / DOCUMENT).write_bytes(text)
    remove_earlier(target, _OURS, {*files.contents.values(), files.environment or ""})
    finest = files.sizes[0] / max(1, files.sizes[0].sum())
    return TilesReport(
        path=target,
        counts=tuple(int(n) for n in leaves.counts.sum(axis=1)),
        environment=len(leaves.environment),
        leaves=len(leaves) - (0 if skipped is None else int(skipped.sum())),
        tiles=len(files.contents) + (files.environment is not None),
        cells=0 if store is None else len(store),
        volumes=0 if volumes is None else int(volumes.bounded.sum()),
        unneeded=0 if skipped is None else int(skipped.sum()),
        requested=1.0 if volumes is None else _share(volumes, finest),
        needed=1.0 if needs is None else float((needs.needed @ finest).mean()),
        never_seen=None if seen is None else int((~seen).sum()),
        dropped=drop,
        nbytes=files.nbytes + len(text),
    )


def _report_losses(g: Gaussians, target: Path, compression: Compression) -> None:
    """Log what the contents of all tiles cannot store."""
    if compression == "spz":
        report_spz_losses(g, target)
    if g.facts.antialiased:
        report_antialiased(target)


class _TileFiles:
    """Write the contents of leaves; skipped leaves have a size but no file.

    Attributes:
        contents: File of each (level, leaf).
        environment: File of the environment; None without one.
        sizes: (L, B) bytes of each content.
        nbytes: Bytes of all files.
    """

    def __init__(
        self, leaves: Leaves, upright: NDArray[np.float64], compression: Compression, skipped: NDArray[np.bool_] | None
    ) -> None:
        self._leaves = leaves
        self._upright = upright
        self._compression = compression
        self._skipped = skipped
        self.contents: dict[tuple[int, int], str] = {}
        self.environment: str | None = None
        self.sizes = np.zeros(leaves.counts.shape, np.int64)
        self.nbytes = 0

    def write(self, folder: Path, progress: Progress) -> None:
        """Write all files; a level of a leaf without changes to the next finer level has no file."""
        leaves = self._leaves
        union = self._leaves.levels.union
        pieces = np.argwhere(leaves.counts > 0).tolist()
        progress("export", 0, len(pieces))
        for k, (lod, leaf) in enumerate(pieces):
            ids = leaves.ids(lod, leaf)
            if lod == 0 or not np.array_equal(ids, leaves.ids(lod - 1, leaf)):
                data = self._encode(union[ids])
                self.sizes[lod, leaf] = len(data)
                if self._skipped is None or not self._skipped[leaf]:
                    self.contents[lod, leaf] = self._keep(folder, f"{lod}_{leaf}", data)
            progress("export", k + 1, len(pieces))
        if len(leaves.environment):
            self.environment = self._keep(folder, "env", self._encode(union[leaves.environment]))

    def _encode(self, g: Gaussians) -> bytes:
        """Return the content of a tile."""
        return encode_glb(g, upright=self._upright, compression=self._compression)

    def _keep(self, folder: Path, name: str, data: bytes) -> str:
        """Write a file; return its name."""
        file = f"{name}-{hashlib.sha256(data).hexdigest()[:8]}.glb"
        (folder / file).write_bytes(data)
        self.nbytes += len(data)
        return file


def _share(volumes: Volumes, sizes: NDArray[np.float64]) -> float:
    """Return the mean share of bytes that the middles of cells request."""
    requested = volumes.needed & (volumes.inside | ~volumes.bounded)
    return float((requested @ sizes).mean())


def _up(said: TilesOptions, known: Known, store: VisibilityStore | None) -> tuple[float, ...]:
    """Return the up axis: that of the options, the package, the visible sets, or +z."""
    return said.up or known.up or ((0.0, 0.0, 1.0) if store is None else tuple(store.grid.up.tolist()))


def _meters(said: TilesOptions, known: Known) -> float:
    """Return the length of a scene unit in meters."""
    return said.meters_per_unit or known.meters_per_unit or 1.0
