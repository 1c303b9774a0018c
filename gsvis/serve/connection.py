"""One client of the server: two loops over its socket around one `Session`, which decides what to send.

One loop receives into a `Mailbox`; the other empties it, plans and sends. So no two tasks use a session at once. Memory
is bounded whatever a client does: the allowance of the session limits the bytes in flight, and the mailbox has a limit.
Deadlines use the clock of the server (`Watchdog`); link measurements and the pace of batches use real time. Seconds,
bytes of messages.
"""

from __future__ import annotations

import asyncio
import enum
import itertools
import logging
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple, Protocol, TypeVar

from gsvis.abr.config import AbrConfig
from gsvis.errors import FormatError, ProtocolError
from gsvis.serve._log import EventLog
from gsvis.serve.clock import Clock
from gsvis.serve.limits import Limits, Pace
from gsvis.serve.mailbox import Mailbox
from gsvis.serve.metrics import Metrics
from gsvis.serve.scenes import ServedScene
from gsvis.serve.watchdog import Watchdog
from gsvis.stream import Ack, Bye, Hello, Message, PoseAt, Session, StreamedScene, Token, parse_client
from gsvis.stream.wire import CLOSE_CODES, FAULTS, LEAST_HELLO, NORMAL, POLICY, ServerFault

__all__ = ["Connection", "GoneError", "Peer", "Setting"]

_IN_A_ROW = 16  # messages of a client that are taken before others run
_ROUND = 1.0  # seconds after which a client is checked even if nothing happens
_FAREWELL = 1.0  # most seconds to send the last message
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


class _View(enum.Enum):
    """What a connection knows of the view of its client."""

    UNKNOWN = "no pose has come"
    NEW = "a pose has come since the last plan"
    PLANNED = "the last plan was for the last pose"


