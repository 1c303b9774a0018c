"""What do records of 16 bytes cost: bytes a Gaussian, image quality, and time to be ready to draw?

One scene a run, as one level, its colors without view dependence, or the SRBF colors that `gsvis color` wrote
(`--colors FILE`). Cameras: drawn from seed 3 in navigable space, 480 x 360. Bytes: parts as they lie on disk, rows of
chunks included. Time: 50,000 Gaussians spread over all chunks, from the bytes of a batch (planes under zstd) to the
arrays that a rasterizer takes; against that, the bare decompression of the same bytes. Beside it the same scene as SPZ
and SOG, without and with its SH colors, and all bytes of a package that `gsvis prepare` made from it (`--package DIR`).

Given: a scene as one level, the record of 16 bytes.
Measured: bytes, PSNR of held-out cameras against the unrounded scene, time until 50,000 Gaussians can be drawn.
Defaults chosen on: nika LOD 2 (bits of the records) and showroom LOD 3.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import zstandard
from _harness import add_arguments, measure_in_turn, realdata, write_result

from gsvis.color import FitConfig, SrbfColors, fit_srbf, load_srbf, quantize
from gsvis.io import load_scene, save_scene
from gsvis.package import (
    RECORD_BYTES,
    Contents,
    Package,
    PackageOrder,
    base_rgb,
    decode_records,
    in_package_order,
    measure_cost,
    write_package,
)
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.sh import SH_C0

SCENES = {"showroom": ("showroom", 3, "+z"), "nika": ("nika_sh3", 0, "-y"), "nika-small": ("nika_sh3", 2, "-y")}
BATCH = 50_000
LABELS = {
    "spz_base": "SPZ, base colors alone",
    "sog_base": "SOG, base colors alone",
    "spz_sh": "SPZ with SH",
    "sog_sh": "SOG with SH",
}


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene", choices=tuple(SCENES), default="showroom")
    parser.add_argument("--colors", type=Path, help="what gsvis color wrote with --precision exact for that scene")
    parser.add_argument("--package", type=Path, help="what gsvis prepare wrote of that scene")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--variant", choices=("rgb", "hsl"), default="rgb", help="layout, where there are no --colors")
    options = parser.parse_args()
    folder, lod, up = SCENES[options.scene]
    g = load_scene(realdata() / "scenes" / folder / "lod-meta.json", lod=lod)
    space = NavigableSpace.from_scene(g, up=up)
    cameras = space.sample_cameras(options.views, np.random.default_rng(3), width=480, height=360)
    if options.colors is not None:
        _, colors = load_srbf(options.colors)
    elif options.variant == "rgb":
        colors = SrbfColors.without_terms(np.maximum(0.5 + SH_C0 * g.sh0[:, 0], 0.0))
    else:
        flat = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0)
        colors = fit_srbf(flat, None, FitConfig(variant="hsl", max_terms=0)).colors
    single = Levels.single(g)
    permutation = PackageOrder.from_levels(single).permutation
    levels, colors = in_package_order(single), colors[permutation]
    packed = quantize(colors, "wire")
    contents = Contents.from_levels(levels, packed)
    cost = measure_cost(levels, colors, packed, cameras)
    with tempfile.TemporaryDirectory() as place:
        with write_package(Path(place) / "s.gsvis", levels, packed) as package:
            m = package.manifest
            geometry = sum(block.gaussians.nbytes for block in m.blocks) / len(package)
            tables = sum(part.nbytes for part, _ in m.tables) / len(package)
            terms = sum(part.nbytes for block in m.blocks for part, _ in block.terms) / len(package)
        others = {}
        flat = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0)
        for suffix in ("spz", "sog"):
            for label, scene in (("base", flat), *((("sh", g),) if g.sh_degree else ())):
                save_scene(scene, Path(place) / f"s.{suffix}")
                others[f"{suffix}_{label}"] = (Path(place) / f"s.{suffix}").stat().st_size
    ids = np.random.default_rng(0).choice(len(g), min(BATCH, len(g)), replace=False)
    chunks, rows = np.unique(contents.chunks[ids], return_inverse=True)
    table, rows = contents.table[chunks], rows.astype(np.int32)
    planes = zstandard.ZstdCompressor(3).compress(np.ascontiguousarray(contents.records[ids].T).tobytes())

    def decompressed() -> bytes:
        return zstandard.ZstdDecompressor().decompress(planes)

    def ready() -> object:
        records = np.ascontiguousarray(np.frombuffer(decompressed(), np.uint8).reshape(RECORD_BYTES, -1).T)
        return decode_records(records, table, contents.layout, chunks=rows), base_rgb(records, contents.grids)

    def cpu_ms() -> float:
        """Milliseconds of the processor, which others on the machine disturb least; the median of 15 calls."""
        found = []
        for _ in range(15):
            start = time.process_time()
            ready()
            found.append(1e3 * (time.process_time() - start))
        return float(np.median(found))

    whole = None if options.package is None else sizes_of(options.package)
    rivals = {label: others[name] for name, label in LABELS.items() if name in others}
    if whole is not None:
        rivals["package with levels, terms, visible sets"] = whole["all"]
        rivals["records, rows of chunks and terms of that"] = whole["records"] + whole["chunks"] + whole["terms"]
    timings = measure_in_turn({"ready": ready, "decompressed": decompressed}, repeats=15, warmup=3)
    name = f"{options.scene}, {colors.variant}"
    write_result(
        options.out,
        "What do records of 16 bytes cost in bytes, image quality and time?",
        [
            {"name": f"record of geometry and base color, {name}", "target": 16, "reached": RECORD_BYTES,
             "unit": "bytes", "better": "lower"},
            {"name": f"on disk, with rows of chunks, {name}", "target": None, "reached": geometry + tables,
             "unit": "bytes a Gaussian", "better": "lower"},
            {"name": f"rounded against exact, mean of {options.views} views, {name}", "target": 45.0,
             "reached": cost.psnr, "unit": "dB", "better": "higher"},
            {"name": f"the worst of them, {name}", "target": None, "reached": cost.worst, "unit": "dB",
             "better": "higher"},
            *({"name": f"{label}, {options.scene}", "target": None, "reached": size / len(g),
               "unit": "bytes a Gaussian of the scene", "better": "lower"} for label, size in rivals.items()),
            {"name": f"{len(ids):,} Gaussians ready to draw, processor time, {name}", "target": 50.0,
             "reached": cpu_ms(), "unit": "ms", "better": "lower"},
        ],
        {
            "gaussians": len(g), "chunks": len(contents.table), "geometry_bytes": geometry, "table_bytes": tables,
            "term_bytes": terms, "files": others, "package": whole, "sh_degree": g.sh_degree, "terms": packed.num_terms,
            "batch_bytes": len(planes),
            "decompress_ms": 1e3 * timings["decompressed"].median, **timings,
        },
    )  # fmt: skip


def sizes_of(folder: Path) -> dict[str, int]:
    """Bytes of a package by what they hold."""
    with Package.open(folder) as package:
        m = package.manifest
        sizes = {**m.sizes(), "manifest": len(m.to_json())}
        counts = {"gaussians": m.gaussians, "terms_counted": m.terms, "levels": len(m.names)}
    return {**sizes, "all": sum(sizes.values()), **counts}


if __name__ == "__main__":
    main()
