"""Messages between a client and a server, byte by byte: little-endian, the first byte is the kind of the message.

`parse_client` reads the messages of a client. It rejects a message that is not complete and valid before it allocates
memory for it. Batches are in `batch.py`. docs/streaming.md describes the messages for other implementations.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field

import numpy as np

from gsvis.abr.classes import FieldOfView
from gsvis.errors import ProtocolError

__all__ = [
    "CLOSE_CODES",
    "FAULTS",
    "LEAST_HELLO",
    "MOST_HELLO",
    "NORMAL",
    "POLICY",
    "PROTOCOL",
    "Ack",
    "Bye",
    "Hello",
    "PoseAt",
    "ServerFault",
    "Token",
    "parse_client",
]

PROTOCOL = 3
"""Version of the messages."""

MOST_HELLO = 16 << 20
"""Default limit of a HELLO in bytes."""

HELLO = 1
POSE = 2
ACK = 3
BYE = 4
TOKEN = 5
WELCOME = 129
BATCH = 130
ERROR = 131

FAULTS = {
    "malformed": 1,
    "version": 2,
    "too-large": 3,
    "refused": 4,
    "too-many": 5,
    "flood": 6,
    "late": 7,
    "internal": 8,
    "ending": 9,
}
"""Codes of ERROR, in this order: invalid message; wrong version; over a limit; no token; too many connections; too many
messages; no acknowledgement for too long; a fault of the server; the server is shutting down."""

CLOSE_CODES = {FAULTS["too-many"]: 1013, FAULTS["internal"]: 1011, FAULTS["ending"]: 1012}
"""Close code of a WebSocket after an ERROR, by the code of the ERROR; else `POLICY`. After BYE it is `NORMAL`."""

NORMAL = 1000
POLICY = 1008

IDENTITY = 32
_HELLO = struct.Struct("<BBHI6f32sQ")  # type, version, 0, bytes of holdings, view, scene, memory
LEAST_HELLO = _HELLO.size
"""Bytes of a HELLO without holdings."""

_POSE = struct.Struct("<B3xI3f4f")
_ACK = struct.Struct("<B3xI")
_BYE = struct.Struct("<B3x")
_ERROR = struct.Struct("<BBH")  # type, code, bytes of the line
_TOKEN = struct.Struct("<BBH")  # type, 0, bytes of the token
_MOST_LINE = 1000


@dataclass(frozen=True)
class Hello:
    """The first message of a client.

    Attributes:
        view: The client's field of view.
        identity: 32 bytes, `SceneHeader.identity` of the scene of the holdings; zeros without holdings.
        holdings: What the client holds, from `Holdings.to_bytes`; empty for nothing.
        version: Version of the protocol.
        memory: Bytes of records that the client can hold; 0 means no limit.
    """

    view: FieldOfView
    identity: bytes = bytes(IDENTITY)
    holdings: bytes = b""
    version: int = PROTOCOL
    memory: int = 0

    def to_bytes(self) -> bytes:
        """Return the HELLO message.

        Raises:
            ValueError: If the identity is not 32 bytes, or the memory is not in [0, 2^64).
        """
        if len(self.identity) != IDENTITY:
            raise ValueError(f"identity: expected {IDENTITY} bytes, got {len(self.identity)}")
        if not 0 <= self.memory < 1 << 64:
            raise ValueError(f"memory: expected bytes >= 0, or 0 for no limit, got {self.memory}")
        v = self.view
        numbers = v.left, v.right, v.top, v.bottom, v.margin, v.near
        head = _HELLO.pack(HELLO, self.version, 0, len(self.holdings), *numbers, self.identity, self.memory)
        return head + self.holdings


@dataclass(frozen=True)
class PoseAt:
    """The pose of the client at a time.

    Attributes:
        time_ms: Milliseconds of the client's own clock, below 2^32.
        position: (3,) scene frame, float32.
        quat: (4,) wxyz, world from camera, not zero.
    """

    time_ms: int
    position: tuple[float, float, float]
    quat: tuple[float, float, float, float]

    def to_bytes(self) -> bytes:
        """Return the POSE message."""
        return _POSE.pack(POSE, self.time_ms & 0xFFFFFFFF, *self.position, *self.quat)


@dataclass(frozen=True)
class Ack:
    """All messages up to this one have arrived; WELCOME is number 0.

    Attributes:
        sequence: Number of the last message that arrived.
    """

    sequence: int

    def to_bytes(self) -> bytes:
        """Return the ACK message."""
        return _ACK.pack(ACK, self.sequence)


@dataclass(frozen=True)
class Bye:
    """The client is leaving."""

    def to_bytes(self) -> bytes:
        """Return the BYE message."""
        return _BYE.pack(BYE)


@dataclass(frozen=True)
class Token:
    """The token of the server, before HELLO: for a page, which cannot set headers of a WebSocket.

    Attributes:
        text: 1 to 1000 printable ASCII characters.
    """

    text: str = field(repr=False)

    def to_bytes(self) -> bytes:
        """Return the TOKEN message.

        Raises:
            ValueError: If the text is empty or too long, or has characters that are not printable ASCII.
        """
        if not _is_token(self.text.encode("utf-8", "replace")):
            got = f"{len(self.text):,} characters, or some that are not ASCII"  # never the token itself
            raise ValueError(f"text: expected 1 to {_MOST_LINE} printable ASCII characters, got {got}")
        return _TOKEN.pack(TOKEN, 0, len(self.text)) + self.text.encode()


def _is_token(text: bytes) -> bool:
    """Return whether bytes are 1 to 1000 printable ASCII characters."""
    return 1 <= len(text) <= _MOST_LINE and all(0x20 <= byte < 0x7F for byte in text)


@dataclass(frozen=True)
class ServerFault:
    """Why the server ends the connection.

    Attributes:
        code: One of `FAULTS`.
        line: Message for people.
    """

    code: int
    line: str

    def to_bytes(self) -> bytes:
        """Return the ERROR message."""
        text = self.line.encode("utf-8", "replace")[:_MOST_LINE]
        return _ERROR.pack(ERROR, self.code, len(text)) + text

    @classmethod
    def from_error(cls, error: Exception) -> ServerFault:
        """Return what the client gets to know about an error: all of a ProtocolError, no detail of any other."""
        if isinstance(error, ProtocolError):
            return cls(error.code, str(error))
        return cls(FAULTS["internal"], "the server failed; try again later")

    @classmethod
    def parse(cls, data: bytes) -> ServerFault:
        """Return the content of an ERROR message.

        Raises:
            ProtocolError: If the message is not an ERROR, or its length is wrong.
        """
        if len(data) < _ERROR.size or data[0] != ERROR:
            raise ProtocolError(f"message: expected ERROR, got {len(data)} bytes")
        _, code, length = _ERROR.unpack_from(data)
        if length > _MOST_LINE or len(data) != _ERROR.size + length:
            raise ProtocolError(f"ERROR: expected {_ERROR.size + length} bytes, got {len(data)}")
        return cls(code, data[_ERROR.size :].decode("utf-8", "replace"))


def parse_client(data: bytes, *, most_hello: int = MOST_HELLO) -> Hello | PoseAt | Ack | Bye | Token:
    """Return the content of a client's message.

    Args:
        data: One message.
        most_hello: Most bytes of a HELLO; for a known scene, `StreamedScene.most_hello`.

    Raises:
        ProtocolError: If the data are not one complete message with valid values. The code is `FAULTS["version"]` for a
            HELLO of an unsupported version, and `FAULTS["too-large"]` for a HELLO over the limit.
    """
    kind = data[0] if data else 0
    if kind == HELLO:
        return _parse_hello(data, most_hello)
    if kind == TOKEN:
        return _parse_token(data)
    for code, name, layout in ((POSE, "POSE", _POSE), (ACK, "ACK", _ACK), (BYE, "BYE", _BYE)):
        if kind == code:
            if len(data) != layout.size:
                raise ProtocolError(f"{name}: expected {layout.size} bytes, got {len(data)}")
            if data[1:4] != b"\0\0\0":
                raise ProtocolError(f"{name}: expected zeros in bytes 1 to 3, got {data[1:4].hex()}")
    if kind == POSE:
        _, time_ms, x, y, z, *quat = _POSE.unpack(data)
        a, b, c, d = quat
        if not all(map(math.isfinite, (x, y, z, *quat))):
            raise ProtocolError(f"POSE: expected finite numbers, got {(x, y, z)} and {tuple(quat)}")
        if not 1e-12 < a * a + b * b + c * c + d * d < 1e12:
            raise ProtocolError(f"POSE: expected a rotation with a length of 1e-6 to 1e6, got {tuple(quat)}")
        return PoseAt(time_ms, (x, y, z), (a, b, c, d))
    if kind == ACK:
        return Ack(_ACK.unpack(data)[1])
    if kind == BYE:
        return Bye()
    raise ProtocolError(f"message: expected one of HELLO, POSE, ACK, BYE, TOKEN, got {'nothing' if not data else kind}")


def _parse_token(data: bytes) -> Token:
    """Return the content of a TOKEN message; errors never quote the token."""
    if not _TOKEN.size < len(data) <= _TOKEN.size + _MOST_LINE:
        raise ProtocolError(
            f"TOKEN: expected {_TOKEN.size + 1} to {_TOKEN.size + _MOST_LINE:,} bytes, got {len(data):,}"
        )
    _, zero, length = _TOKEN.unpack_from(data)
    text = data[_TOKEN.size :]
    if zero or length != len(text) or not _is_token(text):
        got = f"length {length} for {len(text)} bytes" if length != len(text) else "bytes that are not"
        raise ProtocolError(f"TOKEN: expected its length and printable ASCII characters, got {got}")
    return Token(text.decode())


def _parse_hello(data: bytes, most: int) -> Hello:
    """Return the content of a HELLO message of at most `most` bytes."""
    if len(data) > most:
        raise ProtocolError(f"HELLO: expected at most {most:,} bytes, got {len(data):,}", FAULTS["too-large"])
    if len(data) < 2 or data[1] != PROTOCOL:
        got = f"version {data[1]}" if len(data) > 1 else "none"
        raise ProtocolError(f"HELLO: expected version {PROTOCOL}, got {got}; update", FAULTS["version"])
    if len(data) < _HELLO.size:
        raise ProtocolError(f"HELLO: expected at least {_HELLO.size} bytes, got {len(data)}")
    _, version, zero, length, *numbers, identity, memory = _HELLO.unpack_from(data)
    if zero or len(data) != _HELLO.size + length:
        raise ProtocolError(f"HELLO: expected {_HELLO.size + length:,} bytes, got {len(data):,}")
    if not np.abs(np.array(numbers)).max() < 1e6:  # worded so that NaN fails
        raise ProtocolError(f"HELLO: expected a field of view of numbers below 1e6, got {tuple(numbers)}")
    try:
        view = FieldOfView(*numbers)
        view.planes((0, 0, 0), (1, 0, 0, 0))
    except ValueError as error:
        raise ProtocolError(f"HELLO: {error}") from error
    return Hello(view, identity, data[_HELLO.size :], version, memory)
