"""Branch coverage of the readers by a fuzz run in this process; coverage.py counts from the first import on."""

from __future__ import annotations

import ast
import importlib.util
import json
import logging
import sys
from collections import Counter
from pathlib import Path
from typing import Any

APART = {
    "a writer": [
        "gsvis.stream.kept:_make",
        "gsvis.stream.wire:Token.to_bytes",
        "gsvis.files.mapped:ArrayFiles",
        "gsvis.files.mapped:write_arrays",
        "gsvis.jobs.objects:FolderStore.sweep",
        "gsvis.jobs.objects:ObjectStore.put",
        "gsvis.io.ply:save_ply_parts",
        "gsvis.io.selection:save_selection",
        "gsvis.io.voxels:_encode",
        "gsvis.io.voxels:_named",
        "gsvis.stream.kept:_remove_unused",
        "gsvis.abr.holdings:Holdings.to_bytes",
        "gsvis.color.storage:_array",
        "gsvis.color.storage:_batches",
        "gsvis.color.storage:save_srbf",
        "gsvis.files.arrow:write_arrow",
        "gsvis.io._webp:encode_plane",
        "gsvis.files.archive:save_arrays",
        "gsvis.io.ksplat:_encode",
        "gsvis.io.ksplat:_sh_limits",
        "gsvis.io.ksplat:_sort_into_buckets",
        "gsvis.io.ksplat:_to_bytes",
        "gsvis.io.ksplat:save_ksplat",
        "gsvis.io.levels:_batches",
        "gsvis.io.levels:check_names",
        "gsvis.io.levels:save_levels",
        "gsvis.io.ply:save_ply",
        "gsvis.io.poses:write_poses",
        "gsvis.io.scenes:save_scene",
        "gsvis.io.spz:_pack_smallest_three",
        "gsvis.io.spz:_pack_streams",
        "gsvis.io.spz:save_spz",
        "gsvis.io.spz:_extensions",
        "gsvis.io.spz:_header_flags",
        "gsvis.io.ply:_with_doubles",
        "gsvis.io.ksplat:_report",
        "gsvis.io.ksplat:_with_facts",
        "gsvis.package.active_terms:_groups",
        "gsvis.package.active_terms:colors_hash",
        "gsvis.package.active_terms:sets_hash",
        "gsvis.package.active_terms:write_active_terms",
        "gsvis.package.blocks:write_blocks",
        "gsvis.package.codec:build_chunks",
        "gsvis.package.codec:chunk_starts",
        "gsvis.package.codec:encode_records",
        "gsvis.package.coded:encode_gaussians",
        "gsvis.package.coded:encode_terms",
        "gsvis.package.contents:Contents.from_levels",
        "gsvis.package.manifest:Manifest.to_json",
        "gsvis.package.package:columns_of",
        "gsvis.package.parts:Part.as_dict",
        "gsvis.package.parts:PartFolder._write",
        "gsvis.package.parts:PartFolder.remove_all_but",
        "gsvis.package.parts:PartFolder.write_bytes",
        "gsvis.package.parts:PartFolder.write_columns",
        "gsvis.stream.batch:Sections._encode_ids",
        "gsvis.stream.batch:Sections.to_message",
        "gsvis.stream.coding:Coding.encode_records",
        "gsvis.stream.coding:Coding.encode_terms",
        "gsvis.stream.coding:Coding.from_contents",
        "gsvis.stream.coding:Coding.mean_bytes",
        "gsvis.stream.coding:coarsen",
        "gsvis.stream.header:SceneHeader.from_manifest",
        "gsvis.stream.header:SceneHeader.to_message",
        "gsvis.stream.session:Session._encode",
        "gsvis.stream.tables:Tables.from_counts",
        "gsvis.stream.tables:Tables.to_text",
        "gsvis.stream.wire:Ack.to_bytes",
        "gsvis.stream.wire:Bye.to_bytes",
        "gsvis.stream.wire:Hello.to_bytes",
        "gsvis.stream.wire:PoseAt.to_bytes",
        "gsvis.stream.wire:ServerFault.from_error",
        "gsvis.stream.wire:ServerFault.to_bytes",
        "gsvis.train.checkpoint:run_key",
        "gsvis.train.checkpoint:save_checkpoint",
        "gsvis.pvs.codec:_join_digits",
        "gsvis.pvs.codec:compress",
        "gsvis.pvs.codec:encode_classes",
        "gsvis.pvs.codec:encode_labels",
        "gsvis.pvs.codec:encode_set",
        "gsvis.files.sections:SectionWriter",
        "gsvis.pvs._journal:_compress",
        "gsvis.pvs._journal:_pack_seen",
        "gsvis.pvs._journal:pack_sighting",
        "gsvis.pvs._journal:pack_view",
        "gsvis.jobs.resume:KeptWork.keep",
        "gsvis.jobs.resume:KeptWork.keep_arrays",
        "gsvis.jobs.resume:KeptWork.keep_own",
        "gsvis.jobs.resume:KeptWork.remove",
        "gsvis.jobs.resume:KeptWork.seal_file",
    ],
    "asked by callers, not by files": [
        "gsvis.jobs.objects:_checked",
        "gsvis.train.levels:_subsets.choose",
        "gsvis.train.importance:_gradients",
        "gsvis.train.importance:_schedule",
        "gsvis.train.importance:_turns",
        "gsvis.train.importance:importance",
        "gsvis.train.importance:most_important",
        "gsvis.train.importance:prune",
        "gsvis.train.levels:LevelsConfig",
        "gsvis.train.photos:_check_target",
        "gsvis.package.active_terms:ActiveTerms.check",
        "gsvis.package.active_terms:ActiveTerms.difference",
        "gsvis.pvs.store:VisibilityStore._at_least",
        "gsvis.pvs.store:VisibilityStore._check_class",
        "gsvis.pvs.store:VisibilityStore.check_gaussian",
        "gsvis.pvs.store:VisibilityStore.check_scene",
        "gsvis.pvs.store:VisibilityStore.difference",
        "gsvis.pvs.store:VisibilityStore.nearest_seer",
        "gsvis.pvs.store:VisibilityStore.union",
        "gsvis.pvs.store:VisibilityStore.why",
    ],
    "behind fsspec, in tests of its own": [
        "gsvis.jobs.objects:RemoteStore",
    ],
    "locks against other processes, in tests of their own": [
        "gsvis.jobs.resume:KeptWork._lock",
    ],
    "no reader": [
        "gsvis.jobs.graph:_Run",
        "gsvis.jobs.graph:_check_worker",
        "gsvis.jobs.graph:_perform",
        "gsvis.jobs.graph:perform",
        "gsvis.jobs.graph:run_graph",
        "gsvis.abr.holdings:Holdings.__repr__",
        "gsvis.io._sog_files:ZipStore.__exit__",
        "gsvis.package.contents:Contents.__repr__",
        "gsvis.package.package:Package.__exit__",
        "gsvis.package.package:Package.__repr__",
        "gsvis.stream.receiver:Receiver.__repr__",
        "gsvis.train.levels:train_levels",
        "gsvis.train.photos:Photos.__repr__",
        "gsvis.package.active_terms:ActiveTerms.__exit__",
        "gsvis.package.active_terms:ActiveTerms.__repr__",
        "gsvis.pvs.store:VisibilityStore.__exit__",
        "gsvis.pvs.store:VisibilityStore.__repr__",
    ],
}
"""What reads nothing in the modules of readers, by the reason: `module:function`, `module:Class.method` or a class."""

