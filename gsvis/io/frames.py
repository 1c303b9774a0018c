"""Bring cameras into the frame of a scene, and say when they see nothing of it.

The one function for every command that takes cameras. What nerfstudio wrote beside the cameras or the scene
(`dataparser_transforms.json`) is applied if the cameras see the scene then, and not before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from gsvis import _check
from gsvis.errors import ArgumentError, FormatError
from gsvis.io.dataparser import NAME, find_dataparser, read_applied, read_dataparser
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sight import blind
from gsvis.scene.similarity import Similarity

__all__ = ["Framed", "fit_cameras", "move_cameras"]

_LOOKED = 64  # cameras looked at, at even steps
_MANY = 0.5  # share of cameras that see nothing from which a line says so
_GAIN = 0.1  # least share of cameras that must see more for a transform to be applied


@dataclass(frozen=True, eq=False)
class Framed:
    """Cameras in the frame of a scene.

    Attributes:
        cameras: The cameras, moved if `transform` is given.
        transform: The scene's frame from the frame of their file; None if nothing was moved.
        remarks: At most one line for the user for each thing done or seen, without a leading space.
        blind: Share of the cameras that see nothing of the scene, in [0, 1].
    """

    cameras: Cameras
    transform: Similarity | None
    remarks: tuple[str, ...]
    blind: float


def fit_cameras(
    g: Gaussians,
    cameras: Cameras,
    path: str | Path | None = None,
    scene: str | Path | None = None,
    *,
    frame: Literal["auto", "scene", "capture"] = "auto",
) -> Framed:
    """Return cameras in the frame of a scene, with a line where they were moved or where most see nothing.

    Args:
        g: The scene.
        cameras: C cameras as their file states them.
        path: Their file or folder; `dataparser_transforms.json` is looked for beside and above it.
        scene: The scene's file or folder; the same is looked for there if it is not beside the cameras.
        frame: Frame of the cameras: "scene" leaves them as they are, "capture" moves them as the file says, "auto"
            moves them only if clearly fewer of them see nothing then.

    Returns:
        The cameras, moved or as they were.

    Raises:
        ArgumentError: If the frame is "capture" and there is no `dataparser_transforms.json`.
        FormatError: If there is a `dataparser_transforms.json` that is malformed and the cameras need it.
    """
    _check.one_of("frame", frame, ("auto", "scene", "capture"))
    lost = _share(g, cameras)
    forced = frame == "capture"
    looked = forced or (frame == "auto" and lost > 0.0)
    found = find_dataparser(path, scene) if looked else None
    if found is None and forced:
        where = " or ".join(str(each) for each in (path, scene) if each) or "the cameras"
        raise ArgumentError(
            "frame", f"expected a {NAME} beside {where} for capture, got none", "copy it there, or leave this out"
        )
    best = 2.0 if forced else lost
    moved = None
    if found is not None:
        for each in _candidates(found, path, inverted=not forced):
            share = _share(g, move_cameras(cameras, each))
            if share < best:
                best = share
                moved = each
    if moved is not None and (forced or lost - best >= _GAIN):
        count = len(cameras)
        line = (
            f"The cameras were brought into the frame of the scene by {found}: {_seeing(best, count)} of {count:,} see"
            f" it, {_seeing(lost, count)} as they were."
        )
        warning = () if best < _MANY else (_warning(best, count),)
        return Framed(move_cameras(cameras, moved), moved, (line, *warning), best)
    return Framed(cameras, None, () if lost < _MANY else (_warning(lost, len(cameras)),), lost)


def move_cameras(cameras: Cameras, transform: Similarity) -> Cameras:
    """Return cameras in another frame; they see a scene that is moved along as before.

    Args:
        cameras: C cameras.
        transform: New frame from theirs.
    """
    rotations = cameras.viewmats[:, :3, :3] @ transform.rotation.T
    eyes = transform.apply(cameras.viewpoints)
    poses = np.tile(np.eye(4), (len(cameras), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = -np.einsum("cij,cj->ci", rotations, eyes)
    return Cameras(poses, cameras.Ks, cameras.width, cameras.height, cameras.names)


def _share(g: Gaussians, cameras: Cameras) -> float:
    count = len(cameras)
    some = np.unique(np.arange(min(count, _LOOKED)) * count // max(1, min(count, _LOOKED)))
    return float(blind(g, cameras[some]).mean()) if count else 0.0


def _candidates(found: Path, path: str | Path | None, *, inverted: bool) -> Iterator[Similarity]:
    """Yield what may bring the cameras into the scene: what the file says, also after what was applied before."""
    moved = read_dataparser(found)
    yield moved
    if path is not None:
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        file = Path(path) if Path(path).suffix == ".json" else folder / "transforms.json"
        try:
            applied = read_applied(file) if file.is_file() else None
        except FormatError:
            applied = None
        if applied is not None:
            yield _after(moved, applied.inverse())
    if inverted:
        yield moved.inverse()


def _after(second: Similarity, first: Similarity) -> Similarity:
    return Similarity.from_rotation(
        second.scale * first.scale, second.rotation @ first.rotation, second.apply(first.translation[None])[0]
    )


def _seeing(lost: float, count: int) -> str:
    return f"{round((1.0 - lost) * count):,}"


def _warning(lost: float, count: int) -> str:
    return (
        f"{count - round((1.0 - lost) * count):,} of {count:,} cameras see nothing of the scene: they are probably"
        " those of another frame; give the cameras of the capture that the scene was trained on, or put nerfstudio's"
        " dataparser_transforms.json beside them."
    )
