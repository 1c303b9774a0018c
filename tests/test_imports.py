"""The house: data flows one way, and some things have no place in it. Read from the source, nothing is imported."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "gsvis"
ROOMS = (
    "errors",
    "progress",
    "_extras",
    "_text",
    "_sorting",
    "_check",
    "files",
    "_kernels",
    "scene",
    "io",
    "jobs",
    "color",
    "render",
    "raycast",
    "hpr",
    "pvs",
    "train",
    "package",
    "prepare",
    "abr",
    "stream",
    "simulate",
    "world",
    "edit",
    "export",
    "serve",
    "report",
    "cli",
)
NOT_NAMES = ("util", "helper", "manager", "common", "misc")
MODULES = sorted(PACKAGE.rglob("*.py"))

Statement = ast.Import | ast.ImportFrom


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module: str) -> str | None:
    """The room of `gsvis.room.module`; None for the package itself, which may show every room."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else None


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def statements(path: Path) -> tuple[Statement, ...]:
    """All import statements of a module."""
    return tuple(node for node in ast.walk(parse(path)) if isinstance(node, Statement))


def imported(path: Path) -> Iterator[str]:
    """Full names of all that a module imports from gsvis, at its top, in functions and under conditions."""
    package = name_of(path).split(".") if path.stem == "__init__" else name_of(path).split(".")[:-1]
    for node in statements(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "gsvis")
        else:
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *(node.module or "").split(".")]).rstrip(".")
            if source == "gsvis":  # `from gsvis import io` names rooms
                yield from (f"gsvis.{alias.name}" for alias in node.names)
            elif source.startswith("gsvis."):
                yield source


def climbs_of(path: Path) -> Iterator[str]:
    """What is wrong with the imports of a module: rooms without a place in the order, and rooms below its own."""
    room = room_of(name_of(path))
    if room in (None, "__main__"):
        return
    if room not in ROOMS:
        yield f"{room} has no place in the order of rooms"
        return
    for target in imported(path):
        other = room_of(target)
        if other not in ROOMS:
            yield f"{name_of(path)} imports {target}: import it from its room, not from the package"
        elif ROOMS.index(other) > ROOMS.index(room):
            yield f"{name_of(path)} imports {target}, a room below it"


def test_a_module_imports_only_from_rooms_above_it() -> None:
    assert [line for path in MODULES for line in climbs_of(path)] == []


def named(path: Path) -> Iterator[str]:
    """Full names of all that a module imports from gsvis, with the names taken from modules."""
    package = name_of(path).split(".") if path.stem == "__init__" else name_of(path).split(".")[:-1]
    for node in statements(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        else:
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *(node.module or "").split(".")]).rstrip(".")
            yield from (f"{source}.{alias.name}" for alias in node.names)


def is_private(name: str) -> bool:
    """Whether a name is private to its room: an underscore below `gsvis.room`."""
    return any(part.startswith("_") and not part.startswith("__") for part in name.split(".")[2:])


def test_a_module_imports_no_private_name_of_another_room() -> None:
    found = [
        f"{name_of(path)} imports {target}, a private name"
        for path in MODULES
        for target in named(path)
        if target.startswith("gsvis.") and room_of(target) != room_of(name_of(path)) and is_private(target)
    ]
    assert found == []


def bad_habits_of(path: Path) -> Iterator[str]:
    """What a module does that no module of the house does."""
    source = path.read_text(encoding="utf-8")
    tree = parse(path)
    if len(source.splitlines()) > 600:
        yield f"{name_of(path)}: more than 600 lines"
    if any(word in path.stem for word in NOT_NAMES):
        yield f"{name_of(path)}: a name that says nothing"
    if source.strip() and not ast.get_docstring(tree):
        yield f"{name_of(path)}: a module opens by saying what it is about"
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            word = node.func.id
            if word in ("breakpoint", "eval", "exec") or (word == "print" and room_of(name_of(path)) != "cli"):
                yield f"{name_of(path)}, line {node.lineno}: {word}"
        if isinstance(node, ast.ExceptHandler) and node.type is None:
            yield f"{name_of(path)}, line {node.lineno}: a bare except"


def test_a_module_keeps_the_habits_of_the_house() -> None:
    assert [line for path in MODULES for line in bad_habits_of(path)] == []


def test_bad_habits_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "gsvis"
    (package / "io").mkdir(parents=True)
    monkeypatch.setattr(f"{__name__}.PACKAGE", package)
    module = package / "io" / "utils.py"
    module.write_text("try:\n    print(eval('1'))\nexcept:\n    import gsvis.cli.view\n" + "\n" * 600)
    assert [line.partition(": ")[2] for line in bad_habits_of(module)] == [
        "more than 600 lines",
        "a name that says nothing",
        "a module opens by saying what it is about",
        "a bare except",
        "print",
        "eval",
    ]
    assert list(climbs_of(module)) == ["gsvis.io.utils imports gsvis.cli.view, a room below it"]


