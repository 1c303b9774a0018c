"""Change one operator, comparison or number at a time and see whether the tests notice: `python tools/mutate.py`.

Which modules are changed, and which tests have to notice, stands in `MODULES`: the paper's equations and the store. The
changes are those of cosmic-ray (`pip install cosmic-ray`); of each module a sample, drawn by seed. Everything runs on a
copy of the tree. A change that no test notices has *survived*: either a test is missing, or the change means nothing.

Given: the modules with their tests, how many changes of each, the seed.
Measured: changes that no test noticed.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import ast
import concurrent.futures
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

from _harness import write_result  # noqa: E402

MODULES = {
    "gsvis/color/srbf.py": ("tests/color/test_evaluate.py", "tests/color/test_to_sh.py", "tests/color/test_fit.py"),
    "gsvis/color/reference.py": (
        "tests/color/test_evaluate.py",
        "tests/color/test_omp.py",
        "tests/color/test_fit.py",
    ),
    "gsvis/color/spaces.py": ("tests/color/test_spaces.py", "tests/color/test_evaluate.py"),
    "gsvis/color/activation.py": ("tests/color/test_activation.py",),
    "gsvis/color/epsilon.py": ("tests/color/test_epsilon.py",),
    "gsvis/abr/qoe.py": ("tests/abr/test_qoe.py", "tests/simulate"),
    "gsvis/abr/policies.py": ("tests/abr",),
    "gsvis/abr/classes.py": ("tests/abr",),
    "gsvis/train/importance.py": ("tests/train/test_importance.py",),
    "gsvis/train/levels.py": ("tests/train/test_levels.py",),
    "gsvis/train/densify.py": ("tests/train/test_densify.py",),
    "gsvis/train/merge.py": ("tests/train/test_merge.py",),
    "gsvis/raycast/directions.py": ("tests/raycast/test_directions.py",),
    "gsvis/raycast/reference.py": ("tests/raycast/test_tracer.py",),
    "gsvis/pvs/store.py": ("tests/pvs/test_store_rows.py", "tests/pvs/test_store.py"),
    "gsvis/pvs/codec.py": ("tests/pvs/test_codec.py",),
}
"""A module and the tests that have to notice a change in it."""

GUARD_S = 300.0  # a run of tests that takes longer hangs: the change was noticed

WARM = """
import os, select, signal, sys, pytest
guard, *tests = sys.argv[1:]
class Plugin:  # what fails need not be made small
    def pytest_configure(self):
        from hypothesis import Phase, settings
        settings.register_profile("mutate", parent=settings(), phases=(Phase.explicit, Phase.generate))
        settings.load_profile("mutate")
pytest.main(["--collect-only", "-qq", "-p", "no:cacheprovider", *tests])  # imports numba, torch and so on
for name in [name for name in sys.modules if name.partition(".")[0] in ("gsvis", "tests")]:
    del sys.modules[name]