COMPILED = "compiled, not seen by coverage"
LEAST_SHARE = 90.0
"""Percent of the branches that a run of inputs should take, of all readers together and of each."""


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
    lines, owners = path.read_text(encoding="utf-8").splitlines(), owners_of(path)
    branches = covered = 0
    apart: Counter[str] = Counter()
    left = []
    for line, (total, taken) in sorted(stats.items()):
        if reason := reason_of(module, owners.get(line, "")):
            apart[reason] += total
            continue
        branches, covered = branches + total, covered + taken
        for to in missing.get(line, ()):
            left.append(
                f"{owners.get(line, '')}, line {line}, to {to if to > 0 else 'the end'}: {lines[line - 1].strip()[:80]}"
            )
    percent = round(100.0 * covered / branches, 1) if branches else 100.0
    return {"branches": branches, "covered": covered, "percent": percent, "apart": dict(apart), "left": left}


def reason_of(module: str, owner: str) -> str:
    """Why the branches of a function do not count; empty where they do."""
    if "compiled" in owner.split("."):
        return COMPILED
    place = f"{module}:{owner}"
    found = (why for why, names in APART.items() if any(place == n or place.startswith(f"{n}.") for n in names))
    return next(found, "")


def readers_of(coverage: dict[str, Any]) -> list[dict[str, Any]]:
    """What was taken of each module that has branches of readers, the least first; shares in percent."""
    rows = [
        {"name": name, "taken": found["covered"], "branches": found["branches"], "share": found["percent"]}
        for name, found in coverage.items()
        if found["branches"]
    ]
    return sorted(rows, key=lambda row: (row["share"], row["name"]))


def apart_of(coverage: dict[str, Any]) -> dict[str, int]:
    """Branches that were set apart, by the reason."""
    total: Counter[str] = Counter()
    for found in coverage.values():
        total.update(found["apart"])
    return dict(total)


def figures_of(coverage: dict[str, Any]) -> list[dict[str, Any]]:
    """The share of all readers, how many branches were set apart for it, and the share of the worst reader."""
    readers = readers_of(coverage)
    if not readers:
        return []
    taken, branches = (sum(row[key] for row in readers) for key in ("taken", "branches"))
    share = {"target": LEAST_SHARE, "unit": "%", "better": "higher"}
    apart = {"target": None, "reached": sum(apart_of(coverage).values()), "unit": "branches", "better": "lower"}
    return [
        {"name": "fuzzing: branch coverage of the readers", "reached": 100 * taken / branches, **share},
        {"name": f"fuzzing: branches set apart, beside {branches:,} that count", **apart},
        {"name": f"fuzzing: branch coverage of the worst reader, {readers[0]['name']}",
         "reached": readers[0]["share"], **share},
    ]  # fmt: skip


def owners_of(path: Path) -> dict[int, str]:
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
