"""`gsvis pvs`: find the visible set of each cell of the navigable space, and write them as a store."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gsvis.cli.arguments import Pvs
from gsvis.cli.asking import settle_space
from gsvis.cli.device import say_device
from gsvis.cli.memory import IN_TILES, check_sets
from gsvis.cli.options import Cluster, Work, config_of, naming, refuse
from gsvis.cli.source import levels_spelled, open_source, summarize_levels
from gsvis.cli.targets import check_tracer
from gsvis.cli.terminal import Status, busy_note, clock, facts, print_json, show, size_of
from gsvis.cli.where import check_where, kind_row, space_document
from gsvis.files.output import check_file
from gsvis.io.sources import check_source
from gsvis.jobs.workers import Workers
from gsvis.prepare.warm import warm_sets
from gsvis.pvs.build import build_pvs, journal_of
from gsvis.pvs.cell_count import fitting_cells
from gsvis.pvs.cells import MAX_CELLS, CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.estimate import Estimate, estimate_pvs
from gsvis.pvs.store import VisibilityStore, check_store_target
from gsvis.pvs.stored_certificates import StoredCertificates
from gsvis.raycast import CrossCheck, describe_check
from gsvis.render.device import Device, choose_device
from gsvis.scene.content import scene_hash
from gsvis.scene.lengths import spell_length, spell_volume
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.source import Source

__all__ = [
    "CELLS",
    "FEWER_CELLS",
    "MEMORY",
    "check_workers",
    "local_workers",
    "open_workers",
    "run_pvs",
    "spell_certificates",
]

MEMORY = {"max_memory": f"--max-memory; {IN_TILES}"}
"""The option of a memory limit that a scene does not fit."""

CELLS = 512  # most cells, unless somebody asks for another number
FEWER_CELLS = {"object": 128, "open place": 128}  # where sets hardly grow


@dataclass(frozen=True, eq=False)
class _Plan:
    """What to build: the scene, its cells and space, settings, remarks for the user, and what a dry run has written."""

    source: Source
    grid: CellGrid
    space: NavigableSpace
    config: PvsConfig
    remarks: list[str]
    written: str


def run_pvs(command: Pvs) -> None:
    """Build a store: read, cut the space into cells, find visible sets, write the store, print the result."""
    config = _check_arguments(command)
    walk = check_where(command.where)
    device = _device_of(command)
    with Status() as status, open_workers(command.work) as workers, naming(**MEMORY):
        say_device(device, status)
        plan = _plan(command, config, walk, status)
        if command.work.dry_run:
            estimate = estimate_pvs(
                plan.source.whole, plan.grid, plan.space, command.out, config, workers=workers, progress=status
            )
        else:
            warm_sets(config, status)
            began = time.perf_counter()
            store = _built(command, plan, workers, status)
            seconds = time.perf_counter() - began
    if command.work.dry_run:
        _print_estimate(command, plan, estimate)
        return
    with store:
        _print_result(command, plan, store, seconds)


def _device_of(command: Pvs) -> Device:
    """Return the CPU, which finds visible sets; raise if a GPU is asked for and does not work here."""
    if command.device != "cuda":
        return Device("cpu")
    choose_device("cuda")
    return Device("cpu", "no kernel finds visible sets there yet")


def _check_arguments(command: Pvs) -> PvsConfig:
    """Check the arguments before work begins; return the settings of the build."""
    check_source(command.scene, command.lod)
    check_file(command.out)
    with naming(path="--out"):
        check_store_target(command.out)
    check_workers(command.work)
    check_tracer(command.sets.tracer, command.sets.certify)
    config = config_of(PvsConfig, command.sets, size=command.sets.face_size, rays=command.sets.certify)
    check_sets(command.scene, command.lod, config, command.work.max_memory)
    return config


def check_workers(work: Cluster) -> None:
    """Raise if options of this machine are given with a scheduler, or its address is none."""
    if work.scheduler is not None:
        from gsvis.jobs.cluster import check_address

        refuse(work, ["workers", "max_memory"], "with --scheduler")
        check_address(work.scheduler)


@contextmanager
def open_workers(work: Cluster) -> Iterator[Workers]:
    """Yield the workers of a Dask scheduler, or processes of this machine."""
    if work.scheduler is None:
        yield local_workers(work)
        return
    from gsvis.jobs.cluster import connect

    with connect(work.scheduler) as workers:
        yield workers


def local_workers(work: Work) -> Workers:
    """Return worker processes on this machine, one per core by default."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Workers(work.workers or cores, work.max_memory)


