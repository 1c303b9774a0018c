"""Runs single inputs: what counts as a finding, what it cost, and how to make it smaller.

Used by the quick tests, in their own process, and by tools/fuzz.py, in processes with limits.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.targets import Case, Target, case_of, run_case

__all__ = ["Finding", "Outcome", "minimize", "run_input", "run_whole"]

SLOW_S = 20.0
"""Processor seconds that one input may take."""

FREE_BYTES, BYTES_A_BYTE = 160 << 20, 512
"""Memory that an input may take: what `gsvis.files.limits` grants a file, doubled for what is held on the way."""

_TRIALS, _SECONDS = 120, 20.0


@dataclass(frozen=True)
class Finding:
    """An input that did what none may do.

    Attributes:
        target: Name.
        index: Of the input.
        kind: "exception", "memory", "slow", "crash" or "hang".
        line: What happened, for people.
        key: Findings of one key are one fault.
        case: The input, made smaller where that was cheap.
    """

    target: str
    index: int
    kind: str
    line: str
    key: str
    case: Case


@dataclass(frozen=True)
class Outcome:
    """How an input ended: "read", "refused" or "found", seconds of the processor, and bytes that memory grew by."""

    verdict: str
    seconds: float
    nbytes: int
    finding: Finding | None = None


@contextmanager
def _folder() -> Iterator[Path]:
    room = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    folder = Path(tempfile.mkdtemp(prefix="gsvis-fuzz-", dir=room))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def run_input(target: Target, seed: int, index: int) -> Outcome:
    """Run one input of a run."""
    case = case_of(target, seed, index)
    return run_whole(target, case, index, valid=index < len(target.cases))


def run_whole(target: Target, case: Case, index: int = -1, *, valid: bool = False) -> Outcome:
    """Run a case and say how it ended."""
    size = sum(map(len, case.values()))
    before, began = _start_of_memory(), time.process_time()
    verdict, kind, line, key = "found", "", "", ""
    try:
        with _folder() as folder, warnings.catch_warnings():
            warnings.simplefilter("error")
            verdict = run_case(target, folder, case, valid=valid)
    except Exception as error:
        kind, (line, key) = "exception", _explain(error)
    seconds, nbytes = time.process_time() - began, max(_most_memory() - before, 0)
    if not kind and seconds > SLOW_S:
        kind, line, key = "slow", f"{seconds:.0f} s of the processor for {size:,} bytes", "slow"
    if not kind and nbytes > FREE_BYTES + BYTES_A_BYTE * size:
        kind, line, key = "memory", f"{nbytes >> 20:,} MB for {size:,} bytes", "memory"
    finding = Finding(target.name, index, kind, line, f"{target.name}: {key}", case) if kind else None
    return Outcome("found" if kind else verdict, seconds, nbytes, finding)


def _explain(error: BaseException) -> tuple[str, str]:
    """One line of an error, and a key: its type and the innermost place in gsvis."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/gsvis/" in frame.filename] or list(frames)
    place = f"{ours[-1].filename.rpartition('/gsvis/')[2]}:{ours[-1].lineno}" if ours else "nowhere"
    text = re.sub(r"\s+", " ", str(error))[:160]
    key = f"{type(error).__name__} at {place}"
    if isinstance(error, AssertionError):  # a law of the target: the place alone says too little
        key += " " + re.sub(r"[\d,.]+", "#", re.sub(r"/\S+", "", text))[:60]
    return f"{key}: {text}", key


def _start_of_memory() -> int:
    """Bytes in memory now; the mark of the highest is set back to it."""
    try:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
    except OSError:
        return _most_memory()
    return _most_memory()


def _most_memory() -> int:
    try:
        with open("/proc/self/status") as file:
            return next(int(line.split()[1]) << 10 for line in file if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return 0


def minimize(target: Target, finding: Finding) -> Finding:
    """The same finding from less: files as they are in a valid case, and bytes left out or as they were."""
    trials, until = 0, time.monotonic() + _SECONDS
    best = finding.case

    def same(case: Case) -> bool:
        nonlocal trials
        trials += 1
        if trials > _TRIALS or time.monotonic() > until:
            return False
        found = run_whole(target, case, finding.index).finding
        return found is not None and found.key == finding.key

    near = min(target.cases, key=lambda case: sum(case.get(name) != data for name, data in best.items()))
    for name in sorted(near):
        if best.get(name) != near[name]:
            trial = {**best, name: near[name]}
            best = trial if same(trial) else best
    for name in sorted(best):
        if name not in near or best[name] == near[name]:
            continue
        best = _with_shorter(best, name, same)
    return Finding(finding.target, finding.index, finding.kind, finding.line, finding.key, best)


def _with_shorter(case: Case, name: str, same) -> Case:  # type: ignore[no-untyped-def]
    """The case with blocks of a file left out, as long as the finding stays."""
    size = max(len(case[name]) // 2, 1)
    while size >= 1 and len(case[name]) > 1:
        at = 0
        while at < len(case[name]):
            data = case[name]
            trial = {**case, name: data[:at] + data[at + size :]}
            if same(trial):
                case = trial
            else:
                at += size
        if size < 8:
            break
        size //= 2
    return case
