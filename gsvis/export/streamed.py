"""Write a scene as streamed SOG with a sidecar of visibility, for existing viewers.

PlayCanvas' engine, its viewers and splat-transform read the scene unchanged; docs/streamed.md describes the sidecar,
and a loader in `examples/engines` uses it.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.export.leaves import LEAF, cut_leaves
from gsvis.export.level_errors import measure_errors, pick_eyes
from gsvis.export.levels import ever_seen, open_levels
from gsvis.export.needs import LOST, LeafNeeds, LevelTable, find_needs, scene_sum
from gsvis.export.start import Start, rich_poses, start_poses
from gsvis.io.streamed_sog_writer import check_streamed_target, save_streamed_sog
from gsvis.package.package import Package
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

__all__ = ["StreamedOptions", "StreamedReport", "write_streamed_sog"]

_SHARE = 0.01  # largest share of the sidecar in the bytes of the scene


@dataclass(frozen=True)
class StreamedOptions:
    """Options of a streamed SOG and its sidecar.

    Attributes:
        leaf: Largest number of Gaussians of a leaf at one level.
        lost: Largest share of the light of a cell in the leaves that its row omits.
        never_seen: "keep" writes Gaussians that no cell sees; "drop" omits them, which is visible from outside.
        name: Name for people.
        up: (3,) axis that points upward; None means that of the package or the visible sets, or +z.
        poses: Start views; None takes those of the package, or finds some.

    Raises:
        ValueError: If a value is out of its range.
    """

    leaf: int = LEAF
    lost: float = LOST
    never_seen: Literal["keep", "drop"] = "keep"
    name: str = "scene"
    up: tuple[float, float, float] | None = None
    poses: tuple[Start, ...] | None = None

    def __post_init__(self) -> None:
        _check.positive_int("leaf", self.leaf, at_least=64)
        _check.one_of("never_seen", self.never_seen, ("keep", "drop"))
        if not 0.0 <= self.lost < 1.0:
            raise ValueError(f"lost: expected a share in [0, 1), got {self.lost!r}")
        if self.up is not None:
            _check.unit_vectors("up", np.reshape(np.asarray(self.up, np.float64), (1, -1)))


@dataclass(frozen=True)
class StreamedReport:
    """Result of `write_streamed_sog`.

    Attributes:
        path: The folder.
        counts: Gaussians of each level of detail, finest first, without the environment.
        environment: Gaussians of the environment.
        leaves: B, the number of leaves.
        cells: Cells of the visible sets; 0 without visible sets.
        needed: Mean share of the Gaussians of level 0 in the leaves that a cell needs; 1 without visible sets.
        never_seen: Gaussians that no cell sees; None without visible sets.
        dropped: Whether these were omitted.
        sidecar: Name of the sidecar.
        sidecar_nbytes: Bytes of the sidecar.
        nbytes: Total bytes.
        up: (3,) axis that points upward. Viewers of PlayCanvas take -y.
    """

    path: Path
    counts: tuple[int, ...]
    environment: int
    leaves: int
    cells: int
    needed: float
    never_seen: int | None
    dropped: bool
    sidecar: str
    sidecar_nbytes: int
    nbytes: int
    up: tuple[float, float, float]


def write_streamed_sog(
    folder: str | PathLike[str],
    scene: Package | Levels | Gaussians,
    options: StreamedOptions | None = None,
    *,
    visibility: VisibilityStore | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> StreamedReport:
    """Write streamed SOG: `lod-meta.json`, a folder for each leaf and level, and the sidecar.

    Args:
        folder: Folder of the scene; new, empty, or with `overwrite` one that gsvis wrote before.
        scene: A package; levels, whose highest becomes level of detail 0; or Gaussians.
        options: Division into leaves; None means `StreamedOptions()`.
        visibility: Visible sets of the scene; None means those of the package, or none.
        overwrite: Replace an earlier scene.
        progress: Called with stages "sets", "errors" and "export", and by the fit of SH colors for a package with
            terms.

    Raises:
        ValueError: If the folder holds something else; or never seen Gaussians are to be dropped without visible sets.
        SceneError: If the scene is empty, or nothing would be left.
        FormatError: If the visible sets belong to a different scene, or the package is damaged.
        OSError: If the folder cannot be written.
    """
    target = _check.path("folder", folder)
    said = options or StreamedOptions()
    check_streamed_target(target, overwrite)
    levels, store, known = open_levels(scene, visibility, progress)
    seen = None if store is None else ever_seen(store, len(levels.union))
    if seen is None and said.never_seen == "drop":
        raise ValueError(
            "never_seen: expected visible sets to know what is never seen, got none; give some, or keep it"
        )
    if seen is not None and said.never_seen == "drop" and not seen.any():
        raise SceneError("everything would go: no cell sees a Gaussian; nothing written")
    kept = seen if said.never_seen == "drop" else None
    leaves = cut_leaves(levels, most=said.leaf, kept=kept, lowest=levels.previews)
    needs = find_needs(leaves, store, lost=said.lost, progress=progress)
    grid = None if store is None else store.grid
    up = said.up or known.up or ((0.0, 0.0, 1.0) if grid is None else tuple(grid.up.tolist()))
    poses = said.poses or known.poses or _poses(levels, store, up)
    errors = measure_errors(leaves, _eyes(needs, store, poses), progress)
    facts: dict[str, Any] = {
        "name": said.name,
        "up": [float(v) for v in up],
        "poses": [pose.as_dict() for pose in poses],
        "never_seen": {"gaussians": None if seen is None else int((~seen).sum()), "kept": said.never_seen == "keep"},
    }
    beside: dict[str, bytes] = {}

    def sidecar(sizes: NDArray[np.int64], names: list[str]) -> dict[str, bytes]:
        """Return the sidecar by name, from the bytes and the names of the files of leaves."""
        table = LevelTable(leaves.counts, sizes, errors)
        data = needs.encode_within({**facts, "scene": scene_sum(names)}, table, int(_SHARE * sizes.sum()))
        beside[f"leaves-{hashlib.sha256(data).hexdigest()[:16]}.bin"] = data
        return beside

    written = save_streamed_sog(leaves.as_scene(), target, beside=sidecar, progress=progress)
    ((name, data),) = beside.items()
    share = needs.needed @ leaves.counts[0] / max(1, leaves.counts[0].sum())
    return StreamedReport(
        path=target,
        counts=tuple(int(n) for n in leaves.counts.sum(axis=1)),
        environment=len(leaves.environment),
        leaves=len(leaves),
        cells=0 if store is None else len(store),
        needed=float(share.mean()) if len(share) else 1.0,
        never_seen=None if seen is None else int((~seen).sum()),
        dropped=said.never_seen == "drop",
        sidecar=name,
        sidecar_nbytes=len(data),
        nbytes=written.nbytes,
        up=up,
    )


def _eyes(needs: LeafNeeds, store: VisibilityStore | None, poses: tuple[Start, ...]) -> NDArray[np.float64]:
    """Return (E, 3) eyes around which the errors of levels are measured: middles of cells, or start views."""
    if store is None:
        return np.array([pose.position for pose in poses], np.float64).reshape(-1, 3)
    return np.asarray(store.grid.centers[pick_eyes(needs.lights)], np.float64)


def _poses(levels: Levels, store: VisibilityStore | None, up: tuple[float, float, float]) -> tuple[Start, ...]:
    """Return start views: from cells, or from outside without cells."""
    if store is None:
        return start_poses(levels.union.bounds(0.9), None, up)
    return rich_poses(levels.level(len(levels) - 1), store.grid, up)
