"""Fuzz every reader and the wire: `python tools/fuzz.py --inputs 100000 --seed 1 --out docs/results/fuzz.json`.

Inputs run in processes with a limit on address space; one that takes too long is ended. An input follows from the
seed, its target and its number, so a finding can be made again: `--targets NAME --first NUMBER --inputs 1`.
Findings go to tests/corpus with `--keep`. SIGTERM ends a run early: what has run by then is reported. With coverage.py
installed, a smaller run measures branch coverage: `--inputs 0 --measured 150 --out docs/results/fuzz_coverage.json`.

Given: small valid files of every format and sessions of the wire, made by tests/fuzz from procedural scenes; no real
    data. The seed and the number of inputs.
Measured: how each changed input ends, its processor time and the growth of memory; branches of the readers in a run of
    its own. Branches of functions that write, that callers ask or that are compiled do not count; how many these are
    stands beside the figure, and `readers` in the details has a figure for each module.
Defaults chosen on: nothing; the limits of memory are twice what the readers promise in gsvis.files.limits.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing as mp
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "tools")]
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

CHUNK = 100  # inputs that a process is given at once
HANG_S = 60.0  # seconds of the clock after which an input is ended
WARM = 12  # inputs of each target that a process runs before memory is limited: LLVM does not bear a limit
ROOM = 1 << 30  # bytes of address space beyond what a process has when it is warm


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--inputs",
        type=int,
        default=100_000,
        help="of all targets together (default: 100000); 0 for the coverage alone",
    )
    parser.add_argument("--first", type=int, default=0, help="number of the first input of each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=max(1, (os.cpu_count() or 2) // 2), help="processes")
    parser.add_argument("--targets", nargs="*", default=[], metavar="NAME", help="some of them (default: all)")
    parser.add_argument("--keep", action="store_true", help="write one input of each finding to tests/corpus")
    parser.add_argument("--measured", type=int, default=0, help="inputs a target for branch coverage (default: none)")
    parser.add_argument("--out", type=Path, help="write the result there as JSON")
    parser.add_argument("--measure-into", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def chosen(names: list[str]) -> dict[str, Any]:
    from tests.fuzz.families import TARGETS

    unknown = sorted(set(names) - set(TARGETS))
    if unknown:
        raise SystemExit(f"--targets: expected some of {', '.join(TARGETS)}, got {', '.join(unknown)}")
    return {name: target for name, target in TARGETS.items() if not names or name in names}


@dataclass
class Tally:
    """What the inputs of a target have done so far."""

    verdicts: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    slowest: float = 0.0
    most_bytes: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    examples: dict[str, Any] = field(default_factory=dict)


def serve_inputs(pipe: Connection, place: Any, seed: int, names: list[str]) -> None:
    """Run in a process: take pieces of work, run their inputs, send what came of each."""
    import faulthandler
    import logging
    import resource

    from tests.fuzz.engine import minimize, run_input

    logging.disable(logging.CRITICAL)
    faulthandler.enable()  # where a process died goes to the standard error
    targets = chosen(names)
    for target in targets.values():
        for index in range(WARM):  # kernels are compiled and valid cases made
            run_input(target, 0, index)
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
    known: set[str] = set()
    pipe.send(None)
    while (work := pipe.recv()) is not None:
        name, first, count = work
        for index in range(first, first + count):
            place[0], place[1] = time.monotonic(), index
            outcome = run_input(targets[name], seed, index)
            place[0] = 0.0
            found = outcome.finding
            if found is not None and found.key not in known:
                known.add(found.key)
                found = minimize(targets[name], found)
            pipe.send((index, outcome.verdict, outcome.seconds, outcome.nbytes, found))
        pipe.send(None)


def remake(pipe: Connection, name: str, seed: int, index: int) -> None:
    """Run in a process: send the case of an input."""
    from tests.fuzz.targets import case_of

    pipe.send(case_of(chosen([name])[name], seed, index))


@dataclass
class Worker:
    """A process and what it is doing."""

    process: Any
    pipe: Connection
    place: Any
    work: tuple[str, int, int] | None = None
    done: int = -1
    ready: bool = False


class Run:
    """A run of all targets over several processes."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.targets = args, chosen(args.targets)
        self.tallies = {name: Tally() for name in self.targets}
        self.context = mp.get_context("spawn")
        self.pieces = sorted(self._pieces(), key=lambda piece: -piece[1])  # the last first: all targets in turn
        self.total = sum(count for *_, count in self.pieces)
        self.began, self.printed = time.monotonic(), 0.0

    def _pieces(self) -> Iterator[tuple[str, int, int]]:
        weights = sum(target.weight for target in self.targets.values())
        for name, target in self.targets.items() if self.args.inputs else ():
            count = max(1, round(self.args.inputs * target.weight / weights))
            for first in range(0, count, CHUNK):
                yield name, self.args.first + first, min(CHUNK, count - first)

    def start(self) -> Worker:
        mine, theirs = self.context.Pipe()
        place = self.context.Array("d", 2)
        names = list(self.targets)
        process = self.context.Process(target=serve_inputs, args=(theirs, place, self.args.seed, names), daemon=True)
        process.start()
        theirs.close()
        return Worker(process, mine, place)

    def stop(self, *_: object) -> None:
        """Give out no more work: what is under way is finished and counts."""
        self.pieces.clear()

    def run(self) -> None:
        signal.signal(signal.SIGTERM, self.stop)
        workers = [self.start() for _ in range(min(self.args.jobs, len(self.pieces)))]
        while workers:
            wait([w.pipe for w in workers], timeout=0.5)
            for worker in list(workers):
                try:
                    while worker.pipe.poll():
                        self.take(worker, worker.pipe.recv())
                except (EOFError, OSError):
                    workers.remove(worker)
                    worker.process.join()
                    if worker.work is not None or not worker.ready:
                        self.lost(worker, "crash", f"ended with code {worker.process.exitcode}")
                        workers.append(self.start())
                    continue
                began = worker.place[0]
                if began and time.monotonic() - began > HANG_S:
                    worker.process.kill()
                    worker.process.join()
                    workers.remove(worker)
                    self.lost(worker, "hang", f"more than {HANG_S:.0f} s")
                    workers.append(self.start())
            self.report()
        self.report(last=True)

    def take(self, worker: Worker, message: Any) -> None:
        """Take a result, or give the next piece of work."""
        if message is not None:
            index, verdict, seconds, nbytes, found = message
            assert worker.work is not None
            tally = self.tallies[worker.work[0]]
            worker.done = index
            tally.verdicts[verdict] += 1
            tally.seconds += seconds
            tally.slowest, tally.most_bytes = max(tally.slowest, seconds), max(tally.most_bytes, nbytes)
            if found is not None:
                self.found(found)
            return
        worker.ready = True
        worker.work = self.pieces.pop() if self.pieces else None
        worker.done = worker.work[1] - 1 if worker.work else -1
        worker.pipe.send(worker.work)

    def lost(self, worker: Worker, kind: str, line: str) -> None:
        """Note a process that died or hung, and put back what it had not done."""
        from tests.fuzz.engine import Finding

        if worker.work is None:
            raise SystemExit(f"a process {line} before it had work; try --jobs 1")
        name, first, count = worker.work
        index = worker.done + 1
        self.tallies[name].verdicts["found"] += 1
        case = self.remade(name, index)
        kind, line = (kind, line) if case else ("mutator", f"the mutator {line}, gsvis was not reached")
        self.found(Finding(name, index, kind, line, f"{name}: {kind}", case))
        if rest := first + count - index - 1:
            self.pieces.append((name, index + 1, rest))

    def remade(self, name: str, index: int) -> Any:
        """The case of an input, made in a process of its own; empty where making it is what ends a process."""
        mine, theirs = self.context.Pipe()
        process = self.context.Process(target=remake, args=(theirs, name, self.args.seed, index), daemon=True)
        process.start()
        theirs.close()
        try:
            return mine.recv() if mine.poll(2 * HANG_S) else {}
        except (EOFError, OSError):
            return {}
        finally:
            process.kill()
            process.join()

    def found(self, finding: Any) -> None:
        """Print the first finding of its key, and keep its input if asked to."""
        tally = self.tallies[finding.target]
        tally.faults[finding.key] += 1
        if finding.key in tally.examples:
            return
        tally.examples[finding.key] = finding
        print(f"\n{finding.kind}: {finding.target}, input {finding.index}: {finding.line}", flush=True)
        if self.args.keep and finding.case:
            from tests.fuzz.targets import digest_of, pack_case

            path = ROOT / "tests" / "corpus" / finding.target / f"{finding.kind}-{digest_of(finding.case)}.zip"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pack_case(finding.case))

    def report(self, *, last: bool = False) -> None:
        """Print how far it is, now and then."""
        now, shown = time.monotonic(), sys.stderr.isatty()
        if not last and now - self.printed < (1.0 if shown else 15.0):
            return
        self.printed = now
        done = sum(sum(tally.verdicts.values()) for tally in self.tallies.values())
        rate = done / max(now - self.began, 1e-9)
        left = (self.total - done) / rate if done else 0.0
        faults = sum(len(tally.faults) for tally in self.tallies.values())
        end = "\n" if last or not shown else ""
        line = f"{done:,} of {self.total:,} inputs, {faults} faults, {rate:.0f} a second, {left / 60:.1f} min left"
        print(f"\r{line}   " if shown else line, end=end, file=sys.stderr, flush=True)


