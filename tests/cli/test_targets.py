"""Every command refuses a wrong output at once: before any stage, with nothing of the user's replaced."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from gsvis.cli import main
from gsvis.cli.terminal import Status
from gsvis.io import save_scene
from gsvis.io.poses import write_poses
from gsvis.package import in_package_order, write_package
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import two_rooms
from tests.package.worlds import colors_of
from tests.simulate.streets import walk
from tests.train.photo_files import cloud, write_photos

pytestmark = pytest.mark.usefixtures("blank_plots")
Capture = pytest.CaptureFixture[str]


def foreign(*names: str) -> Callable[[Path], None]:
    """Something else of these names, below the target or, for "", in its place."""

    def make(out: Path) -> None:
        for name in names:
            path = out / name if name else out
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"mine, and it took years")

    return make


REFUSALS = {
    "levels, a PLY of somebody": ("levels {ply} -o {out}", foreign("low.ply")),
    "levels, a damaged map": ("levels {ply} -o {out}", foreign("levels.arrow")),
    "levels, a file": ("levels {ply} -o {out}", foreign("")),
    "prepare, a folder of something": ("prepare {ply} -o {out}", foreign("notes.txt")),
    "prepare, a file": ("prepare {ply} -o {out}", foreign("")),
    "analyze, a page": ("analyze {ply} -o {out}", foreign("report.html")),
    "analyze, pictures": ("analyze {ply} -o {out}", foreign("visible.png")),
    "analyze, a file": ("analyze {ply} -o {out}", foreign("")),
    "pvs-report, a page": ("pvs-report {pvs} {ply} -o {out}", foreign("report.json")),
    "pvs-report, a file": ("pvs-report {pvs} {ply} -o {out}", foreign("")),
    "simulate, a page": ("simulate {package} --path {walk} -o {out}", foreign("report.html")),
    "simulate, a file": ("simulate {package} --path {walk} -o {out}", foreign("")),
    "color, something": ("color {ply} -o {out}", foreign("")),
    "color, a folder": ("color {ply} -o {out}", foreign("x")),
    "color, its report": ("color {ply} -o {other} --report {out}", foreign("report.html")),
    "color, its terms": ("color {ply} -o {other} --pvs {pvs} --active {out}", foreign("")),
    "pvs, something": ("pvs {ply} -o {out}", foreign("")),
    "pvs, a folder": ("pvs {ply} -o {out}", foreign("x")),
    "train, something": ("train {photos} -o {out}.ply", lambda out: foreign("")(out.with_name("out.ply"))),
    "train, its record": ("train {photos} -o {out}.ply", lambda out: foreign("")(out.with_name("out.train.json"))),
    "render, a picture": ("render {ply} -o {out}.png", lambda out: foreign("")(out.with_name("out.png"))),
    "render, a frame": ("render {ply} -o {out} --orbit 3", foreign("0002.png")),
    "convert, a scene": ("convert {ply} {out}.ply", lambda out: foreign("")(out.with_name("out.ply"))),
}
INPUTS = {
    "simulate, no package": ("simulate {ply} --path {walk} -o {out}", "ply"),
    "simulate, no trace": ("simulate {package} --path {walk} --trace {ply} -o {out}", "ply"),
    "simulate, no path": ("simulate {package} --path {ply} -o {out}", "ply"),
    "pvs-report, no store": ("pvs-report {ply} {ply} -o {out}", "ply"),
    "pvs, no path": ("pvs {ply} -o {out} --path {ply}", "ply"),
    "color, no store": ("color {ply} -o {out} --pvs {ply}", "ply"),
    "analyze, no cameras": ("analyze {ply} -o {out} --cameras {walk}", "walk.csv"),
    "render, no cameras": ("render {ply} -o {out}.png --cameras {walk}", "walk.csv"),
}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What the commands read."""
    folder = tmp_path_factory.mktemp("world")
    scene = two_rooms(1000, sh_degree=1).gaussians
    save_scene(scene, folder / "rooms.ply")
    few = "--cells 2 --face-size 16 --workers 1 --certify 256 --max-inner 1 --box 0.5 0.5 0.5 3.5 3.5 2.5"
    assert main(["pvs", f"{folder}/rooms.ply", "-o", f"{folder}/rooms.pvs", *few.split()]) == 0
    levels = in_package_order(Levels.single(scene))
    write_package(folder / "rooms.gsvis", levels, colors_of(len(levels.union))[1]).close()
    write_poses(walk(3.0), folder / "walk.csv")
    photos = write_photos(tmp_path_factory.mktemp("photos"), points=cloud())
    names = {"ply": "rooms.ply", "pvs": "rooms.pvs", "package": "rooms.gsvis", "walk": "walk.csv"}
    return {name: folder / file for name, file in names.items()} | {"photos": photos}


