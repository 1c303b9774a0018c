"""The command line: arguments to library calls, status to stderr, results to stdout.

Exit codes: 0 success; 2 wrong input or arguments; 130 interrupted; 141 stdout was closed; 1 any other error, such as a
full disk.
"""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from importlib import import_module
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsvis.cli.arguments import Command

__all__ = ["main"]

_HOMES = {"unpack": "package", "verify": "package"}
"""Modules of commands that have none of their own name."""

_ABOUT = """Ray-traced visibility for trained 3D Gaussian Splatting scenes, on the CPU.

  gsvis inspect scene.ply                    what is in it, what looks wrong
  gsvis analyze scene.ply -o report          visibility report with pictures
  gsvis analyze builtin:two_rooms -o report  the same without a scene at hand
  gsvis render scene.ply -o orbit.gif --orbit 36
  gsvis pvs scene.ply -o scene.pvs           what can be seen from each cell
  gsvis pvs-report scene.pvs scene.ply -o report
  gsvis color scene.ply -o scene.arrow       color that can be sent in pieces
  gsvis train photos -o scene.ply            photographs to a scene
  gsvis levels scene.ply -o levels           smaller levels that share Gaussians
  gsvis clean scene.ply -o clean.ply         without floaters and the unseen
  gsvis convert scene.ply small.spz --min-opacity 0.02
  gsvis convert house.ply garden.ply -o both.html
  gsvis cut scene.ply -o walk.ply --path walk.csv   keep what a walk can see
  gsvis paint scene.ply -o seen.ply --by visibility
  gsvis prepare scene.ply -o scene.gsvis     a package that can be served
  gsvis world a.ply b.ply -o city.gsworld    many packages, out of core
  gsvis verify scene.gsvis                   is a package whole?
  gsvis unpack scene.gsvis -o levels         a package back to PLYs
  gsvis export scene.gsvis -o site           a site for any file server
  gsvis space scene.ply -o walk.glb          where one can walk, as meshes
  gsvis view scene.gsvis                     in the browser; any scene
  gsvis serve scene.gsvis                    to viewers, over WebSockets
  gsvis simulate scene.gsvis --path walk.csv --trace link.csv -o report

gsvis COMMAND --help lists options; gsvis --version prints the version."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments without the program's name; None takes those of the process.

    Returns:
        The exit code.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments or os.environ.get("GSVIS_DEBUG", "") not in ("", "0")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # threads that spin take cores from those that work
    before = _stop_politely()
    try:
        if arguments[:1] == ["--version"]:
            with _stdout():
                sys.stdout.write(f"gsvis {version()}\n")
        else:
            with _stdout():
                command = parse(arguments or ["--help"])
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

    from gsvis.cli.arguments import Command
    from gsvis.cli.spelling import expand_home, misspelling, paths_first

    wrong = misspelling(arguments)
    if wrong is not None:
        raise SystemExit(_exit_with(f"error: {wrong}", 2))
    command: Command = tyro.cli(
        _without_options(Command) if arguments[:1] in (["-h"], ["--help"]) else Command,
        prog="gsvis",
        description=_ABOUT,
        args=_axes_as_values(paths_first(arguments)),
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
    )
    return expand_home(command)


def _without_options(commands: Any) -> Any:
    """Return commands without their options. `gsvis --help` shows none, and tyro then takes half the time."""
    from dataclasses import make_dataclass
    from functools import reduce
    from operator import or_
    from typing import get_args

    bare = (make_dataclass(c.__name__, [], namespace={"__doc__": c.__doc__.split("\n")[0]}) for c in get_args(commands))
    return reduce(or_, bare)


def _axes_as_values(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with a space before the value of --up, so that tyro does not read -y as an option."""
    words: list[str] = []
    for word in arguments:
        option, equals, value = word.partition("=")
        if option == "--up" and equals:
            words += [option, f" {value}"]
        else:
            words.append(f" {word}" if words[-1:] == ["--up"] else word)
    return words


def version() -> str:
    """Return the installed version of gsvis."""
    from importlib.metadata import version as installed

    return installed("gsvis")


def _run(command: Command) -> None:
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", type(command).__name__).lower()
    home = import_module(f"gsvis.cli.{_HOMES.get(name, name)}")
    with _losses_on_stderr(), _dropping(command):
        getattr(home, f"run_{name}")(command)


def _losses_on_stderr() -> AbstractContextManager[None]:
    """Return a context that prints what readers and writers lose, each line once."""
    from gsvis.cli.losses import losses_on_stderr

    return losses_on_stderr()


def _dropping(command: Command) -> AbstractContextManager[None]:
    """Return a context in which readers leave invalid rows out if the command says so."""
    from gsvis.io.invalid import dropping_invalid

    return dropping_invalid(getattr(command, "drop_invalid", False))


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
    sys.stderr.write(f"gsvis: {line}\n")
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
