"""`gsvis cut` and `gsvis paint` at the command line: what they write and say, and every wrong input in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsvis.cli import main
from gsvis.io import load_scene, save_scene
from gsvis.io.poses import write_poses
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.paths import HeadPath
from gsvis.scene.procedural import BUILTIN_SCENES, two_rooms

Capture = pytest.CaptureFixture[str]
BOX = ["--box", "0.6", "1.6", "1.2", "0.9", "1.9", "1.5"]
CUT = [*BOX, "--face-size", "24", "--held-out", "2", "--limit", "0.05"]
PAINT = [*BOX, "--face-size", "24", "--eyes", "2"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene, cameras in it, and a walk outside of it."""
    made = tmp_path_factory.mktemp("edit")
    save_scene(two_rooms(1200, sh_degree=1).gaussians, made / "rooms.ply")
    far = HeadPath([0.0, 1.0], [[90, 90, 90], [91, 90, 90]], [[1, 0, 0, 0]] * 2)
    write_poses(far, made / "far.csv")
    write_poses(HeadPath([0.0, 1.0], [[0.8, 2, 1.6], [1.6, 2, 1.6]], [[1, 0, 0, 0]] * 2), made / "walk.csv")
    pose = {"position": [0.8, 2.0, 1.6], "rotation": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]}
    sized = {"width": 32, "height": 24, "fx": 20.0, "fy": 20.0}
    (made / "cameras.json").write_text(json.dumps([{"id": 0, "img_name": "a", **sized, **pose}]))
    pose["position"] = [90.0, 2.0, 1.6]
    (made / "away.json").write_text(json.dumps([{"id": 0, "img_name": "a", **sized, **pose}]))
    return made


