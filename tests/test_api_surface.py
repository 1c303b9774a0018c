"""Public names are frozen in `api_surface.json`: a change to them is made on purpose, or not at all.

After a change that is meant: `python tests/test_api_surface.py --write`, and a line in CHANGELOG.md.
"""

from __future__ import annotations

import importlib
import inspect
import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FROZEN = Path(__file__).with_name("api_surface.json")


def packages() -> list[str]:
    """gsvis and its rooms that state their public names."""
    rooms = sorted(p.parent.name for p in (ROOT / "gsvis").glob("*/__init__.py") if not p.parent.name.startswith("_"))
    files = sorted(p.stem for p in (ROOT / "gsvis").glob("*.py") if not p.stem.startswith("_"))
    return ["gsvis", *(f"gsvis.{name}" for name in sorted({*rooms, *files}))]


def described(value: Any) -> Any:
    """A signature for a function, the public members for a class, the type for anything else."""
    if inspect.isclass(value):
        members = (
            {"__init__": signature(value)} if "__init__" in vars(value) or not issubclass(value, Exception) else {}
        )
        for name, member in sorted(vars(value).items()):
            if name.startswith("_"):
                continue
            if isinstance(member, property):
                members[name] = "property"
            elif callable(member) or isinstance(member, classmethod | staticmethod):
                members[name] = signature(getattr(value, name))
        return members
    return signature(value) if callable(value) and hasattr(value, "__module__") else type(value).__name__


class Bare:
    """Prints as the text it is given, without quotes."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


def signature(value: Any) -> str:
    if hasattr(value, "__origin__"):
        return "alias"
    try:
        written = inspect.signature(value)
    except (TypeError, ValueError):  # a class written in C
        return type(value).__name__
    parameters = [
        p.replace(annotation=annotation(p.annotation), default=default(p.default)) for p in written.parameters.values()
    ]
    return str(written.replace(parameters=parameters, return_annotation=annotation(written.return_annotation)))


def annotation(value: Any) -> Any:
    """As it stands in the source: under `from __future__ import annotations` it is a string."""
    return Bare(value) if isinstance(value, str) else value


def default(value: Any) -> Any:
    """A function by its name: its address differs from run to run."""
    return Bare(value.__qualname__) if inspect.isroutine(value) else value


def surface() -> dict[str, dict[str, Any]]:
    found = {}
    for package in packages():
        module = importlib.import_module(package)
        names = getattr(module, "__all__", None)
        if names is not None:
            found[package] = {name: described(getattr(module, name)) for name in sorted(names)}
    return found


def test_public_names_are_the_frozen_ones() -> None:
    message = "the public names changed; if that is meant: python tests/test_api_surface.py --write"
    assert surface() == json.loads(FROZEN.read_text(encoding="utf-8")), message


def test_public_names_are_documented_where_they_live() -> None:
    for package in packages():
        module = importlib.import_module(package)
        for name in getattr(module, "__all__", []):
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isfunction(value):
                assert inspect.getdoc(value), f"{package}.{name} has no docstring"


def test_dir_shows_what_is_public_and_nothing_else() -> None:
    for package in packages():
        module = importlib.import_module(package)
        if not hasattr(module, "__path__"):
            continue
        files = [p.stem for p in Path(module.__path__[0]).glob("*.py") if not p.stem.startswith("_")]
        public = getattr(module, "__all__", files)
        extra = {"__version__"} if package == "gsvis" else set()
        assert set(dir(module)) == {*public, *extra}, package
        if hasattr(module, "__all__"):
            assert all(hasattr(module, name) for name in dir(module)), package


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    text = json.dumps(surface(), indent=1, ensure_ascii=False) + "\n"
    if "--write" in sys.argv[1:]:
        FROZEN.write_text(text, encoding="utf-8")
    else:
        sys.stdout.write(text)
