"""`gsvis clean` at the command line: print, report, select, apply, remove; wrong arguments."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main, parse
from gsvis.cli.arguments import Clean
from gsvis.cli.asking import Settled
from gsvis.cli.options import Shown
from gsvis.cli.terminal import Status
from gsvis.edit import class_of
from gsvis.io import load_scene, save_scene
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.place import Place
from gsvis.scene.procedural import random_scene
from gsvis.scene.source import Source
from tests.edit.worlds import dirty_room

BOX = ["--box", "0.3", "0.3", "0.3", "2", "4.7", "2.7"]
QUICK = [*BOX, "--eyes", "3", "--held-out", "2"]


@pytest.fixture(scope="module", autouse=True)
def few_voxels() -> Iterator[None]:
    """Look at the grids of so small a scene coarsely; what finer ones show is tested in tests/edit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsvis.edit.shape._VOXELS", 1 << 19)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with dirty.ply and other.ply."""
    made = tmp_path_factory.mktemp("clean")
    save_scene(dirty_room().scene, made / "dirty.ply")
    save_scene(random_scene(np.random.default_rng(0), 60), made / "other.ply")
    return made


def test_a_scene_is_shown_selected_and_cleaned_in_one_go(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, out = str(folder / "dirty.ply"), str(tmp_path / "clean.ply")
    words = ["clean", scene, *QUICK, "-o", out, "--select", str(tmp_path / "s.npy"), "--report", str(tmp_path / "r")]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    before, after = load_scene(scene), load_scene(out)
    classes = np.load(tmp_path / "s.npy")
    assert len(after) == found["kept"] == int(np.count_nonzero(classes == 0)) < len(before)
    assert np.array_equal(after.means, before.means[classes == 0])
    for name in ("fog", "floaters", "flyaways"):
        assert found["classes"][name]["removed"] == int(np.count_nonzero(classes == class_of(name))) > 0
    page = (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    assert "floaters" in page
    assert "<script" not in page
    assert {"before_0.png", "classes_0.png", "after_0.png", "outside_1.png"} <= {
        file.name for file in (tmp_path / "r").iterdir()
    }
    report = json.loads((tmp_path / "r" / "report.json").read_text(encoding="utf-8"))
    assert report["classes"] == found["classes"]
    again = str(tmp_path / "again.ply")
    assert main(["clean", scene, "--apply", str(tmp_path / "s.npy"), "-o", again]) == 0
    assert "Gaussians" in capsys.readouterr().out
    assert Path(again).read_bytes() == Path(out).read_bytes()
    fog = str(tmp_path / "fog.ply")
    assert main(["clean", scene, "--apply", str(tmp_path / "s.npy"), "-o", fog, "--classes", "fog", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["removed"]["floaters"] == 0
    assert len(load_scene(fog)) == len(before) - found["classes"]["fog"]["removed"]


def test_without_out_nothing_is_written(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(folder.iterdir())
    assert main(["clean", str(folder / "dirty.ply"), *QUICK, "--classes", "fog"]) == 0
    out = capsys.readouterr().out
    assert "Nothing was removed" in out
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["none.ply"], "no such file"),
        (["SCENE", "-o", "SCENE"], "another file than SCENE"),
        (["SCENE", "-o", "OTHER"], "--overwrite"),
        (["SCENE", "-o", "OUT.splat"], ".ply"),
        (["SCENE", "--select", "OUT.txt"], ".npy"),
        (["SCENE", "--select", "TAKEN"], "--overwrite"),
        (["SCENE", "--classes", "mist"], "--classes"),
        (["SCENE", "--apply", "TAKEN"], "-o OUT"),
        (["SCENE", "--apply", "TAKEN", "-o", "OUT.ply", "--eyes", "3"], "--eyes"),
        (["SCENE", "--apply", "TAKEN", "-o", "OUT.ply"], "a different scene"),
        (["SCENE", "--apply", "OTHER", "-o", "OUT.ply"], "an .npy file"),
        (["OTHER", "--apply", "ALL", "-o", "OUT.ply"], "everything would go: nothing written"),
        (["OTHER", "--apply", "MANY", "-o", "OUT.ply"], "0 to 255"),
        (["SCENE", "--path", "FAR", "-o", "OUT.ply"], "--path"),
        (["SCENE", "--cameras", "none.json"], "no such file"),
        (["FAINT", "-o", "OUT.ply"], "nothing to see"),
    ],
)
def test_wrong_input_is_one_line_and_writes_nothing(
    words: list[str], wanted: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "taken.npy", np.zeros(7, np.uint8))
    np.save(tmp_path / "all.npy", np.ones(60, bool))
    np.save(tmp_path / "many.npy", np.full(60, 999))
    walk = "t,x,y,z,qw,qx,qy,qz\n" + "".join(f"{t},9000,{t},9000,1,0,0,0\n" for t in range(9))
    (tmp_path / "far.csv").write_text(walk)
    g = random_scene(np.random.default_rng(1), 30)
    save_scene(type(g)(g.means, g.quats, g.scales, np.full(30, 0.001), g.sh0), tmp_path / "faint.ply")
    known = {
        "SCENE": folder / "dirty.ply", "OTHER": folder / "other.ply", "TAKEN": tmp_path / "taken.npy",
        "ALL": tmp_path / "all.npy", "MANY": tmp_path / "many.npy", "FAR": tmp_path / "far.csv",
        "FAINT": tmp_path / "faint.ply", **{f"OUT.{end}": tmp_path / f"out.{end}" for end in ("ply", "splat", "txt")},
    }  # fmt: skip
    assert main(["clean", *(str(known.get(word, word)) for word in words)]) == 2
    error = capsys.readouterr().err
    assert wanted in error
    assert len(error.strip().splitlines()) == 1
    assert not list(tmp_path.glob("out.*"))


def test_a_strength_out_of_range_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["clean", str(folder / "dirty.ply"), "--strength", "3"]) == 2
    assert "a strength of 0.01 to 2" in " ".join(capsys.readouterr().err.split())


def test_a_selection_of_a_scene_that_changed_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from gsvis.io.selection import load_selection, note_of, save_selection

    g = load_scene(folder / "other.ply")
    classes = np.arange(60, dtype=np.uint8) % 3
    save_selection(tmp_path / "s.npy", classes, g, ("a", "b"))
    assert np.array_equal(load_selection(tmp_path / "s.npy", g), classes)
    save_scene(g[::-1], tmp_path / "turned.ply")
    words = ["clean", str(tmp_path / "turned.ply"), "--apply", str(tmp_path / "s.npy"), "-o", str(tmp_path / "o.ply")]
    assert main(words) == 2
    assert "this scene" in capsys.readouterr().err
    note_of(tmp_path / "s.npy").unlink()  # as other programs write it
    assert main(words) == 0


def test_a_scene_that_does_not_fit_is_cleaned_in_tiles(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("gsvis.edit.memory.BASE", 598_000_000)
    monkeypatch.setattr("gsvis.cli.clean._LEAST", 100)
    monkeypatch.setattr("gsvis.cli.clean._MOST_UNSEEN", 0.0)
    scene, out = str(folder / "dirty.ply"), str(tmp_path / "clean.ply")
    words = ["clean", scene, "-o", out, "--max-memory", "600MB", "--eyes", "3", "--held-out", "0", "--up", "+z"]
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    unseen = sum(found["classes"][name]["removed"] for name in ("interior", "unseen"))
    assert f"{unseen / found['gaussians']:.0%} is never seen" in said.err
    assert found["tiles"] >= 3
    assert found["gaussians"] == len(load_scene(scene))
    assert (
        found["kept"]
        == len(load_scene(out))
        == found["gaussians"] - sum(each["removed"] for each in found["classes"].values())
    )
    assert [path.name for path in tmp_path.iterdir()] == ["clean.ply"]


def test_a_remark_says_that_most_is_never_seen(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["clean", str(folder / "dirty.ply"), "--eyes", "3", "--held-out", "0", "--up", "+z"]
    assert main(words) == 0
    assert "is never seen" not in capsys.readouterr().out
    monkeypatch.setattr("gsvis.cli.clean._MOST_UNSEEN", 0.0)
    assert main(words) == 0
    assert "0% is never seen from where eyes were found" in " ".join(capsys.readouterr().out.split())


@pytest.mark.usefixtures("blank_plots")
def test_a_report_repeats_what_was_answered_and_a_stated_kind_is_kept(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def answered(
        where: Shown, source: Source, find: Callable[[Shown], Place], status: Status, *, quiet: bool
    ) -> Settled[Shown]:
        said = replace(where, kind="rooms")
        return Settled(said, find(said), None)

    def parcels(*_: object, **__: object) -> NavigableSpace:
        raise AssertionError("a stated kind is not looked for in parcels")

    monkeypatch.setattr("gsvis.cli.clean.settle", answered)
    monkeypatch.setattr("gsvis.edit.find_in_parcels", parcels)
    words = ["clean", str(folder / "dirty.ply"), "--report", str(tmp_path), "--eyes", "3", "--held-out", "0"]
    assert main([*words, "--up", "+z", "--json"]) == 0
    again = parse(shlex.split(json.loads(capsys.readouterr().out)["command"])[1:])
    assert isinstance(again, Clean)
    assert again.where.kind == "rooms"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--max-memory", "100MB"], "raise it, or take a coarser --lod"),
        (["--max-memory", "100MB", "--select", "s.npy"], "--select needs all of them: leave it out"),
        (["--max-memory", "100MB", "--show", "s.png"], "--show needs all of them: leave it out"),
        (["--max-memory", "100MB", "-o", "clean.spz"], "tiles are written to a .ply"),
    ],
)
def test_memory_that_does_not_suffice_is_one_line(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    words: list[str], message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["clean", str(folder / "dirty.ply"), *words]) != 0
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not list(tmp_path.iterdir())
