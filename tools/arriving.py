"""Draw how a scene arrives over a slow link: gsvis beside streamed SOG and one whole file. It heads the README.

    gsvis convert builtin:flat scene.ply
    gsvis prepare scene.ply -o scene.gsvis --levels none --cells 24 --limit 0.4
    gsvis prepare scene.ply -o leveled.gsvis --cells 24 --limit 0.4
    python tools/arriving.py scene.gsvis leveled.gsvis scene.ply

All ways are simulated over the same link with the same walk. Streamed SOG has the levels of the second package; leaves
are loaded by the rule of PlayCanvas' engine; `benchmarks/paper/rivals/leaves.py` says how it is simplified. The whole
file is a compact SPZ in Morton order, the smallest of those that `gsvis simulate` tries. Every image stands beside its
PSNR against the scene.

Given: the built-in flat, its package, a link of 5 Mbit/s and 50 ms, a viewer who stands and turns.
Measured: images, bytes and PSNR of the simulation. The files of the others are drawn as if they lost nothing.
Defaults chosen on: other scenes; eye and link before anything was drawn, times so that the whole file is seen, too.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gsvis.abr import BandwidthTrace, FieldOfView
from gsvis.export.leaves import cut_leaves
from gsvis.io import load_scene
from gsvis.io.spz import save_spz
from gsvis.io.streamed_sog_writer import save_streamed_sog
from gsvis.package.contents import Contents
from gsvis.package.package import Package
from gsvis.package.unpack import unpack_levels
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians, quats_from_rotations
from gsvis.scene.paths import HeadPath
from gsvis.simulate import Delivery, Link, ViewingConfig, morton_order
from gsvis.simulate.baselines import WholeFile
from gsvis.simulate.delivery import Adaptive
from gsvis.simulate.frames import Stage, psnr_of
from gsvis.simulate.playback import play
from gsvis.simulate.viewing import show_at
from gsvis.simulate.visits import Place

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

from _harness import write_result  # noqa: E402
from paper.rivals.leaves import LeafFiles, LeafStream, leaf_sizes  # noqa: E402

QUESTION = "What does a viewer of the built-in flat see over a slow link, by gsvis, streamed SOG and one whole file?"
MBIT, ROUND_TRIP = 5.0, 0.05
TIMES = (0.5, 1.0, 3.0, 7.0)
EYE, TARGET = (5.2, 3.75, 1.6), (1.3, 0.9, 0.95)
SIZE, GAP, LABEL = (440, 275), 6, 30

Image3 = NDArray[np.float32]


def standing(seconds: float) -> HeadPath:
    """Return a viewer who stands and turns by two degrees a second."""
    times = np.linspace(0.0, seconds, 41)
    eyes = np.tile(EYE, (len(times), 1))
    cameras = Cameras.look_at(eyes, np.array(TARGET))
    turn = np.radians(2.0) * (times - times[-1])
    quats = quats_from_rotations(np.swapaxes(cameras.viewmats[:, :3, :3], 1, 2))
    about_up = np.stack([np.cos(turn / 2), 0.0 * turn, 0.0 * turn, np.sin(turn / 2)], axis=1)
    return HeadPath(times, eyes, multiplied(about_up, quats))


def multiplied(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, 4) products of quaternions wxyz."""
    w = a[:, 0] * b[:, 0] - (a[:, 1:] * b[:, 1:]).sum(axis=1)
    xyz = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w[:, None], xyz], axis=1)


def leaf_stream(package: Package, contents: Contents, view: FieldOfView, folder: Path) -> LeafStream:
    """Return the delivery of the levels of a package as streamed SOG, whose files are written to be measured."""
    leaves = cut_leaves(unpack_levels(package))
    written = save_streamed_sog(leaves.as_scene(), folder)
    meta = folder / "lod-meta.json"
    document = json.loads(meta.read_text())
    beside = 0
    if "environment" in document:
        beside = sum(file.stat().st_size for file in (folder / document["environment"]).parent.iterdir())
    sizes = leaf_sizes(written.sizes)
    files = LeafFiles(leaves.of_ids, sizes, meta.stat().st_size, np.asarray(leaves.environment), beside)
    return LeafStream(contents, files, view)


@dataclass(frozen=True, eq=False)
class Way:
    """What a viewer sees of one way to deliver the scene.

    Attributes:
        images: An image for each time, black where there is none yet.
        quality: PSNR of each against the scene, dB.
        nbytes: Bytes that have arrived at each time.
        first: Seconds until the first image.
    """

    images: list[Image3]
    quality: list[float]
    nbytes: list[int]
    first: float


def watch(place: Place, reference: Gaussians, delivery: Delivery, config: ViewingConfig) -> Way:
    """Return what a viewer sees who stands in a scene while it is delivered."""
    stage = Stage(place.contents, reference, place.highest)
    path = standing(max(TIMES) + 1.0)
    playback = play(delivery, Link(BandwidthTrace.constant(MBIT), ROUND_TRIP), path, stage.size, seconds=40.0)
    black = np.zeros((SIZE[1], SIZE[0], 3), np.float32)
    images, quality = [], []
    for t in TIMES:
        full, (seen,) = show_at(stage, [playback], path, t, config)
        image = black if seen is None else seen
        images.append(image)
        quality.append(round(min(psnr_of(image, full), 99.0), 1))
    return Way(images, quality, playback.bytes_at(np.array(TIMES)).astype(int).tolist(), round(playback.first, 2))


