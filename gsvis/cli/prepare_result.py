"""Print the result of `gsvis prepare`: the package and how it was made, or what it would cost."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from gsvis.cli.arguments import Prepare
from gsvis.cli.package import fidelity_table, size_rows
from gsvis.cli.pvs import spell_certificates
from gsvis.cli.source import Source
from gsvis.cli.terminal import busy_note, clock, facts, print_json, show, size_of
from gsvis.cli.where import kind_row, space_document
from gsvis.scene.lengths import spell_volume
from gsvis.scene.navigable import NavigableSpace

if TYPE_CHECKING:
    from gsvis.prepare import PreparationEstimate, Prepared

__all__ = ["print_estimate", "print_result"]

_CALLED = {
    "levels": "levels",
    "sets": "visible sets",
    "colors": "colors",
    "cost": "cost of rounding",
    "fidelity": "what a client gets",
    "package": "package",
}


def print_result(
    command: Prepare, source: Source, space: NavigableSpace, prepared: Prepared, remarks: list[str]
) -> None:
    """Print the package and its stages, as a JSON document or as tables."""
    m = prepared.manifest
    cost = m.info.cost
    seconds = sum(stage.seconds for stage in prepared.stages)
    levels = [{"name": n, "gaussians": c} for n, c in zip(m.names, m.counts, strict=True)]
    for row, spread in zip(levels, (prepared.quality or {}).get("psnr", ()), strict=False):
        row["psnr"] = spread
    if command.output.json:
        about = {"format": "gsvis-preparation", "version": 1, **_about(command, source, space)}
        print_json({**about, **_document(command, prepared, levels, remarks)})
        return
    sizes = ", ".join(f"{row['name']} {row['gaussians']:,}" for row in levels)
    meters = m.info.meters_per_unit
    rows = [
        ("Gaussians", f"{m.gaussians:,}" + (f" in levels {sizes}" if len(levels) > 1 else "")),
        *_quality(prepared.quality, m.names),
        kind_row(space),
        ("where eyes may be", f"{space.rule}, {spell_volume(space.volume, meters)}"),
        ("up", f"{_axis(m.info.up)}; " + (f"{meters:g} meters a unit" if meters else "meters a unit not known")),
        ("terms", f"{m.terms:,}, variant {m.grids.variant}"),
    ]
    if cost is not None:
        text = f"{cost.psnr:.1f} dB, worst {cost.worst:.1f}, in {cost.views} views of {cost.width} x {cost.height}"
        rows.append(("cost of rounding", text))
    if prepared.certificates is not None:
        rows += spell_certificates(prepared.certificates, prepared.traced_twice)
    if prepared.judged is not None:
        rows.append(("checked by other eyes", str(prepared.judged["line"])))
    rows.append(("package", f"{command.out}, {size_of(prepared.nbytes)} in {prepared.parts:,} parts"))
    rows += size_rows(m)
    if prepared.parts_kept:
        rows.append(("as before", f"{prepared.parts_kept:,} of the parts, {size_of(prepared.nbytes_kept)}"))
    if not command.discard:
        rows.append(("kept beside it", f"{prepared.work.name}, {size_of(prepared.work_bytes)}; may be deleted"))
    rows.append(("time", clock(seconds)))
    given = source.levels is not None or not command.training.levels
    stages = [
        (
            _CALLED[stage.name],
            "as given" if stage.name == "levels" and given else "there already" if stage.reused else "made",
            clock(stage.seconds),
        )
        for stage in prepared.stages
    ]
    show(
        facts(f"{source.name}: package", rows),
        facts("", stages),
        *fidelity_table(m.info.fidelity, source.name),
        *remarks,
        *(f" {remark}" for remark in prepared.remarks),
    )


def _document(command: Prepare, prepared: Prepared, levels: list[dict[str, Any]], remarks: list[str]) -> dict[str, Any]:
    """Return the part of the JSON document about the package."""
    m = prepared.manifest
    return {
        "gaussians": m.gaussians,
        "levels": levels,
        "terms": m.terms,
        "variant": m.grids.variant,
        "up": list(m.info.up),
        "meters_per_unit": m.info.meters_per_unit,
        "cost": None if m.info.cost is None else asdict(m.info.cost),
        "fidelity": None if m.info.fidelity is None else m.info.fidelity.summary(),
        "certificates": None if prepared.certificates is None else prepared.certificates.as_dict(),
        "traced_twice": prepared.traced_twice,
        "judged": prepared.judged,
        "parts": prepared.parts,
        "parts_kept": prepared.parts_kept,
        "sizes": m.sizes(),
        "bytes": prepared.nbytes,
        "bytes_kept": prepared.nbytes_kept,
        "stages": [asdict(stage) for stage in prepared.stages],
        "work": None if command.discard else str(prepared.work),
        "work_bytes": 0 if command.discard else prepared.work_bytes,
        "remarks": [*(each.strip() for each in remarks), *prepared.remarks],
    }


def print_estimate(
    command: Prepare, source: Source, space: NavigableSpace, estimate: PreparationEstimate, remarks: list[str]
) -> None:
    """Print the estimated cost, as a JSON document or as tables."""
    if command.output.json:
        print_json(
            {
                "format": "gsvis-preparation-estimate",
                "version": 1,
                **_about(command, source, space),
                **asdict(estimate),
                "levels": [{"name": name, "gaussians": count} for name, count in estimate.levels],
                "work_bytes": estimate.work_bytes,
                "remarks": [each.strip() for each in remarks],
            }
        )
        return
    stages = [
        (_CALLED[s.name], s.state, s.what, clock(s.seconds) if s.state not in ("done", "given") else "")
        for s in estimate.stages
    ]
    rows = [
        kind_row(space),
        ("where eyes may be", f"{space.rule}, {spell_volume(space.volume, source.gaussians.facts.meters_per_unit)}"),
        ("time", f"about {clock(estimate.seconds)}{busy_note(estimate.load)}"),
        ("package", f"about {size_of(estimate.nbytes)}"),
        ("kept beside it", f"about {size_of(estimate.work_bytes)}"),
    ]
    rows.append(("memory", f"at most about {size_of(estimate.memory)}, all processes together"))
    show(
        facts(f"{source.name}: what it would cost", rows),
        facts("", stages),
        *remarks,
    )


def _about(command: Prepare, source: Source, space: NavigableSpace) -> dict[str, Any]:
    return {
        "scene": source.name,
        "lod": source.lod,
        "out": command.out,
        "space": space_document(space),
    }


def _quality(quality: dict[str, Any] | None, names: tuple[str, ...]) -> list[tuple[str, str]]:
    if quality is None or "psnr" not in quality:
        return []
    text = ", ".join(f"{name} {row['mean']:.1f} dB" for name, row in zip(names[:-1], quality["psnr"], strict=False))
    return [("levels against the scene", f"{text}, in {quality['views']} views")]


def _axis(up: tuple[float, float, float]) -> str:
    """Return an axis as text: a name such as '+z', or three numbers."""
    for k, name in enumerate("xyz"):
        if abs(abs(up[k]) - 1.0) < 1e-9:
            return ("+" if up[k] > 0 else "-") + name
    return ", ".join(f"{v:.3g}" for v in up)
