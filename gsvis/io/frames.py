"""Transform cameras into the frame of a scene, and warn if they see nothing of it.

Every command that takes cameras calls `fit_cameras`. It applies the `dataparser_transforms.json` of nerfstudio beside
the cameras or the scene if the cameras see the scene only then. If the scene has an origin, they
may be in the coordinates of its source.
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
from gsvis.scene.source_frame import SourceFrame

__all__ = ["Framed", "fit_cameras", "move_cameras"]

_LOOKED = 64  # cameras that are tested, evenly spaced
_MANY = 0.5  # share of cameras that see nothing from which a warning is given
_GAIN = 0.1  # a transform is applied if at least this share of cameras sees the scene only with it


@dataclass(frozen=True, eq=False)
class Framed:
    """Cameras in the frame of a scene.

    Attributes:
        cameras: The cameras, transformed unless `transform` is None.
        transform: Similarity from the frame of the file to that of the scene; None if nothing was transformed.
        remarks: Lines for the user, one for each change or problem.
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
    """Return cameras in the frame of a scene, with remarks if they were transformed or most see nothing.

    Args:
        g: The scene.
        cameras: C cameras as their file states them.
        path: Their file or folder; `dataparser_transforms.json` is searched beside and above it.
        scene: The scene's file or folder, which is searched next.
        frame: Frame of the cameras: "scene" leaves them unchanged, "capture" applies the file, "auto" applies it only
            if clearly more of the cameras then see the scene.

    Returns:
        The cameras, transformed or unchanged.

    Raises:
        ArgumentError: If the frame is "capture" and there is no `dataparser_transforms.json`.
        FormatError: If there is a `dataparser_transforms.json` that is malformed and the cameras need it.
    """
    _check.one_of("frame", frame, ("auto", "scene", "capture"))
    place = SourceFrame.from_scene(g).cameras
    stand = place(cameras)
    lost = _share(g, stand)
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
            share = _share(g, place(move_cameras(cameras, each)))
            if share < best:
                best = share
                moved = each
    if moved is not None and (forced or lost - best >= _GAIN):
        count = len(cameras)
        line = (
            f"The cameras were transformed into the frame of the scene by {found}:"
            f" {_count_seeing(best, count)} of {count:,} see"
            f" it, {_count_seeing(lost, count)} without the transform."
        )
        warning = () if best < _MANY else (_warning(best, count),)
        return Framed(place(move_cameras(cameras, moved)), moved, (line, *warning), best)
    return Framed(stand, None, () if lost < _MANY else (_warning(lost, len(cameras)),), lost)


def move_cameras(cameras: Cameras, transform: Similarity) -> Cameras:
    """Return cameras in a new frame; they see a scene that is transformed with them as before.

    Args:
        cameras: C cameras.
        transform: Similarity from their frame to the new one.
    """
    rotations = cameras.viewmats[:, :3, :3] @ transform.rotation.T
    eyes = transform.apply(cameras.viewpoints)
    poses = np.tile(np.eye(4), (len(cameras), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = -np.einsum("cij,cj->ci", rotations, eyes)
    return Cameras(poses, cameras.Ks, cameras.width, cameras.height, cameras.names)


def _share(g: Gaussians, cameras: Cameras) -> float:
    """Return the share of cameras that see nothing of the scene."""
    count = len(cameras)
    some = np.unique(np.arange(min(count, _LOOKED)) * count // max(1, min(count, _LOOKED)))
    return float(blind(g, cameras[some]).mean()) if count else 0.0


def _candidates(found: Path, path: str | Path | None, *, inverted: bool) -> Iterator[Similarity]:
    """Yield similarities that may apply: that of the file, and its product with one applied before."""
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
            yield _compose(moved, applied.inverse())
    if inverted:
        yield moved.inverse()


def _compose(second: Similarity, first: Similarity) -> Similarity:
    """Return the similarity that applies `first`, then `second`."""
    return Similarity.from_rotation(
        second.scale * first.scale, second.rotation @ first.rotation, second.apply(first.translation[None])[0]
    )


def _count_seeing(lost: float, count: int) -> str:
    """Return the number of cameras that see something, from the share that sees nothing."""
    return f"{round((1.0 - lost) * count):,}"


def _warning(lost: float, count: int) -> str:
    """Return the warning that most cameras see nothing of the scene."""
    return (
        f"{count - round((1.0 - lost) * count):,} of {count:,} cameras see nothing of the scene: their frame is"
        " probably not that of the scene; give the cameras that the scene was trained on, or put nerfstudio's"
        " dataparser_transforms.json beside them."
    )
