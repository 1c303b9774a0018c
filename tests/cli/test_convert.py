"""`gsvis convert`: several scenes, placements, pages, and what is refused before anything is read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.cli import convert, main, parse
from gsvis.cli.arguments import Convert
from gsvis.errors import BackendError
from gsvis.export import page
from gsvis.io import convert_scene, load_scene, merge_scenes, save_scene
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.upright import Upright
from tests.cli.test_commands import refused
from tests.export.viewers import viewer_of
from tests.io.scene_files import random_scene, streamed_files, write_files

Capture = pytest.CaptureFixture[str]
FIRST, SECOND = random_scene(30, 1, 1), random_scene(20, 3, 2)
AWAY = ["--rotate", "0", "0", "90", "--scale", "2", "--translate", "-10", "0", "1e1"]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The tests run in a folder with a.ply, b.ply and streamed/, of LODs 0 and 1."""
    monkeypatch.chdir(tmp_path)
    save_scene(FIRST, "a.ply")
    save_scene(SECOND, "b.ply")
    write_files(tmp_path / "streamed", streamed_files({0: random_scene(40, 0), 1: random_scene(12, 0)}))
    return tmp_path


@pytest.fixture
def nothing_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("read")

    monkeypatch.setattr(convert, "load_source", fail)


def same(got: Gaussians, expected: Gaussians) -> None:
    assert got.sh_degree == expected.sh_degree
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_allclose(getattr(got, name), getattr(expected, name), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    "words",
    [
        ["a.ply", "b.ply", "-o", "c.ply", *AWAY],
        ["-o", "c.ply", *AWAY, "a.ply", "b.ply"],
        ["a.ply", "--out=c.ply", *AWAY, "b.ply"],
        [*AWAY[:4], "a.ply", "-o", "c.ply", *AWAY[4:], "b.ply"],
        [
            "--scale=2",
            "-o",
            "c.ply",
            "--rotate",
            "0",
            "0",
            "90",
            "--translate",
            "-10",
            "0",
            "10",
            "--",
            "a.ply",
            "b.ply",
        ],
    ],
)
def test_several_scenes_become_one_wherever_options_stand(words: list[str]) -> None:
    assert main(["convert", *words]) == 0
    merged = merge_scenes([FIRST, SECOND])
    same(load_scene("c.ply"), convert_scene(merged, rotate=(0, 0, 90), scale=2, translate=(-10, 0, 10)))


@pytest.mark.parametrize("words", [["a.ply", "c.ply"], ["a.ply", "--overwrite", "c.ply"], ["a.ply", "-o", "c.ply"]])
def test_one_scene_may_name_its_file_in_either_way(words: list[str]) -> None:
    assert main(["convert", *words]) == 0
    same(load_scene("c.ply"), FIRST)


def test_names_that_begin_with_a_minus_stand_behind_two(here: Path) -> None:
    (here / "a.ply").rename(here / "-a.ply")
    command = parse(["convert", "--scale", "2", "--", "-a.ply", "c.ply"])
    assert isinstance(command, Convert)
    assert (command.paths, command.placement.scale) == (("-a.ply", "c.ply"), 2.0)


def test_crop_and_thinning_come_before_the_placement_of_the_whole() -> None:
    box = [-1.0, -1, -1, 2, 2, 2]
    words = [
        "convert",
        "a.ply",
        "b.ply",
        "-o",
        "c.ply",
        "--translate",
        "50",
        "0",
        "0",
        "--change-up",
        "-y:+z",
        "--crop",
    ]
    assert main([*words, *map(str, box), "--min-opacity", "0.3", "--sh-degree", "2"]) == 0
    merged = merge_scenes([FIRST, SECOND])
    crop = (box[:3], box[3:])
    same(
        load_scene("c.ply"),
        convert_scene(merged, crop=crop, min_opacity=0.3, max_sh_degree=2, up=("-y", "+z"), translate=(50, 0, 0)),
    )


@pytest.mark.parametrize(("lod", "counts"), [(None, [40, 30, 40]), ("1", [12, 30, 12]), ("1,0", [12, 30, 40])])
def test_streamed_scenes_have_one_lod_or_each_its_own(lod: str | None, counts: list[int], capsys: Capture) -> None:
    words = ["convert", "streamed", "a.ply", "streamed/lod-meta.json", "-o", "c.ply", "--json"]
    assert main(words + (["--lod", lod] if lod else [])) == 0
    document = json.loads(capsys.readouterr().out)
    assert [each["gaussians"] for each in document["inputs"]] == counts
    assert [each["lod"] for each in document["inputs"]] == [int(lod[0]) if lod else 0, None, int(lod[-1]) if lod else 0]
    assert (document["in"], document["lod"], document["gaussians_out"]) == (None, None, sum(counts))
    assert len(load_scene("c.ply")) == sum(counts)


