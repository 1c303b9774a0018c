"""What every benchmark shares: timing, the machine's description, the place of the real data, and the result as JSON.

A benchmark asks one question, warms up, repeats, compares with a peer or a bare measure in the same run, and ends with
`write_result`, which prints one line a figure and writes the JSON where `--out` says.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import shlex
import sys
import time
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

__all__ = [
    "SKIPPED",
    "Timing",
    "add_arguments",
    "find_realdata",
    "first_reaching",
    "machine",
    "measure",
    "measure_in_turn",
    "need",
    "read_notes",
    "realdata",
    "skip",
    "write_result",
]

NEVER = 1e9
"""Seconds that stand for what did not happen."""

SKIPPED = 77
"""Exit code of a benchmark that measured nothing, because something is missing."""

_ROOT = Path(__file__).resolve().parents[1]
_NOTES = ("Given", "Measured", "Defaults chosen on")


@dataclass(frozen=True)
class Timing:
    """Seconds of one piece of work: all samples, in the order taken."""

    samples: tuple[float, ...]

    @property
    def median(self) -> float:
        return float(np.median(self.samples))

    @property
    def iqr(self) -> float:
        """Distance between the quartiles."""
        low, high = np.quantile(self.samples, [0.25, 0.75])
        return float(high - low)

    def as_json(self) -> dict[str, Any]:
        return {"median_s": self.median, "iqr_s": self.iqr, "samples_s": [round(s, 6) for s in self.samples]}


def measure(fn: Callable[[], object], repeats: int = 7, warmup: int = 1) -> Timing:
    """Time calls of one function, after calls that do not count (compilation, file cache, first touch of memory)."""
    return measure_in_turn({"": fn}, repeats, warmup)[""]


def measure_in_turn(fns: Mapping[str, Callable[[], object]], repeats: int = 7, warmup: int = 1) -> dict[str, Timing]:
    """Time several functions turn by turn, so that whatever else the machine does disturbs all of them alike.

    Returns:
        One `Timing` for each name. The garbage collector rests while a call runs.
    """
    for _ in range(warmup):
        for fn in fns.values():
            fn()
    samples: dict[str, list[float]] = {name: [] for name in fns}
    collecting = gc.isenabled()
    try:
        for _ in range(repeats):
            for name, fn in fns.items():
                gc.collect()
                gc.disable()
                start = time.perf_counter()
                kept = fn()
                samples[name].append(time.perf_counter() - start)
                del kept  # the cost of giving memory back belongs to nobody
    finally:
        if collecting:
            gc.enable()
    return {name: Timing(tuple(taken)) for name, taken in samples.items()}


def machine() -> dict[str, Any]:
    """Processor, cores, memory, how busy it was, and the versions that matter."""
    return {
        "cpu": _cpu_name(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gb": _memory_gb(),
        "load_average": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: found for name in ("numpy", "numba", "open3d-cpu", "torch") if (found := _version(name))},
    }


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _memory_gb() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def add_arguments(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """The options that every benchmark has."""
    parser.add_argument("--out", type=Path, help="write the result there as JSON")
    return parser


def find_realdata() -> Path | None:
    """The folder of real scenes, `GSVIS_REALDATA` or `../shared/data`; None where there is none."""
    folder = Path(os.environ.get("GSVIS_REALDATA", _ROOT.parent / "shared" / "data"))
    return folder if folder.is_dir() else None


def realdata() -> Path:
    """The folder of real scenes; where there is none the benchmark ends with `SKIPPED` and says what is missing."""
    folder = find_realdata()
    if folder is None:
        skip(
            "it needs real scenes, photographs or recordings: a folder with scenes/, photos/ and traces/, which"
            " GSVIS_REALDATA names; benchmarks/README.md lists the files and where they are from"
        )
    return folder


def first_reaching(quality: Callable[[int], float], last: int, target: float) -> int | None:
    """Return the first of the states 0 to `last` whose quality is at least a target, None if the last has less.

    Found by halving, as quality hardly ever falls.
    """
    if quality(last) < target:
        return None
    return bisect_left(range(last), True, key=lambda k: quality(k) >= target)


def need(made: object, how: str) -> None:
    """End with `SKIPPED` where something was not given that only another command makes."""
    if not made:
        skip(f"give it {how}")


def skip(why: str) -> NoReturn:
    """End with `SKIPPED`, which says that nothing was measured; `make bench` goes on with the next benchmark."""
    print(f"skipped: {why}", file=sys.stderr)
    raise SystemExit(SKIPPED)


def read_notes(doc: str) -> dict[str, str]:
    """Return what the docstring of a benchmark says is given, is measured, and where defaults were chosen.

    Args:
        doc: A docstring that ends with one entry each for "Given", "Measured" and "Defaults chosen on".

    Raises:
        ValueError: If an entry is missing or empty.
    """
    notes: dict[str, str] = {}
    for line in doc.splitlines():
        name, colon, text = line.partition(": ")
        if colon and name in _NOTES:
            notes[name] = text.strip()
        elif notes and line.startswith("    "):
            last = next(reversed(notes))
            notes[last] = f"{notes[last]} {line.strip()}"
    missing = [name for name in _NOTES if not notes.get(name)]
    if missing:
        raise ValueError(f"docstring: expected lines that begin with {', '.join(_NOTES)}; {', '.join(missing)} missing")
    return notes


def write_result(
    path: Path | None, question: str, figures: Sequence[Mapping[str, Any]], details: Mapping[str, Any]
) -> dict[str, Any]:
    """Print one line a figure, write the result as JSON if there is a path, and return it.

    Args:
        path: The file, or None.
        question: What the benchmark asks, one sentence.
        figures: Each with `name`, `target` (None where there is none), `reached`, `unit`, and `better`: "lower" or
            "higher".
        details: Anything that helps to read the figures; samples, sizes, seeds.
    """
    checked = []
    for figure in figures:
        target, reached, better = figure["target"], float(figure["reached"]), figure["better"]
        if better not in ("lower", "higher"):
            raise ValueError(f"better: expected 'lower' or 'higher', got {better!r}")
        met = None if target is None else bool(reached <= target if better == "lower" else reached >= target)
        checked.append({**figure, "reached": reached, "met": met})
        verdict = "" if target is None else f" (target {target:g}, {'met' if met else 'MISSED'})"
        said = f"{reached:.4g} {figure['unit']}"
        if figure["unit"] == "s" and reached >= NEVER:
            said = "never"
        print(f"{figure['name']}: {said}{verdict}")
    result = {
        "format": "gsvis-benchmark",
        "version": 1,
        "question": question,
        "figures": checked,
        "notes": read_notes(sys.modules["__main__"].__doc__ or ""),
        "machine": machine(),
        "command": shlex.join(["python", os.path.relpath(sys.argv[0], _ROOT), *map(_without_folders, sys.argv[1:])]),
        "details": details,
    }
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.partial")
        partial.write_text(json.dumps(result, indent=1, default=_plain) + "\n", encoding="utf-8")
        os.replace(partial, path)
    return result


def _without_folders(word: str) -> str:
    """Return an argument with the name alone of a path outside of the repository: what lies there is nobody else's."""
    name, equals, value = word.rpartition("=")
    path = Path(value)
    if not path.is_absolute():
        return word
    if path.is_relative_to(_ROOT):
        return f"{name}{equals}{path.relative_to(_ROOT).as_posix()}"
    kept = path.parts[-2:] if path.name in ("lod-meta.json", "meta.json") else path.parts[-1:]
    return f"{name}{equals}{'/'.join(kept)}"


def _plain(value: Any) -> Any:
    """NumPy values and timings as JSON knows them."""
    if isinstance(value, Timing):
        return value.as_json()
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return value.name
    raise TypeError(f"no JSON for {type(value).__name__}")
