"""One server as several processes on one port: a supervisor starts them, restarts them, and ends them.

The supervisor binds the port; its children inherit the listening socket and accept from one queue. So a child that is
free takes a new viewer, and a child that dies takes no waiting connection with it (design note 059 compares this with
SO_REUSEPORT). Children are whole commands of their own: nothing is shared but the socket and files. A child ends when
its supervisor has gone. The event loop of a child writes a byte a second into a pipe; the supervisor kills a child that
stops writing.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from gsvis.files.temporary import temporary_folder
from gsvis.serve._log import EventLog

__all__ = ["Child", "Supervisor"]

_VARIABLE = "GSVIS_CHILD"
_LOOK_S = 0.05
_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 30.0
_STEADY_S = 60.0  # a child that lived so long is restarted at once
_STOP_S = 10.0  # seconds that children have to end before they are killed
_HUNG_S = 20.0  # a child that has served and says nothing for so long hangs
_LONGEST_LOOK_S = 1.0  # a look that took longer, as while the machine slept, counts no more against children


@dataclass(frozen=True)
class Child:
    """What a supervisor passes to a child, in its environment.

    Attributes:
        number: Number of the child, from 0.
        listener: Descriptor of the listening socket.
        parent: Descriptor of a pipe that ends when the supervisor does.
        beats: Descriptor of a pipe for signs of life; writing never blocks.
        folder: Folder of the files of the server's processes.
    """

    number: int
    listener: int
    parent: int
    beats: int
    folder: str

    @classmethod
    def from_environment(cls) -> Child | None:
        """Return what the supervisor of this process passed to it; None if there is none.

        Programs that this process starts get nothing.
        """
        text = os.environ.pop(_VARIABLE, None)
        return None if text is None else cls(**json.loads(text))

    def socket(self) -> socket.socket:
        """Return the listening socket."""
        found = socket.socket(fileno=self.listener)
        found.setblocking(False)
        return found

    def watch(self, stop: Callable[[], None]) -> None:
        """Call `stop`, in a thread, when the supervisor has gone."""

        def wait() -> None:
            os.read(self.parent, 1)
            stop()

        threading.Thread(target=wait, name="gsvis-parent", daemon=True).start()

    def say_ready(self) -> None:
        """Tell the supervisor that this child serves."""
        (Path(self.folder) / f"ready-{self.number}").touch()

    def beat(self) -> None:
        """Give the supervisor a sign of life; after the first one, it expects them."""
        with suppress(OSError):  # the pipe is full of them, or the supervisor has gone
            os.write(self.beats, b".")


@dataclass
class _Place:
    """A child that should run, and what is known of its process."""

    number: int
    process: subprocess.Popen[bytes] | None = None
    began: float = 0.0
    due: float = 0.0  # when to start it
    pause: float = field(default=_FIRST_PAUSE_S)
    beats: int | None = None  # our end of the pipe of its signs of life
    silent: float | None = None  # seconds since the last sign of life; None before the first

    def listen(self, elapsed: float) -> float:
        """Read its signs of life; return the seconds since the last one, 0 before the first.

        Args:
            elapsed: Seconds since the last call.
        """
        heard = False
        with suppress(BlockingIOError):
            heard = self.beats is not None and bool(os.read(self.beats, 1 << 16))
        if heard:
            self.silent = 0.0
        elif self.silent is not None:
            self.silent += elapsed
        return self.silent or 0.0

    def forget(self) -> None:
        """Forget a process that has ended."""
        self.process = self.silent = None
        if self.beats is not None:
            os.close(self.beats)
            self.beats = None


class Supervisor:
    """Runs a command several times on one listening socket.

    Args:
        command: The command and its arguments.
        count: Number of processes.
        listener: The listening socket.
        log: Log of events.
        clock: Returns seconds that never decrease.
        hung_s: Seconds without a sign of life after which a child that has served is killed and started again.
    """

    def __init__(
        self,
        command: Sequence[str],
        count: int,
        listener: socket.socket,
        *,
        log: EventLog | None = None,
        clock: Callable[[], float] = time.monotonic,
        hung_s: float = _HUNG_S,
    ) -> None:
        self._command = list(command)
        self._listener = listener
        self._log = log or EventLog()
        self._clock = clock
        self._hung_s = hung_s
        self._places = [_Place(number) for number in range(count)]
        self._stopped = threading.Event()
        self._signal = 0

    @property
    def pids(self) -> list[int]:
        """Process ids of the children that run."""
        return [p.process.pid for p in self._places if p.process is not None and p.process.poll() is None]

    def stop(self, number: int = 0, _: object = None) -> None:
        """End the server; `number` is the signal that asks for it, or 0. May be a handler of signals."""
        self._signal = self._signal or number
        self._stopped.set()

    def run(self, on_ready: Callable[[], None] = lambda: None) -> int:
        """Serve until a signal or `stop`, in the main thread; return the exit status.

        The first child starts alone: what is wrong with the command shows once, and what has to be computed is computed
        once.

        Args:
            on_ready: Called when the first child serves.

        Returns:
            0 after `stop`; -n after signal n; the status of the first child if it ended before it served.
        """
        before = {which: signal.signal(which, self.stop) for which in (signal.SIGTERM, signal.SIGINT)}
        reading, writing = os.pipe()
        with temporary_folder() as folder:
            try:
                status = self._wait_for_first(Path(folder), reading)
                if status is None and not self._stopped.is_set():
                    on_ready()
                    self._keep_running(Path(folder), reading)
                return -self._signal if status is None else status
            finally:
                self._end()
                os.close(reading)
                os.close(writing)
                for which, handler in before.items():
                    signal.signal(which, handler)

    def _wait_for_first(self, folder: Path, reading: int) -> int | None:
        """Start the first child and wait until it serves; return its status if it ends before."""
        first = self._places[0]
        self._start(first, folder, reading)
        assert first.process is not None
        while not self._stopped.wait(_LOOK_S):
            status = first.process.poll()
            if status is not None:
                return status or 1
            if (folder / "ready-0").exists():
                return None
        return None

    def _keep_running(self, folder: Path, reading: int) -> None:
        """Start what should run and kill what hangs, again and again."""
        last = self._clock()
        while not self._stopped.is_set():
            now = self._clock()
            for place in self._places:
                self._kill_if_hung(place, min(now - last, _LONGEST_LOOK_S))
                self._restart_if_ended(place, folder, reading)
            last = now
            self._stopped.wait(_LOOK_S)

    def _kill_if_hung(self, place: _Place, elapsed: float) -> None:
        """Kill a child that gives no sign of life."""
        if place.process is None or place.process.poll() is not None:
            return
        silent = place.listen(elapsed)
        if silent >= self._hung_s:
            self._log("hangs", logging.ERROR, process=place.number, pid=place.process.pid, silent_s=silent)
            place.process.kill()
            place.process.wait()

    def _restart_if_ended(self, place: _Place, folder: Path, reading: int) -> None:
        """Log the end of a child; start it again after a pause that grows while it fails soon."""
        now = self._clock()
        if place.process is not None:
            status = place.process.poll()
            if status is None:
                return
            lived = now - place.began
            place.forget()
            place.pause = _FIRST_PAUSE_S if lived >= _STEADY_S else min(2.0 * place.pause, _LONGEST_PAUSE_S)
            place.due = now + (0.0 if lived >= _STEADY_S else place.pause / 2.0)
            self._log(
                "died", logging.ERROR, process=place.number, status=status, lived_s=lived, again_in_s=place.due - now
            )
        if now >= place.due:
            self._start(place, folder, reading)

    def _start(self, place: _Place, folder: Path, reading: int) -> None:
        """Start a child, with the pipe of its signs of life."""
        place.beats, writing = os.pipe()
        os.set_blocking(place.beats, False)
        os.set_blocking(writing, False)
        child = Child(place.number, self._listener.fileno(), reading, writing, str(folder))
        try:
            place.process = subprocess.Popen(
                self._command,
                env={**os.environ, _VARIABLE: json.dumps(asdict(child))},
                pass_fds=(self._listener.fileno(), reading, writing),
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C reaches only this process, which passes it on
            )
        finally:
            os.close(writing)
        place.began = self._clock()

    def _end(self) -> None:
        """End all children: first by SIGTERM, then by force."""
        running = [place.process for place in self._places if place.process is not None]
        for process in running:
            if process.poll() is None:
                process.terminate()
        end = self._clock() + _STOP_S
        for process in running:
            while process.poll() is None:
                if self._clock() > end:
                    self._log("killed", logging.ERROR, pid=process.pid, why=f"does not end within {_STOP_S:g} s")
                    process.kill()
                    process.wait()
                    break
                time.sleep(_LOOK_S)
        for place in self._places:
            place.forget()
