"""A host of files behind a slow link: HTTP/1.1 with keep-alive over loopback, and delay and rate as of one visitor.

The first answer on a connection waits for a round trip more, as its set-up takes one. An answer begins a round trip
after its request, and all connections share one rate. Text is compressed, as hosts do. There are no ranges.
"""

from __future__ import annotations

import asyncio
import gzip
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote, urlsplit

__all__ = ["Host", "slow_host"]

_TYPES = {
    ".html": "text/html; charset=utf-8", ".js": "text/javascript", ".mjs": "text/javascript", ".css": "text/css",
    ".json": "application/json", ".webp": "image/webp", ".wasm": "application/wasm",
}  # fmt: skip
_TEXT = ("text/", "application/json", "application/wasm")
_SLICE = 4096  # bytes that one connection sends before the next one has its turn


@dataclass
class Host:
    """A host.

    Attributes:
        url: Its address.
        delay: Seconds of a round trip.
        rate: Bytes a second of all connections together.
        log: For each answer the path, bytes, and seconds since `began` of the request and of its last byte.
        began: When the log begins.
    """

    folder: Path
    url: str = ""
    delay: float = 0.0
    rate: float = 1e9
    log: list[tuple[str, int, float, float]] = field(default_factory=list)
    began: float = 0.0
    connections: int = 0
    _free: float = 0.0

    def begin(self, delay: float, rate: float) -> None:
        """Start another visit."""
        self.delay, self.rate, self.log, self.connections, self.began = delay, rate, [], 0, time.monotonic()
        self._free = self.began

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the requests of a connection."""
        self.connections += 1
        await asyncio.sleep(self.delay)
        try:
            while line := await reader.readline():
                while (await reader.readline()).strip():
                    pass
                await self._answer(urlsplit(line.split()[1].decode()).path, writer)
        except (ConnectionError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()

    async def _answer(self, path: str, writer: asyncio.StreamWriter) -> None:
        asked = time.monotonic()
        file = (self.folder / unquote(path).lstrip("/")).resolve()
        file = file / "index.html" if file.is_dir() else file
        found = file.is_relative_to(self.folder) and file.is_file()
        data = file.read_bytes() if found else b"not here"
        kind = _TYPES.get(file.suffix, "application/octet-stream") if found else "text/plain"
        packed = kind.startswith(_TEXT) and len(data) > 200
        data = gzip.compress(data, 6) if packed else data
        head = f"HTTP/1.1 {200 if found else 404} X\r\nContent-Type: {kind}\r\nContent-Length: {len(data)}\r\n"
        head += "Content-Encoding: gzip\r\n" if packed else ""
        head += "Cache-Control: public, max-age=600\r\nConnection: keep-alive\r\n\r\n"
        await asyncio.sleep(max(asked + self.delay - time.monotonic(), 0))
        whole = head.encode() + data
        for at in range(0, len(whole), _SLICE):
            some = whole[at : at + _SLICE]
            self._free = max(self._free, time.monotonic()) + len(some) / self.rate
            await asyncio.sleep(max(self._free - time.monotonic(), 0))
            writer.write(some)
            await writer.drain()
        self.log.append((path, len(data), asked - self.began, time.monotonic() - self.began))


@contextmanager
def slow_host(folder: Path) -> Iterator[Host]:
    """A host of the files in a folder."""
    host = Host(folder.resolve())
    loop = asyncio.new_event_loop()
    server = loop.run_until_complete(asyncio.start_server(host.serve, "127.0.0.1", 0))
    host.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/"
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    try:
        yield host
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