def _plan(command: Pvs, config: PvsConfig, walk: HeadPath | None, status: Status) -> _Plan:
    """Read the scene, find its navigable space and cut it into cells."""
    source = open_source(command.scene, command.lod, status, "see")
    with naming(path="--out"):
        check_store_target(command.out, scene_hash(source.union))
    settled, space, remarks = settle_space(
        command.where,
        source,
        walk,
        status,
        quiet=command.output.json,
        beside=command.out if command.work.dry_run else None,
    )
    size = command.sets.cell_size
    most = command.sets.cells
    if size is None:
        grid = CellGrid.over(space, max_cells=most or fitting_cells(source.gaussians, space, CELLS, FEWER_CELLS))
    else:
        grid = CellGrid.over(space, max_cells=most or MAX_CELLS, cell_size=size)
    return _Plan(source, grid, space, config, remarks, settled.written)


def _built(command: Pvs, plan: _Plan, workers: Workers, status: Status) -> VisibilityStore:
    """Build the store; say what is kept if that is interrupted."""
    kept: dict[str, tuple[int, int]] = {}

    def progress(stage: str, done: int, total: int) -> None:
        if stage in ("viewpoints", "cells"):
            kept[stage] = done, total
        status(stage, done, total)

    g = plan.source.whole
    report = progress
    try:
        return build_pvs(g, plan.grid, plan.space, command.out, plan.config, workers=workers, progress=report)
    except KeyboardInterrupt:
        if not any(done for done, _ in kept.values()):
            raise
        folder = journal_of(g, plan.grid, plan.space, command.out, plan.config)
        held = " and ".join(f"{done:,} of {total:,} {stage}" for stage, (done, total) in kept.items())
        raise KeyboardInterrupt(f"{held} are kept in {folder.name}; run the same command to resume") from None


def _about(plan: _Plan) -> dict[str, Any]:
    """Return a JSON summary of what is built."""
    return {
        "scene": plan.source.name,
        "lod": plan.source.lod,
        "gaussians": len(plan.source.union),
        "levels": summarize_levels(plan.source),
        "grid": plan.grid.as_dict(),
        "space": space_document(plan.space),
        "remarks": [each.strip() for each in plan.remarks],
        "config": plan.config.as_dict(),
    }


def _rows(plan: _Plan) -> list[tuple[str, str]]:
    """Return the rows of a table about what is built."""
    x, y, z = plan.grid.shape
    shown = plan.config
    meters = plan.source.gaussians.facts.meters_per_unit
    return [
        ("Gaussians", f"{len(plan.source.union):,}{levels_spelled(plan.source)}"),
        kind_row(plan.space),
        ("where eyes may be", f"{plan.space.rule}, {spell_volume(plan.space.volume, meters)}"),
        ("cells", f"{len(plan.grid):,} of side {spell_length(plan.grid.cell_size, meters)}, in {x} x {y} x {z} boxes"),
        ("method", f"{shown.method}, six faces of {shown.size} pixels, tau {shown.tau:.3g}"),
    ]


def _print_estimate(command: Pvs, plan: _Plan, estimate: Estimate) -> None:
    """Print what a build would cost."""
    if command.output.json:
        print_json({"format": "gsvis-pvs-estimate", "version": 2, **_about(plan), "estimate": asdict(estimate)})
        return
    rows = [*_rows(plan), ("shared viewpoints", f"{estimate.viewpoints:,}"), ("workers", f"{estimate.workers:,}")]
    if estimate.finished:
        rows.append(("found earlier", f"{estimate.finished:,} cells of an interrupted build, which would resume"))
    rows += [
        ("time", f"about {clock(estimate.seconds)}{busy_note(estimate.load)}"),
        ("memory", f"at most about {size_of(estimate.memory)}, all processes together"),
        ("disk", f"about {size_of(estimate.disk)}; {size_of(estimate.working_disk)} more while it works"),
    ]
    show(facts(f"{plan.source.name}: what it would cost", rows), *plan.remarks, plan.written)