def test_the_document_names_what_was_done(capsys: Capture) -> None:
    assert main(["convert", "a.ply", "c.ksplat", "--json", *AWAY]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["in"], document["out"], document["sh_degree_out"]) == ("a.ply", "c.ksplat", 1)
    assert document["placement"] == {"up": None, "scale": 2.0, "rotate": [0, 0, 90], "translate": [-10, 0, 10]}
    assert document["bytes"] == Path("c.ksplat").stat().st_size


def test_a_ksplat_says_in_one_line_that_degree_3_is_reduced(capsys: Capture) -> None:
    assert main(["convert", "b.ply", "c.ksplat", "--ksplat-compression", "0"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("c.ksplat: 20 Gaussians, SH degree 2")
    assert err == "gsvis: c.ksplat: SH degree 3 is reduced to 2, the highest of .ksplat\n"
    np.testing.assert_array_equal(load_scene("c.ksplat").shN, SECOND.shN[:, :8])
    for words in (["a.ply"], ["b.ply", "--sh-degree", "2"]):
        assert main(["convert", *words, "-o", "c.ksplat", "--overwrite"]) == 0
        assert capsys.readouterr().err == ""


@pytest.mark.parametrize("compression", ["0", "1", "2"])
def test_the_compression_of_a_ksplat_is_that_which_is_asked(compression: str) -> None:
    assert main(["convert", "a.ply", "c.ksplat", "--ksplat-compression", compression]) == 0
    assert Path("c.ksplat").read_bytes()[20] == int(compression)


def test_a_page_holds_the_converted_scene_upright(monkeypatch: pytest.MonkeyPatch, here: Path, capsys: Capture) -> None:
    monkeypatch.setattr(page, "VIEWER", viewer_of(here / "viewer"))
    found: dict[str, Any] = {}

    def record(path: Path, scene: Gaussians, options: Any, *, progress: object) -> None:
        found.update(scene=scene, up=options.up, name=options.name)
        path.write_text("page")

    monkeypatch.setattr("gsvis.export.write_html", record)
    monkeypatch.setattr("gsvis.export.start.find_starts", lambda source, up: None)
    words = ["convert", "a.ply", "b.ply", "-o", "c.html", "--change-up", "-y:+z", "--rotate", "90", "0", "0"]
    assert main([*words, "--min-opacity", "0.5"]) == 0
    merged = merge_scenes([FIRST, SECOND])
    same(found["scene"], convert_scene(merged, min_opacity=0.5, up=("-y", "+z"), rotate=(90, 0, 0)))
    assert (found["name"], found["up"]) == ("a + b", (0.0, -1.0, 0.0))
    assert capsys.readouterr().out.startswith("c.html: ")
    assert main(["convert", "builtin:two_rooms", "d.html", "--rotate", "0", "90", "0", "--sh-degree", "0"]) == 0
    assert found["up"] == (1.0, 0.0, 0.0)  # the rooms have a known up axis, +z
    plus_y = Upright(np.array([0.0, 1.0, 0.0]), 1.0, "")
    monkeypatch.setattr("gsvis.scene.source.find_up", lambda g, **more: plus_y if len(g) > 30_000 else None)
    assert main(["convert", "builtin:two_rooms", "a.ply", "-o", "e.html", "--rotate", "0", "0", "90"]) == 0
    assert found["up"] == (-1.0, 0.0, 0.0)  # guessed of all together


def test_a_page_is_the_one_of_export(monkeypatch: pytest.MonkeyPatch, here: Path) -> None:
    monkeypatch.setattr(page, "VIEWER", viewer_of(here / "viewer"))
    assert main(["convert", "a.ply", "c.html"]) == 0
    assert main(["export", "a.ply", "-o", "d.html", "--format", "html"]) == 0
    assert Path("c.html").read_bytes() == Path("d.html").read_bytes()


@pytest.mark.usefixtures("nothing_is_read")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "OUT: expected a file to write, got nothing"),
        (["a.ply"], "OUT: expected a file to write, got only a.ply"),
        (["-o", "c.ply"], "IN: expected a scene to read, got none"),
        (["a.ply", "b.ply", "c.ply"], "OUT: expected -o OUT with several scenes, got 3 paths"),
        (["a.ply", "none.ply", "-o", "c.ply"], "none.ply: no such file or folder"),
        (["a.ply", "note.txt", "-o", "c.ply"], "note.txt: expected a scene"),
        (["a.ply", "folder", "-o", "c.ply"], "folder: expected a scene"),
        (["a.ply", "builtin:nowhere", "-o", "c.ply"], "SCENE: expected one of builtin:"),
        (["a.ply", "b.ply", "-o", "b.ply", "--overwrite"], "OUT: expected another file than IN 2"),
        (["a.ply", "b.ply", "-o", "./a.ply", "--overwrite"], "OUT: expected another file than IN 1"),
        (["b.ply", "-o", "b.ply", "--overwrite"], "OUT: expected another file than IN, got b.ply"),
        (["a.ply", "b.ply"], "b.ply: expected a new file, got one that exists; name another, or say --overwrite"),
        (["a.ply", "-o", "b.ply"], "b.ply: expected a new file"),
        (
            ["a.ply", "-o", "c.splat"],
            "OUT: expected a name that ends in .ply, .spz, .sog, .ksplat, .compressed.ply",
        ),
        (["a.ply", "-o", "c.ply", "--translate", "1", "2", "3", "4"], "IN: expected a scene, got 4; --translate"),
        (["a.ply", "c.ply", "--scale", "2", "3"], "IN: expected a scene, got 3; --translate"),
        (["a.ply", "c.ply", "--lod", "1"], "--lod: expected none for a scene with one level of detail, got 1"),
        (["a.ply", "streamed", "-o", "c.ply", "--lod", "1,0"], "--lod: expected one number, or one for each streamed"),
        (["a.ply", "c.html", "--compact"], "--compact: expected an OUT that ends in .spz"),
        (["a.ply", "c.ply", "--ksplat-compression", "1"], "--ksplat-compression: expected an OUT that ends in .ksplat"),
        (["a.ply", "c.ply", "--change-up", "y"], "--change-up: expected FROM:TO"),
    ],
)
def test_bad_input_is_refused_in_one_line_before_any_scene_is_read(
    words: list[str], message: str, here: Path, capsys: Capture
) -> None:
    (here / "note.txt").write_text("no scene")
    (here / "folder").mkdir()
    before = {path.name: path.stat().st_size for path in here.iterdir()}
    assert message in refused(capsys, "convert", *words)
    assert {path.name: path.stat().st_size for path in here.iterdir()} == before