def test_a_private_name_is_seen_in_every_spelling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "gsvis"
    (package / "io").mkdir(parents=True)
    monkeypatch.setattr(f"{__name__}.PACKAGE", package)
    module = package / "io" / "x.py"
    module.write_text(
        "import gsvis.render._kernels.tiles\nfrom gsvis.render import _kernels\nfrom gsvis.render.cpu import _array\n"
        "from gsvis import _check\nfrom gsvis._kernels.bits import ones\nfrom ..color import _kinds\n"
    )
    assert [is_private(name) for name in named(module)] == [True, True, True, False, False, True]


def statements_that_run(node: ast.AST) -> Iterator[Statement]:
    """Import statements at the top of a module and in its functions, without those that only types need."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, Statement):
            yield child
        elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            for other in child.orelse:
                yield from statements_that_run(other)
        else:
            yield from statements_that_run(child)


def modules_needed(path: Path, every: set[str]) -> set[str]:
    """Full names of the modules that a module needs, now or when one of its functions runs."""
    package = name_of(path).split(".") if path.stem == "__init__" else name_of(path).split(".")[:-1]
    found: set[str] = set()
    for node in statements_that_run(parse(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
            continue
        base = package[: len(package) - node.level + 1] if node.level else []
        source = ".".join([*base, *(node.module or "").split(".")]).rstrip(".")
        names = {alias.name: f"{source}.{alias.name}" for alias in node.names}
        found |= {full if full in every else source for full in names.values()}
    return (found & every) - {name_of(path)}


def circle(needs: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the modules that lie on circles or between them, with what keeps each there."""
    left = dict(needs)
    while ends := {name for name, below in left.items() if not below & left.keys()}:
        left = {name: below for name, below in left.items() if name not in ends}
    while starts := left.keys() - set().union(*left.values()):
        left = {name: below for name, below in left.items() if name not in starts}
    return {name: below & left.keys() for name, below in left.items()}


def test_no_modules_need_each_other_in_a_circle() -> None:
    """A late import closes a circle too. Only what types need may go round."""
    every = {name_of(path) for path in MODULES}
    assert circle({name_of(path): modules_needed(path, every) for path in MODULES}) == {}


def test_a_circle_is_seen_at_any_depth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = tmp_path / "gsvis" / "io"
    room.mkdir(parents=True)
    monkeypatch.setattr(f"{__name__}.PACKAGE", room.parent)
    (room / "a.py").write_text("def f():\n    if True:\n        from . import b\n")
    (room / "b.py").write_text("from .c import g\n")
    (room / "c.py").write_text("class C:\n    def h(self):\n        import gsvis.io.a as a\n")
    (room / "d.py").write_text(
        "from typing import TYPE_CHECKING\nfrom gsvis.io import a\nif TYPE_CHECKING:\n    from gsvis.io import e\n"
    )
    (room / "e.py").write_text("from gsvis.io.d import x\n")
    paths = sorted(room.iterdir())
    found = circle({name_of(path): modules_needed(path, {name_of(path) for path in paths}) for path in paths})
    assert found == {"gsvis.io.a": {"gsvis.io.b"}, "gsvis.io.b": {"gsvis.io.c"}, "gsvis.io.c": {"gsvis.io.a"}}


def test_every_room_in_the_tree_has_a_place_in_the_order() -> None:
    rooms = {p.stem for p in PACKAGE.iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()}
    assert rooms - {"__init__", "__main__"} <= set(ROOMS)


def test_the_reader_of_imports_sees_every_spelling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "gsvis"
    (package / "io").mkdir(parents=True)
    monkeypatch.setattr(f"{__name__}.PACKAGE", package)
    module = package / "io" / "x.py"
    module.write_text(
        "import gsvis.raycast.tracer as t, numpy\nfrom gsvis import cli\nfrom gsvis.scene.sh import SH_C0\n"
        "from . import ply\nfrom .ply import read\nfrom ..report import html\nfrom .. import hpr\n"
        "def f():\n    from gsvis.serve import run\n"
    )
    assert sorted(imported(module)) == [
        "gsvis.cli",
        "gsvis.hpr",
        "gsvis.io",
        "gsvis.io.ply",
        "gsvis.raycast.tracer",
        "gsvis.report",
        "gsvis.scene.sh",
        "gsvis.serve",
    ]
