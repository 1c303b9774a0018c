"""`--device`: one meaning in all commands, one line where there is no GPU, and no torch where nobody needs it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from PIL import Image

from gsvis._extras import has
from gsvis.cli import main
from gsvis.cli.arguments import Command
from gsvis.cli.options import command_name, leaves
from gsvis.errors import BackendError
from gsvis.io import load_scene, save_scene
from gsvis.render import rasterizer_torch
from gsvis.render.device import Device
from gsvis.scene.procedural import two_rooms
from tests import warm_start
from tests.render.pretended_gpu import pretend_gpu
from tests.train.photo_files import cloud, write_photos

Capture = pytest.CaptureFixture[str]
NAMES = ("analyze", "color", "levels", "prepare", "pvs", "render", "train")
LINE = "device 'cuda': expected a GPU, got none"


@pytest.fixture(scope="module")
def ply(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "rooms.ply"
    save_scene(two_rooms(1000, sh_degree=1).gaussians, path)
    return path


class Tried(Device):
    """A device that goes the way of a GPU with tensors on the CPU."""

    @property
    def backend(self) -> str:
        return "reference"


def test_seven_commands_have_it() -> None:
    kinds = {command_name(kind): kind for kind in get_args(Command)}
    found = [name for name, kind in kinds.items() if any(leaf.name == "device" for leaf in leaves(kind))]
    assert sorted(found) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_missing_gpu_is_one_line_before_any_work(
    name: str, ply: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(asked: str) -> Device:
        assert asked == "cuda"
        raise BackendError(LINE)

    def work(*_: object, **__: object) -> None:
        raise AssertionError("work began")

    home = f"gsvis.cli.{name}"
    monkeypatch.setattr(f"{home}.choose_device", fail)
    given = ply
    out = tmp_path / "out.ply"
    if name == "train":
        given = write_photos(tmp_path / "photos", points=cloud())
        monkeypatch.setattr(f"{home}._plan", work)
    else:
        monkeypatch.setattr(f"{home}.open_source", work)
    assert main([name, str(given), "-o", str(out.with_suffix(".png") if name == "render" else out),
                 "--device", "cuda"]) == 2  # fmt: skip
    printed, err = capsys.readouterr()
    assert printed == ""
    assert err == f"gsvis: error: {LINE}\n"
    assert not out.exists()


def test_torch_is_not_imported_for_the_cpu(ply: Path, tmp_path: Path) -> None:
    """What needs no torch does not load it, whatever the device: it takes seconds."""
    box = ["--box", "1", "1", "1", "7", "3", "2"]
    small = ["--width", "16", "--height", "12"]
    sets = ["--cells", "1", "--face-size", "16", "--certify", "256", "--max-inner", "1", "--workers", "1"]
    words = [
        ["analyze", str(ply), "-o", "a", "--views", "1", *small, "--traced-sample", "0", *box],
        ["pvs", str(ply), "-o", "a.pvs", *sets, *box],
    ]
    device = "cpu" if has("gsplat") else "auto"
    code = f"""
import sys
from gsvis.cli import analyze, main
analyze.JUDGES = 2
for words in {words!r}:
    words += ["--device", {device!r}]
    assert main(words) == 0, words
    assert "torch" not in sys.modules, words
"""
    ran = warm_start.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr


def test_a_device_draws_what_the_cpu_draws(
    ply: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = ["--eye", "2", "2", "1", "--width", "16", "--height", "12"]
    assert main(["render", str(ply), "-o", str(tmp_path / "here.png"), *look]) == 0
    capsys.readouterr()
    monkeypatch.setattr("gsvis.cli.render.choose_device", lambda asked: Tried("reference", "a GPU of a test"))
    assert main(["render", str(ply), "-o", str(tmp_path / "there.png"), *look]) == 0
    assert "device: reference, a GPU of a test" in capsys.readouterr().err
    pictures = [np.asarray(Image.open(tmp_path / f"{name}.png")).astype(int) for name in ("here", "there")]
    assert np.abs(pictures[0] - pictures[1]).max() <= 1
    assert pictures[0].max() > 0


TINY = ["--width", "20", "--height", "16"]
RUNS = {
    "render": ["render", "IN", "-o", "a.png", *TINY, "--eye", "2", "2", "1"],
    "levels": ["levels", "IN", "-o", "levels", "--steps", "2", *TINY, "--views", "2", "--held-out", "1",
               "--preview", "0"],
    "color": ["color", "IN", "-o", "a.arrow", "--views", "2", "--held-out", "0", *TINY, "--max-terms", "1",
              "--color-steps", "2", "--fit", "omp", "--directions", "faces"],
    "train": ["train", "PHOTOS", "-o", "a.ply", "--steps", "4", "--evaluate-every", "4", "--sh-degree", "0"],
}  # fmt: skip


@pytest.mark.parametrize("name", RUNS)
def test_a_command_runs_whole_on_a_gpu_that_is_pretended(
    name: str, ply: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save_scene(load_scene(ply)[::6], tmp_path / "few.ply")
    places = {"IN": "few.ply", "PHOTOS": "photos"}
    if name == "train":
        write_photos(tmp_path / "photos", points=cloud())
    drawn: list[str] = []
    pretend_gpu(monkeypatch)
    rasterize_cuda = rasterizer_torch.rasterize_cuda
    monkeypatch.setattr(
        rasterizer_torch, "rasterize_cuda", lambda *words, **named: drawn.append("") or rasterize_cuda(*words, **named)
    )
    box = [] if name in ("train", "render") else ["--box", "1", "1", "1", "7", "3", "2"]
    assert main([places.get(word, word) for word in RUNS[name]] + box + ["--device", "cuda", "--json"]) == 0
    out, err = capsys.readouterr()
    assert "gsvis: device: cuda, a pretended GPU\n" in err
    assert "memory" not in err
    assert len(drawn) >= (1 if name == "render" else 4)
    document = json.loads(out)
    if name == "train":
        assert document["device"] == "cuda"


def test_the_cpu_says_nothing(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    words = ["render", str(ply), "-o", str(tmp_path / "a.png"), "--eye", "2", "2", "1", "--width", "16"]
    assert main([*words, "--height", "12", "--device", "cpu"]) == 0
    assert "device" not in capsys.readouterr().err
