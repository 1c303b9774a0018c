"""Fit SRBF colors of a scene: find the directions that see each Gaussian, find its importance, then fit.

Directions are traced outward into navigable space and joined with those of sampled views. Importance comes from the
views. Levels are traced and viewed one by one, and fitted once. Scene frame and units. The views that measure a fit
are drawn apart from the views of the fit.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color.fit import FitConfig, SrbfFit, fit_srbf
from gsvis.jobs.resume import KeptWork
from gsvis.progress import Progress, silent
from gsvis.render.rasterizer import BACKENDS
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import scene_hash, space_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.icosphere import NUM_FACES
from gsvis.scene.levels import Levels, as_levels, level_scenes, levels_record, union_of
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["DIRECTIONS", "ColorConfig", "ColorPreparation", "find_kept", "prepare_colors"]

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

DIRECTIONS = ("weighed", "faces")
"""Ways in which the directions of a set count in the fit of colors."""

_PLAN = 2  # increase it when the same plan gives another result
_BLOCK = 8192  # Gaussians traced between two saves
_VIEWS = ViewSampling(256)
_FOUND = "found.npz"  # the one file that is kept


@dataclass(frozen=True)
class ColorConfig:
    """Options of the preparation of colors.

    Args:
        fit: Options of the fit.
        views: Views that give the importance of Gaussians; with no view, all have the same importance.
        rays_per_face: Rays traced outward over each of the 80 directions: 1, 4, 16 or 64; 0 traces none.
        directions: How the directions of a set count in the fit; one of `DIRECTIONS`. "weighed": more where views see
            more, and a little outside the set; see `direction_weights`. "faces": all of the set alike, and none outside
            (paper, section 3.1).
        precision: "wire" or "coarse": bits of the records of a package, see `gsvis.color.PRECISIONS`. The fit does not
            depend on it.
        record_psnr: PSNR in dB that images of rounded records keep against exact ones; they are rounded as coarsely as
            that allows, see `choose_limits`. None keeps all bits. The fit does not depend on it.
        backend: Backend that draws while colors are learned: "cuda" on a GPU. The fit does not depend on it.

    Raises:
        ValueError: If a value is out of range.
    """

    fit: FitConfig = field(default_factory=FitConfig)
    views: ViewSampling = _VIEWS
    rays_per_face: int = 1
    directions: str = "weighed"
    precision: str = "wire"
    record_psnr: float | None = None
    backend: str = "auto"

    def __post_init__(self) -> None:
        if self.record_psnr is not None and not 0.0 < self.record_psnr <= 100.0:
            raise ValueError(f"record_psnr: expected dB in (0, 100] or None, got {self.record_psnr!r}")
        _check.one_of("directions", self.directions, DIRECTIONS)
        _check.one_of("precision", self.precision, ("wire", "coarse"))
        _check.one_of("backend", self.backend, BACKENDS)
        if self.rays_per_face not in (0, 1, 4, 16, 64):
            raise ValueError(f"rays_per_face: expected 0, 1, 4, 16 or 64, got {self.rays_per_face!r}")
        if self.rays_per_face == 0 and self.views.count == 0:
            raise ValueError("rays_per_face: expected some where no view gives directions, got 0")


@dataclass(frozen=True, eq=False)
class ColorPreparation:
    """Colors, and the data of their fit.

    Attributes:
        fit: The colors and their errors.
        sets: (N, 10) uint8 direction sets.
        importance: (N,) weight of a squared error of each Gaussian's color; ones if no views were used.
        views: The views used for the fit, so do not measure the fit in them; None if none were used.
        sets_from: Where the directions come from, as a phrase.
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
    """Find directions and importance of a scene's Gaussians, and fit their colors.

    A scene without view dependence (SH degree 0) gets base colors and no terms. Nothing is traced then.

    Different levels hide different Gaussians. So each level is traced and viewed alone, and the direction set of a
    Gaussian holds the directions from which any level shows it. Its color is fitted once for all levels.

    Args:
        g: N Gaussians; or levels with a union of N.
        navigable: The navigable space; None only for a scene of SH degree 0.
        config: Options; None means `ColorConfig()`.
        sets: (N, 10) uint8 known direction sets, such as `VisibilityStore.direction_sets`; None traces them.
        keep: The file that the caller will write from the result. Directions and importance are kept beside it, so
            that a killed run resumes. They stay until the caller removes `find_kept`. None keeps nothing.
        progress: Called with stages "directions", "importance", "price" and "fit".

    Raises:
        ValueError: If the sets do not have this scene's size, or there is no navigable space.
        SceneError: If the scene has nothing to see, or no viewpoint is usable.
        OSError: If the kept work cannot be written.

    References:
        SRBF-Gaussian, sections 3.1 and 5.
    """
    config = config or ColorConfig()
    union = union_of(g)
    given = None if sets is None else _check_sets(sets, len(union))
    if union.sh_degree == 0 or len(union) == 0:
        fit = fit_srbf(union, None, replace(config.fit, max_terms=0), progress=progress)
        everywhere = np.full((len(union), NUM_FACES // 8), 255, np.uint8)
        ones = np.ones(len(union))
        return ColorPreparation(fit, everywhere, ones, None, "none needed: no color depends on direction")
    if navigable is None:
        raise ValueError("navigable: expected the space where eyes may be, got None; give one, such as a box")
    from gsvis.prepare.importance import direction_weights, importance_from_views

    kept = None if keep is None else KeptWork.beside(keep, _plan(g, navigable, config, given))
    n = len(union)
    like: dict[str, Any] = {
        "sets": ((n, NUM_FACES // 8), np.uint8),
        "traced": ((1,), np.int64),
        "importance": ((n,), np.float64),
        "shares": ((n, NUM_FACES), np.uint8),
    }
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
    elif "importance" not in found or "shares" not in found:
        seen = importance_from_views(g, views, progress=progress)
        found["sets"] |= seen.sets
        found["importance"], found["shares"] = seen.importance, seen.shares
        del seen  # 320 bytes a Gaussian
        if kept is not None:
            kept.keep_arrays(_FOUND, found)
    directions = found["sets"] if given is None else found["sets"] | given
    sources += "" if levels_record(g) is None else ", in each level"
    shares = found.get("shares")

    def weigh(ids: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the weights of the faces of some Gaussians."""
        return direction_weights(directions[ids], None if shares is None else shares[ids])

    seen_from = weigh if config.directions == "weighed" else directions
    fit = fit_srbf(union, seen_from, config.fit, importance=found["importance"], progress=progress)
    return ColorPreparation(fit, directions, found["importance"], views, sources)


def find_kept(
    g: Gaussians | Levels,
    navigable: NavigableSpace | None,
    config: ColorConfig,
    keep: str | os.PathLike[str],
    *,
    sets: ArrayLike | None = None,
) -> KeptWork | None:
    """Return the kept work of `prepare_colors`, for a caller that wants to name or remove it.

    Args:
        g: The scene or levels of `prepare_colors`.
        navigable: The navigable space of `prepare_colors`.
        config: The options of `prepare_colors`.
        keep: The file that the caller will write.
        sets: (N, 10) uint8 known direction sets, or None.

    Returns:
        The kept work, which may be empty; None if this preparation keeps nothing.
    """
    union = union_of(g)
    if navigable is None or union.sh_degree == 0:
        return None
    given = None if sets is None else _check_sets(sets, len(union))
    return KeptWork.beside(keep, _plan(g, navigable, config, given))


def _plan(g: Gaussians | Levels, navigable: NavigableSpace, config: ColorConfig, sets: U8 | None) -> dict[str, Any]:
    """Return the record of everything that decides directions and importance."""
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
    """Trace direction sets outward into `found`, resume an earlier run, and save after each block."""
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
        begin = end
        end = end + len(scene)
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
    """Return checked direction sets."""
    array = np.ascontiguousarray(sets)
    if array.dtype != np.uint8 or array.shape != (count, NUM_FACES // 8):
        wanted = f"uint8 of shape ({count}, {NUM_FACES // 8})"
        raise ValueError(f"sets: expected {wanted}, got {array.dtype} of {array.shape}; those of this scene")
    return array
