"""A release agrees with itself: versions, dates, moved modules, hashes, the container, the workflow."""

from __future__ import annotations

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import gsvis

ROOT = Path(__file__).parents[1]


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def read_yaml(path: Path) -> dict[str, Any]:
    yaml = pytest.importorskip("yaml")
    found = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert isinstance(found, dict)
    return found


def test_every_file_names_the_same_version_and_date() -> None:
    version, date = re.findall(r"^## (\S+) \((\d{4}-\d\d-\d\d)\)$", read("CHANGELOG.md"), flags=re.MULTILINE)[0]
    assert gsvis.__version__ == version
    assert f'\nversion = "{version}"\n' in read("pyproject.toml")
    assert f"\nversion: {version}\n" in read("CITATION.cff")
    assert f"\ndate-released: {date}\n" in read("CITATION.cff")


def test_modules_that_moved_are_where_the_changelog_says() -> None:
    rows = re.findall(r"^  \| (`gsvis\..*?) \| (.*?) \|$", read("CHANGELOG.md"), flags=re.MULTILINE)
    assert len(rows) >= 12
    for old, new in rows:
        old_home, new_home = (re.findall(r"`(gsvis\.[\w.]+)`", cell)[0] for cell in (old, new))
        assert find_spec(new_home) is not None, new_home
        if old_home != "gsvis.visibility":
            package = old_home.rpartition(".")[0]
            assert package == "gsvis.visibility" or find_spec(old_home) is None, f"{old_home} still exists"
    assert not list((ROOT / "gsvis" / "visibility").glob("*.py"))


def resolve(name: str) -> object:
    """What a dotted name below gsvis means; None if it means nothing."""
    found: object = gsvis
    path = "gsvis"
    for word in name.split("."):
        path = f"{path}.{word}"
        found = getattr(found, word, None)
        if found is None:
            try:
                found = import_module(path)
            except ModuleNotFoundError:
                return None
    return found


def test_names_that_changed_are_called_as_the_changelog_says() -> None:
    (table,) = re.findall(
        r"^  \| old name \| new name \|\n  \|---\|---\|\n(.*?)\n\n", read("CHANGELOG.md"), re.DOTALL | re.M
    )
    rows = [re.findall(r"^  \| `([\w.]+)`(.*?) \| `([\w.]+)", row)[0] for row in table.splitlines()]
    assert len(rows) >= 15
    for old, others, new in rows:
        assert resolve(old) is None, f"{old} still exists"
        for other in re.findall(r"^, `(\w+)`", others):  # a sibling: in the class of the first, or beside it
            assert resolve(f"{old.rpartition('.')[0]}.{other}") is None, f"{other} still exists"
        assert resolve(new) is not None, f"{new} does not exist"


def test_requirements_are_hashed_and_in_range() -> None:
    lines = [line for line in read("requirements.txt").splitlines() if not line.startswith("#")]
    pins = {}
    for line in lines:
        name, version = re.fullmatch(r"(\S+)==(\S+) --hash=sha256:[0-9a-f]{64}", line).groups()  # type: ignore[union-attr]
        pins[canonicalize_name(name)] = version
    (block,) = re.findall(r"^dependencies = \[\n(.*?)^\]", read("pyproject.toml"), flags=re.DOTALL | re.MULTILINE)
    for line in re.findall(r'^ +"(.*)",$', block, flags=re.MULTILINE):
        wanted = Requirement(line)
        name = canonicalize_name(wanted.name)
        if name in pins and (wanted.marker is None or wanted.marker.evaluate()):
            assert wanted.specifier.contains(pins[name]), f"{wanted} against {pins[name]}"


def test_the_workflow_runs_what_everybody_runs() -> None:
    jobs = read_yaml(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]
    assert any(step.get("run") == ".ci/run" for step in jobs["check"]["steps"])
    lowest = re.findall(r'requires-python = ">=([\d.]+)"', read("pyproject.toml"))
    assert jobs["check"]["strategy"]["matrix"]["python"][0] == lowest[0]


def test_templates_are_whole() -> None:
    templates = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
    assert len(templates) >= 3
    for path in templates:
        found = read_yaml(path)
        assert path.name == "config.yml" or {"name", "description", "body"} <= set(found)


def test_compose_uses_the_site_that_is_tested() -> None:
    services = read_yaml(ROOT / "compose.yml")["services"]
    mounts = [volume.partition(":")[0] for volume in services["nginx"]["volumes"]]
    assert "./examples/deploy/nginx.conf" in mounts
    # nginx shares the network of gsvis, so that the site's 127.0.0.1:8765 is the server.
    assert services["nginx"]["network_mode"] == "service:gsvis"
    assert "127.0.0.1:8765" in read("examples/deploy/nginx.conf")


def test_commands_of_the_containers_are_commands_of_gsvis() -> None:
    from gsvis.cli.arguments import Serve
    from gsvis.cli.options import leaves

    services = read_yaml(ROOT / "compose.yml")["services"]
    (in_image,) = re.findall(r"^CMD \[(.*)\]$", read("Dockerfile"), flags=re.MULTILINE)
    for words in (services["gsvis"]["command"], re.findall(r'"(.*?)"', in_image)):
        assert words[0] == "serve"
        options = {word[2:].replace("-", "_") for word in words if word.startswith("--")}
        assert options <= {leaf.name for leaf in leaves(Serve)}


def test_the_image_copies_files_that_exist_and_are_sent() -> None:
    ignored = read(".dockerignore").splitlines()
    for sources in re.findall(r"^COPY (?!--from)(.*) \S+$", read("Dockerfile"), flags=re.MULTILINE):
        for source in sources.split():
            assert (ROOT / source).exists()
            assert f"!{source}" in ignored


def test_pages_of_formats_name_the_versions_of_the_code() -> None:
    from gsvis.package.manifest import FORMAT, VERSION
    from gsvis.stream import PROTOCOL

    assert f'| `format`, `version` | `"{FORMAT}"`, {VERSION} |' in read("docs/package.md")
    wire = read("docs/streaming.md")
    assert f"The version of the protocol is {PROTOCOL}." in wire
    assert f"| `protocol` | {PROTOCOL} |" in wire
    assert f"| u8 | version, {PROTOCOL};" in wire
    both = f"**Packages and the protocol are version {PROTOCOL}, packages with rounded records {VERSION}**"
    assert both in read("CHANGELOG.md")
