"""What the papers of the house say is so: commands, links, the README's example, the pins."""

from __future__ import annotations

import ast
import os
import re
from functools import cache
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def page(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_every_link_leads_somewhere() -> None:
    wrong = []
    for path in PAGES:
        text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        targets = [target for target in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in target]
        wrong += [f"{page(path)}: {target}" for target in targets if not (path.parent / target).exists()]
    assert wrong == []


def test_every_make_command_exists() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE))
    wrong = []
    for path in PAGES:
        commands = re.findall(r"(?:`|^)make ([a-z]+)", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        wrong += [f"{page(path)}: make {command}" for command in commands if command not in targets]
    assert wrong == []


def test_the_example_of_the_readme_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gsvis.scene import procedural

    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(example.strip().splitlines()) <= 15
    monkeypatch.chdir(tmp_path)
    small = procedural.two_rooms(2000)  # the flat takes long to make; its figure is checked with those of the tutorials
    monkeypatch.setitem(procedural.BUILTIN_SCENES, "flat", lambda: small)
    exec(compile(example, "README.md", "exec"), {})
    (needs,) = (float(n) for n in re.findall(r"([\d.]+)%", capsys.readouterr().out))
    assert 0 < needs < 100


def test_what_gsvis_depends_on_is_pinned_within_its_range() -> None:
    pins = {
        canonicalize_name(pin.name): pin
        for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        if not line.startswith("#")
        for pin in [Requirement(line)]
    }
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    lists = re.findall(r"^(?:dependencies|dev) = \[\n(.*?)^\]", text, flags=re.DOTALL | re.MULTILINE)
    assert len(lists) == 2
    for line in re.findall(r'^ +"(.*)",$', "".join(lists), flags=re.MULTILINE):
        wanted = Requirement(line)
        if canonicalize_name(wanted.name) != "open3d":  # its CPU build stands in for it
            (pin,) = pins[canonicalize_name(wanted.name)].specifier
            assert wanted.specifier.contains(pin.version), f"{wanted} against {pin}"


@pytest.mark.skipif(os.name != "posix", reason="POSIX file modes")
def test_ci_can_be_run() -> None:
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_the_page_of_gsvis_lists_every_name_of_it() -> None:
    import gsvis

    text = (ROOT / "docs" / "api" / "gsvis.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\[`(\w+)`\]\(", text)) == {name for name in gsvis.__all__ if not name.startswith("_")}


ROOMS = sorted(path.name for path in (ROOT / "gsvis").iterdir() if (path / "__init__.py").exists())
FOLDERS = ("gsvis", "tests", "tools", "benchmarks", "docs", "examples")
MARK = "Names that changed"  # begins the old names in CONTRIBUTING.md; CHANGELOG.md has them everywhere


def names_in(body: list[ast.stmt]) -> dict[str, list[ast.stmt]]:
    """Return what a module or a class defines by its text, with the body of each class."""
    names: dict[str, list[ast.stmt]] = {}
    for node in (each for statement in body for each in ast.walk(statement)):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            names[node.name] = node.body
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.setdefault(node.id if isinstance(node, ast.Name) else node.attr, [])
        elif isinstance(node, ast.alias):
            names.setdefault((node.asname or node.name).rpartition(".")[2], [])
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier():
            names.setdefault(node.value, [])  # of __all__
    return names


@cache
def body_of(file: Path) -> list[ast.stmt]:
    return ast.parse(file.read_text(encoding="utf-8")).body


def is_defined(place: Path, names: list[str]) -> bool:
    """Return whether a module or a room, given without its suffix, defines names, each inside the one before."""
    for k, name in enumerate(names):
        if (place / name).is_dir() or (place / f"{name}.py").exists():
            place /= name
            continue
        file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        body = body_of(file)
        for inner in names[k:]:
            found = names_in(body)
            if inner not in found:
                return False
            body = found[inner]
        return True
    return place.is_dir() or place.with_suffix(".py").exists()


def missing_from(text: str) -> list[str]:
    """Return the modules, names and files of this repository that a page names and that do not exist."""
    found = re.findall(r"`gsvis\.([\w.]*\w)`", text)
    wrong = [f"gsvis.{dotted}" for dotted in found if not is_defined(ROOT / "gsvis", dotted.split("."))]
    for place in re.findall(r"`((?:\w+/)+[\w.-]+)`", text):
        folder = place.partition("/")[0]
        exists = True
        if folder in FOLDERS and not re.search("[A-Z]{3}", place):  # capitals stand for any name
            exists = bool(list(ROOT.glob(f"{place}*")))
        elif folder in ROOMS and not place.endswith((".json", ".html")):  # a report has the name of a room
            module, _, names = place.removesuffix(".py").partition(".")
            exists = is_defined(ROOT / "gsvis", [*module.split("/"), *filter(None, names.split("."))])
        if not exists:
            wrong.append(place)
    return wrong


def test_every_module_and_file_that_a_page_names_exists() -> None:
    pages = [path for path in PAGES if path.name != "CHANGELOG.md"]
    texts = {page(path): path.read_text(encoding="utf-8").partition(MARK)[0] for path in pages}
    assert [f"{name}: {place}" for name, text in texts.items() for place in missing_from(text)] == []


def test_what_a_page_names_wrongly_is_found() -> None:
    text = "`gsvis.color.srbf` `gsvis.color.no_such` `docs/no_such.md` `docs/faq.md` `color/srbf.py` `color/no_such.py`"
    assert missing_from(text) == ["gsvis.color.no_such", "docs/no_such.md", "color/no_such.py"]


def test_names_are_found_where_they_are_defined() -> None:
    room = ROOT / "gsvis"
    for names in ("color", "color.srbf", "color.srbf.SrbfColors.offsets", "files.limits.Budget.claim", "Tracer"):
        assert is_defined(room, names.split(".")), names
    for names in ("colour", "color.no_such", "color.srbf.SrbfColors.no_such", "render.rasterizer.Budget"):
        assert not is_defined(room, names.split(".")), names


ARCHITECTURE = sorted((ROOT / "docs" / "architecture").glob("*.md"))
CONSTANT = re.compile(r"`((?:\w+/)+\w+)\.([A-Z_]+)`(?: = ([\d.e-]*\d))?")


@pytest.mark.parametrize("path", [each for each in ARCHITECTURE if each.name != "index.md"], ids=page)
def test_a_page_of_the_architecture_is_short_and_has_one_picture(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert 500 <= len(text.split()) <= 900
    assert re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text) == [f"../images/architecture/{path.stem}.svg"]
    assert f"({path.name})" in (path.parent / "index.md").read_text(encoding="utf-8")
    assert f"architecture/{path.name}" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")


def test_constants_on_pages_of_the_architecture_have_the_values_of_the_code() -> None:
    from importlib import import_module

    found = [each for path in ARCHITECTURE for each in CONSTANT.findall(path.read_text(encoding="utf-8"))]
    assert len(found) > 30
    for place, name, value in found:
        of_code = getattr(import_module(f"gsvis.{place.replace('/', '.')}"), name)
        assert not value or float(value) == of_code, f"{place}.{name} is {of_code}, not {value}"


def test_the_pictures_of_the_architecture_are_those_of_their_script() -> None:
    from tools import draw_architecture as drawing

    for picture in drawing.PICTURES:
        assert (drawing.OUT / f"{picture.file}.svg").read_text(encoding="utf-8") == drawing.draw(picture)
