"""A store of objects named by the SHA-256 of their content, and of small notes by name: a shared folder, or fsspec's.

Workers on several machines read and write it; nothing goes through a scheduler. Objects are written once and compared
with their name when they are read, so a cut or a wrong answer of a store is found. A note is the last thing that a task
writes. An address is a path, `file://...`, or any URL that fsspec knows, such as `s3://bucket/folder`.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Collection
from concurrent.futures import TimeoutError as Late
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from gsvis._extras import require
from gsvis.errors import BackendError, FormatError, GsvisError
from gsvis.files.apart import call_apart
from gsvis.files.atomic import atomic_path, remove_all_partials
from gsvis.files.limits import DAMAGED, digest_of, read_whole
from gsvis.files.output import output_errors
from gsvis.files.sums import seal, unseal

__all__ = ["ObjectStore", "StoredObject", "open_store"]

StoredObject = tuple[str, int]
"""SHA-256 of an object, 64 hexadecimal digits, and its size in bytes."""

_Answer = TypeVar("_Answer")
_OBJECTS = "objects"
_NOTES = "notes"
_NAME = re.compile(r"[0-9a-z][0-9a-z.-]{0,120}")
_TRIES = 3
_CHECKSUM = "FlexibleChecksumError"  # name of botocore's error of an answer that does not fit its checksum
_AGAIN = f"{DAMAGED}: run the same again"


def open_store(address: str | os.PathLike[str], *, patience: float = 120.0) -> ObjectStore:
    """Return the store at an address.

    Args:
        address: A path, `file://PATH`, or a URL of fsspec.
        patience: Seconds that a remote store may take for one object.

    Raises:
        MissingExtraError: If fsspec is needed and not installed.
        BackendError: If fsspec does not know the address.
    """
    text = os.fspath(address)
    if "://" not in text or text.startswith("file://"):
        return FolderStore(Path(text.removeprefix("file://")))
    return RemoteStore(text, patience)


class ObjectStore:
    """Base of the two kinds of store; `open_store` opens one.

    Attributes:
        address: Address with which any process can open the store.
    """

    address: str

    def put(self, path: Path) -> StoredObject:
        """Store the content of a file; an object that exists is not written again."""
        found = digest_of(path), path.stat().st_size
        if not self.has(found):
            self._put(path, found)
        return found

    def has(self, wanted: StoredObject) -> bool:
        """Return whether an object exists with the right size; its content is not read."""
        raise NotImplementedError

    def path_of(self, wanted: StoredObject, cache: Path) -> Path:
        """Return a path of a local file with an object; copy it into `cache` first if the store is elsewhere.

        Raises:
            FormatError: If the object is missing, or its content does not fit its name.
        """
        raise NotImplementedError

    def keep_note(self, name: str, data: bytes) -> None:
        """Write a note, under a checksum, in one step."""
        raise NotImplementedError

    def note(self, name: str) -> bytes | None:
        """Return a note; None if it is missing or damaged."""
        raise NotImplementedError

    def sweep(self, notes: Collection[str], objects: Collection[str]) -> None:
        """Remove all notes and objects but these."""

    def _put(self, path: Path, found: StoredObject) -> None:
        """Write the content of a file as an object."""
        raise NotImplementedError


class FolderStore(ObjectStore):
    """A store in a folder that every worker sees under the same path.

    Args:
        folder: The folder; made if it is missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(os.path.abspath(folder))
        self.address = str(self.folder)

    def has(self, wanted: StoredObject) -> bool:
        """See `ObjectStore.has`."""
        try:
            return self._at(wanted[0]).stat().st_size == wanted[1]
        except OSError:
            return False

    def path_of(self, wanted: StoredObject, cache: Path) -> Path:
        """See `ObjectStore.path_of`."""
        path = self._at(wanted[0])
        _compare(path, wanted)
        return path

    def keep_note(self, name: str, data: bytes) -> None:
        """See `ObjectStore.keep_note`."""
        with atomic_path(self.folder / _NOTES / _checked(name), sweep=False) as temporary:
            temporary.write_bytes(seal(data))

    def note(self, name: str) -> bytes | None:
        """See `ObjectStore.note`."""
        try:
            return unseal(read_whole(self.folder / _NOTES / _checked(name)))
        except (OSError, FormatError):
            return None

    def sweep(self, notes: Collection[str], objects: Collection[str]) -> None:
        """See `ObjectStore.sweep`."""
        for folder in (self.folder / _NOTES, *sorted((self.folder / _OBJECTS).glob("??"))):
            remove_all_partials(folder)
            kept = notes if folder.name == _NOTES else objects
            for path in folder.iterdir() if folder.is_dir() else ():
                if path.name not in kept and path.name[:1] != ".":
                    path.unlink(missing_ok=True)

    def _at(self, digest: str) -> Path:
        """Return the path of an object."""
        return self.folder / _OBJECTS / digest[:2] / digest

    def _put(self, path: Path, found: StoredObject) -> None:
        """Write the content of a file as an object."""
        target = self._at(found[0])
        with output_errors(self.folder):
            target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(target, sweep=False) as temporary:
            shutil.copyfile(path, temporary)


