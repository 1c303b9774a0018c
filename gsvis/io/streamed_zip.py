"""Streamed SOG in one file: a zip of `lod-meta.json` and the folders that it names, as SuperSplat takes it (`.ssog`).

A viewer loads leaves one by one, so a zip is for sending and keeping; programs unpack it first. Entries are stored,
because the images are compressed already.
"""

from __future__ import annotations

import os
import zipfile
from pathlib import Path, PurePosixPath

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import Budget, open_regular, read_whole
from gsvis.io._sog_files import ZipStore
from gsvis.io.streamed_sog_writer import META

__all__ = ["ZIP_SUFFIXES", "is_streamed_zip", "pack_streamed", "unpack_streamed"]

ZIP_SUFFIXES = (".ssog", ".zip")
_HEAD = b"PK\x03\x04"


def is_streamed_zip(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a zip with a `lod-meta.json`; False for everything that cannot be read as a zip."""
    try:
        with open_regular(path) as stream:
            if stream.read(len(_HEAD)) != _HEAD:
                return False
            with zipfile.ZipFile(stream) as archive:
                return any(PurePosixPath(name).name == META for name in archive.namelist())
    except (OSError, zipfile.BadZipFile, ValueError, FormatError):
        return False


def pack_streamed(folder: str | os.PathLike[str], path: str | os.PathLike[str]) -> int:
    """Write the files of a streamed SOG into one zip, atomically. The same folder gives the same bytes.

    Args:
        folder: A folder with `lod-meta.json`.
        path: The file to write.

    Returns:
        Bytes of the file.

    Raises:
        OSError: If it cannot be written.
    """
    root = _check.path("folder", folder)
    files = sorted(file.relative_to(root).as_posix() for file in root.rglob("*") if file.is_file())
    with atomic_path(path) as partial:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive:
            for name in sorted(files, key=lambda name: name != META):
                archive.writestr(zipfile.ZipInfo(name), read_whole(root / name))
        return partial.stat().st_size


def unpack_streamed(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> Path:
    """Write the files of a zipped streamed SOG into a folder; return the path of its `lod-meta.json`.

    Args:
        path: The zip. The scene may lie in a folder of it.
        folder: An empty folder.

    Raises:
        FormatError: If the zip is damaged, has names that leave the folder, or expands too much.
        OSError: If the folder cannot be written.
    """
    target = _check.path("folder", folder)
    with ZipStore(path, META) as store:
        budget = Budget(store.path, store.size)
        for name in store.names:
            file = target / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(store.read(name, budget))
    return target / META
