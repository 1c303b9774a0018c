"""Run benchmarks in two checkouts, turn by turn, and write which figures became worse.

    git worktree add ../before COMMIT
    python tools/compare.py --before ../before --rounds 3 --out docs/results/compare.json \\
        "render_garden" "hpr_open3d --eyes 2 --repeats 3"

Each word is a benchmark of both checkouts, with its options. A figure is worse if the median of its ratios, after over
before and turned so that above 1 is worse, exceeds the noise: the largest ratio between two rounds of the same
checkout, 1.05 at least. Figures are paired by name, in American spelling.

Given: the two checkouts, the benchmarks with their options, the number of rounds.
Measured: each figure of each benchmark in both checkouts, in turn on the same machine; ratios and noise follow.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks._harness import write_result  # noqa: E402

_LEAST_NOISE = 1.05
_SPELLING = (("colour", "color"), ("centre", "center"), ("metre", "meter"), ("neighbour", "neighbor"))

Figures = dict[str, dict[str, Any]]


def run_benchmark(tree: Path, words: Sequence[str]) -> Figures:
    """Run one benchmark of a checkout and return its figures by name.

    Raises:
        RuntimeError: If it fails or writes no result; the end of its output is the message.
    """
    realdata = os.environ.get("GSVIS_REALDATA", str(ROOT.parent / "shared" / "data"))
    environment = {**os.environ, "PYTHONPATH": str(tree), "GSVIS_REALDATA": str(Path(realdata).resolve())}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "result.json"
        command = [sys.executable, str(tree / "benchmarks" / f"{words[0]}.py"), *words[1:], "--out", str(out)]
        ended = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
        if ended.returncode or not out.exists():
            raise RuntimeError(f"{shlex.join(command)}: exit code {ended.returncode}\n{ended.stderr[-2000:]}")
        return read_figures(json.loads(out.read_text(encoding="utf-8")))


def read_figures(result: dict[str, Any]) -> Figures:
    """Return the figures of a result by name, in American spelling."""
    figures = {}
    for figure in result["figures"]:
        name = figure["name"]
        for old, new in _SPELLING:
            name = name.replace(old, new)
        figures[name] = figure
    return figures


def compare_figure(before: Sequence[float], after: Sequence[float], better: str) -> dict[str, Any]:
    """Return how much worse a figure became, and the noise.

    Args:
        before: Value in each round, in the checkout before.
        after: Value in each round, in the checkout after.
        better: "lower" or "higher".

    Returns:
        `ratio`: median over rounds, above 1 is worse. `noise`: largest ratio of two rounds of one checkout.
        `worse`: the ratio exceeds the noise.
    """
    ratios = [turn_ratio(b, a, better) for b, a in zip(before, after, strict=True)]
    noise = max(_LEAST_NOISE, *(turn_ratio(min(values), max(values), "lower") for values in (before, after)))
    ratio = statistics.median(ratios)
    return {"before": list(before), "after": list(after), "ratio": ratio, "noise": noise, "worse": ratio > noise}


def turn_ratio(before: float, after: float, better: str) -> float:
    """Return after over before, inverted where higher is better; 1 if the two are equal, infinite for a lost zero."""
    if better == "higher":
        before, after = after, before
    if before == after:
        return 1.0
    return after / before if before > 0.0 < after else float("inf") if after > before else 0.0


def judge(each: dict[str, Any]) -> str:
    """Return the verdict on a comparison in words."""
    if each["worse"]:
        return "WORSE"
    return "better" if each["ratio"] * each["noise"] < 1.0 else "within noise"


def compare(benchmarks: Iterable[str], before: Path, after: Path, rounds: int) -> dict[str, Any]:
    """Run the benchmarks in both checkouts, and return the comparison of each of their figures."""
    found: dict[str, Any] = {}
    for given in benchmarks:
        words = shlex.split(given)
        runs: list[tuple[Figures, Figures]] = []
        for turn in range(rounds):
            print(f"{given}: round {turn + 1} of {rounds}", file=sys.stderr)
            order = (before, after) if turn % 2 == 0 else (after, before)
            each = {tree: run_benchmark(tree, words) for tree in order}
            runs.append((each[before], each[after]))
        names = [name for name in runs[0][0] if name in runs[0][1]]
        found[given] = {
            name: compare_figure(
                [old[name]["reached"] for old, _ in runs],
                [new[name]["reached"] for _, new in runs],
                runs[0][1][name]["better"],
            )
            for name in names
        }
        missing = sorted(set(runs[0][0]) ^ set(runs[0][1]))
        if missing:
            found[given]["unpaired"] = missing
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True, help="the checkout to compare with")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, help="write the result there as JSON")
    parser.add_argument("benchmarks", nargs="+", help="name of a benchmark, with its options in the same word")
    given = parser.parse_args()
    found = compare(given.benchmarks, given.before.resolve(), ROOT, given.rounds)
    pairs = [each for figures in found.values() for name, each in figures.items() if name != "unpaired"]
    for benchmark, figures in found.items():
        for name, each in figures.items():
            if name != "unpaired":
                verdict = judge(each)
                print(f"{benchmark}: {name}: {each['ratio']:.3f} (noise {each['noise']:.3f}): {verdict}")
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=given.before, capture_output=True, text=True, check=False
    ).stdout.strip()
    figures = [
        {
            "name": "figures that became worse than noise",
            "target": 0,
            "reached": sum(each["worse"] for each in pairs),
            "unit": f"of {len(pairs)} figures",
            "better": "lower",
        },
        {
            "name": "median ratio of all figures, after over before, above 1 is worse",
            "target": None,
            "reached": statistics.median(each["ratio"] for each in pairs),
            "unit": "times",
            "better": "lower",
        },
    ]
    write_result(
        given.out,
        f"Did any figure become worse since commit {commit}?",
        figures,
        {"before": commit, "rounds": given.rounds, "benchmarks": found},
    )


if __name__ == "__main__":
    main()
