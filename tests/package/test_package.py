"""Packages on disk: what is read is what was written, the same scene gives the same files, and damage is refused."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import FormatError, SceneError
from gsvis.files.atomic import _host
from gsvis.files.limits import Budget
from gsvis.io.levels import load_levels
from gsvis.package import (
    Contents,
    Cost,
    Package,
    PackageInfo,
    in_package_order,
    measure_cost,
    unpack_levels,
    unpack_package,
    write_package,
)
from gsvis.package import manifest as manifests
from gsvis.package import order as orders
from gsvis.package import package as packages
from gsvis.package import parts as folders
from gsvis.package.rounding import Quality, limits_of, rounded_contents
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from tests.package.worlds import EPSILON, NAMES, colors_of, levels_of, sets_of


@pytest.fixture
def many_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts so small that a test has many."""
    monkeypatch.setattr(orders, "MOST_GAUSSIANS", 64)


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def written(folder: Path, n: int = 400, variant: str = "rgb", *, stores: bool = False) -> Package:
    levels, (_, colors) = levels_of(n), colors_of(n, variant)
    sets, epsilon = (sets_of(folder.parent / "stores", levels), EPSILON) if stores else (None, None)
    info = PackageInfo((0, -1, 0), 0.5, Cost(50.0, 47.0, 3, 64, 48), {"scene": "a test"}, epsilon=epsilon)
    return write_package(folder, levels, colors, info=info, visibility=sets)


def test_the_folder_of_parts_is_listed_once_while_parts_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = tmp_path / f".x.gsvis-{_host()}01234567.arrow"
    left.write_bytes(b"half")
    listed, listdir = list[str](), os.listdir

    def counted(folder: str) -> list[str]:
        listed.append(os.fspath(folder))
        return listdir(folder)

    monkeypatch.setattr("gsvis.files.atomic.os.listdir", counted)
    parts = folders.PartFolder(tmp_path)
    for k in range(20):
        parts.write_columns("a test", {"a": np.arange(k + 1)})
        parts.write_bytes(bytes(k))
    assert parts.written == 40
    assert listed == [str(tmp_path)]
    assert left.exists() == (os.name != "posix")  # of a run that was killed
    assert not list(tmp_path.glob(".*"))


@pytest.mark.usefixtures("many_parts")
@pytest.mark.parametrize("variant", ["rgb", "hsl"])
def test_what_is_read_is_what_was_written(tmp_path: Path, variant: str) -> None:
    levels, (_, colors) = levels_of(), colors_of(400, variant)
    made = Contents.from_levels(levels, colors)
    with written(tmp_path / "s.gsvis", variant=variant) as package:
        read = package.contents
        for name in ("records", "term_counts", "term_records", "chunk_levels", "starts"):
            np.testing.assert_array_equal(getattr(read, name), getattr(made, name), err_msg=name)
        for name in ("origins", "steps", "lows", "strides", "counts", "bits"):
            np.testing.assert_array_equal(getattr(read.table, name), getattr(made.table, name), err_msg=name)
        np.testing.assert_array_equal(read.first, levels.first)
        np.testing.assert_array_equal(read.last, levels.last)
        for name in ("base", "scales", "offsets", "functions", "centers", "decays", "intensities"):
            np.testing.assert_array_equal(getattr(read.colors(), name), getattr(colors, name), err_msg=name)
        m = package.manifest
        assert (m.names, m.counts, m.gaussians, m.terms) == (NAMES, levels.counts, 400, colors.num_terms)
        assert m.scene == scene_hash(levels.union)
        assert m.info == PackageInfo((0, -1, 0), 0.5, Cost(50.0, 47.0, 3, 64, 48), {"scene": "a test"})
        assert len(m.blocks) > 6
        assert package.verify().strays == 0


