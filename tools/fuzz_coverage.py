"""Branch coverage of the readers by a fuzz run in this process; coverage.py counts from the first import on."""

from __future__ import annotations

import ast
import importlib.util
import json
import logging
import sys
from pathlib import Path
from typing import Any

APART = {
    "a writer": (
        "save_",
        "write_",
        "to_json",
        "to_message",
        "to_bytes",
        "pack_view",
        "encode_",
        "compress",
        "_join_digits",
        "append",
        "close_section",
        "finish",
        "save",
        "keep",
        "as_dict",
        "_batches",
        "_packed",
        "_ids",
        "_write",
        "remove_all_but",
        "run_key",
        "build_",
        "_groups",
        "most_weights",
        "colors_hash",
        "sets_hash",
        "_array",
        "columns_of",
        "check_names",
        "_of_content",
        "chunk_starts",
        "stored_order",
        "of",
        "_packed_streams",
        "_pack_smallest_three",
        "remove",
    ),
    "compiled, not seen by coverage": ("compiled",),
    "asked by callers, not by files": (
        "check_scene",
        "check_gaussian",
        "_checked_class",
        "_at_least",
        "distance_to_visibility",
        "check",
        "opened",
        "gaussians",
    ),
    "no reader": (
        "__repr__",
        "__exit__",
        "respond",
        "_page",
        "_encoded",
        "_webp",
        "why",
        "nearest_seer",
        "union",
        "difference",
    ),
}
"""Functions in the modules of readers that read nothing: by the beginning of their names, with the reason."""


def measure(out: Path, names: list[str], seed: int, inputs: int) -> None:
    """Run `inputs` inputs of each target and write the branches of its modules as JSON."""
    import coverage

    meter = coverage.Coverage(branch=True, data_file=None, source_pkgs=["gsvis"])
    meter.start()
    from fuzz import chosen

    from tests.fuzz.engine import run_input

    logging.disable(logging.CRITICAL)
    targets = chosen(names)
    for name, target in targets.items():
        print(f"coverage: {name}", file=sys.stderr)
        for index in range(inputs):
            run_input(target, seed, index)
    meter.stop()
    modules = sorted({module for target in targets.values() for module in target.modules})
    out.write_text(json.dumps({module: branches_of(meter, module) for module in modules}, indent=1), encoding="utf-8")


def branches_of(meter: Any, module: str) -> dict[str, Any]:
    """How many branches the readers of a module have, how many were taken, and where those are that were not."""
    spec = importlib.util.find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    path = Path(spec.origin)
    analysis = meter._analyze(str(path))
    stats, missing = analysis.branch_stats(), analysis.missing_branch_arcs()
    lines, owners = path.read_text(encoding="utf-8").splitlines(), _owners(path)
    branches = covered = apart = 0
    left = []
    for line, (total, taken) in sorted(stats.items()):
        if _reason(owners.get(line, "")):
            apart += total
            continue
        branches, covered = branches + total, covered + taken
        for to in missing.get(line, ()):
            left.append(
                f"{owners.get(line, '')}, line {line}, to {to if to > 0 else 'the end'}: {lines[line - 1].strip()[:80]}"
            )
    percent = round(100.0 * covered / branches, 1) if branches else 100.0
    return {"branches": branches, "covered": covered, "percent": percent, "apart": apart, "left": left}


def _reason(owner: str) -> str:
    name = owner.rpartition(".")[2]
    return next(
        (
            why
            for why, names in APART.items()
            if any(name == n or (n.endswith("_") and name.startswith(n)) for n in names)
        ),
        "",
    )


def _owners(path: Path) -> dict[int, str]:
    """The function that each line of a file is in."""
    found: dict[int, str] = {}

    def walk(node: ast.AST, trail: str) -> None:
        for child in ast.iter_child_nodes(node):
            inner = trail
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                inner = f"{trail}.{child.name}" if trail else child.name
                if any("jit" in ast.unparse(decorator) for decorator in child.decorator_list):
                    inner += ".compiled"
                assert child.end_lineno is not None
                for line in range(child.lineno, child.end_lineno + 1):
                    found[line] = inner
            walk(child, inner)

    walk(ast.parse(path.read_text(encoding="utf-8")), "")
    return found
