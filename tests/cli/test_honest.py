"""`gsvis simulate` compares with the scene that a package was made from, or says in its title that it does not."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from gsvis.cli import main
from gsvis.io import load_scene, save_scene
from gsvis.io.poses import write_poses
from gsvis.io.sources import load_source
from gsvis.package import PackageInfo, in_package_order, write_package
from gsvis.package.original import about_files, about_source
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import BUILTIN_SCENES, two_rooms
from tests.package.worlds import colors_of
from tests.simulate.streets import walk

pytestmark = pytest.mark.usefixtures("blank_plots")
Capture = pytest.CaptureFixture[str]
QUICK = ["--seconds", "0.5", "--every", "0.5", "--width", "24", "--height", "16", "--mbit", "0.2", "--no-retarget"]
ITSELF = "against the package itself"


def write(package: Path, scene: str, about: dict[str, Any] | None = None) -> Path:
    """Write a package of a scene, which names it unless `about` says otherwise."""
    source = load_source(scene, None)
    levels = in_package_order(Levels.single(source.gaussians))
    named = about_source(scene, source, str(package)) if about is None else about
    write_package(package, levels, colors_of(len(levels.union))[1], info=PackageInfo(provenance=named)).close()
    return package


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a scene, its package and a walk."""
    save_scene(two_rooms(1000, sh_degree=1).gaussians, tmp_path / "rooms.ply")
    write(tmp_path / "rooms.gsvis", str(tmp_path / "rooms.ply"))
    write_poses(walk(2.0), tmp_path / "walk.csv")
    return tmp_path


def simulate(capsys: Capture, folder: Path, package: Path, *more: str) -> tuple[dict[str, Any], str, str]:
    """The document, the page and the text on the terminal."""
    words = ["simulate", str(package), "--path", str(folder / "walk.csv"), "-o", str(folder / "report"), *QUICK, *more]
    assert main(words) == 0
    text = capsys.readouterr().out
    document = json.loads((folder / "report" / "report.json").read_text(encoding="utf-8"))
    return document, (folder / "report" / "report.html").read_text(encoding="utf-8"), " ".join(text.split())


def expect_honest(found: tuple[dict[str, Any], str, str]) -> None:
    document, page, text = found
    assert "before it became a package" in document["visits"][0]["compared_with"]
    assert not document["visits"][0]["against_itself"]
    assert ITSELF not in document["title"] + page + text


def expect_itself(found: tuple[dict[str, Any], str, str], why: str) -> None:
    document, page, text = found
    assert document["visits"][0]["against_itself"]
    for title in (document["title"], page.split("<title>")[1].split("</title>")[0], page.split("<h1>")[1]):
        assert ITSELF in title
    assert ITSELF in document["visits"][0]["title"]
    assert ITSELF in text
    assert why in document["visits"][0]["remark"]
    assert why in text
    assert "--scene" in document["visits"][0]["remark"]


def test_the_scene_beside_a_package_is_found_also_when_both_moved(folder: Path, capsys: Capture) -> None:
    expect_honest(simulate(capsys, folder, folder / "rooms.gsvis"))
    moved = folder / "elsewhere"
    moved.mkdir()
    for name in ("rooms.gsvis", "rooms.ply"):
        shutil.move(folder / name, moved / name)
    expect_honest(simulate(capsys, folder, moved / "rooms.gsvis"))


def test_a_scene_that_is_gone_or_another_is_said_in_the_title(folder: Path, capsys: Capture) -> None:
    scene = folder / "rooms.ply"
    save_scene(two_rooms(1001, sh_degree=1).gaussians, scene)
    expect_itself(simulate(capsys, folder, folder / "rooms.gsvis"), "content differs")
    given = simulate(capsys, folder, folder / "rooms.gsvis", "--scene", str(scene))
    expect_honest(given)
    assert "content differs" in given[0]["visits"][0]["remark"]
    scene.unlink()
    expect_itself(simulate(capsys, folder, folder / "rooms.gsvis"), "not beside the package")


def test_a_package_that_names_no_scene_is_compared_with_itself(folder: Path, capsys: Capture) -> None:
    package = write(folder / "old.gsvis", str(folder / "rooms.ply"), {})
    expect_itself(simulate(capsys, folder, package), "older gsvis")
    expect_honest(simulate(capsys, folder, package, "--scene", str(folder / "rooms.ply")))


def test_built_in_scenes_and_folders_are_known_by_their_gaussians(
    folder: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = two_rooms(1000, sh_degree=1)
    monkeypatch.setitem(BUILTIN_SCENES, "two_rooms", lambda: made)
    package = write(folder / "built.gsvis", "builtin:two_rooms")
    expect_honest(simulate(capsys, folder, package))
    monkeypatch.setitem(BUILTIN_SCENES, "two_rooms", lambda: two_rooms(1002, sh_degree=1))
    expect_itself(simulate(capsys, folder, package), "content differs")


def test_no_folder_of_the_maker_is_in_the_manifest(folder: Path, tmp_path: Path) -> None:
    save_scene(two_rooms(1000).gaussians, tmp_path / "private" / "rooms.ply")
    package = write(tmp_path / "public" / "rooms.gsvis", str(tmp_path / "private" / "rooms.ply"))
    text = (package / "manifest.json").read_text(encoding="utf-8")
    assert "private" not in text
    assert str(tmp_path) not in text
    files = about_files([(str(tmp_path / "private" / "rooms.ply"), None)], str(tmp_path / "public" / "a.gsworld"))
    assert "private" not in json.dumps(files)


def test_the_whole_file_is_the_smallest_good_one_with_view_dependent_color(folder: Path, capsys: Capture) -> None:
    save_scene(load_scene(folder / "rooms.ply"), folder / "rooms.spz")
    package = write(folder / "packed.gsvis", str(folder / "rooms.spz"))
    document, _, _ = simulate(capsys, folder, package)
    files = document["visits"][0]["scene"]["whole_files"]
    assert {"rooms.spz", "SOG as gsvis writes it", "compact SPZ as gsvis writes it"} <= {each["name"] for each in files}
    whole = document["visits"][0]["systems"][1]["about"]
    assert whole["bytes"] == min(each["nbytes"] for each in files if each["psnr"] >= 35.0)
    assert "view-dependent color" in whole["measured"]


def test_what_a_program_wrote_is_no_recording(folder: Path, capsys: Capture) -> None:
    document, page, _ = simulate(capsys, folder, folder / "rooms.gsvis")
    assert "recorded" not in page
    assert (document["walk"], document["link"]["kind"]) == ("the path of walk.csv", "a constant link")
    (folder / "log.csv").write_text("DL_bitrate\n1000\n2000\n")
    (folder / "link.txt").write_text("0.5 1\n1.0 2\n")
    words = [word for word in QUICK if word not in ("--mbit", "0.2")]
    for name, kind in (("log.csv", "a recorded link"), ("link.txt", "the link of link.txt")):
        command = ["simulate", str(folder / "rooms.gsvis"), "--path", str(folder / "walk.csv"), *words]
        assert main([*command, "-o", str(folder / "report"), "--trace", str(folder / name)]) == 0
        capsys.readouterr()
        document = json.loads((folder / "report" / "report.json").read_text(encoding="utf-8"))
        assert document["link"]["kind"] == kind