def spell_certificates(certified: StoredCertificates, twice: Any) -> list[tuple[str, str]]:
    """Return rows on what the sets of a store miss, and on the rays that two tracers agree on."""
    known = certified.known
    if not known.any():
        return [("light missed", "not certified by rays")]
    missed = certified.missed[known]
    bound = certified.bound[known]
    tile = certified.tile[known]
    rows = [
        ("light missed", f"{missed.mean():.3%} on average, {missed.max():.3%} in the worst cell, by fresh rays"),
        ("proven to miss", f"at most {bound.max():.3%} in any cell, with 95% confidence each"),
        ("worst 16 x 16 tile", f"{tile.mean():.1%} missed on average, {tile.max():.1%} in the worst cell"),
        ("rays", f"{int(certified.rays.sum()):,} certified the sets"),
    ]
    return [*rows, ("two tracers agree", describe_check(None if twice is None else CrossCheck(**twice)))]


def _print_result(command: Pvs, plan: _Plan, store: VisibilityStore, seconds: float) -> None:
    """Print the store that was built."""
    n = store.gaussians
    cells = len(store)
    sizes = store.sizes()
    shares = store.visible_counts / n
    viewpoints = store.viewpoints
    certified = store.certificates
    blind = int(np.count_nonzero((viewpoints == 0) & (certified.rays == 0)))
    above = int(np.count_nonzero(certified.bound > plan.config.limit))
    twice = store.info.config.get("traced_twice")
    ever = len(store.ever_visible()) / n
    if command.output.json:
        spread = {"mean": float(shares.mean()), "min": float(shares.min()), "max": float(shares.max())}
        looked = {"mean": float(viewpoints.mean()), "min": int(viewpoints.min()), "max": int(viewpoints.max())}
        print_json(
            {
                "format": "gsvis-pvs",
                "version": 2,
                **_about(plan),
                "out": command.out,
                "cells": cells,
                "visible_share": spread,
                "ever_visible_share": ever,
                "viewpoints": {**looked, "total": int(viewpoints.sum())},
                "certificates": certified.as_dict(),
                "cells_above_limit": above,
                "traced_twice": twice,
                "cells_without_a_free_viewpoint": blind,
                "bytes": sizes["file"],
                "bits_per_visible": sizes["bits_per_pair"],
                "class_bits_per_visible": sizes["class_bits_per_pair"],
                "seconds": round(seconds, 3),
            }
        )
        return
    rows = [
        *_rows(plan),
        ("visible from a cell", f"{shares.mean():.1%} of all; {shares.min():.1%} to {shares.max():.1%}"),
        ("visible from any cell", f"{ever:.1%}"),
        ("viewpoints a cell", f"{viewpoints.mean():.1f} on average; {viewpoints.min()} to {viewpoints.max()}"),
        *spell_certificates(certified, twice),
        (
            "bits a visible Gaussian",
            f"{sizes['bits_per_pair']:.2f}, and {sizes['class_bits_per_pair']:.2f} for its weight class",
        ),
        ("file", f"{command.out}, {size_of(int(sizes['file']))}"),
        ("time", clock(seconds)),
    ]
    remarks = list(plan.remarks)
    if above:
        remarks.append(
            f" {above:,} of {cells:,} cells are not proven to miss at most {plan.config.limit:.2%} of the light: a"
            " larger --max-inner, --certify or --face-size finds more."
        )
    if blind:
        remarks.append(f" {blind:,} cells have no viewpoint outside something solid; their sets are empty.")
    show(facts(plan.source.name, rows), *remarks)
