"""How small is a whole package, if its records are rounded as coarsely as images keep a wanted PSNR?

Records and terms of packages are rounded anew; visible sets, chunks and manifest stay. Views of the choice are those of
`gsvis prepare --record-psnr`; the judge's eyes are drawn by another seed with another field of view. With photographs
(--photos, as the arena has them: every eighth is held out), they judge too.

Given: packages whose records have all bits; --wanted dB.
Measured: bytes by part, over the SOG of the highest level if it is known (--sog BYTES for each package); PSNR of the
    rounded against the whole records; PSNR of both against held-out photographs.
Defaults chosen on: nika LOD 1 (how many bits each kind of field lacks).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, write_result
from numpy.typing import NDArray

from gsvis.color.evaluate import Evaluator
from gsvis.package import Contents, Package, Spread
from gsvis.package.blocks import bytes_of_blocks
from gsvis.package.manifest import MANIFEST
from gsvis.package.rounding import round_records, round_terms
from gsvis.prepare import PrepareConfig
from gsvis.prepare.record_limits import cameras_of_choice, search_limits
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.photos import load_photos

JUDGES = ViewSampling(12, 480, 360, 90.0, seed=77, stream=8)
PHOTO_SIZE = 200, 133
EVERY = 8
OVER_SOG = 1.3  # wanted in the median

Images = list[NDArray[np.float32]]


def drawn(contents: Contents, cameras: Cameras) -> Images:
    """Return images of the highest level."""
    highest = np.flatnonzero(contents.last == len(contents.names) - 1)
    g = contents.gaussians(highest)
    shown = Evaluator(contents.colors().dequantize()[highest])
    found = []
    for c in range(len(cameras)):
        colors = shown.colors(g.means, cameras[c].viewpoints[0])
        found.append(np.clip(rasterize(g, cameras[c], colors=colors).images[0], 0.0, 1.0))
    return found


def spread(images: Images, truth: Images) -> Spread:
    """Return mean and worst PSNR."""
    return Spread.from_values([min(100.0, float(psnr(a, b))) for a, b in zip(images, truth, strict=True)])


def measure(path: Path, sog: int, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of a package: as it is, and for each wanted PSNR."""
    with Package.open(path) as package:
        contents = package.contents
        sizes = package.manifest.sizes()
        up = package.manifest.info.up
    sets = sizes["visibility"]
    rest = sizes["chunks"] + sets + (path / MANIFEST).stat().st_size
    levels = contents.levels()
    space = NavigableSpace.from_scene(levels.level(len(levels) - 1), up=up)
    choice = cameras_of_choice(levels, space, PrepareConfig.cost_views, options.photos)
    whole = [drawn(contents, cameras) for cameras in choice]
    judges = JUDGES.cameras(levels, space)
    truth = drawn(contents, judges)
    photos = None if options.photos is None else load_photos(options.photos, size=PHOTO_SIZE).views.split(EVERY)[1]

    def judge(rounded: Contents) -> Spread:
        """Return the PSNR by the rule of the choice with the least."""
        found = [spread(drawn(rounded, cameras), images) for cameras, images in zip(choice, whole, strict=True)]
        return Spread(min(each.psnr for each in found), min(each.worst for each in found))

    rows = []
    for wanted in (None, *options.wanted):
        rounded = contents
        if wanted is not None:
            limits = search_limits(contents, judge, wanted).limits
            if limits is None:
                continue
            rounded = round_terms(round_records(contents, limits), limits)
        blocks = bytes_of_blocks(rounded)
        terms = bytes_of_blocks(replace(rounded, term_counts=rounded.term_counts * 0, term_records=_none(rounded)))
        row: dict[str, Any] = {"package": path.name, "wanted": wanted, "gaussians": len(contents)}
        row |= {"records": terms, "terms": blocks - terms, "sets": sets, "all": blocks + rest}
        row |= {"over sog": (blocks + rest) / sog if sog else None}
        row |= {f"{name} dB": value for name, value in spread(drawn(rounded, judges), truth).as_dict().items()}
        if photos is not None:
            targets = [photos.images[k] / np.float32(255.0) for k in range(len(photos))]
            row["photographs dB"] = spread(drawn(rounded, photos.cameras), targets).psnr
        print(row, flush=True)
        rows.append(row)
    return rows


def _none(contents: Contents) -> NDArray[np.uint8]:
    """Return the records of no terms."""
    return np.zeros((0, contents.term_records.shape[1]), np.uint8)


def figures_of(row: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of a row."""
    label = f"{row['package']}, {'all bits' if row['wanted'] is None else format(row['wanted'], 'g') + ' dB'}"
    found: list[tuple[str, float | None, float, str, str]] = [
        (f"{label}: whole package", None, row["all"] / 1e6, "MB", "lower")
    ]
    if row["over sog"] is not None:
        found.append((f"{label}: over the SOG of its highest level", OVER_SOG, row["over sog"], "times", "lower"))
    found.append((f"{label}: sets", 0.2, row["sets"] / row["all"], "of the bytes", "lower"))
    found.append((f"{label}: against all bits", row["wanted"], row["psnr dB"], "dB", "higher"))
    if "photographs dB" in row:
        found.append((f"{label}: against held-out photographs", None, row["photographs dB"], "dB", "higher"))
    return [{"name": n, "target": t, "reached": float(v), "unit": u, "better": b} for n, t, v, u, b in found]


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("packages", nargs="+", type=Path, metavar="PACKAGE")
    parser.add_argument("--sog", nargs="*", type=int, default=[], metavar="BYTES")
    parser.add_argument("--wanted", nargs="+", type=float, default=[48.0], metavar="DB")
    parser.add_argument("--photos", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    sog = (*options.sog, *(0 for _ in options.packages))
    rows = [row for path, size in zip(options.packages, sog, strict=False) for row in measure(path, size, options)]
    figures = [figure for row in rows for figure in figures_of(row)]
    question = "How small is a whole package, if its records are rounded as coarsely as images keep a wanted PSNR?"
    write_result(options.out, question, figures, {"rows": rows})


if __name__ == "__main__":
    main()
