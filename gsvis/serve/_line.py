"""The socket of one connection and the transport of asyncio above it, with TLS or without."""

from __future__ import annotations

import socket
import struct
import sys
from contextlib import suppress
from typing import Any

__all__ = ["Line"]

_AT_ONCE = struct.pack("ii", 1, 0)  # linger for 0 seconds


class Line:
    """A socket and its transport.

    Args:
        sock: The accepted socket.

    Attributes:
        fd: Number of the socket, also after it is closed.
        transport: The transport; None before the connection is made and after it is lost.
    """

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self.fd = sock.fileno()
        self.transport: Any = None

    @property
    def unsent(self) -> int:
        """Bytes that wait for room in the socket."""
        if self.transport is None:
            return 0
        tls = getattr(self.transport, "_ssl_protocol", None)
        below = getattr(tls, "_transport", None)
        if tls is not None and below is None:  # the transport is about to report its end
            return 0
        waiting = int(self.transport.get_write_buffer_size())
        if below is not None and sys.version_info >= (3, 11):  # TLS counts only bytes that it still holds
            waiting += int(below.get_write_buffer_size())
        return waiting

    def abort(self) -> None:
        """Cut the connection now and discard unsent bytes, in the kernel too."""
        with suppress(OSError):
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
        if self.transport is not None:
            self.transport.abort()
        else:  # in the handshake, which ends when it reads the end
            with suppress(OSError):
                self._sock.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection after everything is sent."""
        if self.transport is not None and not self.transport.is_closing():  # a second close of TLS cannot be aborted
            self.transport.close()

    def end_writing(self) -> None:
        """Send nothing more, and let the peer read what was sent."""
        if self.transport.can_write_eof():
            self.transport.write_eof()  # a close with unread bytes would discard the answer
        else:
            self.transport.close()
