"""Serve files of a package over HTTP, whole or in ranges, like a static file server; check each file before it is sent.

Clients can request only `manifest.json` and parts, and of a world `world.json` and tables. Names of parts and tables
are hashes; no text from a client becomes a path.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
from pathlib import Path

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from gsvis.errors import FormatError
from gsvis.files.limits import read_whole
from gsvis.package.manifest import MANIFEST
from gsvis.package.package import PARTS
from gsvis.package.parts import MOST_BYTES
from gsvis.world.manifest import WORLD
from gsvis.world.world import BEYOND, PACKAGES

__all__ = ["byte_range", "is_known", "node_folder", "part_of", "read_part", "respond"]

_MOST_MANIFEST = 64 << 20  # most bytes of a manifest, which is held in memory
_MOST_PART = 2 * MOST_BYTES
_MOST_TABLE = 1 << 30  # of what lies beyond a tile
_PART = re.compile(r"([0-9a-f]{64})\.(?:arrow|bin)")
_TABLE = re.compile(r"([0-9a-f]{64})\.pvs")
_NODE = re.compile(r"[0-9a-f]{64}")
_RANGE = re.compile(r"bytes=(\d{0,15})-(\d{0,15})")
_FOREVER = "public, max-age=31536000, immutable"


def byte_range(header: str, size: int) -> tuple[int, int] | None:
    """Return the first byte and the byte after the last that a Range header requests.

    Args:
        header: Value of the header.
        size: Bytes of the file.

    Returns:
        (start, stop); (0, 0) if the range covers no byte of the file; None if the header must be ignored, because it is
        malformed or requests several ranges.

    Examples:
        >>> byte_range("bytes=2-4", 10), byte_range("bytes=-3", 10), byte_range("bytes=10-", 10)
        ((2, 5), (7, 10), (0, 0))
    """
    found = _RANGE.fullmatch(header.strip())
    if found is None or found.group(0) == "bytes=-":
        return None
    first, last = found.groups()
    if not first:
        length = min(int(last), size)
        return (size - length, size) if length else (0, 0)
    start = int(first)
    if last and int(last) < start:
        return None
    stop = min(int(last) + 1, size) if last else size
    return (start, stop) if start < stop else (0, 0)


def is_known(request: Request, tag: str) -> bool:
    """Return whether a client has the content of a tag already; proxies that compress make a tag weak."""
    given = [each.strip().removeprefix("W/") for each in request.headers.get("if-none-match", "").split(",")]
    return tag in given


def part_of(request: Request, size: int, headers: dict[str, str]) -> tuple[int, int] | Response:
    """Return the first byte to send and the byte after the last, or an answer without content: 304 or 416.

    Args:
        request: A GET or HEAD request.
        size: Bytes of the file.
        headers: Headers of the answer, with `etag`; gains `content-length`, and `content-range` for a part.
    """
    tag = headers["etag"]
    if is_known(request, tag):
        return Response(status_code=304, headers=headers)
    asked = request.headers.get("range")
    part = None if asked is None or request.headers.get("if-range", tag) != tag else byte_range(asked, size)
    if part == (0, 0):
        return Response(status_code=416, headers={**headers, "content-range": f"bytes */{size}"})
    start, stop = part or (0, size)
    if part is not None:
        headers["content-range"] = f"bytes {start}-{stop - 1}/{size}"
    headers["content-length"] = str(stop - start)
    return start, stop


def read_part(package: Path, name: str) -> bytes:
    """Return a part, checked against its name.

    Args:
        package: Folder of the package.
        name: Name of the part.

    Raises:
        FileNotFoundError: If there is no such part, or the name cannot be that of a part.
        FormatError: If the part is damaged, a link, or not a file.
    """
    found = _PART.fullmatch(name)
    if found is None:
        raise FileNotFoundError(name)
    path = package / PARTS / name
    data = _read(path, _MOST_PART)
    digest = hashlib.sha256(data).hexdigest()
    if digest != found.group(1):
        raise FormatError(path, "", "content that fits its name", f"SHA-256 {digest[:12]}...", "copy it again")
    return data


def node_folder(world: Path, node: str) -> Path:
    """Return the folder of a package of a world.

    Raises:
        FileNotFoundError: If the name cannot be that of a package.
    """
    if not _NODE.fullmatch(node):
        raise FileNotFoundError(node)
    return world / PACKAGES / node


def _read_table(world: Path, name: str) -> bytes:
    """Return a table of what lies beyond a tile, checked against its name, as `read_part` does."""
    found = _TABLE.fullmatch(name)
    if found is None:
        raise FileNotFoundError(name)
    data = _read(world / BEYOND / name, _MOST_TABLE)
    digest = hashlib.sha256(data).hexdigest()
    if digest != found.group(1):
        expected = "content that fits its name"
        raise FormatError(world / BEYOND / name, "", expected, f"SHA-256 {digest[:12]}...", "copy it again")
    return data


def _read(path: Path, most: int) -> bytes:
    """Return the content of a file, at most so many bytes; raise FormatError for a link."""
    if path.is_symlink():
        raise FormatError(path, "", "a file of the package", "a link", "links are not followed; copy the file itself")
    return read_whole(path, most)


async def respond(request: Request, package: Path, name: str, *, private: bool) -> Response:
    """Answer a GET or HEAD request for a file of a package.

    Args:
        request: The request.
        package: Folder of the package.
        name: `manifest.json`, or the name of a part; for a world `world.json`, or the name of a table.
        private: Whether shared caches must not store the answer.

    Raises:
        FormatError: If the file is damaged.
    """
    try:
        if name in (MANIFEST, WORLD):
            data = await asyncio.to_thread(_read, package / name, _MOST_MANIFEST)
            tag = f'"{hashlib.sha256(data).hexdigest()}"'
            kind = "application/json"
            keep = "no-cache"
        else:
            read = _read_table if _TABLE.fullmatch(name) else read_part
            data = await asyncio.to_thread(read, package, name)
            tag = f'"{name[:64]}"'
            kind = "application/octet-stream"
            keep = _FOREVER
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        return PlainTextResponse("no such file\n", 404)
    headers = {"accept-ranges": "bytes", "etag": tag, "x-content-type-options": "nosniff"}
    headers["cache-control"] = keep.replace("public", "private") if private else keep
    part = part_of(request, len(data), headers)
    if isinstance(part, Response):
        return part
    body = b"" if request.method == "HEAD" else data[slice(*part)]
    return Response(body, 206 if "content-range" in headers else 200, headers, kind)
