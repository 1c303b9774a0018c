"""Check the head of a request, byte for byte, before any other parser sees it.

A head that passes here also passes in h11 and in websockets, so one parser decides what a request is. Only requests
without a body pass, since no address of the server accepts a body.
"""

from __future__ import annotations

import re
from typing import NamedTuple

__all__ = ["MOST_BYTES", "Head", "Refusal", "RequestBuffer", "check_head", "find_end"]

MOST_BYTES = 32 << 10
"""Most bytes of a head; the holdings of a viewer are in HELLO, not in the head."""

_MOST_LINE = 8000  # bytes; the WebSocket parser takes 8192
_MOST_HEADERS = 100  # the WebSocket parser takes 128

_END = b"\r\n\r\n"
_REQUEST = re.compile(rb"([!#$%&'*+.^_`|~0-9A-Za-z-]{1,32}) ([\x21-\x7e]+) HTTP/1\.([01])")
_HEADER = re.compile(rb"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([\t\x20-\x7e\x80-\xff]*)")
_BARE = re.compile(rb"(?<!\r)\n|\r(?!\n|$)|\0")


class Head(NamedTuple):
    """The parts of a request that the guard of a connection needs."""

    method: str
    target: str
    headers: list[tuple[str, str]]  # names in lower case


class Refusal(NamedTuple):
    """Why a request is not served."""

    status: int
    line: str


def find_end(data: bytes | bytearray, seen: int = 0) -> int | Refusal | None:
    r"""Return where the first head in some bytes ends; None while it is incomplete.

    Args:
        data: Bytes received so far.
        seen: Number of these bytes that were checked before.

    Examples:
        >>> find_end(b"GET / HTTP/1.1\r\n\r\nmore"), find_end(b"GET / HT")
        (18, None)
        >>> find_end(b"GET / HTTP/1.1\n")
        Refusal(status=400, line='a line ends without CR LF')
    """
    start = max(seen - len(_END), 0)
    end = data.find(_END, start)
    if _BARE.search(data, start, len(data) if end < 0 else end + len(_END)):
        return Refusal(400, "a line ends without CR LF")
    if (end if end >= 0 else len(data)) > MOST_BYTES:
        return Refusal(431, f"the head of the request is longer than {MOST_BYTES} bytes")
    return None if end < 0 else end + len(_END)


def check_head(head: bytes) -> Head | Refusal:
    r"""Return the parts of a head, or why it is refused.

    Args:
        head: The request line and the headers, up to and including the empty line.

    Examples:
        >>> check_head(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        Head(method='GET', target='/', headers=[('host', 'localhost')])
        >>> check_head(b"GET / HTTP/1.1\r\nA b: c\r\n\r\n")
        Refusal(status=400, line='a header is malformed')
    """
    first, *lines = head[: -len(_END)].split(b"\r\n")
    if len(first) > _MOST_LINE:
        return Refusal(414, f"the request line is longer than {_MOST_LINE} bytes")
    if len(lines) > _MOST_HEADERS or any(len(line) > _MOST_LINE for line in lines):
        return Refusal(431, f"more than {_MOST_HEADERS} headers, or one longer than {_MOST_LINE} bytes")
    request = _REQUEST.fullmatch(first)
    if request is None:
        return Refusal(400, "the request line is malformed")
    found = [_HEADER.fullmatch(line) for line in lines]
    if not all(found):
        return Refusal(400, "a header is malformed")
    headers = [(m[1].decode().lower(), m[2].decode("latin-1").strip(" \t")) for m in found if m is not None]
    names = [name for name, _ in headers]
    hosts = names.count("host")
    if hosts > 1 or (hosts == 0 and request[3] == b"1"):
        return Refusal(400, "expected one Host header")
    lengths = [value for name, value in headers if name == "content-length"]
    if lengths and "transfer-encoding" in names:
        return Refusal(400, "both Content-Length and Transfer-Encoding")
    if any(not re.fullmatch(r"[0-9]{1,18}", value) for value in lengths) or len(lengths) > 1:
        return Refusal(400, "Content-Length is malformed")
    if "transfer-encoding" in names or any(int(value) for value in lengths):
        return Refusal(413, "no request of this server has a body")
    return Head(request[1].decode(), request[2].decode(), headers)


class RequestBuffer:
    """The bytes of a peer that are no complete request yet, and those behind it."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._checked = 0  # bytes in which no head ends

    def __len__(self) -> int:
        return len(self._data)

    def add(self, data: bytes) -> None:
        """Add bytes of the peer."""
        self._data += data

    def take_request(self) -> tuple[bytes, Head] | Refusal | None:
        """Take out the first head: its bytes and its parts; or why it is refused; None while it is incomplete."""
        while self._data.startswith(b"\r\n"):  # allowed between requests
            del self._data[:2]
            self._checked = 0
        end = find_end(self._data, self._checked)
        self._checked = len(self._data) if end is None else 0
        if end is None or isinstance(end, Refusal):
            return end
        raw = bytes(self._data[:end])
        head = check_head(raw)
        if isinstance(head, Refusal):
            return head
        del self._data[:end]
        return raw, head

    def take_rest(self) -> bytes:
        """Take out all bytes."""
        found = bytes(self._data)
        self._data.clear()
        return found

    def clear(self) -> None:
        """Discard all bytes."""
        self._data.clear()
