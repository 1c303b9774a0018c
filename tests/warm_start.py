"""Processes of `gsvis` that start warm: forked from one that has imported what commands need and started no thread.

To import it anew takes over a second of the processor, many times what most commands of tests do. `Popen` and `run` are
those of `subprocess`, and the process is a child of the test, with its own words, environment, folder, streams, session
and exit code. How it starts cold, as for users, is tested by `tests/cli/test_process.py`, `test_consoles.py` and
`test_closed_streams.py`. Other programs, other environments and other systems start as they always do.
"""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import gc
import inspect
import json
import os
import runpy
import socket
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

__all__ = ["Popen", "run"]

_ROOT = Path(__file__).parents[1]
_BEGAN = {**os.environ, "OPENBLAS_THREAD_TIMEOUT": "4"}  # `gsvis` sets that one before it imports anything large
_FREE = {"BROWSER", "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED", "GSVIS_CHILD", "GSVIS_DEBUG", "GSVIS_TOKEN"}
_FREE |= {"OPENBLAS_THREAD_TIMEOUT", "PYTEST_CURRENT_TEST", "PYTHONWARNINGS", "TCM_ENABLE", "TERM", "TMPDIR"}
_FREE |= {"TORCHINDUCTOR_CACHE_DIR"}  # torch sets it, in a worker that has trained
"""Variables that may differ from those of the warm process: nothing keeps what they say while it imports."""

_ADOPT = 36  # PR_SET_CHILD_SUBREAPER: processes whose parent ends become children of this one
_HIGH = 500  # descriptors wait from here on until they get their numbers
_LONGEST = 1 << 18  # bytes of a request
_execute = getattr(subprocess.Popen, "_execute_child")  # noqa: B009
_lock = threading.Lock()


class Popen(subprocess.Popen[Any]):
    """A process as of `subprocess.Popen`, warm if its words are those of Python, with a module or a program."""

    def _execute_child(self, *arguments: Any) -> None:
        named = inspect.signature(_execute).bind(self, *arguments).arguments
        if not _can_be_warm(named):
            _execute(self, *arguments)
            return
        with _lock:
            self.pid = _source().start(named)
        self._child_created = True
        ends = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
        self._close_pipe_fds(*(named[end] for end in ends))  # type: ignore[attr-defined]


def run(command: Sequence[str], *, capture_output: bool = False, **options: Any) -> subprocess.CompletedProcess[Any]:
    """Run a command to its end as `subprocess.run` does, but warm."""
    timeout = options.pop("timeout", None)
    check = options.pop("check", False)
    if capture_output:
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with Popen(command, **options) as process:
        try:
            out, err = process.communicate(timeout=timeout)
        except BaseException:
            process.kill()
            raise
    done = subprocess.CompletedProcess(command, process.returncode, out, err)
    if check:
        done.check_returncode()
    return done


def _can_be_warm(named: Mapping[str, Any]) -> bool:
    """Whether a process is one of Python, in the environment that the warm process has."""
    words = named["args"]
    plain = not (named["preexec_fn"] or named["shell"] or named["executable"])
    if sys.platform != "linux" or not plain or isinstance(words, str | bytes) or words[0] != sys.executable:
        return False
    environment = os.environ if named["env"] is None else named["env"]
    names = (_BEGAN.keys() | environment.keys()) - _FREE
    same = all(_BEGAN.get(name) == environment.get(name) for name in names)
    return same and words[1] in ("-m", "-c")


@cache
def _source() -> _Source:
    return _Source()


