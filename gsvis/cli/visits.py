"""How a visit of a scene begins that nobody has prepared, by the evidence that every command weighs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.cli.asking import settle
from gsvis.cli.options import Placed, Shown, Where
from gsvis.cli.source import Source, navigable_space, parse_up, up_of
from gsvis.cli.terminal import Status
from gsvis.cli.where import Place, find_place
from gsvis.scene.navigable import NavigableSpace

if TYPE_CHECKING:
    from gsvis.export.start import Start
    from gsvis.scene.paths import HeadPath

__all__ = ["Visit", "find_starts", "plan_visit", "settle_visit", "starts_in"]

_DRAWN = 12  # views that those to begin with are chosen from


@dataclass(frozen=True, eq=False)
class Visit:
    """How a visit of a scene begins.

    Attributes:
        starts: Upright views that show much of the scene, the best first; None if no eye finds room.
        up: (3,) unit up axis.
        remarks: Remarks for the user, such as what is not sure.
    """

    starts: tuple[Start, ...] | None
    up: NDArray[np.float64]
    remarks: list[str]


def plan_visit(source: Source, where: Where | None = None) -> Visit:
    """Return how a visit of a scene begins.

    Where that is not sure, a remark says so, and views are drawn from where either reading has eyes.

    Args:
        source: The scene.
        where: What the user said of where eyes may be; None for nothing.
    """
    some = source.thin()
    place = find_place(some, where or Where())
    up = where.up if isinstance(where, Placed) else None
    return _begin(some, place, up, place.remarks)


def settle_visit(
    where: Shown, source: Source, walk: HeadPath | None, status: Status, *, quiet: bool
) -> tuple[Shown, Visit]:
    """Return how a visit begins after a question on a terminal in doubt, and the options with the answers in them.

    Args:
        where: The options.
        source: The scene.
        walk: The walk of --path.
        status: The display of progress, which pauses for the question.
        quiet: Ask nothing, as with --json.

    Raises:
        SceneError: If no eye fits where the user said that eyes are.
        OutputError: If the picture of --show cannot be written.
        KeyboardInterrupt: If the user presses Ctrl-C at the question.
    """
    some = source.thin()
    status("start", 0, 1)
    settled = settle(where, source, lambda w: find_place(some, w, walk), status, quiet=quiet)
    if where.given or where.kind not in (None, "auto"):
        settled.place.required("leave it out, or say where eyes may be with --box or --around")
    visit = _begin(some, settled.place, settled.where.up, settled.remarks)
    status("start", 1, 1)
    return settled.where, visit


def _begin(some: Source, place: Place, up: str | None, remarks: list[str]) -> Visit:
    """Return how a visit begins in a place, which may have no space."""
    if place.upright is not None:
        axis = place.upright.up
    else:
        known = parse_up(up)
        axis = up_of(some) if known is None else known
    starts = None if place.space is None else starts_in(some, place.space)
    return Visit(starts, axis, remarks)


def find_starts(source: Source, up: ArrayLike) -> tuple[Start, ...] | None:
    """Return upright views that show much of a scene, the best first; None if no eye finds room.

    They are found among a part of the Gaussians: about two seconds for any scene, and not the views that `gsvis
    prepare` would choose.

    Args:
        source: The scene.
        up: (3,) unit axis that points upwards.
    """
    some = source.thin()
    space, _ = navigable_space(some, up=up)
    return None if space is None else starts_in(some, space)


def starts_in(some: Source, space: NavigableSpace) -> tuple[Start, ...] | None:
    """Return upright views from a navigable space, the best first; None if no eye finds room.

    Args:
        some: The scene, or as much of it as `Source.thin` leaves.
        space: Where eyes may be.
    """
    from gsvis.export.start import Mode, Start
    from gsvis.prepare.start_views import choose_start_views
    from gsvis.scene.poses import describe_poses

    mode: Mode = "orbit" if space.kind.kind == "object" else "fly"
    found = describe_poses(choose_start_views(some.gaussians, space, drawn=_DRAWN))
    return tuple(Start.from_dict(view, mode) for view in found) or None