def simulate(package: Path, leveled: Path, scene: Path) -> tuple[list[Way], dict[str, Any]]:
    """Return what is seen by gsvis, by streamed SOG and of the whole file, and what the labels say."""
    reference = load_scene(scene)
    config = ViewingConfig(seconds=max(TIMES), width=SIZE[0], height=SIZE[1], fov=80.0)
    with TemporaryDirectory() as folder:
        whole = Path(folder) / "whole.spz"
        save_spz(reference[morton_order(reference.means)], whole, compact=True)
        with Package.open(package) as opened:
            place = Place.open(opened, whole_file=whole, as_is=True)
            ours = watch(place, reference, Adaptive(place.scene, config.view), config)
            nbytes, measured = place.whole_file or (0, "")
            file = WholeFile(place.contents, nbytes, measured, ids=np.flatnonzero(place.highest))
            alone = watch(place, reference, file, config)
        with Package.open(leveled) as opened:
            place = Place.open(opened, as_is=True)
            leaves = leaf_stream(opened, place.contents, config.view, Path(folder) / "sog")
            streamed = watch(place, reference, leaves, config)
    facts = {
        "mbit": MBIT,
        "round_trip_s": ROUND_TRIP,
        "gaussians": len(reference),
        "whole_file_bytes": nbytes,
        "whole_file_complete_s": alone.first,
        "times_s": list(TIMES),
        "gsvis_first_image_s": ours.first,
        "streamed_sog_first_image_s": streamed.first,
    }
    for name, way in (("gsvis", ours), ("streamed_sog", streamed)):
        facts[f"{name}_db"] = way.quality
        facts[f"{name}_bytes"] = way.nbytes
    facts["whole_file_db"] = alone.quality
    return [ours, streamed, alone], facts


def compose(ways: list[Way], facts: dict[str, Any]) -> Image.Image:
    """Return the picture: a row for each way, a column for each time."""
    wide = len(TIMES) * (SIZE[0] + GAP) - GAP
    tall = len(ways) * (SIZE[1] + LABEL + GAP) - GAP
    sheet = Image.new("RGB", (wide, tall), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(17)
    for k, way in enumerate(ways):
        top = k * (SIZE[1] + LABEL + GAP)
        for i, image in enumerate(way.images):
            left = i * (SIZE[0] + GAP)
            sheet.paste(Image.fromarray((image * 255).round().astype(np.uint8)), (left, top + LABEL))
            pen.text((left + 4, top + 6), f"{TIMES[i]:g} s   {label(k, i, facts)}", "#222222", font)
            if not image.any():
                waiting = f"nothing until {facts['whole_file_complete_s']:.1f} s" if k == 2 else "nothing yet"
                pen.text((left + 20, top + LABEL + SIZE[1] // 2), waiting, "#bbbbbb", font)
    return sheet


def label(row: int, column: int, facts: dict[str, Any]) -> str:
    """Return what stands above an image."""
    if row == 2:
        return f"whole file (compact SPZ, {facts['whole_file_bytes'] / 1e6:.1f} MB)"
    key, name = (("gsvis", "gsvis"), ("streamed_sog", "streamed SOG"))[row]
    nbytes, quality = facts[f"{key}_bytes"][column], facts[f"{key}_db"][column]
    return f"{name}: {nbytes / 1e6:.2f} MB, {quality:.0f} dB"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("package", type=Path)
    parser.add_argument("leveled", type=Path, help="package with levels, which streamed SOG has")
    parser.add_argument("scene", type=Path)
    parser.add_argument("--picture", type=Path, default=ROOT / "docs" / "images" / "arriving.jpg")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "arriving.json")
    given = parser.parse_args()
    ways, facts = simulate(given.package, given.leveled, given.scene)
    compose(ways, facts).save(given.picture, quality=88, optimize=True)
    figures = [
        figure("PSNR after 0.5 s, 5 Mbit/s", facts["gsvis_db"][0], "dB", "higher"),
        figure("PSNR after 1 s, 5 Mbit/s", facts["gsvis_db"][1], "dB", "higher"),
        figure("PSNR after 1 s, streamed SOG", facts["streamed_sog_db"][1], "dB", "higher"),
        figure("bytes in 1 s", facts["gsvis_bytes"][1], "bytes", "lower"),
        figure("the smallest whole file is there after", facts["whole_file_complete_s"], "s", "lower"),
    ]
    write_result(given.out, QUESTION, figures, facts)


def figure(name: str, reached: float, unit: str, better: str) -> dict[str, Any]:
    """Return a figure without a target."""
    return {"name": name, "target": None, "reached": reached, "unit": unit, "better": better}


if __name__ == "__main__":
    main()
