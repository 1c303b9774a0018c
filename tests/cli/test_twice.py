"""Every command that writes, run twice with the same words: the same bytes, but for the times."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from gsvis.cli import main
from gsvis.export.page import write_site
from gsvis.files.sums import unseal
from gsvis.io import save_scene
from gsvis.io.poses import write_poses
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import BUILTIN_SCENES, two_rooms
from tests.export.viewers import viewer_of
from tests.few_views import take_few_views
from tests.known_spaces import coarse_spaces
from tests.simulate.streets import walk
from tests.train.photo_files import write_transforms

VIEW = ["--width", "32", "--height", "24"]
SETS = ["--cells", "4", "--face-size", "16", "--certify", "256", "--max-inner", "1"]
BOX = ["--box", "0.5", "0.5", "0.5", "3.5", "3.5", "2.5"]
COMMANDS = {
    "convert to ply": ["convert", "../rooms.ply", "out.ply", "--min-opacity", "0.1"],
    "convert to spz": ["convert", "../rooms.ply", "out.spz"],
    "convert to compact spz": ["convert", "../rooms.ply", "out.spz", "--compact"],
    "convert to ksplat": ["convert", "../rooms.ply", "../rooms.ply", "-o", "out.ksplat", "--rotate", "1", "2", "3"],
    "convert to sog": ["convert", "../rooms.ply", "out.sog"],
    "cut": ["cut", "../rooms.ply", "-o", "out.ply", "--box", "1", "1", "1", "2", "2", "2", "--face-size", "16",
            "--held-out", "1", "--limit", "0.05", "--select", "out.npy"],
    "paint": ["paint", "../rooms.ply", "-o", "out.ply", "--by", "directions", "--eyes", "2", "--face-size", "16",
              "--box", "1", "1", "1", "2", "2", "2"],
    "render": ["render", "../rooms.ply", "-o", "out/", "--orbit", "2", "--depth", *VIEW],
    "render gif": ["render", "../rooms.ply", "-o", "out.gif", "--orbit", "2", *VIEW],
    "analyze": ["analyze", "../rooms.ply", "-o", "out", "--views", "2", *VIEW, "--traced-sample", "50",
                "--rays-per-face", "1"],
    "pvs": ["pvs", "../rooms.ply", "-o", "out.pvs", *SETS, "--workers", "1"],
    "pvs-report": ["pvs-report", "../rooms.pvs", "../rooms.ply", "-o", "out", "--cells", "1", "--eyes", "1",
                   "--dense", "0", *VIEW],
    "color": ["color", "../rooms.ply", "-o", "out.arrow", "--views", "2", "--held-out", "1", *VIEW, "--max-terms", "1",
              "--color-steps", "2",
              "--report", "report"],
    "levels": ["levels", "../rooms.ply", "-o", "out", "--steps", "3", "--views", "2", "--held-out", "1",
               "--width", "32", "--height", "24"],
    "train": ["train", "../photos", "-o", "out.ply", "--steps", "6", "--random-points", "50",
              "--evaluate-every", "3"],
    "prepare": ["prepare", "builtin:wall_with_hole", "-o", "out.gsvis", "--cells", "2", "--face-size", "16",
                "--limit", "0.05", "--max-inner", "1", "--workers", "1", "--max-terms", "1", "--levels", "none"],
    "clean": ["clean", "../rooms.ply", "-o", "out.ply", "--select", "out.npy", "--report", "report", "--eyes", "1",
              "--held-out", "1", *BOX],
    "export": ["export", "../rooms.gsvis", "-o", "out"],
    "space": ["space", "../rooms.ply", "-o", "out.voxel.json", *BOX],
    "world": ["world", "../rooms.ply", "-o", "out.gsworld", "--levels", "none", "--cells", "1", "--face-size", "16",
              "--limit", "0.05", "--workers", "1", "--tile", "5000"],
    "unpack": ["unpack", "../rooms.gsvis", "-o", "out"],
    "simulate": ["simulate", "../rooms.gsvis", "--path", "../walk.csv", "-o", "out", "--mbit", "1", "--seconds", "0.5",
                 *VIEW],
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def known_spaces() -> None:
    """Find spaces anew: that is part of what repeats."""


@pytest.fixture(scope="module", autouse=True)
def quick(tmp_path_factory: pytest.TempPathFactory) -> object:
    """Packages of few views, small pictures, a stand-in for the built viewer."""
    viewer = viewer_of(tmp_path_factory.mktemp("viewer") / "built")
    made = replace(two_rooms(1000, sh_degree=1), navigable=NavigableSpace.from_box((1, 1, 1), (7, 3, 2), 12))
    with pytest.MonkeyPatch.context() as patch, take_few_views(), coarse_spaces():
        patch.setitem(BUILTIN_SCENES, "wall_with_hole", lambda: made)
        patch.setattr("gsvis.cli.analyze.PICTURE", 24)
        patch.setitem(write_site.__kwdefaults__, "viewer", viewer)
        yield


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("twice")
    save_scene(two_rooms(1000, sh_degree=1).gaussians, folder / "rooms.ply")
    (folder / "photos").mkdir()
    write_transforms(folder / "photos", 8)
    write_poses(walk(3.0), folder / "walk.csv")
    words = COMMANDS["prepare"]
    assert main([*words[:3], str(folder / "rooms.gsvis"), *words[4:]]) == 0
    words = COMMANDS["pvs"]
    assert main(["pvs", str(folder / "rooms.ply"), "-o", str(folder / "rooms.pvs"), *words[4:]]) == 0
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """All files by name, hidden ones too; times left out where they may be."""
    found = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert not any(re.search(r"\.gsvis-[0-9a-f]{12}", name) for name in found)
    for name, data in found.items():
        if name.endswith(".train.json"):
            record = json.loads(data)
            assert record.pop("timing")["seconds"]
            found[name] = json.dumps(record).encode()
        elif "notes" in Path(name).parts:  # of a task of a world
            note = json.loads(unseal(data) or b"")
            assert note.pop("cpu") >= 0.0
            assert note.pop("seconds") > 0.0
            assert note.pop("peak") >= 0
            found[name] = json.dumps(note).encode()
        elif Path(name).name == "timings.json":
            assert json.loads(data)["seconds"]
            found[name] = b""
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_run_twice_writes_the_same_bytes(
    name: str, inputs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = []
    for _ in range(2):
        folder = inputs / "work"
        folder.mkdir()
        monkeypatch.chdir(folder)
        assert main(COMMANDS[name]) == 0, capsys.readouterr().err
        found.append(contents(folder))
        monkeypatch.chdir(inputs)
        shutil.rmtree(folder)
    assert found[0].keys() == found[1].keys()
    assert [path for path in found[0] if found[0][path] != found[1][path]] == []


@pytest.mark.usefixtures("blank_plots")  # that plots repeat is seen above
def test_a_command_that_finds_its_own_result_writes_the_same_again(
    inputs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(inputs)
    found = []
    for _ in range(2):
        for name in ("analyze", "levels", "pvs"):
            words = [re.sub(r"^out\b", f"own-{name}", word.replace("../", "")) for word in COMMANDS[name]]
            assert main(words) == 0, capsys.readouterr().err
        found.append(contents(inputs))
    assert found[0] == found[1]
