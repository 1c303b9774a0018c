"""Check what a command needs before the work: files that it reads and writes, and a tracer; write arrays."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._extras import require
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path, find_interrupted_moves
from gsvis.files.limits import open_regular
from gsvis.files.output import check_folder
from gsvis.io.scenes import WRITTEN, suffix_of
from gsvis.io.sources import inputs_of, is_levels

__all__ = [
    "check_exists",
    "check_new",
    "check_one_level",
    "check_outputs",
    "check_report",
    "check_scene_out",
    "check_show",
    "check_tracer",
    "write_array",
]


def check_exists(*paths: str | None) -> None:
    """Raise unless each path that is given exists.

    Raises:
        FileNotFoundError: If one does not.
    """
    for path in paths:
        if path is not None and not Path(path).exists():
            raise FileNotFoundError(2, "no such file or folder", path)


def check_new(path: str | os.PathLike[str], overwrite: bool) -> None:
    """Raise if a file exists, unless it may be overwritten: a typo must not destroy a scene.

    Raises:
        ValueError: If the file exists and `overwrite` is false.
    """
    if not overwrite and os.path.lexists(path):
        raise ValueError(f"{path}: expected a new file, got one that exists; name another, or say --overwrite")


def check_tracer(name: str, certify: int | None = None) -> None:
    """Raise unless the tracer of --tracer is installed, or no rays of --certify need it.

    Raises:
        MissingExtraError: If it is not; with the remedy.
    """
    if name == "embree" and certify != 0:
        require("--tracer embree", "open3d")


def check_show(path: str | None) -> None:
    """Check --show before work begins.

    Raises:
        ValueError: If the name does not end in .png, or is that of a file that gsvis did not write.
        OutputError: If nothing can be written there.
    """
    if path is None:
        return
    from gsvis.report.frames import is_own

    target = Path(path)
    if target.suffix.lower() != ".png" or target.is_dir():
        raise ValueError(f"--show: expected the name of a .png, got {path!r}")
    if target.exists() and not is_own(target):
        raise ValueError(f"--show: expected a new file, or a picture of gsvis, got {path}; name another")
    check_folder(target.absolute().parent)


def check_report(path: str | os.PathLike[str]) -> None:
    """Raise unless a report can be written into a folder without mixing with other files.

    A report replaces an earlier report of gsvis, but no pictures and pages that gsvis did not write.

    Raises:
        ValueError: If the folder holds pictures or pages of something else.
        OutputError: If nothing can be written there.
    """
    check_folder(path)
    folder = Path(path)
    if not folder.is_dir() or _holds_report(folder / "report.json"):
        return
    others = [name for name in ("report.html", "report.json") if (folder / name).exists()]
    others += sorted(file.name for file in folder.glob("*.png"))
    moved = find_interrupted_moves(folder)
    others = [name for name in others if name not in moved]  # an interrupted report of gsvis may be replaced
    if others:
        raise ValueError(
            f"{path}: expected a new folder, or one of an earlier report, got one with {others[0]} of something else;"
            " name another"
        )


def _holds_report(path: Path) -> bool:
    """Return whether a file starts like a `report.json` of gsvis."""
    try:
        with open_regular(path) as file:
            return file.read(64).lstrip(b"{ \r\n").startswith(b'"format": "gsvis-')
    except (FormatError, OSError):
        return False


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
    if suffix_of(target) not in known:
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
