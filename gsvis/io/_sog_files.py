"""Read the files of a SOG scene by name, from a folder or from a zip, without trusting the input.

`safe_name` checks names; a `Budget` bounds every read. This module knows no planes.
"""

from __future__ import annotations

import os
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import Protocol

from gsvis.errors import FormatError
from gsvis.files.limits import Budget, inside, open_regular, read_whole, safe_name

__all__ = ["FolderStore", "Store", "ZipStore"]

_ZIP_FAULTS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    ValueError,
    NotImplementedError,
    RuntimeError,
    OverflowError,
)


class Store(Protocol):
    """Source of the files of a scene."""

    path: str
    """Path for error messages."""

    def file_bytes(self, names: list[str]) -> int:
        """Return the actual bytes on disk of these files."""

    def read(self, name: str, budget: Budget) -> bytes:
        """Return the content of one file."""


class FolderStore:
    """Files in a folder.

    Args:
        folder: The folder.
        path: Path for error messages, such as that of its meta.json.
        root: The folder that links must not leave; None means `folder`.
    """

    def __init__(self, folder: Path, path: str | os.PathLike[str], root: Path | None = None) -> None:
        self.folder = folder
        self.path = os.fspath(path)
        self._root = folder if root is None else root

    def _file(self, name: str) -> Path:
        """Return the path of a file; raise if it is missing or a link leads out of the folder."""
        below = self.folder.relative_to(self._root) if self.folder.is_relative_to(self._root) else Path()
        file = inside(self.path, name, self._root, os.fspath(below / name))
        if not file.is_file():
            raise FormatError(
                self.path, name, "a file of that name beside the metadata", "none", "is the copy complete?"
            )
        return file

    def file_bytes(self, names: list[str]) -> int:
        """Return the actual bytes on disk of these files.

        Raises:
            FormatError: If one is missing, or a link leads out of the folder.
        """
        return sum(self._file(name).stat().st_size for name in dict.fromkeys(names))

    def read(self, name: str, budget: Budget) -> bytes:
        """Return the content of one file.

        Raises:
            FormatError: If it is missing, or a link leads out of the folder.
        """
        file = self._file(name)
        budget.claim(file.stat().st_size, name)
        return read_whole(file)


class ZipStore:
    """Files in a zip, beside its JSON.

    Args:
        path: The zip.
        index: Name of the JSON: `meta.json`, or `lod-meta.json` of a streamed SOG.

    Raises:
        FormatError: If it is not a zip, has unsafe names, or has no such JSON.
    """

    def __init__(self, path: str | os.PathLike[str], index: str = "meta.json") -> None:
        self.path = os.fspath(path)
        self._index = index
        self._file = open_regular(path)
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            self._zip = self._open_zip()
            self._entries = self._safe_entries()
        except BaseException:
            self._file.close()
            raise

    def _open_zip(self) -> zipfile.ZipFile:
        """Return the open zip."""
        try:
            return zipfile.ZipFile(self._file)
        except _ZIP_FAULTS as error:
            raise FormatError(self.path, "", "a zip archive", str(error), "is it truncated?") from error

    def _safe_entries(self) -> dict[str, zipfile.ZipInfo]:
        """Return the entries of the folder of the JSON by name; raise if a name is unsafe."""
        entries = {}
        for info in self._zip.infolist():
            entries[safe_name(self.path, "zip entry", info.orig_filename)] = info
        metas = sorted((n for n in entries if PurePosixPath(n).name == self._index), key=lambda n: (n.count("/"), n))
        if not metas:
            raise FormatError(self.path, "", f"a {self._index} in the zip", "none", "this is not a SOG scene")
        prefix = metas[0][: -len(self._index)]
        return {name[len(prefix) :]: info for name, info in entries.items() if name.startswith(prefix)}

    @property
    def names(self) -> list[str]:
        """Names of the files beside the JSON and below."""
        return [name for name, info in self._entries.items() if not info.is_dir()]

    def __enter__(self) -> ZipStore:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()
        self._file.close()

    def file_bytes(self, names: list[str]) -> int:
        """Return the bytes on disk of these files, at most the size of the zip.

        Raises:
            FormatError: If one is missing.
        """
        for name in names:
            if name not in self._entries:
                raise FormatError(self.path, name, "an entry of that name in the zip", "none")
        return self.size

    def read(self, name: str, budget: Budget) -> bytes:
        """Return the content of one entry.

        Raises:
            FormatError: If it is missing, damaged, encrypted, or expands too much.
        """
        self.file_bytes([name])
        info = self._entries[name]
        if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            got = "an encrypted one" if info.flag_bits & 1 else f"one compressed by method {info.compress_type}"
            raise FormatError(self.path, name, "a stored or deflated entry", got)
        budget.claim(info.file_size, name)
        try:
            with self._zip.open(info) as stream:
                data = stream.read(info.file_size + 1)
        except _ZIP_FAULTS as error:
            raise FormatError(self.path, name, "an intact zip entry", str(error) or "a damaged one") from error
        if len(data) != info.file_size:
            raise FormatError(self.path, name, f"{info.file_size:,} bytes", f"{len(data):,}", "the zip is damaged")
        return data