class _Ending(NamedTuple):
    """How a connection has ended.

    Attributes:
        reason: Why; "" while it goes on.
        fault: What to report to the client; None for nothing.
        said_bye: Whether the client has said BYE, and its socket is still open.
    """

    reason: str = ""
    fault: ServerFault | None = None
    said_bye: bool = False

    @property
    def close_code(self) -> int:
        """The code of WebSockets with which the connection is closed."""
        if self.fault is not None:
            return CLOSE_CODES.get(self.fault.code, POLICY)
        return NORMAL if self.said_bye else POLICY


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
        number: Number of the client in the log.
        session: The session; None before HELLO.
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
        self._mailbox = Mailbox(setting.limits)
        self._watchdog = Watchdog(setting.limits, setting.clock, self._mailbox.ring)
        self._view = _View.UNKNOWN
        self._again: float | None = None  # when to plan again after a plan that found nothing to send
        self._seat_gone = asyncio.Event()
        self._ending = _Ending()

    @property
    def reason(self) -> str:
        """Why the connection ended: "left", "lost", or a limit or fault; "" while it goes on."""
        return self._ending.reason

    @property
    def silent_s(self) -> float:
        """Seconds since the last message of the client."""
        return self._watchdog.silent_s

    def give_way(self) -> None:
        """End the connection because another viewer takes its seat."""
        self._seat_gone.set()

    async def run(self) -> None:
        """Run the whole connection; raises only on cancellation."""
        began = self._setting.measure()
        try:
            hello = await self._read_hello()
            scene = await self._open()
            try:
                await self._stream(scene, hello)
            finally:
                self._served.leave(self._setting.clock.now())
        except Exception as error:
            self._ending = self._judge(error)
        finally:
            self._seat = None  # it refers to this object
            self._account(began)
        if self.reason not in ("left", "lost", "ending") or self._ending.said_bye:
            await self._farewell()

    async def _read_hello(self) -> Hello:
        """Read HELLO, and take a seat."""
        limits = self._setting.limits
        try:
            said = await self._setting.clock.within(self._greet_s, self._read_first_message())
        except TimeoutError:
            raise ProtocolError(f"no HELLO within {limits.handshake_s:g} s; closing", FAULTS["late"]) from None
        if not isinstance(said, Hello):
            raise ProtocolError(f"message: expected HELLO first, got {type(said).__name__}")
        self._watchdog.hear()
        if self._seat is not None and (why := self._seat()):
            raise ProtocolError(f"no seat ({why}); try again later", FAULTS["too-many"])
        return said

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
        setting.metrics.scenes.opened.add(of=served.name)
        setting.log("ready", scene=served.name, gaussians=served.gaussians, client=self.number)
        return scene

    def _leave_late(self, opening: asyncio.Future[StreamedScene]) -> None:
        """Leave a scene that opened after its viewer had gone."""
        if not opening.cancelled() and opening.exception() is None:
            self._served.leave(self._setting.clock.now())

    async def _stream(self, scene: StreamedScene, hello: Hello) -> None:
        """Answer HELLO and stream until the connection ends."""
        try:
            self.session = await self._in_planner_thread(
                partial(Session.from_hello, scene, hello, self._setting.config)
            )
        except ValueError as error:
            raise ProtocolError(f"HELLO: {error}") from error
        self._served.sessions.add(self.session)
        loops: list[asyncio.Task[None]] = []
        try:
            await self._welcome(self.session)
            loops = [asyncio.create_task(loop) for loop in (self._listen(), self._talk(), self._leave_seat())]
            done, _ = await asyncio.wait(loops, return_when=asyncio.FIRST_COMPLETED)
            # Do not raise it again: the error would refer to this frame, and so to the task that holds the error.
            ended = next(task.exception() for task in loops if task in done)
            if isinstance(ended, Exception):
                self._ending = self._judge(ended)
        finally:
            for task in loops:
                task.cancel()
            self._watchdog.stop()
            await asyncio.gather(*loops, return_exceptions=True)
            self._served.sessions.discard(self.session)

    async def _welcome(self, session: Session) -> None:
        """Send WELCOME; deadlines count from here."""
        self._watchdog.hear()
        self._watchdog.progress()
        await self._peer.send(session.welcome(self._setting.measure()).data)
        self._setting.metrics.opened.add(of=self._served.name)
        held = len(session.holdings.received) or None
        self._setting.log("opened", client=self.number, scene=self._served.name, held=held)

    async def _read_first_message(self) -> object:
        """Return the first message that is no TOKEN; one TOKEN may come before it, needed or not."""
        most = self._setting.limits.message_bytes or self._served.most_hello
        said = parse_client(await self._peer.receive(), most_hello=most)
        return parse_client(await self._peer.receive(), most_hello=most) if isinstance(said, Token) else said

    async def _listen(self) -> None:
        """Read messages of the client until it leaves."""
        metrics = self._setting.metrics
        for turn in itertools.count(1):
            if turn % _IN_A_ROW == 0:
                await asyncio.sleep(0)  # `receive` does not let others run while messages wait
            data = await self._peer.receive()
            now = self._watchdog.hear()
            self._mailbox.admit(now)
            said = parse_client(data, most_hello=LEAST_HELLO)
            metrics.received.add(of=type(said).__name__)
            if isinstance(said, Bye):
                raise _ByeError("left")
            if isinstance(said, Hello | Token):
                name = type(said).__name__.upper()
                raise ProtocolError(f"{name}: expected it at the start, got one after HELLO")
            if not self._mailbox.put(said, now, self._setting.measure()):
                metrics.skipped.add()
            elif isinstance(said, Ack) or self._view is _View.UNKNOWN:
                self._mailbox.ring()

    async def _leave_seat(self) -> None:
        """End the connection when another viewer takes the seat."""
        await self._seat_gone.wait()
        why = f"silent for {self.silent_s:.0f} s, and another viewer of this address needs the seat; reconnect"
        raise ProtocolError(why, FAULTS["late"])

    async def _talk(self) -> None:
        """Plan and send until the connection ends."""
        while True:
            now = self._setting.measure()
            self._use_messages()
            self._watchdog.check(self._session.outstanding)
            if (wait := self._time_to_wait(now)) > 0.0:
                await self._mailbox.wait(wait)
                continue
            if self._setting.planners is None:
                await self._take_turn()
                self._use_messages()
                if self._time_to_wait(self._setting.measure()) > 0.0:
                    continue
            self._view = _View.PLANNED
            message, seconds = await self._in_planner_thread(self._plan)
            self._again = now + self._setting.limits.tick_s if message is None else None
            self._setting.metrics.planning.observe(seconds)
            if message is not None:
                await self._peer.send(message.data)
                self._count(message)
                await asyncio.sleep(0)  # let other clients send

    async def _take_turn(self) -> None:
        """Wait for what planning needs, and for the turn of this client."""
        pace = self._setting.pace
        session = self._session
        if session.has_to_prepare:
            await pace.preparations.make(session.prepare, is_new=self._is_new)
        await pace.turns.take(is_new=self._is_new)

    def _time_to_wait(self, now: float) -> float:
        """Return the seconds until the next batch is due, if nothing happens before; 0 for now."""
        session = self._session
        if self._view is _View.UNKNOWN or (session.done and self._view is _View.PLANNED):
            return _ROUND
        if self._again is not None:
            return max(self._again - now, 0.0)
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
        """Count a message that was sent."""
        metrics = self._setting.metrics
        metrics.sent.batches.add()
        metrics.sent.bytes.add(len(message.data))
        metrics.sent.gaussians.add(len(message.batch.gaussians))
        metrics.sent.terms.add(len(message.batch.terms))

    def _use_messages(self) -> None:
        """Pass received poses and acknowledgements to the session."""
        for arrived, said in self._mailbox.take():
            try:
                if isinstance(said, Ack):
                    self._use_ack(arrived, said)
                else:
                    self._use_pose(arrived, said)
            except ValueError as error:
                raise ProtocolError(f"{type(said).__name__}: {error}") from error

    def _use_ack(self, arrived: float, ack: Ack) -> None:
        """Pass an acknowledgement to the session."""
        session = self._session
        before = session.outstanding
        session.on_ack(arrived, ack.sequence)
        if session.outstanding < before:
            self._watchdog.progress()

    def _use_pose(self, arrived: float, pose: PoseAt) -> None:
        """Pass a pose to the session."""
        t = self._mailbox.clock.at(arrived, pose.time_ms)
        self._session.on_pose(t, self._served.within(pose.position), pose.quat)
        self._view = _View.NEW

    async def _in_planner_thread(self, work: Callable[[], _T]) -> _T:
        """Run work of the session in a thread for planning, or here if there is none."""
        executor = self._setting.planners
        return work() if executor is None else await asyncio.get_running_loop().run_in_executor(executor, work)

    @property
    def _is_new(self) -> bool:
        """Whether the client has no picture yet."""
        return self._session.wire_bytes < _PICTURE

    @property
    def _session(self) -> Session:
        """The session, after HELLO."""
        assert self.session is not None
        return self.session

    def _judge(self, error: Exception) -> _Ending:
        """Log an error; return how it ends the connection."""
        if isinstance(error, GoneError):
            return _Ending(str(error) or "lost", said_bye=isinstance(error, _ByeError))
        log = self._setting.log
        if isinstance(error, ProtocolError):
            reason = next((name for name, code in FAULTS.items() if code == error.code), "malformed")
            log("refused", logging.WARNING, client=self.number, reason=reason, why=str(error))
            return _Ending(reason, ServerFault.from_error(error))
        if isinstance(error, FormatError):
            self._served.refuse(str(error))
            self._setting.metrics.scenes.faults.add(of=self._served.name)
            log("damaged", logging.ERROR, scene=self._served.name, client=self.number, why=str(error))
            return _Ending("damaged", ServerFault(FAULTS["internal"], "the scene is damaged on the server"))
        log("failed", logging.ERROR, client=self.number, why=f"{type(error).__name__}: {error}")
        logging.getLogger("gsvis.serve").debug("client %d", self.number, exc_info=error)
        return _Ending("internal", ServerFault.from_error(error))

    def _account(self, began: float) -> None:
        """Count and log the end of the connection."""
        reason = self.reason or "ending"
        if self.session is None:
            self._setting.metrics.refused.add(of=reason)
            return
        self._setting.metrics.closed.add(of=reason)
        self._setting.log(
            "closed",
            client=self.number,
            reason=reason,
            seconds=self._setting.measure() - began,
            sent_bytes=self.session.wire_bytes,
            unacknowledged=self.session.outstanding,
            rate=self.session.rate,
        )

    async def _farewell(self) -> None:
        """Send the client the reason and close; cut the connection if the client does not read."""
        ending = self._ending

        async def say() -> None:
            if ending.fault is not None:
                await self._peer.send(ending.fault.to_bytes())
            await self._peer.close(ending.reason, ending.close_code)

        try:
            await self._setting.clock.within(_FAREWELL, say())
        except (TimeoutError, GoneError) as error:
            if isinstance(error, TimeoutError) or not ending.said_bye:  # after BYE a client may close first
                self._peer.abort()
