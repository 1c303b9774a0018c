"""Target: requests over HTTP as text: the range, the name of a file, then `HEAD` or further headers, a line each."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path

from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from gsvis.errors import FormatError
from gsvis.serve.parts import byte_range, node_folder, respond
from tests.fuzz.targets import Case, Target

__all__ = ["TARGETS", "answer", "asked_name"]

Respond = Callable[[Request, str], Awaitable[Response]]


def asked_name(text: bytes) -> tuple[str, str, list[str]]:
    """The value of Range, the name, and all further lines."""
    header, _, rest = text.decode("latin-1").partition("\n")
    name, *others = rest.split("\n")
    return header, name, others


def answer(text: bytes, respond: Respond) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of what a server answers to a request, the body as long as its headers say."""
    header, name, others = asked_name(text)
    pairs = [("range", header)] if header else []
    pairs += [(key.strip().lower(), value.strip()) for key, _, value in (line.partition(":") for line in others) if key]
    method = "HEAD" if "HEAD" in others else "GET"
    scope = {
        "type": "http",
        "method": method,
        "path": "/",
        "query_string": b"",
        "headers": [(key.encode("latin-1"), value.encode("latin-1")) for key, value in pairs],
    }

    async def run() -> tuple[int, dict[str, str], bytes]:
        found = await respond(Request(scope), name)
        if isinstance(found, StreamingResponse):
            pieces = [piece async for piece in found.body_iterator]
            body = b"".join(piece.encode() if isinstance(piece, str) else piece for piece in pieces)
        else:
            body = bytes(found.body)
        return found.status_code, dict(found.headers), body

    status, headers, body = asyncio.run(run())
    assert status in (200, 206, 304, 404, 416)
    if method == "GET" and status in (200, 206):
        assert len(body) == int(headers["content-length"])
    return status, headers, body


def requests() -> list[Case]:
    part = b"the bytes of a part"
    name = hashlib.sha256(part).hexdigest() + ".bin"
    digest, table = name[:64], f"{hashlib.sha256(part).hexdigest()}.pvs"
    files = {f"parts/{name}": part, f"beyond/{table}": part, "manifest.json": b"{}"}
    ranges = ("bytes=0-5", "bytes=-3", "bytes=4-", "bytes=90-", "bytes=5-2", "")
    asked = [f"{text}\n{name}" for text in ranges]
    asked += [f"bytes=1-2\n{table}", "\nmanifest.json", f"\n{digest}", "\nmanifest.json\nHEAD"]
    asked += [f'\n{name}\nif-none-match: W/"{digest}", "b"', f'bytes=0-1\n{name}\nif-range: "another"']
    folder = {"request.name": b"\nmanifest.json", "manifest.json/x": b""}
    return [*({"request.name": text.encode(), **files} for text in asked), folder]


def in_files(folder: Path, case: Case) -> None:
    """Answer a request for a file of a package or a world; what is sent whole fits its name."""
    text = case.get("request.name", b"")
    header, name, others = asked_name(text)
    for size in (0, 1, 50):
        found = byte_range(header, size)
        assert found is None or 0 <= found[0] <= found[1] <= size
    with suppress(FileNotFoundError):
        assert node_folder(folder, name).parent == folder / "packages"
    private = len(others) % 2 == 0
    status, headers, body = answer(text, lambda request, name: respond(request, folder, name, private=private))
    assert not (private and "public" in headers.get("cache-control", ""))
    if status == 200 and "HEAD" not in others and name[64:] in (".bin", ".arrow", ".pvs"):
        assert hashlib.sha256(body).hexdigest() == name[:64]


TARGETS = [
    Target(
        "requests",
        requests,
        in_files,
        (FormatError,),
        {"request.name": "text"},
        modules=("gsvis.serve.parts",),
        weight=0.3,
    ),
]
