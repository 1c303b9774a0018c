"""One client of the server: two loops over its socket around one `Session`, which decides what to send.

One loop receives into a short list; the other reads the list, plans and sends. So no two tasks use a session at once.
Memory is bounded whatever a client does: the allowance of the session limits the bytes in flight, and a count limits
the list. Deadlines use the clock of the server; link measurements and the pace of batches use real time. Seconds, bytes
of messages.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol, TypeVar

from gsvis.abr.config import AbrConfig
from gsvis.errors import FormatError, ProtocolError
from gsvis.serve._log import EventLog
from gsvis.serve.clock import Clock, Timer
from gsvis.serve.limits import Limits, Pace, RateBucket
from gsvis.serve.metrics import Metrics
from gsvis.serve.scenes import ServedScene
from gsvis.stream import Ack, Bye, Hello, Message, PoseAt, Session, StreamedScene, Token, parse_client
from gsvis.stream.wire import CLOSE_CODES, FAULTS, LEAST_HELLO, NORMAL, POLICY, ServerFault

__all__ = ["Connection", "GoneError", "Peer", "PoseClock", "Setting"]

_IN_A_ROW = 16  # messages of a client that are taken before others run
_MOST_HEARD = 256  # most poses and acknowledgements that wait in the list
_ROUND = 1.0  # seconds after which a client is checked even if nothing happens
_FAREWELL = 1.0  # most seconds to send the last message
_SLACK = 1e-6  # seconds of rounding error
_PICTURE = 1 << 17  # bytes of messages after which a client has a picture; showroom has one of 20 dB after 20 to 160 KB


_T = TypeVar("_T")


class GoneError(Exception):
    """The client has closed the connection, or it broke."""


class _ByeError(GoneError):
    """The client has said BYE; the connection is still open."""


class Peer(Protocol):
    """The socket of a client."""

    async def receive(self) -> bytes:
        """Return the next message; raises `GoneError`, or ProtocolError for text."""
        ...

    async def send(self, data: bytes) -> None:
        """Send when there is room in the buffer of the socket; raises `GoneError`."""
        ...

    async def close(self, reason: str, code: int) -> None:
        """Close the connection with a code of WebSockets and a reason."""
        ...

    def abort(self) -> None:
        """Cut the connection and discard unsent bytes."""
        ...


@dataclass(frozen=True)
class Setting:
    """What all connections of a server share.

    Attributes:
        limits: Bounds.
        metrics: Counters of the server.
        log: Log of events.
        config: Settings of the sessions.
        clock: Clock of the deadlines.
        measure: Function that returns seconds, never decreasing, to measure links and pace work.
        planners: Executor that plans batches; None plans in the thread of the event loop.
        pace: How late the server runs.
    """

    limits: Limits
    metrics: Metrics
    log: EventLog
    config: AbrConfig
    clock: Clock = field(default_factory=Clock)
    measure: Callable[[], float] = time.monotonic
    planners: Executor | None = None
    pace: Pace = field(default_factory=Pace)


class PoseClock:
    """Convert times of a client's clock to the server's clock, with the smallest recent delay.

    After a stall many poses arrive at once. The predictor needs the times at which they were taken.
    """

    _CREEP = 1e-3  # seconds per second by which the delay grows: clocks differ in speed

    def __init__(self) -> None:
        self._offset: float | None = None
        self._ms = 0
        self._turns = 0
        self._arrived = 0.0

    def at(self, arrived: float, time_ms: int) -> float:
        """Return the server's seconds at which a pose was taken, never later than its arrival.

        Args:
            arrived: Arrival of the pose, seconds of the server.
            time_ms: Milliseconds of the client; they start again after 2^32.
        """
        if self._offset is not None and self._ms - time_ms > 1 << 31:
            self._turns += 1
        seconds = (time_ms + (self._turns << 32)) / 1e3
        offset = arrived - seconds
        if self._offset is not None:
            offset = min(offset, self._offset + self._CREEP * (arrived - self._arrived))
        self._offset = offset
        self._ms = time_ms
        self._arrived = arrived
        return seconds + offset


class Connection:
    """Serve one client until it leaves or the server disconnects it.

    Args:
        peer: Socket of the client.
        served: The scene.
        setting: What all connections share.
        number: Number of the client in the log.
        seat: Called after a valid HELLO; returns why this client may not stream, or "". None always allows it.
        greet_s: Seconds for TOKEN and HELLO together; None means `Limits.handshake_s`.

    Attributes:
        session: The session; None before HELLO.
        reason: Why the connection ended: "left", "lost", or a limit or fault.
    """

    def __init__(
        self,
        peer: Peer,
        served: ServedScene,
        setting: Setting,
        number: int,
        seat: Callable[[], str] | None = None,
        *,
        greet_s: float | None = None,
    ) -> None:
        self._greet_s = setting.limits.handshake_s if greet_s is None else greet_s
        self._peer = peer
        self._served = served
        self._setting = setting
        self.number = number
        self._seat = seat
        self.session: Session | None = None
        self.reason = ""
        self._heard: list[tuple[float, PoseAt | Ack]] = []
        self._bell: asyncio.Future[None] | None = None
        limits = setting.limits
        self._messages = RateBucket(limits.messages_per_s, limits.messages_per_s * limits.burst_s)
        self._poses = RateBucket(limits.poses_per_s, limits.poses_per_s)
        self._pose_clock = PoseClock()
        self._alive = self._moved = setting.clock.now()
        self._planned = setting.measure()
        self._alarm: Timer | None = None
        # a pose; one not planned for; nothing to send
        self._has_pose = False
        self._fresh = False
        self._dry = False
        self._said_bye = False
        self._uses = False
        self._seat_gone = asyncio.Event()

    @property
    def silent_s(self) -> float:
        """Seconds since the last message of the client."""
        return self._setting.clock.now() - self._alive

    def give_way(self) -> None:
        """End the connection because another viewer takes its seat."""
        self._seat_gone.set()

    async def run(self) -> None:
        """Run the whole connection; raises only on cancellation."""
        began = self._setting.measure()
        fault = None
        loops: list[asyncio.Task[None]] = []
        try:
            await self._greet()
            loops = [asyncio.create_task(loop) for loop in (self._listen(), self._talk(), self._leave_seat())]
            done, _ = await asyncio.wait(loops, return_when=asyncio.FIRST_COMPLETED)
            # Do not raise it again: the error would refer to this frame, and so to the task that holds the error.
            ended = next(task.exception() for task in loops if task in done)
            fault = self._judge(ended) if isinstance(ended, Exception) else None
        except Exception as error:
            fault = self._judge(error)
        finally:
            for task in loops:
                task.cancel()
            if self._alarm is not None:
                self._alarm.cancel()
            await asyncio.gather(*loops, return_exceptions=True)
            self._seat = None  # it refers to this object
            if self.session is not None:
                self._served.sessions.discard(self.session)
            if self._uses:
                self._served.leave(self._setting.clock.now())
            self._account(began)
        if self.reason not in ("left", "lost", "ending") or self._said_bye:
            await self._farewell(fault)

    async def _greet(self) -> None:
        """Read HELLO and send WELCOME."""
        limits = self._setting.limits
        clock = self._setting.clock
        try:
            said = await clock.within(self._greet_s, self._first())
        except TimeoutError:
            raise ProtocolError(f"no HELLO within {limits.handshake_s:g} s; closing", FAULTS["late"]) from None
        if not isinstance(said, Hello):
            raise ProtocolError(f"message: expected HELLO first, got {type(said).__name__}")
        self._alive = clock.now()
        if self._seat is not None and (why := self._seat()):
            raise ProtocolError(f"no seat ({why}); try again later", FAULTS["too-many"])
        scene = await self._open()
        self._uses = True
        try:
            self.session = await self._apart(partial(Session.from_hello, scene, said, self._setting.config))
        except ValueError as error:
            raise ProtocolError(f"HELLO: {error}") from error
        self._served.sessions.add(self.session)
        self._alive = self._moved = clock.now()
        await self._peer.send(self.session.welcome(self._setting.measure()).data)
        self._setting.metrics.opened.add(of=self._served.name)
        self._setting.log(
            "opened", client=self.number, scene=self._served.name, held=len(self.session.holdings.received) or None
        )

    async def _open(self) -> StreamedScene:
        """Return the scene, opened in a thread if it is closed."""
        served = self._served
        setting = self._setting
        if served.opened is not None:
            return served.use()
        opening = asyncio.ensure_future(asyncio.to_thread(served.use))
        try:
            scene = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(self._leave_late)
            raise
        setting.metrics.scenes_opened.add(of=served.name)
        setting.log("ready", scene=served.name, gaussians=served.gaussians, client=self.number)
        return scene

    def _leave_late(self, opening: asyncio.Future[StreamedScene]) -> None:
        """Leave a scene that opened after its viewer had gone."""
        if not opening.cancelled() and opening.exception() is None:
            self._served.leave(self._setting.clock.now())

    async def _first(self) -> object:
        """Return the first message that is no TOKEN; one TOKEN may come before it, needed or not."""
        most = self._setting.limits.message_bytes or self._served.most_hello
        said = parse_client(await self._peer.receive(), most_hello=most)
        return parse_client(await self._peer.receive(), most_hello=most) if isinstance(said, Token) else said

    async def _listen(self) -> None:
        """Read messages of the client until it leaves."""
        clock = self._setting.clock
        metrics = self._setting.metrics
        for turn in itertools.count(1):
            if turn % _IN_A_ROW == 0:
                await asyncio.sleep(0)  # `receive` does not let others run while messages wait
            data = await self._peer.receive()
            now = self._alive = clock.now()
            if not self._messages.take(now):
                raise ProtocolError("messages: expected fewer, got a flood", FAULTS["flood"])
            said = parse_client(data, most_hello=LEAST_HELLO)
            metrics.received.add(of=type(said).__name__)
            if isinstance(said, Bye):
                raise _ByeError("left")
            if isinstance(said, Hello | Token):
                name = type(said).__name__.upper()
                raise ProtocolError(f"{name}: expected it at the start, got one after HELLO")
            if isinstance(said, PoseAt) and not self._poses.take(now):
                metrics.skipped.add()
                continue
            if len(self._heard) >= _MOST_HEARD:  # the other loop waits for room in the socket buffer
                self._heard = [entry for entry in self._heard if isinstance(entry[1], Ack)]
                if len(self._heard) >= _MOST_HEARD:
                    raise ProtocolError("ACK: expected one a message, got more", FAULTS["flood"])
            self._heard.append((self._setting.measure(), said))
            if isinstance(said, Ack) or not self._has_pose:
                self._ring()

    async def _leave_seat(self) -> None:
        """End the connection when another viewer takes the seat."""
        await self._seat_gone.wait()
        why = f"silent for {self.silent_s:.0f} s, and another viewer of this address needs the seat; reconnect"
        raise ProtocolError(why, FAULTS["late"])

    async def _talk(self) -> None:
        """Plan and send until the connection ends."""
        while True:
            now = self._setting.measure()
            self._take_in()
            self._look_after()
            if (wait := self._idle_for(now)) > 0.0:
                await self._wait(wait)
                continue
            if self._setting.planners is None:
                pace = self._setting.pace
                session = self._session
                if session.has_to_prepare:
                    await pace.preparations.make(session.prepare, is_new=self._is_new)
                await pace.turns.take(is_new=self._is_new)
                self._take_in()
                if self._idle_for(self._setting.measure()) > 0.0:
                    continue
            self._planned = now
            self._fresh = False
            message, seconds = await self._apart(self._plan)
            self._dry = message is None
            self._setting.metrics.planning.observe(seconds)
            if message is not None:
                await self._peer.send(message.data)
                self._count(message)
                await asyncio.sleep(0)  # let other clients send

    def _idle_for(self, now: float) -> float:
        """Return the seconds until the next batch is due, if nothing happens before; 0 for now."""
        session = self._session
        tick = self._setting.limits.tick_s
        if not self._has_pose or (session.done and not self._fresh):
            return _ROUND
        if self._dry:
            return max(self._planned + tick - now, 0.0)
        session.piece = self._setting.pace.stretched(self._setting.config.piece)  # small batches cost as much
        return 0.0 if session.room() > 0.0 else _ROUND  # an acknowledgement wakes the loop

    def _plan(self) -> tuple[Message | None, float]:
        """Return the next batch and the seconds that planning took; may run in another thread."""
        session = self._session
        began = self._setting.measure()
        budget = min(session.room(), float(self._setting.limits.batch_bytes))
        message = session.next_message(began, budget, sent_at=self._setting.measure)
        return message, self._setting.measure() - began

    def _count(self, message: Message) -> None:
        metrics = self._setting.metrics
        metrics.batches.add()
        metrics.sent_bytes.add(len(message.data))
        metrics.gaussians.add(len(message.batch.gaussians))
        metrics.terms.add(len(message.batch.terms))

    def _take_in(self) -> None:
        """Pass received poses and acknowledgements to the session."""
        heard, self._heard, session = self._heard, [], self._session
        for t, said in heard:
            try:
                if isinstance(said, Ack):
                    before = session.outstanding
                    session.on_ack(t, said.sequence)
                    if session.outstanding < before:
                        self._moved = self._setting.clock.now()
                else:
                    session.on_pose(self._pose_clock.at(t, said.time_ms), self._served.within(said.position), said.quat)
                    self._has_pose = self._fresh = True
            except ValueError as error:
                raise ProtocolError(f"{type(said).__name__}: {error}") from error

    def _look_after(self) -> None:
        """Raise if the client is silent or does not read; set an alarm for the next check."""
        limits = self._setting.limits
        now = self._setting.clock.now()
        if now - self._alive >= limits.idle_s - _SLACK:
            raise ProtocolError(f"no message within {limits.idle_s:g} s; closing", FAULTS["late"])
        if self._session.outstanding == 0:
            self._moved = now
        if now - self._moved >= limits.stall_s - _SLACK:
            raise ProtocolError(f"no ACK within {limits.stall_s:g} s; closing", FAULTS["late"])
        if self._alarm is None:
            due = min(self._alive + limits.idle_s, self._moved + limits.stall_s)
            self._alarm = self._setting.clock.call_later(due - now, self._wake)

    def _wake(self) -> None:
        self._alarm = None
        self._ring()

    async def _apart(self, work: Callable[[], _T]) -> _T:
        executor = self._setting.planners
        return work() if executor is None else await asyncio.get_running_loop().run_in_executor(executor, work)

    async def _wait(self, seconds: float) -> None:
        """Wait until the bell rings, for a limited time."""
        loop = asyncio.get_running_loop()
        self._bell = loop.create_future()
        timer = loop.call_later(seconds, self._ring)
        try:
            await self._bell
        finally:
            timer.cancel()
            self._bell = None

    def _ring(self) -> None:
        if self._bell is not None and not self._bell.done():
            self._bell.set_result(None)

    @property
    def _is_new(self) -> bool:
        """Whether the client has no picture yet."""
        return self._session.wire_bytes < _PICTURE

    @property
    def _session(self) -> Session:
        assert self.session is not None
        return self.session

    def _judge(self, error: Exception) -> ServerFault | None:
        """Log an error and return what to report to the client; None if the client has gone."""
        if isinstance(error, GoneError):
            self.reason = str(error) or "lost"
            self._said_bye = isinstance(error, _ByeError)
            return None
        fault = ServerFault.from_error(error)
        if isinstance(error, ProtocolError):
            self.reason = next((name for name, code in FAULTS.items() if code == error.code), "malformed")
            self._setting.log("refused", logging.WARNING, client=self.number, reason=self.reason, why=str(error))
        elif isinstance(error, FormatError):
            self.reason = "damaged"
            self._served.refuse(str(error))
            self._setting.metrics.faults.add(of=self._served.name)
            self._setting.log("damaged", logging.ERROR, scene=self._served.name, client=self.number, why=str(error))
            return ServerFault(FAULTS["internal"], "the scene is damaged on the server")
        else:
            self.reason = "internal"
            self._setting.log("failed", logging.ERROR, client=self.number, why=f"{type(error).__name__}: {error}")
            logging.getLogger("gsvis.serve").debug("client %d", self.number, exc_info=error)
        return fault

    def _account(self, began: float) -> None:
        if self.session is None:
            self._setting.metrics.refused.add(of=self.reason or "ending")
            return
        self._setting.metrics.closed.add(of=self.reason or "ending")
        self._setting.log(
            "closed",
            client=self.number,
            reason=self.reason or "ending",
            seconds=self._setting.measure() - began,
            sent_bytes=self.session.wire_bytes,
            unacknowledged=self.session.outstanding,
            rate=self.session.rate,
        )

    async def _farewell(self, fault: ServerFault | None) -> None:
        """Send the client the reason and close; cut the connection if it does not read."""
        code = NORMAL if fault is None and self._said_bye else POLICY

        async def say() -> None:
            if fault is not None:
                await self._peer.send(fault.to_bytes())
            await self._peer.close(self.reason, code if fault is None else CLOSE_CODES.get(fault.code, POLICY))

        try:
            await self._setting.clock.within(_FAREWELL, say())
        except (TimeoutError, GoneError) as error:
            if isinstance(error, TimeoutError) or not self._said_bye:  # after BYE a client may close first
                self._peer.abort()
