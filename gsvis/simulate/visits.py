"""Simulate visits of scenes, one after the other over one link; each scene is sent in three ways along a walk.

places = [Place.open(package) for package in packages]
visits = simulate_visits(places, load_path("walk.csv"), link, config)
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._text import as_line
from gsvis.abr import AbrConfig
from gsvis.errors import ArgumentError, SceneError
from gsvis.package.contents import Contents
from gsvis.package.package import Package
from gsvis.progress import Progress, silent
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.retarget import RetargetConfig, retarget
from gsvis.scene.source_frame import SourceFrame
from gsvis.simulate.baselines import MortonProgressive, WholeFile
from gsvis.simulate.delivery import Adaptive, Delivery
from gsvis.simulate.frames import Stage
from gsvis.simulate.link import Link
from gsvis.simulate.playback import play
from gsvis.simulate.viewing import Viewing, ViewingConfig, show_at, watch
from gsvis.simulate.whole_files import choose_whole_file, describe_whole_file, measure_whole_files, scene_with_sh
from gsvis.stream import StreamedScene

__all__ = ["AS_IS", "WALKED", "Place", "Visit", "judged_in", "simulate_visits"]

WALKED = 0.9
"""Share of a walk in cells below which a report warns."""

AS_IS = "if the path lies in the scene, ask for it as it is (--no-retarget)"
"""What to do about a scene without a space to walk in."""

Picture = tuple[float, str, NDArray[np.float32]]

_SHOWN_AT = (0.5, 2.0)  # seconds of the pictures
_COMPARED = 6  # views in which whole files are compared
_ASKED = 512  # positions of a walk that are tested against cells
_AFTER = 1.0  # seconds of the walk after a visit, for prediction


@dataclass(frozen=True, eq=False)
class Place:
    """A scene prepared for visits, once for any number of them.

    Attributes:
        title: Name of the scene.
        scene: The scene, ready to stream.
        contents: Its records.
        highest: (N,) mask of the Gaussians of the full scene.
        reference: The scene before it was packaged, to compare with; None compares with the package.
        whole_file: Bytes of the scene as one file, and the way they were measured; None measures them in each visit.
        space: Navigable space to move the walk into; None leaves the walk unchanged.
        whole: Name of the scene's form, for reports.
        facts: Further facts about the scene, ready for JSON.
        remark: A sentence about the reference scene, for reports; maybe empty.
        own_file: Name and bytes of the file that `reference` came from; None if it is not one file.
        frame: The scene's place in the coordinates of its source, in which a walk may be given; None without an origin.
    """

    title: str
    scene: StreamedScene
    contents: Contents
    highest: NDArray[np.bool_]
    reference: Gaussians | None
    whole_file: tuple[int, str] | None
    space: NavigableSpace | None
    whole: str = "the package"
    facts: Mapping[str, Any] = field(default_factory=dict)
    remark: str = ""
    own_file: tuple[str, int] | None = None
    frame: SourceFrame | None = None

    @property
    def against(self) -> str:
        """Name of the reference if it is not the original scene, such as "the package itself"; else empty."""
        if self.reference is not None:
            return ""
        return "the world itself" if "tiles" in self.facts else "the package itself"

    @classmethod
    def open(
        cls,
        package: Package,
        *,
        reference: Gaussians | None = None,
        whole_file: str | os.PathLike[str] | None = None,
        as_is: bool = False,
        terms: str = "pose",
    ) -> Place:
        """Prepare a package for visits; it must stay open.

        Args:
            package: The package.
            reference: The scene before it was packaged.
            whole_file: A file or folder of the scene, to take its size; None measures the best format.
            as_is: Whether to leave walks unchanged, because they lie in the scene.
            terms: Which terms are sent: one of `gsvis.stream.scene.TERMS`.

        Raises:
            SceneError: If the scene is empty, or has no navigable space.
            ArgumentError: If the whole file is empty.
        """
        scene = StreamedScene.open(package).sending(terms)
        contents = scene.contents
        highest = np.asarray(contents.last == len(contents.names) - 1)
        find = None if as_is else partial(_find_space, package=package)
        facts = judged_in(package.manifest.info.provenance)
        return cls.prepare(scene, contents, highest, find, reference=reference, whole_file=whole_file, facts=facts)

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
            whole_file: A file or folder of the scene, to take its size; None measures the best format.
            whole: What the scene is, for reports.
            facts: More facts on the scene, ready for JSON.

        Raises:
            SceneError: If the full scene is empty, or has no navigable space.
            ArgumentError: If the whole file is empty.
        """
        path = scene.source.path
        if not highest.any():
            raise SceneError(f"{path}: {whole} has no Gaussian in its highest level: there is nothing to see")
        full = contents.gaussians(np.flatnonzero(highest))
        found = None if space is None else space(full)
        measured = None if whole_file is None else _file_size(_check.path("whole_file", whole_file))
        title = path.resolve().name.removesuffix(".gsvis").removesuffix(".gsworld")
        frame = SourceFrame.from_scene(full)
        return cls(
            title, scene, contents, highest, reference, measured, found, whole=whole, facts=facts or {}, frame=frame
        )

    def measure_whole_file(self, walk: HeadPath, config: ViewingConfig, progress: Progress = silent) -> WholeFileFound:
        """Return the best whole file of the scene, its size, and how it was chosen.

        Args:
            walk: Where viewers are; quality is measured in views along it.
            config: Size and field of view of these views.
            progress: Called with stage "whole files".
        """
        if self.whole_file is not None:
            return WholeFileFound(*self.whole_file, ())
        if self.reference is not None:
            scene = self.reference
            of = "the scene that the package was made from"
        else:
            scene = scene_with_sh(self.contents, np.flatnonzero(self.highest))
            of = f"the highest level of {self.whole}"
        times = np.unique(np.linspace(0.0, min(walk.duration, config.seconds), _COMPARED))
        views = walk.resample(times=times).cameras(config.width, config.height, config.fov)
        sizes = measure_whole_files(scene, views, self.own_file, progress=progress)
        chosen = choose_whole_file(sizes)
        rows = tuple(each.as_dict() for each in sizes)
        return WholeFileFound(chosen.nbytes, describe_whole_file(sizes, chosen, of), rows)


