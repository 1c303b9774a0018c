"""How many bytes does a package take on disk, part by part, and how many does SOG take for the same scene?

Packages that `gsvis prepare` made of nika LOD 1 and showroom LOD 3, with three levels (`--packages`). The records and
terms of each are coded as packages of version 3 have them. Beside that: the same as Arrow columns under zstd, as
version 2 had them; zstd level 19 on planes of bytes, part by part; and the coder of the wire with tables for each part.
Rivals: the SOG files of the same LOD as they came, with SH; what `save_scene` writes as SOG of the same LOD; and SOG of
each level of the package, base colors alone. SOG has no visible sets, so sums with and without them are given.

Time: all records and terms read from a folder of each version in turn, and a scene opened for streaming.

Given: packages, SOG files of the scenes they were made of.
Measured: bytes by what they hold, bytes a Gaussian, seconds to read and to open.
Defaults chosen on: the contexts of the coder on these two scenes; flowers was not looked at.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from _harness import add_arguments, measure_in_turn, need, realdata, write_result

from gsvis.io import load_scene, save_scene
from gsvis.package import Contents, Package
from gsvis.package.blocks import write_blocks
from gsvis.package.manifest import MANIFEST, Blob
from gsvis.package.package import PARTS, columns_of
from gsvis.package.parts import MOST_BYTES, PartFolder
from gsvis.package.rounding import chunks_of
from gsvis.progress import silent
from gsvis.stream import StreamedScene
from gsvis.stream.coding import Coding

SCENES = {"nika": ("nika_sh3", 1), "showroom": ("showroom", 3), "flowers": ("flowers_sh2", 2)}
KINDS = ("records", "chunks", "terms")


def rewritten(package: Package, folder: Path) -> Path:
    """Write a package in the newest version, and return its folder."""
    contents, parts = package.contents, PartFolder(folder / PARTS)
    columns, sets = columns_of(contents.table, contents.chunk_levels), package.visibility.path.read_bytes()
    pieces = tuple(parts.write_bytes(sets[at : at + MOST_BYTES]) for at in range(0, len(sets), MOST_BYTES))
    manifest = replace(
        package.manifest, tables=((parts.write_columns("chunks", columns), len(contents.table)),),
        blocks=tuple(write_blocks(parts, contents, silent)), visibility=Blob(pieces, len(sets)), active_terms=None,
        info=replace(package.manifest.info, epsilon=package.epsilon), version=3,
    )  # fmt: skip
    (folder / MANIFEST).write_bytes(manifest.to_json())
    return folder


def other_coders(contents: Contents) -> dict[str, int]:
    """Bytes of records and terms under zstd on planes of bytes, and under the coder of the wire, part by part."""
    pack, found = zstandard.ZstdCompressor(19).compress, {"zstd": 0, "wire": 0}
    owners, offsets = np.repeat(np.arange(len(contents), dtype=np.int32), contents.term_counts), contents.term_offsets
    for low, high in pairwise(contents.starts.tolist()):
        some, terms = slice(low, high), slice(*offsets[[low, high]].tolist())
        planes = [contents.records[some].T, contents.term_counts[some], contents.term_records[terms].T]
        found["zstd"] += sum(len(pack(np.ascontiguousarray(each).tobytes())) for each in planes if each.size)
        ids, table = np.arange(low, high), contents.table
        rows = slice(*np.searchsorted(table.starts, [low, high]).tolist())
        part = replace(
            contents, table=table[rows], chunk_levels=contents.chunk_levels[rows], records=contents.records[some],
            term_counts=contents.term_counts[some], term_records=contents.term_records[terms],
            starts=np.array([0, high - low]),
        )  # fmt: skip
        code = Coding.from_contents(part)
        records = code.encode_records(part.records, ids - low, part.chunks, chunks_of(part.table))
        coded = code.encode_terms(part.term_records, owners[terms] - low)
        found["wire"] += len(code.tables.to_text()) * 3 // 4 + len(records) + len(coded)
    return found


def sog_bytes(name: str, package: Package, place: Path) -> dict[str, int]:
    """Bytes of SOG of the same scene: as it came, as we write it, and of all levels with base colors alone."""
    folder, lod = SCENES[name]
    scene = realdata() / "scenes" / folder
    files = json.loads((scene / "lod-meta.json").read_bytes())["filenames"]
    whole = [scene / file for file in files if Path(file).parts[0].startswith(f"{lod}_")]
    came = sum(path.stat().st_size for file in whole for path in file.parent.iterdir())
    save_scene(load_scene(scene / "lod-meta.json", lod=lod), place / "whole.sog")
    levels, bases = package.contents.levels(), 0
    for k in range(len(levels)):
        save_scene(levels.level(k), place / "level.sog")
        bases += (place / "level.sog").stat().st_size
    return {"as it came": came, "as we write it": (place / "whole.sog").stat().st_size, "levels, base colors": bases}


def measure(name: str, folder: Path) -> dict[str, Any]:
    """Return all sizes and times of one scene."""
    with tempfile.TemporaryDirectory() as place, Package.open(folder) as package:
        made = rewritten(package, Path(place) / "new.gsvis")
        with Package.open(made) as now:
            assert np.array_equal(now.contents.records, package.contents.records)
            assert np.array_equal(now.contents.term_records, package.contents.term_records)
            sizes = {**now.manifest.sizes(), "manifest": (made / MANIFEST).stat().st_size}
        before = {**package.manifest.sizes(), "manifest": (folder / MANIFEST).stat().st_size}
        versions = {"before": folder, "now": made} if package.manifest.version == 2 else {"now": made}
        reads = {key: lambda path=path: Package.open(path).contents for key, path in versions.items()}
        opens = {key: lambda path=path: StreamedScene.open(path) for key, path in versions.items()}
        m = package.manifest
        return {
            "gaussians": m.gaussians, "highest_level": m.counts[-1], "terms": m.terms, "levels": dict(
                zip(m.names, m.counts, strict=True)
            ),
            "bytes": sizes, "bytes_before": before, "coders": other_coders(package.contents),
            "sog": sog_bytes(name, package, Path(place)),
            "read": measure_in_turn(reads, repeats=5), "opened": measure_in_turn(opens, repeats=3),
        }  # fmt: skip


def figures(name: str, found: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of one scene."""
    sizes, sog, n, top = found["bytes"], found["sog"], found["gaussians"], found["highest_level"]
    scene, came = sum(sizes[kind] for kind in KINDS), sog["as it came"]
    base, levels = sizes["records"] + sizes["chunks"], sum(found["levels"].values())

    def figure(what: str, reached: float, unit: str, target: float | None = None) -> dict[str, Any]:
        return {"name": f"{what}, {name}", "target": target, "reached": reached, "unit": unit, "better": "lower"}

    rows = [
        figure("records, rows of chunks and terms of all levels, target SOG of the highest", scene, "bytes", came),
        figure("the same with visible sets and manifest", sum(sizes.values()), "bytes", came),
        figure("a package of version 2", sum(found["bytes_before"].values()), "bytes"),
        figure("a Gaussian with its terms, target SOG", scene / n, "bytes", came / top),
        figure("a Gaussian without terms", base / n, "bytes"),
        figure("records of all levels without terms, target SOG of each level, base colors", base, "bytes",
               sog["levels, base colors"]),
        figure("SOG as gsvis writes it, the highest level", sog["as we write it"], "bytes"),
        figure("SOG of each level, base colors", sog["levels, base colors"] / levels, "bytes a Gaussian"),
        figure("records and terms under zstd 19, over coded", found["coders"]["zstd"] / (scene - sizes["chunks"]), "x"),
        figure("under the coder of the wire, over coded", found["coders"]["wire"] / (scene - sizes["chunks"]), "x"),
    ]  # fmt: skip
    if found["terms"]:
        rows.append(figure("a term", sizes["terms"] / found["terms"], "bytes"))
    for key, what in (("read", "to read all records and terms"), ("opened", "to open for streaming")):
        if "before" in found[key]:
            rows.append(
                figure(f"seconds {what}, over version 2", found[key]["now"].median / found[key]["before"].median, "x")
            )
        rows.append(figure(f"seconds {what}", found[key]["now"].median, "s"))
    return rows


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--packages", nargs="*", default=[], metavar="NAME=DIR", help="nika, showroom, flowers")
    options = parser.parse_args()
    need(options.packages, "packages of these scenes from gsvis prepare (--packages nika=DIR showroom=DIR)")
    found = {name: measure(name, Path(folder)) for name, _, folder in (row.partition("=") for row in options.packages)}
    write_result(
        options.out,
        "How many bytes does a package take on disk, and how many does SOG take?",
        [row for name, each in found.items() for row in figures(name, each)],
        found,
    )


if __name__ == "__main__":
    main()
