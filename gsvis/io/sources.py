"""Open a scene by the name that a user gives: a file, a folder of levels, or `builtin:NAME`.

What it returns knows its name, its LOD, its levels and its up axis besides the Gaussians; see `gsvis.scene.source`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._text import as_line
from gsvis.scene.facts import SceneFacts
from gsvis.scene.glance import stand_ins
from gsvis.scene.procedural import BUILTIN_SCENES, CLEARANCE, BuiltinScene, builtin_scene
from gsvis.scene.source import SOME, Source

__all__ = ["BUILTIN", "check_source", "glance_at", "inputs_of", "is_builtin", "is_levels", "load_source", "title_of"]

BUILTIN = "builtin:"
"""What the name of a built-in scene starts with."""

_TABLES = ("lod-meta.json", "meta.json")  # of a streamed SOG, of a SOG
_INNER = (".compressed", ".splat", ".gltf")  # what may stand in front of the ending of a file
_POOL = 4  # rows that are read for each Gaussian of a glance
_UNIT = 1e-3  # by which the length of a stored unit vector may be off


def is_builtin(scene: str) -> bool:
    """Return whether a name is that of a built-in scene, by its prefix."""
    return scene.startswith(BUILTIN)


def is_levels(scene: str) -> bool:
    """Return whether a path is a folder that `gsvis levels` wrote."""
    if not Path(scene).is_dir():
        return False
    from gsvis.io.levels import MAP  # here: it imports pyarrow, which few commands need

    return (Path(scene) / MAP).is_file()


def check_source(scene: str, lod: int | None) -> None:
    """Raise unless a scene of that name exists and `lod` fits it.

    Raises:
        ValueError: If there is no built-in scene of that name, the folder is a publication of a scene, or `lod` is
            given for a built-in scene or a folder of levels.
        FileNotFoundError: If there is no such file.
    """
    if not is_builtin(scene):
        if not Path(scene).exists():
            raise FileNotFoundError(2, "no such file or folder", scene)
        _check_no_publication(scene)
        if lod is not None and is_levels(scene):
            raise ValueError(f"--lod: expected none for a folder of levels, got {lod}; name the PLY of one level")
        return
    known = [BUILTIN + each for each in BUILTIN_SCENES]
    if scene not in known:
        near = _check.suggestion(scene, known)
        raise ValueError(
            f"SCENE: expected one of {', '.join(known)}, or a path, got {scene!r}" + (f"; {near}" if near else "")
        )
    if lod is not None:
        raise ValueError(f"--lod: expected none for a built-in scene, got {lod}; leave it out")


def _check_no_publication(scene: str) -> None:
    """Raise if a folder is what `gsvis prepare`, `world` or `export` wrote of a scene.

    Raises:
        ValueError: If it is; the message names what reads it.
    """
    folder = Path(scene)
    if (folder / "world.json").is_file():
        raise ValueError(
            f"{scene}: expected a scene, got a world; gsvis view shows it, and {folder / 'packages'} holds its tiles"
        )
    if (folder / "scene.json").is_file() and not (folder / "meta.json").is_file():
        raise ValueError(
            f"{scene}: expected a scene, got a static scene; gsvis view shows it; give what it was exported from"
        )
    if (folder / "manifest.json").is_file():
        raise ValueError(f"{scene}: expected a scene, got a package; gsvis unpack writes its levels as PLY")


def load_source(scene: str, lod: int | None) -> Source:
    """Load the scene of a path or a `builtin:NAME`, with all levels if it is a folder of levels.

    Raises:
        GsvisError: If the file cannot be read as a scene.
        ValueError: As from `check_source`.
        FileNotFoundError: If there is no such file.
    """
    check_source(scene, lod)
    if is_builtin(scene):
        made = builtin_scene(scene.removeprefix(BUILTIN))
        return Source(scene, made.gaussians.with_facts(_builtin_facts(made)), known_up=made.navigable.up)
    if is_levels(scene):
        from gsvis.io.levels import levels_info, load_levels

        levels = load_levels(scene)
        up = _unit_vector(levels_info(scene).extra.get("up"))
        return Source(title_of(scene), levels.level(len(levels) - 1), Path(scene), levels=levels, known_up=up)
    from gsvis.io.scenes import load_scene
    from gsvis.io.streamed_sog import list_lods

    path = Path(scene)
    g = load_scene(path, lod=lod)
    meta = path / _TABLES[0] if path.is_dir() else path
    lods = list_lods(meta) if meta.name == _TABLES[0] and meta.is_file() else ()
    if lods and lod is None:
        lod = lods[0]
    known_up = None if g.facts.up is None else np.asarray(g.facts.up, np.float64)
    return Source(title_of(scene, lod), g, path, lod, lods, known_up=known_up)


def glance_at(scene: str, least: int) -> tuple[Source, int] | None:
    """Return a large scene with some Gaussians that stand for it, and the number of all; None if that is not quick.

    A file of many gigabytes takes a fraction of a second: of a binary PLY only some rows are read.

    Args:
        scene: A path or a `builtin:NAME`.
        least: Number of Gaussians from which a scene is large.

    Raises:
        FormatError: If the file is damaged where it was read.
        OSError: If it cannot be opened.
    """
    path = Path(scene)
    if is_builtin(scene) or path.suffix.lower() != ".ply" or path.is_dir():
        return None
    from gsvis.io.ply import sample_ply

    found = sample_ply(scene, min(least, _POOL * SOME))
    if found is None or found[1] < least or len(found[0]) == 0:
        return None
    sample, count = found
    known_up = None if sample.facts.up is None else np.asarray(sample.facts.up, np.float64)
    return Source(title_of(scene), stand_ins(sample, count, SOME), path, known_up=known_up), count


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
    return vector if abs(float(np.linalg.norm(vector)) - 1.0) < _UNIT else None


def title_of(scene: str, lod: int | None = None) -> str:
    """Return a title: 'showroom, LOD 3' for showroom/lod-meta.json, 'biker' for biker.compressed.ply."""
    if is_builtin(scene):
        return scene.removeprefix(BUILTIN)
    resolved = Path(scene).resolve()
    inner = resolved.name in _TABLES or resolved.is_dir()
    name = (resolved if resolved.is_dir() else resolved.parent).name if inner else _stem_of(resolved.name)
    return as_line(name or resolved.name or "scene") + ("" if lod is None else f", LOD {lod}")


def _stem_of(name: str) -> str:
    """Return the name of a file without its ending, which may have a part in front: `.compressed.ply`, `.splat.gz`."""
    stem = Path(name).stem
    inner = Path(stem)
    return inner.stem if inner.suffix.lower() in _INNER else stem


def inputs_of(scene: str) -> list[Path]:
    """Return the files that are read of a scene: its path, or the files in a folder of levels.

    Raises:
        FormatError: If the map of levels is damaged.
    """
    if not is_levels(scene):
        return [Path(scene)]
    from gsvis.io.levels import MAP, levels_info

    return [Path(scene, name) for name in (MAP, *levels_info(scene).files)]
