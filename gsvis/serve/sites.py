"""Static scenes: the files that `gsvis export --format static` writes, served as any file server does.

`gsvis view` shows a bare scene in this form. Clients can request only the files that `scene.json` names; no text of a
client becomes a path.
"""

from __future__ import annotations

import asyncio
import os
import re
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse

from gsvis.errors import FormatError
from gsvis.export.static import FORMAT, SCENE
from gsvis.files.fields import parse_json
from gsvis.files.limits import open_regular, read_whole
from gsvis.serve.parts import part_of

__all__ = ["SCENE", "Site", "is_site"]

_MOST_JSON = 64 << 20
_MOST_FILES = 1 << 20  # of one kind
_PIECE = 1 << 20  # bytes read and sent at a time
_HASHED = re.compile(r"-[0-9a-f]{16}(?:-\d+)?\.bin$")  # such a file never changes
_LATE = re.compile(r"walk-[0-9a-f]{16}\.bin")  # gsvis.export.later_walk writes it while the scene is shown
_LOOK = 0.1  # seconds between two looks for such a file
_SOON = 0.02  # seconds between two looks for a scene
_QUIET = 30  # such looks without a request after which pages have what they need
_MOST_LOOKS = 600
_PATIENCE = 60.0  # seconds for which an answer waits for it
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}")


def is_site(folder: Path) -> bool:
    """Return whether a folder may hold a static scene rather than a package."""
    return (folder / SCENE).is_file()


class Site:
    """A folder with a static scene.

    Args:
        folder: The folder.
        promised: Number of Gaussians of a scene that is still being written: `read` must be called when it is there,
            and those who ask for `scene.json` wait until then. None for a scene that is there.

    Attributes:
        folder: The folder.
        about: Content of `scene.json`.
        is_there: Whether the scene has been read.
        names: Names of the files that it lists, and its own.
        answers: How many requests for files were answered.
        is_walk_asked: Whether anybody has asked for the file of walking that is written later.

    Raises:
        FormatError: If `scene.json` is not one of a static scene.
        OSError: If it cannot be read.
    """

    def __init__(self, folder: Path, promised: int | None = None) -> None:
        self.folder = folder
        self.about: dict[str, Any] = {"gaussians": promised}
        self.names = frozenset([SCENE])
        self.is_there = False
        self.answers = 0
        self.is_walk_asked = False
        if promised is None:
            self.read()

    def read(self) -> None:
        """Read `scene.json`.

        Raises:
            FormatError: If it is not one of a static scene.
            OSError: If it cannot be read.
        """
        path = self.folder / SCENE
        about = parse_json(path, read_whole(path, _MOST_JSON))
        if not isinstance(about, dict) or about.get("format") != FORMAT:
            raise FormatError(path, "format", FORMAT, repr(about.get("format") if isinstance(about, dict) else None))
        names = [name for name in _names(about.get("files")) if _NAME.fullmatch(name) and ".." not in name]
        self.about = about
        self.names = frozenset([SCENE, *names])
        self.is_there = True

    @property
    def gaussians(self) -> int | None:
        """Number of Gaussians; None if `scene.json` does not say."""
        found = self.about.get("gaussians")
        return found if type(found) is int and 0 <= found < 1 << 31 else None

    def wait_until_quiet(self, sleep: Callable[[float], None] = time.sleep) -> None:
        """Return when nobody asks for files for three seconds, or somebody for that of walking; in a minute at most."""
        seen = self.answers
        quiet = 0
        for _ in range(_MOST_LOOKS):
            if self.is_walk_asked or quiet == _QUIET:
                return
            sleep(_LOOK)
            quiet = quiet + 1 if self.answers == seen else 0
            seen = self.answers

    async def respond(self, request: Request, name: str, *, private: bool) -> Response:
        """Answer a GET or HEAD request for a file, whole or a range.

        Args:
            request: The request.
            name: Name of the file.
            private: Whether shared caches must not store the answer.

        Raises:
            FormatError: If the file is a link, a pipe or a device.
            OSError: If the file cannot be read.
        """
        path = self.folder / name
        self.answers += 1
        self.is_walk_asked |= bool(_LATE.fullmatch(name))
        if not await self._is_written():
            return PlainTextResponse("the scene is not there yet; try again\n", 503, {"retry-after": "1"})
        if name not in self.names or not await _comes(path) or path.is_dir():
            return PlainTextResponse("no such file\n", 404)
        if path.is_symlink():
            raise FormatError(path, "", "a file of the scene", "a link", "links are not followed")
        source = open_regular(path)
        try:
            return self._answer(request, source, name, private)
        except BaseException:
            source.close()
            raise

    async def _is_written(self) -> bool:
        """Return whether the scene is there; one that is promised is waited for."""
        for _ in range(int(_PATIENCE / _SOON)):
            if self.is_there:
                break
            await asyncio.sleep(_SOON)
        return self.is_there

    def _answer(self, request: Request, source: BinaryIO, name: str, private: bool) -> Response:
        """Answer with an open file, which is closed at the end."""
        state = os.fstat(source.fileno())
        tag = f'"{state.st_mtime_ns:x}-{state.st_size:x}"'
        headers = {"accept-ranges": "bytes", "etag": tag, "x-content-type-options": "nosniff"}
        whose = "private" if private else "public"
        headers["cache-control"] = f"{whose}, max-age=31536000, immutable" if _HASHED.search(name) else "no-cache"
        if name.startswith("plain-"):  # for pages on this machine: to store them again takes longer than to send them
            headers["cache-control"] = "no-store"
        kind = "application/json" if name.endswith(".json") else "application/octet-stream"
        part = part_of(request, state.st_size, headers)
        status = 206 if "content-range" in headers else 200
        if isinstance(part, Response) or request.method == "HEAD":
            source.close()
            return part if isinstance(part, Response) else Response(b"", status, headers, kind)
        return StreamingResponse(_pieces(source, *part), status, headers, kind)


async def _comes(path: Path) -> bool:
    """Return whether a file is there; one of walking is waited for, which is written after the others."""
    waits = int(_PATIENCE / _LOOK) if _LATE.fullmatch(path.name) else 0
    for _ in range(waits):
        if path.exists():
            return True
        await asyncio.sleep(_LOOK)
    return path.exists()


async def _pieces(source: BinaryIO, start: int, stop: int) -> AsyncIterator[bytes]:
    """Yield the bytes of a file from `start` to `stop`, piece by piece; close the file."""
    with source:
        source.seek(start)
        while start < stop:
            data = await asyncio.to_thread(source.read, min(_PIECE, stop - start))
            if not data:  # cut while it was read: the connection ends early, which the client notices
                raise OSError("a file of the scene became shorter while it was sent")
            start += len(data)
            yield data


def _names(files: Any) -> Iterator[str]:
    """Yield the names of the files in `scene.json`; files of one kind are numbered."""
    for row in files.values() if isinstance(files, dict) else ():
        if not isinstance(row, dict) or "name" not in row:
            continue
        name = str(row["name"])
        count = row.get("count")
        if name.endswith(".bin") or type(count) is not int:
            yield name
        else:
            yield from (f"{name}-{k}.bin" for k in range(min(count, _MOST_FILES)))
