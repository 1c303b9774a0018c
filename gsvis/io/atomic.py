"""Files and folders that appear whole or not at all.

Work is written beside its destination under a hidden name and moved into place at the end, so a crash, a full
disk or Ctrl-C leaves what was there before untouched.
"""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsvis import _check
from gsvis.io.output import output_errors

__all__ = ["atomic_folder", "atomic_path"]


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path` that becomes `path` when the block ends well, and is removed otherwise.

    Args:
        path: The file to write; its folder is made if it is missing.

    Yields:
        The path to write to, with the same suffix.

    Raises:
        OutputError: If the file cannot be written.
    """
    target = _check.path("path", path)
    partial = target.with_name(f".{target.stem}-{secrets.token_hex(6)}{target.suffix}")
    _make(target.parent, path)
    with output_errors(path, partial):
        os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # the usual rights, unlike mkstemp's
        try:
            yield partial
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder whose files move into `path` when the block ends well.

    Files of the same name are replaced one by one; other files already in `path` stay: nothing a user made is lost.

    Args:
        path: The folder to fill; made if it is missing.

    Yields:
        The folder to write to.

    Raises:
        OutputError: If the folder cannot be written.
    """
    target = _check.path("path", path)
    _make(target.parent, path)
    with output_errors(path, target.parent):
        partial = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    with output_errors(path, partial):
        try:
            yield partial
            target.mkdir(exist_ok=True)
            for source in sorted(partial.rglob("*")):
                destination = target / source.relative_to(partial)
                if source.is_dir():
                    destination.mkdir(exist_ok=True)
                else:
                    os.replace(source, destination)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def _make(folder: Path, path: str | os.PathLike[str]) -> None:
    """Make a folder and those above it; `path` is what the user asked for."""
    with output_errors(path, folder.absolute().anchor):
        folder.mkdir(parents=True, exist_ok=True)
