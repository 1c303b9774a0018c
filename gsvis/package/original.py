"""Record in a package which scene it is made from, and find that scene again to compare with."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsvis.errors import FormatError, SceneError
from gsvis.files.limits import digest_of
from gsvis.io.sources import is_builtin, is_levels, load_source
from gsvis.package.made_from import KEY, MadeFrom, candidates_of, made_from_of, path_from_package
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.source import Source

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["Original", "about_files", "about_source", "find_original", "load_original", "own_file"]

_META = ("lod-meta.json", "meta.json")
_OTHER = "is not the scene from which it was made: its content differs"
_NONE = "it was made by an older gsvis, or by a program that did not name its scene"


@dataclass(frozen=True)
class Original:
    """The scene that a package was made from, as far as it was found.

    Attributes:
        scenes: Path or built-in name and level of detail of each scene to read; empty if it was not found.
        made: What the manifest says of each.
        remark: Why it was not found, or why the given scene may be another one; empty if all is well.
    """

    scenes: tuple[tuple[str, int | None], ...]
    made: tuple[MadeFrom, ...]
    remark: str = ""


def about_source(scene: str, source: Source, package: str) -> dict[str, Any]:
    """Return the entry of a provenance on the scene that a package is made from.

    Args:
        scene: Path or built-in name.
        source: The scene as read.
        package: Folder of the package, which may not exist yet.
    """
    counted = len(source.gaussians)
    if _is_one_file(scene):
        made = MadeFrom(Path(scene).name, digest_of(scene), nbytes=os.path.getsize(scene), gaussians=counted)
    else:
        made = MadeFrom(_name_of(scene), scene=scene_hash(source.gaussians), gaussians=counted, lod=source.lod)
    path = None if is_builtin(scene) else path_from_package(scene, package)
    return {KEY: [replace(made, path=path).as_dict()]}


def about_files(scenes: Sequence[tuple[str, int | None]], package: str) -> dict[str, Any]:
    """Return the entry of a provenance on the files that a world is made from, without reading them as scenes.

    Args:
        scenes: Path and level of detail of each.
        package: Folder of the world, which may not exist yet.
    """
    rows = []
    for scene, lod in scenes:
        made = MadeFrom(_name_of(scene), lod=lod, path=path_from_package(scene, package))
        file = _file_of(Path(scene))
        if file.is_file():
            made = replace(made, sha256=digest_of(file), nbytes=file.stat().st_size)
        rows.append(made.as_dict())
    return {KEY: rows}


def find_original(package: str, provenance: Mapping[str, Any], given: Sequence[tuple[str, int | None]]) -> Original:
    """Return the scene that a package was made from, before it is read.

    Args:
        package: Folder of the package or world.
        provenance: Of its manifest.
        given: Path and level of detail of each scene that the user names; empty to look for them.
    """
    made = made_from_of(provenance)
    if given:
        return Original(tuple(given), made, _doubt(given, made))
    if not made:
        return Original((), (), f"the package does not name the scene that it was made from: {_NONE}")
    scenes: list[tuple[str, int | None]] = []
    for each, paths in zip(made, candidates_of(made, package), strict=True):
        if is_builtin(each.name):
            scenes.append((each.name, None))
            continue
        if not paths:
            return Original((), made, f"{each.name}, from which it was made, is not beside the package")
        same = next((path for path in paths if each.matches_file(_file_of(path))), None)
        if same is None:
            return Original((), made, f"{_shown(paths[0])} {_OTHER}")
        scenes.append((str(same), each.lod))
    return Original(tuple(scenes), made)


def load_original(original: Original, given: bool) -> tuple[Gaussians | None, str]:
    """Read the scene that a package was made from; return None and the reason if it is another one.

    Args:
        original: From `find_original`.
        given: Whether the user named it: then it is returned even if its content differs.

    Raises:
        ValueError: If a given scene has another number of Gaussians, as another level of detail has.
    """
    if not original.scenes:
        return None, original.remark
    read = []
    for k, (scene, lod) in enumerate(original.scenes):
        try:
            found = load_source(scene, lod).gaussians
        except (FormatError, SceneError, ValueError, OSError) as error:
            if given:
                raise
            return None, f"{_shown(scene)}, from which it was made, cannot be read: {error}"
        read.append(found)
        if given and len(original.made) == len(original.scenes):
            _check_count(original.made[k], len(found), _shown(scene))
        if len(original.made) == len(original.scenes) and original.made[k].scene not in (None, scene_hash(found)):
            changed = f"{_shown(scene)} {_OTHER}"
            if not given:
                return None, changed
            original = replace(original, remark=changed)
    return Gaussians.concatenate(read), original.remark


def own_file(original: Original) -> tuple[str, int] | None:
    """Return name and bytes of the file that a package was made from; None if it was not one file."""
    if len(original.scenes) != 1 or not _is_one_file(original.scenes[0][0]):
        return None
    path = original.scenes[0][0]
    return Path(path).name, os.path.getsize(path)


def _doubt(given: Sequence[tuple[str, int | None]], made: Sequence[MadeFrom]) -> str:
    """Return a line if the given scene is not the one that a package says that it was made from."""
    if len(given) != len(made):
        return ""
    for (scene, _), each in zip(given, made, strict=True):
        same = scene == each.name if is_builtin(scene) else each.matches_file(_file_of(Path(scene)))
        if not same:
            return f"{_shown(scene)} is not the file from which it was made, {each.name}: its content differs"
    return ""


def _check_count(made: MadeFrom, count: int, shown: str) -> None:
    """Raise if a scene has another number of Gaussians than the one that a package was made from."""
    if made.gaussians in (None, count):
        return
    level = "" if made.lod is None else f", level of detail {made.lod}"
    raise ValueError(
        f"{shown}: expected the {made.gaussians:,} Gaussians of {made.name}{level}, from which the package was made,"
        f" got {count:,}; name that scene and its level of detail"
    )


def _is_one_file(scene: str) -> bool:
    path = Path(scene)
    return path.is_file() and path.name not in _META and path.suffix.lower() != ".gltf" and not is_levels(scene)


def _file_of(path: Path) -> Path:
    """Return the file whose hash stands for a scene: itself, or the table of a streamed one."""
    return next((path / name for name in _META if (path / name).is_file()), path) if path.is_dir() else path


def _name_of(scene: str) -> str:
    """Return the name of a file, of a folder, or of a table with its folder; that of a built-in scene as it is."""
    if is_builtin(scene):
        return scene
    resolved = Path(os.path.abspath(scene))
    return resolved.parent.name + "/" + resolved.name if resolved.name in _META else resolved.name


def _shown(path: str | Path) -> str:
    text = os.fspath(path)
    return text if is_builtin(text) else Path(text).name
