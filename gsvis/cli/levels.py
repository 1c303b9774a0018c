"""`gsvis levels`: lower levels of a scene that share Gaussians with it, as a folder, with how good they are."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsvis.cli.arguments import Levels
from gsvis.cli.levels_result import record_of, tell_result
from gsvis.cli.source import Source, check_folder, check_source, given_up, load_source, navigable_space
from gsvis.cli.stopping import between_steps
from gsvis.cli.terminal import Status
from gsvis.errors import FormatError, SceneError
from gsvis.io.levels import MAP, check_names, levels_info, load_levels, save_levels
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from gsvis.scene.cameras import Cameras
    from gsvis.scene.navigable import NavigableSpace
    from gsvis.train.images import PosedImages
    from gsvis.train.levels import LevelsConfig, TrainedLevels

__all__ = ["run_levels", "work_of"]

_VIEWS, _HELD_OUT, _WIDTH, _HEIGHT, _FOV = 160, 12, 480, 360, 2.0 * float(np.degrees(np.arctan(240.0 / 300.0)))
_EVERY = 8  # of photographs, how many are trained on before one is held out
_NAMES = {1: ("low", "high"), 2: ("low", "medium", "high")}
_REUSE = (0.90, 0.96)  # the last for all further ones
_LEAST_SIDE = 16  # pixels; SSIM needs 11
_MEMORY_SHARE = 0.5  # of what the machine has, for images
_UNLIKE = 12.0  # dB; photographs of another scene, or in another frame, are not met better


@dataclass(frozen=True, eq=False)
class _Plan:
    """What is to be done.

    Attributes:
        source: The scene.
        config: Sizes and training.
        views: Images to train on.
        held_out: Images to measure on; None for none.
        cameras_from: Where their cameras come from, in words.
        work: The folder that keeps what is not finished.
        remarks: What the user should know.
    """

    source: Source
    config: LevelsConfig
    views: PosedImages
    held_out: PosedImages | None
    cameras_from: str
    work: Path
    remarks: list[str]


def run_levels(command: Levels) -> None:
    """Check, draw or read views, choose what stays, train, measure, write, say what came out.

    Raises:
        GsvisError: If a file cannot be read, or the scene or the photographs cannot serve.
        ValueError: If an argument is wrong, or something else would be replaced.
        FileNotFoundError: If a file is missing.
        OSError: If the folder cannot be written.
        KeyboardInterrupt: With a word on what is kept, if the user has had enough.
    """
    config = _checked(command)
    with Status() as status:
        plan = _planned(command, config, status)
        _warm_up(config, status)
        trained, record = _done(command, plan, status)
        seconds = dict(status.seconds)
    tell_result(command, trained.levels, record, plan.remarks, seconds)


def work_of(out: str, plan: str) -> Path:
    """The hidden folder beside the result that keeps a run which is not done; `plan` says which run."""
    target = _target(out)
    return target.with_name(f".{target.name}.partial-{hashlib.sha256(plan.encode()).hexdigest()[:12]}")


def _begun(work: Path) -> bool:
    """Whether a folder of unfinished work holds anything to go on from."""
    return (work / "subsets.npz").exists()


def _target(out: str) -> Path:
    return Path(os.path.abspath(out))


def _checked(command: Levels) -> LevelsConfig:
    """Everything about the arguments that can be known before work begins."""
    from gsvis.train.levels import LevelsConfig

    check_source(command.scene, command.lod)
    if command.photos is not None:
        if not Path(command.photos).exists():
            raise FileNotFoundError(2, "no such file or folder", command.photos)
        for name in ("views", "held_out", "up"):
            if getattr(command, name) is not None:
                spelled, value = name.replace("_", "-"), str(getattr(command, name)).strip()
                raise ValueError(f"--{spelled}: expected none with --photos, got {value}; leave it out")
    given_up(command.up)
    if command.size is not None and min(command.size) < _LEAST_SIDE:
        told = f"{command.size[0]}x{command.size[1]}"
        raise ValueError(f"--size: expected at least {_LEAST_SIDE} pixels a side, got {told}")
    lower = len(command.shares)
    names = command.names or _NAMES.get(lower) or (*(f"level{k}" for k in range(lower)), "high")
    reuse = command.reuse or (*_REUSE[:lower], *_REUSE[-1:] * (lower - len(_REUSE)))
    try:
        config = LevelsConfig(command.shares, reuse, names, command.iterations, seed=command.seed)
        check_names(names)
    except ValueError as error:
        raise ValueError(f"--{error}") from None
    check_folder(command.out)
    check_folder(_target(command.out).parent)  # where unfinished work is kept
    _check_memory(command)
    return config


def _check_memory(command: Levels) -> None:
    """Refuse views that would not fit beside everything else; photographs check themselves."""
    if command.photos is not None:
        return
    width, height = command.size or (_WIDTH, _HEIGHT)
    count = (command.views or _VIEWS) + (_HELD_OUT if command.held_out is None else command.held_out)
    needed = 12 * count * width * height
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not on this system
        return
    if needed > _MEMORY_SHARE * memory:
        raise ValueError(
            f"--views: expected images that fit into half of the memory ({memory / 1e9:.1f} GB), got {count:,} of"
            f" {width} x {height}, {needed / 1e9:.1f} GB; take fewer, or smaller ones with --size"
        )


def _planned(command: Levels, config: LevelsConfig, status: Status) -> _Plan:
    """The scene, the views, and where the work is kept."""
    status("reading", 0, 1)
    source = load_source(command.scene, command.lod)
    g = source.gaussians
    if len(g) == 0:
        raise SceneError(f"{command.scene}: the scene has no Gaussian: there is nothing to make levels of")
    try:
        config.sizes(len(g))
    except ValueError as error:
        raise ValueError(f"--{error}; larger --shares, or a finer --lod") from None
    _check_replaced(command, config.names, g)
    status("reading", 1, 1)
    remarks: list[str] = []
    held_out: PosedImages | None
    if command.photos is not None:
        views, held_out, told = _photographs(command, g, status, remarks)
    else:
        views, held_out, told = _drawn(command, source, status)
    least = sum((1.0 - reuse) * share for reuse, share in zip(config.reuse, config.shares, strict=True))
    if least > 0.05:
        remarks.append(
            f" Going up level by level may send {least:.1%} more than the scene alone; a higher --reuse sends less."
        )
    work = _work(command, config, g, views)
    if _begun(work):
        status.line(f"going on from {work.name}, which an earlier run left")
        remarks.append(" It went on from what an earlier run had kept; the time is of this one alone.")
    return _Plan(source, config, views, held_out, told, work, remarks)


def _work(command: Levels, config: LevelsConfig, g: Gaussians, views: PosedImages) -> Path:
    """Where this very run keeps its work: another scene, configuration or other views have another folder."""
    digest = hashlib.sha256()
    for array in (views.images, views.cameras.viewmats, views.cameras.Ks):
        digest.update(np.ascontiguousarray(array).data)
    return work_of(command.out, json.dumps([scene_hash(g), asdict(config), digest.hexdigest()]))


def _check_replaced(command: Levels, names: tuple[str, ...], g: Gaussians) -> None:
    """Refuse to replace what is not levels of this scene: a slip of the keyboard must not cost hours of training."""
    folder = _target(command.out)
    files = {name: folder / f"{name}.ply" for name in names}
    for file in files.values():
        if file.exists() and Path(command.scene).exists() and file.samefile(command.scene):
            raise ValueError(f"--out: expected a folder of its own, got {command.out}, whose {file.name} is read")
    known: tuple[str, ...] = ()
    if (folder / MAP).exists():
        wanted = f"--out: expected a new folder, or levels of this scene to replace, got {command.out}"
        try:
            known = levels_info(folder).files
            held = load_levels(folder)
        except FormatError as error:
            raise ValueError(f"{wanted}, which cannot be read ({error}); name another, or delete it") from None
        if scene_hash(held.level(len(held) - 1)) != scene_hash(g):
            raise ValueError(f"{wanted}, which holds those of another; name another")
    for file in files.values():
        if file.exists() and file.name not in known:
            raise ValueError(
                f"--out: expected a folder without {file.name}, got {command.out}, which has one that no {MAP} knows;"
                " name another, or move it away"
            )


def _photographs(
    command: Levels, g: Gaussians, status: Status, remarks: list[str]
) -> tuple[PosedImages, PosedImages, str]:
    """Photographs to train on and to measure on."""
    from gsvis.render.rasterizer import rasterize
    from gsvis.train.photos import load_photos
    from gsvis.train.trainer import mean_psnr

    assert command.photos is not None
    photos = load_photos(command.photos, size=command.size, progress=status)
    views, held_out = photos.views.split(_EVERY)
    remarks += [f" {remark}" for remark in photos.remarks]
    wrong = "are they of this scene, and in its frame?"
    for c in range(len(held_out)):
        if float(rasterize(g, held_out.cameras[c]).images.max()) >= 1.0 / 255.0:
            break
    else:
        raise SceneError(f"{command.photos}: no camera of the photographs shows any of {command.scene}: {wrong}")
    likeness = mean_psnr(g, held_out)
    if likeness < _UNLIKE:
        told = f"The scene is unlike the photographs ({likeness:.1f} dB): {wrong}"
        status.line(told)
        remarks.append(f" {told}")
    return views, held_out, "photographs"


def _drawn(command: Levels, source: Source, status: Status) -> tuple[PosedImages, PosedImages | None, str]:
    """Renders of the scene to train on and to measure on, from cameras that have nothing to do with each other."""
    from gsvis.train.images import render_views

    status("space", 0, 1)
    space, why_not = navigable_space(source, up=given_up(command.up))
    if space is None:
        raise SceneError(f"{command.scene}: {why_not}; photographs with cameras, --photos, serve as well")
    status("space", 1, 1)
    found: list[PosedImages] = []
    counts = command.views or _VIEWS, _HELD_OUT if command.held_out is None else command.held_out
    cameras = [_cameras(command, count, stream, source, space) for stream, count in enumerate(counts) if count]
    for some in cameras:

        def told(stage: str, done: int, of: int, before: int = sum(map(len, found))) -> None:
            if done or not before:
                status(stage, before + done, sum(counts))

        found.append(render_views(source.gaussians, some, progress=told))
    if float(found[0].images.max()) < 1.0 / 255.0:
        raise SceneError(f"{command.scene}: views from inside the scene show nothing of it; is the --up axis right?")
    return found[0], found[1] if len(found) > 1 else None, f"drawn at random where eyes may be ({space.rule})"


def _cameras(command: Levels, count: int, stream: int, source: Source, space: NavigableSpace) -> Cameras:
    from gsvis.visibility.colors import ViewSampling

    width, height = command.size or (_WIDTH, _HEIGHT)
    return ViewSampling(count, width, height, _FOV, command.seed, stream).cameras(source.gaussians, space)


def _warm_up(config: LevelsConfig, status: Status) -> None:
    """Load the kernels, or compile them once after an installation, so that the first run tells what it waits for."""
    from gsvis.scene.cameras import Cameras
    from gsvis.train.images import render_views
    from gsvis.train.levels import LevelsConfig, train_levels

    status("kernels", 0, 1)
    rng = np.random.default_rng(0)
    few = Gaussians(
        rng.normal(size=(12, 3)), [[1, 0, 0, 0]] * 12, np.full((12, 3), 0.3), [0.5] * 12, [[[1, 1, 1]]] * 12
    )
    views = render_views(few, Cameras.orbit((0.0, 0.0, 0.0), 4.0, 2, width=16, height=16))
    train_levels(few, views, replace(LevelsConfig(iterations=1), backend=config.backend))
    status("kernels", 1, 1)


def _done(command: Levels, plan: _Plan, status: Status) -> tuple[TrainedLevels, dict[str, object]]:
    """Everything between a plan and the last file; the record of it."""
    from gsvis.train.level_quality import measure_levels
    from gsvis.train.levels import train_levels

    g, work = plan.source.gaussians, plan.work
    quality = None
    try:
        with between_steps() as stop_if_asked:
            said = "", 0

            def told(stage: str, done: int, total: int) -> None:
                nonlocal said
                if (stage, done) != said:  # an end may be told twice
                    status(stage.replace("train ", "training ", 1), done, total)
                said = stage, done
                stop_if_asked()

            trained = train_levels(g, plan.views, plan.config, held_out=plan.held_out, work=work, progress=told)
        if plan.held_out is not None:
            photographs = command.photos is not None
            quality = measure_levels(trained.levels, plan.held_out, photographs=photographs, progress=status)
        record = record_of(command, plan, trained, quality)
        status("writing", 0, 1)
        save_levels(trained.levels, command.out, record)
        status("writing", 1, 1)
    except KeyboardInterrupt:
        if not _begun(work):
            shutil.rmtree(work, ignore_errors=True)
            raise
        raise KeyboardInterrupt(
            f"what was chosen and trained is kept in {work.name}; the same command goes on from there"
        ) from None
    shutil.rmtree(work, ignore_errors=True)
    return trained, record
