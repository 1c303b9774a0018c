"""A command as a process that halts at a stage of its work and says so: a test stops it there, not after a time."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

from tests import warm_start

__all__ = ["GUARD", "Halted"]

GUARD = 600.0  # seconds until a hang is a failure; no verdict rests on them

_PROGRAM = """
import os, select, signal, sys
from gsvis.cli import main, terminal

signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs tests in the background ignores it

pipe, stage, least = int(sys.argv[1]), sys.argv[2], int(sys.argv[3])
report, parent = terminal.Status.__call__, os.getppid()
heard, hears = os.pipe()
os.set_blocking(hears, False)
signal.set_wakeup_fd(hears)

def halt(status, name, done, total):
    report(status, name, done, total)
    if name.startswith(stage) and done >= least:
        os.write(pipe, b"!")
        while not select.select([heard], [], [], 1.0)[0]:  # until a signal ends it, or asks it to end after this step
            if os.getppid() != parent:  # a test that was killed leaves nobody behind
                os._exit(1)

terminal.Status.__call__ = halt
sys.exit(main(sys.argv[4:]))
"""


class Halted:
    """`gsvis WORDS` in a session of its own, halted where it reports at least `done` of a stage.

    Args:
        stage: What the stage's name begins with.
        done: How much of it is done.
        words: The command and its arguments.
    """

    def __init__(self, stage: str, done: int, *words: object) -> None:
        self._pipe, theirs = os.pipe()
        self.process = warm_start.Popen(
            [sys.executable, "-c", _PROGRAM, str(theirs), stage, str(done), *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            pass_fds=(theirs,),
            start_new_session=True,
        )
        os.close(theirs)

    @property
    def group(self) -> int:
        """Id of its process group."""
        return self.process.pid

    def wait(self) -> None:
        """Return when it has halted."""
        ready, _, _ = select.select([self._pipe], [], [], GUARD)
        if not ready:
            os.killpg(self.group, signal.SIGKILL)
            raise AssertionError(f"hangs: {self.process.communicate()}")
        if not os.read(self._pipe, 1):
            raise AssertionError(f"ended before it could be stopped: {self.process.communicate()}")

    def end(self, how: signal.Signals, *, group: bool = True) -> tuple[int, str, str]:
        """Send a signal and wait until nobody holds its streams, its children included.

        Args:
            how: The signal.
            group: To all processes of its group, as a terminal does; otherwise to the command alone.

        Returns:
            Its exit code, and what stands on stdout and stderr.
        """
        if group:
            os.killpg(self.group, how)
        else:
            self.process.send_signal(how)
        try:
            out, err = self.process.communicate(timeout=GUARD)
        except subprocess.TimeoutExpired:
            os.killpg(self.group, signal.SIGKILL)
            raise AssertionError(f"hangs: {self.process.communicate()}") from None
        os.close(self._pipe)
        return self.process.returncode, out, err

    def members(self) -> list[str]:
        """Ids of the processes of its group that are alive."""
        found = []
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                state, _, leader = stat.read_text().rpartition(")")[2].split()[:3]
            except OSError:
                continue
            if int(leader) == self.group and state not in "ZX":
                found.append(stat.parent.name)
        return found
