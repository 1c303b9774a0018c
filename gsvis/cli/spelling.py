"""Check the names of commands and options, and expand `~` in paths.

The names come from the dataclasses of `gsvis.cli.arguments`. For a mistyped name, this module gives one line with a
suggestion, before `tyro` reads the arguments. It replaces `~` by the home folder for shells that do not (`--out=~/x`).
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import MISSING
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from gsvis.cli.options import Leaf, command_name, leaves, replaced
from gsvis.cli.renamed import current_name

if TYPE_CHECKING:
    from gsvis.cli.arguments import Command

__all__ = ["axes_as_values", "expand_home", "is_number", "is_path", "misspelling", "names_of", "paths_first"]

_PATHS = frozenset(
    {"DIR", "FILE", "IMAGES", "IN", "OUT", "PACKAGE", "PHOTOS", "SCENE", "STORE"}
)  # metavars of paths, by their first word


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
    options = {each: leaf for leaf in leaves(commands[name]) for each in names_of(leaf)}
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
        if option is not None and (choices := _choices(option)):
            value = value if equals else arguments[place + 1] if place + 1 < len(arguments) else ""
            if value and value not in choices:
                near = _suggestion(value, choices)
                known = f"{given}: expected one of {', '.join(choices)}, got {value[:80]!r}"
                return known + (f"; {near}" if near else "")
    return _without_option(arguments, list(leaves(commands[name])))


def _without_option(arguments: Sequence[str], known: Sequence[Leaf]) -> str | None:
    """Return a message if what to write stands behind the input, as in `cp`, where the command has -o for it."""
    wanted = {leaf.name: leaf for leaf in known if leaf.default is MISSING and not leaf.is_positional}
    taken = [leaf for leaf in known if leaf.is_positional]
    name, *words = arguments
    places, options = _apart(words, known)
    given = {word.partition("=")[0] for word in options}
    if list(wanted) != ["out"] or given & {*names_of(wanted["out"]), "-h", "--help", "--help-all"}:
        return None
    if len(places) != len(taken) + 1 or any(get_origin(get_args(leaf.hint)[0]) is tuple for leaf in taken):
        return None
    return f"gsvis {name} writes where -o says: gsvis {name} {shlex.join(places[:-1])} -o {shlex.quote(places[-1])}"


def paths_first(arguments: Sequence[str]) -> list[str]:
    """Return the arguments of `gsvis convert` with its paths before its options; those of other commands unchanged.

    `tyro` takes paths of any number only where they stand together.
    """
    if arguments[:1] != ["convert"]:
        return list(arguments)
    kind = next(kind for kind in _kinds() if command_name(kind) == "convert")
    paths, options = _apart(arguments[1:], leaves(kind))
    if any(path.startswith("-") for path in paths):
        return ["convert", *options, "--", *paths]
    return ["convert", *paths, *options]


def _apart(arguments: Sequence[str], known: Iterable[Leaf]) -> tuple[list[str], list[str]]:
    """Return the arguments without a name, and the options with their values."""
    words = {name: _count_words(leaf) for leaf in known for name in names_of(leaf)}
    paths = []
    options = []
    rest = list(arguments)
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
    return paths, options


def axes_as_values(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with the value of --up or --change-up as one word that tyro does not read as an option.

    A space goes before -y, and the three numbers of a direction become one word.
    """
    words = list[str]()
    rest = list(arguments)
    while rest:
        word = rest.pop(0)
        option, equals, value = word.partition("=")
        if option.replace("_", "-") not in ("--up", "--change-up") or not (equals or rest):
            words.append(word)
            continue
        given = [value if equals else rest.pop(0)]
        while len(given) < 3 and rest and is_number(rest[0]) and is_number(given[0]):
            given.append(rest.pop(0))
        words += [option, " " + " ".join(given)]
    return words


def is_number(word: str) -> bool:
    """Return whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def expand_home(command: Command) -> Command:
    """Return the command with `~` in its paths replaced by the home folder, and ways through missing folders by others.

    `new/../scene.ply` names `scene.ply` once a writer has made the folder `new`, so it is compared as that.
    """
    changed: dict[tuple[str, ...], Any] = {}
    for leaf in leaves(type(command)):
        value = leaf.of(command)
        if is_path(leaf) and value is not None:
            changed[leaf.path] = _plain(value) if isinstance(value, str) else tuple(map(_plain, value))
    return replaced(command, changed)


def _plain(path: str) -> str:
    """Return a path with the home folder in place of `~`, and without a way through a missing folder."""
    found = os.path.expanduser(path)
    if os.pardir not in re.split(r"[/\\]" if os.sep == "\\" else "/", found) or os.path.lexists(found):
        return found
    return os.path.realpath(found)


def _suggestion(word: str, choices: Iterable[str]) -> str:
    """Return a phrase that suggests the nearest choice; empty if none is near."""
    from gsvis._check import suggestion  # imports numpy, which help does not need

    return suggestion(word, choices)


def _kinds() -> tuple[type, ...]:
    """Return the dataclasses of all commands."""
    from gsvis.cli import arguments

    return get_args(arguments.Command)


def names_of(leaf: Leaf) -> tuple[str, ...]:
    """Return the names of an option; none for a positional argument."""
    aliases = (alias for extra in leaf.extras for alias in getattr(extra, "aliases", None) or ())
    return () if leaf.is_positional else (leaf.option, *aliases)


def is_path(leaf: Leaf) -> bool:
    """Return whether an argument is a path."""
    metavars = (str(extra.metavar) for extra in leaf.extras if getattr(extra, "metavar", None))
    return any(word.split()[0] in _PATHS for word in metavars)


def _choices(leaf: Leaf) -> tuple[str, ...]:
    """Return the words that an option takes; none if it takes any."""
    plain = get_args(leaf.hint)[0] if leaf.extras else leaf.hint
    return tuple(map(str, get_args(plain))) if get_origin(plain) is Literal else ()


def _count_words(leaf: Leaf) -> int:
    """Return the number of words of the value of an option; 0 for a flag."""
    plain = get_args(leaf.hint)[0] if leaf.extras else leaf.hint
    counts = [extra.nargs for extra in leaf.extras if isinstance(getattr(extra, "nargs", None), int)]
    return 0 if plain is bool else counts[0] if counts else 1


def _hyphens(name: str) -> str:
    """Return a name with hyphens for underscores: --max_terms -> --max-terms. Users may write both."""
    return name.replace("_", "-")
