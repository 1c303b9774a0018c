"""Groups of options that several commands share, and what is asked of the options of any command.

A command is a dataclass; its fields are options, or groups of options. The names of options are those of the fields,
whichever group they are in. Nothing heavy is imported here: `gsvis --help` has to be quick.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import cache
from typing import Annotated, Any, Literal, Protocol, TypeVar, get_args, get_origin, get_type_hints

from gsvis.cli import readers
from gsvis.cli.readers import Count, File, Flag, Memory, Units, Up, hint
from gsvis.errors import ArgumentError

__all__ = [
    "IN_DOUBT",
    "LISTENING",
    "PLACING",
    "REPORT",
    "UP",
    "Cluster",
    "Fit",
    "Framed",
    "Leaf",
    "Levels",
    "Output",
    "Placed",
    "Reading",
    "Sending",
    "Sets",
    "Shown",
    "Where",
    "Work",
    "changed",
    "command_line",
    "command_name",
    "config_of",
    "image_size",
    "leaves",
    "naming",
    "refuse",
    "replaced",
    "value_of",
    "values_of",
    "with_help",
]

C = TypeVar("C")


_SHORT = frozenset({"as_in_paper"})  # switches that `gsvis.cli.paper` replaces by the options they are short for
UP = "Up in the scene: an axis such as -y, or three numbers"
IN_DOUBT = (
    "Write a picture of where people stand: the first view, and a plan with eyes; a dry run in doubt does anyway."
)


@dataclass(frozen=True, kw_only=True)
class Output:
    """How a command prints."""

    json: Flag = False
    """Print one JSON document instead of tables and lines."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class Reading(Output):
    """How a command that reads scenes prints, and what it does with invalid rows."""

    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""


@dataclass(frozen=True, kw_only=True)
class Framed:
    """Cameras and their frame; every command that takes cameras has them."""

    cameras: Annotated[str | None, hint("no cameras", "FILE")] = None
    """Cameras of the capture, in the frame of SCENE: a COLMAP model, transforms.json or cameras.json. They say where
    people stand and which way is up."""
    cameras_frame: Annotated[Literal["auto", "scene", "capture"], readers.PLAIN] = "auto"
    """Frame of --cameras. scene: that of SCENE, as they are; capture: that of the photographs, moved by nerfstudio's
    dataparser_transforms.json; auto: moved where more of them see the scene then. (default: auto)"""


@dataclass(frozen=True, kw_only=True)
class Where(Framed):
    """Where eyes may be; by default where the kind of the scene puts them."""

    box: Annotated[tuple[float, ...] | None, readers.BOX, hint("the navigable space of the scene")] = None
    """Restrict viewpoints to this box, in the frame of SCENE."""
    around: Annotated[tuple[float, ...] | None, readers.AROUND, hint("where the scene is an object")] = None
    """Put viewpoints around an object, auto for the whole scene, or its center and radius, in the frame of SCENE."""
    path: Annotated[str | None, hint("no path", "FILE")] = None
    """Walk that viewpoints are restricted to, in the frame of SCENE: a CSV of poses (t,x,y,z,qw,qx,qy,qz) or an
    EyeNavGS recording."""
    margin: Annotated[Units, hint("3 voxels of the navigable space")] = None
    """Distance of viewpoints from --path, at most, in scene units."""
    retarget: Flag = False
    """Move --path into the scene by a similarity transform, if it was recorded in another frame."""
    kind: Annotated[str | None, readers.KIND, hint("auto, and a question on a terminal where that is unsure")] = None
    """What the scene is, which says where people stand: object, rooms, open-place; or auto, which asks nothing."""

    WORDS = ("box", "around", "path", "margin", "retarget", "kind")

    @property
    def given(self) -> list[str]:
        """Options that say by hand where eyes may be."""
        return [name for name in ("box", "around", "path") if getattr(self, name) is not None]


@dataclass(frozen=True, kw_only=True)
class Placed(Where):
    """Where eyes may be, and which way is up."""

    up: Up = None
    """Up in the scene: an axis such as -y, or three numbers."""


@dataclass(frozen=True, kw_only=True)
class Shown(Placed):
    """Where eyes may be, which way is up, and a picture of both."""

    show: File = None
    """Write a picture of where people stand: the first view, and a plan with eyes."""


