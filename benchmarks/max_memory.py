"""Does every command with `--max-memory` keep to it, and does it refuse with one line what does not fit?

Each command runs on each of its scenes under a megabyte, which it has to refuse before it works, and then under the
least that its line asks for, under which its memory is followed. A world may refuse again, when it knows its tiles.

Given: nika, flowers, showroom LOD 3 and biker, with few views, steps and cells.
Measured: peak of proportional memory (PSS) of all processes of the command over the least limit that it accepts, and
    seconds of processor until it refuses.
Defaults chosen on: the same commands on nika, flowers and showroom; biker, nika LOD 2 with prepare, and large shares
    are held out.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from _harness import add_arguments, need, realdata, write_result
from _memory import pss, tree

SCENES = {
    "nika": "nika_sh3/lod-meta.json", "flowers": "flowers_sh2/lod-meta.json", "showroom": "showroom/lod-meta.json",
    "biker": "formats/biker.compressed.ply",
}  # fmt: skip
_MOST = 12  # refusals of a world
_UNITS = {"GB": 1e9, "MB": 1e6, "kB": 1e3}


class Case(NamedTuple):
    """A command on a scene of the real data, with its other words; `out` is the suffix of what it writes."""

    command: str
    scene: str
    lod: int | None
    out: str
    words: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        of = self.scene if self.lod is None else f"{self.scene} LOD {self.lod}"
        more = f" to {self.out}" if self.command == "convert" else ", large shares" if "--levels" in self.words else ""
        return f"{self.command} of {of}{more}"


_TRAIN = ("--views", "16", "--width", "480", "--height", "360")
_LEVELS = ("--steps", "12", "--held-out", "2", *_TRAIN)
_COLOR = ("--views", "32", "--held-out", "2")
_SETS = ("--cells", "2", "--workers", "1")
_STEPS = ("--steps", "12")

CASES = (
    *(Case("convert", "nika", 0, out) for out in (".sog", ".spz")),
    Case("convert", "showroom", 3, ".spz"),
    *(Case("convert", "biker", None, out) for out in (".sog", ".spz", ".html")),
    Case("clean", "flowers", 2, ".ply"),
    Case("clean", "biker", None, ".ply"),
    Case("levels", "flowers", 2, "", _LEVELS),
    Case("levels", "biker", None, "", _LEVELS),
    Case("levels", "flowers", 3, "", (*_LEVELS, "--levels", "0.5", "0.9")),
    Case("color", "nika", 2, ".arrow", _COLOR),
    Case("color", "biker", None, ".arrow", _COLOR),
    Case("pvs", "biker", None, ".pvs", _SETS),
    Case("prepare", "nika", 2, ".gsvis", (*_SETS, *_STEPS, *_TRAIN)),
    Case("prepare", "biker", None, ".gsvis", (*_SETS, *_STEPS, *_TRAIN)),
    Case("world", "nika", 2, ".gsworld", (*_SETS, *_STEPS, "--tile", "20000")),
)


def main() -> None:
    """Run every case under too little and under just enough memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", help="parts of names of cases, such as levels")
    parser.add_argument("--work", type=Path, help="folder for what the commands write, a gigabyte")
    given = add_arguments(parser).parse_args()
    need(given.work, "a folder with --work")
    cases = [case for case in CASES if not given.only or any(word in case.name for word in given.only)]
    runs = dict[str, dict[str, Any]]()
    for case in cases:
        runs[case.name] = measured(case, given.work)
        shown = runs[case.name]
        print(f"{case.name}: {shown['share']:.2f} of {shown['limit'] / 1e6:.0f} MB; {shown['line']}", flush=True)
    figures = [
        {"name": f"peak over the least limit, {command}", "target": 1.0, "unit": "", "better": "lower",
         "reached": max(run["share"] for name, run in runs.items() if name.startswith(command + " "))}
        for command in dict.fromkeys(case.command for case in cases)
    ]  # fmt: skip
    figures.append(
        {"name": "commands that do not end with one line under 1 MB", "target": 0, "unit": "", "better": "lower",
         "reached": sum(not run["refused"] for run in runs.values())}
    )  # fmt: skip
    write_result(given.out, "Does every command keep to --max-memory?", figures, {"runs": runs})


def measured(case: Case, work: Path) -> dict[str, Any]:
    """Run a case under a megabyte, then under what it asks for."""
    shutil.rmtree(work / "made", ignore_errors=True)
    (work / "made").mkdir(parents=True)
    limit, share, refusals = 1_000_000, 0.0, list[dict[str, Any]]()
    while (went := run(case, work, limit))["code"]:
        refusals.append(went)
        found = re.search(r"at least ([0-9.]+) (GB|MB|kB)", went["line"])
        if went["code"] != 2 or found is None or len(refusals) > _MOST:
            raise SystemExit(f"{case.name} ended with {went['code']}: {went['line']}")
        share = max(share, went["peak"] / limit) if len(refusals) > 1 else 0.0
        last = 10.0 ** -len(found[1].partition(".")[2])  # what rounding may have taken away
        limit = int((float(found[1]) + last) * _UNITS[found[2]])
    return {
        "refused": all(each["lines"] == 1 for each in refusals), "line": refusals[-1]["line"], "limit": limit,
        "refused_after_cpu_s": refusals[0]["cpu_s"], "refusals": len(refusals),
        "share": max(share, went["peak"] / limit), "run": went,
    }  # fmt: skip


def run(case: Case, work: Path, limit: int) -> dict[str, Any]:
    """Run a case under a limit; return its exit code, last line of stderr, seconds of processor and peak of PSS."""
    words = [case.command, str(realdata() / "scenes" / SCENES[case.scene]), "-o", str(work / "made" / f"out{case.out}")]
    words += [*case.words, *([] if case.lod is None else ["--lod", str(case.lod)])]
    before, began, peak = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter(), 0
    with open(work / "stderr", "w+") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "gsvis", *words, "--max-memory", f"{limit}B"], stdout=subprocess.DEVNULL,
            stderr=said, env={**os.environ, "COLUMNS": "400"},
        )  # fmt: skip
        while process.poll() is None:
            peak = max(peak, sum(pss(pid) for pid in tree(process.pid)))
            time.sleep(0.05)
        said.seek(0)
        lines = [line for line in said.read().replace("\r", "\n").splitlines() if line.startswith("gsvis: error")]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "code": process.returncode, "line": lines[-1] if lines else "", "lines": len(lines), "peak": peak,
        "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "seconds": time.perf_counter() - began,
    }  # fmt: skip


if __name__ == "__main__":
    main()
