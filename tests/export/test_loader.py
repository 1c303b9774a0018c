"""The loader of examples/engines, run by node: what it reads, plans and chooses is what the documented bytes say."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.export import StreamedOptions, write_streamed_sog
from tests.export import choosing
from tests.export.test_needs import store_of, two_heaps
from tests.export.test_streamed import sidecar_of
from tests.serve.servers import PATIENCE

CHOICE = """
import { readFileSync } from "node:fs";
import { chooseLevels, leafLights, loadOrder } from "CHOICE";
import { levelsByDistance } from "DISTANCE";
import { power } from "MODULE";
const found = JSON.parse(readFileSync(process.argv[2], "utf8")).map((c) => {
  const lods = (k) => c.counts[k].map((count, lod) => (count ? { count, bytes: c.bytes[k][lod] } : null));
  const errors = (k) => c.errors[k].map((byte) => byte && power(byte - 255));
  const box = (k) => ({ min: c.boxes[k][0], max: c.boxes[k][1] });
  const leaves = c.counts.map((_, k) => ({ lods: lods(k), errors: errors(k), ...box(k) }));
  const rows = [c.everywhere, c.lights, c.beside, c.lights.map(() => 255)];
  const ahead = (leaf) => (c.ahead.includes(leaf) ? 256 : 0);
  const scene = { leaves, rows, ahead, header: { absent: c.absent }, cellAt: ([x]) => ({ row: 1 + 2 * x }),
    neighbors: () => [{ row: 2 }] };
  const views = [{ position: [0, 0, 0] }], turned = [{ position: [0, 0, 0], forward: [1, 0, 0] }];
  const chosen = chooseLevels(scene, views, c.splats);
  return {
    lods: [...chosen.lods], drawn: chosen.splats, order: loadOrder(scene, views, chosen.lods, c.most_bytes),
    all: [...chooseLevels(scene, views).lods],
    plain: [...chooseLevels(scene, views, c.splats, { guard: false }).lods],
    good: [...chooseLevels(scene, views, Infinity, { quality: 30 }).lods],
    filled: [...chooseLevels(scene, turned, c.splats).lods],
    bare: [...chooseLevels(scene, turned, c.splats, { fill: false }).lods],
    distance: [...levelsByDistance(scene, views, c.splats)],
    lit: [false, true].map((fill) => [...leafLights(scene, turned, fill)]),
    two: [...leafLights(scene, [...views, { position: [1, 0, 0], weight: 0.5 }])],
  };
});
console.log(JSON.stringify(found));
"""
EXAMPLE = Path(__file__).parents[2] / "examples" / "engines"
SCRIPT = """
import { readFileSync } from "node:fs";
import { NeededLeaves } from "MODULE";
const folder = process.argv[2] + "/";
globalThis.fetch = async (name) => ({ ok: true, json: async () => JSON.parse(readFileSync(name, "utf8")),
  arrayBuffer: async () => { const data = readFileSync(name); return data.buffer.slice(data.byteOffset, data.byteOffset + data.length); } });
const scene = await NeededLeaves.open(folder);
const eyes = JSON.parse(process.argv[3]);
const plans = eyes.map(([position, forward]) => { const { cell, ...rest } = scene.plan(position, forward); return { box: cell?.box ?? null, ...rest }; });
console.log(JSON.stringify({ plans, urls: scene.leaves.map(({ lods }) => lods.map((lod) => lod?.url ?? null)), header: scene.header }));
"""  # noqa: E501
CELLS = (3, 2, 1)


def node(tmp_path: Path, text: str, *words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a program with the modules of the example."""
    program = shutil.which("node")
    if program is None:
        pytest.skip("no node: install Node.js 18 or later")
    script = tmp_path / "run.mjs"
    for name, file in (("MODULE", "needed-leaves.js"), ("CHOICE", "level-choice.js"), ("DISTANCE", "by-distance.js")):
        text = text.replace(f'"{name}"', f'"{(EXAMPLE / file).as_uri()}"')
    script.write_text(text)
    return subprocess.run([program, script, *words], capture_output=True, text=True, timeout=PATIENCE)


def run(tmp_path: Path, folder: Path, eyes: list[Any]) -> dict[str, Any]:
    done = node(tmp_path, SCRIPT, folder, json.dumps(eyes))
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("name", [path.name for path in sorted(EXAMPLE.glob("*.js"))])
def test_programs_are_short(name: str) -> None:
    assert len((EXAMPLE / name).read_text(encoding="utf-8").splitlines()) <= 150


def test_levels_are_chosen_as_the_reference_chooses(tmp_path: Path) -> None:
    cases = json.loads(choosing.CASES.read_text())
    assert cases == [choosing.solved(case) for case in cases]  # the file is what the reference says
    done = node(tmp_path, CHOICE, choosing.CASES)
    assert done.returncode == 0, done.stderr
    for case, found in zip(cases, json.loads(done.stdout), strict=True):
        assert {key: found[key] for key in ("lods", "drawn", "order")} == {
            key: case[key] for key in ("lods", "drawn", "order")
        }
        assert found["drawn"] <= case["splats"]
        assert found["all"] == choosing.choose({**case, "splats": float("inf")})[0]
        assert found["good"] == choosing.choose({**case, "splats": float("inf")}, quality=30.0)[0]
        assert found["plain"] == choosing.choose(case, guard=False)[0]
        assert found["filled"] == choosing.choose(case, turned=True)[0]
        assert found["bare"] == choosing.choose(case, fill=False, turned=True)[0]
        assert found["distance"] == choosing.by_distance(case)
        assert found["lit"] == [choosing.worths(case, fill, True) for fill in (False, True)]
        once = np.array(choosing.worths(case, False, False))
        assert found["two"] == np.maximum(once, 0.5).tolist()  # a second view, of half the weight, sees all brightly


