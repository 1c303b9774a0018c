"""`gsvis levels` in this process and as one of its own: what it writes, says, refuses, keeps and leaves behind."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsvis.cli import main
from gsvis.cli.levels import _explain
from gsvis.io import load_scene, save_scene
from gsvis.io.levels import levels_info, load_levels
from gsvis.render.rasterizer import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import BUILTIN_SCENES, two_rooms, wall_with_hole
from gsvis.train.images import PosedImages
from gsvis.train.levels import LevelsConfig
from tests import warm_start
from tests.cli.halted import Halted
from tests.known_spaces import coarse_spaces

Capture = pytest.CaptureFixture[str]
BUILTIN = "builtin:wall_with_hole"  # the smallest
TINY = ["--steps", "3", "--width", "24", "--height", "20"]
QUICK = [*TINY, "--views", "3", "--held-out", "2"]
PLYS = ["high.ply", "low.ply", "medium.ply"]
WRITTEN = [*PLYS[:1], "levels.arrow", *PLYS[1:]]


@pytest.fixture(scope="module", autouse=True)
def small_scene() -> Iterator[None]:
    """The built-in scene of these tests has 2,000 Gaussians, not 20,000, and few voxels: more is not theirs."""
    made = wall_with_hole(2000)
    with pytest.MonkeyPatch.context() as patch, coarse_spaces():
        patch.setitem(BUILTIN_SCENES, "wall_with_hole", lambda: made)
        yield


@pytest.fixture(scope="module")
def ply(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("in") / "rooms.ply"
    save_scene(two_rooms(1000, sh_degree=1).gaussians, path)
    return path


@pytest.fixture(scope="module")
def photos(ply: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs of the rooms from inside, with a transforms.json."""
    folder = tmp_path_factory.mktemp("photos")
    (folder / "images").mkdir()
    eyes = [(0.6 + 0.1 * k, 0.5 + 0.35 * k, 1.5) for k in range(9)]
    cameras = Cameras.look_at(eyes, (4.0, 2.0, 1.0), up=(0, 0, 1), fov=80, width=24, height=20)
    images = rasterize(load_scene(ply), cameras).images.clip(0.0, 1.0)
    frames = []
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # transforms.json looks along -z
    for k in range(len(cameras)):
        name = f"images/{k}.png"
        Image.fromarray((255 * images[k]).round().astype(np.uint8)).save(folder / name)
        pose = np.linalg.inv(cameras.viewmats[k].astype(np.float64)) @ flip
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    ks = cameras.Ks[0].tolist()
    about = {"fl_x": ks[0][0], "fl_y": ks[1][1], "cx": ks[0][2], "cy": ks[1][2], "w": 24, "h": 20, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(about))
    return folder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def document(capsys: Capture, *words: object) -> dict:
    capsys.readouterr()
    code = main(["levels", *map(str, words), "--json"])
    out, err = capsys.readouterr()
    assert code == 0, err
    return json.loads(out)


