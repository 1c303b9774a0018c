"""What do the validators say of 3D Tiles that gsvis writes?

`3d-tiles-validator` checks `tileset.json` and hands each content to `gltf-validator`. The latter does not know
KHR_gaussian_splatting as of version 2.0.0-dev.3.10: it takes the names of its attributes, which hold a colon, for
errors. So errors of names of the extension are counted apart from all others.

Given: flowers LOD 1 and showroom LOD 3, plain and SPZ-compressed; visible sets of showroom for its request volumes
    (`--work` of `tiles.py`).
Measured: issues of the tileset itself; errors and warnings of contents; of these, names of the extension.
Defaults chosen on: nothing.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from _harness import add_arguments, need, realdata, write_result

from gsvis.export.tiles import TilesOptions, write_tiles
from gsvis.io import load_scene
from gsvis.pvs import VisibilityStore

SCENES = {"flowers": ("flowers_sh2", 1, (0.0, -1.0, 0.0)), "showroom": ("showroom", 3, (0.0, 0.0, 1.0))}


def issues_of(listed: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield issues that have no causes of their own."""
    for issue in listed:
        if issue.get("causes"):
            yield from issues_of(issue["causes"])
        else:
            yield issue


def validate(command: list[str], folder: Path, report: Path) -> Counter[str]:
    """Return how many issues of each kind the validator finds."""
    words = [*command, "-t", str(folder / "tileset.json"), "--reportFile", str(report)]
    subprocess.run(words, check=True, capture_output=True)
    found: Counter[str] = Counter()
    for issue in issues_of(json.loads(report.read_text())["issues"]):
        kind = str(issue["severity"]).lower()
        named = issue["message"] == "Invalid attribute name." and "KHR_gaussian_splatting:" in issue["path"]
        place = "content" if str(issue["type"]).startswith("CONTENT_") else "tileset"
        found[f"{place} {'name of the extension' if named else kind}"] += 1
    return found


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--work", type=Path, help="folder for tilesets; showroom.pvs in it gives volumes")
    parser.add_argument("--validator", default="npx 3d-tiles-validator", help="command that runs it")
    args = parser.parse_args()
    need(args.work, "--work DIR: a folder for tilesets")
    realdata()
    args.work.mkdir(parents=True, exist_ok=True)
    cases: dict[str, dict[str, int]] = {}
    total: Counter[str] = Counter()
    contents = 0
    for name, (folder, lod, up) in SCENES.items():
        g = load_scene(realdata() / "scenes" / folder / "lod-meta.json", lod=lod)
        sets = args.work / f"{name}.pvs"
        for compression in ("none", "spz"):
            store = VisibilityStore.open(sets, scene=g) if sets.exists() else None
            options = TilesOptions(up=up, compression=compression, request_volumes=store is not None)
            case = f"{name}, {compression}" + (", with volumes" if store else "")
            out = args.work / f"{name}-valid"
            report = write_tiles(out, g, options, visibility=store, overwrite=True)
            if store is not None:
                store.close()
            found = validate(shlex.split(args.validator), out, args.work / f"{name}.json")
            cases[case], contents = dict(sorted(found.items())), contents + report.tiles
            total += found
            print(case, cases[case], flush=True)
    own = {"tileset error", "tileset warning", "tileset info"}
    rows = [
        ("issues of tilesets", 0, sum(total[key] for key in own), "issues"),
        ("errors and warnings of contents", 0, total["content error"] + total["content warning"], "issues"),
        ("names of the extension, unknown to gltf-validator", None, total["content name of the extension"], "errors"),
        ("contents", None, contents, "files"),
    ]
    keys = ("name", "target", "reached", "unit")
    figures = [{**dict(zip(keys, row, strict=True)), "better": "lower"} for row in rows]
    write_result(args.out, "What do the validators say of 3D Tiles that gsvis writes?", figures, {"cases": cases})


if __name__ == "__main__":
    main()