def test_ids_in_any_order_decode_as_they_do_among_all(tmp_path: Path) -> None:
    with written(tmp_path / "s.gsvis", variant="hsl") as package:
        ids = np.random.default_rng(0).permutation(400)[:70]
        some, whole = package.contents.gaussians(ids), package.contents.gaussians()
        np.testing.assert_array_equal(some.means, whole.means[ids])
        np.testing.assert_allclose(some.sh0, whole.sh0[ids], atol=1e-6)
        with pytest.raises(ValueError, match="ids: expected values"):
            package.contents.gaussians([400])


@pytest.mark.usefixtures("many_parts")
def test_the_same_scene_gives_the_same_files_whatever_its_order(tmp_path: Path) -> None:
    levels, (_, colors) = levels_of(), colors_of(400)
    write_package(tmp_path / "a", levels, colors)
    shuffled = np.random.default_rng(3).permutation(400)
    other = Levels(levels.union[shuffled], levels.first[shuffled], levels.last[shuffled], NAMES)
    with pytest.raises(ValueError, match="in_package_order"):
        write_package(tmp_path / "b", other, colors)
    write_package(tmp_path / "b", in_package_order(other), colors)
    assert files(tmp_path / "a") == files(tmp_path / "b")


def test_gaussians_in_one_place_are_ordered_by_what_they_are() -> None:
    g = levels_of(40).union
    piled = Gaussians(np.zeros((40, 3)), g.quats, g.scales, g.opacities, g.sh0, g.shN)
    shuffled = piled[np.random.default_rng(0).permutation(40)]
    a, b = (in_package_order(Levels.single(scene)).union for scene in (piled, shuffled))
    assert scene_hash(a) == scene_hash(b)


def test_the_order_is_by_level_and_in_a_chunk_by_what_is_likely_to_be_seen() -> None:
    levels = levels_of(3000)
    order = orders.PackageOrder.from_levels(levels)
    np.testing.assert_array_equal(order.permutation, np.arange(3000))
    keys = levels.first.astype(int) * 16 - levels.last
    assert np.all(np.diff(keys) >= 0)
    s, g = levels.union.scales.astype(float), levels.union
    strengths = g.opacities * (s[:, 0] * s[:, 1] + s[:, 1] * s[:, 2] + s[:, 2] * s[:, 0])
    falls = np.diff(strengths) <= 0
    falls[order.chunks[1:] - 1] = True
    assert falls.all()
    assert set(order.starts[:-1].tolist()) <= set(order.chunks.tolist())


def test_an_order_that_is_known_gives_the_same_records() -> None:
    levels = levels_of(3000)
    mixed = np.random.default_rng(0).permutation(3000)
    other = Levels(levels.union[mixed], levels.first[mixed], levels.last[mixed], levels.names)
    order = orders.PackageOrder.from_levels(other)
    ordered = order.sort(other)
    assert scene_hash(ordered.union) == scene_hash(in_package_order(other).union)
    colors = colors_of(3000)[1]
    found = Contents.from_levels(ordered, colors)
    known = Contents.from_levels(ordered, colors, order.of_sorted())
    np.testing.assert_array_equal(known.records, found.records)
    np.testing.assert_array_equal(known.starts, found.starts)
    np.testing.assert_array_equal(known.table.starts, found.table.starts)
    with pytest.raises(ValueError, match="expected the order of a package"):
        Contents.from_levels(ordered, colors, order)


@pytest.mark.usefixtures("many_parts")
def test_records_that_are_known_make_the_same_package(tmp_path: Path) -> None:
    levels = levels_of(400)
    colors = colors_of(400)[1]
    limits = limits_of(Contents.from_levels(levels, colors), Quality())
    records = rounded_contents(levels, colors, limits)
    write_package(tmp_path / "colors", levels, colors, limits=limits).close()
    write_package(tmp_path / "records", levels, records).close()
    assert files(tmp_path / "records") == files(tmp_path / "colors")
    with pytest.raises(ValueError, match="limits: expected None for records"):
        write_package(tmp_path / "both", levels, records, limits=limits)
    with pytest.raises(ValueError, match="colors: expected records of 300 Gaussians"):
        write_package(tmp_path / "other", levels_of(300), records)


