"""The up axis: no command guesses what a scene states."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.cli.options import Where
from gsvis.cli.source import inspect_scene_of
from gsvis.cli.where import find_place
from gsvis.export.start import Start
from gsvis.io.gltf_splats_writer import save_glb
from gsvis.io.levels import save_levels
from gsvis.io.ply import save_ply
from gsvis.io.sources import load_source
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import box_in_room, random_scene
from gsvis.scene.source import Source
from gsvis.scene.upright import Upright, find_up

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room as glTF under two names, as levels that state an axis, and as PLY; the room's own up axis is +z."""
    folder = tmp_path_factory.mktemp("up")
    g = box_in_room(1000, sh_degree=0).gaussians
    save_glb(g, folder / "a.glb")
    save_glb(g, folder / "no_suffix")
    save_ply(g, folder / "a.ply")
    save_levels(Levels.single(g), folder / "stated", {"up": [0.0, -1.0, 0.0]})
    save_levels(Levels.single(g), folder / "silent", {"up": "-y"})
    return folder


@pytest.fixture
def no_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    def guess(g: object, **more: object) -> None:
        raise AssertionError("the up axis was guessed")

    for name in ("scene.source.find_up", "cli.render.find_up", "scene.place.find_up"):
        monkeypatch.setattr(f"gsvis.{name}", guess)
    for module in ("_looking", "inspection", "stated"):
        monkeypatch.setattr(f"gsvis.scene.{module}.find_up", guess)


@pytest.mark.usefixtures("no_guess")
@pytest.mark.parametrize(
    ("name", "up", "spelled"),
    [("a.glb", (0, 1, 0), "+y"), ("no_suffix", (0, 1, 0), "+y"), ("stated", (0, -1, 0), "-y")],
)
def test_what_is_stated_is_not_guessed(folder: Path, name: str, up: tuple[float, ...], spelled: str) -> None:
    source = load_source(str(folder / name), None)
    assert source.up.tolist() == list(up)
    assert inspect_scene_of(source)["up"] == spelled
    wheres = [Where(), Where(around=()), Where(box=(1.0, 1.0, 1.0, 2.0, 2.0, 2.0))]
    for space in (source.navigable()[0], *(find_place(source, where).space for where in wheres)):
        assert space is not None
        assert space.up.tolist() == list(up)


@pytest.mark.usefixtures("no_guess")
def test_space_at_a_resolution_does_not_guess(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "a.voxel.json"
    assert main(["space", str(folder / "a.glb"), "-o", str(out), "--resolution", "32", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["solid_voxels"] > 0


@pytest.mark.usefixtures("no_guess")
def test_merged_gltf_keeps_its_axis(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    axes = []

    def find_starts(source: object, up: tuple[float, ...]) -> tuple[Start, ...] | None:
        axes.append(tuple(up))
        return None

    monkeypatch.setattr("gsvis.export.start.find_starts", find_starts)
    files = [str(folder / "a.glb"), str(folder / "no_suffix")]
    assert main(["convert", *files, "-o", str(tmp_path / "both.html")]) == 0
    assert axes == [(0.0, 1.0, 0.0)]


def test_the_rest_is_guessed(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.ply", "silent"):
        source = load_source(str(folder / name), None)
        assert source.known_up is None
        assert np.allclose(source.up, [0.0, 0.0, 1.0], atol=1e-3)
    axes: list[tuple[float, ...]] = []
    monkeypatch.setattr("gsvis.export.start.find_starts", lambda source, up: axes.append(tuple(up)))
    minus_x = Upright(np.array([-1.0, 0.0, 0.0]), 1.0, "")
    monkeypatch.setattr("gsvis.scene.source.find_up", lambda g, **more: minus_x)
    assert main(["convert", str(folder / "a.glb"), str(folder / "a.ply"), "-o", str(tmp_path / "mixed.html")]) == 0
    assert axes == [(-1.0, 0.0, 0.0)]


def test_a_scene_that_tells_little_is_not_turned_by_an_oblique_angle() -> None:
    g = random_scene(np.random.default_rng(0), 100)
    assert find_up(g, check=False).confidence < 0.5
    assert sorted(np.abs(Source("blob", g).steady_up).tolist()) == [0.0, 0.0, 1.0]
