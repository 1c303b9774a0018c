"""Ask which reading of a scene is right, where that is in doubt and somebody sits at a terminal.

Nobody is asked elsewhere, with --json, or with --kind. Then, and without an answer, eyes are where any reading has
them, which loses nothing.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from gsvis.cli.options import Shown
from gsvis.cli.terminal import Status
from gsvis.cli.where import find_place, parse_up, suspect_views
from gsvis.files.atomic import atomic_path
from gsvis.files.temporary import temporary_folder
from gsvis.scene.cameras import Cameras
from gsvis.scene.kinds import KINDS
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.place import Place
from gsvis.scene.readings import Choice, find_choices
from gsvis.scene.source import Source

__all__ = ["Settled", "settle", "settle_space", "settle_stay", "settle_visit", "write_picture"]

if TYPE_CHECKING:
    from gsvis.export.start import Visit

_WORDS = {kind: word for word, kind in KINDS.items()}
_TRIES = 3  # answers that nobody understands
_QUESTIONS = 3  # one after the other: an answer about up leaves the kind open


W = TypeVar("W", bound=Shown)


@dataclass(frozen=True, eq=False)
class Settled(Generic[W]):
    """Where people stand, after the question.

    Attributes:
        where: The options, with the answers as if they had been given.
        place: Where eyes may be.
        picture: The picture that was written; None if none was.
    """

    where: W
    place: Place
    picture: Path | None

    @property
    def remarks(self) -> list[str]:
        """Remarks for the user: those of the place, and where the picture is."""
        if self.picture is None:
            hint = [" --show FILE.png shows the first view and a plan with eyes."] if self.place.doubt else []
            return [*self.place.remarks, *hint]
        return [*self.place.remarks, f" Where people stand: {self.picture} shows the first view and a plan with eyes."]

    @property
    def written(self) -> str:
        """What a dry run says at its end."""
        return " Nothing was written." if self.picture is None else " Nothing else was written."


def settle(
    where: W,
    source: Source,
    find: Callable[[W], Place],
    status: Status,
    *,
    quiet: bool = False,
    beside: str | None = None,
) -> Settled[W]:
    """Find where people stand; in doubt show it, and ask on a terminal.

    Args:
        where: The options.
        source: The scene.
        find: Finds the place for options.
        status: The display of progress, which pauses for the question.
        quiet: Ask nothing, as with --json.
        beside: The output of a dry run, beside which a picture is written in doubt; None otherwise.

    Raises:
        OutputError: If a picture cannot be written.
        KeyboardInterrupt: If the user presses Ctrl-C at the question.
    """
    place = find(where)
    if place.space is None:
        return Settled(where, place, None)
    for _ in range(_QUESTIONS):
        if quiet or not place.doubt or not _may_ask(where):
            break
        answer = _ask(source, place, status)
        if not answer:
            break
        given: dict[str, Any] = {**answer}
        where = replace(where, **given)
        status.line(f"taken as you say; {_spell(answer)} says so without a question")
        place = find(where)
        if "kind" in answer:
            break
    target = _place_beside(beside) if place.doubt else None
    if where.show is not None:
        target = Path(where.show)
    if target is not None and place.space is not None:
        write_picture(target, source, place)
    return Settled(where, place, target)


def settle_space(
    where: W,
    source: Source,
    walk: HeadPath | None,
    status: Status,
    *,
    quiet: bool,
    beside: str | None = None,
    cameras: Cameras | None = None,
    remedy: str = "say where eyes may be with --box or --around",
) -> tuple[Settled[W], NavigableSpace, list[str]]:
    """Find the navigable space of a scene, after a question in doubt, and look at a few views from it.

    Args:
        where: The options.
        source: The scene.
        walk: The walk of --path.
        status: The display of progress.
        quiet: Ask nothing, as with --json.
        beside: The output of a dry run, beside which a picture is written in doubt; None otherwise.
        cameras: Cameras that took photos of the scene; those of --cameras by default.
        remedy: What the user can do if there is no space.

    Returns:
        Where people stand, the space, and remarks for the user.

    Raises:
        SceneError: If there is no space.
        OutputError: If a picture cannot be written.
        KeyboardInterrupt: If the user presses Ctrl-C at the question.
    """
    with status.stage("space"):
        settled = settle(
            where, source, lambda w: find_place(source, w, walk, cameras), status, quiet=quiet, beside=beside
        )
        space = settled.place.required(remedy)
        return settled, space, [*settled.remarks, *suspect_views(source.gaussians, space)]


def settle_visit(
    where: Shown, source: Source, walk: HeadPath | None, status: Status, *, quiet: bool
) -> tuple[Shown, Visit]:
    """Return how a visit begins after a question on a terminal in doubt, and the options with the answers in them.

    Arguments and errors are those of `settle_stay`.
    """
    settled, plan = settle_stay(where, source, walk, status, quiet=quiet)
    visit = plan()
    status("start", 1, 1)
    return settled.where, visit


def settle_stay(
    where: Shown, source: Source, walk: HeadPath | None, status: Status, *, quiet: bool
) -> tuple[Settled[Shown], Callable[[], Visit]]:
    """Return where people stand after a question on a terminal in doubt, and what finds the first views of a visit.

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
    from gsvis.export.start import plan_visit

    some = source.thin()
    status("start", 0, 1)
    settled = settle(where, source, lambda w: find_place(some, w, walk), status, quiet=quiet)
    if where.given or where.kind not in (None, "auto"):
        settled.place.required("leave it out, or say where eyes may be with --box or --around")

    def plan() -> Visit:
        """Find the views."""
        found = plan_visit(some, settled.place, parse_up(settled.where.up))
        return replace(found, remarks=settled.remarks)

    return settled, plan


