"""Open a package, levels or one scene for export, as levels with visible sets and facts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.export.start import Start
from gsvis.package.package import Package
from gsvis.package.unpack import unpack_levels
from gsvis.progress import Progress
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, as_levels

__all__ = ["Known", "ever_seen", "open_levels"]


@dataclass(frozen=True)
class Known:
    """Facts that a package states; all unknown for a bare scene."""

    up: tuple[float, float, float] | None = None
    poses: tuple[Start, ...] = ()
    meters_per_unit: float | None = None


def open_levels(
    scene: Package | Levels | Gaussians, visibility: VisibilityStore | None, progress: Progress
) -> tuple[Levels, VisibilityStore | None, Known]:
    """Return the levels of a scene with SH colors, its visible sets, and its facts."""
    if isinstance(scene, Package):
        if visibility is not None:
            raise ValueError("visibility: expected none with a package, which has its own, got some; leave it out")
        manifest = scene.manifest
        meters = manifest.info.meters_per_unit or None
        known = Known(manifest.info.up, tuple(Start.from_dict(view) for view in manifest.views), meters)
        store = None if manifest.visibility is None else scene.visibility
        return unpack_levels(scene, progress=progress), store, known
    if len(scene.union if isinstance(scene, Levels) else scene) == 0:
        raise SceneError("scene: expected at least one Gaussian, got none; name another scene")
    if visibility is not None:
        visibility.check_scene(scene)
    return as_levels(scene), visibility, Known()


def ever_seen(store: VisibilityStore, count: int) -> NDArray[np.bool_]:
    """Return a mask (N,): whether any cell sees each Gaussian."""
    seen = np.zeros(count, np.bool_)
    seen[np.asarray(store.ever_visible().to_array(), np.int64)] = True
    return seen
