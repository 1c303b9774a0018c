"""Terminal output: progress on stderr, tables or one JSON document on stdout."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sys
import textwrap
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Any

from gsvis._text import as_json, as_line, as_text
from gsvis.errors import OutputError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID
    from rich.table import Table

__all__ = [
    "STDOUT",
    "Status",
    "busy_note",
    "check_stdout",
    "clock",
    "facts",
    "least_size_of",
    "print_json",
    "say",
    "show",
    "size_of",
]

STDOUT = "standard output"
"""Path of standard output in an OutputError."""

_SAID = {
    "fetching": "fetching the scene",
    "reading": "reading the scene",
    "space": "finding navigable space",
    "kernels": "preparing kernels",
    "air": "finding the air",
    "guard": "drawing held-out views",
    "structure": "building the tracing structure",
    "cameras": "tracing cameras",
    "directions": "tracing directions outward",
    "angles": "measuring solid angles",
    "pictures": "rendering pictures",
    "rendering": "rendering",
    "writing": "writing",
    "start": "choosing views to begin with",
    "viewpoints": "looking from viewpoints",
    "cells": "finding and certifying sets",
    "check": "tracing some rays a second time",
    "store": "writing the store",
    "join": "packing visible sets",
    "trying": "trying a few cells",
    "trying tiles": "trying a few tiles",
    "quality": "measuring the sets",
    "importance": "weighing Gaussians in views",
    "price": "sharing out terms",
    "fit": "fitting terms",
    "learn": "learning colors",
    "records": "rounding to records",
    "epsilon": "finding epsilon",
    "terms": "finding active terms of cells",
    "colors": "comparing with SH",
    "photos": "reading photographs",
    "views": "rendering views",
    "prune": "choosing what stays",
    "train": "training",
    "measure": "measuring",
    "order": "putting the scene in order",
    "rounding": "choosing how to round records",
    "cost": "measuring what rounding costs",
    "fidelity": "measuring what a client gets",
    "judge": "checking the sets by other eyes",
    "package": "writing the package",
    "sets": "writing what cells see",
    "errors": "measuring errors of levels",
    "export": "writing the export",
    "certificate": "certifying by rays",
    "held_out": "drawing views before and after",
    "light": "measuring the light from inside",
    "opening": "finding what covers the space",
    "fill": "counting splats over pixels",
    "removal": "weighing what could go",
}
_clock = time.perf_counter  # tests replace it
_SIZES = ("GB", 10**9), ("MB", 10**6), ("kB", 10**3)
_EVERY = 10.0  # seconds between plain lines of one stage
_QUIET = 2.0  # seconds before plain lines name stages, so that quick commands print none


class Status(AbstractContextManager["Status"]):
    """A progress callback for the library: bars with an ETA on a terminal, else a plain line now and then.

    Call it as `status(stage, done, total)`. A stage with total 1 has no bar, only its time. A stage that starts above 0
    resumes an earlier run. `seconds` holds the time of each finished stage.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._starts: dict[str, tuple[float, int]] = {}  # start time, and steps done before it
        self._began = self._spoke = _clock()
        self._tasks: dict[str, TaskID] = {}
        self._notes: dict[str, tuple[str, str]] = {}
        self._bars: Progress | None = _bars() if sys.stderr.isatty() else None

    def __enter__(self) -> Status:
        if self._bars:
            self._bars.start()
        return self

    def __exit__(self, *reason: object) -> None:
        if self._bars:
            self._bars.stop()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show the progress of a stage (gsvis.progress.Progress)."""
        now = _clock()
        first = stage not in self._starts or (done == 0 and stage in self.seconds)  # started, or started again
        if first:
            self._starts[stage] = now, done
        began, before = self._starts[stage]
        elapsed = now - began
        left = elapsed / (done - before) * (total - done) if done > before else None
        if done >= total and not first:
            self.seconds[stage] = round(elapsed, 3)
        said = _SAID.get(stage, stage)
        if self._bars:
            if stage not in self._tasks:
                self._tasks[stage] = self._bars.add_task(said, total=total if total > 1 else None)
            ends = None if left is None else now + left
            said = self._notes.get(stage, (said, ""))[0]
            total_ = total if total > 1 or done else None
            self._bars.update(self._tasks[stage], description=said, completed=done, total=total_, ends=ends)
        elif first:
            if now - self._began >= _QUIET:
                self._say(said)
        elif done >= total:
            if elapsed >= _EVERY:
                self._say(f"{said}: done in {clock(elapsed)}")
        elif left is not None and now - self._spoke >= _EVERY:
            note = self._notes.get(stage, ("", ""))[1]
            self._say(f"{said}: {done:,} of {total:,}, about {clock(left)} left{'; ' if note else ''}{note}")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Show a stage of one step while this block runs."""
        self(name, 0, 1)
        yield
        self(name, 1, 1)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Show no bars in this block, as while a question is asked."""
        if self._bars:
            self._bars.stop()
        try:
            yield
        finally:
            if self._bars:
                self._bars.start()

    def note(self, stage: str, brief: str, whole: str) -> None:
        """Set the text of a stage: `brief` replaces its name on a bar, `whole` is added to its plain lines."""
        self._notes[stage] = as_line(brief), whole

    def line(self, text: str) -> None:
        """Print a line that stays on the screen."""
        if self._bars:
            self._bars.console.print(as_line(text), markup=False, highlight=False)
        else:
            self._say(text)

    def _say(self, line: str) -> None:
        """Print a line of status, and remember when."""
        self._spoke = _clock()
        say(line)


def _bars() -> Progress:
    """Return the display of bars."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
    from rich.text import Text

    class Clock(ProgressColumn):
        """The time taken of a finished stage, else the time left."""

        def render(self, task: Task) -> Text:
            if task.finished or task.total is None:
                return Text(clock(task.finished_time or task.elapsed or 0.0), style="dim")
            ends = task.fields.get("ends")
            return Text("" if ends is None else f"{clock(max(0.0, ends - _clock()))} left", style="cyan")

    class Count(ProgressColumn):
        """The count of steps and their total; empty for a stage of one step."""

        def render(self, task: Task) -> Text:
            counted = task.total is not None and task.total > 1
            return Text(f"{int(task.completed):,}/{int(task.total or 0):,}" if counted else "", style="dim")

    return Progress(
        TextColumn("{task.description:<31}", markup=False),
        BarColumn(bar_width=20),
        Count(),
        Clock(),
        console=Console(stderr=True, markup=False, emoji=False),
    )


