"""Report the result of `gsvis levels`: the record in the folder of levels, a JSON document, or tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from gsvis.cli import version
from gsvis.cli.arguments import Levels as Command
from gsvis.cli.terminal import clock, facts, print_json, show, size_of
from gsvis.cli.where import kind_row, space_document
from gsvis.io.levels import MAP
from gsvis.scene.content import scene_hash
from gsvis.scene.levels import Levels

if TYPE_CHECKING:
    from gsvis.cli.source import Source
    from gsvis.scene.judged import Judged
    from gsvis.scene.navigable import NavigableSpace
    from gsvis.train.history import Record
    from gsvis.train.level_quality import LevelQuality
    from gsvis.train.level_views import LevelViews
    from gsvis.train.levels import LevelsConfig, TrainedLevels

__all__ = ["print_result", "record_of"]

_MOST_OVERHEAD = 0.05


class _Run(Protocol):
    """What `record_of` needs of a plan."""

    source: Source
    config: LevelsConfig
    drawn: LevelViews


def record_of(
    command: Command,
    run: Any,
    trained: TrainedLevels,
    quality: LevelQuality | None,
    judged: tuple[Judged, ...] = (),
) -> dict[str, Any]:
    """Return the record of how the levels were made and how good they are, for JSON; equal runs give equal records.

    Args:
        command: The arguments.
        run: The plan of the run.
        trained: The trained levels.
        quality: Quality in held-out views; None without held-out views.
        judged: What eyes of two rules see of each level below the highest; empty without held-out views.
    """
    plan: _Run = run
    levels = trained.levels
    g = plan.source.gaussians
    drawn = plan.drawn
    # Renders to train on are smaller than what was asked for.
    cameras = drawn.views.cameras if drawn.choose_by is None else drawn.choose_by
    rows = []
    for k, name in enumerate(levels.names):
        row: dict[str, Any] = {
            "name": name,
            "gaussians": levels.counts[k],
            "share": levels.counts[k] / len(g),
            "reuse": levels.reuse[k] if k < len(levels.reuse) else None,
        }
        if quality is not None:
            row["psnr"] = _spread(quality.scene_psnr[k]) if k < len(levels.reuse) else None
            row["psnr_photographs"] = None if quality.photo_psnr is None else _spread(quality.photo_psnr[k])
            row["brightness"] = float(quality.brightness[k])
        if k < len(judged):
            row["judged"] = judged[k].as_dict()
        if name in trained.histories:
            row["curve"] = [_step(record) for record in trained.histories[name]]
        rows.append(row)
    return {
        "made_by": f"gsvis {version()}",
        "scene": plan.source.name,
        "lod": plan.source.lod,
        "scene_sha256": scene_hash(g),
        "gaussians": len(g),
        "union": len(levels.union),
        "overhead": levels.overhead,
        "views": {
            "from": drawn.cameras_from,
            "photographs": drawn.photographs,
            "trained_on": len(drawn.views),
            "held_out": 0 if drawn.held_out is None else len(drawn.held_out),
            "width": cameras.width,
            "height": cameras.height,
        },
        "config": asdict(plan.config),
        "levels": rows,
    }


def print_result(
    command: Command,
    levels: Levels,
    record: Mapping[str, Any],
    space: NavigableSpace | None,
    remarks: list[str],
    seconds: Mapping[str, float],
) -> None:
    """Print the document or the tables."""
    folder = Path(command.out)
    rows = [{**row, "file": f"{row['name']}.ply"} for row in record["levels"]]
    for row in rows:
        row["bytes"] = (folder / row["file"]).stat().st_size
    spent = sum(value for stage, value in seconds.items() if stage != "kernels")
    if command.output.json:
        about = {name: value for name, value in record.items() if name != "levels"}
        times = {stage: value for stage, value in seconds.items() if stage != "kernels"}
        about["space"] = None if space is None else space_document(space)
        more = {"out": command.out, "levels": rows, "remarks": [each.strip() for each in remarks], "seconds": times}
        print_json({"format": "gsvis-levels", "version": 1, **about, **more})
        return
    views = record["views"]
    photographs = record["views"]["photographs"]
    header = ["level", "Gaussians", "share", "reuse"]
    if views["held_out"]:
        header += ["PSNR", "photos", "brightness"] if photographs else ["PSNR", "brightness"]
    header.append("PLY")
    table = facts(f"{record['scene']}: levels", [_cells(row, rows[-1], views) for row in rows], header)
    size = f"{views['width']} x {views['height']}"
    lines = [
        ("views", f"{views['trained_on']:,} to train on, {views['held_out']:,} held out, {size}"),
        ("their cameras", views["from"]),
        *([] if space is None else [kind_row(space)]),
        ("steps", f"{record['config']['iterations']:,} for each lower level"),
        (
            "going up level by level",
            f"sends {record['overhead']:.1%} more than the scene alone ({record['union']:,} Gaussians)",
        ),
        ("time", clock(spent)),
    ]
    written = f" Written to {command.out}: {', '.join(row['file'] for row in rows)}, {MAP}."
    show(table, facts("", lines), *_explain(record), *remarks, written)


def _cells(row: Mapping[str, Any], top: Mapping[str, Any], views: Mapping[str, Any]) -> list[str]:
    cells = [row["name"], f"{row['gaussians']:,}", f"{row['share']:.1%}"]
    cells.append("" if row["reuse"] is None else f"{row['reuse']:.1%}")
    if views["held_out"]:
        cells.append("" if row["psnr"] is None else f"{row['psnr']['mean']:.2f} dB")
        if views["photographs"]:
            cells.append(f"{row['psnr_photographs']['mean']:.2f} dB")
        drift = "" if row is top else f" ({row['brightness'] / max(top['brightness'], 1e-9) - 1.0:+.1%})"
        cells.append(f"{row['brightness']:.3f}{drift}")
    return [*cells, size_of(row["bytes"])]


def _explain(record: Mapping[str, Any]) -> list[str]:
    """Return lines that explain the columns and say what went wrong."""
    views = record["views"]
    top = record["levels"][-1]["name"]
    lines = [
        f" Reuse is the share of a level that stands unchanged in the next; {top} is the scene itself, bit by bit."
    ]
    if views["held_out"]:
        photos = ", photos against the photographs themselves" if views["photographs"] else ""
        lines.append(
            f" PSNR is the mean over the held-out views against renders of the scene{photos}; brightness is the mean of"
            " all pixels, where 1 is white."
        )
        checked = [row for row in record["levels"] if "judged" in row]
        lines += [f" {row['name']}, by other eyes: {row['judged']['line']}." for row in checked]
    else:
        lines.append(" No view was held out, so nothing was measured.")
    if record["overhead"] > _MOST_OVERHEAD:
        lines.append(" Going up sends more than 5% more than the scene alone: a higher --reuse, or lower --levels.")
    return lines


def _spread(values: Any) -> dict[str, float]:
    return {"mean": float(values.mean()), "worst": float(values.min())}


def _step(record: Record) -> dict[str, Any]:
    """Return one point of a curve, without times, which differ from run to run."""
    point = record.as_json()
    return {"step": point["step"], "loss": point["loss"], "gaussians": point["count"], "psnr": point["psnr"]}