def write_picture(path: Path, source: Source, place: Place) -> None:
    """Write the picture, complete or not at all.

    Raises:
        OutputError: If it cannot be written.
    """
    from gsvis.report.readings import picture_of  # slow to import

    png = picture_of(source, place)
    with atomic_path(path) as partial:
        partial.write_bytes(png)


def _place_beside(out: str | None) -> Path | None:
    """Return the path of the picture that is written in doubt; None without an output."""
    if out is None:
        return None
    target = Path(out).absolute()
    folder = next(each for each in target.parents if each.is_dir())  # a dry run makes no folder
    beside = Path(out).parent if folder == target.parent else folder
    return beside / (target.name + ".where.png")


def _may_ask(where: Shown) -> bool:
    """Return whether somebody sits at a terminal in front of this command, and has not answered yet."""
    if where.kind is not None:
        return False
    try:
        if not (sys.stdin.isatty() and sys.stderr.isatty()):
            return False
        # In the background, reading from the terminal would stop the process.
        return not hasattr(os, "tcgetpgrp") or os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except (AttributeError, OSError, ValueError):  # closed, or none at all
        return False


def _ask(source: Source, place: Place, status: Status) -> dict[str, str]:
    """Show the readings and return the options that the answer stands for; none for the safe one."""
    choices = find_choices(place)
    with ExitStack() as stack:
        picture = Path(stack.enter_context(temporary_folder())) / "where.png"
        write_picture(picture, source, place)
        stack.enter_context(status.paused())
        lines = [
            "",
            place.doubt,
            f"A picture of the first view and of a plan with eyes: {picture}",
            *(f"  {k}      {choice}" for k, choice in enumerate(choices, 1)),
            "  Enter  where any of these has eyes: safe, and a larger space",
            "  Or say which way is up: an axis such as -y, or three numbers.",
        ]
        sys.stderr.write("\n".join(lines) + "\n")
        for _ in range(_TRIES):
            word = _read(f"Which is right, 1 to {len(choices)}? " if len(choices) > 1 else "Is it 1? ")
            if not word:
                break
            answer = _understand(word, choices, place)
            if answer is not None:
                return answer
            sys.stderr.write(f"expected a number up to {len(choices)}, an up axis, or Enter alone; got {word!r}\n")
    return {}


def _read(prompt: str) -> str:
    """Return what the user types, without spaces around it; nothing at the end of input."""
    sys.stderr.write(prompt)
    sys.stderr.flush()
    try:
        line = sys.stdin.readline()
    except KeyboardInterrupt:
        sys.stderr.write("\n")
        raise
    if not line:
        sys.stderr.write("\n")
    return line.strip()


def _understand(word: str, choices: list[Choice], place: Place) -> dict[str, str] | None:
    """Return the options that a word stands for; None if it stands for none."""
    if word.isdecimal() and 1 <= int(word) <= len(choices):
        choice = choices[int(word) - 1]
        answer = {"kind": _WORDS[choice.kind]} if choice.kind in _WORDS else {}
        if place.upright is not None and not place.upright.sure:
            answer["up"] = " ".join(f"{value:.9g}" for value in choice.up)
        return answer
    try:
        parse_up(word)
    except ValueError:
        return None
    return {"up": word}


def _spell(answer: dict[str, str]) -> str:
    """Return the options of an answer, as one types them."""
    return shlex.join([part for name, value in answer.items() for part in (f"--{name}", value)])