def clock(seconds: float) -> str:
    """Return seconds as text: 45 -> '45 s', 125 -> '2 min 05 s'; below 10 s with one decimal."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole} s" if whole < 60 else f"{whole // 60} min {whole % 60:02d} s"


def size_of(count: int) -> str:
    """Return bytes as text: 1500000 -> '1.5 MB'."""
    for unit, size in _SIZES:
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} bytes"


def least_size_of(count: int) -> str:
    """Return bytes as text, rounded up: a limit of that suffices. 1510000 -> '1.6 MB'."""
    digit = next((size // 10 for _, size in _SIZES if count >= size), 1)
    return size_of(-(-count // digit) * digit)


@contextmanager
def check_stdout() -> Iterator[None]:
    """Raise OutputError if standard output cannot be written, as on a full disk."""
    try:
        yield
    except BrokenPipeError:  # the reader has gone
        raise
    except OSError as error:
        raise OutputError(STDOUT, error.errno or errno.EIO) from error


def say(line: str) -> None:
    """Print one line of status on stderr, which is looked up each time, because progress bars replace it."""
    sys.stderr.write(f"gsvis: {as_line(line)}\n")
    sys.stderr.flush()


def print_json(document: dict[str, Any]) -> None:
    """Print one JSON document on stdout; raise ValueError for NaN and infinity, which JSON does not have."""
    unicode = (sys.stdout.encoding or "").lower().replace("-", "").startswith("utf")
    text = as_json(document, indent=2) if unicode else json.dumps(document, indent=2, allow_nan=False)
    with check_stdout():
        sys.stdout.write(f"{text}\n")


def facts(title: str, rows: Iterable[Sequence[str]], header: Sequence[str] = ("", "")) -> Table:
    """Return a table whose first column names the row."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    title = as_line(title)
    named = any(header)
    table = Table(title=title or None, title_justify="left", title_style="bold", box=SIMPLE_HEAD, show_header=named)
    for column, name in enumerate(header):
        table.add_column(
            name, style="" if column else "dim", no_wrap=not column, justify="right" if named and column else "left"
        )
    for row in rows:
        table.add_row(*map(as_line, row))
    return table


def show(*parts: Table | str) -> None:
    """Print tables and lines on stdout, in at most 80 columns, in color only on a terminal."""
    from rich.console import Console

    width = min(80, shutil.get_terminal_size().columns) if sys.stdout.isatty() else 80
    console = Console(width=width, highlight=False, markup=False, emoji=False)  # names are no markup
    with check_stdout(), console.capture() as held:  # a capture still flushes stdout
        for part in parts:
            if isinstance(part, str):
                part = as_text(part)
                indent = " " * (3 if part.startswith(" - ") else 1)
                part = textwrap.fill(
                    part,
                    console.width - 1,
                    subsequent_indent=indent,
                    break_long_words=False,
                    break_on_hyphens=False,
                )
            console.print(part, markup=False, soft_wrap=isinstance(part, str))
    with check_stdout():
        sys.stdout.write("\n".join(line.rstrip() for line in held.get().splitlines()) + "\n")


def busy_note(load: float | None) -> str:
    """Return what to say beside an estimated time if the machine was busy when it was made; empty if it was not."""
    cores = os.cpu_count() or 1
    return "" if load is None or load < 0.5 * cores else f"; the machine is busy (load {load:.1f} on {cores} cores)"
