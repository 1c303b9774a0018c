"""SRBF colors of a scene from the scene alone: from where each Gaussian can be seen, what it counts, and the fit.

Directions are traced outward into navigable space and joined with those of sampled views; how much each Gaussian counts
comes from the views. Levels are traced and viewed one by one, and fitted once. Scene frame and units. The views
that a fit is judged by are drawn apart from those of the fit.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.color.fit import FitConfig, SrbfFit, fit_srbf
from gsvis.files.resume import KeptWork
from gsvis.progress import Progress, silent
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import scene_hash, space_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.icosphere import NUM_FACES
from gsvis.scene.levels import Levels, as_levels, level_scenes, levels_record, union_of
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["ColorConfig", "ColorPreparation", "find_kept", "prepare_colors"]

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

_PLAN = 1  # raised whenever the same plan would find something else
_BLOCK = 8192  # Gaussians traced before what was found is kept
_FOUND = "found.npz"  # all that is kept


@dataclass(frozen=True)
class ColorConfig:
    """How colors are prepared.

    Args:
        fit: What is fitted, and how hard.
        views: From where it is asked how much each Gaussian counts; with none, all count alike.
        rays_per_face: Rays traced outward over each of the 80 directions: 0 for none, 1, 4, 16 or 64.

    Raises:
        ValueError: If a value is out of range.
    """

    fit: FitConfig = field(default_factory=FitConfig)
    views: ViewSampling = field(default_factory=ViewSampling)
    rays_per_face: int = 1

    def __post_init__(self) -> None:
        if self.rays_per_face not in (0, 1, 4, 16, 64):
            raise ValueError(f"rays_per_face: expected 0, 1, 4, 16 or 64, got {self.rays_per_face!r}")
        if self.rays_per_face == 0 and self.views.count == 0:
            raise ValueError("rays_per_face: expected some where no view tells directions, got 0")


@dataclass(frozen=True, eq=False)
class ColorPreparation:
    """Colors, and what they were fitted to.

    Attributes:
        fit: The colors and their errors.
        sets: (N, 10) uint8 direction sets.
        importance: (N,) what a squared error of each Gaussian's color counts; ones where no view was asked.
        views: The views that were asked; their results must not be judged by them.
        sets_from: Where directions come from, as a phrase.
    """

    fit: SrbfFit
    sets: U8
    importance: F64
    views: Cameras | None
    sets_from: str


def prepare_colors(
    g: Gaussians | Levels,
    navigable: NavigableSpace | None,
    config: ColorConfig | None = None,
    *,
    sets: ArrayLike | None = None,
    keep: str | os.PathLike[str] | None = None,
    progress: Progress = silent,
) -> ColorPreparation:
    """Directions, importance and fit of the colors of a scene.

    A scene without view dependence (SH degree 0) gets base colors and no terms; nothing is traced then.

    What hides a Gaussian differs from level to level, so levels are traced and viewed each by itself: the set of a
    Gaussian holds the directions from which any level shows it. Its color is fitted once, whichever levels share it.

    Args:
        g: N Gaussians; or levels of which N are the union.
        navigable: Where eyes may be; None only for a scene of SH degree 0.
        config: How; None means `ColorConfig()`.
        sets: (N, 10) uint8 direction sets that are known, such as `VisibilityStore.direction_sets`; None traces them.
        keep: The file that will be made of this. What was found is kept beside it until `find_kept` is removed, so
            that a run which is killed and started again traces nothing twice. None keeps nothing.
        progress: Called with stages "directions", "importance", "price" and "fit".

    Raises:
        ValueError: If the sets are not of this scene's size, or there is no navigable space.
        SceneError: If nothing can be seen, or from nowhere.
        OSError: If what is to be kept cannot be written.

    References:
        SRBF-Gaussian, sections 3.1 and 5.
    """
    config = config or ColorConfig()
    union = union_of(g)
    given = None if sets is None else _check_sets(sets, len(union))
    if union.sh_degree == 0 or len(union) == 0:
        fit = fit_srbf(union, None, replace(config.fit, max_terms=0), progress=progress)
        everywhere, ones = np.full((len(union), NUM_FACES // 8), 255, np.uint8), np.ones(len(union))
        return ColorPreparation(fit, everywhere, ones, None, "none needed: no color depends on direction")
    if navigable is None:
        raise ValueError("navigable: expected the space where eyes may be, got None; give one, such as a box")
    kept = None if keep is None else KeptWork.beside(keep, _plan(g, navigable, config, given))
    n = len(union)
    like: dict[str, Any] = {
        "sets": ((n, NUM_FACES // 8), np.uint8), "traced": ((1,), np.int64), "importance": ((n,), np.float64)
    }  # fmt: skip
    found = {} if kept is None else kept.read_arrays(_FOUND, like)
    if given is None and config.rays_per_face > 0:
        _trace(as_levels(g), navigable, config.rays_per_face, kept, found, progress)
        rays = "1 ray" if config.rays_per_face == 1 else f"{config.rays_per_face} rays"
        sources = f"traced outward ({rays} for each of 80) and gathered from the views of the fit"
    else:
        found.setdefault("sets", np.zeros((len(union), NUM_FACES // 8), np.uint8))
        sources = "gathered from the views of the fit"
        sources = sources if given is None else f"of the visible sets and {sources}"
    views = config.views.cameras(g, navigable) if config.views.count else None
    if views is None:
        found["importance"] = np.ones(len(union))
        sources = sources.replace(" and gathered from the views of the fit", "")
    elif "importance" not in found:
        from gsvis.prepare.importance import importance_from_views  # imports torch

        seen = importance_from_views(g, views, progress=progress)
        found["sets"] |= seen.sets
        found["importance"] = seen.importance
        if kept is not None:
            kept.keep_arrays(_FOUND, found)
    directions = found["sets"] if given is None else found["sets"] | given
    sources += "" if levels_record(g) is None else ", in each level"
    fit = fit_srbf(union, directions, config.fit, importance=found["importance"], progress=progress)
    return ColorPreparation(fit, directions, found["importance"], views, sources)


def find_kept(
    g: Gaussians | Levels,
    navigable: NavigableSpace | None,
    config: ColorConfig,
    keep: str | os.PathLike[str],
    *,
    sets: ArrayLike | None = None,
) -> KeptWork | None:
    """Return where a preparation keeps what it finds, to name it and to remove it.

    Args:
        g: The scene or levels, as given to `prepare_colors`.
        navigable: The space, as given there.
        config: How, as given there.
        keep: The file that will be made.
        sets: The direction sets that are known.

    Returns:
        The work, of which nothing need be there; None where nothing is ever kept.
    """
    union = union_of(g)
    if navigable is None or union.sh_degree == 0:
        return None
    given = None if sets is None else _check_sets(sets, len(union))
    return KeptWork.beside(keep, _plan(g, navigable, config, given))


def _plan(g: Gaussians | Levels, navigable: NavigableSpace, config: ColorConfig, sets: U8 | None) -> dict[str, Any]:
    """All that decides what is found before the fit."""
    record = levels_record(g)
    return {
        "version": _PLAN,
        "scene": scene_hash(union_of(g)),
        **({} if record is None else {"levels": record}),
        "space": space_hash(navigable),
        "views": asdict(config.views),
        "rays_per_face": None if sets is not None else config.rays_per_face,
        "sets": None if sets is None else hashlib.sha256(sets.tobytes()).hexdigest(),
    }


def _trace(
    levels: Levels,
    navigable: NavigableSpace,
    rays: int,
    kept: KeptWork | None,
    found: dict[str, NDArray[Any]],
    progress: Progress,
) -> None:
    """Direction sets traced outward into `found`, from where an earlier run stood; kept block by block."""
    from gsvis.raycast import EllipsoidProxies, Tracer
    from gsvis.raycast.directions import trace_directions

    total = sum(levels.counts)
    if "sets" not in found or "traced" not in found:
        found.clear()
        found.update(sets=np.zeros((len(levels.union), NUM_FACES // 8), np.uint8), traced=np.zeros(1, np.int64))
    done = int(found["traced"][0])
    progress("directions", done, total)
    end = 0
    for scene, places in level_scenes(levels):
        begin, end = end, end + len(scene)
        if done >= end:
            continue
        tracer = Tracer(EllipsoidProxies.from_scene(scene))
        for start in range(max(done - begin, 0), len(scene), _BLOCK):
            ids = np.arange(start, min(start + _BLOCK, len(scene)))

            def within(_stage: str, at: int, _total: int, before: int = begin + start) -> None:
                progress("directions", before + at, total)

            found["sets"][places[ids]] |= trace_directions(
                tracer, navigable, ids=ids, rays_per_face=rays, progress=within
            )
            found["traced"] = np.array([begin + ids[-1] + 1], np.int64)
            if kept is not None:
                kept.keep_arrays(_FOUND, found)


def _check_sets(sets: ArrayLike, count: int) -> U8:
    array = np.ascontiguousarray(sets)
    if array.dtype != np.uint8 or array.shape != (count, NUM_FACES // 8):
        wanted = f"uint8 of shape ({count}, {NUM_FACES // 8})"
        raise ValueError(f"sets: expected {wanted}, got {array.dtype} of {array.shape}; those of this scene")
    return array