class WholeFileFound(NamedTuple):
    """The whole file that gsvis is compared with.

    Attributes:
        nbytes: Its bytes.
        measured: How they were measured, for reports.
        files: All files that were measured, ready for JSON; empty if the user named one.
    """

    nbytes: int
    measured: str
    files: tuple[dict[str, Any], ...]


@dataclass(frozen=True, eq=False)
class Visit:
    """One visit of a scene, from the request on.

    Attributes:
        title: Name of the scene.
        sessions: Session of each system, that of gsvis first.
        compared_with: Description of the full scene.
        path: Facts on the path, ready for JSON.
        scene: Facts on the scene, ready for JSON.
        pictures: (seconds, system, (H, W, 3) image) of what was shown; the full scene has the name "".
        against: See `Place.against`.
        remark: A sentence about the reference scene; maybe empty.
    """

    title: str
    sessions: tuple[Viewing, ...]
    compared_with: str
    path: dict[str, Any] = field(default_factory=dict)
    scene: dict[str, Any] = field(default_factory=dict)
    pictures: tuple[Picture, ...] = ()
    against: str = ""
    remark: str = ""


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
    """Simulate visits of places in turn over one link; send each scene by gsvis, as a whole file, and progressively.

    Args:
        places: Places to visit.
        walk: The path; each visit replays the next part of it, or the first part if it has ended.
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
    files = dict[int, WholeFileFound]()
    for k in range(len(places) if count is None else count):
        which = k % len(places)
        place = places[which]
        path, facts = _cut_walk(place, walk, config.seconds, k, seed)
        later = link if k == 0 else link.from_time(k * config.seconds)
        if which not in files:
            files[which] = place.measure_whole_file(path, config, progress)
        visits.append(_simulate_visit(place, files[which], (path, facts), later, config, abr or AbrConfig(), progress))
    return tuple(visits)


def judged_in(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return the quality at independent eyes that a package or a world states, ready for JSON.

    Args:
        provenance: Provenance of its manifest, which is not trusted: unexpected values are ignored.
    """
    found = provenance.get("judged")
    if not isinstance(found, dict):
        return {}
    share = found.get("judge_eyes_in_cells")
    warning = found.get("warning")
    known = float(share) if isinstance(share, float | int) and 0.0 <= share <= 1.0 else None
    return {
        "judged": {
            "eyes_in_cells": known,
            "warning": as_line(warning) if isinstance(warning, str) else None,
        }
    }


