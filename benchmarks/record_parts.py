"""Which parts of a record take the bytes of a package: positions, scales, rotations, opacity, color, terms?

A scene is written as one level. A part is what the bytes fall by when all records have the same value in it; parts that
predict each other do not add up exactly. Places are split in the path through the octree, which is coded, and the bits
below, which are stored as they are.

Given: --scenes, by NAME:LOD; --mean-terms, --precision of fitted colors.
Measured: bytes a Gaussian on disk, of a record with its row of the chunk and of its terms; PSNR of the records against
    the scene, mean and worst of 12 sampled views.
Defaults chosen on: nothing here.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from numpy.typing import NDArray

from gsvis.color import FitConfig, SrbfColors, fit_srbf, quantize
from gsvis.io import load_scene
from gsvis.package import Contents, PackageOrder, in_package_order, measure_cost
from gsvis.package.coded import encode_gaussians, encode_terms
from gsvis.package.layout import TermLayout
from gsvis.prepare.importance import direction_weights, importance_from_views
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.sh import SH_C0
from gsvis.scene.view_sampling import ViewSampling

SCENES = {"nika": ("nika_sh3", "-y"), "showroom": ("showroom", "+z"), "flowers": ("flowers_sh2", "-y")}
U8 = NDArray[np.uint8]

ROW_BYTES = 33  # of a chunk, as it is kept: origin, steps, lowest scale, stride, count, bits


def fitted(g: Gaussians, space: NavigableSpace, mean_terms: float) -> SrbfColors:
    """Return the colors of a scene; base colors alone where they do not depend on direction."""
    if g.sh_degree == 0:
        return SrbfColors.without_terms(np.maximum(0.5 + SH_C0 * g.sh0[:, 0], 0.0))
    seen = importance_from_views(g, ViewSampling(256).cameras(g, space))
    weights = direction_weights(seen.sets, seen.shares)
    return fit_srbf(g, weights, FitConfig(mean_terms=mean_terms), importance=seen.importance).colors


def bits_of(contents: Contents, part: str) -> NDArray[np.bool_]:
    """Return (128,) whether each bit of a record belongs to a part."""
    layout = contents.layout
    found = np.zeros(128, bool)
    if part == "opacity":
        found[:8] = True
    if part == "color":
        found[8 : 8 * layout.packed_from] = True
    at = 8 * layout.packed_from
    for _ in range(3):
        for name, width in zip(("places", "rotation", "scales"), layout.bits, strict=True):
            found[at : at + width] = name == part
            at += width
    return found


def coded_bytes(contents: Contents, without: str | None = None) -> int:
    """Return the bytes of all records, with one value for a part in all of them."""
    records = contents.records
    if without is not None:
        kept = np.packbits(~bits_of(contents, without), bitorder="little")
        records = records & kept
    counts = np.zeros_like(contents.term_counts) if without == "counts" else contents.term_counts
    total = 0
    starts = contents.table.starts
    for low, high in zip(contents.starts[:-1], contents.starts[1:], strict=True):
        rows = slice(*np.searchsorted(starts, [low, high]).tolist())
        total += len(encode_gaussians(records[low:high], counts[low:high], contents.table[rows], contents.layout))
    return total


def term_bytes(contents: Contents, bits: slice | None = None) -> int:
    """Return the bytes of all terms, with 0 in some bits of all of them."""
    if contents.colors().num_terms == 0:
        return 0
    layout = TermLayout.from_grids(contents.grids)
    records = contents.term_records
    if bits is not None:
        kept = np.ones(8 * records.shape[1], bool)
        kept[bits] = False
        records = records & np.packbits(kept, bitorder="little")
    owners = np.repeat(np.arange(len(contents)), contents.term_counts)
    firsts = np.concatenate([[True], np.diff(owners) != 0])
    return len(encode_terms(np.ascontiguousarray(records), firsts, layout))


def measure(scene: str, options: argparse.Namespace) -> dict[str, Any]:
    """Return the bytes a Gaussian of each part of a scene, and its quality."""
    name, lod = scene.split(":")
    folder, up = SCENES[name]
    single = Levels.single(load_scene(realdata() / "scenes" / folder / "lod-meta.json", lod=int(lod)))
    space = NavigableSpace.from_scene(single.union, up=up)
    exact = fitted(single.union, space, options.mean_terms)[PackageOrder.from_levels(single).permutation]
    levels = in_package_order(single)
    packed = quantize(exact, options.precision)
    contents = Contents.from_levels(levels, packed)
    n = len(contents)
    whole = coded_bytes(contents)
    row: dict[str, Any] = {"scene": scene, "gaussians": n, "terms_each": packed.num_terms / n}
    row["records"] = whole / n
    low = contents.table.bits.astype(np.int64)
    below = (np.maximum(low, 4) - 4).sum(axis=1) * contents.table.counts
    row["places below the octree"] = float(below.sum()) / 8 / n
    for part in ("places", "rotation", "scales", "opacity", "color", "counts"):
        row[part] = (whole - coded_bytes(contents, part)) / n
    row["places"] += row["places below the octree"]
    row["rows of chunks"] = ROW_BYTES * len(contents.table) / n
    terms = term_bytes(contents)
    row["terms"] = terms / n
    if terms:
        ends = np.cumsum(TermLayout.from_grids(contents.grids).widths)
        for label, low_bit, high_bit in (("centers", ends[0], ends[2]), ("decays", ends[2], ends[3])):
            row[f"terms: {label}"] = (terms - term_bytes(contents, slice(low_bit, high_bit))) / n
        row["terms: intensities"] = (terms - term_bytes(contents, slice(ends[3], ends[-1]))) / n
    cameras = ViewSampling(12, 320, 240, seed=77, stream=8).cameras(levels.union, space)
    cost = measure_cost(levels, exact, packed, cameras)
    row |= {"psnr": cost.psnr, "worst": cost.worst}
    print(row, flush=True)
    return row


def figures_of(row: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of one scene."""
    whole = row["records"] + row["rows of chunks"] + row["terms"]
    wanted = 16.0 if row["terms"] else 11.0
    found = [(f"{row['scene']}: whole record on disk", wanted, whole, "bytes a Gaussian", "lower")]
    found.append((f"{row['scene']}: records against what was fitted", 48.0, row["psnr"], "dB", "higher"))
    for part, value in row.items():
        if part not in ("scene", "gaussians", "terms_each", "records", "psnr", "worst"):
            found.append((f"{row['scene']}: {part}", None, value, "bytes a Gaussian", "lower"))
    return [{"name": n, "target": t, "reached": float(v), "unit": u, "better": b} for n, t, v, u, b in found]


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scenes", nargs="+", default=["nika:1", "showroom:3"], metavar="NAME:LOD")
    parser.add_argument("--mean-terms", type=float, default=FitConfig.mean_terms)
    parser.add_argument("--precision", choices=("coarse", "wire", "fine"), default="wire")
    options = parser.parse_args()
    rows = [measure(scene, options) for scene in options.scenes]
    figures = [figure for row in rows for figure in figures_of(row)]
    write_result(options.out, "Which parts of a record take the bytes of a package?", figures, {"rows": rows})


if __name__ == "__main__":
    main()
