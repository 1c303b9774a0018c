"""End a process whose event loop stands still, so that whoever started the process can start it again.

A server of several processes has a supervisor for this (`processes`). A server of one process watches itself, in a
thread. The thread needs Python's lock: code that holds the lock and never ends is seen by a supervisor only.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from gsvis.serve._log import EventLog

__all__ = ["HUNG_S", "HangWatch"]

HUNG_S = 60.0
"""Seconds after which the event loop of a server counts as hanging; no honest work takes so long."""

_LOOK_S = 1.0
_LONGEST_LOOK_S = 2.0  # a look that took longer, as while the machine slept, counts no more
_MOST_CALLS = 6  # innermost calls that the log names
_STATUS = 1


def _end_process() -> None:
    os._exit(_STATUS)


class HangWatch:
    """Watch the event loop of the thread that makes this object, in a `with` block.

    Args:
        log: Log of events.
        hung_s: Seconds without a beat after which the process ends; counted from the first beat on.
        clock: Returns seconds that never decrease.
        end: Ends the process.
    """

    def __init__(
        self,
        log: EventLog,
        hung_s: float = HUNG_S,
        *,
        clock: Callable[[], float] = time.monotonic,
        end: Callable[[], object] = _end_process,
    ) -> None:
        self._log = log
        self._hung_s = hung_s
        self._clock = clock
        self._end = end
        self._thread = threading.get_ident()
        self._silent: float | None = None  # seconds since the last beat; None before the first
        self._last = clock()
        self._stopped = threading.Event()

    def __enter__(self) -> HangWatch:
        threading.Thread(target=self._keep_looking, name="gsvis-hang", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopped.set()

    def beat(self) -> None:
        """Note that the event loop turns."""
        self._silent = 0.0

    def look(self) -> bool:
        """Count the time since the last look; log the stack and end the process if the loop hangs.

        Returns:
            Whether the loop hangs.
        """
        now = self._clock()
        elapsed = min(now - self._last, _LONGEST_LOOK_S)
        self._last = now
        if self._silent is None:
            return False
        self._silent += elapsed
        if self._silent < self._hung_s:
            return False
        self._log("hangs", logging.ERROR, pid=os.getpid(), silent_s=self._silent, stack=_stack_of(self._thread))
        self._end()
        return True

    def _keep_looking(self) -> None:
        """Look once a second until the loop hangs or the block ends."""
        while not self._stopped.wait(_LOOK_S):
            if self.look():
                return


def _stack_of(thread: int) -> str:
    """Return the innermost calls of a thread, the innermost first."""
    frame = sys._current_frames().get(thread)
    if frame is None:
        return "the thread has ended"
    calls = traceback.extract_stack(frame)[: -_MOST_CALLS - 1 : -1]
    return " < ".join(f"{Path(call.filename).name}:{call.lineno} {call.name}" for call in calls)