def refused(capsys: Capture, *words: object) -> str:
    capsys.readouterr()
    assert main(["levels", *map(str, words)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    return " ".join(err.split())


def test_a_builtin_scene_as_a_folder_and_as_tables(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "new" / "levels"
    assert main(["levels", BUILTIN, "-o", str(out), *QUICK]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.replace(str(tmp_path), "").splitlines())) <= 80
    assert "…" not in text
    for label in ("reuse", "PSNR", "brightness", "going up level by level", "held out", "levels.arrow"):
        assert label in text
    assert names(out) == WRITTEN
    assert names(out.parent) == ["levels"]  # what was kept has gone


def test_the_document_says_what_is_in_the_folder(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "levels"
    found = document(capsys, BUILTIN, "-o", out, *QUICK)
    assert (found["format"], found["version"]) == ("gsvis-levels", 1)
    levels, info = load_levels(out), levels_info(out)
    assert [row["name"] for row in found["levels"]] == list(levels.names) == ["low", "medium", "high"]
    assert [row["gaussians"] for row in found["levels"]] == list(levels.counts)
    assert [row["reuse"] for row in found["levels"]] == [*levels.reuse, None]
    assert found["overhead"] == levels.overhead <= 0.05
    for row, share, reuse in zip(found["levels"], (0.25, 0.5, 1.0), (0.9, 0.96, None), strict=True):
        assert row["share"] <= share
        assert reuse is None or row["reuse"] >= reuse
        assert row["bytes"] == (out / row["file"]).stat().st_size
        assert 0.0 < row["brightness"] < 1.0
        assert row["psnr_photographs"] is None
    low, medium, high = (row["psnr"] for row in found["levels"])
    assert low["worst"] <= low["mean"] < medium["mean"]
    assert high is None
    assert [point["step"] for point in found["levels"][0]["curve"]] == [3]
    assert found["views"]["trained_on"] == 3
    assert (found["views"]["width"], found["views"]["height"]) == (24, 20)
    kept = info.extra
    assert kept["config"]["iterations"] == 3
    assert kept["scene_sha256"] == scene_hash(levels.level(2)) == found["scene_sha256"]
    assert [row["psnr"] for row in kept["levels"]] == [low, medium, None]
    before = {name: (out / name).read_bytes() for name in WRITTEN}
    document(capsys, BUILTIN, "-o", out, *QUICK)  # levels of the same scene are replaced, by the same
    assert {name: (out / name).read_bytes() for name in WRITTEN} == before


def test_photographs_names_and_another_number_of_levels(
    ply: Path, photos: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "levels"
    words = [ply, "-o", out, "--photos", photos, "--levels", "0.05", "--reuse", "0.8", "--names", "small", "whole"]
    found = document(capsys, *words, "--steps", "3")
    assert found["views"] == {
        "from": "photographs", "photographs": True, "trained_on": 7, "held_out": 2, "width": 24, "height": 20,
    }  # fmt: skip
    small, whole = found["levels"]
    assert (small["name"], whole["name"]) == ("small", "whole")
    assert 0.8 <= small["reuse"] < 0.9
    assert whole["psnr_photographs"]["mean"] > 45.0  # the same, but for 8 bits
    assert small["psnr_photographs"]["mean"] < whole["psnr_photographs"]["mean"]
    assert names(out) == ["levels.arrow", "small.ply", "whole.ply"]
    assert main(["levels", *map(str, words), "--steps", "2"]) == 0
    text = capsys.readouterr().out
    assert "photos" in text
    assert max(map(len, text.replace(str(tmp_path), "").splitlines())) <= 80


def test_photographs_of_something_else_are_reported(ply: Path, photos: Path, tmp_path: Path, capsys: Capture) -> None:
    g = load_scene(ply)
    away = Gaussians(g.means + 100.0, g.quats, g.scales, g.opacities, g.sh0, g.shN)
    save_scene(away, tmp_path / "away.ply")
    output = refused(capsys, tmp_path / "away.ply", "-o", tmp_path / "out", "--photos", photos, "--steps", "2")
    assert "shows any of" in output
    assert "in its frame" in output
    glaring = Gaussians(g.means, g.quats, g.scales, g.opacities, np.full_like(g.sh0, 5.0), g.shN)
    save_scene(glaring, tmp_path / "glaring.ply")
    words = [tmp_path / "glaring.ply", "-o", tmp_path / "out", "--photos", photos, "--steps", "1"]
    assert "unlike the photographs" in document(capsys, *words)["remarks"][0]


def test_nothing_of_the_users_is_replaced(ply: Path, photos: Path, tmp_path: Path, capsys: Capture) -> None:
    base = ["--photos", photos, "--steps", "1"]
    out = tmp_path / "out"
    out.mkdir()
    (out / "low.ply").write_text("mine")
    assert "which has a low.ply that no levels.arrow knows" in refused(capsys, ply, "-o", out, *base)
    (out / "low.ply").unlink()
    (out / "notes.txt").write_text("mine")  # not in the way
    document(capsys, ply, "-o", out, *base)
    assert names(out) == sorted([*WRITTEN, "notes.txt"])
    assert "whose high.ply is read" in refused(capsys, out / "high.ply", "-o", out, *base)
    g = load_scene(ply)
    save_scene(g[:-1], tmp_path / "other.ply")
    assert "which holds levels of the scene with the hash" in refused(capsys, tmp_path / "other.ply", "-o", out, *base)
    document(capsys, ply, "-o", out, *base)
    with (out / "low.ply").open("ab") as file:
        file.write(b"edited")
    assert "it has changed since" in refused(capsys, ply, "-o", out, *base)
    (out / "levels.arrow").write_bytes(b"ARROW1 and no more")
    assert "cannot be read" in refused(capsys, ply, "-o", out, *base)
    assert (out / "notes.txt").read_text() == "mine"
    assert names(tmp_path) == ["other.ply", "out"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--levels", "0", "0.5"], "expected shares in (0, 1]"),
        (["--levels", "0.5", "1.5"], "expected shares in (0, 1]"),
        (["--levels", "few"], "expected shares in (0, 1]"),
        (["--levels", "0.5", "0.25"], "--levels: expected each below the next"),
        (["--levels", "0.5", "1"], "the last below 1"),
        (["--levels", "0.00001", "0.5"], "expected at least 2 Gaussians in each level"),
        (["--levels", "0.1", "0.2", "0.3", "--reuse", "0.9", "0.9"], "--reuse: expected one for each of 3 shares"),
        (["--reuse", "0.9", "1.1"], "expected shares in (0, 1]"),
        (["--reuse", "1", "0.2"], "--reuse: expected each level to keep more"),
        (["--names", "low", "high"], "--names: expected 3 different ones"),
        (["--names", "a", "b", "c/d"], "--names: expected letters"),
        (["--names", "a", "A", "b"], "--names: expected names that differ in more than case"),
        (["--steps", "0"], "1 to 10000000"),
        (["--views", "0"], "at least 1"),
        (["--views", "1000000000"], "fit into half of the memory"),
        (["--width", "8", "--height", "8"], "--width: expected at least 16 pixels"),
        (["--width", "large"], "1 to 16384 pixels"),
        (["--up", "up"], "+z"),
        (["--lod", "1"], "--lod: expected none for a built-in scene"),
        (["--photos", "nowhere"], "nowhere: no such file or folder"),
        (["--photos", ".", "--views", "3"], "--views: expected none with --photos"),
        (["--photos", ".", "--held-out", "3"], "--held-out: expected none with --photos"),
        (["--photos", ".", "--up", "-y"], "--up: expected none with --photos, got -y"),
    ],
)
def test_wrong_arguments_exit_with_2_and_say_which(
    words: list[str], message: str, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = refused(capsys, BUILTIN, "-o", "out", *words)
    assert message in said.replace("│ ", "").replace(" │", "")
    assert list(tmp_path.iterdir()) == []


def test_a_scene_that_does_not_fit_the_memory_is_refused_before_it_is_read(
    ply: Path, tmp_path: Path, capsys: Capture
) -> None:
    said = refused(capsys, ply, "-o", tmp_path / "out", "--max-memory", "100MB")
    assert "--max-memory: expected at least" in said
    assert "gsvis world --until levels" in said
    assert names(tmp_path) == []
    images = [
        re.search(
            "at least ([0-9.]+) GB", refused(capsys, ply, "-o", tmp_path / "out", "--max-memory", "100MB", "--views", n)
        )
        for n in ("500", "900")
    ]
    sizes = [float(found[1]) for found in images if found]
    assert sizes[1] - sizes[0] == pytest.approx(12 * 400 * 480 * 360 / 1e9, abs=0.11)


@pytest.mark.parametrize("command", ["levels", "prepare"])
def test_photographs_count_before_the_scene_is_read(
    command: str, ply: Path, photos: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"gsvis.cli.{command}.open_source", lambda *given: pytest.fail("the scene was read"))
    monkeypatch.setattr("gsvis.train.photos.photo_bytes", lambda folder, size: 9_000_000_000)
    words = [command, str(ply), "-o", str(tmp_path / "out.gsvis"), "--photos", str(photos), "--max-memory", "5GB"]
    assert main(words) != 0
    assert "--max-memory: expected at least 9." in capsys.readouterr().err
    assert names(tmp_path) == []


def test_wrong_files_and_folders_are_refused_at_once(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    assert "no.ply: no such file" in refused(capsys, tmp_path / "no.ply", "-o", tmp_path / "out")
    assert "expected a folder to write to" in refused(capsys, ply, "-o", tmp_path / "file")
    assert "expected a folder to write to" in refused(capsys, ply, "-o", tmp_path / "file" / "below")
    said = refused(capsys, ply, "-o", tmp_path / "out", "--photos", tmp_path / "empty")
    assert "COLMAP" in said
    assert names(tmp_path) == ["empty", "file"]


def test_scenes_that_cannot_serve_are_refused_with_a_remedy(
    ply: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = [ply, "-o", tmp_path / "out", *QUICK]
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: Gaussians.empty())
    assert "nothing to make levels of" in refused(capsys, *base)
    faint = Gaussians(np.zeros((9, 3)), [[1, 0, 0, 0]] * 9, np.ones((9, 3)), [0.001] * 9, np.zeros((9, 1, 3)))
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: faint)
    assert "--photos" in refused(capsys, *base)
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: faint[:5])
    assert "expected at least 2 Gaussians in each level, got 0.25 of 5; larger shares" in refused(capsys, *base)
    assert list(tmp_path.iterdir()) == []


def test_nothing_held_out_is_nothing_measured(tmp_path: Path, capsys: Capture) -> None:
    words = [BUILTIN, "-o", str(tmp_path / "out"), *TINY, "--views", "2", "--held-out", "0", "--reuse", "0.8", "0.8"]
    assert main(["levels", *words]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "nothing was measured" in text
    assert "PSNR" not in text
    assert "a higher --reuse" in text


def test_it_states_what_reuse_costs(tmp_path: Path, capsys: Capture) -> None:
    found = document(capsys, BUILTIN, "-o", tmp_path / "out", *QUICK, "--price-reuse")
    assert names(tmp_path) == ["out"]
    assert "reuse_costs" not in found["levels"][-1]
    for row in found["levels"][:-1]:
        assert set(row["reuse_costs"]) == {"mean", "worst"}
        assert np.isfinite(list(row["reuse_costs"].values())).all()
    lines = " ".join(_explain(found))
    assert f"low: reuse costs {found['levels'][0]['reuse_costs']['mean']:.2f} dB" in lines
    message = refused(capsys, BUILTIN, "-o", tmp_path / "none", *TINY, "--held-out", "0", "--price-reuse")
    assert "--price-reuse: expected held-out views" in message


def test_the_help_states_the_defaults_of_the_library(capsys: Capture) -> None:
    assert main(["levels", "--help-all"]) == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    usual = LevelsConfig()
    for values in (usual.shares, usual.reuse, usual.names):
        assert f"(default: {' '.join(map(str, values))})" in text
    assert f"(default: {usual.iterations})" in text


def test_a_first_picture_is_a_level_of_its_own(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "levels"
    found = document(capsys, BUILTIN, "-o", out, *QUICK, "--preview", "0.05")
    assert [row["name"] for row in found["levels"]] == ["preview", "low", "medium", "high"]
    assert found["levels"][0]["reuse"] == 0.0
    assert "preview.ply" in names(out)
    words = [BUILTIN, "-o", str(tmp_path / "other"), *QUICK]
    assert "expected a share in [0, 0.1]" in refused(capsys, *words, "--preview", "0.5")


def test_a_run_that_is_stopped_is_resumed(ply: Path, photos: Path, tmp_path: Path, capsys: Capture) -> None:
    words = [str(ply), "-o", str(tmp_path / "out"), "--photos", str(photos), "--steps", "16"]
    stopped = Halted("train", 1, "levels", *words)
    stopped.wait()
    code, said, text = stopped.end(signal.SIGINT)
    assert (code, said) == (130, ""), text
    (kept,) = tmp_path.glob(".out.partial-*")
    assert f"is kept in {kept.name}; run the same command to resume" in text.splitlines()[-1]
    assert "Traceback" not in text
    assert "subsets.npz" in names(kept)
    assert names(tmp_path) == [kept.name]
    assert main(["levels", *words]) == 0
    out, err = capsys.readouterr()
    assert f"resuming from {kept.name}" in err
    assert "an earlier run had kept" in " ".join(out.split())
    assert names(tmp_path) == ["out"]
    other = tmp_path / "other"
    assert main(["levels", *words[:2], str(other), *words[3:]]) == 0  # never stopped: the same bits
    for name in PLYS:
        assert (other / name).read_bytes() == (tmp_path / "out" / name).read_bytes()


def test_stopped_before_anything_was_found_it_leaves_nothing(
    ply: Path, photos: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*words: object, **named: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gsvis.train.levels.prune", stop)
    monkeypatch.setattr("gsvis.cli.levels.warm_levels", lambda config, status: None)
    assert main(["levels", str(ply), "-o", str(tmp_path / "out"), "--photos", str(photos)]) == 130
    assert "nothing was left half-written" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_views_read_by_the_fixture_are_those_of_the_scene(ply: Path, photos: Path) -> None:
    from gsvis.train.likeness import mean_psnr
    from gsvis.train.photos import load_photos

    views = load_photos(photos).views
    assert isinstance(views, PosedImages)
    assert mean_psnr(load_scene(ply), views) > 45.0


def test_a_run_that_ends_between_its_files_is_resumed_by_the_same_command(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    words, replace, before = [BUILTIN, "-o", tmp_path / "levels", *QUICK], os.replace, []

    def ends(source: str, target: Path) -> None:
        if Path(target).parent == tmp_path / "levels":
            before.append(target)
            if len(before) == 3:
                raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr("gsvis.files.atomic.swap_folder", lambda *_: False)
        patch.setattr("gsvis.files.atomic.os.replace", ends)
        assert main(["levels", *map(str, words)]) == 130
    assert names(tmp_path / "levels") == []
    document(capsys, *words)
    assert names(tmp_path / "levels") == WRITTEN
    assert names(tmp_path) == ["levels"]


@pytest.mark.skipif(sys.platform == "win32", reason="kills with a signal")
def test_a_file_changed_after_a_kill_between_files_is_not_replaced(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    words = [str(ply), "-o", str(tmp_path / "levels"), *QUICK, "--box", "1", "1", "1", "7", "3", "2"]
    code = "import os, signal, sys; from pathlib import Path; from gsvis.files import atomic; move = os.replace\n"
    code += "def replace(a, b):\n    move(a, b)\n"
    code += "    Path(b).parent == Path(sys.argv[3]) and os.kill(os.getpid(), signal.SIGKILL)\n"
    code += "atomic.os.replace = replace\natomic.swap_folder = lambda *_: False\n"
    code += "from gsvis.cli import main; main(['levels', *sys.argv[1:]])"
    ended = warm_start.run([sys.executable, "-c", code, *words], capture_output=True, check=False)
    assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
    mine = tmp_path / "levels" / "high.ply"
    assert names(tmp_path / "levels") == ["high.ply"]
    mine.write_bytes(mine.read_bytes() + b"\n")  # no longer what the run wrote
    assert "high.ply" in refused(capsys, *words)
    mine.unlink()
    document(capsys, *words)
    assert names(tmp_path / "levels") == WRITTEN
