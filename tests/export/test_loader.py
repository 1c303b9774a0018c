"""The loader of examples/streamed, run by node: what it reads and plans is what the documented bytes say."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.export import StreamedOptions, write_streamed_sog
from tests.export.test_needs import store_of, two_heaps
from tests.export.test_streamed import sidecar_of
from tests.serve.servers import PATIENCE

EXAMPLE = Path(__file__).parents[2] / "examples" / "streamed"
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


def run(tmp_path: Path, folder: Path, eyes: list[Any]) -> dict[str, Any]:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node: install Node.js 18 or later")
    script = tmp_path / "run.mjs"
    script.write_text(SCRIPT.replace("MODULE", (EXAMPLE / "needed-leaves.js").as_uri()))
    done = subprocess.run([node, script, folder, json.dumps(eyes)], capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_the_loader_is_short_and_imports_nothing() -> None:
    text = (EXAMPLE / "needed-leaves.js").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    assert "import " not in text


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
