"""`gsvis verify` and `gsvis unpack`: check that a package is whole, and write it back as PLYs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsvis.cli.arguments import Unpack, Verify
from gsvis.cli.options import naming
from gsvis.cli.source import open_source
from gsvis.cli.terminal import Status, facts, print_json, show, size_of
from gsvis.files.output import check_folder
from gsvis.files.places import TABLES, cache_folder
from gsvis.io.levels import check_levels_target
from gsvis.io.sources import check_source
from gsvis.package import Fidelity, Manifest, Package, Spread, unpack_package
from gsvis.stream.kept import check_kept
from gsvis.world import World, is_world
from gsvis.world.streamed import WorldSource

__all__ = ["fidelity_table", "run_unpack", "run_verify", "size_rows"]

_STEPS = {
    "levels": "the highest level for the scene",
    "terms": "terms for spherical harmonics",
    "rounding": "records for exact values",
    "cells": "what a cell needs for every record",
}
_EQUAL = 100.0  # dB, the most that is measured


def run_verify(command: Verify) -> None:
    """Verify a package: read everything, compare it with its scene if that is given, and print what it holds."""
    if command.scene is None and command.lod is not None:
        raise ValueError(f"--lod: expected none without --scene, got {command.lod}; leave it out")
    if is_world(command.package):
        _verify_world(command)
        return
    if command.scene is not None:
        check_source(command.scene, command.lod)
    with Status() as status, Package.open(command.package) as package:
        found = package.verify(progress=status)
        kept = check_kept(package, _tables_of(command))
        manifest = package.manifest
        fidelity = manifest.info.fidelity
        name = "the scene"
        remarks: list[str] = []
        if command.scene is not None:
            from gsvis.prepare.compared import compare_with_source

            source = open_source(command.scene, command.lod, status, "compare with")
            fidelity, remark = compare_with_source(package, source, progress=status)
            name = source.name
            remarks = [f" {remark}"] if remark else []
    if command.output.json:
        print_json(
            {
                "format": "gsvis-verification",
                "version": 1,
                "package": command.package,
                **_facts(manifest),
                **asdict(found),
                "kept_files": len(kept),
                "fidelity": None if fidelity is None else fidelity.summary(),
                "fidelity_from": _source_of(command, fidelity),
            }
        )
        return
    cost = manifest.info.cost
    meters = manifest.info.meters_per_unit
    rows = [
        ("Gaussians", f"{found.gaussians:,}"),
        ("levels", ", ".join(f"{n} {c:,}" for n, c in zip(manifest.names, manifest.counts, strict=True))),
        ("terms", f"{found.terms:,}, variant {manifest.grids.variant}"),
        ("cells", f"{found.cells:,}" if found.cells else "no visible sets"),
        ("parts", f"{found.parts:,}, {size_of(found.nbytes)}"),
        *_kept_rows(kept),
        *size_rows(manifest),
        ("up", ", ".join(f"{v:g}" for v in manifest.info.up)),
        ("meters per unit", f"{meters:g}" if meters else "not known"),
        ("cost of rounding", f"{cost.psnr:.1f} dB, worst {cost.worst:.1f}" if cost else "not measured"),
    ]
    if fidelity is None:
        rows.append(("what a client gets", "not measured; --scene SCENE measures it"))
    strays = [f" {found.strays:,} files beside the parts belong to no part of it."] if found.strays else []
    whole = " Every part is whole."
    show(facts(command.package, rows), *fidelity_table(fidelity, name), whole, *strays, *remarks)


def _verify_world(command: Verify) -> None:
    """Verify a world and print what it holds."""
    if command.scene is not None:
        raise ValueError(f"--scene: expected none for a world, got {command.scene}; leave it out")
    with Status() as status:
        world = World.open(command.package)
        found = world.verify(progress=status)
        kept = check_kept(WorldSource(world), _tables_of(command))
    if command.output.json:
        document = {"format": "gsvis-world-verification", "version": 1, "world": command.package}
        print_json({**document, **asdict(found), "kept_files": len(kept)})
        return
    rows = [
        ("Gaussians", f"{found.gaussians:,}"),
        ("tiles", f"{found.tiles:,}"),
        ("districts", f"{found.districts:,}"),
        ("cells", f"{found.cells:,}"),
        ("size", size_of(found.nbytes)),
        *_kept_rows(kept),
    ]
    strays = [f" {found.strays:,} packages and tables belong to no part of it."] if found.strays else []
    show(facts(command.package, rows), " Every part is whole.", *strays)


def _tables_of(command: Verify) -> str:
    """Return the folder of kept tables."""
    return command.tables or str(cache_folder() / TABLES)


def _kept_rows(kept: list[Path]) -> list[tuple[str, str]]:
    """Return the row for tables that were kept; none without."""
    return [("kept for serving", f"{len(kept):,} files in {kept[0].parent}, whole")] if kept else []


def _source_of(command: Verify, fidelity: Fidelity | None) -> str | None:
    """Return where figures come from, for JSON."""
    if fidelity is None:
        return None
    return "measured by gsvis prepare" if command.scene is None else f"measured against {command.scene}"


def fidelity_table(fidelity: Fidelity | None, scene: str) -> list[Any]:
    """Return a table of what a client gets and a line about it; an empty list if it was not measured.

    Args:
        fidelity: The figures.
        scene: Name of the scene.
    """
    if fidelity is None:
        return []
    rows = [(label, *_decibels(fidelity.steps[name])) for name, label in _STEPS.items() if name in fidelity.steps]
    rows.append(("all of it, every record", *_decibels(fidelity.records)))
    if fidelity.cell is not None:
        rows.append(("all of it, what a cell needs", *_decibels(fidelity.cell)))
    views = f"{len(fidelity.poses)} views of {fidelity.width} x {fidelity.height}"
    about = f" PSNR in {views} that nothing was fitted to, each line against the one before; the whole against {scene}."
    return [facts("What a client gets", rows, ("", "mean", "worst")), about]


def _decibels(spread: Spread) -> tuple[str, str]:
    """Return mean and worst PSNR as text."""
    mean, worst = ("equal" if value >= _EQUAL else f"{value:.1f} dB" for value in (spread.psnr, spread.worst))
    return mean, worst


def run_unpack(command: Unpack) -> None:
    """Unpack a package: write one PLY for each level and print the paths."""
    target = Path(command.out)
    if target.exists() and not target.is_dir():
        raise ValueError(f"--out: expected a folder, got the file {command.out!r}")
    check_folder(target)
    with Status() as status, Package.open(command.package) as package:
        _check_replaced(target, package.manifest)
        levels = unpack_package(package, target, sh_degree=command.sh_degree, progress=status)
    files = {name: target / f"{name}.ply" for name in levels.names}
    if command.output.json:
        rows = [
            {"name": name, "file": str(files[name]), "gaussians": count, "bytes": files[name].stat().st_size}
            for name, count in zip(levels.names, levels.counts, strict=True)
        ]
        degree = levels.union.sh_degree
        print_json({"format": "gsvis-unpacking", "version": 1, "levels": rows, "sh_degree": degree})
        return
    show(
        *(
            f"{files[name]}: {count:,} Gaussians, SH degree {levels.union.sh_degree},"
            f" {size_of(files[name].stat().st_size)}"
            for name, count in zip(levels.names, levels.counts, strict=True)
        )
    )


def _check_replaced(folder: Path, manifest: Manifest) -> None:
    """Raise ValueError if files would be replaced that are not an earlier unpacking of this scene."""
    with naming(folder="--out"):
        info = check_levels_target(folder, manifest.names, "what was unpacked from this scene")
    if info is not None and info.extra.get("scene") != manifest.scene:
        raise ValueError(
            f"--out: expected a new folder, or what was unpacked from this scene, got {folder}, which holds levels of"
            " something else; name another"
        )


def size_rows(manifest: Manifest) -> list[tuple[str, str]]:
    """Return table rows with the bytes of each kind of part of a package."""
    sizes = manifest.sizes()
    n = max(1, manifest.gaussians)
    records = sizes["records"] + sizes["chunks"]
    rows = [("  records", f"{size_of(records)}, {records / n:.1f} bytes a Gaussian")]
    for name, label in (("terms", "terms"), ("visibility", "visible sets"), ("active_terms", "lists of active terms")):
        if sizes.get(name):
            rows.append((f"  {label}", size_of(sizes[name])))
    return rows


def _facts(manifest: Manifest) -> dict[str, Any]:
    """Return what the manifest states, for JSON."""
    info = manifest.info
    return {
        "levels": [{"name": n, "gaussians": c} for n, c in zip(manifest.names, manifest.counts, strict=True)],
        "variant": manifest.grids.variant,
        "sizes": manifest.sizes(),
        "up": list(info.up),
        "meters_per_unit": info.meters_per_unit,
        "cost": None if info.cost is None else asdict(info.cost),
    }