PLACING = tuple(each.name for each in fields(Shown))
"""Names of all options that say where eyes may be and which way is up."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """The machine that works, and whether it only counts what the work costs."""

    workers: Annotated[Count, hint("one for each core")] = None
    """Number of processes. The result is the same for any number."""
    max_memory: Memory = None
    """Memory limit of all processes together, such as 4GB or 2GiB."""
    dry_run: Flag = False
    """Print time, memory and disk, and write nothing."""


@dataclass(frozen=True, kw_only=True)
class Cluster(Work):
    """The machine or the cluster that works."""

    scheduler: Annotated[str | None, hint("this machine", "ADDRESS")] = None
    """Dask scheduler whose workers do the work, such as tcp://10.0.0.5:8786; needs the extra 'cluster'."""


@dataclass(frozen=True, kw_only=True)
class Sets:
    """How visible sets are found: `gsvis.pvs.config.PvsConfig`."""

    cells: Annotated[int | None, readers.CELLS, hint("128, or 32 to 64 where sets hardly grow then")] = None
    """Largest number of cells. They are as small as it allows."""
    cell_size: Annotated[Units, hint("the smallest that --cells allows")] = None
    """Side of a cell, scene units."""
    face_size: Annotated[int | None, readers.FACE_PIXELS, hint("768")] = None
    """Pixels along a side of the six faces around a viewpoint of a cell."""
    limit: Annotated[float | None, readers.SHARE, hint("0.0015")] = None
    """The set of a cell is finished when rays prove that it misses at most this share of the light."""


@dataclass(frozen=True, kw_only=True)
class Levels:
    """How lower levels are made: `gsvis.train.levels.LevelsConfig`, and the views that they are trained on."""

    photos: Annotated[str | None, hint("renders of the scene", "DIR")] = None
    """Photographs to train levels on, with the COLMAP model or transforms.json that SCENE was trained from."""
    levels: Annotated[tuple[float, ...], readers.SHARES_OR_NONE, hint("0.25 0.5")] = (0.25, 0.5)
    """Size of each lower level as a share of the scene's, lowest first; none for the scene alone."""
    reuse: Annotated[tuple[float, ...] | None, readers.SHARES, hint("0.9 0.96")] = None
    """Least share of each lower level that stands unchanged in the next."""
    names: Annotated[tuple[str, ...] | None, readers.NAMES, hint("low medium high")] = None
    """Names of these levels, that of the scene itself last."""
    preview: Annotated[float | None, readers.PREVIEW_SHARE, hint("0.02; 0 below 50,000 Gaussians")] = None
    """Size of the first picture, merged Gaussians below all other levels, as a share of the scene's; 0 for none."""
    importance: Annotated[Literal["removal", "gradient"], readers.PLAIN] = "removal"
    """How Gaussians that stay in lower levels are chosen. removal: in rounds, by what their removal changes; gradient:
    at once, by equation 6 of the paper, the error of the training views. (default: removal)"""
    grow: Annotated[Literal["merged", "clones"], readers.PLAIN] = "merged"
    """What a lower level has besides them. merged: Gaussians that stand for those that go; clones: clones of what
    stays, at most 1% of the level at a time, the paper's way. (default: merged)"""
    steps: Annotated[int, readers.STEPS] = 400
    """Steps of training for each lower level, one view each; fewer also look less at what may go."""
    views: Annotated[Count, hint("400")] = None
    """Number of views to train on, sampled where viewers may stand; not with --photos, which trains on 7 of 8."""
    width: Annotated[int | None, readers.PIXELS, hint("480; with --photos theirs")] = None
    """Pixels across views to measure on; those to train on are wider and smaller. Photographs are shrunk to it."""
    height: Annotated[int | None, readers.PIXELS, hint("360; with --photos theirs")] = None
    """Pixels down these views."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """How colors are fitted: `gsvis.color.fit.FitConfig`."""

    variant: Annotated[Literal["rgb", "hsl"], readers.PLAIN] = "rgb"
    """How colors are split; hsl is the paper's way. (default: rgb)"""
    fit: Annotated[Literal["lobes", "omp"], readers.PLAIN] = "lobes"
    """How terms are found. lobes: refined after each choice; omp: orthogonal matching pursuit leaves them on its grid,
    the paper's way, quicker and worse. (default: lobes)"""
    directions: Annotated[Literal["weighed", "faces"], readers.PLAIN] = "weighed"
    """What the fit heeds. weighed: directions by how much views see from them; faces: those of the 80 from which views
    see a Gaussian, all alike, the paper's way. (default: weighed)"""
    max_terms: Annotated[int | None, readers.TERMS, hint("24")] = None
    """Most terms of each function of a Gaussian; 0 leaves base colors alone."""
    mean_terms: Annotated[float | None, readers.MEAN_TERMS, hint("3")] = None
    """Terms a Gaussian on average; they go where they lower errors most. all: all that help (slow)."""
    width_price: Annotated[float | None, readers.WIDTH_PRICE, hint("3")] = None
    """What a term costs more at most if it is active for all eyes, over what it costs by itself: terms are narrower,
    and an eye needs fewer of them. 0: width costs nothing (the paper's way)."""
    width_loss: Annotated[float | None, readers.WIDTH_LOSS, hint("0.02")] = None
    """dB that the price for width may cost the fit; the price falls until it does not cost more."""