class RemoteStore(ObjectStore):
    """A store behind fsspec.

    Args:
        address: The URL.
        patience: Seconds for one call.
    """

    def __init__(self, address: str, patience: float) -> None:
        require(f"a store at {address.split('://')[0]}://", "fsspec")
        import fsspec

        self.address = address.rstrip("/")
        self.patience = patience
        try:
            self._files, self._root = fsspec.core.url_to_fs(self.address)
        except Exception as error:  # fsspec raises what its backends raise
            raise BackendError(f"{self.address}: no store can be opened there: {_reason(error)}") from error

    def has(self, wanted: StoredObject) -> bool:
        """See `ObjectStore.has`."""
        try:
            info = self._call("looking up an object", lambda: self._files.info(self._at(wanted[0])))
        except FileNotFoundError:
            return False
        return bool(info.get("size") == wanted[1])

    def path_of(self, wanted: StoredObject, cache: Path) -> Path:
        """See `ObjectStore.path_of`."""
        path = cache / wanted[0]
        if path.is_file() and path.stat().st_size == wanted[1]:
            return path
        for attempt in range(_TRIES):
            try:
                with atomic_path(path, sweep=False) as partly:
                    at = self._at(wanted[0])
                    self._call("reading an object", partial(self._files.get_file, at, str(partly)))
                    _compare(partly, wanted, f"{self.address}/{_OBJECTS}/{wanted[0]}")
                break
            except FileNotFoundError as error:
                raise FormatError(self.address, wanted[0][:12], "an object of the store", "no such object") from error
            except FormatError:  # a cut answer: ask again
                if attempt == _TRIES - 1:
                    with suppress(FileNotFoundError):  # so that the next run makes it again
                        self._call("removing a damaged object", lambda: self._files.rm_file(self._at(wanted[0])))
                    raise
        return path

    def keep_note(self, name: str, data: bytes) -> None:
        """See `ObjectStore.keep_note`."""
        at = f"{self._root}/{_NOTES}/{_checked(name)}"
        self._call("writing a note", lambda: self._files.pipe_file(at, seal(data)))

    def note(self, name: str) -> bytes | None:
        """See `ObjectStore.note`."""
        at = f"{self._root}/{_NOTES}/{_checked(name)}"
        try:
            return unseal(self._call("reading a note", lambda: self._files.cat_file(at)))
        except (FileNotFoundError, FormatError):
            return None

    def _at(self, digest: str) -> str:
        """Return the path of an object."""
        return f"{self._root}/{_OBJECTS}/{digest[:2]}/{digest}"

    def _put(self, path: Path, found: StoredObject) -> None:
        """Write the content of a file as an object."""
        at = self._at(found[0])

        def write() -> None:
            self._files.makedirs(at.rsplit("/", 1)[0], exist_ok=True)
            self._files.put_file(str(path), at)

        self._call("writing an object", write)

    def _call(self, what: str, ask: Callable[[], _Answer]) -> _Answer:
        """Return what the store answers; try again where it fails, and raise one clear line at the end."""
        for attempt in range(_TRIES):
            try:
                return call_apart(ask, "gsvis-store").result(self.patience)
            except FileNotFoundError:
                raise
            except Late as error:
                raise BackendError(
                    f"{self.address}: {what}: no answer within {self.patience:g} s; is the store up and reachable?"
                ) from error
            except GsvisError:
                raise
            except Exception as error:  # fsspec raises what its backends raise
                if attempt < _TRIES - 1:
                    continue
                if type(error).__name__ == _CHECKSUM:
                    got = f"bytes that do not fit it, when {what}"
                    raise FormatError(
                        self.address, "", "content that fits its checksum", got, "run the same again"
                    ) from error
                raise BackendError(f"{self.address}: {what} failed {_TRIES} times: {_reason(error)}") from error
        raise AssertionError("unreachable")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled by its address."""
        return RemoteStore, (self.address, self.patience)


def _compare(path: Path, wanted: StoredObject, name: str = "") -> None:
    """Raise unless a file has the content of an object; a file with another content is removed."""
    shown = name or str(path)
    try:
        size = path.stat().st_size
        digest = digest_of(path) if size == wanted[1] else ""
    except FileNotFoundError as error:
        raise FormatError(shown, "", "an object of the store", "no such file", "run the same again") from error
    if digest != wanted[0]:
        path.unlink(missing_ok=True)  # so that the next run makes it again
        got = f"content with the hash {digest[:12]}..." if digest else f"{size:,} bytes, not {wanted[1]:,}"
        raise FormatError(shown, "", "content that fits its name", got, _AGAIN)


def _checked(name: str) -> str:
    """Return a name, or raise if it cannot be a file name everywhere."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"name: expected lower-case letters, digits, points and dashes, got {name[:40]!r}")
    return name


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split())[:200]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
