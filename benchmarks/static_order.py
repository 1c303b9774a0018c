"""How many bytes does a static site need when its page knows where the light is that a cell sees?

A part counts by a sphere of all its light and by one of the light that pictures in the cell show (docs/static.md). The
page's own reader (TypeScript, run by node) reads one site with several shares of the second in place of its own, on a
link of 10 Mbit/s with a round trip of 40 ms. All orders have the same eyes, and no server: eyes differ much more than
orders, so orders are compared eye by eye. Eyes are those of `static_site.py`.

Given: a package with visible sets (--package), eyes in --eyes cells for each of --seeds.
Measured: bytes until the image of what has come reaches 25 and 35 dB, 320 x 224, 90 degrees wide, summed over eyes,
    over those with share 0; its 95% interval by drawing eyes again; in how many eyes it is more.
Defaults chosen on: 27 eyes of seeds 77, 2029 and 5077.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from _reader import build_reader
from static_site import Eye, first_bytes, is_drawn, name_arrivals, package_ids, trace, views_of

from gsvis.color.evaluate import Evaluator
from gsvis.export import write_static
from gsvis.package import Package

TARGETS = (25.0, 35.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_arguments(parser)
    parser.add_argument("--package", help="folder of a package with visible sets")
    parser.add_argument("--eyes", type=int, default=16)
    parser.add_argument("--seeds", type=int, nargs="+", default=[9001, 9002])
    parser.add_argument("--shares", type=float, nargs="+", default=[0.0, 0.5, 1.0])
    args = parser.parse_args()
    need(args.package, "--package, that `gsvis prepare` makes")
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as made_in, Package.open(args.package) as package:
        folder = Path(made_in)
        readers = {share: build_reader(folder, f"reader-{share:g}", SEEN=share) for share in args.shares}
        static = write_static(folder / "scene", package)
        contents, ids = package.contents, package_ids(package)
        evaluator = Evaluator(contents.colors().dequantize())
        views, eyes = [], []
        for seed in args.seeds:
            for view, camera in zip(*views_of(package, args.eyes, np.random.default_rng(seed)), strict=True):
                eye = Eye(contents, evaluator, camera)
                if is_drawn(package, eye, view["pose"]):
                    views.append(view)
                    eyes.append(eye)
        for share, script in readers.items():
            for number, (eye, steps) in enumerate(zip(eyes, trace(static.path, views, script), strict=True)):
                name_arrivals(steps, ids, contents)
                found = first_bytes(eye, steps)
                sizes = {str(target): found.get(target, (steps[-1]["bytes"], 0))[0] for target in TARGETS}
                rows.append({"eye": number, "share": share, **sizes})
            print(share, [row[str(TARGETS[-1])] for row in rows if row["share"] == share], flush=True)
    write_result(args.out, __doc__.splitlines()[0], figures_of(rows, args.shares), {"eyes": rows})


def figures_of(rows: list[dict[str, Any]], shares: list[float]) -> list[dict[str, Any]]:
    """Return the bytes of each share over those of the first one."""
    out: list[dict[str, Any]] = []
    for target in TARGETS:
        sizes = {share: np.array([row[str(target)] for row in rows if row["share"] == share]) for share in shares}
        before = sizes[shares[0]]
        for share in shares[1:]:
            now = sizes[share]
            drawn = np.random.default_rng(0).integers(0, len(now), (4000, len(now)))
            low, high = np.quantile(now[drawn].sum(axis=1) / before[drawn].sum(axis=1), [0.025, 0.975])
            more = int((now > 1.01 * before).sum())
            of = f"share {share:g}, {len(now)} eyes: bytes until {target:.0f} dB"
            name = f"{of}, over share 0; {low:.2f} to {high:.2f}, {more} eyes need more"
            out.append(
                {
                    "name": name, "target": None, "reached": float(now.sum() / before.sum()), "unit": "x",
                    "better": "lower", "worst": float((now / before).max()),
                }
            )  # fmt: skip
    return out


if __name__ == "__main__":
    main()
