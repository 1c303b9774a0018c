"""The folder beside a package that keeps intermediate results.

The name of a piece holds a hash of everything that it depends on. So a killed run resumes, and a run after an edit
repeats only what the edit changed. You may delete the folder: every piece can be made again.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsvis import _check
from gsvis.files.limits import digest_of
from gsvis.files.output import keeping
from gsvis.jobs.resume import KeptWork

__all__ = ["WorkFolder", "digest_of_folder"]

_ABOUT = "What `gsvis prepare` keeps between runs. It may be deleted: it is made again."


class WorkFolder(KeptWork):
    """Pieces by stage and key, kept after the package is complete.

    Args:
        package: Folder of the package NAME; the working folder is `NAME.work` beside it.

    Attributes:
        folder: The working folder, which may not exist yet.
    """

    lock_name = "gsvis-prepare"

    def __init__(self, package: str | os.PathLike[str]) -> None:
        target = Path(os.path.abspath(_check.path("package", package)))
        super().__init__(target.with_name(f"{target.name}.work"), {"about": _ABOUT}, argument="out")
        self._used: set[str] = set()

    def check(self) -> None:
        """Raise unless the folder is usable.

        Raises:
            ValueError: If something else has that name.
        """
        expected = f"out: expected {self.folder.name} beside it to be free for what is kept between runs, got"
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"{expected} a file; move it away")
        if self.folder.is_dir() and any(self.folder.iterdir()) and not (self.folder / self.lock_name).exists():
            raise ValueError(f"{expected} a folder of something else; move it away")

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Create the folder and lock it against other processes for the block.

        Raises:
            ValueError: If something else has its name, or another process works there.
            OSError: If the folder cannot be written.
        """
        self.check()
        with super().opened(), keeping(f"what was finished is kept in {self.folder.name}"):
            yield

    def key(self, stage: str, decides: Mapping[str, Any]) -> str:
        """Return a short hash of everything that a piece depends on.

        Args:
            stage: Stage of the piece.
            decides: JSON values that decide the piece.
        """
        text = json.dumps([stage, dict(decides)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def at(self, name: str) -> Path:
        """Return the path of a piece and mark it as used, so that `clear` keeps it."""
        self._used.add(name)
        return self.folder / name

    def whole(self, name: str) -> bool:
        """Return whether a piece exists with the content that `seal_file` recorded; mark it as used."""
        self.at(name)
        return self.has_file(name)

    def clear(self) -> None:
        """Remove the pieces that this run did not use: those of other scenes and options."""
        used = self._used | {f"{name}.sha256" for name in self._used} | self._own
        for path in self.folder.iterdir() if self.folder.is_dir() else ():
            if path.name in used:
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    @property
    def nbytes(self) -> int:
        """Bytes of all files in the folder."""
        return sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file())


def digest_of_folder(folder: str | os.PathLike[str]) -> str:
    """Return the SHA-256 over names and contents of all files in a folder, or of one file, as 64 hexadecimal digits.

    Raises:
        OSError: If something cannot be read.
    """
    root = Path(folder)
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
        if path.is_file():
            digest.update(f"{path.relative_to(root).as_posix()} {digest_of(path)}\n".encode())
    return digest.hexdigest()