@pytest.mark.usefixtures("many_parts")
def test_a_second_run_writes_nothing_and_an_edit_little(tmp_path: Path) -> None:
    levels, (_, colors) = levels_of(2000), colors_of(2000)
    write_package(tmp_path / "s", levels, colors)
    times = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "s" / "parts").iterdir()}
    write_package(tmp_path / "s", levels, colors)
    assert times == {p.name: p.stat().st_mtime_ns for p in (tmp_path / "s" / "parts").iterdir()}
    g, quats = levels.union, levels.union.quats.copy()
    quats[1000] = 0.5, 0.1, 0.7, -0.3
    edited = Levels(Gaussians(g.means, quats, g.scales, g.opacities, g.sh0, g.shN), levels.first, levels.last, NAMES)
    write_package(tmp_path / "s", edited, colors)
    now = {p.name for p in (tmp_path / "s" / "parts").iterdir()}
    assert len(now - set(times)) == 1
    assert len(now) == len(times)


@pytest.mark.usefixtures("many_parts")
def test_a_killed_run_leaves_the_old_package_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path / "s", 100).close()
    old = files(tmp_path / "s")
    levels, (_, colors) = levels_of(), colors_of(400)

    def stop(stage: str, done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_package(tmp_path / "s", levels, colors, progress=stop)
    assert old.items() <= files(tmp_path / "s").items()
    with Package.open(tmp_path / "s") as package:
        assert package.verify().strays > 0
    (tmp_path / "s" / "parts" / ".part-0123456789ab.arrow").write_bytes(b"left by a killed run")
    (tmp_path / "s" / "parts" / "notes.txt").write_text("mine")
    write_package(tmp_path / "s", levels, colors)
    (tmp_path / "s" / "parts" / "notes.txt").unlink()
    write_package(tmp_path / "t", levels, colors)
    assert files(tmp_path / "s") == files(tmp_path / "t")


def test_a_part_that_is_there_but_damaged_is_written_again(tmp_path: Path) -> None:
    levels, (_, colors) = levels_of(100), colors_of(100)
    write_package(tmp_path / "s", levels, colors)
    good = files(tmp_path / "s")
    for path in (tmp_path / "s" / "parts").iterdir():
        path.write_bytes(b"x" * path.stat().st_size)
    write_package(tmp_path / "s", levels, colors)
    assert files(tmp_path / "s") == good


def test_visible_sets_travel_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.package.writer.MOST_BYTES", 500)
    with written(tmp_path / "s.gsvis", stores=True) as package:
        assert package.manifest.visibility is not None
        assert len(package.manifest.visibility.parts) > 3
        found = package.verify()
        assert found.cells == 9
        assert len(package.visibility) == 9
        joined = b"".join(path.read_bytes() for path in package.set_files())
        assert joined == (tmp_path / "stores" / "w.pvs").read_bytes()


def test_stores_of_another_scene_are_refused(tmp_path: Path) -> None:
    (_, colors), sets = colors_of(400), sets_of(tmp_path / "stores", levels_of())
    with pytest.raises(FormatError, match="scene"):
        write_package(tmp_path / "s", levels_of(400, seed=1), colors, visibility=sets)
    with written(tmp_path / "s.gsvis") as package:
        with pytest.raises(SceneError, match="no visible sets"):
            _ = package.visibility
        with pytest.raises(SceneError, match="no epsilon"):
            _ = package.active_terms


def test_every_part_is_checked_when_it_is_read(tmp_path: Path) -> None:
    written(tmp_path / "s", stores=True).close()
    for path in sorted((tmp_path / "s" / "parts").iterdir()):
        whole = path.read_bytes()
        for damaged in (whole[:-1], whole + b"x", whole[:40] + bytes([whole[40] ^ 1]) + whole[41:], None):
            path.unlink()
            if damaged is not None:
                path.write_bytes(damaged)
            with Package.open(tmp_path / "s") as package, pytest.raises(FormatError, match=path.name[:20]):
                package.verify()
        path.write_bytes(whole)
    with Package.open(tmp_path / "s") as package:
        package.verify()


@pytest.mark.skipif(os.name != "posix", reason="links")
def test_no_name_leads_out_of_the_folder(tmp_path: Path) -> None:
    package = written(tmp_path / "s", 60)
    part = package.manifest.blocks[0].gaussians
    path = tmp_path / "s" / "parts" / part.name
    shutil.move(path, tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FormatError, match="a link"):
        package.verify()
    for name in ("../../elsewhere", "/etc/passwd", part.digest.upper(), part.digest + "/..", 7):
        with pytest.raises(FormatError, match="64 hexadecimal"):
            reread(tmp_path / "s", lambda value, name=name: value["blocks"][0].update(sha256=name))


def reread(folder: Path, change: object, *, resign: bool = True) -> None:
    """Verify the package with a changed manifest, under a hash that fits; the old manifest comes back."""
    path = folder / manifests.MANIFEST
    whole = path.read_bytes()
    value = json.loads(whole)
    value.pop("sha256")
    change(value)  # type: ignore[operator]
    digest = manifests._digest(value) if resign else "0" * 64
    path.write_text(json.dumps({**value, "sha256": digest}))
    try:
        with Package.open(folder) as package:
            package.verify()
    finally:
        path.write_bytes(whole)


def test_a_manifest_that_contradicts_itself_is_refused(tmp_path: Path) -> None:
    written(tmp_path / "s", 60, stores=True).close()
    reread(tmp_path / "s", lambda value: None)
    for change, message in (
        (lambda v: v.update(version=5), "update gsvis"),
        (lambda v: v.update(version=1), "prepare the package again"),
        (lambda v: v.update(version=0), "version"),
        (lambda v: v.update(format="other"), "is this a package"),
        (lambda v: v.update(gaussians=61), "gaussians"),
        (lambda v: v.update(epsilon=-1), "epsilon"),
        (lambda v: v.update(terms=1), "terms"),
        (lambda v: v.update(up=[0, 0, 0]), "up"),
        (lambda v: v.update(meters_per_unit=-1), "meters_per_unit"),
        (lambda v: v["levels"][0].update(count=1), "levels"),
        (lambda v: v["levels"][0].update(name="high"), "different names"),
        (lambda v: v["levels"].pop(), "chunks"),
        (lambda v: v["chunks"].pop(), "chunks"),
        (lambda v: v["blocks"][0].update(count=7), "gaussians"),
        (lambda v: v["quantization"]["record"].update(position=16), "record"),
        (lambda v: v["quantization"]["colors"].update(variant="none"), "variant"),
        (lambda v: v["quantization"]["colors"]["precision"].update(base=12), "precision"),
        (lambda v: v["quantization"]["cost"].update(views=0), "views"),
        (lambda v: v["visibility"].update(bytes=1), "visibility"),
        (lambda v: v["blocks"][0]["term_parts"].clear(), "terms"),
        (lambda v: v.update(scene="0" * 64), "visibility"),
        (lambda v: v.update(blocks={}), "blocks"),
    ):
        with pytest.raises(FormatError, match=message):
            reread(tmp_path / "s", change)
    with pytest.raises(FormatError, match="hash of the rest"):
        reread(tmp_path / "s", lambda value: None, resign=False)


def test_what_is_no_package_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Package.open(tmp_path / "none")
    with pytest.raises(FormatError, match="a folder without"):
        Package.open(tmp_path)
    (tmp_path / "manifest.json").write_bytes(b"{")
    with pytest.raises(FormatError, match="JSON"):
        Package.open(tmp_path)
    (tmp_path / "manifest.json").unlink()
    (tmp_path / "photo.jpg").write_bytes(b"mine")
    levels, (_, colors) = levels_of(60), colors_of(60)
    with pytest.raises(FormatError, match=r"photo\.jpg"):
        write_package(tmp_path, levels, colors)
    with pytest.raises(FormatError, match="choose another name"):
        write_package(tmp_path / "photo.jpg", levels, colors)
    with pytest.raises(ValueError, match="colors: expected those"):
        write_package(tmp_path / "s", levels, colors_of(59)[1])


def test_parts_together_are_bounded_by_their_real_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Narrow(Budget):
        """Eight bytes in memory for one on disk, and nothing for the rest."""

        def claim(self, nbytes: int, where: str) -> None:
            super().claim(nbytes, where)
            if self.claimed > 8 * self.file_bytes:
                raise FormatError(self.path, where, "less", "more")

    package = written(tmp_path / "p")
    monkeypatch.setattr(packages, "Budget", Narrow)
    assert len(package.contents) == len(package)
    named_often = Package.open(tmp_path / "p")
    named_often.manifest = replace(package.manifest, blocks=16 * package.manifest.blocks)
    with pytest.raises(FormatError, match="expected less, got more"):
        _ = named_often.contents


def test_parts_are_of_bounded_size() -> None:
    assert orders.MOST_GAUSSIANS * (16 + 1 + 4) <= folders.MOST_BYTES


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
def test_unpacking_gives_levels_that_look_like_those_packed(tmp_path: Path, variant: str) -> None:
    levels = levels_of()
    with written(tmp_path / "s", variant=variant) as package:
        flat = unpack_levels(package, sh_degree=0)
        assert flat.union.sh_degree == 0
        unpack_package(package, tmp_path / "out", sh_degree=2)
        with pytest.raises(ValueError, match="sh_degree"):
            unpack_levels(package, sh_degree=4)
    found = load_levels(tmp_path / "out")
    assert found.names == NAMES
    assert found.union.sh_degree == 2
    np.testing.assert_array_equal(found.first, levels.first)
    np.testing.assert_allclose(found.union.means, levels.union.means, atol=0.02)
    np.testing.assert_allclose(found.union.covars(), levels.union.covars(), atol=0.1 * levels.union.scales.max() ** 2)


def test_the_cost_is_measured_by_drawing() -> None:
    levels, (exact, colors) = levels_of(), colors_of(400)
    view = np.eye(4)
    view[2, 3] = 8.0
    cameras = Cameras(view[None], [[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]], 64, 48)
    cost = measure_cost(levels, exact, colors, cameras)
    assert 35.0 < cost.worst <= cost.psnr < 100.0
    assert (cost.views, cost.width, cost.height) == (1, 64, 48)
    with pytest.raises(ValueError, match="cameras"):
        measure_cost(levels, exact, colors, cameras[:0])


def test_a_manifest_that_promises_too_much_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    written(tmp_path / "s", 60).close()
    most = 1 << 30

    def gaussians(value: dict[str, Any]) -> None:
        value["blocks"][0].update(count=most)
        value.update(gaussians=sum(block["count"] for block in value["blocks"]))

    def terms(value: dict[str, Any]) -> None:
        block = next(block for block in value["blocks"] if block["term_parts"])
        block["term_parts"][0].update(count=most)
        block.update(terms=most)
        value.update(terms=sum(block["terms"] for block in value["blocks"]))

    for change in (gaussians, terms):
        with pytest.raises(FormatError, match="exhaust memory"):
            reread(tmp_path / "s", change)


@pytest.mark.usefixtures("many_parts")
def test_blocks_that_cut_a_chunk_are_refused(tmp_path: Path) -> None:
    written(tmp_path / "s").close()

    def change(value: dict[str, Any]) -> None:
        value["blocks"][0]["count"] += 1
        value["blocks"][1]["count"] -= 1

    with pytest.raises(FormatError, match="chunks that end where blocks end"):
        reread(tmp_path / "s", change)
