"""Options in groups: few attributes, one name once in a command, and the defaults of the library."""

from __future__ import annotations

import re
import shlex
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest

from gsvis.cli import arguments, arguments_edit, arguments_publish, options, parse
from gsvis.cli.arguments import Command
from gsvis.cli.options import changed, command_line, command_name, config_of, leaves, refuse, values_of
from gsvis.color.fit import FitConfig
from gsvis.edit import CleanConfig, CutConfig
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.quality import QualityConfig
from gsvis.raycast.analysis import AnalysisConfig
from gsvis.serve import Address, AppConfig, Limits
from gsvis.simulate import ViewingConfig

KINDS = {command_name(kind): kind for kind in get_args(Command)}
SAME: dict[type, tuple[type, dict[str, str]]] = {
    arguments.Tracing: (AnalysisConfig, {}),
    arguments.CertifiedSets: (PvsConfig, {"face_size": "size", "certify": "rays"}),
    arguments_publish.MendedSets: (PvsConfig, {"face_size": "size", "certify": "rays"}),
    arguments.Quality: (QualityConfig, {"eyes": "viewpoints", "raycast": "rays"}),
    options.Fit: (FitConfig, {}),
    arguments_publish.FilteredFit: (FitConfig, {}),
    arguments.Viewing: (ViewingConfig, {}),
    arguments_edit.Search: (CleanConfig, {"min_psnr": "least_db", "max_changed": "most_changed"}),
    arguments_edit.Looking: (CutConfig, {"face_size": "size"}),
    arguments_publish.Address: (Address, {}),
    arguments_publish.Access: (AppConfig, {}),
    arguments_publish.Bounds: (
        Limits,
        {"clients": "connections", "poses": "poses_per_s", "messages": "messages_per_s"},
    ),
}
"""Groups of options, the configuration of the library that each is of, and the names there of options."""


def groups_of(kind: type) -> set[type]:
    """Return a dataclass and the groups in it."""
    found = {kind}
    for hint in get_type_hints(kind, include_extras=True).values():
        plain = get_args(hint)[0] if get_origin(hint) is Annotated else hint
        if isinstance(plain, type) and is_dataclass(plain):
            found |= groups_of(plain)
    return found


@pytest.mark.parametrize("name", sorted(KINDS))
def test_no_command_and_no_group_has_more_than_15_attributes(name: str) -> None:
    assert {group.__name__: len(fields(group)) for group in groups_of(KINDS[name]) if len(fields(group)) > 15} == {}
    names = [leaf.name for leaf in leaves(KINDS[name])]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("group", SAME, ids=lambda group: group.__name__)
def test_options_have_the_defaults_of_the_library(group: type) -> None:
    """An option of None takes that of the library, which its help tells."""
    config, renamed = SAME[group]
    known = {each.name: each.default for each in fields(config)}
    compared = 0
    for leaf in leaves(group):
        default = known.get(renamed.get(leaf.name, leaf.name), MISSING)
        if default is MISSING:
            continue
        compared += 1
        if leaf.default is None and default is not None:
            (told,) = [each.help_behavior_hint for each in leaf.extras if getattr(each, "help_behavior_hint", None)][
                -1:
            ]
            assert re.match(rf"\(default: {default:.9g}\b", told), leaf.name
        else:
            assert leaf.default == default, leaf.name
    assert compared >= 2


def test_a_configuration_takes_what_is_given() -> None:
    command: Any = parse(["pvs", "a.ply", "-o", "a.pvs", "--limit", "0.01", "--face-size", "64"])
    config = config_of(PvsConfig, command.sets, size=command.sets.face_size, rays=command.sets.certify)
    assert config == PvsConfig(limit=0.01, size=64)


@pytest.mark.parametrize(
    "words",
    [
        "color a.ply -o b.arrow --mean-terms all --epsilon auto --up '0 0 1' --box 0 0 0 1 1 1 --fit omp",
        "prepare a.ply -o b.gsvis --levels none --max-memory 2GB --names low high --around auto --limit 0.002",
        "world a.ply b.ply -o c.gsworld --lod 3,2 --angle 0.01 --work s3://a/b --until tiles",
        "render a.ply -o b/ --index 3 5 --cameras c.json --background 0 0.5 1 --contributors 3,4",
        "serve a.gsvis b.gsvis --hosts a.org b.org --cache 1GB --handshake 2.5",
        "clean a.ply --select b.npy --classes fog floaters --path walk.csv --margin 0.25",
    ],
)
def test_a_command_line_is_read_as_it_was(words: str) -> None:
    command = parse(shlex.split(words))
    again = parse(shlex.split(command_line(command))[1:])
    assert {name: _plain(value) for name, value in values_of(again).items()} == {
        name: _plain(value) for name, value in values_of(command).items()
    }


def _plain(value: Any) -> Any:
    return value.strip() if isinstance(value, str) else value


def test_an_option_that_makes_no_sense_is_named() -> None:
    command = parse(["paint", "a.ply", "-o", "b.ply", "--up", "-y", "--eyes", "3"])
    assert changed(command) == {"--up": [" -y"], "--eyes": ["3"]}
    with pytest.raises(ValueError, match=r"^--eyes: expected none with --pvs, got 3; leave it out$"):
        refuse(command, ["face_size", "eyes", "up"], "with --pvs")


def test_groups_are_frozen() -> None:
    for kind in KINDS.values():
        for group in groups_of(kind):
            assert hash(group) is not None
            assert group.__dataclass_params__.frozen  # type: ignore[attr-defined]
    assert options.PLACING
