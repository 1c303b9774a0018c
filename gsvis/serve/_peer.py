"""A WebSocket of Starlette, with the interface that a connection needs."""

from __future__ import annotations

from starlette.websockets import WebSocket, WebSocketDisconnect

from gsvis.errors import ProtocolError
from gsvis.serve._protocols import GUARD
from gsvis.serve.connection import GoneError

__all__ = ["SocketPeer"]

_ENDED = 1012  # close code of uvicorn when the server stops
_LEFT = (1000, 1001)


class SocketPeer:
    """The socket of a client.

    Args:
        socket: An accepted WebSocket.
    """

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket

    async def receive(self) -> bytes:
        """Return the next message; see `Peer`."""
        message = await self._socket.receive()
        if message["type"] == "websocket.disconnect":
            code = message.get("code", 1005)
            raise GoneError(
                "ending" if code == _ENDED else "too-large" if code == 1009 else "left" if code in _LEFT else "lost"
            )
        data = message.get("bytes")
        if data is None:
            raise ProtocolError("message: expected bytes, got text")
        return bytes(data)

    async def send(self, data: bytes) -> None:
        """Send a message; see `Peer`."""
        try:
            await self._socket.send_bytes(data)
        except (WebSocketDisconnect, RuntimeError) as error:
            raise GoneError("lost") from error

    async def close(self, reason: str, code: int) -> None:
        """Close the connection; see `Peer`."""
        try:
            await self._socket.close(code, reason)
        except (WebSocketDisconnect, RuntimeError) as error:
            raise GoneError("lost") from error

    def abort(self) -> None:
        """Cut the connection; see `Peer`."""
        guard = self._socket.scope.get("extensions", {}).get(GUARD)
        if guard is not None:
            guard.cut()
