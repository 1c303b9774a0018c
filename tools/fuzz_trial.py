"""Which engine reaches more: `python tools/fuzz_trial.py ENGINE --inputs 3000`, see docs/design/026.

Targets of one file get the same number of inputs: from Hypothesis (edits of bytes of a valid file), from Atheris
(libFuzzer, guided by coverage, from the valid files) or from the mutators of tests/fuzz. What is compared is the branch
coverage of the readers, by coverage.py in a run of its own over the inputs.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from random import Random
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]

NAMES = (
    "ply",
    "compressed-ply",
    "spz-gzip",
    "spz-zstd",
    "sog-zip",
    "manifest",
    "visibility",
    "active-terms",
    "client-message",
)


def instrumented(modules: tuple[str, ...]) -> None:
    """Let Atheris see the plain functions of modules; a kernel that is instrumented would be compiled anew."""
    import importlib
    import inspect

    import atheris

    for name in modules:
        module = importlib.import_module(name)
        holders = [module, *(value for value in vars(module).values() if inspect.isclass(value))]
        for holder in holders:
            for value in list(vars(holder).values()):
                function = getattr(value, "__func__", getattr(value, "fget", value))
                if inspect.isfunction(function) and function.__module__ == name:
                    atheris.instrument_func(function)


def by_hypothesis(target: Any, inputs: int) -> list[bytes]:
    from hypothesis import HealthCheck, given, settings
    from hypothesis import strategies as st

    found: list[bytes] = []
    valid = [next(iter(case.values())) for case in target.cases]
    edit = st.tuples(
        st.sampled_from(("set", "insert", "delete", "cut")), st.floats(0, 1), st.binary(min_size=1, max_size=6)
    )

    @settings(
        max_examples=inputs, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(st.sampled_from(valid), st.lists(edit, min_size=1, max_size=4))
    def run(data: bytes, edits: list[tuple[str, float, bytes]]) -> None:
        for way, place, piece in edits:
            at = int(place * len(data))
            kept = {"set": at + len(piece), "insert": at, "delete": at + len(piece), "cut": len(data)}[way]
            data = data[:at] + (piece if way in ("set", "insert") else b"") + data[kept:]
        found.append(data)

    run()
    return found


def by_atheris(target: Any, inputs: int, folder: Path) -> None:
    """Run libFuzzer, which ends the process; its inputs go to the folder."""
    import atheris

    from tests.fuzz.engine import run_whole

    (name,) = target.cases[0]
    seeds = folder / "seeds"
    seeds.mkdir(parents=True, exist_ok=True)
    for k, case in enumerate(target.cases):
        (seeds / f"{k:03d}").write_bytes(case[name])
    out = (folder / "inputs.bin").open("wb")

    def one(data: bytes) -> None:
        out.write(len(data).to_bytes(4, "little") + data)
        out.flush()
        run_whole(target, {name: data})

    atheris.Setup([sys.argv[0], f"-runs={inputs}", "-seed=1", "-max_len=20000", "-rss_limit_mb=4096", str(seeds)], one)
    atheris.Fuzz()


def by_mutators(target: Any, inputs: int) -> list[bytes]:
    from tests.fuzz.targets import case_of

    return [data for k in range(inputs) for data in [next(iter(case_of(target, 1, k).values()), b"")]]


def inputs_in(path: Path) -> list[bytes]:
    data, found, at = path.read_bytes(), [], 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        found.append(data[at + 4 : at + 4 + size])
        at += 4 + size
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("engine", choices=("hypothesis", "atheris", "mutators"))
    parser.add_argument("target", choices=NAMES)
    parser.add_argument("--inputs", type=int, default=3000)
    parser.add_argument("--folder", type=Path, default=Path("/tmp/gsvis-trial"), help="where Atheris keeps its inputs")
    parser.add_argument("--collect", action="store_true", help="run Atheris; a second run without it measures")
    args = parser.parse_args()
    folder = args.folder / args.target
    if args.engine == "atheris" and args.collect:
        from tests.fuzz.families import TARGETS

        instrumented(TARGETS[args.target].modules)
        by_atheris(TARGETS[args.target], args.inputs, folder)
    import coverage
    from fuzz_coverage import branches_of

    meter = coverage.Coverage(branch=True, data_file=None, source_pkgs=["gsvis"])
    meter.start()
    from tests.fuzz.engine import run_whole
    from tests.fuzz.families import TARGETS

    target = TARGETS[args.target]
    (name,) = target.cases[0]
    made = {"hypothesis": by_hypothesis, "mutators": by_mutators}
    inputs = inputs_in(folder / "inputs.bin") if args.engine == "atheris" else made[args.engine](target, args.inputs)
    Random(0).shuffle(inputs)
    began, faults = time.process_time(), set()
    for data in inputs[: args.inputs]:
        finding = run_whole(target, {name: data}).finding
        faults |= {finding.key} if finding else set()
    meter.stop()
    modules = {module: branches_of(meter, module) for module in target.modules}
    branches, covered = (sum(module[key] for module in modules.values()) for key in ("branches", "covered"))
    said = {"engine": args.engine, "target": args.target, "inputs": len(inputs[: args.inputs]), "branches": branches}
    said |= {"covered": covered, "percent": round(100 * covered / branches, 1), "faults": sorted(faults)}
    print(json.dumps({**said, "processor_s": round(time.process_time() - began, 1)}))


if __name__ == "__main__":
    main()
