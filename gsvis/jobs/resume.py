"""Resume long runs: a folder keeps finished work, so that a killed run continues from it.

The folder lies beside the result. Its name holds a digest of the plan, which is everything that decides the result. So
runs with different settings never share a folder. Every entry has a checksum; a damaged entry counts as missing. The
folder is removed when the result is complete. docs/design/058-graphs-of-tasks.md lists what each run keeps.

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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.archive import load_arrays, save_arrays
from gsvis.files.atomic import atomic_path, remove_all_partials
from gsvis.files.limits import digest_of, read_whole
from gsvis.files.locks import MARK, lock_file
from gsvis.files.output import output_errors
from gsvis.files.sums import SEAL, seal, unseal

__all__ = ["PLAN", "KeptWork", "folder_beside"]

_LOCK = "lock"
PLAN = "plan.json"
"""Name of the file that describes the kept work for people."""
_KEY = "key"  # in an archive of `keep_own`: the digest of the plan


def folder_beside(target: str | os.PathLike[str], plan: Any, *, hidden: bool = False) -> Path:
    """Return the folder for unfinished work on a result: `NAME.partial-DIGEST`, beside the result.

    Args:
        target: Path of the result.
        plan: Everything that decides the result; JSON values.
        hidden: Whether the name begins with a dot.
    """
    path = _check.path("path", target)
    return path.with_name(f"{'.' if hidden else ''}{path.name}.partial-{_digest(plan)[:12]}")


class KeptWork:
    """Kept work: entries by name in a folder.

    Args:
        folder: The folder, which may not exist yet.
        plan: Everything that decides the result; JSON values. Written into the folder for people to read.
        argument: Name of the argument that errors mention.

    Attributes:
        folder: The folder.
    """

    lock_name = _LOCK
    """Name of the lock file."""

    def __init__(self, folder: str | os.PathLike[str], plan: Mapping[str, Any], *, argument: str = "path") -> None:
        self.folder = Path(folder)
        self.plan = dict(plan)
        self._argument = argument

    @classmethod
    def beside(cls, target: str | os.PathLike[str], plan: Mapping[str, Any]) -> KeptWork:
        """Return the kept work beside a result; see `folder_beside`."""
        return cls(folder_beside(target, plan), plan)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Create the folder and lock it for the block; an empty folder is removed at the end.

        Raises:
            ValueError: If another process works there.
            OSError: If the folder cannot be written.
        """
        with self._lock():
            try:
                remove_all_partials(self.folder)  # leftovers of a killed run
                if not (self.folder / PLAN).exists():
                    with atomic_path(self.folder / PLAN, sweep=False) as partial:
                        partial.write_text(json.dumps(self.plan, indent=1) + "\n", encoding="utf-8")
                yield
            finally:
                if not self.names():
                    self.remove()

    def _lock(self) -> IO[str]:
        """Return the lock file, open and locked. Its folder may just have been removed by the process that held it."""
        path = self.folder / self.lock_name
        while True:
            with output_errors(self.folder):
                try:
                    self.folder.mkdir(parents=True, exist_ok=True)
                    lock = path.open("a+", encoding="utf-8")
                except FileNotFoundError:
                    if self.folder.parent.is_dir():
                        continue
                    raise
            if not lock_file(lock):
                lock.close()
                raise ValueError(
                    f"{self._argument}: expected work that no other process is busy with, got one that is, in"
                    f" {self.folder}; wait for it or stop it"
                )
            if path.exists() and os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                return lock
            lock.close()

    def names(self) -> set[str]:
        """Return the names of all entries, also of damaged ones; hidden files do not count."""
        if not self.folder.is_dir():
            return set()
        return {name for name in os.listdir(self.folder) if name[:1] != "." and name not in self._own}

    @property
    def _own(self) -> set[str]:
        """Names of files that are no entries: the description and the lock, which can be two files."""
        return {PLAN, self.lock_name, f"{self.lock_name}{MARK}"}

    def keep(self, name: str, data: bytes) -> None:
        """Keep bytes under a name; replace an older entry.

        Raises:
            OSError: If the entry cannot be written.
        """
        with atomic_path(self.folder / name, sweep=False) as partial:  # a sweep lists all entries
            partial.write_bytes(seal(data))

    def read(self, name: str, *, at_most: int | None = None) -> bytes | None:
        """Return the bytes of an entry; None if it is missing, damaged, or longer than `at_most` bytes."""
        most = None if at_most is None else SEAL + at_most
        try:
            return unseal(read_whole(self.folder / name, most))
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError, FormatError):
            return None

    def keep_arrays(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays as one entry; replace an older entry.

        Raises:
            OSError: If the entry cannot be written.
        """
        save_arrays(self.folder / name, arrays)

    def read_arrays(
        self, name: str, like: Mapping[str, tuple[tuple[int, ...], type[np.generic]]]
    ) -> dict[str, NDArray[Any]]:
        """Return the arrays of an entry that have the expected shape and type; empty if it is missing or damaged.

        Args:
            name: Name of the entry.
            like: Expected shape and type of each array, by name.
        """
        try:
            found = load_arrays(self.folder / name, sealed=True)
        except (OSError, FormatError):
            return {}
        return {key: array for key, array in found.items() if like.get(key) == (array.shape, array.dtype.type)}

    def keep_own(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays in a folder that the user named, together with the digest of the plan."""
        save_arrays(self.folder / name, {_KEY: np.frombuffer(_digest(self.plan).encode(), np.uint8), **arrays})

    def read_own(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Return the arrays that `keep_own` kept; None if there is no such file.

        A silent restart could lose a day of work in a folder that the user named. So a damaged entry raises an error.

        Raises:
            FormatError: If the entry is damaged.
            ValueError: If the entry belongs to another plan.
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
                " work of a run with different ones; delete it to start again, or name another folder"
            )
        return found

    def has_file(self, name: str) -> bool:
        """Return whether a file exists with the content that `seal_file` recorded."""
        try:
            noted = read_whole(self.folder / f"{name}.sha256", 64)
            return noted.decode("ascii") == digest_of(self.folder / name)
        except (OSError, FormatError, UnicodeDecodeError):
            return False

    def seal_file(self, name: str) -> None:
        """Record the digest of a finished file in the folder, so that `has_file` finds damage.

        Raises:
            OSError: If the file cannot be read, or the record cannot be written.
        """
        with atomic_path(self.folder / f"{name}.sha256") as partial:
            partial.write_text(digest_of(self.folder / name), encoding="ascii")

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _digest(plan: Any) -> str:
    return hashlib.sha256(json.dumps(plan, sort_keys=True).encode()).hexdigest()
