"""Does streaming win a fair fight, over all scenes, links, walks and systems?

The whole bench in one command. Runs `streaming_rivals.py` for every package: first over constant links of 1, 3, 10
and 30 Mbit/s, all systems, eight walks; then over recorded links of these classes, ours and the rivals, four walks.
Draws figures 9 to 14 of the paper (`streaming_plots.py`) and writes `tables.md`: ours beside the best rival of each
class, and table 1 of the paper with a line for what is here; `paper/figures.py` writes the others. What is finished
is kept, so a killed run goes on. A part that would begin after `--minutes` is left out, and named in the tables. One
walk over constant links takes 1.5 minutes of a core in nika and 2.3 in showroom, so all of it about 50 by reckoning:
less than an hour on four cores. `--quick` takes minutes: two walks, constant links of 3 and 10 Mbit/s, small images.

Given: packages with visible sets and levels; see `streaming_rivals.py`.
Measured: what `streaming_rivals.py` measures; this collects it.
Defaults chosen on: four other walks; see `streaming_rivals.py`. Flowers is a scene on which no default of streaming was
    chosen.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from _delivery_systems import OTHERS, OURS
from _harness import need

TABLE_1 = (
    ("Compressed-3D", "no", "no", "no", "named with published sizes"),
    ("SOGG", "no", "no", "no", "named with published sizes"),
    ("Compact-3D", "yes", "no", "no", "named with published sizes"),
    ("Scaffold-GS", "yes", "no", "no", "named with published sizes"),
    ("the paper's own", "yes", "yes", "yes", "not published"),
)
"""Table 1 of the paper: Gaussians by view, attributes by view, differences alone; then how it is compared with here."""


class Part(NamedTuple):
    """One run of `streaming_rivals.py`."""

    name: str
    scene: str
    arguments: tuple[str, ...]


def parts_of(packages: Sequence[str], workers: int, *, quick: bool) -> list[Part]:
    """Return the runs in the order of what they are worth: constant links of all scenes, then recorded ones."""
    both = ("--workers", str(workers))
    if quick:
        some = ("--quick", "--every", "3", "--width", "160", "--systems", OURS, *OTHERS, *both)
        return [Part("quick", word.partition("=")[0], (word, *some)) for word in packages]
    constant = ("--links", "constant", "--every", "1.5", "--width", "240", *both)
    recorded = ("--links", "recorded", "--walks", "4", "--every", "3", "--width", "240", *both, "--systems", OURS)
    return [
        Part(name, word.partition("=")[0], (word, *arguments))
        for name, arguments in (("constant", constant), ("recorded", (*recorded, *OTHERS)))
        for word in packages
    ]


def tables(done: Sequence[tuple[Part, dict[str, Any]]], left_out: Sequence[Part]) -> str:
    """Return the tables as Markdown."""
    lines = ["# Does streaming win a fair fight?", "", "## Is ours better than the best rival, and how soon?", ""]
    lines += ["| links | class | best rival | QoE of a step, ours less its, 95% interval |", "|---|---|---|---|"]
    for part, result in done:
        for where, found in result["details"]["differences"].items():
            best = found["best_rival"]
            if best in found["ours_minus"]:
                apart = found["ours_minus"][best]["score"]
                said = f"{apart['mean']:+.3f} ({apart['low']:.3f} to {apart['high']:.3f}, {apart['pairs']} walks)"
                lines.append(f"| {part.name} | {where} | {best} | {said} |")
    lines += ["", "| links | figure | ours | target | |", "|---|---|---|---|---|"]
    for part, result in done:
        for figure in result["figures"]:
            if figure["target"] is not None and "interval" not in figure["name"]:
                verdict = "reached" if figure["met"] else "**missed**"
                ours = f"{figure['reached']:.3g} {figure['unit']}"
                lines.append(f"| {part.name} | {figure['name']} | {ours} | {figure['target']:g} | {verdict} |")
    if left_out:
        names = ", ".join(f"{part.scene} on {part.name} links" for part in left_out)
        lines += ["", f"Left out, since the time was over: {names}. The same command goes on with them."]
    return "\n".join([*lines, "", *_table_1(), ""])


def _table_1() -> list[str]:
    lines = ["## Which systems send a part for a view? (table 1 of the paper)", ""]
    lines += ["| | Gaussians by view | attributes by view | differences alone | here |", "|---|---|---|---|---|"]
    lines += [f"| {' | '.join(row)} |" for row in TABLE_1]
    lines.append("| gsvis | yes | yes | yes | its own server |")
    by_view = {"frustum chunks": "yes", "layers, L3GS, levels": "yes", "layers, L3GS, importance": "yes"}
    for name in OTHERS:
        chosen = by_view.get(name, "by distance" if "leaves" in name else "no")
        lines.append(f"| {name} | {chosen} | no | no | simulated |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("packages", nargs="*", metavar="NAME=PACKAGE", help="a package, under a name of your choice")
    parser.add_argument("--quick", action="store_true", help="minutes instead of an hour")
    parser.add_argument("--minutes", type=float, default=60.0, help="no part begins later")
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--out", type=Path, default=Path("out/streaming_bench"), help="folder of results")
    options = parser.parse_args()
    need(options.packages, "what `gsvis prepare` made, as NAME=PACKAGE")
    here, begun = Path(__file__).resolve().parent, time.monotonic()
    options.out.mkdir(parents=True, exist_ok=True)
    done: list[tuple[Part, dict[str, Any]]] = []
    left_out: list[Part] = []
    for part in parts_of(options.packages, options.workers, quick=options.quick):
        if time.monotonic() - begun > 60.0 * options.minutes:
            left_out.append(part)
            continue
        kept = options.out / f"{part.name}-{part.scene}.json"
        beside = ("--cache", str(options.out / "cache"), "--out", str(kept))
        subprocess.run([sys.executable, str(here / "streaming_rivals.py"), *part.arguments, *beside], check=True)
        figures = options.out / f"{part.name}-{part.scene}"
        subprocess.run([sys.executable, str(here / "streaming_plots.py"), str(kept), "--out", str(figures)], check=True)
        done.append((part, json.loads(kept.read_text(encoding="utf-8"))))
        (options.out / "tables.md").write_text(tables(done, left_out), encoding="utf-8")
        print(f"{part.name} links, {part.scene}: {time.monotonic() - begun:.0f} s so far", file=sys.stderr, flush=True)
    (options.out / "tables.md").write_text(tables(done, left_out), encoding="utf-8")
    print(options.out / "tables.md")


if __name__ == "__main__":
    main()
