"""`gsvis verify` and `gsvis unpack`: check that a package is whole, and write it back as PLYs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsvis.cli.arguments import Unpack, Verify
from gsvis.cli.source import check_folder
from gsvis.cli.terminal import Status, facts, print_json, show, size_of
from gsvis.errors import FormatError
from gsvis.io.levels import MAP, levels_info
from gsvis.package import Manifest, Package, unpack_package

__all__ = ["run_unpack", "run_verify", "size_rows"]


def run_verify(command: Verify) -> None:
    """Verify a package: read everything and print what it holds.

    Raises:
        FormatError: If anything is missing, damaged or of a newer version.
        FileNotFoundError: If there is no such folder.
    """
    with Status() as status, Package.open(command.package) as package:
        found = package.verify(progress=status)
        manifest = package.manifest
    if command.json:
        print_json(
            {
                "format": "gsvis-verification",
                "version": 1,
                "package": command.package,
                **_facts(manifest),
                **asdict(found),
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
        *size_rows(manifest),
        ("up", ", ".join(f"{v:g}" for v in manifest.info.up)),
        ("meters per unit", f"{meters:g}" if meters else "not known"),
        ("cost of rounding", f"{cost.psnr:.1f} dB, worst {cost.worst:.1f}" if cost else "not measured"),
    ]
    strays = [f" {found.strays:,} files beside the parts belong to no part of it."] if found.strays else []
    show(facts(command.package, rows), " Every part is whole.", *strays)


def run_unpack(command: Unpack) -> None:
    """Unpack a package: write one PLY for each level and print the paths.

    Raises:
        FormatError: If the package is damaged.
        ValueError: If an argument is wrong.
        OSError: If the folder cannot be written.
    """
    target = Path(command.out)
    if target.exists() and not target.is_dir():
        raise ValueError(f"--out: expected a folder, got the file {command.out!r}")
    check_folder(target)
    with Status() as status, Package.open(command.package) as package:
        _check_replaced(target, package.manifest)
        levels = unpack_package(package, target, sh_degree=command.sh_degree, progress=status)
    files = {name: target / f"{name}.ply" for name in levels.names}
    if command.json:
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
    """Raise if files would be replaced that are not an earlier unpacking of this scene.

    Raises:
        ValueError: If the folder holds such files, or its map cannot be read.
    """
    known: tuple[str, ...] = ()
    wanted = f"--out: expected a new folder, or what was unpacked from this scene, got {folder}"
    if (folder / MAP).exists():
        try:
            info = levels_info(folder)
        except FormatError as error:
            raise ValueError(f"{wanted}, which cannot be read ({error}); name another, or delete it") from None
        if info.extra.get("scene") != manifest.scene:
            raise ValueError(f"{wanted}, which holds levels of something else; name another")
        known = info.files
    for name in manifest.names:
        if f"{name}.ply" not in known and (folder / f"{name}.ply").exists():
            raise ValueError(f"{wanted}, which has a {name}.ply that no {MAP} knows; name another, or move it away")


def size_rows(manifest: Manifest) -> list[tuple[str, str]]:
    """Return table rows with the bytes of each kind of part of a package."""
    sizes, n = manifest.sizes(), max(1, manifest.gaussians)
    records = sizes["records"] + sizes["chunks"]
    rows = [("  records", f"{size_of(records)}, {records / n:.1f} bytes a Gaussian")]
    for name, label in (("terms", "terms"), ("visibility", "visible sets"), ("active_terms", "active terms")):
        if sizes[name]:
            rows.append((f"  {label}", size_of(sizes[name])))
    return rows


def _facts(manifest: Manifest) -> dict[str, Any]:
    info = manifest.info
    return {
        "levels": [{"name": n, "gaussians": c} for n, c in zip(manifest.names, manifest.counts, strict=True)],
        "variant": manifest.grids.variant,
        "sizes": manifest.sizes(),
        "up": list(info.up),
        "meters_per_unit": info.meters_per_unit,
        "cost": None if info.cost is None else asdict(info.cost),
    }
