"""A manifest with anything in place of any value, under a digest that fits, is read or refused as FormatError."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from gsvis.errors import FormatError
from gsvis.package import Package
from gsvis.package import manifest as manifests
from gsvis.package.manifest import Manifest
from gsvis.stream import StreamedScene
from tests.damage import OTHERS, places, replaced, without
from tests.stream.worlds import package_of


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A package, and what its manifest says."""
    folder = tmp_path_factory.mktemp("made") / "s.gsvis"
    package_of(folder, 60, "hsl").close()
    value = json.loads((folder / manifests.MANIFEST).read_bytes())
    del value["sha256"]
    return folder, value


def signed(value: Any) -> bytes:
    """The bytes of a manifest with a digest that fits."""
    return json.dumps({**value, "sha256": manifests._digest(value)} if isinstance(value, dict) else value).encode()


def reads(path: Path, data: bytes) -> bool:
    """Whether a manifest is read; nothing but FormatError may stop it."""
    path.write_bytes(data)
    try:
        Manifest.read(path)
    except FormatError as error:
        assert "\n" not in str(error)
        return False
    return True


@pytest.mark.parametrize("name", OTHERS)
def test_another_value_anywhere_is_read_or_refused(
    made: tuple[Path, dict[str, Any]], tmp_path: Path, name: str
) -> None:
    _, value = made
    trails = list(places(value))
    assert ("quantization", "colors", "variant") in trails
    good = sum(reads(tmp_path / "m.json", signed(replaced(value, trail, OTHERS[name]))) for trail in trails)
    assert good < len(trails)


def test_a_value_that_is_missing_is_read_or_refused(made: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    _, value = made
    for trail in places(value):
        if trail:
            reads(tmp_path / "m.json", signed(without(value, trail)))


@pytest.mark.parametrize(
    ("trail", "named"),
    [
        (("quantization", "colors", "variant"), "variant: expected one of"),
        (("scene",), "scene: expected a string"),
        (("levels", 0, "name"), r"levels\[0\]\.name: expected a string"),
        (("quantization", "colors", "precision", "name"), "name: expected a string"),
    ],
)
def test_what_is_no_text_is_refused_by_its_name(
    made: tuple[Path, dict[str, Any]], tmp_path: Path, trail: tuple[Any, ...], named: str
) -> None:
    for other in ([], {}, 7, None, "\ud800"):
        (tmp_path / "m.json").write_bytes(signed(replaced(made[1], trail, other)))
        with pytest.raises(FormatError, match=named):
            Manifest.read(tmp_path / "m.json")


def test_nesting_of_any_depth_is_read_or_refused(made: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    text = json.dumps(made[1] | {"provenance": 0}, sort_keys=True, separators=(",", ":"))
    read = []
    for depth in (10, 100, *range(850, 1010), 100_000):
        nested = text.replace('"provenance":0', '"provenance":' + '{"a":' * depth + "1" + "}" * depth)
        digest = hashlib.sha256(nested.encode()).hexdigest()
        read.append(reads(tmp_path / "m.json", f'{nested[:-1]},"sha256":"{digest}"}}'.encode()))
    assert read[:2] == [True, True]
    assert not read[-1]


def test_tables_shorter_than_the_records_that_point_into_them_are_no_crash(made: tuple[Path, dict[str, Any]]) -> None:
    folder, value = made
    path = folder / manifests.MANIFEST
    whole = path.read_bytes()
    path.write_bytes(signed(replaced(value, ("quantization", "colors", "precision", "base"), 3)))
    try:
        with Package.open(folder) as package:
            scene = StreamedScene.open(package)
            assert scene.contents.colors().base.max() == 7
            with pytest.raises(FormatError, match="base colors within their tables"):
                package.verify()
    finally:
        path.write_bytes(whole)


def test_views_that_are_no_poses_are_left_out(made: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    view = {"position": [0, 1, 2.5], "rotation": [1, 0, 0, 0]}
    odd = [{**view, "position": other} for other in ([0, 0], "up", [10**400, 0, 0], [True, 0, 0], [1e300, 0, 0], None)]
    for listed, kept in (([view, *odd, 7, {}, view], 2), (odd, 0), ({"a": view}, 0), (7, 0)):
        (tmp_path / "m.json").write_bytes(signed({**made[1], "provenance": {"views": listed}}))
        assert Manifest.read(tmp_path / "m.json").views == [view] * kept
