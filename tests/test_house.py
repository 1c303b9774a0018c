"""The size of things: short files, short functions, few parameters and attributes, one assignment a line.

Read from the source. The length of a function is its lines without the docstring. Kernels are exempt from lines and
parameters: they are compiled whole and take rows of arrays. Objects with too many attributes are listed; the list only
gets shorter.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "gsvis"
SOURCES = ("gsvis", "tools", "benchmarks", "examples", "tests")
MOST_LINES_OF_FILE = 600
MOST_LINES_OF_FUNCTION = 60
MOST_PARAMETERS = 8
MOST_ATTRIBUTES = 15
LARGE_OBJECTS = {
    "abr/_kernels/plan.py:Work": 16,
    "abr/config.py:AbrConfig": 21,
    "abr/index.py:SceneIndex": 18,
    "pvs/quality_result.py:Quality": 23,
    "scene/inspection.py:SceneReport": 19,
    "train/config.py:TrainConfig": 16,
}
"""Objects that have more attributes still: how many they may have. All are frozen: nothing changes together in them.

Work: arrays of a kernel, by name.
AbrConfig, TrainConfig: settings that users set one by one, by keyword. Groups would change the keys of checkpoints and
    of results in JSON.
SceneIndex: columns of tables; the names are those of files of kept tables.
Quality, SceneReport: results that users read one by one; the names are those in JSON, of `gsvis pvs-report` and
    `gsvis inspect`.
"""

Function = ast.FunctionDef | ast.AsyncFunctionDef


class Facts(NamedTuple):
    """What is measured in the modules of the package, each found by reading every module once.

    Attributes:
        functions: Names, lines and parameters of all functions outside kernels.
        objects: Names of all classes, and their numbers of attributes.
        packed: Places of statements that assign several values at once.
    """

    functions: list[tuple[str, int, int]]
    objects: list[tuple[str, int]]
    packed: list[str]


@cache
def facts() -> Facts:
    found = Facts([], [], [])
    for path in sorted(PACKAGE.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        lines = source.splitlines()
        name = path.relative_to(PACKAGE)
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ClassDef):
                found.objects.append((f"{name}:{node.name}", len(attributes_of(node))))
            elif isinstance(node, Function) and "_kernels" not in path.parts:
                found.functions.append((f"{name}:{node.name}", count_lines(node), count_parameters(node)))
            elif is_packed(node) and not any(mark in lines[node.end_lineno - 1] for mark in ("# fmt: skip", "# type:")):
                found.packed.append(f"{name}:{node.lineno}")
    return found


def count_lines(function: Function) -> int:
    first = function.body[0]
    lines = (function.end_lineno or 0) - function.lineno + 1
    if ast.get_docstring(function) is None:
        return lines
    return lines - ((first.end_lineno or 0) - first.lineno + 1)


def count_parameters(function: Function) -> int:
    given = function.args
    names = [each.arg for each in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    more = sum(each is not None for each in (given.vararg, given.kwarg))
    return len(names) + more - (names[:1] in (["self"], ["cls"]))


def test_no_file_is_longer_than_600_lines() -> None:
    paths = [path for folder in SOURCES for path in (ROOT / folder).rglob("*.py")]
    lines = {str(path.relative_to(ROOT)): len(path.read_bytes().splitlines()) for path in paths}
    assert len(lines) > 400
    assert {name: count for name, count in lines.items() if count > MOST_LINES_OF_FILE} == {}


def test_no_function_outside_kernels_is_longer_than_60_lines() -> None:
    lines = {name: lines for name, lines, _ in facts().functions}
    assert len(lines) > 1000
    assert {name: count for name, count in lines.items() if count > MOST_LINES_OF_FUNCTION} == {}


def test_no_function_outside_kernels_takes_more_than_8_parameters() -> None:
    counts = {name: count for name, _, count in facts().functions}
    assert {name: count for name, count in counts.items() if count > MOST_PARAMETERS} == {}


def attributes_of(node: ast.ClassDef) -> set[str]:
    """Return the attributes that methods of a class assign, and its annotated fields."""
    fields = {
        each.target.id for each in node.body if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
    }
    assigned = {
        each.attr
        for each in ast.walk(node)
        if isinstance(each, ast.Attribute) and isinstance(each.ctx, ast.Store)
        if isinstance(each.value, ast.Name) and each.value.id == "self"
    }
    return fields | assigned


def test_an_object_has_at_most_15_attributes() -> None:
    counts = dict(facts().objects)
    assert len(counts) > 300
    large = {name: count for name, count in counts.items() if count > MOST_ATTRIBUTES}
    assert {name: count for name, count in large.items() if count > LARGE_OBJECTS.get(name, MOST_ATTRIBUTES)} == {}


def test_attributes_are_counted() -> None:
    source = "class A:\n b: int\n def f(self):\n  self.c, self.d = 1, 2\n  self.c += 1\n  self.b = self.e\n"
    assert attributes_of(ast.parse(source).body[0]) == {"b", "c", "d"}


def names_in(nodes: Iterable[ast.expr]) -> set[str]:
    return {found.id for node in nodes for found in ast.walk(node) if isinstance(found, ast.Name)}


def is_packed(node: ast.AST) -> bool:
    """Whether a statement assigns several values to names at once although none of them needs the others' old ones."""
    if not isinstance(node, ast.Assign) or len(node.targets) != 1:
        return False
    targets, values = node.targets[0], node.value
    if not isinstance(targets, ast.Tuple) or not isinstance(values, ast.Tuple):
        return False
    plain = all(isinstance(each, ast.Name) for each in targets.elts)
    return plain and len(targets.elts) == len(values.elts) and not names_in(targets.elts) & names_in(values.elts)


def test_one_statement_assigns_one_value() -> None:
    assert facts().packed == []


def test_a_swap_is_no_packed_assignment() -> None:
    packed = [is_packed(node) for node in ast.parse("a, b = 1, 2\na, b = b, a\na, b = f()\na[0], b = 1, 2\n").body]
    assert packed == [True, False, False, False]


def test_lines_and_parameters_are_counted() -> None:
    source = 'class A:\n def f(self, a, /, b, *c, d=1, **e):\n  """One\n\n  two."""\n  return a\n'
    function = next(node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef))
    assert count_lines(function) == 2
    assert count_parameters(function) == 5
