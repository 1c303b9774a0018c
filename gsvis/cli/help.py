"""What `--help` shows: all commands in groups, and of one command the options that matter first.

`gsvis COMMAND --help-all` shows every option. This module imports nothing heavy, so that help is quick.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from dataclasses import MISSING, field, make_dataclass
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, get_args

if TYPE_CHECKING:
    from gsvis.cli.options import Leaf

__all__ = [
    "ALL",
    "FIRST",
    "GROUPS",
    "find_command",
    "long_help",
    "option_texts",
    "overview",
    "short_help",
]

ALL = "--help-all"
"""The option that shows every option of a command."""

GROUPS: dict[str, tuple[tuple[str, str], ...]] = {
    "Look": (
        ("view scene.ply", "in the browser; packages too"),
        ("inspect scene.ply", "what is in it, what looks wrong"),
        ("render scene.ply -o orbit.gif --orbit 36", "pictures; packages too"),
    ),
    "Edit": (
        ("convert scene.ply small.spz", "formats; merge, crop, move"),
        ("clean scene.ply -o clean.ply", "without floaters and the unseen"),
        ("cut scene.ply -o walk.ply --path walk.csv", "keep what a walk can see"),
        ("paint scene.ply -o seen.ply --by visibility", "color by visibility"),
        ("train photos -o scene.ply", "photographs to a scene"),
    ),
    "Publish": (
        ("prepare scene.ply -o scene.gsvis", "a package that can be streamed"),
        ("serve scene.gsvis", "to viewers, over WebSockets"),
        ("export scene.gsvis -o site", "a site for any file server"),
        ("world a.ply b.ply -o city.gsworld", "many packages, out of core"),
        ("space scene.ply -o walk.glb", "where one can walk, as meshes"),
        ("verify scene.gsvis", "is a package whole?"),
        ("unpack scene.gsvis -o levels", "a package back to PLYs"),
    ),
    "Study": (
        ("analyze scene.ply -o report", "who sees what, from where"),
        ("simulate scene.gsvis --path walk.csv -o out", "what a viewer sees on a link"),
        ("pvs scene.ply -o scene.pvs", "what can be seen from each cell"),
        ("pvs-report scene.pvs scene.ply -o report", "how good these sets are"),
        ("levels scene.ply -o levels", "levels that share Gaussians"),
        ("color scene.ply -o scene.arrow", "color that can be sent in pieces"),
    ),
}
"""Examples of all commands, each with what it is for."""

FIRST: dict[str, tuple[str, ...]] = {
    "inspect": ("lod", "histograms", "cameras", "box", "around", "path", "json", "drop_invalid"),
    "analyze": ("out", "cameras", "views", "width", "height", "lod", "box", "around", "path", "json"),
    "render": ("out", "cameras", "orbit", "eye", "target", "up", "width", "height", "fov", "lod"),
    "pvs": ("out", "cells", "cameras", "up", "box", "around", "path", "lod", "workers", "dry_run"),
    "pvs-report": ("out", "cells", "eyes", "dense", "certify", "raycast", "width", "height", "lod", "json"),
    "color": ("out", "pvs", "variant", "mean_terms", "epsilon", "report", "active", "lod", "up", "json"),
    "train": (
        "out",
        "images",
        "width",
        "height",
        "downscale",
        "steps",
        "sh_degree",
        "max_gaussians",
        "test_every",
        "overwrite",
    ),
    "levels": ("out", "levels", "steps", "photos", "cameras", "up", "box", "path", "lod", "json"),
    "clean": ("out", "report", "select", "strength", "cameras", "up", "box", "path", "lod", "overwrite"),
    "convert": (
        "out",
        "lod",
        "crop",
        "min_opacity",
        "sh_degree",
        "change_up",
        "scale",
        "rotate",
        "translate",
        "overwrite",
    ),
    "cut": ("out", "cameras", "path", "box", "around", "fov", "up", "lod", "min_psnr", "overwrite"),
    "paint": ("out", "by", "pvs", "path", "box", "around", "up", "lod", "overwrite", "json"),
    "prepare": ("out", "photos", "cameras", "path", "box", "around", "up", "lod", "levels", "dry_run"),
    "world": ("out", "lod", "tile", "far", "levels", "path", "up", "workers", "max_memory", "dry_run"),
    "verify": ("scene", "lod", "json", "debug"),
    "unpack": ("out", "sh_degree", "json", "debug"),
    "export": ("out", "format", "leaf", "compression", "meters_per_unit", "name", "lod", "up", "overwrite", "json"),
    "space": ("out", "box", "path", "up", "resolution", "frame", "meters_per_unit", "lod", "overwrite", "json"),
    "view": ("lod", "up", "cameras", "kind", "show", "prepare", "host", "port", "no_browser", "json"),
    "serve": ("host", "port", "token", "ssl_certfile", "ssl_keyfile", "origins", "clients", "workers", "cache"),
    "simulate": ("out", "path", "trace", "mbit", "round_trip", "scene", "whole_file", "seconds", "policy", "json"),
}
"""Options of each command that its `--help` shows, at most ten, in this order of importance."""

_WIDTH = 44  # columns of an example


def overview() -> str:
    """Return what `gsvis --help` prints: one sentence, all commands in groups, and where to read on."""
    lines = [
        "usage: gsvis COMMAND ...",
        "",
        "Stream trained 3D Gaussian Splatting scenes: what can be seen comes first.",
    ]
    for title, examples in GROUPS.items():
        lines += ["", f"{title}:"]
        lines += [f"  {example:<{_WIDTH}}{about}" for example, about in examples]
    lines += [
        "",
        "builtin:two_rooms in place of scene.ply is a scene to try with.",
        f"gsvis COMMAND --help lists the first options, {ALL} all of them.",
        "gsvis --version prints the version.",
    ]
    return "\n".join(lines) + "\n"


def short_help(kind: type) -> tuple[type, int]:
    """Return a command with only the options that matter first, and the number of the others.

    Args:
        kind: The dataclass of a command. The result is for printing help alone.
    """
    from gsvis.cli.options import command_name, leaves

    shown = FIRST[command_name(kind)]
    hidden = {leaf.name for leaf in leaves(kind) if leaf.name not in shown and leaf.default is not MISSING}
    return _for_print(kind, hidden), len(hidden)


def long_help(kind: type) -> type:
    """Return a command with all its options, for printing help alone."""
    return _for_print(kind, set())


def _for_print(kind: type, hidden: set[str]) -> type:
    """Return a command without groups and without the hidden options, whose texts `tyro` wraps to the terminal.

    `tyro` keeps the line breaks of the strings below the fields, so that their lines would end early.
    """
    from tyro import conf

    from gsvis.cli.options import command_name, leaves

    hide: Any = conf.Suppress
    replaced = []
    texts = option_texts(kind)
    for each in sorted(leaves(kind), key=partial(_importance, command_name(kind))):
        kept = field() if each.default is MISSING else field(default=each.default)
        described: Any = Annotated[each.hint, conf.arg(help=texts[each.name])]
        replaced.append((each.name, hide[each.hint] if each.name in hidden else described, kept))
    names = {"__doc__": kind.__doc__}
    return make_dataclass(kind.__name__, replaced, namespace=names, frozen=True, kw_only=True)


def _importance(command: str, leaf: Leaf) -> int:
    """Return the place of an argument in the help: positional ones, the first options, then the others."""
    first = FIRST[command]
    if leaf.name in first:
        return first.index(leaf.name)
    return -1 if leaf.default is MISSING else len(first) + (leaf.name == "debug")


def option_texts(kind: type) -> dict[str, str]:
    """Return the text of each argument of a command, in one line: its own, that of its field, or a shared one."""
    from gsvis.cli.options import leaves

    found = leaves(kind)
    below = {owner: _strings_below_fields(owner) for owner in dict.fromkeys(leaf.owner for leaf in found)}
    return {leaf.name: leaf.text or below[leaf.owner].get(leaf.name) or str(leaf.shared) for leaf in found}


def _strings_below_fields(kind: type) -> dict[str, str]:
    """Return the string below each field of a dataclass and of those that it extends."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        tree = ast.parse(textwrap.dedent(inspect.getsource(base)))
        assert isinstance(tree.body[0], ast.ClassDef)
        for one, below in pairwise(tree.body[0].body):
            match one, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    found[name] = " ".join(text.split())
    return found


def find_command(name: str) -> type | None:
    """Return the dataclass of a command by its name; None if there is none."""
    from gsvis.cli.arguments import Command
    from gsvis.cli.options import command_name

    return next((kind for kind in get_args(Command) if command_name(kind) == name), None)
