"""How near does what a client ends with come to the scene as it came, and which part of the way costs most?

Packages of `gsvis prepare` against the scenes they were made of, in the 12 views that the manifest keeps, or where it
has none in those that `gsvis prepare` would draw: nothing was fitted to them. Every record of the highest level, then
only what the cell of each eye needs. Terms and rounding apart are those that `gsvis prepare` measured.

Given: packages made with the defaults (`--packages`), their scenes.
Measured: PSNR over views, mean and worst.
Defaults chosen on: nika, in other views; showroom has no terms.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from _harness import add_arguments, need, write_result
from _packaged import open_original

from gsvis.package import Package, measure_fidelity
from gsvis.prepare import PrepareConfig
from gsvis.scene.navigable import NavigableSpace

WANTED = {"nika": 48.0, "showroom": 50.0}
APART = 6.0
"""Wanted PSNR, dB, and by how much the worst view may be below the mean."""


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--packages", nargs="*", metavar="NAME=PACKAGE", help="a package, under a name of your choice")
    arguments = parser.parse_args()
    need(arguments.packages, "--packages NAME=PACKAGE, as `gsvis prepare` made them")
    figures, found = [], {}
    for given in arguments.packages:
        name, _, folder = given.partition("=")
        g = open_original(folder).gaussians
        with Package.open(Path(folder)) as package:
            told = package.manifest.info.fidelity
            if told is None:
                space = NavigableSpace.from_scene(g, up=package.manifest.info.up)
                cameras = PrepareConfig.fidelity_views.cameras(g, space)
            else:
                cameras = told.cameras
            now = measure_fidelity(g, package.contents, cameras, sets=package.visibility, active=package.active_terms)
            found[name] = {
                **now.summary(),
                "told": None if told is None else told.summary(),
                "version": package.manifest.version,
            }
        spreads = [("every record", now.records, WANTED.get(name)), ("what a cell needs", now.cell, None)]
        if told is not None:
            spreads += [(f"{step} alone", spread, None) for step, spread in told.steps.items()]
        for what, spread, wanted in spreads:
            if spread is None:
                continue
            for which, value, target in (
                ("mean", spread.psnr, wanted),
                ("worst view", spread.worst, spread.psnr - APART if wanted else None),
            ):
                row = {"name": f"{name}, {what}: {which}", "target": target, "reached": value}
                figures.append({**row, "unit": "dB", "better": "higher"})
    write_result(arguments.out, "How near does what a client ends with come to the scene as it came?", figures, found)


if __name__ == "__main__":
    main()
