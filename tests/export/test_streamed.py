"""Streamed SOG as written: read back alike, replaced as a whole, and refused where something else lies."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import FormatError, SceneError
from gsvis.export import StreamedOptions, write_streamed_sog
from gsvis.io.losses import watch_losses
from gsvis.io.streamed_sog import list_lods, load_streamed_sog
from gsvis.package import write_package
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene
from tests.export.test_needs import decode, store_of, two_heaps
from tests.package.worlds import colors_of, levels_of, sets_of

SMALL = StreamedOptions(leaf=64)


def by_place(g: Gaussians) -> Gaussians:
    return g[np.lexsort(np.round(g.means, 2).T)]


def sidecar_of(folder: Path) -> tuple[dict[str, Any], list[tuple[list[int], int]], list[dict[int, int]]]:
    (name,) = json.loads((folder / "lod-meta.json").read_bytes())["gsvis"]["files"]
    return decode((folder / name).read_bytes())


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_what_is_written_reads_back_alike(tmp_path: Path, degree: int) -> None:
    g = random_scene(np.random.default_rng(degree), 500, sh_degree=degree)
    found = write_streamed_sog(tmp_path / "s", g, SMALL)
    again = load_streamed_sog(tmp_path / "s")
    assert (len(again), again.sh_degree, found.counts, found.leaves) == (500, degree, (500,), 8)
    first, second = by_place(g), by_place(again)
    order = np.argmin(np.square(first.means[:, None] - second.means[None]).sum(axis=2), axis=1)
    second = second[order]
    assert np.abs(second.means - first.means).max() < 1e-3
    assert np.abs(np.log(second.scales / first.scales)).max() < 0.05
    assert np.abs(second.opacities - first.opacities).max() <= 0.5 / 255 + 1e-6
    assert np.abs(second.sh0 - first.sh0).max() < 0.05
    assert found.nbytes == sum(file.stat().st_size for file in (tmp_path / "s").rglob("*") if file.is_file())


def test_levels_become_levels_of_detail_the_highest_first(tmp_path: Path) -> None:
    levels = levels_of(400)
    found = write_streamed_sog(tmp_path / "s", levels, SMALL)
    assert list_lods(tmp_path / "s") == (0, 1, 2)
    far = found.environment
    for lod in range(3):
        again = load_streamed_sog(tmp_path / "s", lod)
        assert len(again) == found.counts[lod] + far
    assert far <= 4
    assert abs(found.counts[0] + far - levels.counts[2]) == 0


def test_a_loss_counts_the_gaussians_far_outside_too(tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(3), 1500, sh_degree=2)
    means = g.means.copy()
    means[:3] += 1e5
    far = Gaussians(means, g.quats, g.scales, g.opacities, g.sh0, g.shN)
    with watch_losses() as losses:
        found = write_streamed_sog(tmp_path / "s", far, StreamedOptions(leaf=2000))
    assert found.environment > 0
    assert [each.count for each in losses if each.what == "SH"] == [1500]


def test_the_document_is_as_the_format_has_it(tmp_path: Path) -> None:
    levels = levels_of(300)
    write_streamed_sog(tmp_path / "s", levels, SMALL)
    meta = json.loads((tmp_path / "s" / "lod-meta.json").read_bytes())
    assert (meta["version"], meta["lodLevels"], meta["count"]) == (1, 3, sum(meta["counts"]))
    runs: dict[int, int] = {}

    def check(node: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        low, high = np.array(node["bound"]["min"]), np.array(node["bound"]["max"])
        assert ("children" in node) != ("lods" in node)
        if "children" in node:
            assert len(node["children"]) == 2
            ends = [check(child) for child in node["children"]]
            assert (np.min([a for a, _ in ends], axis=0) == low).all()
            assert (np.max([b for _, b in ends], axis=0) == high).all()
        for run in node.get("lods", {}).values():
            assert (run["offset"], run["file"] in runs) == (0, False)
            runs[run["file"]] = run["count"]
        return low, high

    check(meta["tree"])
    assert sorted(runs) == list(range(len(meta["filenames"])))
    for file, count in runs.items():
        assert json.loads((tmp_path / "s" / meta["filenames"][file]).read_bytes())["count"] == count


def test_a_package_brings_its_visible_sets_and_its_colors(tmp_path: Path) -> None:
    levels, (_, colors) = levels_of(400), colors_of(400)
    sets = sets_of(tmp_path / "stores", levels)
    with write_package(tmp_path / "s.gsvis", levels, colors, visibility=sets) as package:
        found = write_streamed_sog(tmp_path / "s", package, SMALL)
    header, cells, _ = sidecar_of(tmp_path / "s")
    assert (found.cells, len(cells), header["leaves"]) == (9, header["cells"], found.leaves)
    assert found.never_seen is not None
    assert 0.0 < found.needed <= 1.0
    assert load_streamed_sog(tmp_path / "s").sh_degree == 3


def test_never_seen_is_kept_or_dropped_and_counted(tmp_path: Path) -> None:
    g = two_heaps()
    with store_of(tmp_path / "s.pvs", g, [np.arange(10, 100), np.arange(50, 150)]) as store:
        kept = write_streamed_sog(tmp_path / "kept", g, SMALL, visibility=store)
        less = StreamedOptions(leaf=64, never_seen="drop")
        dropped = write_streamed_sog(tmp_path / "dropped", g, less, visibility=store)
    assert (kept.counts, kept.never_seen, kept.dropped) == ((200,), 60, False)
    assert (dropped.counts, dropped.never_seen, dropped.dropped) == ((140,), 60, True)
    assert sidecar_of(tmp_path / "dropped")[0]["never_seen"] == {"gaussians": 60, "kept": False}


def test_the_sidecar_stays_below_its_share_or_has_one_cell(tmp_path: Path) -> None:
    g, rng = two_heaps(400), np.random.default_rng(0)
    seen = [np.flatnonzero(rng.random(800) < 0.2) for _ in range(64)]
    with store_of(tmp_path / "s.pvs", g, seen, (4, 4, 4)) as store:
        found = write_streamed_sog(tmp_path / "s", g, StreamedOptions(leaf=64), visibility=store)
    header, _, _ = sidecar_of(tmp_path / "s")
    assert header["cells"] == 1 or found.sidecar_nbytes <= 0.01 * found.nbytes


def test_the_same_scene_gives_the_same_files_and_a_new_one_replaces_the_old(tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(1), 300)
    write_streamed_sog(tmp_path / "a", g, SMALL)
    write_streamed_sog(tmp_path / "b", g, SMALL)
    read = {p.relative_to(tmp_path / "a"): p.read_bytes() for p in (tmp_path / "a").rglob("*") if p.is_file()}
    assert read == {p.relative_to(tmp_path / "b"): p.read_bytes() for p in (tmp_path / "b").rglob("*") if p.is_file()}
    with pytest.raises(ValueError, match="overwrite"):
        write_streamed_sog(tmp_path / "a", g[:100], SMALL)
    found = write_streamed_sog(tmp_path / "a", g[:100], SMALL, overwrite=True)
    assert len(load_streamed_sog(tmp_path / "a")) == 100
    assert found.nbytes == sum(file.stat().st_size for file in (tmp_path / "a").rglob("*") if file.is_file())


def test_something_else_is_never_replaced(tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(1), 100)
    for name, text in (("notes.txt", "mine"), ("lod-meta.json", '{"asset": {"generator": "splat-transform"}}')):
        folder = tmp_path / name.split(".")[0]
        folder.mkdir()
        (folder / name).write_text(text)
        with pytest.raises(ValueError, match="something else"):
            write_streamed_sog(folder, g, SMALL, overwrite=True)
        assert [p.name for p in folder.iterdir()] == [name]


def test_wrong_input_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    g = two_heaps()
    with store_of(tmp_path / "s.pvs", g, [np.arange(100)]) as store, pytest.raises(FormatError, match="scene"):
        write_streamed_sog(tmp_path / "out", g[:150], SMALL, visibility=store)
    with store_of(tmp_path / "none.pvs", g, [np.zeros(0, np.int64)]) as blind:
        assert isinstance(blind, VisibilityStore)
        with pytest.raises(SceneError, match="everything would go"):
            write_streamed_sog(tmp_path / "out", g, StreamedOptions(never_seen="drop"), visibility=blind)
        with pytest.raises(SceneError, match="no cell sees"):
            write_streamed_sog(tmp_path / "out", g, visibility=blind)
    with pytest.raises(ValueError, match="visible sets"):
        write_streamed_sog(tmp_path / "out", g, StreamedOptions(never_seen="drop"))
    with pytest.raises(SceneError, match="at least one"):
        write_streamed_sog(tmp_path / "out", Gaussians.empty())
    for wrong in ({"leaf": 1}, {"lost": 1.0}, {"never_seen": "hide"}, {"up": (0.0, 0.0, 0.0)}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            StreamedOptions(**wrong)
    assert not (tmp_path / "out").exists()
