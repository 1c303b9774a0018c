"""What a manifest says of the scene that a package was made from, and where that scene is looked for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gsvis.package.made_from import KEY, MadeFrom, candidates_of, made_from_of, note_paths, path_from_package

DIGEST = "0" * 64
ROW: dict[str, Any] = MadeFrom("scene.ply", DIGEST, None, 12, 3, None, "../scene.ply").as_dict()


def test_what_is_written_is_read() -> None:
    rows = [ROW, MadeFrom("builtin:flat", scene=DIGEST, gaussians=7).as_dict()]
    found = made_from_of(json.loads(json.dumps({KEY: rows})))
    assert [each.as_dict() for each in found] == rows


def test_a_path_is_stored_only_beside_the_package_and_below(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "out" / "scene.gsvis"
    assert path_from_package(tmp_path / "out" / "scene.ply", package) == "../scene.ply"
    assert path_from_package(tmp_path / "out" / "of" / "scene.ply", package) == "../of/scene.ply"
    assert path_from_package(tmp_path / "scene.ply", package) is None
    assert path_from_package("/home/someone/secret/scene.ply", package) is None
    monkeypatch.chdir(tmp_path)
    assert path_from_package("a.ply", "b.gsvis") == "../a.ply"
    assert path_from_package("../a.ply", "b.gsvis") is None


@pytest.mark.parametrize("name", ["scan 12:30.ply", "a\\b.ply", "x" * 200 + "/" + "y" * 900, "é.ply", "a b.ply"])
def test_a_scene_of_any_name_is_known_again(name: str, tmp_path: Path) -> None:
    path = path_from_package(tmp_path / name, tmp_path / "scene.gsvis")
    made = MadeFrom(name[-200:], sha256=DIGEST, path=path)
    assert made_from_of({KEY: [made.as_dict()]}) == (made,)


@pytest.mark.parametrize(
    "change",
    [
        {"name": 3}, {"name": ""}, {"name": "x" * 10_000}, {"sha256": "abc"}, {"sha256": 1}, {"scene": []},
        {"nbytes": -1}, {"nbytes": True}, {"gaussians": 1.5}, {"lod": "0"}, {"path": "/etc/passwd"},
        {"path": "../../x"}, {"path": "../x/../../y"}, {"path": "x"}, {"path": ".."}, {"path": "../"}, {"path": 1},
        {"path": "../a\\b"}, {"path": "../C:x"}, {"path": "../a\0"}, {"path": "..//etc/passwd"},
    ],
    ids=str,
)  # fmt: skip
def test_a_row_that_gsvis_did_not_write_names_no_scene(change: dict[str, Any]) -> None:
    assert made_from_of({KEY: [{**ROW, **change}]}) == ()
    assert made_from_of({KEY: [ROW, {**ROW, **change}]}) == ()


@pytest.mark.parametrize("rows", [None, 1, "x", {}, [], [1], [None], [ROW] * 70_000])
def test_a_provenance_without_a_list_names_no_scene(rows: Any) -> None:
    assert made_from_of({KEY: rows}) == ()
    assert made_from_of({}) == ()


def test_a_scene_is_looked_for_where_it_was_then_where_the_note_says_then_by_its_name(tmp_path: Path) -> None:
    package, far = tmp_path / "out" / "scene.gsvis", tmp_path / "far" / "scene.ply"
    made = made_from_of({KEY: [{**ROW, "path": "../of/scene.ply"}]})
    assert candidates_of(made, package) == [[]]
    places = [tmp_path / "out" / "of" / "scene.ply", far, tmp_path / "out" / "scene.ply"]
    for place in places:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(b"x")
    note_paths(package, [far])  # no folder of work: nothing is noted
    assert candidates_of(made, package) == [[places[0], places[2]]]
    (tmp_path / "out" / "scene.gsvis.work").mkdir()
    note_paths(package, [far])
    assert candidates_of(made, package) == [places]


@pytest.mark.parametrize(
    "note", ["", "[", "{}", '{"paths": 1}', '{"paths": []}', '{"paths": ["a.ply"]}', '{"paths": [1]}']
)
def test_a_damaged_note_names_no_path(tmp_path: Path, note: str) -> None:
    work = tmp_path / "scene.gsvis.work"
    work.mkdir()
    (work / "made_from.json").write_text(note)
    (tmp_path / "a.ply").write_bytes(b"x")
    assert candidates_of(made_from_of({KEY: [ROW]}), tmp_path / "scene.gsvis") == [[]]


def test_names_that_lead_elsewhere_are_not_looked_for(tmp_path: Path) -> None:
    (tmp_path / "passwd").write_bytes(b"x")
    for name in ("../passwd", "a/passwd", "..", ".", "C:passwd", "a\\b"):
        made = made_from_of({KEY: [{**ROW, "path": None, "name": name}]})
        assert candidates_of(made, tmp_path / "in" / "scene.gsvis") == [[]]


def test_content_tells_a_file_from_another(tmp_path: Path) -> None:
    file = tmp_path / "a.ply"
    file.write_bytes(b"x")
    assert not MadeFrom("a.ply", DIGEST).matches_file(file)
    assert not MadeFrom("a.ply", DIGEST).matches_file(tmp_path)
    assert MadeFrom("a.ply", scene=DIGEST).matches_file(file)
    assert MadeFrom("a.ply", "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881").matches_file(file)
