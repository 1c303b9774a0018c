"""`gsvis cut`: keep what eyes along a path, of cameras, or in a place can see; write it, say what is missing.

`cut_outside.py` has what differs for eyes outside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsvis.cli.arguments import Cut
from gsvis.cli.cut_outside import check_outside, open_up, spell_outside
from gsvis.cli.options import config_of
from gsvis.cli.source import open_source
from gsvis.cli.targets import check_one_level, check_outputs, check_scene_out, write_array
from gsvis.cli.terminal import Status, print_json, show, size_of
from gsvis.cli.where import check_where, find_place, framed_cameras, space_document
from gsvis.errors import SceneError
from gsvis.io.cameras import load_cameras_at
from gsvis.io.scenes import save_scene
from gsvis.io.sources import check_source
from gsvis.prepare.warm import warm_sets
from gsvis.raycast import describe_check
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.source import Source

if TYPE_CHECKING:
    from gsvis.edit import Cut as Found
    from gsvis.edit import CutConfig, Eyes, OutsideCut

__all__ = ["run_cut"]

_RATE = 10.0  # frames a second of a walk that is cut by its frames
_LOOKS = 240  # most of them to look from
_FRAME = (960, 720)  # their pixels
_WIDEST = 1280  # pixels across the images of cameras, at most


@dataclass(frozen=True, eq=False)
class _Eyes:
    """The eyes of a command: where they are, in words, the space if there is one, and remarks for the user."""

    eyes: Eyes
    words: str
    space: NavigableSpace | None
    remarks: list[str]


def run_cut(command: Cut) -> None:
    """Cut a scene: read, look, certify, compare views, write, print the result."""
    walk = _check_arguments(command)
    target = check_scene_out(command.out, command.scene, command.overwrite)
    if command.select is not None:
        outputs = {"--out": target, "--select": Path(command.select)}
        check_outputs(outputs, {"SCENE": command.scene}, command.overwrite)
    config = _config(command)
    with Status() as status:
        source = open_source(command.scene, command.lod, status)
        with status.stage("space"):
            place = _place_eyes(command, source, walk)
        found = _cut(command, source.gaussians, place, config, status)
        with status.stage("writing"):
            save_scene(source.gaussians[found.kept], target)
            if command.select is not None:
                write_array(Path(command.select), found.kept)
    _show_result(command, source, place, found)


def _check_arguments(command: Cut) -> HeadPath | None:
    """Check the arguments before work begins; return the walk of --path."""
    check_source(command.scene, command.lod)
    check_one_level(command.scene)
    check_outside(command)
    if command.where.cameras is None and not command.where.given and not command.from_outside:
        raise ValueError(
            "--path: expected one of --path, --cameras, --box and --around, got none; say where the eyes are"
        )
    if command.fov is not None and command.where.path is None:
        raise ValueError(f"--fov: expected --path with it, got {command.fov:g} alone; cameras state their own")
    if command.where.cameras is None:
        return check_where(command.where)
    return check_where(replace(command.where, margin=None), "--cameras")  # here a margin is one of cameras


def _config(command: Cut) -> CutConfig:
    """Return the settings of the cut from the options."""
    from gsvis.edit import CutConfig

    usual = CutConfig()
    return config_of(
        CutConfig,
        command.looking,
        size=command.looking.face_size,
        limit=max(command.looking.limit, 1e-6),
        views=replace(usual.views, count=command.looking.held_out),
    )


def _place_eyes(command: Cut, source: Source, walk: HeadPath | None) -> _Eyes:
    """Return where the eyes are.

    Raises:
        SceneError: If eyes have no place in the scene.
        ValueError: If the walk lies elsewhere.
    """
    from gsvis.edit import EyesInSpace, EyesOfCameras

    if command.where.cameras is not None:
        cameras = load_cameras_at(command.where.cameras, None, None, at_most=_WIDEST)
        cameras, framed = framed_cameras(source, cameras, command.where)
        words = f"{len(cameras):,} cameras"
        if command.where.margin is not None:
            words += f", or up to {command.where.margin:g} beside them"
        return _Eyes(EyesOfCameras(cameras, command.where.margin or 0.0), words, None, framed)
    found = find_place(source, command.where, walk)
    space = found.required("say where the eyes are with --cameras or --box")
    if not command.where.given:
        return _Eyes(EyesInSpace(space), "eyes anywhere inside, all around", space, found.remarks)
    if command.where.path is None:
        words = "eyes in the box" if command.where.box is not None else "eyes around the scene"
        return _Eyes(EyesInSpace(space), f"{words}, all around", space, found.remarks)
    assert found.path is not None
    if command.fov is None:
        return _Eyes(EyesInSpace(space, found.path), "eyes along the path, all around", space, found.remarks)
    steady = found.path.resample(_RATE)
    cameras = steady.cameras(*_FRAME, command.fov)
    words = f"frames of the path, {command.fov:g} degrees wide"
    return _Eyes(EyesOfCameras(cameras, command.where.margin or 0.0, looks=_LOOKS), words, space, found.remarks)


def _cut(command: Cut, g: Gaussians, place: _Eyes, config: CutConfig, status: Status) -> Found | OutsideCut:
    """Return what the eyes see."""
    from gsvis.edit import cut
    from gsvis.pvs.config import PvsConfig

    warm_sets(PvsConfig(), status)
    try:
        if command.from_outside:
            return open_up(command, g, place.eyes, config, status)
        return cut(g, place.eyes, config, progress=status)
    except SceneError as error:
        raise SceneError(f"{error}; nothing was written") from None


def _show_result(command: Cut, source: Source, place: _Eyes, found: Found | OutsideCut) -> None:
    """Print what was kept, as lines or as JSON."""
    from gsvis.edit import Cut as Found

    size = Path(command.out).stat().st_size
    if command.output.json:
        document: dict[str, Any] = {
            "format": "gsvis-cut",
            "version": 1,
            "in": command.scene,
            "lod": source.lod,
            "out": command.out,
            "bytes": size,
            "eyes": place.words,
            "space": None if place.space is None else space_document(place.space),
            **found.as_dict(),
            "remarks": [each.strip() for each in place.remarks],
        }
        print_json(document)
        return
    count = int(np.count_nonzero(found.kept))
    share = count / len(found.kept)
    lines = _spell(found, place.words) if isinstance(found, Found) else spell_outside(found, place.words)
    show(
        f"{command.out}: {count:,} of {len(found.kept):,} Gaussians ({share:.1%}), {size_of(size)}",
        *(f" {line}" for line in lines),
        *place.remarks,
    )


def _spell(found: Found, words: str) -> list[str]:
    """Return what is said of a cut, in lines."""
    lines = [f"For {words}. {_spell_looks(found)}"]
    if found.certificates:
        lines.append(_spell_certificate(found))
    if found.held_out is not None:
        lines.append(_spell_views(found))
    return lines


def _spell_looks(found: Found) -> str:
    """Return a sentence about the places looked from."""
    lost = f"; {found.buried:,} more lie inside something solid" if found.buried else ""
    return f"Looked from {found.looks:,} places{lost}."


def _spell_certificate(found: Found) -> str:
    """Return two sentences about the light that is missing."""
    return (
        f"They carry {1.0 - found.missed:.3%} of the light; with 95% confidence at most {found.bound:.3%} is missing,"
        f" by {found.rays:,} random rays of these eyes. A second tracer agrees: {describe_check(found.check)}."
    )


def _spell_views(found: Found) -> str:
    """Return a sentence about held-out views."""
    views = found.held_out
    assert views is not None
    added = f"; {views.added:,} Gaussians were added because of views before" if views.added else ""
    which = "views that were not looked from" if views.fresh else "of the cameras"
    mean = float(np.mean(views.psnr))
    worst = float(views.psnr.min())
    return (
        f"{len(views.psnr)} {which}: {mean:.1f} dB against the scene in the mean, {worst:.1f} dB in the worst{added}."
    )
