"""Simulate visits of scenes, one after the other over one link: each scene is sent in three ways along a walk.

places = [Place.open(package) for package in packages]
visits = simulate_visits(places, load_path("walk.csv"), link, config)
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.abr import AbrConfig
from gsvis.errors import ArgumentError, SceneError
from gsvis.files.output import TEMPORARY, output_errors
from gsvis.files.temporary import temporary_folder
from gsvis.io.sog_writer import save_sog
from gsvis.package.contents import Contents
from gsvis.package.package import Package
from gsvis.progress import Progress, silent
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.retarget import RetargetConfig, retarget
from gsvis.simulate.baselines import MortonProgressive, WholeFile, morton_order
from gsvis.simulate.delivery import Adaptive, Delivery
from gsvis.simulate.frames import Stage
from gsvis.simulate.link import Link
from gsvis.simulate.playback import play
from gsvis.simulate.viewing import Viewing, ViewingConfig, show_at, watch
from gsvis.stream import StreamedScene

__all__ = ["AS_IS", "Place", "Visit", "simulate_visits"]

AS_IS = "if the path lies in the scene, ask for it as it is (--as-is)"
"""What to do about a scene without a space to walk in."""

Picture = tuple[float, str, NDArray[np.float32]]

_SHOWN_AT = (0.5, 2.0)  # seconds of the pictures
_AFTER = 1.0  # seconds of the walk beyond a visit, for prediction


@dataclass(frozen=True, eq=False)
class Place:
    """A scene prepared for visits, once for any number of them.

    Attributes:
        title: Name of the scene.
        scene: The scene, ready to stream.
        contents: Its records.
        highest: (N,) which Gaussians belong to the full scene.
        reference: The scene before it was packaged, to compare with; None compares with the package.
        whole_file: Bytes of the scene as one file, and how they were measured.
        space: Navigable space to move the walk into; None leaves the walk unchanged.
        whole: What the scene is, for reports.
        facts: More facts on the scene, ready for JSON.
    """

    title: str
    scene: StreamedScene
    contents: Contents
    highest: NDArray[np.bool_]
    reference: Gaussians | None
    whole_file: tuple[int, str]
    space: NavigableSpace | None
    whole: str = "the package"
    facts: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def open(
        cls,
        package: Package,
        *,
        reference: Gaussians | None = None,
        whole_file: str | os.PathLike[str] | None = None,
        as_is: bool = False,
    ) -> Place:
        """Prepare a package for visits; it must stay open.

        Args:
            package: The package.
            reference: The scene before it was packaged.
            whole_file: A file or folder of the scene, to take its size; None measures the scene as SOG.
            as_is: Whether to leave walks unchanged, because they lie in the scene.

        Raises:
            SceneError: If the scene is empty, or has no navigable space.
            ArgumentError: If the whole file is empty.
        """
        scene = StreamedScene.open(package)
        contents = scene.contents
        highest = np.asarray(contents.last == len(contents.names) - 1)
        find = None if as_is else partial(_find_space, package=package)
        return cls.prepare(scene, contents, highest, find, reference=reference, whole_file=whole_file)

    @classmethod
    def prepare(
        cls,
        scene: StreamedScene,
        contents: Contents,
        highest: NDArray[np.bool_],
        space: Callable[[Gaussians], NavigableSpace | None] | None,
        *,
        reference: Gaussians | None = None,
        whole_file: str | os.PathLike[str] | None = None,
        whole: str = "the package",
        facts: Mapping[str, Any] | None = None,
    ) -> Place:
        """Prepare a scene that is ready to stream.

        Args:
            scene: The scene, whose package must stay open.
            contents: Its records.
            highest: (N,) which Gaussians belong to the full scene.
            space: Returns the space to move walks into, from the full scene; None leaves walks unchanged.
            reference: The scene before it was packaged.
            whole_file: A file or folder of the scene, to take its size; None measures the scene as SOG.
            whole: What the scene is, for reports.
            facts: More facts on the scene, ready for JSON.

        Raises:
            SceneError: If the full scene is empty, or has no navigable space.
            ArgumentError: If the whole file is empty.
        """
        path = scene.package.path
        if not highest.any():
            raise SceneError(f"{path}: {whole} has no Gaussian in its highest level: there is nothing to see")
        full = contents.gaussians(np.flatnonzero(highest))
        found = None if space is None else space(full)
        if whole_file is not None:
            measured = _file_size(_check.path("whole_file", whole_file))
        elif reference is not None:
            measured = _sog_size(reference), "SOG as gsvis writes it, of the scene: before it was packaged"
        else:
            how = f"SOG as gsvis writes it, of the scene: the highest level of {whole}, base colors alone"
            measured = _sog_size(full), how
        title = path.resolve().name.removesuffix(".gsvis").removesuffix(".gsworld")
        return cls(title, scene, contents, highest, reference, measured, found, whole, facts or {})


@dataclass(frozen=True, eq=False)
class Visit:
    """One visit of a scene, from the request for it.

    Attributes:
        title: Name of the scene.
        sessions: Session of each system, that of gsvis first.
        compared_with: Description of the full scene.
        path: Facts on the path, ready for JSON.
        scene: Facts on the scene, ready for JSON.
        pictures: (seconds, system, (H, W, 3) image) of what was shown; the full scene has the name "".
    """

    title: str
    sessions: tuple[Viewing, ...]
    compared_with: str
    path: dict[str, Any] = field(default_factory=dict)
    scene: dict[str, Any] = field(default_factory=dict)
    pictures: tuple[Picture, ...] = ()


def simulate_visits(
    places: Sequence[Place],
    walk: HeadPath,
    link: Link,
    config: ViewingConfig,
    *,
    count: int | None = None,
    abr: AbrConfig | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> tuple[Visit, ...]:
    """Simulate visits of places in turn over one link; send each scene as gsvis does, as a whole file, progressively.

    Args:
        places: Places to visit.
        walk: The recording; each visit replays its next part while it lasts, else the first part.
        link: The link at the start of the first visit.
        config: Length of a visit, pictures and measurements.
        count: Number of visits; None means one of each place.
        abr: Settings of gsvis; None means `AbrConfig()`.
        seed: Seed for moving walks into the scenes.
        progress: Called with stages "playing" and those of `watch`.

    Raises:
        SceneError: If the walk fits nowhere.
    """
    visits = []
    for k in range(len(places) if count is None else count):
        place = places[k % len(places)]
        path, facts = _cut_walk(place, walk, config.seconds, k, seed)
        later = link if k == 0 else link.from_time(k * config.seconds)
        visits.append(_simulate_visit(place, (path, facts), later, config, abr or AbrConfig(), progress))
    return tuple(visits)


def _find_space(g: Gaussians, package: Package) -> NavigableSpace:
    try:
        return NavigableSpace.from_scene(g, up=np.array(package.manifest.info.up))
    except SceneError as error:
        raise SceneError(f"{package.path}: {error}; {AS_IS}") from None


def _file_size(path: Path) -> tuple[int, str]:
    """Return the bytes of a file or of all files in a folder, and how they were measured."""
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    size = sum(file.stat().st_size for file in files)
    if size == 0:
        raise ArgumentError("whole_file", f"expected a file with something in it, got {path}, which is empty")
    return size, f"size of {path.name}"


def _sog_size(g: Gaussians) -> int:
    """Return the bytes of a scene as SOG."""
    with temporary_folder() as folder:
        with output_errors(folder, remedy=TEMPORARY):
            save_sog(g[morton_order(g.means)], Path(folder) / "scene.sog")
        return (Path(folder) / "scene.sog").stat().st_size


def _cut_walk(place: Place, walk: HeadPath, seconds: float, visit: int, seed: int) -> tuple[HeadPath, dict[str, Any]]:
    """Return the part of the recording that a visit replays, in its scene, and facts on it."""
    start = visit * seconds
    start = start if start + 0.5 * seconds <= walk.duration else 0.0
    part = walk.cut(start, start + seconds + _AFTER) if walk.duration > 0 else walk
    facts: dict[str, Any] = {"from_s": start, "recorded_s": part.duration}
    if place.space is None:
        return part, {**facts, "rule": "left as it is"}
    meters = place.scene.package.manifest.info.meters_per_unit
    config = RetargetConfig(meters_per_unit=meters or None, project=True, seed=seed + visit)
    moved = retarget(part, place.space, config)
    return moved.path, {**facts, **moved.as_dict()}


def _simulate_visit(
    place: Place,
    walk: tuple[HeadPath, dict[str, Any]],
    link: Link,
    config: ViewingConfig,
    abr: AbrConfig,
    progress: Progress,
) -> Visit:
    """Simulate one visit, with its scene sent in three ways."""
    contents, (path, facts) = place.contents, walk
    stage, ids = Stage(contents, place.reference, place.highest, place.whole), np.flatnonzero(place.highest)
    deliveries: tuple[Delivery, ...] = (
        Adaptive(place.scene, config.view, abr),
        WholeFile(contents, *place.whole_file, ids=ids),
        MortonProgressive(contents, measured=f"records of {place.whole}", ids=ids),
    )
    progress("playing", 0, len(deliveries))
    played = []
    for k, delivery in enumerate(deliveries):
        played.append(play(delivery, link, path, stage.size, seconds=config.watched, tick=config.tick))
        progress("playing", k + 1, len(deliveries))
    sessions = tuple(watch(stage, played, path, config, progress=progress))
    return Visit(
        place.title,
        sessions,
        stage.compared_with,
        facts,
        {"gaussians": stage.size[0], "terms": stage.size[1], "levels": list(contents.names), **place.facts},
        _pictures(stage, sessions, path, config),
    )


def _pictures(stage: Stage, sessions: Sequence[Viewing], path: HeadPath, config: ViewingConfig) -> tuple[Picture, ...]:
    """Return images at some times, beside the full scene; black if there was no image."""
    shown: list[Picture] = []
    for t in _SHOWN_AT:
        if t < config.seconds:
            full, images = show_at(stage, [session.playback for session in sessions], path, t, config)
            shown.append((t, "", full))
            for session, image in zip(sessions, images, strict=True):
                shown.append((t, session.playback.name, np.zeros_like(full) if image is None else image))
    return tuple(shown)
