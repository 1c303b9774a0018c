"""`gsvis train`: train a scene of Gaussians from photographs with a reconstruction, and write a record of the run."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsvis._extras import require
from gsvis._text import as_json
from gsvis.cli import version
from gsvis.cli.arguments import Train
from gsvis.cli.device import say_device
from gsvis.cli.options import image_size
from gsvis.cli.stopping import between_steps, resumable
from gsvis.cli.targets import check_exists, check_new
from gsvis.cli.terminal import Status, clock, facts, print_json, show, size_of
from gsvis.files.atomic import atomic_path, remove_partials
from gsvis.files.limits import open_regular
from gsvis.files.output import check_file
from gsvis.io.scenes import WRITTEN, suffix_of
from gsvis.jobs.freed_memory import keep_freed_memory
from gsvis.prepare.warm import warm_training
from gsvis.render.device import Device, choose_device

if TYPE_CHECKING:
    from gsvis.progress import Progress
    from gsvis.train.images import PosedImages
    from gsvis.train.photos import Photos
    from gsvis.train.trainer import TrainConfig, Trainer

__all__ = ["checkpoint_of", "record_of", "run_train"]

_SEEN_EVERY = 8  # without held-out views, measure every 8th view trained on
_RANDOM_POINTS = 50_000


@dataclass(frozen=True, eq=False)
class _Plan:
    """What to do.

    Attributes:
        photos: The photographs and their reconstruction.
        train: Views to train on.
        held_out: Views to measure on; None if all are trained on.
        trainer: The trainer, before its first step.
        start: Description of the initial points.
        checkpoint: The file to resume from.
        device: Device that training begins on, "cpu" or "cuda".
    """

    photos: Photos
    train: PosedImages
    held_out: PosedImages | None
    trainer: Trainer
    start: str
    checkpoint: Path
    device: str


def run_train(command: Train) -> None:
    """Train a scene: check, read photographs, train, measure, write, print the result."""
    require("gsvis train", "torch")
    config = _check_arguments(command)
    device = choose_device(command.device)
    keep_freed_memory()
    with Status() as status:
        say_device(device, status)
        plan = _plan(command, config, device, status)
        document = _train(command, plan, status)
        stages = {name: seconds for name, seconds in status.seconds.items() if name != "kernels"}
        document["timing"] = {"seconds": stages, **document.pop("timing")}
        _write_record(command, document)
    plan.checkpoint.unlink(missing_ok=True)
    remove_partials(plan.checkpoint)
    _print_result(command, plan, document)


def checkpoint_of(command: Train) -> Path:
    """Return the path of the checkpoint of an unfinished run: scene.ply.checkpoint by default."""
    return Path(command.checkpoint or f"{command.out}.checkpoint")


def record_of(command: Train) -> Path:
    """Return the path of the record of the run: scene.train.json."""
    return Path(command.out).with_suffix(".train.json")


def _check_arguments(command: Train) -> TrainConfig:
    """Check the arguments before work begins; return the settings of the training."""
    check_exists(command.source)
    out = Path(command.out)
    if suffix_of(out) not in WRITTEN:
        raise ValueError(f"--out: expected a name that ends in {', '.join(WRITTEN)}, got {command.out!r}")
    for path in (out, record_of(command), checkpoint_of(command)):
        check_file(path)
    if out.suffix.lower() == ".ply" and out.is_file() and out.stat().st_size > 0 and not _holds_gaussians(out):
        got = f"got {command.out}, which is something else; name another"
        raise ValueError(f"--out: expected a new file or a scene to replace, {got}")
    if command.restart or not checkpoint_of(command).exists():  # else an earlier run has passed this check
        check_new(out, command.overwrite)
        check_new(record_of(command), command.overwrite)
    if image_size(command.photos, None) is not None and command.photos.downscale is not None:
        raise ValueError("--downscale: expected none with --width and --height, got both; leave one out")
    if command.training.test_every == 1:
        raise ValueError("--test-every: expected 0 or at least 2, got 1; it would leave nothing to train on")
    return _config(command)


def _holds_gaussians(path: Path) -> bool:
    """Return whether a file is a PLY of Gaussians, not for example the points that training starts with."""
    with open_regular(path) as file:
        head = file.read(1 << 16)
    return head.startswith(b"ply") and b" f_dc_0" in head


def _config(command: Train) -> TrainConfig:
    """Return the settings of 3DGS training; few steps shorten the schedule."""
    from gsvis.train.densify import DensifyConfig
    from gsvis.train.trainer import TrainConfig

    steps = command.training.steps
    usual = DensifyConfig()
    densify = replace(
        usual,
        start=min(usual.start, steps // 14),
        stop=min(usual.stop, steps // 2),
        most_count=command.training.max_gaussians or usual.most_count,
    )
    return TrainConfig(
        iterations=steps,
        sh_degree=command.training.sh_degree,
        sh_every=min(TrainConfig.sh_every, max(1, steps // 7)),
        densify=densify,
        evaluate_every=command.training.evaluate_every,
        seed=command.training.seed,
    )


def _plan(command: Train, config: TrainConfig, device: Device, status: Status) -> _Plan:
    """Read the photographs and return a plan, before the first step."""
    from gsvis.train.initial import gaussians_from_points, random_points
    from gsvis.train.photos import load_photos
    from gsvis.train.trainer import Trainer

    photos = load_photos(
        command.source,
        images=command.photos.images,
        downscale=command.photos.downscale,
        size=image_size(command.photos, None),
        progress=status,
    )
    views = photos.views
    held_out = None
    if command.training.test_every:
        views, held_out = photos.views.split(command.training.test_every)
    points = photos.points
    text = ""
    if points is not None:
        text = f"{len(points):,} points of the reconstruction"
    if points is None or command.training.random_points is not None:
        count = command.training.random_points or _RANDOM_POINTS
        points = random_points(views.cameras, count, np.random.default_rng([command.training.seed, 1]))
        text = f"{count:,} random points"
    config = replace(config, backend=device.backend)
    trainer = Trainer(views, gaussians_from_points(points), config, held_out=held_out)
    checkpoint = checkpoint_of(command)
    if command.restart:
        checkpoint.unlink(missing_ok=True)
    return _Plan(photos, views, held_out, trainer, text, checkpoint, device.name)


def _train(command: Train, plan: _Plan, status: Status) -> dict[str, Any]:
    """Train, measure and write the scene; return the JSON record."""
    from gsvis.io import save_scene
    from gsvis.train.config import decisive_options
    from gsvis.train.likeness import measure_views

    trainer = plan.trainer
    begun: list[int] = []
    warm_training(trainer.config, status)
    name = plan.checkpoint.name
    with (
        resumable(f"what was trained is kept in {name}", has=plan.checkpoint.exists),
        between_steps() as stop_if_asked,
    ):
        result = trainer.run(
            checkpoint=plan.checkpoint,
            checkpoint_seconds=command.checkpoint_seconds,
            progress=_reporter(trainer, status, begun, stop_if_asked),
        )
    measured = plan.train[::_SEEN_EVERY] if plan.held_out is None else plan.held_out
    with resumable(f"training is done and kept in {name}", "the same command writes the scene"):
        quality = measure_views(result.gaussians, measured, backend=trainer.backend, progress=status)
        with status.stage("writing"):
            save_scene(result.gaussians, command.out)
    cameras = plan.photos.views.cameras
    return {
        "format": "gsvis-training-record",
        "version": 1,
        "made_by": f"gsvis {version()}",
        "images": command.source,
        "out": command.out,
        "bytes": Path(command.out).stat().st_size,
        "gaussians": len(result.gaussians),
        "sh_degree": result.gaussians.sh_degree,
        "width": cameras.width,
        "height": cameras.height,
        "photographs": {"all": len(plan.photos.views), "trained_on": len(plan.train)},
        "start": plan.start,
        "device": plan.device,
        "config": decisive_options(trainer.config),
        "curve": [record.as_json() for record in result.history],
        "quality": {"of": "trained on" if plan.held_out is None else "held out", **quality.as_dict()},
        "remarks": list(plan.photos.remarks),
        "timing": {  # everything that differs between two equal runs
            "resumed_from": begun[0] if begun and begun[0] else None,
            "curve": [record.seconds for record in result.history],
        },
    }


def _reporter(trainer: Trainer, status: Status, begun: list[int], stop_if_asked: Callable[[], None]) -> Progress:
    """Return the progress callback that the training loop calls between two steps."""
    shown = 0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal shown
        if not begun:
            begun.append(done)
            shown = len(trainer.history)
            if done:
                status.line(f"resuming from step {done:,} of {total:,}")
        count = len(trainer.parameters)
        brief = f"loss {trainer.loss:.3f}, {_thousands(count)}"
        whole = f"loss {trainer.loss:.4f}, {count:,} Gaussians"
        measured = [record.psnr for record in trainer.history if not math.isnan(record.psnr)]
        if measured:
            brief = f"{brief}, {measured[-1]:.1f} dB"
            whole = f"{whole}, {measured[-1]:.2f} dB held out"
        if done and not math.isnan(trainer.loss):
            status.note(stage, brief, whole)
        for record in trainer.history[shown:]:
            psnr = "" if math.isnan(record.psnr) else f"{record.psnr:.2f} dB held out, "
            status.line(f"step {record.step:,}: {psnr}loss {record.loss:.4f}, {record.count:,} Gaussians")
        shown = len(trainer.history)
        status(stage, done, total)
        stop_if_asked()

    return report


def _thousands(count: int) -> str:
    """Return a count in few characters: 12,345 is 12k."""
    return f"{count:,}" if count < 10_000 else f"{count / 1e3:.0f}k"


def _write_record(command: Train, document: dict[str, Any]) -> None:
    """Write the record of the run."""
    with atomic_path(record_of(command)) as partial:
        partial.write_text(as_json(document, indent=1) + "\n", encoding="utf-8")


def _print_result(command: Train, plan: _Plan, document: dict[str, Any]) -> None:
    """Print the result, as a JSON document or as a table."""
    if command.output.json:
        print_json(document)
        return
    photographs = document["photographs"]
    quality = document["quality"]
    kept = photographs["all"] - photographs["trained_on"]
    which = f"{quality['views']} {'held out' if kept else 'of those trained on'}"
    steps = f"{document['config']['iterations']:,}"
    if resumed := document["timing"]["resumed_from"]:
        steps += f", the first {resumed:,} of them in an earlier run"
    rows = [
        ("photographs", f"{photographs['all']:,} of {document['width']} x {document['height']}, {kept:,} held out"),
        ("began with", plan.start),
        ("Gaussians", f"{document['gaussians']:,}, SH degree {document['sh_degree']}"),
        ("steps", steps),
        ("PSNR", f"{quality['psnr']['mean']:.2f} dB, worst {quality['psnr']['worst']:.2f}, in {which}"),
        ("SSIM", f"{quality['ssim']['mean']:.4f}, worst {quality['ssim']['worst']:.4f}"),
        ("file", f"{command.out}, {size_of(document['bytes'])}"),
        ("record", str(record_of(command))),
        ("time", clock(sum(document["timing"]["seconds"].values()))),
    ]
    remarks = [f" {remark}" for remark in plan.photos.remarks]
    if "random" in plan.start and plan.photos.points is None:
        remarks.append(" The reconstruction has no points; with them training would have started near the surfaces.")
    show(facts(Path(command.out).name, rows), *remarks)