for _ in sys.stdin:
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os._exit(pytest.main(["-x", "-q", "--no-header", "-p", "no:cacheprovider", *tests], [Plugin()]))
    os.close(writing)
    if not select.select([reading], [], [], float(guard))[0]:  # closed when the tests end
        os.killpg(child, signal.SIGKILL)
    os.close(reading)
    print("\\ncode", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


def list_mutations(path: Path) -> Iterator[tuple[str, int]]:
    """Yield operator and occurrence of every change that alters what the module does."""
    import cosmic_ray.plugins
    from cosmic_ray.ast import ast_nodes, get_ast_from_path

    tree = get_ast_from_path(path)
    for name in sorted(cosmic_ray.plugins.operator_names()):
        kind = cosmic_ray.plugins.get_operator(name)
        if kind.arguments() or name.startswith("core/ZeroIterationForLoop"):
            continue
        places = (place for node in ast_nodes(tree) for place in kind().mutation_positions(node))
        for occurrence, _ in enumerate(places):
            yield name, occurrence


def apply_mutation(source: str, operator: str, occurrence: int) -> str | None:
    """Return the changed source, or None if it means the same."""
    import cosmic_ray.plugins
    from cosmic_ray.mutating import mutate_code

    changed = mutate_code(source, cosmic_ray.plugins.get_operator(operator)(), occurrence)
    try:
        same = changed is None or meaning(changed) == meaning(source)
    except SyntaxError:  # such as an overload without its decorator
        return None
    return None if same else str(changed)


def meaning(source: str) -> str:
    """Return a dump of the source without annotations, docstrings and overloads: what a run can notice."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.returns = None
        if isinstance(node, ast.arg):
            node.annotation = None
        if isinstance(node, ast.AnnAssign):
            node.annotation = ast.Name("object", ast.Load())
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [  # type: ignore[attr-defined]
                one for one in body if not says_nothing(one)
            ] or [ast.Pass()]
    return ast.dump(tree)


def says_nothing(node: ast.stmt) -> bool:
    """Return whether a statement is a constant or a function of constants: docstrings and overloads are."""
    if isinstance(node, ast.FunctionDef):
        return all(says_nothing(one) for one in node.body)
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


class Runner:
    """Runs tests of a copy of the tree, each time in a new process that has imported numba, torch and so on already."""

    def __init__(self, tree: Path, tests: tuple[str, ...]) -> None:
        environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1", "NUMBA_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-c", WARM, str(GUARD_S), *tests], cwd=tree, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.stdin.close()  # type: ignore[union-attr]
        self._process.wait()

    def passes(self) -> bool:
        """Return whether the tests pass with what the files say now."""
        self._process.stdin.write("run\n")  # type: ignore[union-attr]
        self._process.stdin.flush()  # type: ignore[union-attr]
        for line in self._process.stdout:  # type: ignore[union-attr]
            if line.startswith("code "):
                return line == "code 0\n"
        raise SystemExit("error: the process that runs the tests ended")


def try_module(tree: Path, module: str, count: int, seed: int) -> list[dict[str, Any]]:
    """Return one row for each change that was tried in a module of a copy of the tree."""
    path = tree / module
    source = path.read_text(encoding="utf-8")
    candidates = list(list_mutations(path))
    random.Random(f"{seed} {module}").shuffle(candidates)
    rows: list[dict[str, Any]] = []
    with Runner(tree, MODULES[module]) as runner:
        if not runner.passes():
            raise SystemExit(f"error: {module}: the tests fail before anything is changed")
        for operator, occurrence in candidates:
            if len(rows) == count:
                break
            changed = apply_mutation(source, operator, occurrence)
            if changed is None:
                continue
            path.write_text(changed, encoding="utf-8")
            started = time.monotonic()
            survived = runner.passes()
            path.write_text(source, encoding="utf-8")
            row = {"module": module, **describe(source, changed), "operator": operator.removeprefix("core/")}
            rows.append({**row, "survived": survived})
            if survived:
                print(f"SURVIVED {module}:{row['line']}: {row['before']}  ->  {row['after']}", flush=True)
            else:
                print(f"noticed {module}:{row['line']} after {time.monotonic() - started:.0f} s", file=sys.stderr)
    return rows


def describe(source: str, changed: str) -> dict[str, Any]:
    """Return the first line that differs, as it was and as it is."""
    lines = enumerate(zip(source.splitlines(), changed.splitlines(), strict=False), 1)
    line, before, after = next((k, a.strip(), b.strip()) for k, (a, b) in lines if a != b)
    return {"line": line, "before": before, "after": after}


def try_in_copy(module: str, count: int, seed: int) -> list[dict[str, Any]]:
    """Try the changes of one module in a copy of its own."""
    with tempfile.TemporaryDirectory(prefix="gsvis-mutate-") as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".venv", ".git", "docs", "*.gsvis", ".*_cache"))
        return try_module(tree, module, count, seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", help="some of the modules; all by default")
    parser.add_argument("--mutants", type=int, default=25, help="changes tried in each module")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="modules at once")
    parser.add_argument("--out", type=Path, help="write the result there as JSON")
    options = parser.parse_args()
    for module in options.modules:
        if module not in MODULES:
            raise SystemExit(f"error: expected some of {', '.join(MODULES)}; got {module!r}")
    chosen = options.modules or list(MODULES)
    rows: list[dict[str, Any]] = []
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        for found in pool.map(lambda module: try_in_copy(module, options.mutants, options.seed), chosen):
            rows.extend(found)
    survivors = [row for row in rows if row["survived"]]
    write_result(
        options.out,
        "Which changes of the paper's equations and of the store does no test notice?",
        [
            {"name": "changes tried", "target": None, "reached": len(rows), "unit": "changes", "better": "higher"},
            {"name": "changes that no test noticed", "target": 0, "reached": len(survivors), "unit": "changes",
             "better": "lower"},
        ],
        {"seed": options.seed, "modules": {m: sum(row["module"] == m for row in rows) for m in chosen},
         "survivors": survivors},
    )  # fmt: skip
    if survivors:
        raise SystemExit(json.dumps(len(survivors)) + " survived")


if __name__ == "__main__":
    main()
