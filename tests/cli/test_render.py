"""`gsvis render` in this process: what it draws, writes, lists and refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image

from gsvis.cli import main, parse
from gsvis.cli.arguments import Render
from gsvis.io import load_scene, save_scene
from gsvis.render import rasterize
from gsvis.report.frames import target_of
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import builtin_scene, two_rooms

Capture = pytest.CaptureFixture[str]
TINY = ["--width", "24", "--height", "18"]
EYE = ["--eye", "2", "2", "1.5", "--target", "4", "2.5", "1.2", "--up", "+z"]


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    save_scene(two_rooms(1000, sh_degree=1).gaussians, tmp_path / "rooms.ply")
    return tmp_path / "rooms.ply"


def camera_of(*, width: int = 24, height: int = 18, fov: float = 60.0) -> Cameras:
    """The camera of EYE."""
    return Cameras.look_at([[2.0, 2.0, 1.5]], (4.0, 2.5, 1.2), width=width, height=height, fov=fov)


def pixels(path: Path) -> NDArray[np.uint8]:
    with Image.open(path) as image:
        assert image.mode == "RGB"
        return np.array(image)


def done(capsys: Capture, *words: object) -> str:
    """What a command that succeeds prints."""
    assert main(["render", *map(str, words)]) == 0
    return capsys.readouterr().out


def documented(capsys: Capture, *words: object) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(done(capsys, *words, "--json"))
    assert (document["format"], document["version"]) == ("gsvis-rendering", 1)
    return document


def refused(capsys: Capture, *words: object) -> str:
    """The one line on stderr of a refusal; nothing on stdout."""
    assert main(["render", *map(str, words)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert err.startswith("gsvis: error: ")
    return err


@pytest.mark.parametrize("backend", ["auto", "cpu", "reference"])
def test_the_png_is_the_image_of_rasterize(backend: str, ply: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "new" / "image.png"
    extra = ["--background", "1", "0.5", "0", "--sh-degree", "0", "--antialiased", "--fov", "75"]
    extra += ["--reference"] if backend == "reference" else ["--device", backend]
    output = done(capsys, ply, "-o", out, *TINY, *EYE, *extra)
    seen = rasterize(
        load_scene(ply), camera_of(fov=75.0), backend="cpu", background=(1, 0.5, 0), sh_degree=0, antialiased=True
    )
    assert np.abs(pixels(out) / 255.0 - seen.images[0].clip(0, 1)).max() <= 1.0 / 255.0
    assert "24 x 18, " in " ".join(output.split())
    assert [path.name for path in out.parent.iterdir()] == ["image.png"]


def test_up_is_up(tmp_path: Path, capsys: Capture) -> None:
    red_over_blue = Gaussians(
        [[0, 0, 1], [0, 0, -1]], [[1, 0, 0, 0]] * 2, [[0.3] * 3] * 2, [0.9] * 2, [[[1.5, -2, -2]], [[-2, -2, 1.5]]]
    )
    save_scene(red_over_blue, tmp_path / "two.ply")
    for up, (top, bottom) in {"+z": (0, 2), "-z": (2, 0)}.items():
        done(capsys, tmp_path / "two.ply", "-o", tmp_path / "a.png", *TINY, "--eye", "-4", "0", "0", "--up", up)
        image = pixels(tmp_path / "a.png").astype(int)
        assert image[:9, :, top].sum() > 10 * image[:9, :, bottom].sum()
        assert image[9:, :, bottom].sum() > 10 * image[9:, :, top].sum()


def test_an_orbit_is_a_numbered_sequence_of_distinct_pictures(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    document = documented(capsys, ply, "-o", f"{tmp_path}/frames/", "--orbit", 5, *TINY, "--up", "+z")
    files = sorted((tmp_path / "frames").iterdir())
    assert [path.name for path in files] == [f"{i:04d}.png" for i in range(5)]
    assert document["files"] == [str(path) for path in files]
    images = [pixels(path) for path in files]
    assert all(image.max() > 50 for image in images)
    assert all((a != b).any() for i, a in enumerate(images) for b in images[:i])
    eyes = np.array([camera["eye"] for camera in document["cameras"]])
    low, high = load_scene(ply).bounds(0.9)
    away = eyes - 0.5 * (low + high)
    assert np.ptp(np.linalg.norm(away, axis=1)) < 1e-6
    assert np.allclose(np.degrees(np.arcsin(away[:, 2] / np.linalg.norm(away, axis=1))), 20.0)
    assert np.linalg.norm(away[0]) > 0.5 * np.linalg.norm(high - low)


def test_an_orbit_goes_where_its_options_say(ply: Path, capsys: Capture, tmp_path: Path) -> None:
    words = ["--orbit", 3, "--target", 1, 2, 3, "--radius", 2, "--elevation", -30, "--up", "-y"]
    document = documented(capsys, ply, "-o", tmp_path / "o.gif", *words, *TINY)
    away = np.array([camera["eye"] for camera in document["cameras"]]) - [1, 2, 3]
    assert np.allclose(np.linalg.norm(away, axis=1), 2.0)
    assert np.allclose(away[:, 1], 1.0)  # half the radius below, and -y is up


def test_a_gif_has_all_frames_and_their_time(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    words = [ply, "--orbit", 4, *TINY, "--up", "+z"]
    output = done(capsys, *words, "-o", tmp_path / "orbit.gif", "--fps", 10)
    done(capsys, *words, "-o", tmp_path / "frames")
    assert "4 frames" in " ".join(output.split())
    with Image.open(tmp_path / "orbit.gif") as animation:
        assert animation.n_frames == 4
        assert animation.info["loop"] == 0
        for i in range(4):
            animation.seek(i)
            assert animation.info["duration"] == 100
            away = np.array(animation.convert("RGB")).astype(int) - pixels(tmp_path / "frames" / f"{i:04d}.png")
            assert np.abs(away).mean() < 6.0  # of 255; 256 colors a frame


def test_depth_can_be_read_back_from_the_colors(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    words = [*TINY, "--eye", "-9", "2", "9", "--target", "4", "2", "1", "--up", "+z"]
    document = documented(capsys, ply, "-o", tmp_path / "a.png", *words, "--depth")
    camera = Cameras.look_at([[-9.0, 2.0, 9.0]], (4.0, 2.0, 1.0), width=24, height=18)
    seen = rasterize(load_scene(ply), camera, backend="cpu")
    depth, empty = seen.depths[0], seen.alphas[0] < 1.0 / 255.0
    image = pixels(tmp_path / "a_depth.png").astype(int)
    assert empty.any()
    assert np.array_equal((image == 0).all(axis=2), empty)
    colors = np.rint(colormaps["viridis"](np.arange(256))[:, :3] * 255.0)
    level = np.abs(image[:, :, None] - colors).sum(axis=3).argmin(axis=2)
    near, far = document["depth"]["near"], document["depth"]["far"]
    assert depth[~empty].min() <= near < far <= depth[~empty].max()
    read = near + level / 255.0 * (far - near)
    assert np.abs(read - depth.clip(near, far))[~empty].max() <= 0.02 * (far - near)  # neighboring colors may coincide
    with Image.open(tmp_path / "a_depth.png") as picture:
        assert float(picture.text["gsvis:near"]) == pytest.approx(near)
        assert float(picture.text["gsvis:far"]) == pytest.approx(far)
    output = done(capsys, ply, "-o", tmp_path / "a.png", *words, "--depth")
    assert f"violet {near:.4g} to yellow {far:.4g}" in " ".join(output.split())


@pytest.mark.parametrize("out", ["frames", "orbit.gif"])
def test_all_frames_of_a_depth_sequence_share_their_colors(
    out: str, ply: Path, tmp_path: Path, capsys: Capture
) -> None:
    document = documented(capsys, ply, "-o", tmp_path / out, "--orbit", 3, *TINY, "--depth", "--up", "+z")
    near, far = document["depth"]["near"], document["depth"]["far"]
    for path in document["depth"]["files"]:
        with Image.open(path) as picture:
            info = picture.info
            assert getattr(picture, "n_frames", 1) == (3 if out == "orbit.gif" else 1)
        text = info.get("Description") or info["comment"].decode()
        assert f"near={near:.9g} to far={far:.9g}" in text


def test_nothing_in_sight_is_the_background_and_has_no_depth(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    away = ["--eye", "-50", "0", "0", "--target", "-60", "0", "0", "--up", "+z"]
    words = ["-o", tmp_path / "a.png", *TINY, *away, "--background", "0", "0", "1", "--depth"]
    document = documented(capsys, ply, *words, "--contributors", "3,4")
    assert (pixels(tmp_path / "a.png") == [0, 0, 255]).all()
    assert not pixels(tmp_path / "a_depth.png").any()
    assert (document["depth"]["near"], document["depth"]["far"]) == (None, None)
    assert document["contributors"]["weights"] == []
    output = done(capsys, ply, *words, "--contributors", "3,4")
    assert "nothing is seen" in output
    assert "No Gaussian contributes to pixel 3,4." in output


def test_the_weights_of_the_contributors_sum_to_alpha(ply: Path, capsys: Capture) -> None:
    seen = rasterize(load_scene(ply), camera_of(), backend="cpu")
    for x, y in ((0, 0), (12, 9), (23, 17), (20, 3)):
        document = documented(capsys, ply, *TINY, *EYE, "--contributors", f"{x},{y}")
        assert document["files"] == []
        found = document["contributors"]
        assert found["pixel"] == [x, y]
        assert sum(found["weights"]) == pytest.approx(found["sum_of_weights"], abs=1e-6)
        assert found["sum_of_weights"] == pytest.approx(float(seen.alphas[0, y, x]), abs=2e-4)
        assert found["depths"] == sorted(found["depths"])
        light = np.cumprod([1.0, *(1.0 - np.array(found["alphas"]))])
        assert np.allclose(found["weights"], found["alphas"] * light[:-1], atol=1e-5)


def test_a_long_list_of_contributors_shows_the_weightiest(tmp_path: Path, capsys: Capture) -> None:
    n = 60
    means = np.column_stack([np.linspace(0.0, 1.0, n), np.zeros(n), np.zeros(n)])
    opacities = np.where(np.arange(n) == n - 1, 0.9, 0.02)
    row = Gaussians(means, [[1, 0, 0, 0]] * n, np.full((n, 3), 0.3), opacities, np.zeros((n, 1, 3)))
    save_scene(row, tmp_path / "row.ply")
    output = done(capsys, tmp_path / "row.ply", *TINY, "--eye", "-3", "0", "0", "--contributors", "12,9")
    rows = [[float(word) for word in line.split()] for line in output.splitlines() if re.match(r"^ +\d+ +\d+ ", line)]
    assert len(rows) == 40
    ranks, ids, _, weights, depths = zip(*rows, strict=True)
    assert (ranks[-1], ids[-1]) == (n, n - 1)  # the last and weightiest is not cut off
    assert list(ranks) == sorted(ranks)
    assert list(depths) == sorted(depths)
    (rest,) = re.findall(r"other 20 weigh ([\d.]+)", " ".join(output.split()))
    (total,) = re.findall(r"all 60: ([\d.]+)", output)
    assert sum(weights) + float(rest) == pytest.approx(float(total), abs=1e-3)
    assert max(map(len, output.splitlines())) <= 80


def cameras_json(path: Path, count: int) -> Path:
    pose = [[0.0, 0.0, -1.0, 2.0], [-1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]  # looks along +x
    size = {"w": 32, "h": 16, "fl_x": 16.0, "fl_y": 16.0, "cx": 16.0, "cy": 8.0}
    frames = [{"file_path": f"{i}.png", "transform_matrix": pose} for i in range(count)]
    path.write_text(json.dumps({**size, "frames": frames}))
    return path


def test_cameras_of_a_file_keep_their_size_and_can_be_chosen(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    file = cameras_json(tmp_path / "transforms.json", 4)
    document = documented(capsys, ply, "--cameras", file, "-o", tmp_path / "all")
    assert (len(document["files"]), document["width"], document["height"]) == (4, 32, 16)
    document = documented(capsys, ply, "--cameras", file, "--index", 3, 1, "-o", tmp_path / "two", "--width", 16)
    assert [camera["name"] for camera in document["cameras"]] == ["3.png", "1.png"]
    assert pixels(tmp_path / "two" / "0001.png").shape == (8, 16, 3)
    camera = Cameras.look_at([[2.0, 2.0, 1.5]], (3.0, 2.0, 1.5), width=16, height=8, fov=90.0)
    seen = rasterize(load_scene(ply), camera, backend="cpu").images[0].clip(0, 1)
    assert np.abs(pixels(tmp_path / "two" / "0000.png") / 255.0 - seen).max() <= 1.0 / 255.0
    assert "0 to 3" in refused(capsys, ply, "--cameras", file, "--index", 4, "-o", tmp_path / "no")
    assert "one camera, got 4" in refused(capsys, ply, "--cameras", file, "--contributors", "1,1")
    assert not (tmp_path / "no").exists()


def test_a_seed_repeats_the_sampled_camera_and_its_words_give_it_again(tmp_path: Path, capsys: Capture) -> None:
    words = ["builtin:nested_shells", *TINY, "-o", tmp_path / "a.png"]
    output = done(capsys, *words, "--seed", 3)
    first = pixels(tmp_path / "a.png")
    document = documented(capsys, *words, "--seed", 3)
    assert np.array_equal(first, pixels(tmp_path / "a.png"))
    scene = builtin_scene("nested_shells")
    assert scene.navigable is not None
    assert scene.navigable.contains([document["cameras"][0]["eye"]]).all()
    (again,) = re.findall(r"Again: (.*)", output)
    done(capsys, *words, *again.split())
    assert np.abs(first.astype(int) - pixels(tmp_path / "a.png")).max() <= 3
    assert documented(capsys, *words, "--seed", 4)["cameras"] != document["cameras"]


def test_what_a_folder_holds_stays_and_later_frames_are_reported(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for name in ("notes.txt", "cover.png", "0001.png", "0002.png", "0007.png"):
        (frames / name).write_text("old")
    assert "0001.png, which something else wrote" in refused(capsys, ply, "-o", frames, "--orbit", 2, *TINY)
    assert (frames / "0001.png").read_text() == "old"
    output = done(capsys, ply, "-o", frames, "--orbit", 2, "--overwrite", *TINY)
    done(capsys, ply, "-o", frames, "--orbit", 2, *TINY)  # its own pictures are replaced
    assert "also holds 2 later frames" in " ".join(output.split())
    assert pixels(frames / "0001.png").shape == (18, 24, 3)
    for name in ("notes.txt", "cover.png", "0002.png", "0007.png"):
        assert (frames / name).read_text() == "old"


@pytest.mark.parametrize("out", ["frames", "orbit.gif"])
def test_an_interrupt_leaves_what_was_there(
    out: str, ply: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["render", str(ply), "-o", str(tmp_path / out), "--orbit", "3", *TINY, "--depth"]
    assert main(words) == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    calls = []

    def interrupted(*arguments: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) > 2:  # the first prepares kernels, the second is a frame
            raise KeyboardInterrupt
        return rasterize(*arguments, **options)

    monkeypatch.setattr("gsvis.render.device_scene.rasterize", interrupted)
    assert main([*words, "--background", "1", "1", "1", "--device", "cpu"]) == 130
    assert capsys.readouterr().err == "gsvis: interrupted; nothing was left half-written\n"
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_frames_beyond_four_digits_still_sort(tmp_path: Path) -> None:
    names = [path.name for path in target_of(str(tmp_path), 10001).files]
    assert (names[0], names[-1]) == ("00000.png", "10000.png")
    assert names == sorted(names)


def test_a_link_of_a_page_gives_the_view_of_the_page(ply: Path, tmp_path: Path, capsys: Capture) -> None:
    link = "http://host/view/x#eye=2,2,1.5&to=4,2.5,1.2&fov=50&up=0,0,1&mode=walk"
    (camera,) = json.loads(done(capsys, ply, "-o", tmp_path / "a.png", *TINY, "--view", link, "--json"))["cameras"]
    across = 2 * np.degrees(np.arctan(np.tan(np.radians(25)) * 24 / 18))
    same = ["--eye", "2", "2", "1.5", "--target", "4", "2.5", "1.2", "--up", "+z", "--fov", f"{across:.12f}"]
    done(capsys, ply, "-o", tmp_path / "b.png", *TINY, *same)
    assert camera["eye"] == pytest.approx([2, 2, 1.5])
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert "two places" in refused(capsys, ply, "-o", tmp_path / "c.png", "--view", "#eye=1,2")
    assert "--view" in refused(capsys, ply, "-o", tmp_path / "c.png", "--view", link, "--fov", "50")


def test_defaults_are_those_the_help_states() -> None:
    assert parse(["render", "x", "-o", "d"]) == Render("x", "d")
    command = parse(["render", "x", "--index", "3", "5", "--up", "-y", "--eye", "-1", "-.5", "2", "-o", "y"])
    assert isinstance(command, Render)
    assert (command.cast.index, command.cast.eye, command.out) == ((3, 5), (-1.0, -0.5, 2.0), "y")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "-o"),
        (["--contributors", "1,1", "--depth"], "-o"),
        (["-o", "a.jpg"], "OUT"),
        (["-o", "a.png", "--orbit", "2"], "for 2 cameras"),
        (["-o", "a/", "--orbit", "2", "--eye", "1", "2", "3"], "--eye: expected none with --orbit"),
        (["-o", "a/", "--cameras", "c", "--orbit", "2"], "--orbit: expected none with --cameras"),
        (["-o", "a.png", "--cameras", "none.json"], "none.json"),
        (["-o", "a.png", "--cameras", "c", "--fov", "50"], "--fov"),
        (["-o", "a.png", "--cameras", "c", "--up", "+z"], "--up"),
        (["-o", "a.png", "--up", "north"], "--up"),
        (["-o", "a.png", "--index", "1"], "--index"),
        (["-o", "a.png", "--radius", "1"], "--radius"),
        (["-o", "a.png", "--elevation", "1", "--eye", "1", "2", "3"], "--elevation"),
        (["-o", "a.png", "--target", "1", "2", "3"], "--target"),
        (["-o", "a.png", "--eye", "1", "2", "3", "--target", "1", "2", "3"], "a point that is not --eye, got 1 2 3"),
        (["-o", "a.png", "--fps", "10"], "--fps"),
        (["-o", "a/", "--orbit", "2", "--contributors", "1,1"], "one camera, got 2"),
        (["-o", "a.png", "--contributors", "24,1", *TINY], "24 x 18"),
        (["-o", "rooms.ply/a.png"], "rooms.ply"),
        (["-o", "rooms.ply/a/"], "rooms.ply"),
        (["-o", "a.png", "--reference", "--device", "cuda"], "--reference: expected the CPU, got --device cuda"),
    ],
)
def test_arguments_that_cannot_be_are_refused_in_one_line(
    words: list[str], message: str, ply: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ply.parent)
    assert message in refused(capsys, ply, *words)
    assert [path.name for path in ply.parent.iterdir()] == ["rooms.ply"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--contributors", "12"], "column and a row"),
        (["--index"], "whole numbers"),
        (["--index", "-1"], "index"),
        (["--eye", "1", "2", "nan"], "finite"),
        (["--background", "1", "2", "0"], "[0, 1]"),
        (["--radius", "0"], "above 0"),
        (["--elevation", "90"], "[-89, 89]"),
        (["--fps", "100"], "frames a second"),
        (["--device", "gpu"], "device"),
        (["--orbit", "0"], "at least 1"),
    ],
)
def test_values_out_of_range_exit_with_2_and_say_which(words: list[str], message: str, capsys: Capture) -> None:
    assert main(["render", "x", "-o", "y", *words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert "Traceback" not in err


def test_a_backend_that_cannot_run_says_why(ply: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.render.device.why_no_cuda", lambda: "device 'cuda': expected a GPU; use another")
    assert "expected a GPU" in refused(capsys, ply, "-o", ply.parent / "a.png", "--device", "cuda")


def test_scenes_with_nothing_to_see_or_nowhere_to_stand(
    ply: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: Gaussians.empty())
    assert "no Gaussian" in refused(capsys, ply, "-o", ply.parent / "a.png")
    faint = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.001], np.zeros((1, 1, 3)))
    monkeypatch.setattr("gsvis.io.scenes.load_scene", lambda path, lod=None: faint)
    assert "--eye" in refused(capsys, ply, "-o", ply.parent / "a.png")
    assert [path.name for path in ply.parent.iterdir()] == ["rooms.ply"]


@pytest.mark.realdata
def test_a_real_scene_is_shown_upright(realdata: Path, tmp_path: Path, capsys: Capture) -> None:
    scene = realdata / "scenes" / "flowers_sh2" / "lod-meta.json"
    document = documented(capsys, scene, "--lod", 3, "-o", tmp_path / "a.gif", "--orbit", 2, *TINY)
    assert (document["gaussians"], document["lod"]) == (26895, 3)
    up_in_camera = np.array(document["cameras"][0]["viewmat"])[:3, :3] @ [0.0, -1.0, 0.0]  # -y is up in this scene
    assert up_in_camera[1] < -0.9
    with Image.open(tmp_path / "a.gif") as animation:
        image = np.array(animation.convert("RGB")).astype(int)
    assert image[9:].sum() > 2 * image[:9].sum()  # grass below, black above
