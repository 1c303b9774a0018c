"""The folder beside a package that keeps what was found on the way, each piece under the hash of all that decides it.

So a run that is killed continues where it was, and one after an edit does again only what the edit changed. Everything
in it can be made again: whoever needs the room may delete it.
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
from gsvis.files.resume import PLAN, KeptWork

__all__ = ["WorkFolder", "digest_of_folder"]

_ABOUT = "What `gsvis prepare` keeps between runs. It may be deleted: it is made again."


class WorkFolder(KeptWork):
    """Pieces by stage and key, which stay when the package is whole.

    Args:
        package: The package; the folder is `NAME.work` beside it.

    Attributes:
        folder: The folder, which need not exist.
    """

    lock_name = "gsvis-prepare"

    def __init__(self, package: str | os.PathLike[str]) -> None:
        target = Path(os.path.abspath(_check.path("package", package)))
        super().__init__(target.with_name(f"{target.name}.work"), {"about": _ABOUT}, argument="out")
        self._used: set[str] = set()

    def check(self) -> None:
        """Raise unless the folder is usable.

        Raises:
            ValueError: If there is something else of that name.
        """
        expected = f"out: expected {self.folder.name} beside it to be free for what is kept between runs, got"
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"{expected} a file; move it away")
        if self.folder.is_dir() and any(self.folder.iterdir()) and not (self.folder / self.lock_name).exists():
            raise ValueError(f"{expected} a folder of something else; move it away")

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Make the folder and keep other processes out of it.

        Raises:
            ValueError: If it is not free, or another process works there.
            OSError: If it cannot be written.
        """
        self.check()
        with super().opened(), keeping(f"what was finished is kept in {self.folder.name}"):
            yield

    def key(self, stage: str, decides: Mapping[str, Any]) -> str:
        """Return a short hash of all that decides a piece.

        Args:
            stage: Its stage.
            decides: JSON values.
        """
        text = json.dumps([stage, dict(decides)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def at(self, name: str) -> Path:
        """Return the path of a piece, which is then kept when others are cleared away."""
        self._used.add(name)
        return self.folder / name

    def whole(self, name: str) -> bool:
        """Return whether a piece is there with the content that `seal_file` saw; it is then kept as by `at`."""
        self.at(name)
        return self.has_file(name)

    def clear(self) -> None:
        """Remove what this run did not ask for: pieces of other scenes and options."""
        used = self._used | {f"{name}.sha256" for name in self._used} | {self.lock_name, PLAN}
        for path in self.folder.iterdir() if self.folder.is_dir() else ():
            if path.name in used:
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    @property
    def nbytes(self) -> int:
        """Bytes of all files in it."""
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
