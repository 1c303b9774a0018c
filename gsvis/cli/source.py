"""Load the scene and cameras of a command from a file, a built-in scene or sampling; check where results may go."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis._text import as_line
from gsvis.errors import ArgumentError, SceneError
from gsvis.scene.axes import AXES, axis_vector, nearest_axis
from gsvis.scene.cameras import Cameras
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import inspect_scene
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import CLEARANCE, BuiltinScene, builtin_scene
from gsvis.scene.stated import stated_space
from gsvis.scene.upright import find_up

if TYPE_CHECKING:
    from gsvis.cli.options import Framed
    from gsvis.progress import Progress

__all__ = [
    "Source",
    "check_source",
    "evenly",
    "file_cameras",
    "framed_cameras",
    "inputs_of",
    "inspect_scene_of",
    "is_builtin",
    "is_levels",
    "levels_spelled",
    "load_source",
    "navigable_space",
    "open_source",
    "parse_up",
    "spaces_of_build",
    "summarize_levels",
    "title_of",
    "up_of",
    "up_to_turn",
]

BUILTIN = "builtin:"
SOME = 100_000
"""Gaussians of a thin scene: what place it is, and where it is free, shows in few."""

_TURNED = 0.5  # confidence from which a scene is turned by an oblique angle


@dataclass(frozen=True, eq=False)
class Source:
    """A scene and what is known about it besides its Gaussians.

    Attributes:
        name: Name of the scene in a report.
        gaussians: The scene; for a folder of levels the highest level, which pictures show.
        path: File or folder of the scene; None for a built-in scene.
        lod: The LOD that was read; None for a scene without.
        lods: LODs that are present in a streamed scene; empty for any other.
        levels: All levels of a folder of levels; None for any other scene.
        known_up: The (3,) up axis: that of a built-in scene, +y of glTF, or what a folder of levels states; None where
            it has to be guessed.
    """

    name: str
    gaussians: Gaussians
    path: Path | None = None
    lod: int | None = None
    lods: tuple[int, ...] = ()
    levels: Levels | None = None
    known_up: NDArray[np.float64] | None = None

    @property
    def whole(self) -> Gaussians | Levels:
        """The scene, or all levels."""
        return self.gaussians if self.levels is None else self.levels

    @property
    def union(self) -> Gaussians:
        """The Gaussians of the scene, or those of all levels together."""
        return self.gaussians if self.levels is None else self.levels.union

    def thin(self, most: int | None = None) -> Source:
        """Return the scene with Gaussians drawn at random, larger by as much as keeps the area of all together.

        Args:
            most: Gaussians that remain, at most; by default as many as a view to begin with needs.
        """
        g = self.gaussians
        most = most or SOME
        if len(g) > most:
            some = np.sort(np.random.default_rng(0).choice(len(g), most, replace=False))
            g = replace(g[some], scales=g.scales[some] * np.float32(np.sqrt(len(g) / most)))
        return replace(self, gaussians=g, levels=None)


Loader = Callable[[str, "int | None"], Source]


def is_levels(scene: str) -> bool:
    """Return whether a path is a folder that `gsvis levels` wrote."""
    if not Path(scene).is_dir():
        return False
    from gsvis.io.levels import MAP

    return (Path(scene) / MAP).is_file()


def _check_no_publication(scene: str) -> None:
    """Raise if a folder is what `gsvis prepare`, `world` or `export` wrote of a scene.

    Raises:
        ValueError: If it is; the message names what reads it.
    """
    from gsvis.package.manifest import MANIFEST

    folder = Path(scene)
    if (folder / "world.json").is_file():
        raise ValueError(
            f"{scene}: expected a scene, got a world; gsvis view shows it, and {folder / 'packages'} holds its tiles"
        )
    if (folder / "scene.json").is_file() and not (folder / "meta.json").is_file():
        raise ValueError(
            f"{scene}: expected a scene, got a static scene; gsvis view shows it; give what it was exported from"
        )
    if (folder / MANIFEST).is_file():
        raise ValueError(f"{scene}: expected a scene, got a package; gsvis unpack writes its levels as PLY")


def check_source(scene: str, lod: int | None) -> None:
    """Raise unless a scene of that name exists and `lod` fits it.

    Raises:
        ValueError: If there is no built-in scene of that name, or `lod` is given for a built-in scene or a folder of
            levels.
        FileNotFoundError: If there is no such file.
    """
    if not scene.startswith(BUILTIN):
        if not Path(scene).exists():
            raise FileNotFoundError(2, "no such file or folder", scene)
        _check_no_publication(scene)
        if lod is not None and is_levels(scene):
            raise ValueError(f"--lod: expected none for a folder of levels, got {lod}; name the PLY of one level")
        return
    from gsvis.scene.procedural import BUILTIN_SCENES

    name = scene.removeprefix(BUILTIN)
    if name not in BUILTIN_SCENES:
        known = ", ".join(BUILTIN + each for each in BUILTIN_SCENES)
        near = _check.suggestion(scene, [BUILTIN + each for each in BUILTIN_SCENES])
        raise ValueError(f"SCENE: expected one of {known}, or a path, got {scene!r}" + (f"; {near}" if near else ""))
    if lod is not None:
        raise ValueError(f"--lod: expected none for a built-in scene, got {lod}; leave it out")


def load_source(scene: str, lod: int | None) -> Source:
    """Load the scene of a path or a `builtin:NAME`, with all levels if it is a folder of levels.

    Raises:
        GsvisError: If the file cannot be read as a scene.
        ValueError: If there is no built-in scene of that name.
        FileNotFoundError: If there is no such file.
    """
    check_source(scene, lod)
    if scene.startswith(BUILTIN):
        made = builtin_scene(scene.removeprefix(BUILTIN))
        g = made.gaussians.with_facts(_builtin_facts(made))
        return Source(scene, g, known_up=made.navigable.up)
    if is_levels(scene):
        from gsvis.io.levels import levels_info, load_levels

        levels = load_levels(scene)
        up = _unit_vector(levels_info(scene).extra.get("up"))
        return Source(title_of(scene), levels.level(len(levels) - 1), Path(scene), levels=levels, known_up=up)
    from gsvis.io import load_scene
    from gsvis.io.streamed_sog import list_lods

    path = Path(scene)
    g = load_scene(path, lod=lod)
    meta = path / "lod-meta.json" if path.is_dir() else path
    lods = list_lods(meta) if meta.name == "lod-meta.json" and meta.is_file() else ()
    if lods and lod is None:
        lod = lods[0]
    known_up = None if g.facts.up is None else np.asarray(g.facts.up, np.float64)
    return Source(title_of(scene, lod), g, path, lod, lods, known_up=known_up)


def open_source(
    scene: str, lod: int | None, status: Progress, what: str | None = None, load: Loader = load_source
) -> Source:
    """Load a scene and show that it is read.

    Args:
        scene: A path or a `builtin:NAME`.
        lod: Level of detail of a streamed scene.
        status: The display of progress.
        what: Completes "there is nothing to", where an empty scene is an error; None takes any scene.
        load: What loads it, such as `load_shown`.

    Raises:
        GsvisError: If the file cannot be read as a scene, or is empty.
        ValueError: If there is no built-in scene of that name.
        FileNotFoundError: If there is no such file.
    """
    status("reading", 0, 1)
    source = load(scene, lod)
    if what is not None and len(source.gaussians) == 0:
        raise SceneError(f"{scene}: the scene has no Gaussian: there is nothing to {what}")
    status("reading", 1, 1)
    return source


def _builtin_facts(made: BuiltinScene) -> SceneFacts:
    """Return what is known of a built-in scene: what it states, else its up axis, a box of eyes, an eye in it."""
    stated = made.gaussians.facts
    if stated.box is not None:
        return stated
    space = made.navigable
    free = np.argwhere(space.free)
    low, high = space.origin + space.voxel_size * np.stack([free.min(axis=0), free.max(axis=0) + 1])
    return replace(
        stated,
        up=_triple(space.up),
        up_source="built-in scene",
        box=(_triple(low), _triple(high)),
        eye=_triple(made.viewpoints[0]),
        clearance=CLEARANCE,
    )


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _unit_vector(value: Any) -> NDArray[np.float64] | None:
    """Return a JSON value as a (3,) unit vector; None if it is no such list."""
    if not isinstance(value, list) or len(value) != 3 or not all(type(each) in (int, float) for each in value):
        return None
    vector = np.array(value, np.float64)
    return vector if abs(float(np.linalg.norm(vector)) - 1.0) < 1e-3 else None


def summarize_levels(source: Source) -> list[dict[str, Any]] | None:
    """Return names and sizes of the levels for JSON; None for a scene without levels."""
    found = source.levels
    if found is None:
        return None
    return [{"name": name, "gaussians": n} for name, n in zip(found.names, found.counts, strict=True)]


def levels_spelled(source: Source) -> str:
    """Return text such as ' in levels low 300, high 1,000'; empty for a scene without levels."""
    sizes = ", ".join(f"{each['name']} {each['gaussians']:,}" for each in summarize_levels(source) or ())
    return f" in levels {sizes}" if sizes else ""


def inspect_scene_of(source: Source) -> dict[str, Any]:
    """Return the inspection of a scene as a dict; guess the up axis only where it is not known."""
    return inspect_scene(source.gaussians, up=source.known_up).as_dict()


def title_of(scene: str, lod: int | None = None) -> str:
    """Return a title: 'showroom, LOD 3' for showroom/lod-meta.json, 'biker' for biker.compressed.ply."""
    if is_builtin(scene):
        return scene.removeprefix(BUILTIN)
    resolved = Path(scene).resolve()
    inner = resolved.name in ("lod-meta.json", "meta.json") or resolved.is_dir()
    name = (resolved if resolved.is_dir() else resolved.parent).name if inner else resolved.name.split(".")[0]
    return as_line(name or resolved.name or "scene") + ("" if lod is None else f", LOD {lod}")


def up_of(source: Source) -> NDArray[np.float64]:
    """Return the (3,) up axis of a scene: the known one, else the likely one."""
    known = source.known_up
    return find_up(source.union, check=False).up if known is None else known


def up_to_turn(source: Source) -> NDArray[np.float64]:
    """Return the (3,) up axis to turn a scene by: the known one, else the likely one, a coordinate axis if unsure.

    A scene that little tells about is not turned by an oblique angle.
    """
    known = source.known_up
    if known is not None:
        return known
    found = find_up(source.union, check=False)
    return found.up if found.confidence >= _TURNED else axis_vector(nearest_axis(found.up))


def navigable_space(
    source: Source, *, up: ArrayLike | None = None, seeds: ArrayLike | None = None
) -> tuple[NavigableSpace | None, str]:
    """Return the navigable space of a scene and ""; None and the reason if there is none.

    A box that the scene states comes before its Gaussians; seeds that mostly lie outside of it come before both.

    Args:
        source: The scene.
        up: (3,) up axis; None means the known one, else a guess.
        seeds: (S, 3) positions known to be navigable.
    """
    axis = source.known_up if up is None else up
    stated = _in_stated_box(source, axis)
    if stated is not None and (seeds is None or np.mean(stated.contains(seeds)) >= 0.5):
        return stated, ""
    try:
        return NavigableSpace.from_scene(source.gaussians, up=axis, seeds=seeds), ""
    except SceneError as error:
        return None, error.problem


def _in_stated_box(source: Source, up: ArrayLike | None) -> NavigableSpace | None:
    """Return what is free in the box that a scene states; None without one, or if nothing in it is free."""
    try:
        return stated_space(source.gaussians, up=up)
    except SceneError:
        return None


def spaces_of_build(source: Source, up: ArrayLike) -> Iterator[NavigableSpace]:
    """Yield the navigable spaces that sets of a scene may have been built in, for an up axis that was stored with them.

    Where up was certain, the space was found with it; where it was a guess, with eyes on all sides.

    Args:
        source: The scene.
        up: (3,) the up axis of the sets.
    """
    for axis in (up, None):
        space, _ = navigable_space(source, up=axis)
        if space is not None:
            yield space


def parse_up(axis: str | None) -> NDArray[np.float64] | None:
    """Return the (3,) unit up axis of --up; None without --up.

    Args:
        axis: The name of an axis, such as "+z", or three numbers of any length but zero, such as "0.1 -0.98 0.17".

    Raises:
        ValueError: If the value is neither.
    """
    if axis is None:
        return None
    text = axis.strip()
    if text in AXES:
        return axis_vector(text)
    try:
        vector = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        vector = np.zeros(0)
    largest = float(np.abs(vector).max()) if vector.shape == (3,) else 0.0
    if not (np.isfinite(largest) and largest > 0.0):
        known = ", ".join(AXES)
        raise ValueError(f"--up: expected one of {known}, or three numbers such as '0.1 -0.98 0.17', got {text!r}")
    return np.asarray(vector / largest / np.linalg.norm(vector / largest))


def file_cameras(path: str, width: int | None, height: int | None, *, at_most: int | None = None) -> Cameras:
    """Load the cameras of a file, at the given size.

    Args:
        path: A file that `load_cameras` reads.
        width: Pixels; None follows from `height` and the file's aspect.
        height: Pixels; None follows from the width and the file's aspect.
        at_most: Most pixels across if neither width nor height is given; None keeps the file's size.

    Raises:
        FormatError: If the file cannot be read.
        FileNotFoundError: If there is no file.
        ValueError: If the file holds no camera.
    """
    from gsvis.io.cameras import load_cameras

    both = (width, height) if width and height else None
    cameras = load_cameras(path, size=both)
    if len(cameras) == 0:
        raise ValueError(f"{path}: expected at least one camera, got none")
    if both is None:
        aspect = cameras.width / cameras.height
        across = width or (round(height * aspect) if height else min(at_most or cameras.width, cameras.width))
        if across != cameras.width or height:
            cameras = cameras.resize(max(1, across), max(1, height or round(across / aspect)))
    return cameras


def framed_cameras(source: Source, cameras: Cameras, where: Framed) -> tuple[Cameras, list[str]]:
    """Return cameras of a file in the frame of a scene, and remarks for the user: moved, or most see nothing.

    Every command that takes cameras calls this once the scene is read.

    Args:
        source: The scene.
        cameras: Of `file_cameras`.
        where: The file that they are of, and their frame.

    Raises:
        ValueError: If they are to be moved, and no file says how.
    """
    from gsvis.io.frames import fit_cameras

    try:
        found = fit_cameras(source.gaussians, cameras, where.cameras, source.path, frame=where.cameras_frame)
    except ArgumentError as error:
        raise error.renamed("--cameras-frame") from None
    return found.cameras, [f" {each}" for each in found.remarks]


def is_builtin(scene: str) -> bool:
    """Return whether a name is that of a built-in scene, by its prefix."""
    return scene.startswith(BUILTIN)


def evenly(cameras: Cameras, count: int) -> Cameras:
    """Return `count` of the cameras, evenly spaced, in their order; all if there are no more."""
    if count >= len(cameras):
        return cameras
    return cameras[np.floor(np.arange(count) * len(cameras) / count).astype(int)]


def inputs_of(scene: str) -> list[Path]:
    """Return the files that are read: the path of the scene, or the files in a folder of levels.

    Raises:
        FormatError: If the map of levels is damaged.
    """
    if not is_levels(scene):
        return [Path(scene)]
    from gsvis.io.levels import MAP, levels_info

    return [Path(scene, name) for name in (MAP, *levels_info(scene).files)]
