"""`gsvis pvs-report` in this process: what it prints, writes and refuses."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main, parse
from gsvis.cli.arguments import PvsReport
from gsvis.cli.pvs_report import JUDGES, _viewpoints
from gsvis.errors import SceneError
from gsvis.io import save_scene
from gsvis.io.sources import load_source
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.cameras import Cameras
from gsvis.scene.corridor import corridor
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms

Capture = pytest.CaptureFixture[str]
QUICK = ["--cells", "2", "--eyes", "1", "--dense", "2", "--width", "24", "--height", "18", "--certify", "200"]
FEW = PvsConfig(method="raster", size=16, rays=256, max_inner=1)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A store and its scene."""
    folder = tmp_path_factory.mktemp("built")
    save_scene(two_rooms(1000, sh_degree=1).gaussians, folder / "rooms.ply")
    source = load_source(str(folder / "rooms.ply"), None)
    space = NavigableSpace.from_scene(source.gaussians)
    build_pvs(source.gaussians, CellGrid.over(space, max_cells=6), space, folder / "rooms.pvs", FEW).close()
    return folder / "rooms.pvs", folder / "rooms.ply"


def refused(capsys: Capture, *arguments: object) -> str:
    """The one line on stderr of a refusal; nothing on stdout. No stage is printed, however slow the machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsvis.cli.terminal._QUIET", float("inf"))
        assert main([str(word) for word in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert err.startswith("gsvis: error: ")
    return err


def test_it_writes_a_report_and_prints_tables(
    built: tuple[Path, Path], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["pvs-report", *map(str, built), "-o", "new/report", *QUICK]) == 0
    text = capsys.readouterr().out
    assert "new/report/report.html" in text.split()
    row = text[text.index("light that the set keeps") :].splitlines()[
        :2
    ]  # the second target may stand on a line of its own
    assert "99.9%;" in row[0]
    assert "99.5%" in "".join(row)
    assert "in the navigable space that the store was built in" in " ".join(text.split())
    assert "rooms" in text
    assert "visible Gaussians that it has, " in text
    said = " ".join(text.split())
    assert "pixels (px) around a viewpoint" in said
    assert "of 2 measured cells; bounds with 95% confidence may in one of twenty" in said
    assert "The worst tile of 16 x 16 pixels misses " in said
    assert "400 random rays from free points" in " ".join(text.split())
    assert max(map(len, text.splitlines())) <= 80
    assert json.loads(Path("new/report/report.json").read_text())["quality"]["cells_measured"] == 2


@pytest.mark.usefixtures("blank_plots")
def test_json_is_the_document_and_its_command_makes_it_again(
    built: tuple[Path, Path], tmp_path: Path, capsys: Capture
) -> None:
    words = ["pvs-report", *map(str, built), "-o", str(tmp_path), *QUICK, "--seed", "3", "--raycast"]
    assert main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / "report.json").read_text())
    assert document["format"] == "gsvis-pvs-report"
    assert "ray_recall" in document["quality"]["figures"]
    assert parse(shlex.split(document["command"])[1:]) == parse(words)


@pytest.mark.usefixtures("blank_plots")
def test_it_says_what_was_done_to_cameras_and_stands_without_judges(
    built: tuple[Path, Path], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nobody(*_: object, **__: object) -> object:
        raise SceneError("no place is free")

    monkeypatch.setattr("gsvis.pvs.judged.judge_sets", nobody)
    space = NavigableSpace.from_scene(load_source(str(built[1]), None).gaussians)
    eyes = space.sample_viewpoints(4, np.random.default_rng(0))
    cameras = Cameras.look_at(eyes + 500.0, eyes + 500.0 + [1.0, 0.0, 0.0], up=(0, 0, 1), width=32, height=24, fov=60.0)
    poses = np.linalg.inv(cameras.viewmats) * [1.0, -1.0, -1.0, 1.0]  # OpenGL axes
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose.tolist()} for k, pose in enumerate(poses)]
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({"fl_x": 27.7, "w": 32, "h": 24, "frames": frames}))
    words = ["pvs-report", *map(str, built), "-o", str(tmp_path / "r"), *QUICK, "--cameras", str(file), "--json"]
    assert main(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["judged"] is None
    of_cameras, of_judges = document["scene"]["remarks"]
    assert "4 of 4 cameras" in of_cameras
    assert of_judges.strip() == "Not checked by other eyes: no place is free."


def test_a_hundred_eyes_of_two_rules_judge() -> None:
    assert 2 * JUDGES >= 100  # as imported, before tests take fewer


def test_defaults_are_those_of_the_library() -> None:
    from gsvis.pvs.quality import QualityConfig

    command = parse(["pvs-report", "a.pvs", "b.ply", "-o", "c"])
    assert isinstance(command, PvsReport)
    config = QualityConfig()
    for name in ("cells", "dense", "width", "height", "fov", "bytes_per_gaussian", "seed"):
        assert getattr(command.quality, name) == getattr(config, name)
    assert (command.quality.eyes, command.quality.raycast) == (config.viewpoints, config.rays)


def test_another_scene_a_damaged_store_and_missing_files_are_refused_in_one_line(
    built: tuple[Path, Path], tmp_path: Path, capsys: Capture
) -> None:
    store, scene = built
    out = tmp_path / "out"
    assert "scene" in refused(capsys, "pvs-report", store, "builtin:wall_with_hole", "-o", out)
    half = tmp_path / "half.pvs"
    half.write_bytes(store.read_bytes()[: store.stat().st_size // 2])
    assert "half.pvs" in refused(capsys, "pvs-report", half, scene, "-o", out)
    assert "rooms.ply" in refused(capsys, "pvs-report", scene, scene, "-o", out)
    assert "no such file" in refused(capsys, "pvs-report", tmp_path / "none.pvs", scene, "-o", out)
    assert "no such file" in refused(capsys, "pvs-report", store, tmp_path / "none.ply", "-o", out)
    assert "expected a folder" in refused(capsys, "pvs-report", store, scene, "-o", store)
    assert not out.exists()


def test_damage_inside_a_store_is_reported_before_anything_is_written(
    built: tuple[Path, Path], tmp_path: Path, capsys: Capture
) -> None:
    data = bytearray(built[0].read_bytes())
    with VisibilityStore.open(built[0]) as store:
        start = store._file.section("sets").offset
    data[start + 2] ^= 255
    bad = tmp_path / "bad.pvs"
    bad.write_bytes(bytes(data))
    assert "bad.pvs" in refused(capsys, "pvs-report", bad, built[1], "-o", tmp_path / "out", "--cells", 99, *QUICK[2:])
    assert not (tmp_path / "out").exists()


def test_fresh_viewpoints_stay_in_the_space_of_the_build_as_far_as_it_is_known(
    built: tuple[Path, Path], tmp_path: Path
) -> None:
    source = load_source(str(built[1]), None)
    g, space = source.gaussians, NavigableSpace.from_scene(source.gaussians)
    with VisibilityStore.open(built[0]) as store:
        viewpoints, text = _viewpoints(store, source)
        assert text.endswith("that the store was built in")
        assert np.array_equal(viewpoints.space.free, space.free)
    voxel = np.argwhere(space.free)[0]
    walk = space.origin + space.voxel_size * (voxel + 0.5)
    along = corridor(space, walk[None], 3.0 * space.voxel_size)
    with build_pvs(g, CellGrid.over(along, max_cells=6), along, tmp_path / "walk.pvs", FEW) as store:
        viewpoints, text = _viewpoints(store, source)
        assert text.endswith("covers a part")
        assert np.all(space.contains(viewpoints.draw(0, 20, np.random.default_rng(0))))
    box = NavigableSpace.from_box((1, 1, 1), (2, 2, 2), 4)
    with build_pvs(g, CellGrid.over(box, max_cells=8), box, tmp_path / "box.pvs", FEW) as store:
        viewpoints, text = _viewpoints(store, source)
        assert text.startswith("anywhere in the boxes")
        assert np.all(store.grid.cell_at(viewpoints.draw(2, 20, np.random.default_rng(0))) == 2)
