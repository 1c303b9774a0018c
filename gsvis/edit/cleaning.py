"""Clean a scene: find masks of unseen Gaussians, fog, floaters and flyaways. Scene frame. Writes no file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.edit.classes import CLASSES, KEPT, CleanConfig, class_of, classify
from gsvis.edit.evidence import Evidence, gather_evidence
from gsvis.edit.guard import Cost, guard
from gsvis.edit.judged import judge_cleaning
from gsvis.edit.places import find_in_parcels
from gsvis.edit.shape import Shape
from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.render.judges import count_views
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.judged import Judged
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["Cleaning", "clean", "core_of", "held_out_cameras", "judge"]

# of held-out views
_WIDTH = 320
_HEIGHT = 240
_FOV = 75.0
_STREAM = 2  # of the seed, for held-out views; the next two are for further ones
_SMALL = (96, 72)  # pixels of views that are judged
_USUAL = 8  # held-out views from which there are as many to judge as elsewhere
# Gaussians drawn in further views of the guard, and most of these views
_DRAWN = 12_000_000
_MOST = 256


@dataclass(frozen=True, eq=False)
class Cleaning:
    """Gaussians that can go from a scene of N Gaussians.

    Attributes:
        classes: (N,) uint8, 0 for Gaussians that stay, else 1 + the index in `CLASSES`.
        found: (N,) uint8, the classes before the guard restored Gaussians.
        costs: Loss of held-out views by class, and for "all"; empty without a guard.
        evidence: The evidence for the classes.
        navigable: The space of the eyes.
        cameras: The held-out cameras; None without a guard.
        judged: Quality at eyes that are independent of navigable space; None without a guard.
    """

    classes: NDArray[np.uint8]
    found: NDArray[np.uint8]
    costs: dict[str, Cost]
    evidence: Evidence
    navigable: NavigableSpace
    cameras: Cameras | None
    judged: Judged | None = None

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(N,) True for Gaussians that stay."""
        return np.asarray(self.classes == KEPT)

    @property
    def counts(self) -> dict[str, int]:
        """Number of Gaussians that go, by class."""
        return {name: int(np.count_nonzero(self.mask(name))) for name in CLASSES}

    def mask(self, name: str) -> NDArray[np.bool_]:
        """Return (N,) the Gaussians of one class of `CLASSES`.

        Raises:
            ValueError: If no class has that name.
        """
        return np.asarray(self.classes == class_of(name))


def clean(
    g: Gaussians,
    *,
    navigable: NavigableSpace | None = None,
    cameras: Cameras | None = None,
    config: CleanConfig | None = None,
    progress: Progress = silent,
) -> Cleaning:
    """Find the Gaussians of a scene that can go.

    Args:
        g: The scene, N Gaussians.
        navigable: Allowed viewpoints; None finds them, ignoring haze and flyaways.
        cameras: Cameras of photographs, whose viewpoints are eyes too.
        config: Classes, strength and guard; None means `CleanConfig()`.
        progress: Called with stages "space", "air", "viewpoints", "structure", "directions", "guard"
            and "judge".

    Returns:
        Masks, costs and evidence; nothing is removed. `g[result.kept]` is the clean scene.

    Raises:
        SceneError: If the scene has no Gaussian that can be seen, or no navigable space.
        ValueError: If an argument is out of range.

    Examples:
        >>> from gsvis.scene.procedural import box_in_room
        >>> room = box_in_room(2000)
        >>> found = clean(room.gaussians, navigable=room.navigable, config=CleanConfig(eyes=4, held_out=0))
        >>> found.counts["fog"], found.counts["floaters"]
        (0, 0)
    """
    config = config or CleanConfig()
    shape = Shape.from_scene(g)
    viewpoints = None if cameras is None else cameras.viewpoints
    if navigable is None:
        progress("space", 0, 1)
        core = core_of(g, shape)
        navigable = NavigableSpace.from_scene(core, seeds=viewpoints)
        if viewpoints is None:
            navigable = find_in_parcels(core, navigable, progress=progress)
        progress("space", 1, 1)
    evidence = gather_evidence(g, shape, navigable, config, viewpoints=viewpoints, progress=progress)
    return judge(g, shape, navigable, evidence, config, progress=progress)


def judge(
    g: Gaussians,
    shape: Shape,
    navigable: NavigableSpace,
    evidence: Evidence,
    config: CleanConfig,
    *,
    progress: Progress = silent,
) -> Cleaning:
    """Find the Gaussians that can go by the evidence, and check held-out views.

    Args:
        g: The scene, N Gaussians.
        shape: Its shape.
        navigable: Allowed viewpoints.
        evidence: Evidence for the first M Gaussians; the others stay.
        config: The classes and the guard.
        progress: Called with stages "guard" and "judge".

    Raises:
        SceneError: If all held-out viewpoints lie inside something solid.
    """
    found = np.zeros(len(g), np.uint8)
    found[: len(evidence.seen)] = classify(evidence, config)
    classes = found
    costs = dict[str, Cost]()
    held_out = None
    judged = None
    if config.held_out:
        held_out = held_out_cameras(g, shape, navigable, config.held_out, config.seed)
        count = int(np.clip(_DRAWN // len(g), 0, _MOST))  # a few seconds of work
        more = held_out_cameras(g, shape, navigable, count, config.seed, stream=_STREAM + 1) if count else None
        classes, costs = guard(g, found, held_out, config, more=more, progress=progress)
        judged = _judge_eyes(g, shape, navigable, classes == KEPT, config, progress)
    return Cleaning(classes, found, costs, evidence, navigable, held_out, judged)


def _judge_eyes(
    g: Gaussians,
    shape: Shape,
    navigable: NavigableSpace,
    kept: NDArray[np.bool_],
    config: CleanConfig,
    progress: Progress,
) -> Judged:
    """Return quality at builder's and judge's eyes; uses few eyes if few views are held out, as in tests."""
    views = ViewSampling(count_views(config.held_out, _USUAL), *_SMALL, _FOV, config.seed, _STREAM + 2)
    return judge_cleaning(g, kept, core_of(g, shape), views, navigable, progress=progress)


def core_of(g: Gaussians, shape: Shape | None = None) -> Gaussians:
    """Return the Gaussians that form the surfaces of a scene, between which navigable space is searched.

    Args:
        g: The scene.
        shape: Its shape; None measures it.

    Raises:
        SceneError: If nothing is left.
    """
    core = g[(shape or Shape.from_scene(g)).surfaces]
    if not len(core):
        raise SceneError("the scene has nothing but haze and Gaussians far outside: no surface is left to look at")
    return core


def held_out_cameras(
    g: Gaussians, shape: Shape, navigable: NavigableSpace, count: int, seed: int, *, stream: int = _STREAM
) -> Cameras:
    """Return random cameras in navigable space that are independent of the evidence.

    Args:
        g: The scene.
        shape: Its shape; eyes may lie inside haze.
        navigable: Allowed viewpoints.
        count: Number of cameras.
        seed: Seed of the cameras.
        stream: Index of one of the seed's independent random streams.

    Raises:
        SceneError: If all viewpoints drawn lie inside something solid.
    """
    sampling = ViewSampling(count, _WIDTH, _HEIGHT, _FOV, seed, stream)
    return sampling.cameras(core_of(g, shape), navigable)
