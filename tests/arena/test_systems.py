"""Trainings are kept and checked, systems are named and cited, damaged files are one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from arena import run
from arena.budget import Allowance
from arena.course import Course
from arena.files import load_arrays, save_arrays
from arena.report import figures_of, find_weak, sizes_table, streams_table
from arena.systems import SYSTEMS, Training, trained
from arena.systems.gaussians import SYSTEMS as GAUSSIANS
from arena.systems.ours import PACKAGE, open_package

from gsvis.errors import FormatError, SceneError
from gsvis.progress import Progress

FEW = Allowance(60.0, 2_000, steps=2)


def test_every_system_is_named_once_and_cited() -> None:
    names = [system.name for system in SYSTEMS]
    assert len(set(names)) == len(names)
    assert names[0] == "gsvis"
    for system in SYSTEMS:
        assert system.source
        whole = system.name in ("gsvis", "gsvis, 48 dB records") or system.training.name == "3dgs"
        assert bool(system.simplified) == (not whole), system.name


def test_a_training_runs_once_and_belongs_to_its_photographs(course: Course, tmp_path: Path) -> None:
    ran: list[str] = []

    def note(course: Course, allowance: Allowance, folder: Path, progress: Progress) -> None:
        ran.append(folder.name)

    first = Training("first", note)
    second = Training("second", note, first)
    folder, _ = trained(second, course, FEW, tmp_path)
    assert ran == ["first.partial", "second.partial"]
    assert trained(second, course, FEW, tmp_path)[0] == folder
    assert len(ran) == 2
    with pytest.raises(SceneError, match="got another; give another --work"):
        trained(second, course, Allowance(61.0, 2_000, steps=2), tmp_path)
    (folder / "trained.json").write_text("{")
    with pytest.raises(FormatError, match="key and seconds of a training"):
        trained(second, course, FEW, tmp_path)


def test_an_interrupted_training_leaves_nothing_that_counts(course: Course, tmp_path: Path) -> None:
    def stop(course: Course, allowance: Allowance, folder: Path, progress: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(Training("a", stop), course, FEW, tmp_path)
    assert not (tmp_path / "a").exists()


def test_a_damaged_file_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "scene.npz"
    save_arrays(path, a=np.arange(10))
    np.testing.assert_array_equal(load_arrays(path)["a"], np.arange(10))
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(FormatError, match="arrays of a trained system"):
        load_arrays(path)


def test_plain_files_show_the_trained_scene(course: Course, tmp_path: Path) -> None:
    sizes = {}
    for system in GAUSSIANS:
        folder, seconds = trained(system.training, course, FEW, tmp_path)
        opened = system.open(course, folder)
        sizes[system.name] = opened.nbytes
        assert seconds > 0.0
        assert opened.whole(course, 0).shape == (32, 48, 3)
    assert sizes["3DGS, SPZ"] < sizes["3DGS, PLY"] > sizes["3DGS, SOG"]


def test_a_package_of_another_scene_is_refused(course: Course, tmp_path: Path) -> None:
    from gsvis.io import save_scene
    from gsvis.scene.procedural import random_scene
    from tests.simulate.streets import street

    made = street(tmp_path)[0]
    (tmp_path / "half").mkdir()
    save_scene(random_scene(np.random.default_rng(0), 7, 0), tmp_path / "half" / "scene.ply")
    folder = tmp_path / "gsvis"
    folder.mkdir()
    Path(made.source.path).rename(folder / PACKAGE)
    with made.source, pytest.raises(SceneError, match="it is of another scene or level"):
        open_package(folder)


def test_the_command_plays_and_writes_one_result(
    course: Course, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run, "open_course", lambda options: course)
    monkeypatch.setattr(run, "Allowance", lambda seconds, gaussians, steps: FEW)
    out = tmp_path / "arena.json"
    words = ["run.py", "--quick", "--systems", "3DGS, PLY", "3DGS, SOG", "--work", str(tmp_path), "--out", str(out)]
    monkeypatch.setattr("sys.argv", words)
    monkeypatch.setattr("_harness.read_notes", lambda doc: {})
    run.main()
    found = json.loads(out.read_text())["details"]
    assert [each["name"] for each in found["systems"]] == ["3DGS, PLY", "3DGS, SOG"]
    assert len(found["sessions"]) == 4
    links = {name: [row["link"] for row in found["sessions"] if row["system"] == name] for name in words[3:5]}
    assert links["3DGS, PLY"] == links["3DGS, SOG"]
    assert "| 3DGS, PLY |" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["run.py", "--systems", "no such"])
    with pytest.raises(SystemExit):
        run.main()


def test_a_copy_far_below_plain_3dgs_is_weak() -> None:
    systems = [{"name": "plain", "psnr": 29.0}, {"name": "a", "psnr": 27.9}, {"name": "b", "psnr": 28.1}]
    assert find_weak(systems, "plain") == ["a"]
    assert find_weak(systems, "none") == []


def test_tables_say_what_never_came() -> None:
    mean = {
        "mbit": 3.0, "system": "a", "qoe_20": -1.0, "qoe_25": -2.0, "psnr": 20.0, "first_20": 1.5, "first_25": None,
        "sessions": 2,
    }  # fmt: skip
    apart = {
        "mbit": 3.0,
        "system": "a",
        "qoe_20": {"mean": 1.0, "low": 0.5, "high": 1.5},
        "psnr": None,
        "qoe_25": None,
        "qoe_20_ahead": 1,
    }
    line = streams_table([mean], [apart]).splitlines()[-1]
    assert "| 1.5 | never | +1.000 (0.500 to 1.500) | 1 of 2 |  |  |" in line
    assert figures_of([apart])[0]["reached"] == 0.5
    assert figures_of([apart])[0]["target"] == 0.0
    assert figures_of([apart], own=["a"])[0]["target"] is None
    assert "a (weak copy)" in streams_table([mean], [apart], ["a"])
    assert "a (weak copy)" in figures_of([apart], ["a"])[0]["name"]
    system = {"name": "a", "count": 1000, "bytes": 2e6, "psnr": 25.0, "seconds": 3.0, "published": ""}
    assert sizes_table([system]).splitlines()[-1] == "| a | 1,000 | 2.00 | 25.00 | 3 | - |"