def _share_in_cells(place: Place, path: HeadPath, seconds: float) -> float:
    """Return the share of a walk, over time, that lies in cells."""
    times = np.linspace(0.0, min(path.duration, seconds), _ASKED)
    inside = place.scene.index.grid.cell_at(path.resample(times=times).positions) >= 0
    return float(inside.mean())


def _find_space(g: Gaussians, package: Package) -> NavigableSpace:
    """Return the navigable space of a package."""
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


def _cut_walk(place: Place, walk: HeadPath, seconds: float, visit: int, seed: int) -> tuple[HeadPath, dict[str, Any]]:
    """Return the part of the path that a visit replays, in its scene, with facts about it."""
    walk = walk if place.frame is None else place.frame.walk(walk)
    start = visit * seconds
    start = start if start + 0.5 * seconds <= walk.duration else 0.0
    part = walk.cut(start, start + seconds + _AFTER) if walk.duration > 0 else walk
    facts: dict[str, Any] = {"from_s": start, "seconds": part.duration}
    if place.space is None:
        return part, {**facts, "rule": "left as it is"}
    meters = place.scene.source.manifest.info.meters_per_unit
    config = RetargetConfig(meters_per_unit=meters or None, project=True, seed=seed + visit)
    moved = retarget(part, place.space, config)
    return moved.path, {**facts, **moved.as_dict()}


def _simulate_visit(
    place: Place,
    file: WholeFileFound,
    walk: tuple[HeadPath, dict[str, Any]],
    link: Link,
    config: ViewingConfig,
    abr: AbrConfig,
    progress: Progress,
) -> Visit:
    """Simulate one visit with its scene sent in three ways."""
    contents, (path, facts) = place.contents, walk
    stage = Stage(contents, place.reference, place.highest, place.whole)
    ids = np.flatnonzero(place.highest)
    deliveries: tuple[Delivery, ...] = (
        Adaptive(place.scene, config.view, abr),
        WholeFile(contents, file.nbytes, file.measured, ids=ids),
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
        {**facts, "in_cells": _share_in_cells(place, path, config.seconds)},
        {
            "gaussians": stage.size[0],
            "terms": stage.size[1],
            "levels": list(contents.names),
            "whole_files": list(file.files),
            **place.facts,
        },
        _pictures(stage, sessions, path, config),
        place.against,
        place.remark,
    )


def _pictures(stage: Stage, sessions: Sequence[Viewing], path: HeadPath, config: ViewingConfig) -> tuple[Picture, ...]:
    """Return images at some times beside the full scene; black if there was no image."""
    shown: list[Picture] = []
    for t in _SHOWN_AT:
        if t < config.seconds:
            full, images = show_at(stage, [session.playback for session in sessions], path, t, config)
            shown.append((t, "", full))
            for session, image in zip(sessions, images, strict=True):
                shown.append((t, session.playback.name, np.zeros_like(full) if image is None else image))
    return tuple(shown)
