"""The commands in this process: what they print, write and refuse."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main, parse
from gsvis.cli.arguments import Analyze, Convert, Inspect
from gsvis.files.output import check_folder
from gsvis.io import load_scene, save_scene
from gsvis.io.facts import spell_facts
from gsvis.io.report_cameras import describe_cameras
from gsvis.scene.cameras import Cameras
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import BUILTIN_SCENES, OCCLUDER_SCENES, two_rooms

Capture = pytest.CaptureFixture[str]
FAR = ["90", "90", "90", "91", "91", "91"]
QUICK = ["--views", "3", "--width", "12", "--height", "9", "--traced-sample", "50", "--rays-per-face", "1"]


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.cli.analyze.PICTURE", 24)


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    save_scene(two_rooms(1000, sh_degree=1).gaussians, tmp_path / "rooms.ply")
    return tmp_path / "rooms.ply"


@pytest.mark.parametrize(
    ("name", "usual", "other"), [("OMP_WAIT_POLICY", "passive", "active"), ("OPENBLAS_THREAD_TIMEOUT", "4", "20")]
)
def test_waiting_threads_sleep_unless_the_environment_says_otherwise(
    name: str, usual: str, other: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for given, expected in ((None, usual), (other, other)):
        if given is None:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, given)
        assert main(["--version"]) == 0
        assert os.environ[name] == expected


def refused(capsys: Capture, *arguments: object) -> str:
    """The one line on stderr of a refusal; nothing on stdout."""
    assert main([str(word) for word in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("gsvis: error: ")
    return lines[0]


def test_inspect_prints_a_table_of_80_columns(ply: Path, capsys: Capture) -> None:
    assert main(["inspect", str(ply)]) == 0
    out, err = capsys.readouterr()
    assert f"{len(load_scene(ply)):,}" in out
    assert "SH degree" in out
    assert "\\" not in out  # nothing is escaped in what gsvis says itself
    assert max(map(len, out.splitlines())) <= 80
    assert err == ""


def test_inspect_says_what_the_file_states(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    known = SceneFacts(origin=(1e6, 0.0, -5e5), antialiased=True, meters_per_unit=0.5)
    save_scene(load_scene(ply).with_facts(known), tmp_path / "far.ply")
    assert main(["inspect", str(tmp_path / "far.ply")]) == 0
    out = capsys.readouterr().out
    for said in ("1,000,000, 0, -500,000", "antialiased", "0.5 m"):
        assert said in out
    assert main(["inspect", str(tmp_path / "far.ply"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["facts"] == json.loads(spell_facts(known))


def test_inspect_json_is_one_document(ply: Path, capsys: Capture) -> None:
    assert main(["inspect", str(ply), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["format"], document["version"], document["scene"]) == ("gsvis-inspection", 1, "rooms")
    assert document["count"] == len(load_scene(ply))


def test_inspect_counts_splats_over_pixels(ply: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.render.fill.SIDE", 16)
    assert main(["inspect", str(ply), "--overdraw", "2"]) == 0
    assert "splats over a pixel" in capsys.readouterr().out
    assert main(["inspect", str(ply), "--overdraw", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["overdraw"]
    assert (found["drawn"], len(found["places"])) == ("everything", 2)
    assert found["heaviest"]["mean"] == max(each["mean"] for each in found["places"])
    assert all(each["until"] <= each["mean"] <= each["worst"] <= each["splats"] for each in found["places"])


def test_a_builtin_scene_is_a_scene(capsys: Capture) -> None:
    """One at its full size; `test_stated` converts each, and a name is looked up in one table."""
    assert BUILTIN_SCENES.keys() == {*OCCLUDER_SCENES, "flat"}
    assert main(["inspect", "builtin:box_in_room", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["count"] > 1000


def test_analyze_writes_a_report_and_prints_a_table(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "new" / "report"
    assert main(["analyze", str(ply), "-o", str(out), *QUICK]) == 0
    text = capsys.readouterr().out
    assert str(out / "report.html") in text.split()
    assert "20.21%" in text
    assert "two tracers agree on all of 256 rays, ids and weights" in " ".join(text.split())
    assert "3 cameras are too few" in " ".join(text.split())
    assert json.loads((out / "report.json").read_text())["gaussians"] == len(load_scene(ply))
    assert (out / "report.html").read_text().startswith("<!doctype html>")


@pytest.mark.usefixtures("blank_plots")
def test_analyze_json_is_the_report_and_a_seed_repeats_it(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    command = ["analyze", str(ply), "-o", str(tmp_path / "a b"), *QUICK, "--seed", "7", "--json"]
    documents = []
    for _ in range(2):
        assert main(command) == 0
        documents.append(json.loads(capsys.readouterr().out))
    assert documents[0] == json.loads((tmp_path / "a b" / "report.json").read_text())
    assert documents[0] == documents[1]
    assert documents[0]["command"].startswith(f"gsvis analyze {ply} -o '{tmp_path}/a b' --views 3")
    assert "--json" not in documents[0]["command"]
    assert documents[0]["parameters"]["fov"] == 60.0
    assert documents[0]["config"]["seed"] == 7
    assert documents[0]["traced_twice"]["agreeing"] == documents[0]["traced_twice"]["rays"] == 256


@pytest.mark.usefixtures("blank_plots")
def test_analyze_takes_cameras_of_a_file_at_its_aspect(tmp_path: Path, capsys: Capture) -> None:
    size = {"w": 320, "h": 160, "fl_x": 160.0, "fl_y": 160.0, "cx": 160.0, "cy": 80.0}
    pose = [[0.0, 0.0, -1.0, 2.0], [-1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]  # looks along +x
    frames = [{"file_path": f"{i}.png", "transform_matrix": pose} for i in range(4)]
    (tmp_path / "transforms.json").write_text(json.dumps({**size, "frames": frames}))
    command = ["analyze", "builtin:two_rooms", "-o", str(tmp_path / "out"), "--json", "--traced-sample", "0"]
    command += ["--cameras", str(tmp_path / "transforms.json"), "--width", "20", "--views", "2"]
    assert main(command) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["rays"]["width"], document["rays"]["height"]) == (20, 10)
    assert document["rays"]["horizontal_fov_degrees"] == pytest.approx([90.0, 90.0])
    assert [each["name"] for each in document["visible_fraction"]["cameras"]] == ["0.png", "2.png"]
    assert document["directions"]["traced"] is None
    assert "transforms.json" in document["cameras_from"]


@pytest.mark.usefixtures("blank_plots")
def test_a_report_repeats_its_views(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "first"
    assert main(["analyze", str(ply), "-o", str(out), *QUICK, "--seed", "5", "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    again = ["analyze", str(ply), "-o", str(tmp_path / "again"), "--cameras", str(out / "report.json"), "--json"]
    assert main([*again, "--traced-sample", "0"]) == 0
    second = json.loads(capsys.readouterr().out)
    assert second["visible_fraction"] == first["visible_fraction"]
    assert second["cameras"] == first["cameras"]
    assert (second["rays"], second["directions"]["gathered"]) == (first["rays"], first["directions"]["gathered"])
    eye = ["--eye", "1", "1", "1.5", "--target", "3", "2", "1", "--width", "24", "--height", "18"]
    assert main(["render", str(ply), "-o", str(tmp_path / "a.png"), *eye, "--json"]) == 0
    (tmp_path / "view.json").write_text(capsys.readouterr().out)
    assert main(["render", str(ply), "-o", str(tmp_path / "b.png"), "--cameras", str(tmp_path / "view.json")]) == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    words = ["render", str(ply), "-o", str(tmp_path / "c.png"), "--cameras", str(out / "report.json"), "--index", "1"]
    assert main([*words, "--json"]) == 0
    capsys.readouterr()


@pytest.mark.usefixtures("blank_plots")
def test_the_paper_stands_beside_what_compares_with_it(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    assert main(["analyze", str(ply), "-o", str(tmp_path / "a"), *QUICK]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "20.21% visible in a view does not compare with these: the cameras here are drawn at random" in text
    assert "39.4%" not in text
    assert "by solid angle" in text
    assert "of directions, 3 views" not in text  # a count of cameras
    document = json.loads((tmp_path / "a" / "report.json").read_text())
    assert document["paper"]["comparable"] is False
    assert 0.0 <= document["directions"]["solid_angle"]["mean"] <= 1.0
    html = (tmp_path / "a" / "report.html").read_text(encoding="utf-8")
    assert "39.4%" not in html
    (tmp_path / "cameras.json").write_text(json.dumps(captured(fifty_views())))
    words = ["analyze", str(ply), "-o", str(tmp_path / "b"), "--cameras", str(tmp_path / "cameras.json")]
    assert main([*words, "--traced-sample", "50", "--rays-per-face", "1"]) == 0
    text = capsys.readouterr().out
    assert "39.4%" in text
    assert "does not compare" not in text
    assert json.loads((tmp_path / "b" / "report.json").read_text())["paper"]["comparable"] is True
    assert "39.4%" in (tmp_path / "b" / "report.html").read_text(encoding="utf-8")


def fifty_views() -> Cameras:
    eyes = np.linspace([0.6, 0.6, 1.2], [3, 3, 1.6], 50)
    return Cameras.look_at(eyes, (4.0, 2.0, 1.0), up=(0, 0, 1), width=8, height=6)


def captured(cameras: Cameras) -> list[dict[str, object]]:
    """The cameras as a reconstruction of photographs lists them."""
    worlds = np.linalg.inv(cameras.viewmats)
    return [
        {"img_name": name, "width": cameras.width, "height": cameras.height, "fx": float(k[0, 0]), "fy": float(k[1, 1]),
         "position": world[:3, 3].tolist(), "rotation": world[:3, :3].tolist()}
        for name, world, k in zip(cameras.names, worlds, cameras.Ks, strict=True)
    ]  # fmt: skip


@pytest.mark.usefixtures("blank_plots")
@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("report.json", "gsvis-report"),
        ("REPORT.JSON", "gsvis-rendering"),
        ("views.txt2", "gsvis-report"),
        ("folder/transforms.json", "gsvis-report"),
    ],
)
def test_many_views_of_a_report_do_not_compare_with_the_paper(ply: Path, tmp_path: Path, name: str, made: str) -> None:
    views = tmp_path / name
    views.parent.mkdir(exist_ok=True)
    views.write_text(json.dumps({"format": made, "cameras": describe_cameras(fifty_views())}))
    given = views.parent if "/" in name else views
    words = ["analyze", str(ply), "-o", str(tmp_path / "out"), "--cameras", str(given)]
    assert main([*words, "--traced-sample", "0"]) == 0
    paper = json.loads((tmp_path / "out" / "report.json").read_text())["paper"]
    assert paper["comparable"] is False
    assert paper["differs"] == "the cameras here are those of a report of gsvis, not the views of a capture"
    assert len(json.loads((tmp_path / "out" / "report.json").read_text())["cameras"]) == 50


def test_convert_asks_before_it_replaces(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "mine.ply"
    out.write_bytes(b"hours of work")
    assert "--overwrite" in refused(capsys, "convert", ply, out)
    assert out.read_bytes() == b"hours of work"
    assert "another file than IN" in refused(capsys, "convert", ply, ply, "--overwrite")
    assert main(["convert", str(ply), str(out), "--overwrite"]) == 0
    assert len(load_scene(out)) == len(load_scene(ply))


def test_convert_cuts_thins_turns_and_writes(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "deep" / "small.ply"
    command = ["convert", str(ply), str(out), "--crop", "-1", "-1", "-1", "3.5", "9", "9", "--sh-degree", "0"]
    assert main([*command, "--change-up", "-y:+z", "--min-opacity", "0.1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    before, after = load_scene(ply), load_scene(out)
    kept = before.means[before.means[:, 0] <= 3.5]
    assert document["gaussians_out"] == len(after) == len(kept)
    assert document["bytes"] == out.stat().st_size
    assert (document["sh_degree_in"], document["sh_degree_out"]) == (1, 0)
    assert np.allclose(after.means[:, 2], -kept[:, 1], atol=1e-5)


def test_convert_says_what_it_did(ply: Path, capsys: Capture) -> None:
    assert main(["convert", str(ply), str(ply.with_suffix(".spz"))]) == 0
    assert capsys.readouterr().out.split()[0] == f"{ply.with_suffix('.spz')}:"


def test_the_up_axis_may_begin_with_a_minus() -> None:
    for words in (["--change-up", "-y:+z"], ["--change-up=-y:+z"]):
        command = parse(["convert", "a", "b", *words])
        assert isinstance(command, Convert)
        assert command.placement.change_up is not None
        assert command.placement.change_up.strip() == "-y:+z"


def test_defaults_are_those_the_help_states() -> None:
    assert parse(["inspect", "x"]) == Inspect("x")
    assert parse(["analyze", "x", "-o", "d"]) == Analyze("x", "d")
    assert parse(["analyze", "x", "--out", "d", "--lod", "3"]) == Analyze("x", "d", lod=3)


def test_missing_and_wrong_scenes_are_refused_in_one_line(tmp_path: Path, capsys: Capture) -> None:
    assert "nowhere.ply: no such file" in refused(capsys, "inspect", tmp_path / "nowhere.ply")
    assert "builtin:two_rooms" in refused(capsys, "inspect", "builtin:three_rooms")
    assert "--lod" in refused(capsys, "inspect", "builtin:two_rooms", "--lod", "1")
    bad = tmp_path / "bad.ply"
    bad.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\n")
    assert "bad.ply" in refused(capsys, "inspect", bad)
    (tmp_path / "note.txt").write_text("no scene")
    assert "expected a scene" in refused(capsys, "analyze", tmp_path / "note.txt", "-o", tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.ply", "note.txt"]


def test_arguments_that_contradict_each_other_are_refused(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "cameras.json").write_text("[]")
    output = refused(
        capsys, "analyze", ply, "-o", tmp_path / "o", "--cameras", tmp_path / "cameras.json", "--fov", "50"
    )
    assert "--fov" in output
    output = refused(capsys, "analyze", ply, "-o", tmp_path / "o", "--cameras", tmp_path / "none.json")
    assert "none.json" in output
    refused(capsys, "analyze", ply, "-o", tmp_path / "o", "--cameras", tmp_path / "cameras.json")
    assert not (tmp_path / "o").exists()


def test_output_that_cannot_be_written_is_refused_before_the_work(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    assert "rooms.ply" in refused(capsys, "analyze", ply, "-o", ply)
    assert "rooms.ply" in refused(capsys, "analyze", ply, "-o", ply / "below" / "it")
    assert "OUT" in refused(capsys, "convert", ply, tmp_path / "x.splat")
    (tmp_path / "folder.ply").mkdir()
    assert "folder.ply" in refused(capsys, "convert", ply, tmp_path / "folder.ply")
    assert "--change-up" in refused(capsys, "convert", ply, tmp_path / "x.ply", "--change-up", "y")
    if os.geteuid() != 0:
        (tmp_path / "locked").mkdir(mode=0o500)
        assert "locked" in refused(capsys, "analyze", ply, "-o", tmp_path / "locked" / "out")


def test_nothing_left_is_refused_and_nothing_written(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    assert "none of" in refused(capsys, "convert", ply, tmp_path / "x.ply", "--crop", *FAR)
    assert not (tmp_path / "x.ply").exists()


def test_an_empty_scene_cannot_be_analyzed(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty.ply").touch()
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: Gaussians.empty())
    assert "no Gaussian" in refused(capsys, "analyze", tmp_path / "empty.ply", "-o", tmp_path / "out")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["inspect"], "SCENE"),
        (["inspct", "x"], "inspct"),
        (["inspect", "x", "--lod", "-1"], "lod"),
        (["inspect", "x", "--lod", "two"], "whole number"),
        (["analyze", "x"], "DIR"),
        (["analyze", "x", "-o", "d", "--views", "0"], "at least 1"),
        (["analyze", "x", "-o", "d", "--width", "20000"], "16384"),
        (["analyze", "x", "-o", "d", "--fov", "180"], "degrees"),
        (["analyze", "x", "-o", "d", "--tau", "nan"], "weight"),
        (["convert", "x", "y.ply", "--crop", "1", "1", "1", "0", "2", "2"], "X0 < X1"),
        (["convert", "x", "y.ply", "--crop", "1", "1", "1", "2", "2"], "6 values"),
        (["analyze", "x", "-o", "d", "--rays-per-face", "2"], "1, 4, 16 or 64"),
        (["convert", "x", "y.ply", "--sh-degree", "4"], "0 to 3"),
    ],
)
def test_wrong_arguments_exit_with_2_and_say_which(words: list[str], message: str, capsys: Capture) -> None:
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert "Traceback" not in err


def test_debug_shows_where(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError):
        main(["inspect", "nowhere.ply", "--debug"])
    monkeypatch.setenv("GSVIS_DEBUG", "1")
    with pytest.raises(FileNotFoundError):
        main(["inspect", "nowhere.ply"])


def test_a_bug_is_reported_in_one_line(ply: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(path: object, lod: object = None) -> Gaussians:
        raise TypeError("something\nodd")

    monkeypatch.setattr("gsvis.io.scenes.load_scene", broken)
    assert main(["inspect", str(ply)]) == 1
    assert capsys.readouterr().err.startswith("gsvis: internal error: TypeError: something odd; please report")


def test_a_polite_end_is_an_interrupt(ply: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    def ended(path: object, lod: object = None) -> Gaussians:
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("not reached")

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr("gsvis.io.scenes.load_scene", ended)
    assert main(["inspect", str(ply)]) == 130
    assert capsys.readouterr().err == "gsvis: interrupted; nothing was left half-written\n"
    assert signal.getsignal(signal.SIGTERM) is before


def test_cameras_are_taken_at_even_steps() -> None:
    cameras = Cameras.orbit((0, 0, 0), 1.0, 10)
    assert cameras.evenly(3).names == ("00000", "00003", "00006")
    assert cameras.evenly(99) is cameras


def test_checking_a_folder_leaves_no_trace(tmp_path: Path) -> None:
    check_folder(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []


def test_plain_progress_speaks_now_and_then(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    from gsvis.cli import terminal

    clock = iter(np.arange(0.0, 1000.0, 6.0))
    monkeypatch.setattr(terminal, "_clock", lambda: float(next(clock)))
    with terminal.Status() as status:
        for done in range(5):
            status("cameras", done, 4)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "gsvis: tracing cameras"
    assert lines[-1].startswith("gsvis: tracing cameras: done in")
    assert any("about" in line and "left" in line for line in lines[1:-1])
    assert "cameras" in status.seconds


def test_help_needs_nothing_heavy(capsys: Capture) -> None:
    code = "import sys; from gsvis.cli import main; main(['--help']); print(*sys.modules, sep='\\n', file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"numpy", "numba", "torch", "open3d", "matplotlib", "scipy"} & set(done.stderr.split())


@pytest.mark.realdata
@pytest.mark.usefixtures("blank_plots")
def test_a_real_scene_of_a_streamed_format(realdata: Path, tmp_path: Path, capsys: Capture) -> None:
    scene = str(realdata / "scenes" / "nika_sh3" / "lod-meta.json")
    assert main(["analyze", scene, "--lod", "3", "-o", str(tmp_path / "out"), "--json", *QUICK]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["gaussians"] == 9925
    assert (document["scene"]["name"], document["scene"]["lod"]) == ("nika_sh3, LOD 3", 3)
    assert 0.0 < document["visible_fraction"]["mean"] < 1.0
    assert document["directions"]["traced"]["gaussians"] == 50
    assert "LODs present: 2, 3" in refused(capsys, "inspect", realdata / "scenes" / "showroom", "--lod", "0")
