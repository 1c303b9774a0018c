"""The work folder of a task: if an attempt is killed, the next attempt resumes from it; the end of the task removes it.

A lock prevents that a slow worker, which counts as lost, and its successor use the folder at the same time. The folder
is in the store if that is a folder, so that any worker finds it, else among temporary files.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gsvis.files.locks import try_lock
from gsvis.files.output import output_errors
from gsvis.files.temporary import private_folder, temporary_folder
from gsvis.jobs.objects import FolderStore, ObjectStore

__all__ = ["forget_work", "work_folder"]

_LOCK = "lock"
_KEPT_S = 86400.0  # seconds for which a killed attempt among temporary files waits for the next one


@contextmanager
def work_folder(store: ObjectStore, key: str) -> Iterator[Path]:
    """Yield the folder of a task, or a new one while another worker is in that; removed when the block succeeds.

    Raises:
        OutputError: If it cannot be written.
    """
    root = store.folder / "work" if isinstance(store, FolderStore) else _temporary()
    with output_errors(root):
        descriptor = _lock(root / key)
    if descriptor is None:
        with temporary_folder(root) as other:
            yield other
        return
    try:
        yield root / key
        _empty(root / key)
    finally:
        os.close(descriptor)
    with suppress(OSError):  # another worker may have begun in it
        (root / key).rmdir()


def forget_work(store: ObjectStore, key: str) -> None:
    """Remove the folder of a finished task, which a worker leaves in the store if it is killed at the end."""
    if isinstance(store, FolderStore) and (store.folder / "work" / key).is_dir():
        shutil.rmtree(store.folder / "work" / key, ignore_errors=True)


def _temporary() -> Path:
    """Return the folder of this user among temporary files; remove work folders that are unused for a day."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    root = private_folder(Path(tempfile.gettempdir()) / f"gsvis-work-{user}")
    for folder in list(root.iterdir()):
        with suppress(OSError):
            if time.time() - (folder / _LOCK).stat().st_mtime < _KEPT_S:
                continue
            descriptor = os.open(folder / _LOCK, os.O_RDWR)
            try:
                if try_lock(descriptor) == "held":
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(descriptor)
    return root


def _lock(folder: Path) -> int | None:
    """Return the descriptor of the lock of a folder, which is made if it is missing; None if it cannot be had.

    Whoever ends in a folder removes its lock, so a lock on a file that is no longer there is none.
    """
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR, 0o666)
        except FileNotFoundError:  # removed meanwhile
            continue
        held = try_lock(descriptor) == "held"
        with suppress(FileNotFoundError):
            if held and os.path.samestat(os.fstat(descriptor), os.stat(folder / _LOCK)):
                return descriptor
        os.close(descriptor)
        if not held:
            return None


def _empty(folder: Path) -> None:
    """Remove what is in a folder, its lock last."""
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        elif path.name != _LOCK:
            path.unlink(missing_ok=True)
    with suppress(OSError):  # a system that keeps open files
        (folder / _LOCK).unlink()
