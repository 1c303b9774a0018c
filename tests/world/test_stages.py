"""A preparation that stops early: tiles hold every Gaussian once, levels are folders of any other tool, both resume."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsvis.cli import main
from gsvis.errors import FormatError
from gsvis.io import load_scene
from gsvis.io.levels import load_levels
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.world.rows import content_order
from gsvis.world.stages import INDEX, STAGES, Stage, write_tiles
from tests.world import cities


def in_order(g: Gaussians) -> str:
    return scene_hash(g[content_order(g)])


def test_tiles_hold_every_gaussian_once(tmp_path: Path) -> None:
    scene = cities.write(cities.street(), tmp_path / "s.ply")
    found = write_tiles([scene], tmp_path / "city", "tiles", cities.config())
    parts = [load_scene(tmp_path / "city" / tile.file) for tile in found]
    whole = load_scene(tmp_path / "s.ply")
    joined = Gaussians.concatenate(parts)
    assert len(joined) == len(whole)
    assert joined.means[content_order(joined)].tolist() == whole.means[content_order(whole)].tolist()
    assert [tile.gaussians for tile in found] == [len(part) for part in parts]
    index = json.loads((tmp_path / "city" / INDEX).read_text())
    assert [each["file"] for each in index["tiles"]] == [tile.file for tile in found]
    assert index["up"] == [0.0, 0.0, 1.0]


def test_levels_are_folders_of_levels_and_the_highest_is_the_tile(tmp_path: Path) -> None:
    scene = cities.write(cities.street(), tmp_path / "s.ply")
    found = write_tiles([scene], tmp_path / "city", "levels", cities.config())
    tops = []
    for tile in found:
        levels = load_levels(tmp_path / "city" / tile.file)
        assert tile.levels == tuple(zip(levels.names, levels.counts, strict=True))
        tops.append(levels.level(len(levels) - 1))
    assert in_order(Gaussians.concatenate(tops)) == in_order(load_scene(tmp_path / "s.ply"))


@pytest.mark.parametrize("until", STAGES)
def test_tiles_of_other_options_are_removed_and_other_files_stay(until: Stage, tmp_path: Path) -> None:
    scene, out = cities.write(cities.street(), tmp_path / "s.ply"), tmp_path / "city"
    first = write_tiles([scene], out, until, cities.config())
    kept = out / "tile-0-0.gsvis"
    kept.mkdir()
    second = write_tiles([scene], out, until, cities.config(most=2_000))
    assert {tile.file for tile in first} - {tile.file for tile in second}
    assert {path.name for path in out.iterdir()} == {tile.file for tile in second} | {INDEX, kept.name}


def test_the_command_writes_them_again_and_refuses_other_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    cities.write(cities.street(), tmp_path / "s.ply")
    words = [
        "world",
        "s.ply",
        "-o",
        "city",
        "--tile",
        "700",
        "--levels",
        "none",
        "--up",
        "+z",
        "--until",
        "tiles",
        "--workers",
        "1",
    ]
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["gaussians"] == len(cities.street())
    before = cities.content(tmp_path / "city")
    assert main([*words, "--discard"]) == 0
    assert cities.content(tmp_path / "city") == before
    assert not (tmp_path / "city.work").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("")
    with pytest.raises(FormatError, match="tiles or an empty folder"):
        write_tiles([("s.ply", None)], tmp_path / "other", "tiles", cities.config())
