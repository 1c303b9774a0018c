"""`gsvis paint`: color a scene by what can be seen of it; write it with its legend."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsvis.cli.arguments import Paint
from gsvis.cli.options import refuse
from gsvis.cli.source import open_source
from gsvis.cli.targets import check_exists, check_one_level, check_outputs, check_scene_out, write_array
from gsvis.cli.terminal import Status, print_json, show
from gsvis.cli.where import check_where, find_place
from gsvis.files.atomic import atomic_path
from gsvis.io.scenes import save_scene
from gsvis.io.sources import check_source
from gsvis.prepare.warm import warm_sets
from gsvis.pvs.store import VisibilityStore

if TYPE_CHECKING:
    from rich.table import Table

    from gsvis.edit import Band, Quantity
    from gsvis.scene.paths import HeadPath
    from gsvis.scene.source import Source

__all__ = ["run_paint"]


@dataclass(frozen=True)
class _Files:
    """Where results go: the scene, its legend, and the values if they are wanted."""

    scene: Path
    legend: Path
    values: Path | None


def run_paint(command: Paint) -> None:
    """Paint a scene: read, measure, write the scene and its legend, print the legend."""
    from gsvis.edit import bands_of, draw_legend, paint

    walk = _check_arguments(command)
    files = _check_files(command)
    with ExitStack() as opened, Status() as status:
        store = None if command.pvs is None else opened.enter_context(VisibilityStore.open(command.pvs))
        source = open_source(command.scene, command.lod, status)
        if store is not None:
            store.check_scene(source.whole)
        quantity, remarks = _measure(command, source, store, walk, status)
        with status.stage("writing"):
            save_scene(paint(source.gaussians, quantity), files.scene)
            with atomic_path(files.legend) as partial:
                partial.write_bytes(draw_legend(quantity))
            if files.values is not None:
                write_array(files.values, quantity.values)
    bands = bands_of(quantity)
    if command.output.json:
        document = _document(command, source, files, quantity, bands)
        print_json({**document, "remarks": [each.strip() for each in remarks]})
        return
    show(f"{command.out}: {len(quantity):,} Gaussians by {quantity.name}, legend in {files.legend}")
    show(_table(quantity, bands), *remarks)


def _check_arguments(command: Paint) -> HeadPath | None:
    """Check the arguments before work begins; return the walk of --path."""
    check_source(command.scene, command.lod)
    check_one_level(command.scene)
    if command.pvs is not None:
        check_exists(command.pvs)
        refuse(command, ["eyes", "face_size", "up"], "with --pvs")
        if command.by == "importance":
            raise ValueError("--by: expected no importance with --pvs, whose sets do not know it; leave --pvs out")
    return check_where(command.where, "" if command.pvs is None else "--pvs")


def _check_files(command: Paint) -> _Files:
    """Return where results go; raise if something else would be replaced."""
    target = check_scene_out(command.out, command.scene, command.overwrite)
    files = _Files(target, target.with_suffix(".legend.png"), None if command.values is None else Path(command.values))
    outputs = {"--out": target, "--out (its legend)": files.legend}
    if files.values is not None:
        outputs["--values"] = files.values
    inputs = {"SCENE": command.scene, **({} if command.pvs is None else {"--pvs": command.pvs})}
    check_outputs(outputs, inputs, command.overwrite)
    return files


def _measure(
    command: Paint, source: Source, store: VisibilityStore | None, walk: HeadPath | None, status: Status
) -> tuple[Quantity, list[str]]:
    """Return the quantity, and remarks for the user."""
    from gsvis.edit import QuantityConfig, measure_quantity, stored_quantity
    from gsvis.pvs.config import PvsConfig

    if store is not None:
        return stored_quantity(store, command.by, progress=status), []
    with status.stage("space"):
        place = find_place(source, command.where, walk)
        space = place.required("say where eyes are with --box or --around, or give visible sets with --pvs")
    if command.by != "importance":
        warm_sets(PvsConfig(), status)
    config = QuantityConfig(seed=command.seed)
    config = replace(config, size=command.face_size or config.size, views=replace(config.views, seed=command.seed))
    if command.eyes is not None:
        config = replace(config, eyes=command.eyes, views=replace(config.views, count=command.eyes))
    return measure_quantity(source.gaussians, command.by, space, config, progress=status), place.remarks


def _document(command: Paint, source: Source, files: _Files, quantity: Quantity, bands: list[Band]) -> dict[str, Any]:
    """Return the result as JSON."""
    return {
        "format": "gsvis-paint",
        "version": 1,
        "in": command.scene,
        "lod": source.lod,
        "out": command.out,
        "legend": str(files.legend),
        "by": quantity.name,
        "label": quantity.label,
        "gaussians": len(quantity),
        "seen": int(quantity.seen.sum()),
        "low": quantity.low,
        "high": quantity.high,
        "logarithmic": quantity.logarithmic,
        "bands": [{"color": each.hex, "text": each.text, "gaussians": each.count} for each in bands],
    }


def _table(quantity: Quantity, bands: list[Band]) -> Table:
    """Return the legend as a table with the colors themselves, where the terminal has colors."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    table = Table(title=quantity.label, title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    for name in ("color", quantity.name, "Gaussians", ""):
        table.add_column(name, justify="right" if name in ("Gaussians", "") else "left")
    for each in bands:
        swatch = Text("    ", style=f"on {each.hex}")
        table.add_row(
            swatch.append(f" {each.hex}", style="default on default"),
            each.text,
            f"{each.count:,}",
            f"{each.count / max(1, len(quantity)):.1%}",
        )
    return table