def refused(words: list[str], capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> str:
    """The one line of a refusal; no stage was begun."""
    stages: list[str] = []
    monkeypatch.setattr(Status, "__call__", lambda self, stage, done, total: stages.append(stage))
    capsys.readouterr()
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert stages == []
    assert out == ""
    assert len(err.splitlines()) == 1
    assert err.startswith("gsvis: error: ")
    return err


@pytest.mark.parametrize("way", ["out", "missing/../out", "a/b/../../out"])
@pytest.mark.parametrize("name", REFUSALS)
def test_a_wrong_output_is_refused_at_once(
    name: str, way: str, world: dict[str, Path], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where its path leads through a folder that does not exist, which a writer would make."""
    command, make = REFUSALS[name]
    out = tmp_path / "out"
    make(out)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    named = f"{tmp_path}/{way}"
    words = [word.format(out=named, other=tmp_path / "other.arrow", **world) for word in command.split()]
    assert "out" in refused(words, capsys, monkeypatch)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("command", ["convert {ply} {out} --overwrite", "color {ply} -o {out}", "clean {ply} -o {out}"])
def test_what_is_read_is_not_replaced_by_another_way_to_it(
    command: str, world: dict[str, Path], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = world["ply"].read_bytes()
    out = f"{world['ply'].parent}/missing/../rooms.ply"
    refused([word.format(out=out, **world) for word in command.split()], capsys, monkeypatch)
    assert world["ply"].read_bytes() == before
    assert not (world["ply"].parent / "missing").exists()


@pytest.mark.parametrize("name", INPUTS)
def test_a_wrong_input_is_refused_before_the_work(
    name: str, world: dict[str, Path], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    command, message = INPUTS[name]
    words = [word.format(out=tmp_path / "out", **world) for word in command.split()]
    assert message in refused(words, capsys, monkeypatch)
    assert list(tmp_path.iterdir()) == []


def test_results_of_another_scene_stay(world: dict[str, Path], tmp_path: Path, capsys: Capture) -> None:
    other = tmp_path / "other.ply"
    save_scene(two_rooms(1100, sh_degree=1).gaussians, other)
    before = world["pvs"].read_bytes()
    assert main(["pvs", str(other), "-o", str(world["pvs"]), "--workers", "1"]) == 2
    assert "of the scene with the hash" in capsys.readouterr().err
    assert world["pvs"].read_bytes() == before
    assert main(["unpack", str(world["package"]), "-o", str(tmp_path / "out")]) == 0
    assert main(["unpack", str(world["package"]), "-o", str(tmp_path / "out")]) == 0  # its own
    for mine in ("high.ply", "low.ply", "level0.ply", "scene.ply"):
        foreign(mine)(tmp_path / "mine")
    names = [path.name for path in (tmp_path / "out").glob("*.ply")]
    foreign(*names)(tmp_path / "mine")
    kept = (tmp_path / "mine" / names[0]).read_bytes()
    capsys.readouterr()
    assert main(["unpack", str(world["package"]), "-o", str(tmp_path / "mine")]) == 2
    assert "name another" in capsys.readouterr().err
    assert (tmp_path / "mine" / names[0]).read_bytes() == kept


def test_an_earlier_report_is_replaced(world: dict[str, Path], tmp_path: Path) -> None:
    words = [
        "analyze",
        str(world["ply"]),
        "-o",
        str(tmp_path / "out"),
        "--views",
        "2",
        "--width",
        "12",
        "--height",
        "9",
    ]
    for _ in range(2):
        assert main([*words, "--traced-sample", "0"]) == 0