def measured(args: argparse.Namespace) -> dict[str, Any]:
    """Branch coverage of the readers in a smaller run, by module; empty without coverage.py."""
    try:
        import coverage  # noqa: F401
    except ModuleNotFoundError:
        print("no coverage: install coverage.py to measure it", file=sys.stderr)
        return {}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "coverage.json"
        command = [sys.executable, __file__, "--measure-into", str(out), "--measured", str(args.measured)]
        names = ["--targets", *args.targets] if args.targets else []
        subprocess.run([*command, "--seed", str(args.seed), *names], check=True)
        return dict(json.loads(out.read_text(encoding="utf-8")))


def main() -> int:
    args = arguments()
    if args.measure_into is not None:
        from fuzz_coverage import measure

        measure(args.measure_into, args.targets, args.seed, args.measured)
        return 0
    run = Run(args)
    if run.total:
        run.run()
    seconds = time.monotonic() - run.began
    coverage = measured(args) if args.measured else {}
    report(run, seconds, coverage)
    return 1 if any(tally.faults for tally in run.tallies.values()) else 0


def report(run: Run, seconds: float, coverage: dict[str, Any]) -> None:
    """Print the figures and write them where asked for."""
    from _harness import write_result
    from fuzz_coverage import apart_of, figures_of, readers_of

    faults: Counter[str] = Counter()
    for tally in run.tallies.values():
        for finding in tally.examples.values():
            faults[finding.kind] += 1
    inputs = sum(sum(tally.verdicts.values()) for tally in run.tallies.values())
    figures: list[dict[str, Any]] = [
        {"name": "fuzzing: inputs", "target": None, "reached": inputs, "unit": "inputs", "better": "higher"},
        {"name": "fuzzing: faults", "target": 0, "reached": sum(faults.values()), "unit": "faults", "better": "lower"},
        {"name": "fuzzing: most memory of one input", "target": None, "unit": "MB", "better": "lower",
         "reached": max(tally.most_bytes for tally in run.tallies.values()) / 1e6},
        {"name": "fuzzing: slowest input, processor", "target": None, "unit": "s", "better": "lower",
         "reached": max(tally.slowest for tally in run.tallies.values())},
    ] if run.total else []  # fmt: skip
    figures += figures_of(coverage)
    targets = {
        name: {
            **{verdict: tally.verdicts[verdict] for verdict in ("read", "refused", "found")},
            "processor_s": round(tally.seconds, 1),
            "slowest_s": round(tally.slowest, 3),
            "most_memory_mb": round(tally.most_bytes / 1e6, 1),
            "faults": [
                {"kind": f.kind, "line": f.line, "input": f.index, "times": tally.faults[key]}
                for key, f in tally.examples.items()
            ],
        }
        for name, tally in run.tallies.items()
    }
    details: dict[str, Any] = {
        "seed": run.args.seed, "jobs": run.args.jobs, "seconds": round(seconds, 1), "faults_by_kind": dict(faults),
        "limits": {"address_space_mb": ROOM >> 20, "hang_s": HANG_S}, "targets": targets,
    } if run.total else {"seed": run.args.seed, "inputs_a_target": run.args.measured}  # fmt: skip
    if coverage:
        details |= {"readers": readers_of(coverage), "apart": apart_of(coverage), "coverage": coverage}
    question = "Does damaged or hostile input end in a result or a known error, within bounds?"
    if not run.total:
        question = "How many branches of each reader do damaged inputs take?"
    write_result(run.args.out, question, figures, details)


if __name__ == "__main__":
    sys.exit(main())
