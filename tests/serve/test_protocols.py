"""The protocol of WebSockets: few small messages wait for the application without a pause of the socket."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from gsvis.serve._protocols import Socket


class Transport:
    """A transport that counts."""

    def __init__(self) -> None:
        self.paused, self.resumed = 0, 0

    def pause_reading(self) -> None:
        self.paused += 1

    def resume_reading(self) -> None:
        self.resumed += 1


def socket_of(transport: Transport) -> Any:
    socket: Any = Socket.__new__(Socket)
    socket.queue, socket.frames, socket.curr_msg_data_type = asyncio.Queue(), [], "bytes"
    socket.read_paused, socket.close_sent, socket.transport = False, False, transport
    return socket


def hear(socket: Any, *frames: bytes) -> None:
    socket.frames = list(frames)
    socket.send_receive_event_to_app()


@pytest.mark.parametrize(("count", "size", "pauses"), [(16, 40, 0), (17, 40, 1), (40, 40, 1), (1, 300, 1), (3, 300, 1)])
def test_reading_pauses_once_when_many_or_large_messages_wait(count: int, size: int, pauses: int) -> None:
    async def run() -> None:
        transport = Transport()
        socket = socket_of(transport)
        for k in range(count):
            hear(socket, bytes([k]) * (size - 1), b"\1")
        assert (transport.paused, socket.read_paused) == (pauses, pauses > 0)
        for k in range(count):
            assert (await socket.receive())["bytes"] == bytes([k]) * (size - 1) + b"\1"
        assert (transport.resumed, socket.read_paused) == (pauses, False)

    asyncio.run(run())