@dataclass(frozen=True, kw_only=True)
class Sending:
    """What a viewer is sent, and in which order: `gsvis.abr.AbrConfig`."""

    policy: Annotated[Literal["utility", "fov-first", "low-first"], readers.PLAIN] = "utility"
    """What is sent first. (default: utility)"""
    terms: Annotated[Literal["pose", "cell"], readers.PLAIN] = "pose"
    """Which terms are sent. pose: those that change the image for the eye; cell: all that are active somewhere in its
    cell, the paper's way. (default: pose)"""
    no_fill: Flag = False
    """Send only what a view needs: an idle link does not bring the rest of the scene."""


@dataclass(frozen=True, eq=False)
class OtherHelp:
    """What the help of one command tells of options of a group in other words than the group.

    Attributes:
        texts: Text of each option.
        defaults: What the help tells as the default of each option.
    """

    texts: dict[str, str]
    defaults: dict[str, str]


def with_help(defaults: dict[str, str] | None = None, **texts: str) -> OtherHelp:
    """Return other words for options of a group, beside which it is written in `Annotated`."""
    return OtherHelp(texts, defaults or {})


REPORT = with_help(json="Print one JSON document, report.json, instead of tables.")
LISTENING = with_help(json="Print one JSON document with the address once it listens.")


@dataclass(frozen=True)
class Leaf:
    """One option or positional argument of a command.

    Attributes:
        name: Its name, with underscores.
        path: Names of the fields that lead to it, through groups.
        hint: Its type with the settings of `tyro`.
        default: Its default; `dataclasses.MISSING` if it is required.
        text: What the help of this command tells of it; None if the field says it.
        shared: What the help tells of it in every command that has no string below its field.
        owner: The dataclass that has the field.
    """

    name: str
    path: tuple[str, ...]
    hint: Any
    default: Any
    text: str | None
    shared: str | None
    owner: type

    @property
    def option(self) -> str:
        """Its name on the command line."""
        return f"--{self.name.replace('_', '-')}"

    @property
    def extras(self) -> tuple[Any, ...]:
        """Settings of `tyro`."""
        return getattr(self.hint, "__metadata__", ())

    @property
    def is_positional(self) -> bool:
        """Whether it is an argument without a name."""
        return any("POSITIONAL" in str(extra).upper() for extra in self.extras)

    def of(self, command: Any) -> Any:
        """Return its value in a command."""
        for name in self.path:
            command = getattr(command, name)
        return command

    def spell(self, value: Any) -> list[str]:
        """Return a value as words of a command line; none for a flag."""
        if value is True:
            return []
        write = next((each.str_from_instance for each in self.extras if hasattr(each, "str_from_instance")), None)
        return list(write(value)) if write is not None else readers.spell(value)


def leaves(kind: type) -> tuple[Leaf, ...]:
    """Return the options of a command, those of its groups included, in the order of their fields."""
    return _leaves(kind, (), None)


@cache
def _leaves(kind: Any, path: tuple[str, ...], other: OtherHelp | None) -> tuple[Leaf, ...]:
    """Return the options of a command or of a group.

    Args:
        kind: The dataclass.
        path: Names of the fields that lead to the group.
        other: Other words for its options.
    """
    hints = get_type_hints(kind, include_extras=True)
    other = other or with_help()
    found: list[Leaf] = []
    for each in fields(kind):
        hinted = hints[each.name]
        where = (*path, each.name)
        plain, *extras = get_args(hinted) if get_origin(hinted) is Annotated else (hinted,)
        if isinstance(plain, type) and is_dataclass(plain):
            words = next((extra for extra in extras if isinstance(extra, OtherHelp)), None)
            found += _leaves(plain, where, words)
            continue
        if each.name in other.defaults:
            hinted = Annotated[hinted, hint(other.defaults[each.name])]
        shared = next((extra.help for extra in extras if getattr(extra, "help", None)), None)
        found.append(Leaf(each.name, where, hinted, each.default, other.texts.get(each.name), shared, kind))
    return tuple(found)


def values_of(command: Any) -> dict[str, Any]:
    """Return the value of each option of a command by its name, in the order of the fields.

    A switch that is short for other options is left out: they have been read in its place.
    """
    return {leaf.name: leaf.of(command) for leaf in leaves(type(command)) if leaf.name not in _SHORT}


