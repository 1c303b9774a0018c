"""The one way to resume: a folder that keeps what a long run has found, so that a killed run continues from there.

The folder lies beside the result and bears a digest of the plan, of all that decides the result, so that runs of
different settings never meet in one. Every entry is under a checksum; a damaged one counts as missing. The folder goes
when the result is whole. docs/design/029-resume.md says which runs keep what.

    kept = KeptWork.beside("scene.pvs", plan)
    with kept.opened():
        if (data := kept.read("cell-000001.bin")) is None:
            kept.keep("cell-000001.bin", data := look())
    kept.remove()
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.archive import load_arrays, save_arrays
from gsvis.files.atomic import atomic_path, remove_all_partials
from gsvis.files.limits import digest_of, read_whole
from gsvis.files.locks import locked
from gsvis.files.output import output_errors

__all__ = ["PLAN", "KeptWork", "folder_beside", "seal", "unseal"]

_HEAD = struct.Struct("<4sI")
_MAGIC = b"gvc2"
_LOCK = "lock"
PLAN = "plan.json"
"""Name of the file that says for people what is kept."""
_KEY = "key"  # of an archive in a folder that the user named: the digest of the plan


def folder_beside(target: str | os.PathLike[str], plan: Any, *, hidden: bool = False) -> Path:
    """Return the folder that keeps unfinished work on a result: `NAME.partial-DIGEST`, beside it.

    Args:
        target: The result.
        plan: All that decides it; JSON values.
        hidden: Begin the name with a dot.
    """
    path = _check.path("path", target)
    return path.with_name(f"{'.' if hidden else ''}{path.name}.partial-{_digest(plan)[:12]}")


class KeptWork:
    """Entries by name in a folder.

    Args:
        folder: The folder; there may be none yet.
        plan: All that decides the result; JSON values. Written into the folder for people to read.
        argument: Names the result in errors.

    Attributes:
        folder: The folder.
    """

    lock_name = _LOCK
    """Name of the file that keeps other processes out."""

    def __init__(self, folder: str | os.PathLike[str], plan: Mapping[str, Any], *, argument: str = "path") -> None:
        self.folder, self.plan, self._argument = Path(folder), dict(plan), argument

    @classmethod
    def beside(cls, target: str | os.PathLike[str], plan: Mapping[str, Any]) -> KeptWork:
        """The work that is kept beside a result; see `folder_beside`."""
        return cls(folder_beside(target, plan), plan)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Make the folder and keep other processes out of it; it goes at the end if nothing was kept in it.

        Raises:
            ValueError: If another process works there.
            OSError: If the folder cannot be written.
        """
        with output_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = (self.folder / self.lock_name).open("a+", encoding="utf-8")
        with lock:
            if not locked(lock):
                raise ValueError(
                    f"{self._argument}: expected work that no other process is busy with, got one that is, in"
                    f" {self.folder}; wait for it or stop it"
                )
            try:
                remove_all_partials(self.folder)  # of a run that was killed
                if not (self.folder / PLAN).exists():
                    with atomic_path(self.folder / PLAN, sweep=False) as partial:
                        partial.write_text(json.dumps(self.plan, indent=1) + "\n", encoding="utf-8")
                yield
            finally:
                if not self.names():
                    self.remove()

    def names(self) -> set[str]:
        """Return the names of all entries, whole or not; hidden files are none."""
        if not self.folder.is_dir():
            return set()
        return {name for name in os.listdir(self.folder) if name[:1] != "." and name not in (PLAN, self.lock_name)}

    def keep(self, name: str, data: bytes) -> None:
        """Keep bytes under a name.

        Raises:
            OSError: If they cannot be written.
        """
        with atomic_path(self.folder / name, sweep=False) as partial:  # to list all entries for each takes too long
            partial.write_bytes(seal(data))

    def read(self, name: str, *, at_most: int | None = None) -> bytes | None:
        """Return the bytes of an entry; None if there is none that is whole, or it has more bytes than `at_most`."""
        most = None if at_most is None else _HEAD.size + at_most
        try:
            return unseal(read_whole(self.folder / name, most))
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError, FormatError):
            return None

    def keep_arrays(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays as one entry, instead of what was kept under the name before.

        Raises:
            OSError: If they cannot be written.
        """
        save_arrays(self.folder / name, arrays)

    def read_arrays(
        self, name: str, like: Mapping[str, tuple[tuple[int, ...], type[np.generic]]]
    ) -> dict[str, NDArray[Any]]:
        """Return those arrays of an entry that are of these shapes and types; none of one that is not whole.

        Args:
            name: The entry.
            like: Shape and type of the arrays that may be there.
        """
        try:
            found = load_arrays(self.folder / name, sealed=True)
        except (OSError, FormatError):
            return {}
        return {key: array for key, array in found.items() if like.get(key) == (array.shape, array.dtype.type)}

    def keep_own(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays in a folder that the user named, with the digest of the plan among them."""
        save_arrays(self.folder / name, {_KEY: np.frombuffer(_digest(self.plan).encode(), np.uint8), **arrays})

    def read_own(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Return arrays that `keep_own` kept; None if there are none.

        To start again without a word could cost a day in a folder that the user named, so nothing counts as missing.

        Raises:
            FormatError: If the entry is damaged.
            ValueError: If it is of another plan.
        """
        path = self.folder / name
        if not path.exists():
            return None
        try:
            found = load_arrays(path)
            key = found.pop(_KEY).tobytes().decode()
        except (FormatError, LookupError, ValueError) as error:
            got = error.got if isinstance(error, FormatError) else f"{type(error).__name__}: {error}"
            raise FormatError(path, "", "what a run has kept", got, "delete it to start again") from error
        if key != _digest(self.plan):
            raise ValueError(
                f"{self._argument}: expected {os.fspath(self.folder)} to be of the same input and settings, got"
                " another run's; delete it to start again, or name another folder"
            )
        return found

    def has_file(self, name: str) -> bool:
        """Return whether a file is there with the content that `seal_file` saw."""
        try:
            noted = read_whole(self.folder / f"{name}.sha256", 64)
            return noted.decode("ascii") == digest_of(self.folder / name)
        except (OSError, FormatError, UnicodeDecodeError):
            return False

    def seal_file(self, name: str) -> None:
        """Note the content of a finished file that something else wrote into the folder, so that damage is seen.

        Raises:
            OSError: If it cannot be read, or the note not be written.
        """
        with atomic_path(self.folder / f"{name}.sha256") as partial:
            partial.write_text(digest_of(self.folder / name), encoding="ascii")

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def seal(data: bytes) -> bytes:
    """Return bytes behind a head that holds their checksum."""
    return _HEAD.pack(_MAGIC, zlib.crc32(data)) + data


def unseal(data: bytes) -> bytes | None:
    """Return the bytes that `seal` took; None if a byte has changed or is missing."""
    if len(data) < _HEAD.size:
        return None
    magic, crc = _HEAD.unpack_from(data)
    body = data[_HEAD.size :]
    return body if magic == _MAGIC and zlib.crc32(body) == crc else None


def _digest(plan: Any) -> str:
    return hashlib.sha256(json.dumps(plan, sort_keys=True).encode()).hexdigest()