def test_more_splats_leave_less_error_and_never_pass_the_budget() -> None:
    for seed in range(100, 108):
        case = choosing.make_case(seed)
        left = []
        for splats in (0, 2000, 10**9):
            lods, drawn = choosing.choose({**case, "splats": splats})
            assert drawn <= splats
            lights = [choosing.power(byte - 255) if byte else 0.0 for byte in case["lights"]]
            left.append(np.dot(lights, [choosing.error(case, leaf, lod) for leaf, lod in enumerate(lods)]))
        assert left == sorted(left, reverse=True)


def test_nothing_in_view_is_coarser_than_by_distance() -> None:
    for seed in range(200, 232):
        case = choosing.make_case(seed)
        lods, _ = choosing.choose(case, turned=True)
        distances = choosing.by_distance(case, True)
        sees = np.array(case["lights"]) + np.array(case["beside"]) > 0
        for leaf, (own, distance) in enumerate(zip(lods, distances, strict=True)):
            in_view = leaf in case["ahead"]
            assert not in_view or not sees[leaf] or distance < 0 or 0 <= own <= distance


def test_a_sidecar_of_another_scene_is_refused(tmp_path: Path) -> None:
    for name, seed in (("a", 0), ("b", 1)):
        g = two_heaps(100 + seed)
        write_streamed_sog(tmp_path / name, g, StreamedOptions(leaf=128))
    (other,) = (tmp_path / "b").glob("leaves-*.bin")
    (own,) = (tmp_path / "a").glob("leaves-*.bin")
    own.write_bytes(other.read_bytes())
    done = node(tmp_path, SCRIPT, tmp_path / "a", "[]")
    assert done.returncode != 0
    assert "a sidecar of another scene: export the scene and its sidecar together" in done.stderr


def test_plans_are_what_the_bytes_say(tmp_path: Path) -> None:
    g, rng = two_heaps(), np.random.default_rng(0)
    seen = [np.flatnonzero(rng.random(200) < share) for share in (0.02, 0.05, 0.5, 1.0, 0.0, 0.1)]
    with store_of(tmp_path / "s.pvs", g, seen, CELLS) as store:
        found = write_streamed_sog(tmp_path / "s", g, StreamedOptions(leaf=64, lost=0.0), visibility=store)
        # a sidecar of so small a scene is above its share: cells are merged
        assert sidecar_of(tmp_path / "s")[0]["cells"] == 1
    header, cells, rows = sidecar_of(tmp_path / "s")
    inside = (np.array(header["origin"]) + 0.5 * header["size"]).tolist()
    far = [1e3, 0.0, 0.0]
    near = (np.array(inside) - [0.9 * header["size"], 0.0, 0.0]).tolist()
    got = run(tmp_path, tmp_path / "s", [[inside, None], [far, None], [near, [1, 0, 0]]])
    assert got["header"] == header
    for plan, row in zip(got["plans"], (rows[cells[0][1]], rows[0], rows[cells[0][1]]), strict=True):
        assert sorted(plan["load"]) == sorted(row)
        assert sorted([*plan["load"], *plan["keep"], *plan["hide"]]) == list(range(found.leaves))
    assert got["plans"][0]["load"] == sorted(rows[1], key=lambda leaf: (-rows[1][leaf], leaf))
    assert [plan["box"] for plan in got["plans"]] == [cells[0][0], None, cells[0][0]]


def test_what_neighbors_need_is_kept_and_what_is_ahead_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.export.streamed._SHARE", 1.0)  # as in a scene that is large beside its cells
    g = two_heaps()
    seen = [np.arange(100), np.arange(200), np.arange(100), np.arange(100, 200)]
    with store_of(tmp_path / "s.pvs", g, seen, (4, 1, 1)) as store:
        write_streamed_sog(tmp_path / "s", g, StreamedOptions(leaf=100), visibility=store)
    first, second = (0, 1) if sidecar_of(tmp_path / "s")[2][1].keys() == {0} else (1, 0)
    eyes = [[-1.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]]
    plans = run(tmp_path, tmp_path / "s", [*([eye, None] for eye in eyes), [eyes[1], [-1, 0, 0]], [eyes[1], [1, 0, 0]]])
    known = [(each["load"], each["keep"], each["hide"]) for each in plans["plans"]]
    assert known[0] == ([first], [second], [])
    assert sorted(known[1][0]) == [0, 1]
    assert known[2] == ([second], [first], [])
    assert known[3][0] == [first, second]  # the heap ahead first
    assert known[4][0] == [second, first]
    assert all(len(urls) == 1 and urls[0].endswith("/meta.json") for urls in plans["urls"])
