"""`gsvis train` in this process: what it writes, prints, refuses, keeps and resumes."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.io import load_scene
from gsvis.scene.points import PointCloud
from gsvis.train.densify import DensifyConfig
from gsvis.train.likeness import mean_psnr
from gsvis.train.photos import load_photos
from gsvis.train.trainer import TrainConfig, Trainer
from tests.io.colmap_files import write_points
from tests.io.scene_files import ply_bytes
from tests.train.photo_files import cloud, write_photos

Capture = pytest.CaptureFixture[str]
STEPS = ["--steps", "20", "--evaluate-every", "10", "--sh-degree", "1"]


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_photos(tmp_path_factory.mktemp("photos"), points=cloud())


def document(capsys: Capture, *words: object) -> dict:
    capsys.readouterr()
    assert main(["train", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys: Capture, *words: object) -> str:
    capsys.readouterr()
    assert main(["train", *map(str, words)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    return " ".join(err.split())


def test_a_scene_and_its_record_are_written_and_summarized(photos: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "new" / "scene.ply"
    assert main(["train", str(photos), "-o", str(out), *STEPS]) == 0
    text, said = capsys.readouterr()
    assert max(map(len, text.replace(str(tmp_path), "").splitlines())) <= 80
    for label in ("10 of 48 x 32, 2 held out", "40 points of the reconstruction", "PSNR", "SSIM", "in 2 held out"):
        assert label in text
    assert "step 10: " in said
    assert sorted(path.name for path in out.parent.iterdir()) == ["scene.ply", "scene.train.json"]
    record = json.loads((out.parent / "scene.train.json").read_text(encoding="utf-8"))
    scene = load_scene(out)
    assert (record["format"], record["version"]) == ("gsvis-training-record", 1)
    assert (record["gaussians"], record["bytes"]) == (len(scene), out.stat().st_size)
    assert scene.sh_degree == record["sh_degree"] == 1
    assert [point["step"] for point in record["curve"]] == [10, 20]
    assert record["curve"][-1]["psnr"] == pytest.approx(record["quality"]["psnr"]["mean"], abs=1e-3)
    assert record["photographs"] == {"all": 10, "trained_on": 8}
    assert [each["name"] for each in record["quality"]["each"]] == ["photo_000.png", "photo_008.png"]
    _, held_out = load_photos(photos).views.split(8)
    assert record["quality"]["psnr"]["mean"] == pytest.approx(mean_psnr(scene, held_out), abs=0.01)


def test_all_photographs_smaller_and_from_random_points(photos: Path, tmp_path: Path, capsys: Capture) -> None:
    words = [
        photos,
        "-o",
        tmp_path / "a.spz",
        *STEPS,
        "--test-every",
        "0",
        "--width",
        "24",
        "--height",
        "16",
        "--random-points",
        "30",
    ]
    record = document(capsys, *words, "--max-gaussians", "30", "--seed", "3")
    assert (record["width"], record["height"], record["gaussians"]) == (24, 16, 30)
    assert record["photographs"] == {"all": 10, "trained_on": 10}
    assert (record["quality"]["of"], record["quality"]["views"]) == ("trained on", 2)
    assert [point["psnr"] for point in record["curve"]] == [None, None]
    assert record["start"] == "30 random points"
    assert record["config"]["seed"] == 3
    assert record == json.loads((tmp_path / "a.train.json").read_text(encoding="utf-8"))


def test_a_run_that_is_stopped_is_resumed(
    photos: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [photos, "-o", tmp_path / "scene.ply", *STEPS]
    whole = document(capsys, photos, "-o", tmp_path / "whole.ply", *STEPS)
    advance = Trainer.advance

    def stopped(self: Trainer) -> float:
        loss = advance(self)
        if self.step == 13 and len(self.views) == 8:
            signal.raise_signal(signal.SIGINT)  # in the middle of the loop: it waits for the end of the step
            assert self.step == 13
        return loss

    monkeypatch.setattr(Trainer, "advance", stopped)
    before = signal.getsignal(signal.SIGINT)
    assert main(["train", *map(str, words)]) == 130
    assert signal.getsignal(signal.SIGINT) is before
    out, err = capsys.readouterr()
    assert out == ""
    text = "gsvis: interrupted; what was trained is kept in scene.ply.checkpoint; run the same command to resume"
    assert err.splitlines()[-1] == text
    assert not (tmp_path / "scene.ply").exists()
    monkeypatch.setattr(Trainer, "advance", advance)
    kept = tmp_path / "scene.ply.checkpoint"
    copy = shutil.copy(kept, tmp_path / "copy")

    assert "a run with different ones; delete it" in refused(capsys, *words, "--seed", "1")
    assert kept.read_bytes() == Path(copy).read_bytes()
    record = document(capsys, *words)
    assert record["timing"]["resumed_from"] == 13
    assert not kept.exists()
    assert (tmp_path / "scene.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert [point["loss"] for point in record["curve"]] == [point["loss"] for point in whole["curve"]]
    anew = [*words, "--checkpoint", copy, "--restart", "--seed", "1"]  # not its run, but not asked for
    assert "--overwrite" in refused(capsys, *anew)
    assert (tmp_path / "scene.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    again = document(capsys, *anew, "--overwrite")
    assert again["timing"]["resumed_from"] is None
    assert not Path(copy).exists()


def test_a_model_without_points_begins_at_random(photos: Path, tmp_path: Path, capsys: Capture) -> None:
    shutil.copytree(photos, tmp_path / "photos")
    (tmp_path / "photos" / "sparse" / "0" / "points3D.bin").unlink()
    few = ["--steps", "1", "--evaluate-every", "0"]
    assert main(["train", str(tmp_path / "photos"), "-o", str(tmp_path / "a.ply"), *few]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "50,000 random points" in text
    assert "The reconstruction has no points" in text


def test_what_cannot_be_is_refused_before_the_work(
    photos: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Trainer, "advance", lambda self: pytest.fail("a step was taken"))
    monkeypatch.setattr("gsvis.cli.train.warm_training", lambda *words: None)
    out = tmp_path / "scene.ply"
    assert "nowhere: no such file" in refused(capsys, tmp_path / "nowhere", "-o", out)
    assert "expected a COLMAP model" in refused(capsys, tmp_path, "-o", out)
    assert "--out: expected a name that ends in" in refused(capsys, photos, "-o", tmp_path / "scene.xyz")
    assert "--downscale: expected none" in refused(
        capsys, photos, "-o", out, "--width", "24", "--height", "16", "--downscale", "2"
    )
    assert "--test-every: expected 0 or at least 2" in refused(capsys, photos, "-o", out, "--test-every", "1")
    assert "--width: expected --height with it" in refused(capsys, photos, "-o", out, "--width", "24")
    assert "size: expected at most 48 x 32" in refused(capsys, photos, "-o", out, "--width", "96", "--height", "64")
    assert "nowhere: no such file or folder" in refused(capsys, photos, "-o", out, "--images", "nowhere")
    (tmp_path / "points.ply").write_bytes(ply_bytes({name: [0.0] for name in "xyz"}))
    assert "which is something else" in refused(capsys, photos, "-o", tmp_path / "points.ply")
    (tmp_path / "folder.ply").mkdir()
    assert "got a folder" in refused(capsys, photos, "-o", tmp_path / "folder.ply")
    (tmp_path / "scene.train.json").mkdir()
    assert "got a folder" in refused(capsys, photos, "-o", out)
    (tmp_path / "scene.train.json").rmdir()
    (tmp_path / "scene.ply.checkpoint").write_bytes(b"something else")
    assert "expected a checkpoint of gsvis" in refused(capsys, photos, "-o", out, *STEPS)
    shutil.copytree(photos, tmp_path / "one")
    write_points(tmp_path / "one" / "sparse" / "0" / "points3D.bin", PointCloud(np.ones((5, 3))))
    output = refused(capsys, tmp_path / "one", "-o", tmp_path / "one.ply")
    assert "expected points at 2 places or more" in output
    assert not out.exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_to_is_refused_at_once(photos: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "closed").mkdir(mode=0o500)
    assert "cannot write there" in refused(capsys, photos, "-o", tmp_path / "closed" / "scene.ply")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--width", "0"], "1 to 16384 pixels"),
        (["--downscale", "0.5"], "a factor of 1 to 64"),
        (["--steps", "0"], "1 to 10000000"),
        (["--sh-degree", "4"], "an SH degree of 0 to 3"),
        (["--device", "gpu"], "cuda"),
    ],
)
def test_wrong_arguments_exit_with_2_and_say_which(words: list[str], message: str, capsys: Capture) -> None:
    assert message in refused(capsys, "photos", "-o", "x.ply", *words)
    assert not Path("x.ply").exists()


def test_the_help_states_the_defaults_of_the_library(capsys: Capture) -> None:
    assert main(["train", "--help-all"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for value in (TrainConfig.iterations, TrainConfig.sh_degree, TrainConfig.evaluate_every, DensifyConfig.most_count):
        assert f"(default: {value})" in text
