"""The command line: arguments to library calls, status to stderr, results to stdout.

Exit codes: 0 success; 2 wrong input or arguments; 130 interrupted; 141 stdout was closed; 1 any other error, such as a
full disk.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from importlib import import_module
from types import FrameType
from typing import TYPE_CHECKING, Any

from gsvis._text import as_line
from gsvis.cli.fetched import fetched
from gsvis.cli.help import overview
from gsvis.cli.streams import safe_streams

if TYPE_CHECKING:
    from gsvis.cli.arguments import Command

__all__ = ["main"]

_HOMES = {"unpack": "package", "verify": "package"}
"""Modules of commands that have none of their own name."""

_WAITING = {"OMP_WAIT_POLICY": "passive", "OPENBLAS_THREAD_TIMEOUT": "4"}
"""What lets threads of OpenMP and OpenBLAS sleep while they wait: those that spin take cores from those that work."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments without the program's name; None takes those of the process.

    Returns:
        The exit code.
    """
    with safe_streams():
        return _main(list(sys.argv[1:] if argv is None else argv))


def _main(arguments: list[str]) -> int:
    """Run one command with standard streams that are safe to write to; return the exit code."""
    debug = "--debug" in arguments or os.environ.get("GSVIS_DEBUG", "") not in ("", "0")
    for name, value in _WAITING.items():
        os.environ.setdefault(name, value)
    before = _stop_politely()
    try:
        if arguments[:1] == ["--version"]:
            with _stdout():
                sys.stdout.write(f"gsvis {version()}\n")
        elif not arguments or arguments[0] in ("-h", "--help", "--help-all"):
            with _stdout():
                sys.stdout.write(overview())
        else:
            with _stdout():
                command = parse(arguments)
            _remove_abandoned()
            _run(command)
        with _stdout():
            sys.stdout.flush()
    except SystemExit as done:  # from tyro, which has printed its message
        return done.code if isinstance(done.code, int) else 2
    except KeyboardInterrupt as stopped:
        return _exit_with(f"interrupted; {str(stopped) or 'nothing was left half-written'}", 130)
    except BrokenPipeError:
        # The reader of stdout has gone. Python would report it again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        _drop_stdout_if_full(error)
        if debug:
            raise
        return _exit_with(*_explain(error))
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)
    return 0


def parse(arguments: Sequence[str]) -> Command:
    """Parse arguments into a command.

    Raises:
        SystemExit: After help (0), or after wrong arguments (2); the message is on stderr.
    """
    import tyro

    from gsvis.cli.help import ALL, find_command
    from gsvis.cli.options import leaves
    from gsvis.cli.paper import expand
    from gsvis.cli.spelling import axes_as_values, expand_home, misspelling, paths_first

    wrong = misspelling(arguments)
    if wrong is not None:
        raise SystemExit(_exit_with(f"error: {wrong}", 2))
    kind = find_command(arguments[0])
    assert kind is not None, "misspelling has refused unknown commands"
    if {"-h", "--help", ALL} & set(arguments[1:]):
        _print_help(kind, arguments[0], every=ALL in arguments)
    options = [leaf.option for leaf in leaves(kind)]
    name, *words = axes_as_values(paths_first(expand(arguments, options)))
    command: Command = tyro.cli(kind, prog=f"gsvis {name}", args=words, config=_style())
    return expand_home(command)


def _style() -> tuple[Any, ...]:
    """Return the settings of `tyro` for all commands."""
    from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes

    return FlagCreatePairsOff, OmitArgPrefixes


def _print_help(kind: type, name: str, *, every: bool) -> None:
    """Print the options of a command, all or those that matter first, and how to see the others.

    Raises:
        SystemExit: Always, with the exit code 0.
    """
    import tyro

    from gsvis.cli.help import ALL, long_help, short_help

    shown, others = (long_help(kind), 0) if every else short_help(kind)
    try:
        tyro.cli(shown, prog=f"gsvis {name}", args=["--help"], config=_style())
    finally:
        if others:
            sys.stdout.write(f"{others} more {'option' if others == 1 else 'options'}: gsvis {name} {ALL}\n")


def version() -> str:
    """Return the installed version of gsvis."""
    from importlib.metadata import version as installed

    return installed("gsvis")


def _remove_abandoned() -> None:
    """Remove what killed commands have left among temporary files."""
    from gsvis.files.temporary import remove_abandoned

    remove_abandoned()


def _run(command: Command) -> None:
    """Run a parsed command by the function of its module."""
    from gsvis.cli.options import command_name

    name = command_name(type(command)).replace("-", "_")
    home = import_module(f"gsvis.cli.{_HOMES.get(name, name)}")
    with _losses_on_stderr(), _dropping(command), fetched(command) as ready:
        getattr(home, f"run_{name}")(ready)


def _losses_on_stderr() -> AbstractContextManager[None]:
    """Return a context that prints what readers and writers lose, each line once."""
    from gsvis.cli.losses import losses_on_stderr

    return losses_on_stderr()


def _dropping(command: Command) -> AbstractContextManager[None]:
    """Return a context in which readers leave invalid rows out if the command says so."""
    from gsvis.io.invalid import dropping_invalid

    return dropping_invalid(getattr(command.output, "drop_invalid", False))


def _explain(error: Exception) -> tuple[str, int]:
    """Return one line for the user, and the exit code."""
    from gsvis.errors import GsvisError, OutputError

    text = " ".join(str(error).split())
    if isinstance(error, OutputError):
        return f"error: {text}", 1
    if isinstance(error, FileNotFoundError) and error.filename is not None:
        return f"error: {os.fsdecode(error.filename)}: no such file or folder", 2
    if isinstance(error, OSError) and error.filename is not None:
        reason = error.strerror or text
        return f"error: {os.fsdecode(error.filename)}: {reason[:1].lower()}{reason[1:]}", 2
    if isinstance(error, GsvisError | ValueError | OSError):
        return f"error: {text}", 2
    if isinstance(error, MemoryError):
        return "error: out of memory; try a coarser --lod, a --crop with gsvis convert, or fewer pixels", 1
    return f"internal error: {type(error).__name__}: {text}; please report it with what --debug shows", 1


def _stdout() -> AbstractContextManager[None]:
    """Return a context that raises OutputError if standard output cannot be written, as on a full disk."""
    from gsvis.cli.terminal import check_stdout

    return check_stdout()


def _drop_stdout_if_full(error: Exception) -> None:
    """Discard the rest of standard output after it failed: Python would fail again when it flushes at exit."""
    from gsvis.cli.terminal import STDOUT
    from gsvis.errors import OutputError

    if isinstance(error, OutputError) and error.path == STDOUT:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _exit_with(line: str, code: int) -> int:
    """Print a line of status; return the exit code."""
    sys.stderr.write(f"gsvis: {as_line(line)}\n")
    return code


def _stop_politely() -> signal._HANDLER:
    """Let SIGTERM stop the work as Ctrl-C does, so that half-written files are removed; return the old handler."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    try:
        return signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not in the main thread: leave signals alone
        return None


def __dir__() -> list[str]:
    return sorted(__all__)
