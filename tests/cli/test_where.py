"""Where eyes are: every command that samples them says what a scene was taken for, and takes a place given by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main, parse
from gsvis.cli.options import Placed, Where, changed, value_of
from gsvis.cli.where import check_where, find_place, suspect_views
from gsvis.errors import SceneError
from gsvis.io import save_scene
from gsvis.io.poses import write_poses
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.procedural import two_rooms
from gsvis.scene.source import Source
from tests.scene.places import apartment, box, discs, filled, outside, statue

Capture = pytest.CaptureFixture[str]
BOX = ["--box", "0.5", "0.5", "0.5", "3.5", "3.5", "2.5"]
SAMPLERS = ("inspect", "analyze", "render", "color", "levels", "pvs", "prepare")
QUICK = ["--limit", "0.05", "--max-inner", "1"]
SMALL = {
    "inspect": [],
    "analyze": ["--views", "3", "--width", "12", "--height", "9", "--traced-sample", "0"],
    "render": ["--width", "16", "--height", "12"],
    "color": ["--views", "2", "--held-out", "0", "--width", "16", "--height", "12"],
    "pvs": [
        "--dry-run",
        "--cells",
        "8",
        "--face-size",
        "16",
        "--workers",
        "1",
        "--certify",
        "256",
        "--limit",
        "0.05",
        "--max-inner",
        "1",
    ],
    "prepare": ["--dry-run", "--levels", "none", "--cells", "4", "--face-size", "16", "--workers", "1", *QUICK],
}
OUT = {"analyze": "report", "render": "eye.png", "color": "c.arrow", "pvs": "s.pvs", "prepare": "p.gsvis"}


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.cli.analyze.PICTURE", 24)


def saved(g: Gaussians, folder: Path) -> Path:
    save_scene(g, folder / "scene.ply")
    return folder / "scene.ply"


def document(capsys: Capture, command: str, scene: Path, *words: object) -> dict:
    out = ["-o", str(scene.parent / OUT[command])] if command in OUT else []
    assert main([command, str(scene), *out, *SMALL[command], *map(str, words), "--json"]) == 0
    found: dict = json.loads(capsys.readouterr().out)
    return found.get("scene", found) if command == "analyze" else found


def refused(capsys: Capture, *words: object) -> str:
    """The one line of a refusal."""
    assert main([str(word) for word in words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = [each for each in err.splitlines() if not each.startswith("gsvis: finding")]
    assert line.startswith("gsvis: error: ")
    return line


class TestKindIsSaid:
    @pytest.mark.parametrize("command", sorted({*SMALL} - {"color"}))
    def test_in_json(self, command: str, tmp_path: Path, capsys: Capture) -> None:
        space = document(capsys, command, saved(statue(), tmp_path))["space"]
        assert space["kind"]["kind"] == "object"
        assert space["rule"].startswith("free, around ")  # and inside as well where up is not certain
        assert space["kind"]["text"].startswith("object: ")

    def test_in_the_terminal(self, tmp_path: Path, capsys: Capture) -> None:
        assert main(["inspect", str(saved(apartment(), tmp_path))]) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert "taken for rooms: " in text
        assert "mplausible" not in text


class TestByHand:
    @pytest.mark.parametrize("command", SAMPLERS)
    def test_every_command_that_samples_eyes_takes_a_place(self, command: str) -> None:
        out = [] if command in ("inspect", "render") else ["-o", "x"]
        around = parse([command, "scene.ply", *out, "--around", "-1", "0", "2.5", "0.5"])
        assert value_of(around, "around") == (-1.0, 0.0, 2.5, 0.5)
        whole, boxed = (parse([command, "scene.ply", *out, *more]) for more in (["--around", "auto"], BOX))
        assert value_of(whole, "around") == ()
        assert value_of(boxed, "box") == (0.5, 0.5, 0.5, 3.5, 3.5, 2.5)
        walked = parse([command, "scene.ply", *out, "--path", "w.csv", "--margin", "0.3", "--retarget"])
        assert [value_of(walked, name) for name in ("path", "margin", "retarget")] == ["w.csv", 0.3, True]

    @pytest.mark.parametrize("command", ["inspect", "analyze", "render", "color", "pvs", "prepare"])
    def test_a_box_is_where_eyes_are(self, command: str, tmp_path: Path, capsys: Capture) -> None:
        space = document(capsys, command, saved(two_rooms(1000, sh_degree=0).gaussians, tmp_path), *BOX)["space"]
        assert (space["rule"], space["kind"]["kind"]) == ("box", "given")

    def test_a_view_lies_in_the_box_or_around_the_object(self, tmp_path: Path, capsys: Capture) -> None:
        scene = saved(two_rooms(1000, sh_degree=0).gaussians, tmp_path)
        for seed in range(4):
            found = document(capsys, "render", scene, *BOX, "--seed", seed)["cameras"]
            eye = np.array(found[0]["eye"])
            assert np.all((eye > 0.5) & (eye < [3.5, 3.5, 2.5]))
            found = document(capsys, "render", scene, "--around", 2.2, 3.1, 0.7, 0.4, "--seed", seed)["cameras"]
            eye = np.array(found[0]["eye"])
            assert 0.4 < np.linalg.norm(eye - (2.2, 3.1, 0.7)) < 1.2

    def test_values_are_spelled_as_they_are_read(self) -> None:
        for words in (["--around", "auto"], ["--around", "1", "-2", "3", "0.25"], BOX):
            command = parse(["pvs", "scene.ply", "-o", "x", *words])
            assert changed(command) == {words[0]: words[1:]}


class TestBadInput:
    def test_no_free_space(self, tmp_path: Path, capsys: Capture) -> None:
        fog = discs(np.random.default_rng(0).uniform(0, 1, (8, 3)), (5.0, 5.0, 5.0), 0.9)
        scene = saved(fog, tmp_path)
        line = refused(capsys, "pvs", scene, "-o", tmp_path / "s.pvs")
        assert "no navigable space: all" in line
        assert "--box" in line
        for argument in ("max_alpha", "resolution", "clearance"):  # no command has them
            assert argument not in line
        finer = refused(capsys, "space", scene, "-o", tmp_path / "s.glb", "--resolution", 16)
        assert "no navigable space: all" in finer
        assert finer.endswith("say where eyes may be with --box or --around, or raise --resolution")
        assert any("no navigable space" in each for each in document(capsys, "inspect", scene)["problems"])

    def test_all_one_object(self, tmp_path: Path, capsys: Capture) -> None:
        space = document(capsys, "inspect", saved(filled(), tmp_path))["space"]
        assert space["kind"]["kind"] == "object"
        assert "around it" in space["kind"]["eyes"]

    def test_a_box_that_is_buried(self, tmp_path: Path, capsys: Capture) -> None:
        scene = saved(discs(np.zeros((1, 3)), (5.0, 5.0, 5.0), 0.99), tmp_path)
        for command in ("pvs", "render", "analyze"):
            out = ["-o", tmp_path / OUT[command]]
            line = refused(capsys, command, scene, *out, "--box", -1, -1, -1, 1, 1, 1)
            assert "--box: expected room for eyes, got a place in which all of 256 eyes" in line
            assert "; give another, or a larger one" in line

    def test_around_a_place_without_room(self, tmp_path: Path, capsys: Capture) -> None:
        scene = saved(discs(np.zeros((1, 3)), (5.0, 5.0, 5.0), 0.99), tmp_path)
        assert "--around: no navigable space" in refused(
            capsys, "pvs", scene, "-o", tmp_path / "s.pvs", "--around", 0, 0, 0, 1
        )

    def test_an_eye_that_is_buried_is_said(self, tmp_path: Path, capsys: Capture) -> None:
        scene = saved(discs(np.zeros((1, 3)), (1.0, 1.0, 1.0), 0.99), tmp_path)
        words = ["--eye", 0, 0, 0, "--target", 1, 0, 0]
        (remark,) = [each for each in document(capsys, "render", scene, *words)["remarks"] if "solid" in each]
        assert remark.startswith("Expected --eye in free space, got a point inside something solid")

    def test_cameras_of_a_file_that_are_buried_are_said(self, tmp_path: Path, capsys: Capture) -> None:
        scene = saved(discs(np.zeros((1, 3)), (1.0, 1.0, 1.0), 0.99), tmp_path)
        views = {"fl_x": 16.0, "w": 16, "h": 12}
        for heights, expected in (([0.0], "a point"), ([0.0, 0.1, 9.0], "2 of 3"), ([9.0], "")):
            poses = [np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, z], [0, 0, 0, 1]]) for z in heights]
            frames = [{"file_path": f"{k}.png", "transform_matrix": pose.tolist()} for k, pose in enumerate(poses)]
            (tmp_path / "transforms.json").write_text(json.dumps({**views, "frames": frames}))
            words = ["--cameras", tmp_path / "transforms.json"]
            out = tmp_path / (f"{heights[0]}.png" if len(poses) == 1 else "eyes")
            assert main([str(word) for word in ("render", scene, "-o", out, *words, "--json")]) == 0
            remarks = [each for each in json.loads(capsys.readouterr().out)["remarks"] if "solid" in each]
            wanted = f"Expected the cameras of --cameras in free space, got {expected} inside something solid"
            assert [each.startswith(wanted) for each in remarks] == ([True] if expected else [])

    @pytest.mark.parametrize("words", [["1", "2", "3"], ["1", "2", "3", "0"], ["1", "2", "3", "nan"], ["all"], []])
    def test_around_is_read_strictly(self, words: list[str], capsys: Capture) -> None:
        assert main(["pvs", "builtin:two_rooms", "-o", "x.pvs", "--around", *words]) == 2
        assert "expected auto, or a center X Y Z and a radius above 0" in " ".join(
            capsys.readouterr().err.replace("│", " ").split()
        )

    def test_places_exclude_each_other(self) -> None:
        for where, message in (
            (Where(box=(0, 0, 0, 1, 1, 1), around=()), "--around: expected none with --box, got auto; leave it out"),
            (Where(around=(), path="w.csv"), "--path: expected none with --around, got w.csv; leave it out"),
            (Where(margin=1.0), "--margin: expected --path with it, got none"),
            (Where(retarget=True), "--retarget: expected --path with it, got none"),
        ):
            with pytest.raises(ValueError, match=f"^{message}"):
                check_where(where)
        with pytest.raises(ValueError, match=r"^--box: expected none with --pvs, which says where eyes are"):
            check_where(Where(box=(0, 0, 0, 1, 1, 1)), "--pvs")

    def test_a_stated_kind_contradicts_a_place_and_auto_none(self) -> None:
        for place in (Where(box=(0, 0, 0, 1, 1, 1)), Where(around=())):
            assert check_where(replace(place, kind="auto")) is None
            with pytest.raises(ValueError, match=r"^--kind: expected none with --(box|around), which says"):
                check_where(replace(place, kind="rooms"))

    def test_a_path_elsewhere(self, tmp_path: Path) -> None:
        times = np.arange(4.0)
        away = HeadPath(times, 500.0 + np.eye(4)[:, :3], np.tile([1.0, 0, 0, 0], (4, 1)), up=np.array([0, 0, 1.0]))
        write_poses(away, tmp_path / "walk.csv")
        where = Placed(path=str(tmp_path / "walk.csv"), up="+z")
        source = Source("rooms", apartment())
        with pytest.raises(ValueError, match="--retarget brings it there"):
            find_place(source, where, check_where(where))

    @pytest.mark.parametrize("make", [filled, lambda: discs(np.zeros((1, 3)), (5.0, 5.0, 5.0), 0.99)])
    def test_a_path_inside_something_solid(self, make: Callable[[], Gaussians], tmp_path: Path) -> None:
        times, places = np.arange(3.0), np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
        walk = HeadPath(times, places, np.tile([1.0, 0, 0, 0], (3, 1)), up=np.array([0, 0, 1.0]))
        write_poses(walk, tmp_path / "walk.csv")
        where = Placed(path=str(tmp_path / "walk.csv"), up="+z")
        place = find_place(Source("solid", make()), where, check_where(where))
        assert place.space is not None
        assert place.space.contains(places).all()  # somebody walked there
        assert place.evidence is not None
        assert (place.evidence.source, place.evidence.confidence) == ("walk", 1.0)
        (line,) = [each for each in place.remarks if "of the walk" in each]
        assert line.startswith(" 100% of the walk")
        assert not any("scaled" in each for each in place.remarks)


class TestFlyaways:
    def test_they_are_said_where_they_are_many(self, tmp_path: Path, capsys: Capture) -> None:
        g = apartment()
        for share, expected in ((0.005, 0), (0.05, 1)):
            more = outside(g, share)
            remarks = find_place(Source("flown", more), Where()).remarks
            assert len(remarks) == expected
            count = len(more) - len(g)
            assert all(f"{count:,} Gaussians, {count / len(more):.1%} of all," in remark for remark in remarks)
            assert all("gsvis clean removes them" in remark for remark in remarks)
        assert find_place(Source("flown", more), Where(box=(1, 1, 1, 2, 2, 2))).remarks == []  # the box is given
        assert main(["inspect", str(saved(more, tmp_path))]) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert "taken for rooms: " in text
        assert text.count("gsvis clean removes them") == 1


class TestImplausible:
    def test_nothing_is_said_of_good_places(self) -> None:
        for g in (apartment(), statue()):
            assert suspect_views(g, NavigableSpace.from_scene(g, resolution=64, up="+z")) == []

    def test_the_void_and_the_hollow_are_named(self) -> None:
        g = statue(bottom=True)
        void = NavigableSpace.from_box((50, 50, 50), (51, 51, 51), 4)
        assert any("look into the void" in each for each in suspect_views(g, void))
        hidden = Gaussians.concatenate([g] + [statue(bottom=True).transform(np.eye(3), (3.0, 0, 0))] * 12)
        hollow = NavigableSpace.from_box((-0.3, -0.3, 0.3), (0.3, 0.3, 0.9), 8)
        (line,) = suspect_views(Gaussians.concatenate([hidden] * 8), hollow)
        assert line.startswith(" Implausible: a view sees 0.")
        assert line.endswith("say where eyes belong with --box, --around or --path.")

    def test_one_surface_is_named(self) -> None:
        tiny = box((3.0, 2.0, 1.5), (3.12, 2.12, 1.62), 0.02)
        space = NavigableSpace.from_box((3.05, 2.05, 1.55), (3.07, 2.07, 1.57), 8)
        found = suspect_views(Gaussians.concatenate([apartment(), tiny]), space)
        assert any("100% of the views look into one surface" in each for each in found)

    def test_a_space_of_buried_eyes_is_implausible(self) -> None:
        g = discs(np.zeros((1, 3)), (5.0, 5.0, 5.0), 0.99)
        (line,) = suspect_views(g, NavigableSpace.from_box((-1, -1, -1), (1, 1, 1), 4))
        assert "implausible" in line

    def test_around_raises_where_nothing_is_free(self) -> None:
        source = Source("solid", discs(np.zeros((1, 3)), (5.0, 5.0, 5.0), 0.99))
        with pytest.raises(SceneError, match=r"^--around: no navigable space"):
            find_place(source, Where(around=(0.0, 0.0, 0.0, 1.0)))
