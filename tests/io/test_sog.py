"""SOG and streamed SOG: planes decoded within their quantization, levels of detail, and damage refused."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.io.losses import watch_losses
from gsvis.io.sog import load_sog
from gsvis.io.sog_writer import encode_sog, report_palette_loss, save_sog
from gsvis.io.streamed_sog import list_lods, load_streamed_sog
from gsvis.scene.gaussians import Gaussians
from tests.io.scene_files import plane, random_scene, sog_files, streamed_files, webp, write_files, zip_bytes


def assert_within_sog(got: Gaussians, want: Gaussians, widest: float = 1.0) -> None:
    """Within half a step of each plane; `widest` times that in codebooks, whose tails are coarse."""
    assert len(got) == len(want)
    np.testing.assert_allclose(got.means, want.means, atol=3e-4)
    np.testing.assert_allclose(np.log(got.scales), np.log(want.scales), atol=0.02 * widest)
    np.testing.assert_allclose(got.opacities, want.opacities, atol=0.02)
    np.testing.assert_allclose(got.sh0, want.sh0, atol=0.02 * widest)
    np.testing.assert_allclose(got.shN, want.shN, atol=0.01 * widest)
    assert want.shN.size == 0 or np.sqrt(np.mean(np.square(got.shN - want.shN))) <= 0.01
    assert np.abs(np.einsum("ij,ij->i", got.quats, want.quats)).min() > 1 - 1e-4


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("version", [1, 2])
def test_folder_meta_and_zip_read_alike(tmp_path: Path, version: int, degree: int) -> None:
    scene = random_scene(150, degree)
    files = sog_files(scene, version)
    folder = write_files(tmp_path / "folder", files)
    (tmp_path / "a.sog").write_bytes(zip_bytes(files))
    (tmp_path / "b.sog").write_bytes(
        zip_bytes({f"inner/{name}": data for name, data in files.items()}, zipfile.ZIP_DEFLATED)
    )
    first = load_sog(folder)
    assert_within_sog(first, scene)
    for path in (folder / "meta.json", tmp_path / "a.sog", tmp_path / "b.sog"):
        other = load_sog(path)
        np.testing.assert_array_equal(other.means, first.means)
        np.testing.assert_array_equal(other.shN, first.shN)


def test_a_codebook_that_begins_with_null_is_mended(tmp_path: Path) -> None:
    files = sog_files(random_scene(50, 0))
    meta = json.loads(files["meta.json"])
    book = meta["scales"]["codebook"]
    book[0] = None
    whole = load_sog(write_files(tmp_path, files))
    mended = load_sog(write_files(tmp_path, {"meta.json": json.dumps(meta).encode()}))
    np.testing.assert_allclose(np.log(mended.scales), np.log(whole.scales), atol=2 * (book[2] - book[1]))


def no_key(*trail: str) -> Callable[[dict[str, Any]], None]:
    def change(meta: dict[str, Any]) -> None:
        for key in trail[:-1]:
            meta = meta[key]
        del meta[trail[-1]]

    return change


def value(new: Any, *trail: Any) -> Callable[[dict[str, Any]], None]:
    def change(meta: Any) -> None:
        for key in trail[:-1]:
            meta = meta[key]
        meta[trail[-1]] = new

    return change


BAD_META = [
    *(no_key(key) for key in ("count", "means", "quats", "scales", "sh0")),
    *(no_key("shN", key) for key in ("count", "codebook", "files")),
    no_key("means", "mins"),
    *(value(v, "version") for v in (1, 3, "2", 2.5, True)),
    *(value(v, "count") for v in (0, -1, 65, 10**9, 10**400, "50", 1.5, None, [50])),
    *(value(v, "means") for v in (3, [], "means", None)),
    *(value(v, "means", "mins") for v in ([0, 0], [0, 0, "0"], [0, 0, None], [0, 0, 1e400], [True] * 3, 7)),
    value([1e299] * 3, "means", "maxs"),
    *(value(v, "means", "files") for v in ([], ["means_l.webp"], "means_l.webp", [1, 2], ["", ""])),
    *(
        value([v], "quats", "files")
        for v in (
            "../quats.webp",
            "/quats.webp",
            "a\\b.webp",
            "C:x",
            "x/../../y",
            "no.webp",
            "",
            ".",
            "x\0",
            "x" * 2000,
        )
    ),
    *(value(v, "scales", "codebook") for v in ([], [0.0] * 3, [None] * 256, ["a"] * 256, {}, [float("nan")] * 256)),
    value([1e30] * 256, "scales", "codebook"),
    *(value(v, "shN", "bands") for v in (-1, 2, 3, 4, "1")),
    *(value(v, "shN", "count") for v in (0, 7, 65537, 65536)),
    value([0.0] * 4, "shN", "codebook"),
]


@pytest.mark.parametrize("change", BAD_META)
def test_meta_data_of_wrong_types_and_ranges(tmp_path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    files = sog_files(random_scene(50, 1))
    meta = json.loads(files["meta.json"])
    change(meta)
    with pytest.raises(FormatError):
        load_sog(write_files(tmp_path, files | {"meta.json": json.dumps(meta).encode()}))


@pytest.mark.parametrize(
    "change", [no_key("means", "shape"), *(value(v, "means", "shape") for v in ([], [0], 5, ["a"]))]
)
def test_version_1_without_a_count(tmp_path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    files = sog_files(random_scene(50, 1), version=1)
    meta = json.loads(files["meta.json"])
    change(meta)
    with pytest.raises(FormatError):
        load_sog(write_files(tmp_path, files | {"meta.json": json.dumps(meta).encode()}))


@pytest.mark.parametrize(
    "data", [b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 100_000, b'{"count":' + b"9" * 9999 + b"}"]
)
def test_json_that_is_none(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(FormatError):
        load_sog(write_files(tmp_path, {"meta.json": data}))


PLANES = (
    "means_l.webp",
    "means_u.webp",
    "quats.webp",
    "scales.webp",
    "sh0.webp",
    "shN_centroids.webp",
    "shN_labels.webp",
)


@pytest.mark.parametrize("name", PLANES)
def test_a_plane_missing_small_truncated_lossy_or_moving(tmp_path: Path, name: str) -> None:
    files = sog_files(random_scene(50, 1))
    noise = np.random.default_rng(0).integers(252, 256, (8, 8, 4), np.uint8)
    bad = [
        b"",
        b"RIFF",
        files[name][: len(files[name]) // 2],
        files[name][:-9],
        webp(noise[:1, :7]),
        webp(noise, lossless=False),
        b"\x89PNG\r\n\x1a\n" + bytes(100),
    ]
    for data in bad:
        with pytest.raises(FormatError):
            load_sog(write_files(tmp_path / "folder", files | {name: data}))
    del files[name]
    (tmp_path / "a.sog").write_bytes(zip_bytes(files))
    with pytest.raises(FormatError, match=name):
        load_sog(tmp_path / "a.sog")


def test_indices_out_of_range(tmp_path: Path) -> None:
    files = sog_files(random_scene(50, 1))
    with pytest.raises(FormatError, match="252"):
        load_sog(write_files(tmp_path, files | {"quats.webp": plane(np.full((50, 4), 251))}))
    with pytest.raises(FormatError, match="palette"):
        load_sog(write_files(tmp_path, files | {"shN_labels.webp": plane(np.full((50, 2), 200))}))


def test_an_image_that_unpacks_to_gigabytes_is_refused_by_its_header(tmp_path: Path) -> None:
    files = sog_files(random_scene(50, 0))
    bits = struct.pack("<I", 16383 | 16383 << 14 | 1 << 28)
    bomb = b"RIFF" + struct.pack("<I", 40) + b"WEBPVP8L" + struct.pack("<I", 28) + b"\x2f" + bits + bytes(23)
    with pytest.raises(FormatError, match="at most"):
        load_sog(write_files(tmp_path, files | {"scales.webp": bomb}))
    big = webp(np.zeros((6000, 6000, 4), np.uint8))
    assert len(big) < 100_000
    with pytest.raises(FormatError, match="promise"):
        load_sog(write_files(tmp_path, files | {"scales.webp": big}))


def test_a_count_beyond_what_the_planes_can_hold(tmp_path: Path) -> None:
    files = sog_files(random_scene(50, 0))
    meta = json.loads(files["meta.json"]) | {"count": 60_000_000}
    with pytest.raises(FormatError, match="promise"):
        load_sog(write_files(tmp_path, files | {"meta.json": json.dumps(meta).encode()}))


@pytest.mark.parametrize("name", ["../x", "/x", "a\\b", "a/../../b", "C:\\x"])
def test_zip_entries_that_leave_the_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.sog").write_bytes(zip_bytes(sog_files(random_scene(5, 0)) | {name: b"x"}))
    with pytest.raises(FormatError, match="inside"):
        load_sog(tmp_path / "a.sog")


def test_a_zip_that_expands_absurdly(tmp_path: Path) -> None:
    files = sog_files(random_scene(50, 0))
    (tmp_path / "a.sog").write_bytes(zip_bytes(files | {"sh0.webp": bytes(200 << 20)}, zipfile.ZIP_DEFLATED))
    assert (tmp_path / "a.sog").stat().st_size < 1 << 20
    with pytest.raises(FormatError, match="promise"):
        load_sog(tmp_path / "a.sog")


@pytest.mark.parametrize("data", [b"", b"PK", b"PK\x03\x04" + bytes(50), zip_bytes({"readme.txt": b"no"})])
def test_zips_that_are_none(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.sog").write_bytes(data)
    with pytest.raises(FormatError):
        load_sog(tmp_path / "a.sog")


def test_a_zip_with_another_compression(tmp_path: Path) -> None:
    (tmp_path / "a.sog").write_bytes(zip_bytes(sog_files(random_scene(5, 0)), zipfile.ZIP_BZIP2))
    with pytest.raises(FormatError, match="stored or deflated"):
        load_sog(tmp_path / "a.sog")


# --- written


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_was_written_reads_back(tmp_path: Path, degree: int) -> None:
    scene = random_scene(700, degree)
    save_sog(scene, tmp_path / "deep" / "a.sog")
    got = load_sog(tmp_path / "deep" / "a.sog")
    assert_within_sog(got, scene, widest=12.0)
    save_sog(scene, tmp_path / "b.sog")
    assert (tmp_path / "b.sog").read_bytes() == (tmp_path / "deep" / "a.sog").read_bytes()


def test_one_gaussian_and_coincident_gaussians_are_written(tmp_path: Path) -> None:
    one = random_scene(1, 1)
    save_sog(one, tmp_path / "a.sog")
    np.testing.assert_allclose(load_sog(tmp_path / "a.sog").means, one.means, rtol=1e-6)
    same = one[np.zeros(300, int)]
    save_sog(same, tmp_path / "a.sog")
    assert_within_sog(load_sog(tmp_path / "a.sog"), same)


def test_an_empty_scene_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="1 to"):
        save_sog(Gaussians.empty(), tmp_path / "a.sog")


# --- streamed


@pytest.fixture
def levels() -> dict[int, Gaussians]:
    return {level: random_scene(40 // (level + 1), 1, seed=level) for level in range(3)}


def test_every_level_reads_whole_and_none_is_the_finest(tmp_path: Path, levels: dict[int, Gaussians]) -> None:
    write_files(tmp_path, streamed_files(levels))
    for level, scene in levels.items():
        assert_within_sog(load_streamed_sog(tmp_path, level), scene)
        assert_within_sog(load_streamed_sog(tmp_path / "lod-meta.json", level), scene)
    assert_within_sog(load_streamed_sog(tmp_path), levels[0])
    assert list_lods(tmp_path) == (0, 1, 2)


def test_absent_levels_are_named_with_those_present(tmp_path: Path, levels: dict[int, Gaussians]) -> None:
    write_files(tmp_path, streamed_files(levels, present={1, 2}))
    assert list_lods(tmp_path) == (1, 2)
    assert_within_sog(load_streamed_sog(tmp_path), levels[1])
    with pytest.raises(FormatError, match=r"files of LOD 0, got no 0_0/meta\.json; LODs present: 1, 2"):
        load_streamed_sog(tmp_path, 0)
    with pytest.raises(FormatError, match=r"LOD 7, got LODs named in the file: 0, 1, 2; LODs present: 1, 2"):
        load_streamed_sog(tmp_path, 7)
    for lod in (-1, "1", 1.0, True):
        with pytest.raises(ValueError, match="lod: expected an integer"):
            load_streamed_sog(tmp_path, lod)  # type: ignore[arg-type]
    write_files(tmp_path / "none", {"lod-meta.json": (tmp_path / "lod-meta.json").read_bytes()})
    with pytest.raises(FormatError, match="at least one LOD"):
        load_streamed_sog(tmp_path / "none")


def edited(files: dict[str, bytes], change: Callable[[dict[str, Any]], None]) -> dict[str, bytes]:
    meta = json.loads(files["lod-meta.json"])
    change(meta)
    return files | {"lod-meta.json": json.dumps(meta).encode()}


def test_an_environment_belongs_to_every_level(tmp_path: Path, levels: dict[int, Gaussians]) -> None:
    sky = random_scene(11, 0, seed=9)
    files = edited(streamed_files(levels, present={1}), value("env/meta.json", "environment"))
    write_files(tmp_path, files)
    with pytest.raises(FormatError, match=r"environment: expected the file env/meta\.json, got none; LODs present: 1"):
        load_streamed_sog(tmp_path)
    write_files(tmp_path / "env", sog_files(sky))
    got = load_streamed_sog(tmp_path)
    assert len(got) == len(levels[1]) + len(sky)
    assert_within_sog(got[: len(levels[1])], levels[1])


def test_leaves_may_use_a_part_of_a_file_and_lack_levels(tmp_path: Path, levels: dict[int, Gaussians]) -> None:
    def change(meta: dict[str, Any]) -> None:
        first, second = meta["tree"]["children"]
        first["lods"]["0"] = {"file": 0, "offset": 3, "count": 5}
        second["lods"] = {"0": {"file": 0, "offset": 30, "count": 10}}

    write_files(tmp_path, edited(streamed_files(levels), change))
    scene = load_streamed_sog(tmp_path, 0)
    assert_within_sog(scene, levels[0][np.r_[3:8, 30:40]])
    assert_within_sog(load_streamed_sog(tmp_path, 1), levels[1][: len(levels[1]) // 2])


def leaf(**change: Any) -> Callable[[dict[str, Any]], None]:
    def apply(meta: dict[str, Any]) -> None:
        meta["tree"]["children"][0]["lods"]["0"].update(change)

    return apply


@pytest.mark.parametrize(
    "change",
    [
        *(leaf(file=v) for v in (-1, 3, 10**20, "0", None, True)),
        *(leaf(offset=v) for v in (-1, 39, 10**30, "0", None, [])),
        *(leaf(count=v) for v in (-1, 41, 10**30, "1", None, {})),
        leaf(offset=25),
        *(value(v, "filenames") for v in (None, [], {}, "x", [1, 2, 3], ["0_0/meta.json"] * 3)),
        *(
            value(v, "filenames", 0)
            for v in ("../0_0/meta.json", "/etc/passwd", "0_0\\meta.json", "", None, "0_0/../../x")
        ),
        *(value(v, "environment") for v in ("../e", "/e", 5, ["e"], "e\\f", "")),
        *(value(v, "tree") for v in (None, [], 5, {}, {"children": 5}, {"children": [5]}, {"lods": 5})),
        *(value({"lods": {k: {"file": 0, "offset": 0, "count": 1}}}, "tree") for k in ("x", "-1", "", "9999", "²")),
        value({"lods": {"0": [0, 0, 1]}}, "tree"),
    ],
)
def test_trees_of_wrong_types_and_ranges(
    tmp_path: Path, levels: dict[int, Gaussians], change: Callable[[dict[str, Any]], None]
) -> None:
    write_files(tmp_path, edited(streamed_files(levels), change))
    with pytest.raises(FormatError):
        load_streamed_sog(tmp_path, 0)


def test_a_tree_of_absurd_depth(tmp_path: Path, levels: dict[int, Gaussians]) -> None:
    deep = b'{"children":[' * 50_000 + b"{}" + b"]}" * 50_000
    (tmp_path / "lod-meta.json").write_bytes(b'{"filenames":[],"tree":' + deep + b"}")
    with pytest.raises(FormatError):
        load_streamed_sog(tmp_path)
    files = streamed_files(levels)

    def nest(meta: dict[str, Any]) -> None:
        for _ in range(100):
            meta["tree"] = {"children": [meta["tree"]]}

    write_files(tmp_path, edited(files, nest))
    assert_within_sog(load_streamed_sog(tmp_path, 0), levels[0])


REAL = [
    ("showroom", 2, 1_495_636, 0),
    ("showroom", 3, 746_973, 0),
    ("nika_sh3", 0, 300_000, 3),
    ("nika_sh3", 1, 202_886, 3),
    ("nika_sh3", 2, 46_708, 3),
    ("nika_sh3", 3, 9_925, 3),
    ("flowers_sh2", 1, 210_422, 2),
    ("flowers_sh2", 2, 92_802, 2),
    ("flowers_sh2", 3, 26_895, 2),
]


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "lod", "count", "degree"), REAL)
def test_real_streamed_scenes(realdata: Path, name: str, lod: int, count: int, degree: int) -> None:
    scene = load_streamed_sog(realdata / "scenes" / name / "lod-meta.json", lod)
    assert (len(scene), scene.sh_degree) == (count, degree)


@pytest.mark.realdata
def test_real_absent_levels_are_reported(realdata: Path) -> None:
    with pytest.raises(FormatError, match="LODs present: 2, 3"):
        load_streamed_sog(realdata / "scenes" / "showroom", 0)
    assert list_lods(realdata / "scenes" / "flowers_sh2") == (1, 2, 3)


def test_what_a_palette_changes_is_measured_and_reported(tmp_path: Path) -> None:
    g = random_scene(300, 2)
    found = encode_sog(g, palette=8)
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        for name, data in found.files.items():
            archive.writestr(name, data)
    back = load_sog(tmp_path / "a.sog")
    squares = np.square(back.shN.astype(np.float64) - g.shN).sum(axis=1).mean()
    np.testing.assert_allclose(found.sh_error, np.sqrt(squares / (4.0 * np.pi)), rtol=1e-5)
    with watch_losses() as losses:
        report_palette_loss("a.sog", 300, found.sets, found.sh_error)
        report_palette_loss("a.sog", 300, 300, 1e-4)
    assert [(each.what, each.count) for each in losses] == [("SH", 300)]
    assert encode_sog(g).sh_error < 0.1 * found.sh_error