class _Source:
    """A process from which others are forked."""

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, "-m", "tests.warm_start", str(theirs.fileno())]
            self.process = subprocess.Popen(
                command, pass_fds=(theirs.fileno(),), cwd=_ROOT, env=_BEGAN, stdin=subprocess.DEVNULL
            )
        atexit.register(self._end)

    def _end(self) -> None:
        self._socket.close()
        self.process.wait()

    def start(self, named: Mapping[str, Any]) -> int:
        """Start a process as a child of this one; return its id."""
        given = (named["p2cread"], named["c2pwrite"], named["errwrite"])
        streams = [number if end == -1 else end for number, end in enumerate(given)]
        passed = list(named["pass_fds"])
        request = {
            "words": [os.fspath(word) for word in named["args"][1:]],
            "environment": dict(os.environ if named["env"] is None else named["env"]),
            "folder": os.fspath(named["cwd"] or os.getcwd()),
            "session": bool(named["start_new_session"]),
            "passed": passed,
        }
        libc = ctypes.CDLL(None)
        libc.prctl(_ADOPT, 1, 0, 0, 0)
        try:
            socket.send_fds(self._socket, [json.dumps(request).encode()], [*streams, *passed])
            answer = self._socket.recv(64)
        finally:
            libc.prctl(_ADOPT, 0, 0, 0, 0)
        assert answer, "the warm process has ended"
        return int(answer)


def _import_all() -> None:
    """Import what commands import, let numba read its tables, and compile what tests beside it do not compile."""
    import gsvis.cli
    from tests.one_compiler import compile_once

    compile_once()

    for found in iter_modules(gsvis.cli.__path__, "gsvis.cli."):
        import_module(found.name)
    from numba.core.registry import cpu_target

    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
    gc.collect()
    gc.freeze()


def _wait_for_requests(ours: socket.socket) -> dict[str, Any]:
    """Fork a process for each request; return the request in that process, and never in this one."""
    while True:
        message, descriptors, _, _ = socket.recv_fds(ours, _LONGEST, 250)
        if not message:
            os._exit(0)
        go, ready = os.pipe()
        said, says = os.pipe()
        between = os.fork()
        if between == 0:
            child = os.fork()
            if child:
                os.write(says, str(child).encode())
                os._exit(0)
            os.close(ready)
            os.read(go, 1)  # ends when the one between has ended, and the test is the parent
            ours.detach()
            request: dict[str, Any] = json.loads(message)
            _take(request, descriptors)
            return request
        for descriptor in (go, says, *descriptors):
            os.close(descriptor)
        os.waitpid(between, 0)
        child_id = os.read(said, 64)
        os.close(said)
        os.close(ready)
        ours.send(child_id)


def _take(request: Mapping[str, Any], descriptors: Sequence[int]) -> None:
    """Make this process the one that was asked for."""
    wanted = [0, 1, 2, *request["passed"]]
    waiting = [fcntl.fcntl(each, fcntl.F_DUPFD, _HIGH) for each in descriptors]
    for source, number in zip(waiting, wanted, strict=True):
        os.dup2(source, number)
    for number in map(int, os.listdir("/proc/self/fd")):
        if number not in wanted:
            with suppress(OSError):  # the one that listed them
                os.close(number)
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    tempfile.tempdir = None
    if os.environ.get("PYTHONWARNINGS") == "error":
        warnings.simplefilter("error")
    if request["session"]:
        os.setsid()
    sys.stdin = sys.__stdin__ = _stream(0, "r", sys.stdin)
    sys.stdout = sys.__stdout__ = _stream(1, "w", sys.stdout)
    sys.stderr = sys.__stderr__ = _stream(2, "w", sys.stderr)


def _stream(number: int, mode: str, before: Any) -> Any:
    """Open a standard stream anew: the one before knows where its file stood."""
    buffer = open(number, f"{mode}b", closefd=False)  # noqa: SIM115
    by_line = number == 2 or os.isatty(number)
    return TextIOWrapper(buffer, encoding=before.encoding, errors=before.errors, line_buffering=by_line)


def _become(words: list[str]) -> None:
    """Do what `python WORDS` does."""
    if words[0] == "-m":
        sys.argv = words[1:]
        sys.path[0] = os.getcwd()
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
        return
    sys.argv = ["-c", *words[2:]]
    sys.path[0] = ""
    module = ModuleType("__main__")
    sys.modules["__main__"] = module
    exec(compile(words[1], "<string>", "exec"), module.__dict__)


if __name__ == "__main__":
    _here = sys.modules["__main__"]  # its names stay while another takes its place
    _import_all()
    _become(_wait_for_requests(socket.socket(fileno=int(sys.argv[1])))["words"])
