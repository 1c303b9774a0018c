"""How many bytes do records take that are coded together, at what loss, and how long do coding and decoding take?

Packages as `gsvis prepare` makes them, as they are and with coarse records. Bytes of the coded rows alone: of 50,000
Gaussians with neighboring ids, and of one in five, which is about what one view needs; beside them the same records as
planes under zstd at level 19, and plain. Bytes with ids, rows of chunks and the message: a walk at 10 Mbit/s, without
terms, as in `stream_codec.py`. Loss: images of coarse records against those of the package's records, in base colors,
from cameras drawn from seed 3 in navigable space, 480 x 360. Times are of the thread, for a batch of 50,000 Gaussians;
in Node by the clock, with the message parsed and checked.

Given: packages, records of 16 bytes.
Measured: bytes a Gaussian and a term; PSNR of coarse records; time to code and to decode 50,000 Gaussians.
Defaults chosen on: nika LOD 1 and showroom LOD 3, the packages that are measured too.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from _harness import add_arguments, need, write_result
from stream_codec import per_gaussian

from gsvis.package import Contents, base_rgb
from gsvis.package.rounding import Quality
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.navigable import NavigableSpace
from gsvis.stream import Receiver, StreamedScene
from gsvis.stream.batch import Sections

BATCH = 50_000
VIEWER = Path(__file__).parents[1] / "viewer"


def thread_ms(fn: Callable[[], object], repeats: int) -> float:
    """Median milliseconds of the thread in calls of a function, after one that does not count."""
    fn()
    found = []
    for _ in range(repeats):
        start = time.thread_time()
        fn()
        found.append(1e3 * (time.thread_time() - start))
    return float(np.median(found))


def planes(rows: np.ndarray) -> int:
    return len(zstandard.ZstdCompressor(level=19).compress(np.ascontiguousarray(rows.T).tobytes()))


def sizes(scene: StreamedScene, ids: np.ndarray) -> dict[str, float]:
    """Bytes of a Gaussian and of a term, coded and otherwise."""
    c, coding = scene.contents, scene.coding
    records = coding.encode_records(c.records[ids], ids, c.chunks[ids], scene.records.chunk_numbers)
    found = {
        "record": len(records) / len(ids),
        "record, zstd": planes(c.records[ids]) / len(ids),
        "record, plain": 16.0,
    }
    terms = np.flatnonzero(np.isin(scene.records.owners, ids))
    if len(terms):
        rows = c.term_records[terms]
        found["term"] = len(coding.encode_terms(rows, scene.records.owners[terms])) / len(terms)
        found |= {"term, zstd": planes(rows) / len(terms), "term, plain": scene.about.term_bits / 8}
    return found


def message(scene: StreamedScene, ids: np.ndarray) -> bytes:
    """The first batch of a session that sends these Gaussians without terms."""
    c, none = scene.contents, np.zeros(0, np.int64)
    chunks = np.unique(c.chunks[ids])
    records = scene.coding.encode_records(c.records[ids], ids, c.chunks[ids], scene.records.chunk_numbers)
    rows = np.zeros(0, np.uint8)
    return Sections(
        1, c.table.starts[chunks], scene.records.chunk_rows[chunks], ids, records, none, none, rows, none
    ).to_message(scene.about)


def times(scene: StreamedScene, ids: np.ndarray, repeats: int) -> dict[str, float]:
    c, coding, data = scene.contents, scene.coding, message(scene, ids)
    given = c.records[ids], ids, c.chunks[ids], scene.records.chunk_numbers
    coded = coding.encode_records(*given)
    assert np.array_equal(coding.decode_records(coded, *given[1:]), c.records[ids])
    found = {
        "encode": thread_ms(lambda: coding.encode_records(*given), repeats),
        "decode": thread_ms(lambda: coding.decode_records(coded, *given[1:]), repeats),
        "receive": thread_ms(lambda: Receiver(scene.header).receive(data), repeats),
        "welcome": thread_ms(lambda: Receiver(scene.header), repeats),
    }
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("welcome", "batch")]
        for file, content in zip(files, (scene.header, data), strict=True):
            file.write_bytes(content)
        script = Path(folder) / "batch-time.mjs"
        build = ["npx", "esbuild", "tools/batch-time.ts", "--bundle", "--platform=node", "--format=esm"]
        subprocess.run([*build, f"--outfile={script}"], cwd=VIEWER, check=True, capture_output=True)
        run = subprocess.run(["node", script, *files, str(repeats + 3)], check=True, capture_output=True, text=True)
        calls = json.loads(run.stdout)
    return found | {"Node, first": calls[0], "Node": float(np.median(calls[3:]))}


def loss(exact: Contents, coarse: Contents, cameras: Cameras) -> list[float]:
    """PSNR of each view of coarse records against the exact ones, in base colors, of the highest level."""
    shown = np.flatnonzero(exact.last == len(exact.names) - 1)
    found = []
    for k in range(len(cameras)):
        images = []
        for c in (exact, coarse):
            image = rasterize(c.gaussians(shown), cameras[k], colors=base_rgb(c.records[shown], c.grids)).images[0]
            images.append(np.clip(image, 0.0, 1.0))
        found.append(float(psnr(images[1], images[0])))
    return found


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("packages", nargs="*", type=Path, help="what `gsvis prepare` made")
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    need(args.packages, "what `gsvis prepare` made")
    figures: list[dict[str, Any]] = []
    details: dict[str, Any] = {}

    def figure(name: str, reached: float, unit: str, target: float | None = None, better: str = "lower") -> None:
        figures.append({"name": name, "target": target, "reached": reached, "unit": unit, "better": better})

    for path in args.packages:
        exact = None
        for label, quality in (("as they are", None), ("coarse", Quality())):
            scene = StreamedScene.open(path, quality=quality)
            name, ids = f"{path.stem}, {label}", np.arange(len(scene))
            some = np.flatnonzero(np.random.default_rng(0).random(len(scene)) < 0.2)[:BATCH]
            record: dict[str, Any] = {
                "gaussians": len(scene), "terms": scene.about.terms, "welcome": len(scene.header),
                "neighbors": sizes(scene, ids[:BATCH]), "one in five": sizes(scene, some),
                "walk": per_gaussian(scene, 100), "ms": times(scene, ids[:BATCH], args.repeats),
            }  # fmt: skip
            each, walk, ms = record["one in five"], record["walk"]["with all"], record["ms"]
            figure(f"{name}: a Gaussian with id, rows of chunks and the message, at 10 Mbit/s", walk, "bytes", 10.0)
            figure(f"{name}: the record of a Gaussian alone", each["record"], "bytes")
            figure(f"{name}: the same as planes under zstd at level 19", each["record, zstd"], "bytes")
            if "term" in each and quality is None:
                figure(f"{name}: the record of a term ({each['term, plain']:g} plain)", each["term"], "bytes")
            figure(f"{name}: 50,000 Gaussians decoded, Python", ms["decode"], "ms", 50.0)
            figure(f"{name}: 50,000 Gaussians received, Node", ms["Node"], "ms", 100.0)
            if exact is None:
                exact = scene.contents
                space = NavigableSpace.from_scene(exact.gaussians(), up=scene.about.up)
                cameras = space.sample_cameras(args.views, np.random.default_rng(3), width=480, height=360)
            else:
                record["psnr"] = views = loss(exact, scene.contents, cameras)
                figure(f"{name}: against the records as they are, mean view", np.mean(views), "dB", 45.0, "higher")
                figure(f"{name}: the worst view", min(views), "dB", None, "higher")
            details[name] = record
    write_result(args.out, "What do records that are coded together take, in bytes and time?", figures, details)


if __name__ == "__main__":
    main()
