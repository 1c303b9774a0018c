"""Which system shows a walk best that has the same photographs, the same processor time and the same link?

The photographs of a scene, in name order, are a walk of ten a second. Every system is trained on seven of eight, with
the same processor seconds, and judged by the others as the walk passes them. Systems of others are simplified copies.

    python benchmarks/arena/run.py                     # bonsai, 8 recorded links of 3, 10 and 30 Mbit/s
    python benchmarks/arena/run.py --quick             # a built-in scene, minutes, no data
    python benchmarks/arena/run.py --systems gsvis "3DGS, SOG" --mbit 10
    python benchmarks/arena/run.py --mbit 3 10 30 --links 8 8 24

Trainings are kept in `--work`; a second run only plays.

Given: photographs with their cameras, recorded links that are scaled to a class.
Measured: bytes and PSNR of each trained system; QoE (equation 8), PSNR, first 20 and 25 dB of sessions; differences
    of gsvis and each other system over the same links, with Student's 95% interval.
Defaults chosen on: nothing here; those of gsvis on other scenes and walks. A seed drew the recordings of links.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from _harness import add_arguments, find_realdata, realdata, write_result

from arena.budget import Allowance
from arena.course import Course, write_synthetic_photos
from arena.judge import final_psnr, judge
from arena.links import CLASSES, drawn_links, recorded_links
from arena.report import compare, figures_of, find_weak, sizes_table, streams_table, summarize
from arena.stages import Playable
from arena.systems import SYSTEMS, System, trained
from gsvis.errors import GsvisError
from gsvis.simulate import Link

OWN = ("gsvis, 48 dB records",)
"""What is ours as well, with other options."""
PLAIN = "3DGS, PLY"
"""What copies are compared with to find weak ones."""

QUESTION = "Which system shows a walk best that has the same photographs, the same processor time and the same link?"


def main() -> None:
    names = [system.name for system in SYSTEMS]
    parser = add_arguments(argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter))
    parser.add_argument("--photos", type=Path, help="folder of photographs with a model; default bonsai")
    parser.add_argument("--width", type=int, default=200, help="pixels to shrink photographs to")
    parser.add_argument("--height", type=int, default=133)
    parser.add_argument("--seconds", type=float, default=200.0, help="processor seconds of training, each system")
    parser.add_argument("--gaussians", type=int, default=60_000, help="most Gaussians of a scene")
    parser.add_argument("--mbit", nargs="*", type=float, default=list(CLASSES), help="classes of links")
    parser.add_argument(
        "--links", nargs="+", type=int, default=[8], help="links of each class: one number, or one for each"
    )
    parser.add_argument("--systems", nargs="*", default=names, metavar="NAME", help=f"default all: {', '.join(names)}")
    parser.add_argument("--work", type=Path, default=Path("out/arena"), help="folder of trainings")
    parser.add_argument("--quick", action="store_true", help="a built-in scene, 100 steps, two drawn links of 3 Mbit/s")
    options = parser.parse_args()
    unknown = [name for name in options.systems if name not in names]
    if unknown:
        parser.error(f"--systems: expected some of {', '.join(names)}; got {unknown[0]!r}")
    if min(options.links) < 1 or not options.mbit or min(options.mbit) <= 0:
        parser.error("--links, --mbit: expected at least one link and rates above 0")
    if len(options.links) not in (1, len(options.mbit)):
        classes = len(options.mbit)
        parser.error(f"--links: expected one number, or {classes} for {classes} classes; got {len(options.links)}")
    try:
        run(options)
    except (GsvisError, ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit("interrupted; trainings that were complete are kept") from None


def run(options: argparse.Namespace) -> None:
    """Train what is not trained yet, play all sessions, print the tables and write the result."""
    if options.quick:
        options.mbit, options.links, options.work = [3.0], [2], options.work / "quick"
    allowance = Allowance(options.seconds, options.gaussians, 100 if options.quick else None)
    course = open_course(options)
    counts = options.links if len(options.links) > 1 else options.links * len(options.mbit)
    links = {
        mbit: open_links(mbit, count, course.seconds, options.quick)
        for mbit, count in zip(options.mbit, counts, strict=True)
    }
    chosen = [system for system in SYSTEMS if system.name in options.systems]
    systems, rows = [], list[dict[str, Any]]()
    for system in chosen:
        folder, seconds = trained(system.training, course, allowance, options.work, Lines(system.training.name))
        opened = system.open(course, folder)
        systems.append(describe(system, opened, course, seconds))
        rows += play_all(system.name, opened, course, links)
    means = summarize(rows)
    means.sort(key=lambda each: float(each["mbit"]))
    ours = SYSTEMS[0].name
    differences = compare(rows, ours) if ours in options.systems else []
    weak = find_weak(systems, PLAIN)
    print(f"{sizes_table(systems)}\n\n{streams_table(means, differences, weak)}\n")
    details = {
        "scene": course.name,
        "size": course.size,
        "photographs": len(course.photos.views),
        "held_out": len(course.held_out),
        "allowance": asdict(allowance),
        "links": {f"{mbit:g}": [link.trace.name for link in found] for mbit, found in links.items()},
        "systems": systems,
        "weak": weak,
        "means": means,
        "differences": differences,
        "sessions": [{name: value for name, value in row.items() if name != "curve"} for row in rows],
    }
    write_result(options.out, QUESTION, figures_of(differences, weak, OWN), details)


def open_course(options: argparse.Namespace) -> Course:
    """Return the course of the options; quick runs write photographs of a built-in scene first."""
    if options.photos is not None:
        return Course.open(options.photos, (options.width, options.height))
    if not options.quick:
        return Course.open(realdata() / "photos" / "bonsai", (options.width, options.height))
    folder = options.work / "photos"
    if not (folder / "transforms.json").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        write_synthetic_photos(folder)
    return Course.open(folder, (96, 64))


def open_links(mbit: float, count: int, seconds: float, quick: bool) -> list[Link]:
    """Return the links of a class: recorded ones, or drawn ones where there are no recordings."""
    found = find_realdata()
    if quick or found is None:
        return drawn_links(mbit, count, seconds)
    return recorded_links(found / "traces", mbit, count, seconds)


def describe(system: System, opened: Playable, course: Course, seconds: float) -> dict[str, Any]:
    """Return what is reported of a trained system, ready for JSON."""
    return {
        "name": system.name,
        "count": opened.count,
        "bytes": opened.nbytes,
        "psnr": final_psnr(course, opened),
        "seconds": seconds,
        "source": system.source,
        "simplified": system.simplified,
        "published": system.published,
    }


def play_all(name: str, opened: Playable, course: Course, links: dict[float, list[Link]]) -> list[dict[str, Any]]:
    """Return the sessions of a system over all links."""
    rows = []
    began = time.perf_counter()
    for mbit, some in links.items():
        for link in some:
            session = judge(course, opened.play(course, link))
            rows.append({"system": name, "mbit": mbit, "link": link.trace.name, **session.figures()})
    print(f"{name}: {len(rows)} sessions in {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return rows


class Lines:
    """A progress callback that prints a line for each tenth of a training.

    Args:
        name: Name of the training.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._tenth = -1

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Print the share that is done, if it is another tenth."""
        tenth = 10 * done // max(total, 1)
        if tenth != self._tenth:
            self._tenth = tenth
            print(f"{self._name}: {stage} {10 * tenth}%", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
