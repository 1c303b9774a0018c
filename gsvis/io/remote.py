"""Fetch scenes by address: a file over http or https, or from any storage that fsspec knows, such as `s3://`.

A scene of several files, a streamed SOG or a SOG folder, is named by its JSON, and the files that it names are fetched
too; of a streamed SOG those of one level of detail. This module decodes no scene.
"""

from __future__ import annotations

import os
import re
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Any
from urllib.parse import unquote, urljoin, urlsplit

from gsvis import _extras
from gsvis.errors import FormatError
from gsvis.files.fields import parse_object
from gsvis.files.limits import read_whole
from gsvis.io.sog import SogMeta
from gsvis.io.streamed_sog import files_of_level
from gsvis.progress import Progress, silent

__all__ = ["fetch_scene", "is_address"]

_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_WEB = ("http", "https")
_PATIENCE = 30.0  # seconds without an answer
_BLOCK = 1 << 20
_AGENT = {"User-Agent": "gsvis"}  # some hosts refuse programs without a name


def is_address(scene: str | os.PathLike[str]) -> bool:
    """Return whether a scene is named by an address such as `https://example.org/scene.spz`.

    Examples:
        >>> is_address("s3://bucket/scene.ply"), is_address("builtin:flat"), is_address("scene.ply")
        (True, False, False)
    """
    return bool(_ADDRESS.match(os.fspath(scene)))


def fetch_scene(address: str, folder: Path, lod: int | None = None, *, progress: Progress = silent) -> Path:
    """Fetch a scene into a folder, and return the path of its file, or of the JSON that names its files.

    Args:
        address: Address of the file: http, https, or a scheme of fsspec.
        folder: An empty folder to write to.
        lod: Level of detail of a streamed SOG; None means the finest.
        progress: Called with stage "fetching", in bytes of a file alone, else in files.

    Raises:
        FormatError: If the address gives no file, or less of it than it said; or the JSON is no scene.
        MissingExtraError: If fsspec is needed and not installed.
        ValueError: If the level is not there.
        OSError: If it cannot be written.
    """
    path = folder / _name_of(address)
    _fetch(address, path, progress)
    if path.suffix.lower() != ".json":
        return path
    names = _named_files(path, lod)
    fetched = {path.name}
    while names:
        name = names.pop(0)
        if name in fetched:
            continue
        fetched.add(name)
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        _fetch(urljoin(address, name), target, silent)
        if PurePosixPath(name).suffix.lower() == ".json":
            inner = PurePosixPath(name).parent
            names += [str(inner / each) for each in _named_files(target, None)]
        progress("fetching", len(fetched), len(fetched) + len(names))
    return path


def _name_of(address: str) -> str:
    """Return the last part of the path of an address, as the name of a file."""
    last = PurePosixPath(unquote(urlsplit(address).path)).name
    kept = re.sub(r"[^\w.,=+ -]", "_", last)[-100:].lstrip(".")
    return kept or "scene"


def _named_files(path: Path, lod: int | None) -> list[str]:
    """Return the names of the files that the JSON of a scene needs, relative to it; checked to stay below it."""
    fields = parse_object(path, read_whole(path))
    if "tree" in fields or "filenames" in fields:
        return files_of_level(path, lod)
    return list(SogMeta(fields).names)


def _fetch(address: str, target: Path, progress: Progress) -> None:
    """Write what an address gives into a file.

    Raises:
        FormatError: If it gives nothing, or less than it said.
    """
    try:
        with _opened(address) as (stream, size), target.open("wb") as file:
            done = 0
            progress("fetching", 0, size or 1)
            while block := stream.read(_BLOCK):
                file.write(block)
                done += len(block)
                progress("fetching", min(done, size or 1), size or 1)
    except urllib.error.HTTPError as error:
        raise FormatError(address, "", "a file", f"{error.code} {error.reason}", "open it in a browser") from error
    except urllib.error.URLError as error:
        raise FormatError(address, "", "a host that answers", str(error.reason), "is the address right?") from error
    except TimeoutError as error:
        raise FormatError(address, "", f"an answer within {_PATIENCE:g} s", "none", "try again") from error
    if size and done != size:
        raise FormatError(address, "", f"{size:,} bytes", f"{done:,}", "the connection broke; try again")
    progress("fetching", size or 1, size or 1)


@contextmanager
def _opened(address: str) -> Iterator[tuple[IO[bytes], int]]:
    """Yield a stream of what an address gives, and its bytes, 0 if they are not known."""
    if urlsplit(address).scheme.lower() in _WEB:
        request = urllib.request.Request(address, headers=_AGENT)
        with urllib.request.urlopen(request, timeout=_PATIENCE) as answer:
            yield answer, int(answer.headers.get("Content-Length") or 0)
        return
    _extras.require(f"an address with {urlsplit(address).scheme}://", "fsspec")
    with _opened_by_fsspec(address) as found:
        yield found


@contextmanager
def _opened_by_fsspec(address: str) -> Iterator[tuple[IO[bytes], int]]:
    """Yield a stream and the bytes of a file in a storage of fsspec.

    Raises:
        FormatError: If fsspec does not know the address, or finds no file.
    """
    import fsspec

    try:
        files, place = fsspec.core.url_to_fs(address)
        size = int(files.info(place).get("size") or 0)
        stream: Any = files.open(place, "rb")
    except Exception as error:  # fsspec raises what its backends raise
        got = " ".join(str(error).split()) or type(error).__name__
        raise FormatError(address, "", "a file that fsspec can open", got, "is the address right?") from error
    with stream:
        yield stream, size