def value_of(command: Any, name: str) -> Any:
    """Return the value of one option of a command."""
    return next(leaf.of(command) for leaf in leaves(type(command)) if leaf.name == name)


def changed(command: Any, names: Iterable[str] | None = None) -> dict[str, list[str]]:
    """Return the options of a command that differ from their defaults, each with its words on a command line.

    Args:
        command: A dataclass of arguments.
        names: Names of arguments that are looked at, in their order; None for all.
    """
    known = {leaf.name: leaf for leaf in leaves(type(command))}
    chosen = list(known.values()) if names is None else [known[name] for name in names if name in known]
    differ = [leaf for leaf in chosen if leaf.default is not MISSING and leaf.of(command) != leaf.default]
    return {leaf.option: leaf.spell(leaf.of(command)) for leaf in differ}


def refuse(command: Any, names: Iterable[str], why: str) -> None:
    """Raise if one of some options is given, which something else makes senseless.

    Args:
        command: A dataclass of arguments.
        names: Names of the options.
        why: Completes "expected none", such as "with --photos".

    Raises:
        ValueError: If one is given; the message names the first.
    """
    for option, words in changed(command, names).items():
        got = f", got {' '.join(words).strip()}" if words else ""
        raise ValueError(f"{option}: expected none {why}{got}; leave it out")


@contextmanager
def naming(**options: str) -> Iterator[None]:
    """Name an option in place of the argument of the library that an error in the block is about.

    Args:
        options: Option of each argument, with another remedy behind "; " if it has one.
    """
    try:
        yield
    except ArgumentError as error:
        if error.name not in options:
            raise
        option, _, remedy = options[error.name].partition("; ")
        raise error.renamed(option, remedy) from None


def replaced(command: C, values: dict[tuple[str, ...], Any]) -> C:
    """Return a command with other values of options, each by the names of the fields that lead to it."""
    for path, value in values.items():
        first, *rest = path
        inner = replaced(getattr(command, first), {tuple(rest): value}) if rest else value
        command = replace(command, **{first: inner})  # type: ignore[type-var]
    return command


def command_name(kind: type[Any]) -> str:
    """Return the name of a command from that of its dataclass: PvsReport is pvs-report."""
    return re.sub(r"(?<!^)(?=[A-Z])", "-", kind.__name__).lower()


def command_line(command: Any, leave_out: Iterable[str] = ()) -> str:
    """Return the command line that gives the same result: what is required, and what differs from its default.

    Args:
        command: A dataclass of arguments.
        leave_out: Names of options that do not change the result, besides those of `Output`.
    """
    words = ["gsvis", command_name(type(command))]
    options = []
    silent = {"json", "debug", *leave_out}
    for leaf in leaves(type(command)):
        value = leaf.of(command)
        if leaf.is_positional:
            words += leaf.spell(value)
        elif leaf.name == "out":
            words += [] if value is None else ["-o", value]
        elif leaf.name not in silent and (leaf.default is MISSING or value != leaf.default):
            options += [leaf.option, *(word.strip() for word in leaf.spell(value))]
    return shlex.join([*words, *options])


def config_of(kind: type[C], group: Any, **given: Any) -> C:
    """Return a configuration of the library from a group of options.

    Args:
        kind: A dataclass; its fields are taken from options of the same name, where they are given.
        group: The options.
        given: Values of other fields; those of None keep their defaults.
    """
    names = {each.name for each in fields(kind)}  # type: ignore[arg-type]
    same = {name: value for name, value in values_of(group).items() if name in names}
    return kind(**{name: value for name, value in {**same, **given}.items() if value is not None})


class Sized(Protocol):
    """Options with the pixels of images."""

    @property
    def width(self) -> int | None: ...
    @property
    def height(self) -> int | None: ...


def image_size(command: Sized, usual: tuple[int, int] | None) -> tuple[int, int] | None:
    """Return (width, height) in pixels as a command states them; None if it states neither.

    Args:
        command: Arguments with --width and --height.
        usual: (width, height) that replaces the one that is not given; None where both are needed, as for photographs,
            whose shape is not known here.

    Raises:
        ValueError: If one is given and the other is needed.
    """
    width = command.width
    height = command.height
    if width is None and height is None:
        return None
    if usual is None and (width is None or height is None):
        missing, given = ("--width", "--height") if width is None else ("--height", "--width")
        raise ValueError(f"{given}: expected {missing} with it for photographs, got none; add it or use --downscale")
    across, down = usual or (0, 0)
    return width or across, height or down
