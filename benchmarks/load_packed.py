"""How fast are SPZ and compressed PLY read, beside gsply, and how large is an SPZ beside splat-transform's?

Reading: the real scenes of the formats, file cache warm, turn by turn. gsply hands over logarithms of scales and
logits of opacities, does not scale quaternions to unit length, checks no value and leaves an SPZ in the frame of the
file. So it is timed twice: as it is, and with its own `apply_pre_activations`, after which both hold the same values,
but for signs of the other frame. That second ratio is like for like; the checks of every value are in our time alone.
gsply works on all threads, gsvis on one: seconds of the processor stand beside those of the clock. Writing: bytes of an
SPZ of the same scene, as it is and compact, over those of splat-transform (npm `@playcanvas/splat-transform`), and the
error of all three in images of the scene.

Given: the scenes, and the two peers as they are.
Measured: seconds, bytes, and PSNR against the scene before it was written.
Defaults chosen on: nika and flowers, for what an SPZ keeps.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gsply
import numpy as np
from _harness import add_arguments, measure_in_turn, realdata, write_result

from gsvis.io import load_scene
from gsvis.io.spz import load_spz, save_spz
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

FILES = ("biker.spz", "biker.compressed.ply", "guitar.compressed.ply")
WRITTEN = {
    "biker": ("formats/biker.compressed.ply", None),
    **{f"nika LOD {lod}": ("nika_sh3/lod-meta.json", lod) for lod in (1, 2, 3)},
    "flowers LOD 3": ("flowers_sh2/lod-meta.json", 3),
}
VIEWS, WIDTH, HEIGHT = 6, 320, 240


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--repeats", type=int, default=31)
    parser.add_argument("--splat-transform", type=Path, help="its command; without it sizes are not compared")
    options = parser.parse_args()
    scenes = realdata() / "scenes"
    figures, reading = [], {}
    for name in FILES:
        reading[name] = read(scenes / "formats" / name, options.repeats)
        for peer, target in (("gsply with activations", 1.5), ("gsply as it is", None)):
            ratio = reading[name]["gsvis"].median / reading[name][peer].median
            figures.append(figure(f"{name}: reading over {peer}", target, ratio, "times"))
    writing: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, (path, lod) in WRITTEN.items():
            writing[name] = write(load_scene(scenes / path, lod), Path(folder), options.splat_transform)
            for kind in ("as it is", "compact"):
                if "splat-transform" in writing[name]:
                    ratio = writing[name][kind]["bytes"] / writing[name]["splat-transform"]["bytes"]
                    target = 1.01 if kind == "compact" else None
                    figures.append(figure(f"{name}: SPZ {kind} over splat-transform's", target, ratio, "of the bytes"))
    notes = [
        "Input: the scenes. Measured: seconds, bytes, PSNR against the scene before it was written.",
        "gsply as it is leaves undone: exp of scales, sigmoid of opacities, unit quaternions, the frame of an SPZ, and "
        "checks of the values.",
        "splat-transform writes an SPZ in the frame of the PLY, not right-up-back as the format's README and biker.spz "
        "have it: its file is turned half about x before the comparison.",
        "Streams of alphas, colors and scales have equal sizes in both; as it is has 16 bits behind the point where "
        "splat-transform has 12, and 8 bits of SH where it has 5 and 4: that is the whole difference in size.",
    ]
    details = {"reading": reading, "writing": writing, "notes": notes, "gsply": gsply.__version__}
    details |= {"views": VIEWS, "width": WIDTH, "height": HEIGHT}
    question = "How fast are SPZ and compressed PLY read, and how large is an SPZ?"
    write_result(options.out, question, figures, details)


def figure(name: str, target: float | None, reached: float, unit: str) -> dict[str, Any]:
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": "lower"}


def read(path: Path, repeats: int) -> dict[str, Any]:
    """Timings of each reader, and how far apart their values are."""
    plain = gsply.read_spz if path.suffix == ".spz" else gsply.plyread
    readers: dict[str, Callable[[], Any]] = {
        "gsvis": lambda: load_scene(path),
        "gsply with activations": lambda: gsply.apply_pre_activations(plain(path)),
        "gsply as it is": lambda: plain(path),
    }
    found: dict[str, Any] = {**measure_in_turn(readers, repeats, warmup=3)}
    found["processor_s"] = {name: processor_seconds(reader) for name, reader in readers.items()}
    ours, theirs = readers["gsvis"](), readers["gsply with activations"]()
    found["largest_difference"] = {
        name: float(np.abs(np.abs(getattr(ours, name).reshape(len(ours), -1)) - np.abs(other)).max())
        for name in ("means", "quats", "scales", "opacities", "sh0")
        for other in [getattr(theirs, name).reshape(len(ours), -1)]
    }
    return found


def processor_seconds(fn: Callable[[], Any], repeats: int = 11) -> float:
    """Least seconds of the processor, all threads, that a call takes."""
    taken = []
    for _ in range(repeats):
        began = time.process_time()
        fn()
        taken.append(time.process_time() - began)
    return min(taken)


def write(scene: Gaussians, folder: Path, peer: Path | None) -> dict[str, Any]:
    """Bytes and PSNR of each SPZ of a scene."""
    paths = {"as it is": folder / "fine.spz", "compact": folder / "compact.spz"}
    for kind, path in paths.items():
        save_spz(scene, path, compact=kind == "compact")
    if peer is not None:
        from gsvis.io.ply import save_ply

        save_ply(scene, folder / "scene.ply")
        paths["splat-transform"] = folder / "peer.spz"
        words = [str(peer), "-q", "-w", "-g", "cpu", str(folder / "scene.ply"), str(paths["splat-transform"])]
        subprocess.run(words, check=True)
    middle, size = scene.bounds(0.8).mean(axis=0), np.linalg.norm(np.diff(scene.bounds(0.8), axis=0))
    around = Cameras.orbit(middle, 0.6 * size, VIEWS, width=WIDTH, height=HEIGHT, fov=60.0)
    wanted = drawn(scene, around)
    found = {"gaussians": len(scene), "sh_degree": scene.sh_degree}
    for kind, path in paths.items():
        got = load_spz(path)
        if kind == "splat-transform":
            got = got.transform(np.diag([1.0, -1.0, -1.0]))
        error = float(np.mean((drawn(got, around) - wanted) ** 2))
        found[kind] = {"bytes": path.stat().st_size, "psnr": -10.0 * float(np.log10(error))}
    return found


def drawn(scene: Gaussians, cameras: Cameras) -> np.ndarray:
    return np.stack([np.clip(rasterize(scene, cameras[k : k + 1]).images, 0.0, 1.0) for k in range(len(cameras))])


if __name__ == "__main__":
    main()
