"""How much of their light do eyes outside get from inside a space that `gsvis cut --from-outside` has opened?

Each scene is opened to above with the defaults of the command. Other eyes than those of the cut look down on it, on two
circles around the middle of its eyes, and the share of their light that comes from inside is measured: in pixels that
look through the opening, from Gaussians that eyes inside see. As a peer, everything above the highest place where eyes
inside may be is left out, as a clip plane does.

Given: the two rooms, the flat, and showroom LOD 3 where there is one.
Measured: that share before, opened, and clipped; the share of the Gaussians that eyes inside see which goes.
Defaults chosen on: the two rooms and the flat; showroom was looked at once the rules stood. That columns must join
    those of eyes was added after the flat, whose garden has trees. The circles decided nothing.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from numpy.typing import NDArray
from PIL import Image

from gsvis.edit import EyesInSpace, OutsideCut, cut_from_outside
from gsvis.edit.outside import light_from_inside
from gsvis.io.sources import load_source
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.place import PlaceConfig, find_place

AIM = 0.95  # of the light
ELEVATIONS = (35.0, 60.0)
ON_A_CIRCLE = 6
SIZE = (480, 360)
FOV = 45.0


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--pictures", type=Path, help="folder for pictures before and after")
    options = parser.parse_args()
    scenes: list[tuple[str, str, int | None]] = [
        ("two rooms", "builtin:two_rooms", None), ("flat", "builtin:flat", None),
        ("showroom", str(realdata() / "scenes" / "showroom" / "lod-meta.json"), 3),
    ]  # fmt: skip
    figures = []
    details = {}
    for name, source, lod in scenes:
        loaded = load_source(source, lod)
        space = find_place(loaded, PlaceConfig()).space
        assert space is not None
        found, rows = measure(loaded.gaussians, space)
        details[name] = {**rows, **found.as_dict()}
        figures += figures_of(name, rows)
        if options.pictures:
            draw(options.pictures / f"{name.replace(' ', '_')}.jpg", loaded.gaussians, found, judges(space))
    write_result(options.out, "How much of their light do eyes outside get from inside?", figures, details)


def judges(space: NavigableSpace) -> Cameras:
    """Return cameras on circles that look at the middle of the eyes of a space from above."""
    places = space.origin + (np.argwhere(space.free) + 0.5) * space.voxel_size
    middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
    radius = 0.5 * float(np.linalg.norm(np.ptp(places, axis=0))) / np.sin(np.radians(0.35 * FOV))
    rings = [
        Cameras.orbit(middle, radius, ON_A_CIRCLE, up=space.up, elevation=each, width=SIZE[0], height=SIZE[1], fov=FOV)
        for each in ELEVATIONS
    ]
    return Cameras(np.concatenate([ring.viewmats for ring in rings]), np.concatenate([r.Ks for r in rings]), *SIZE)


def measure(g: Gaussians, space: NavigableSpace) -> tuple[OutsideCut, dict[str, Any]]:
    """Return what is kept of a scene, and what other eyes outside get of it and of a clipped scene."""
    start = time.perf_counter()
    found = cut_from_outside(g, EyesInSpace(space))
    seconds = time.perf_counter() - start
    places = space.origin + (np.argwhere(space.free) + 0.5) * space.voxel_size
    under = g.means @ space.up <= (places @ space.up).max() + 0.5 * space.voxel_size
    inside = found.inside.kept & ~found.blocking
    cameras = judges(space)
    shares = {
        "before": light_from_inside(g, inside, found.opening, cameras),
        "opened": light_from_inside(g[found.kept], inside[found.kept], found.opening, cameras),
        "clipped": light_from_inside(g[under], inside[under], found.opening, cameras),
    }
    gone = {"opened": ~found.kept, "clipped": ~under}
    return found, {
        "seconds": seconds,
        "light": {name: np.round(values, 4) for name, values in shares.items()},
        "gone": {name: float(np.mean(mask[found.inside.kept])) for name, mask in gone.items()},
    }


def figures_of(scene: str, rows: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of a scene."""
    figures = []
    for name, values in rows["light"].items():
        target = AIM if name == "opened" else None
        figures += [
            figure(f"{scene}: light from inside, {name}, mean", target, float(np.mean(values)), "higher"),
            figure(f"{scene}: light from inside, {name}, least", None, float(np.min(values)), "higher"),
        ]
    for name, share in rows["gone"].items():
        figures.append(figure(f"{scene}: of what eyes inside see goes, {name}", None, share, "lower"))
    return figures


def figure(name: str, target: float | None, reached: float, better: str) -> dict[str, Any]:
    """Return one figure."""
    return {"name": name, "target": target, "reached": reached, "unit": "share", "better": better}


def draw(path: Path, g: Gaussians, found: OutsideCut, cameras: Cameras) -> None:
    """Write a picture of two views, before on the left and opened on the right."""
    rows: list[NDArray[np.float32]] = []
    for c in (1, ON_A_CIRCLE + 3):
        pictures = [rasterize(each, cameras[c], backend="cpu").images[0] for each in (g, g[found.kept])]
        rows.append(np.clip(np.concatenate(pictures, axis=1), 0.0, 1.0))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255.0 * np.concatenate(rows) + 0.5).astype(np.uint8)).save(path, quality=88)


if __name__ == "__main__":
    main()
