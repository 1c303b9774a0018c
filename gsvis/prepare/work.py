"""The folder beside a package that keeps what was found on the way, each piece under the hash of all that decides it.

So a run that is killed goes on where it was, and one after an edit does again only what the edit changed. Everything in
it can be made again: whoever needs the room may delete it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import digest_of, read_whole
from gsvis.files.locks import locked
from gsvis.files.output import keeping, output_errors

__all__ = ["WorkFolder", "digest_of_folder"]

_MARK = "gsvis-prepare"
_TOLD = "What `gsvis prepare` keeps between runs. It may be deleted: it is made again.\n"


class WorkFolder:
    """Pieces by stage and key.

    Args:
        package: The package; the folder is `NAME.work` beside it.

    Attributes:
        path: The folder, which need not exist.
    """

    def __init__(self, package: str | os.PathLike[str]) -> None:
        target = Path(os.path.abspath(_check.path("package", package)))
        self.path = target.with_name(f"{target.name}.work")
        self._used: set[str] = set()

    def check(self) -> None:
        """Nothing, if the folder may be used.

        Raises:
            ValueError: If there is something of that name that is none.
        """
        told = f"out: expected {self.path.name} beside it to be free for what is kept between runs, got"
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{told} a file; move it away")
        if self.path.is_dir() and any(self.path.iterdir()) and not (self.path / _MARK).exists():
            raise ValueError(f"{told} a folder of something else; move it away")

    @contextmanager
    def opened(self) -> Iterator[None]:
        """The folder made, and kept from other processes.

        Raises:
            ValueError: If it is not free, or another process works there.
            OSError: If it cannot be written.
        """
        self.check()
        with ExitStack() as opened:
            with output_errors(self.path):
                self.path.mkdir(parents=True, exist_ok=True)
                mark = opened.enter_context((self.path / _MARK).open("a+", encoding="utf-8"))
            if not locked(mark):
                raise ValueError(
                    f"out: expected a package that no other process prepares, got one that is busy in {self.path.name};"
                    " wait for it or stop it"
                )
            with output_errors(self.path):
                if mark.tell() == 0:
                    mark.write(_TOLD)
                    mark.flush()
            with keeping(f"what was finished is kept in {self.path.name}"):
                yield

    def key(self, stage: str, decides: Mapping[str, Any]) -> str:
        """A short hash of all that decides a piece.

        Args:
            stage: Its stage.
            decides: JSON values.
        """
        text = json.dumps([stage, dict(decides)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def at(self, name: str) -> Path:
        """The path of a piece, which is then kept when others are cleared away."""
        self._used.add(name)
        return self.path / name

    def whole(self, name: str) -> bool:
        """Whether a file is there with the content that `seal` saw."""
        path = self.at(name)
        try:
            told = read_whole(self.path / f"{name}.sha256", 64)
            return told.decode("ascii") == digest_of(path)
        except (OSError, FormatError, UnicodeDecodeError):
            return False

    def seal(self, name: str) -> None:
        """Note the content of a finished file, so that damage is seen.

        Raises:
            OSError: If it cannot be read, or the note not be written.
        """
        with atomic_path(self.path / f"{name}.sha256") as partial:
            partial.write_text(digest_of(self.path / name), encoding="ascii")

    def clear(self) -> None:
        """Remove what this run did not ask for: pieces of other scenes and options."""
        if not self.path.is_dir():
            return
        kept = {_MARK, *self._used, *(f"{name}.sha256" for name in self._used)}
        for path in self.path.iterdir():
            if path.name in kept:
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.path, ignore_errors=True)

    @property
    def nbytes(self) -> int:
        """Bytes of all files in it."""
        return sum(path.stat().st_size for path in self.path.rglob("*") if path.is_file())


def digest_of_folder(folder: str | os.PathLike[str]) -> str:
    """SHA-256 over names and contents of all files in a folder, or of one file, as 64 hexadecimal digits.

    Raises:
        OSError: If something cannot be read.
    """
    root = Path(folder)
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
        if path.is_file():
            digest.update(f"{path.relative_to(root).as_posix()} {digest_of(path)}\n".encode())
    return digest.hexdigest()