@pytest.mark.usefixtures("nothing_is_read")
def test_a_page_without_a_viewer_is_refused_before_the_work(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def missing() -> None:
        raise BackendError("the viewer is not built")

    monkeypatch.setattr(page, "check_viewer", missing)
    assert "the viewer is not built" in refused(capsys, "convert", "a.ply", "c.html")


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "two"])
def test_a_scale_that_is_none_is_refused(value: str, capsys: Capture) -> None:
    assert main(["convert", "a.ply", "c.ply", "--scale", value]) == 2
    assert "expected a factor above 0" in capsys.readouterr().err
    assert not Path("c.ply").exists()


@pytest.mark.parametrize(
    "words", [["--rotate", "1", "2"], ["--translate", "1", "2", "x"], ["--rotate", "1", "nan", "3"]]
)
def test_three_numbers_are_three_finite_numbers(words: list[str], capsys: Capture) -> None:
    assert main(["convert", "a.ply", "c.ply", *words]) == 2
    assert words[0] in capsys.readouterr().err


def test_a_merge_that_leaves_nothing_writes_nothing(capsys: Capture) -> None:
    far = ["90", "90", "90", "91", "91", "91"]
    assert "none of 50 Gaussians" in refused(capsys, "convert", "a.ply", "b.ply", "-o", "c.ply", "--crop", *far)
    assert not Path("c.ply").exists()


@pytest.mark.parametrize("trainer", ["gsplat", "nerfstudio"])
def test_a_checkpoint_of_a_trainer_is_converted(trainer: str) -> None:
    pytest.importorskip("torch")
    from tests.io import test_checkpoint as files

    raw = files.splats()
    if trainer == "gsplat":
        name = files.gsplat_file(Path("ckpt_6999_rank0.pt"), raw).name
    else:
        name = files.nerfstudio_file(Path("step-000029999.ckpt"), files.nerfstudio_state(raw)).name
    assert main(["convert", name, "c.ply", "--translate", "1", "0", "0"]) == 0
    got = load_scene("c.ply")
    np.testing.assert_allclose(got.means, np.add(raw["means"].detach().numpy(), (1, 0, 0)), atol=1e-6)
    assert got.sh_degree == 2


def test_memory_that_does_not_suffice_is_one_line_but_a_ply_needs_little(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], nothing_is_read: None
) -> None:
    assert main(["convert", "a.ply", "c.spz", "--max-memory", "1MB"]) != 0
    assert "--max-memory: expected at least" in capsys.readouterr().err
    assert main(["convert", "a.ply", "b.ply", "-o", "c.ply", "--max-memory", "1MB", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["gaussians_out"] == len(load_scene("c.ply")) == 50
