"""Measure how good the visible sets of a store are, at viewpoints that the build did not use.

At each fresh viewpoint, the weights of all Gaussians give the share of light that the cell's set keeps. Images of the
set alone are compared with images of the full scene. Scene frame and units. Memory holds one cell at a time.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.certificate import CertificateConfig, Certifier
from gsvis.pvs.certified_cells import CertifiedCells, certify_cells
from gsvis.pvs.quality_result import PSNR_CAP, TARGETS, Figure, Quality, QualityConfig, Trade
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.raycast import EllipsoidProxies, Tracer, visible_from
from gsvis.render import psnr, rasterize, view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import space_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, as_levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.solid import buried

__all__ = [
    "PSNR_CAP",
    "TARGETS",
    "Figure",
    "Quality",
    "QualityConfig",
    "Trade",
    "box_space",
    "bytes_of_one",
    "dense_union",
    "find_build_space",
    "measure_quality",
    "space_of_store",
]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_TRIES = 32  # draws of viewpoints until enough lie outside everything solid
_FRESH, _DENSE, _AIMS = range(3)  # random streams of a cell
_TARGETS = 20_000  # most points for cameras to look at, for a space that has none


@dataclass(frozen=True, eq=False)
class _Measured:
    """The rows of `Quality` that belong to one cell."""

    kept: I64
    eyes: F64
    viewmats: F64
    weighted_recall: F64
    recall: F64
    ray_recall: F64
    psnr: F64
    ceiling: F64
    exact: I64
    confirmed: float
    dense: int
    dense_shared: int
    dense_psnr: F64


def measure_quality(
    store: VisibilityStore,
    scene: Gaussians | Levels,
    viewpoints: CellViewpoints,
    config: QualityConfig | None = None,
    *,
    progress: Progress = silent,
) -> Quality:
    """Measure how many of the Gaussians seen by fresh viewpoints and random rays are in the sets of a store.

    The result for a cell depends on the seed and the cell, not on the other cells measured.

    Args:
        store: The visible sets.
        scene: The scene, N Gaussians; or its levels. With levels, only the highest level is measured, against the
            members of the sets that belong to it.
        viewpoints: The viewpoints of the store's cells.
        config: Options; None means `QualityConfig()`.
        progress: Called with stages "quality" and "certificate".

    Returns:
        The measurements.

    Raises:
        FormatError: If the store belongs to another scene, or is damaged.
        ValueError: If the viewpoints belong to other cells.
        SceneError: If no cell has enough viewpoints outside everything solid.
    """
    config = config or QualityConfig()
    store.check_scene(scene)
    levels = as_levels(scene)
    member = levels.member(len(levels) - 1)
    g = levels.union if member.all() else levels.union[member]
    places = np.where(member, member.cumsum() - 1, -1)
    _check_cells(store, viewpoints)
    tracer = Tracer(EllipsoidProxies.from_scene(g)) if config.rays or config.certify else None
    meter = _Meter(store, g, places, viewpoints, config, tracer)
    wanted = len(store) if config.cells is None else min(config.cells, len(store))
    each = config.viewpoints + config.dense
    done: dict[int, _Measured] = {}
    left_out = []
    progress("quality", 0, wanted * each)
    for cell in np.random.default_rng([config.seed, len(store)]).permutation(len(store)).tolist():
        if len(done) == wanted:
            break
        eyes = meter.eyes(cell, config.viewpoints, _FRESH)
        if eyes is None:
            left_out.append(cell)
            continue
        before = len(done) * each

        def within(_stage: str, at: int, _total: int, before: int = before) -> None:
            progress("quality", before + at, wanted * each)

        done[cell] = meter.measure(cell, eyes, within)
    if not done:
        raise SceneError("no cell has a viewpoint outside something solid: there is nothing to measure")
    cells = np.array(sorted(done), np.int64)
    rows = [done[cell] for cell in cells.tolist()]
    dense = config.dense > 0
    stacked = {
        name: np.array([getattr(row, name) for row in rows])
        for name in _Measured.__dataclass_fields__
        if (dense or not name.startswith("dense")) and (config.rays or name != "ray_recall")
    }
    absent = {"ray_recall": None, "dense": None, "dense_shared": None, "dense_psnr": None}
    return Quality(
        config=config,
        gaussians=len(g),
        tau=store.tau,
        class_edges=store.info.class_edges,
        bytes_per_gaussian=config.bytes_per_gaussian or bytes_of_one(g),
        cells=cells,
        centers=store.grid.centers[cells],
        left_out=tuple(sorted(left_out)),
        shown=None if member.all() else member,
        light=meter.certify(cells, progress),
        **{**absent, **stacked},  # type: ignore[arg-type]
    )


def _check_cells(store: VisibilityStore, viewpoints: CellViewpoints) -> None:
    """Raise unless viewpoints are those of the cells of a store."""
    if len(viewpoints.grid) != len(store) or not np.array_equal(viewpoints.grid.coords, store.grid.coords):
        got = f"those of {len(viewpoints.grid)} cells that are not its {len(store)}"
        raise ValueError(f"viewpoints: expected those of the store's cells, got {got}; make them from store.grid")


def dense_union(g: Gaussians, eyes: F64, tau: float, *, size: int = 128, progress: Progress = silent) -> Mask:
    """Return (N,) bool, the Gaussians that at least one of many viewpoints sees; sets are compared with it.

    Args:
        g: The scene.
        eyes: (V, 3) viewpoints.
        tau: Weight from which a Gaussian is visible.
        size: Pixels along a side of the six faces around each viewpoint.
        progress: Called with stage "dense".
    """
    seen = np.zeros(len(g), bool)
    progress("dense", 0, len(eyes))
    for done, eye in enumerate(eyes, 1):
        seen |= _around(g, eye, size)[0] >= np.float32(tau)
        progress("dense", done, len(eyes))
    return seen


def bytes_of_one(g: Gaussians) -> int:
    """Return the bytes of one Gaussian in a 3DGS file: center, rotation, scales, opacity and SH, 32 bits a number."""
    return 4 * (3 + 4 + 3 + 1 + 3 * (g.sh_degree + 1) ** 2)


def find_build_space(store: VisibilityStore, spaces: Iterable[NavigableSpace]) -> tuple[NavigableSpace | None, bool]:
    """Return the space that a store was built in and True, else one of the same grid and False; None if there is none.

    Args:
        store: The store.
        spaces: Spaces of its scene, the likeliest first.
    """
    found = list(spaces)
    for space in found:
        if store.info.config.get("space") == space_hash(space):
            return space, True
    return next((space for space in found if np.array_equal(space.origin, store.grid.origin)), None), False


def space_of_store(store: VisibilityStore, spaces: Iterable[NavigableSpace], g: Gaussians) -> NavigableSpace:
    """Return the space that a store was built in, or the closest one that its cells allow.

    Args:
        store: The store.
        spaces: Spaces of its scene, the likeliest first.
        g: The scene.
    """
    space, is_same = find_build_space(store, spaces)
    if space is None or is_same:
        return space or box_space(store.grid, g)
    voxels = np.argwhere(space.free)
    held = voxels[store.grid.cell_at(space.origin + space.voxel_size * (voxels + 0.5)) >= 0]
    if not len(held):
        return box_space(store.grid, g)
    free = np.zeros_like(space.free)
    free[tuple(held.T)] = True
    return replace(space, free=free, rule=f"{space.rule}, in the cells")


def box_space(grid: CellGrid, g: Gaussians) -> NavigableSpace:
    """Return a navigable space of the whole boxes of cells, for use when the original space is unknown.

    Args:
        grid: The cells.
        g: The scene; cameras look at its Gaussians.
    """
    free = np.zeros(grid.shape, bool)
    free[tuple(grid.coords.T)] = True
    low, high = g.bounds()
    inside = np.flatnonzero(np.all((g.means >= low) & (g.means <= high), axis=1) & (g.opacities >= 0.1))
    targets = g.means[inside[:: max(1, len(inside) // _TARGETS)]].astype(np.float64)
    return NavigableSpace(grid.origin, grid.cell_size, free, grid.up, targets=targets, rule="the boxes of the cells")


@dataclass(frozen=True, eq=False)
class _Meter:
    """Shared state of the measurements of cells."""

    store: VisibilityStore
    g: Gaussians
    places: I64  # row in g of each Gaussian of the store, -1 for those of other levels
    viewpoints: CellViewpoints
    config: QualityConfig
    tracer: Tracer | None

    def eyes(self, cell: int, count: int, stream: int) -> F64 | None:
        """Return (count, 3) random viewpoints in a cell, outside everything solid; None if too few are found."""
        rng = np.random.default_rng([self.config.seed, cell, stream])
        found = np.zeros((0, 3))
        for _ in range(_TRIES):
            drawn = self.viewpoints.draw(cell, count, rng)
            found = np.concatenate([found, drawn[~buried(self.g, drawn)]])
            if len(found) >= count:
                return found[:count]
        return None

    def find_held(self, cell: int) -> tuple[I64, U8]:
        """Return the ids (V,) in g of the set of a cell, and their classes (V,)."""
        ids, classes = self.store.classes(cell)
        there = self.places[ids] >= 0
        return self.places[ids[there]], classes[there]

    def certify(self, cells: I64, progress: Progress) -> CertifiedCells | None:
        """Return the certificates of cells; None if there are none to make."""
        if self.tracer is None or not self.config.certify:
            return None
        config = CertificateConfig(rays=self.config.certify, tau=self.store.tau, seed=self.config.seed)
        sets = [(self.viewpoints.voxels(cell), self.find_held(cell)[0]) for cell in cells.tolist()]
        return certify_cells(Certifier(self.tracer), sets, config, progress=progress)

    def measure(self, cell: int, eyes: F64, progress: Progress) -> _Measured:
        """Return the measurements of one cell; progress counts viewpoints."""
        store = self.store
        g = self.g
        config = self.config
        ids, classes = self.find_held(cell)
        subsets = [ids[classes >= k] for k in range(len(store.info.class_edges))]
        held = np.zeros(len(g), bool)
        held[ids] = True
        ever = np.zeros(len(g), bool)
        if config.dense:
            around = self.eyes(cell, config.dense, _DENSE)
            eyes_of_all = eyes if around is None else around
            size = config.dense_size or config.size
            ever = dense_union(g, eyes_of_all, store.tau, size=size, progress=progress)
        union = np.flatnonzero(ever)
        shared = int(np.count_nonzero(held[union]))
        shape = {"width": config.width, "height": config.height, "fov": config.fov}
        rng = np.random.default_rng([config.seed, cell, _AIMS])
        cameras = self.viewpoints.space.cameras_at(eyes, rng, **shape)  # type: ignore[arg-type]
        count = len(eyes)
        tau = np.float32(store.tau)
        weighted = np.empty((count, len(subsets)))
        images = np.empty((count, len(subsets)))
        recall, by_rays, ceiling, dense_psnr = (np.zeros(count) for _ in range(4))
        exact = np.empty(count, np.int64)
        for v in range(count):
            largest, summed = _around(g, eyes[v], config.size)
            total = summed.sum()
            weighted[v] = [_share(summed[subset].sum(), total) for subset in subsets]
            ever |= largest >= tau
            recall[v] = _recall(largest >= tau, held)
            if self.config.rays and self.tracer is not None:
                by_rays[v] = _recall(visible_from(self.tracer, eyes[v][None], size=config.size)[0] >= tau, held)
            shown = np.flatnonzero(view_weights(g, cameras[v]).largest[0] >= tau)
            exact[v] = len(shown)
            full = _image(g, cameras[v])
            images[v] = [_psnr(g[subset], cameras[v], full) for subset in subsets]
            ceiling[v] = _psnr(g[shown], cameras[v], full)
            if config.dense:
                dense_psnr[v] = _psnr(g[union], cameras[v], full)
            progress("quality", config.dense + v + 1, config.dense + count)
        return _Measured(
            np.array([len(subset) for subset in subsets], np.int64),
            eyes,
            cameras.viewmats.astype(np.float64),
            weighted,
            recall,
            by_rays,
            images,
            ceiling,
            exact,
            _share(int(np.count_nonzero(ever[ids])), len(ids)),
            len(union),
            shared,
            dense_psnr,
        )


def _around(g: Gaussians, eye: F64, size: int) -> tuple[F32, F64]:
    """Return (N,) the largest weight of each Gaussian around an eye, and (N,) the sum of its weights over pixels."""
    largest = np.zeros(len(g), np.float32)
    summed = np.zeros(len(g))
    faces = Cameras.cubemap(eye[None], size)
    for c in range(len(faces)):
        seen = view_weights(g, faces[c])
        np.maximum(largest, seen.largest[0], out=largest)
        summed += seen.summed[0]
    return largest, summed


def _recall(seen: Mask, held: Mask) -> float:
    """Return the share of the seen Gaussians that the set holds."""
    return _share(int(np.count_nonzero(seen & held)), int(np.count_nonzero(seen)))


def _share(part: float, whole: float) -> float:
    """Return part over whole, at most 1; 1 if the whole is 0."""
    return min(1.0, float(part) / float(whole)) if whole else 1.0


def _image(g: Gaussians, camera: Cameras) -> F32:
    """Return the (H, W, 3) image of a camera, clipped to [0, 1] as a display does."""
    return np.asarray(np.clip(rasterize(g, camera, backend="cpu").images[0], 0.0, 1.0), np.float32)


def _psnr(g: Gaussians, camera: Cameras, full: F32) -> float:
    return min(PSNR_CAP, float(psnr(_image(g, camera), full)))
