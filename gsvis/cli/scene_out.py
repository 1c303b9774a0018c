"""Check where a command may write a scene and the files beside it, and write arrays, before and after the work."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.cli.source import check_folder, check_new, inputs_of, is_levels
from gsvis.files.atomic import atomic_path
from gsvis.io.scenes import WRITTEN

__all__ = ["check_one_level", "check_outputs", "check_scene_out", "write_array"]


def check_scene_out(
    out: str,
    scene: str | Sequence[str],
    overwrite: bool,
    *,
    name: str = "--out",
    source: str = "SCENE",
    others: tuple[str, ...] = (),
) -> Path:
    """Raise unless a scene can be written to a file; return the file.

    Args:
        out: The file to write.
        scene: The scene or scenes that are read, which must not be replaced.
        overwrite: Whether an existing file may be replaced.
        name: The option, for messages.
        source: The argument that names the scene, for messages; of several scenes each has its number behind it.
        others: Suffixes that the command writes besides those of scenes.

    Raises:
        ValueError: If the suffix is of no format that gsvis writes, the path is a folder, the file exists, or it is
            the scene itself.
        OutputError: If nothing can be written there.
    """
    target = Path(out)
    known = (*WRITTEN, *others)
    if target.suffix.lower() not in known or target.name.lower().endswith(".compressed.ply"):
        near = _check.suggestion(target.suffix, known)
        raise ValueError(
            f"{name}: expected a name that ends in {', '.join(known)}, got {out!r}; "
            + (near or "other formats are only read")
        )
    if target.is_dir():
        raise ValueError(f"{name}: expected the name of a file, got the folder {out!r}")
    scenes = [scene] if isinstance(scene, str) else scene
    read = {f"{source} {k}" if len(scenes) > 1 else source: each for k, each in enumerate(scenes, 1)}
    check_outputs({name: target}, read, overwrite)
    return target


def check_outputs(outputs: dict[str, Path], inputs: dict[str, str], overwrite: bool) -> None:
    """Raise unless files can be written that are not read, and are not each other.

    Args:
        outputs: Each file, by the option that names it.
        inputs: Scenes and files that are read, by the argument that names each.
        overwrite: Whether existing files may be replaced.

    Raises:
        ValueError: If a file exists, is read, is a folder, or is named twice.
        OutputError: If nothing can be written there.
    """
    read = [(word, path) for word, each in inputs.items() for path in inputs_of(each)]
    known: dict[Path, str] = {}
    for name, target in outputs.items():
        for word, path in read:
            if path.exists() and target.exists() and target.samefile(path):
                raise ValueError(f"{name}: expected another file than {word}, got {target}; name another")
        if target.is_dir():
            raise ValueError(f"{name}: expected the name of a file, got the folder {target}")
        place = target.absolute()
        if place in known:
            raise ValueError(f"{name}: expected a file of its own, got that of {known[place]}; name another")
        known[place] = name
        check_folder(place.parent)
        check_new(target, overwrite)


def check_one_level(scene: str) -> None:
    """Raise if a scene is a folder of levels.

    Raises:
        ValueError: If it is.
    """
    if is_levels(scene):
        raise ValueError(f"SCENE: expected one scene, got the folder of levels {scene}; name the PLY of one level")


def write_array(path: Path, array: NDArray[np.generic]) -> None:
    """Write an array as a NumPy file, atomically."""
    data = io.BytesIO()
    np.save(data, array, allow_pickle=False)
    with atomic_path(path) as partial:
        partial.write_bytes(data.getvalue())