def refused(capsys: Capture, *words: object) -> str:
    """The one line of a refusal."""
    assert main([str(word) for word in words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    assert line.startswith("gsvis: error: ")
    return line


def test_cut_writes_what_a_box_can_see_and_says_what_is_missing(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    out, select = tmp_path / "cut.ply", tmp_path / "kept.npy"
    words = ["cut", str(folder / "rooms.ply"), "-o", str(out), "--select", str(select), *CUT]
    assert main(words) == 0
    text = " ".join(capsys.readouterr().out.split())
    whole, kept = load_scene(folder / "rooms.ply"), np.load(select)
    assert kept.dtype == bool
    assert 0 < kept.sum() < len(kept) == len(whole)
    assert np.array_equal(load_scene(out).means, whole[kept].means)
    assert f"{kept.sum():,} of {len(whole):,} Gaussians" in text
    assert "with 95% confidence at most" in text
    assert "dB in the worst" in text
    assert main([*words, "--overwrite", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["gaussians_out"] == kept.sum()
    assert found["certificate"]["missed"] <= found["certificate"]["bound"]
    assert found["held_out"]["views"] == 2


def test_cut_from_outside_opens_a_closed_room(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "open.ply"
    words = ["cut", str(folder / "rooms.ply"), "-o", str(out), *CUT, "--from-outside", "--open-to", "0", "0", "1"]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["direction"] == [0.0, 0.0, 1.0]
    assert found["light_before"] < 0.6 < 0.9 < found["light_after"]
    assert found["gaussians_out"] == len(load_scene(out)) < found["gaussians_in"]


def test_cut_keeps_what_cameras_or_frames_of_a_walk_show(
    folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(BUILTIN_SCENES, "two_rooms", lambda: two_rooms(1200, sh_degree=0))
    quick = ["--face-size", "24", "--held-out", "0", "--limit", "0.05", "--json"]
    ways = {
        "cameras": ["--cameras", str(folder / "cameras.json")],
        "beside": ["--cameras", str(folder / "cameras.json"), "--margin", "0.2"],
        "frames": ["--path", str(folder / "walk.csv"), "--fov", "60"],
        "walk": ["--path", str(folder / "walk.csv")],
    }
    found = {}
    for name, way in ways.items():
        assert main(["cut", "builtin:two_rooms", "-o", str(tmp_path / f"{name}.ply"), *way, *quick]) == 0
        found[name] = json.loads(capsys.readouterr().out)
    count = {name: each["gaussians_out"] for name, each in found.items()}
    assert 0 < count["cameras"] < count["beside"] < count["walk"]
    assert count["frames"] < count["walk"]
    assert found["beside"]["eyes"] == "1 cameras, or up to 0.2 beside them"
    assert found["walk"]["held_out"] is None


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["SCENE", "-o", "OUT"], "--path, --cameras, --box and --around, got none"),
        (["none.ply", "-o", "OUT", *BOX], "no such file"),
        (["SCENE", "-o", "SCENE", *BOX, "--overwrite"], "another file than SCENE"),
        (["SCENE", "-o", "MADE", *BOX], "--overwrite"),
        (["SCENE", "-o", "OUT.glb", *BOX], ".ply, .spz, .sog"),
        (["SCENE", "-o", "OUT", *BOX, "--select", "OUT"], "a file of its own"),
        (["SCENE", "-o", "OUT", "--path", "FAR"], "expected a walk in the scene"),
        (["SCENE", "-o", "OUT", "--cameras", "AWAY", "--held-out", "0"], "everything would go"),
        (["SCENE", "-o", "OUT", "--cameras", "AWAY", *BOX], "--box: expected none with --cameras"),
        (["SCENE", "-o", "OUT", *BOX, "--fov", "60"], "--fov: expected --path"),
        (["SCENE", "-o", "OUT", *BOX, "--margin", "1"], "--margin: expected --path"),
        (["SCENE", "-o", "OUT", *BOX, "--open-to", "0", "0", "1"], "--open-to: expected --from-outside"),
        (["SCENE", "-o", "OUT", "--from-outside", "--open-to", "0", "0", "0"], "--open-to: expected a direction"),
        (["SCENE", "-o", "OUT", "--from-outside", "--cameras", "AWAY"], "--from-outside: expected eyes inside"),
        (["FLAT", "-o", "OUT", "--path", "FAR"], "expected a walk in the scene"),
        (["LEVELS", "-o", "OUT", *BOX], "folder of levels"),
        (["SCENE", "-o", "OUT", *BOX, "--up", "sky"], "--up"),
    ],
)
def test_wrong_input_of_cut_is_one_line_and_writes_nothing(
    words: list[str], wanted: str, folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    known = places(folder, tmp_path)
    before = known["SCENE"].read_bytes()
    assert wanted in refused(capsys, "cut", *(known.get(word, word) for word in words))
    assert not known["OUT"].exists()
    assert known["SCENE"].read_bytes() == before


def places(folder: Path, tmp_path: Path) -> dict[str, Path]:
    (tmp_path / "made.ply").write_text("something")
    flat = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [1e-3], np.zeros((1, 1, 3)))
    save_scene(flat, tmp_path / "flat.ply")
    (tmp_path / "levels").mkdir()
    (tmp_path / "levels" / "levels.arrow").write_bytes(b"")
    return {
        "SCENE": folder / "rooms.ply",
        "FAR": folder / "far.csv",
        "AWAY": folder / "away.json",
        "OUT": tmp_path / "out.ply",
        "OUT.glb": tmp_path / "out.glb",
        "MADE": tmp_path / "made.ply",
        "FLAT": tmp_path / "flat.ply",
        "LEVELS": tmp_path / "levels",
    }


def test_paint_writes_a_scene_its_legend_and_values(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    out, values = tmp_path / "seen.ply", tmp_path / "seen.npy"
    words = ["paint", str(folder / "rooms.ply"), "-o", str(out), "--values", str(values), *PAINT]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "never seen" in text
    assert "seen.legend.png" in "".join(text.split())
    painted, whole = load_scene(out), load_scene(folder / "rooms.ply")
    assert painted.sh_degree == 0
    assert np.array_equal(painted.means, whole.means)
    assert set(np.load(values)) <= {0.0, 0.5, 1.0}
    with Image.open(tmp_path / "seen.legend.png") as legend:
        assert legend.format == "PNG"
    assert main([*words, "--overwrite", "--json", "--by", "weight"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["by"] == "weight"
    assert sum(each["gaussians"] for each in found["bands"]) == len(whole)


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["SCENE", "-o", "SCENE", "--overwrite"], "another file than SCENE"),
        (["SCENE", "-o", "MADE"], "--overwrite"),
        (["SCENE", "-o", "MADE", "--pvs", "MADE", "--overwrite"], "another file than --pvs"),
        (["SCENE", "-o", "OUT", "--by", "cell", "--pvs", "none.pvs"], "no such file"),
        (["SCENE", "-o", "OUT", "--by", "importance", "--pvs", "MADE"], "importance"),
        (["SCENE", "-o", "OUT", "--eyes", "3", "--pvs", "MADE"], "--eyes: expected none with --pvs"),
        (["SCENE", "-o", "OUT", "--pvs", "MADE", *BOX], "--box: expected none with --pvs"),
        (["SCENE", "-o", "OUT", "--pvs", "MADE"], "made.ply"),
        (["SCENE", "-o", "OUT", "--path", "FAR"], "expected a walk in the scene"),
        (["FLAT", "-o", "OUT"], "no navigable space"),
        (["LEVELS", "-o", "OUT"], "folder of levels"),
        (["SCENE", "-o", "OUT", *BOX, "--values", "OUT"], "a file of its own"),
    ],
)
def test_wrong_input_of_paint_is_one_line_and_writes_nothing(
    words: list[str], wanted: str, folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    known = places(folder, tmp_path)
    assert wanted in refused(capsys, "paint", *(known.get(word, word) for word in words))
    assert not known["OUT"].exists()
    assert not (tmp_path / "out.legend.png").exists()
