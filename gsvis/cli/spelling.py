"""Check the names of commands and options, and expand `~` in paths.

The names come from the dataclasses of `gsvis.cli.arguments`. For a mistyped name, this module gives one line with a
suggestion, before `tyro` reads the arguments. It replaces `~` by the home folder for shells that do not (`--out=~/x`).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

from gsvis.cli.help import command_name
from gsvis.cli.renamed import current_name

if TYPE_CHECKING:
    from gsvis.cli.arguments import Command

__all__ = ["expand_home", "misspelling", "paths_first"]

_PATHS = frozenset(
    {"DIR", "FILE", "IMAGES", "IN", "OUT", "PACKAGE", "PHOTOS", "SCENE", "STORE"}
)  # metavars of paths, by their first word


@dataclass(frozen=True)
class _Option:
    """One argument of a command.

    Attributes:
        field: Its field in the dataclass.
        names: Its names; none for a positional one.
        choices: Its choices if it is a Literal.
        path: Whether it is a path.
        words: Number of its words; 0 for a flag.
    """

    field: str
    names: tuple[str, ...]
    choices: tuple[str, ...]
    path: bool
    words: int


def misspelling(arguments: Sequence[str]) -> str | None:
    """Return a message about the first unknown command, option or choice; None if all are known.

    Args:
        arguments: Arguments of the command line, without the program's name.
    """
    commands = {command_name(kind): kind for kind in _kinds()}
    if not arguments or arguments[0] in ("-h", "--help"):
        return None
    name = arguments[0]
    if name not in commands:
        if name.startswith("-"):
            return f"expected a command before {name!r}, such as gsvis inspect; gsvis --help lists them"
        near = _suggestion(name, commands)
        return f"no command {name[:80]!r}; {near or 'gsvis --help lists the commands'}"
    options = {each: option for option in _options(commands[name]) for each in option.names}
    for place, word in enumerate(arguments[1:], 1):
        if not re.match(r"--?[A-Za-z]", word):
            continue  # a value, perhaps a negative number
        given, equals, value = word.partition("=")
        option = options.get(_hyphens(given))
        if option is None and f"-{_hyphens(given)}" in options:
            return f"gsvis {name} has no option {given}; did you mean -{_hyphens(given)}?"
        if option is None and (renamed := current_name(name, _hyphens(given), options)) is not None:
            return renamed
        if option is None and given.startswith("--") and given not in ("--help", "--help-all", "--debug"):
            near = _suggestion(_hyphens(given), [each for each in options if each.startswith("--")])
            return f"gsvis {name} has no option {given[:80]}; {near or f'gsvis {name} --help lists its options'}"
        if option is not None and option.choices:
            value = value if equals else arguments[place + 1] if place + 1 < len(arguments) else ""
            if value and value not in option.choices:
                near = _suggestion(value, option.choices)
                known = f"{given}: expected one of {', '.join(option.choices)}, got {value[:80]!r}"
                return known + (f"; {near}" if near else "")
    return None


def paths_first(arguments: Sequence[str]) -> list[str]:
    """Return the arguments of `gsvis convert` with its paths before its options; those of other commands unchanged.

    `tyro` takes paths of any number only where they stand together.
    """
    if arguments[:1] != ["convert"]:
        return list(arguments)
    kind = next(kind for kind in _kinds() if command_name(kind) == "convert")
    words = {name: option.words for option in _options(kind) for name in option.names}
    paths = []
    options = []
    rest = list(arguments[1:])
    while rest:
        word = rest.pop(0)
        if word == "--":
            paths += rest
            break
        if not re.match(r"--?[A-Za-z]", word):
            paths.append(word)
            continue
        name, equals, _ = word.partition("=")
        count = max(0, words.get(_hyphens(name), 0) - bool(equals))
        options += [word, *rest[:count]]
        del rest[:count]
    if any(path.startswith("-") for path in paths):
        return ["convert", *options, "--", *paths]
    return ["convert", *paths, *options]


def expand_home(command: Command) -> Command:
    """Return the command with `~` in its paths replaced by the home folder, and ways through missing folders by others.

    `new/../scene.ply` names `scene.ply` once a writer has made the folder `new`, so it is compared as that.
    """
    changed: dict[str, Any] = {}
    for option in _options(type(command)):
        value = getattr(command, option.field)
        if not option.path or value is None:
            continue
        if isinstance(value, str):
            changed[option.field] = _plain(value)
        else:
            changed[option.field] = tuple(map(_plain, value))
    return replace(command, **changed)


def _plain(path: str) -> str:
    found = os.path.expanduser(path)
    if os.pardir not in re.split(r"[/\\]" if os.sep == "\\" else "/", found) or os.path.lexists(found):
        return found
    return os.path.realpath(found)


def _suggestion(word: str, choices: Iterable[str]) -> str:
    from gsvis._check import suggestion  # imports numpy, which help does not need

    return suggestion(word, choices)


def _kinds() -> tuple[type, ...]:
    from gsvis.cli import arguments

    return get_args(arguments.Command)


def _options(kind: type) -> Iterator[_Option]:
    """Yield the arguments of a command; positional arguments have no names."""
    hints = get_type_hints(kind, include_extras=True)
    for each in fields(kind):
        hint = hints[each.name]
        extras: tuple[Any, ...] = hint.__metadata__ if get_origin(hint) is Annotated else ()
        metavars = [str(extra.metavar) for extra in extras if getattr(extra, "metavar", None)]
        aliases = [alias for extra in extras for alias in getattr(extra, "aliases", None) or ()]
        placed = any("POSITIONAL" in str(extra).upper() for extra in extras)
        plain = get_args(hint)[0] if extras else hint
        choices = tuple(map(str, get_args(plain))) if get_origin(plain) is Literal else ()
        names = () if placed else (f"--{_hyphens(each.name)}", *aliases)
        counts = [extra.nargs for extra in extras if isinstance(getattr(extra, "nargs", None), int)]
        count = 0 if plain is bool else counts[0] if counts else 1
        yield _Option(each.name, names, choices, any(word.split()[0] in _PATHS for word in metavars), count)


def _hyphens(name: str) -> str:
    """Return a name with hyphens for underscores: --max_terms -> --max-terms. Users may write both."""
    return name.replace("_", "-")
