"""Do other programs read the same numbers in a .ksplat as gsvis, and how close is it to the scene?

Each scene is written at each compression and read by gsvis, by GaussianSplats3D, whose format it is (npm
`@mkkellogg/gaussian-splats-3d`, under Node), and by splat-transform (npm `@playcanvas/splat-transform`). The other way
round GaussianSplats3D writes a file of two sections or more, and both read it. Images of what was written are compared
with images of the scene, beside SPZ and SOG.

Given: nika, flowers and biker, and the two peers as they are.
Measured: the largest differences of values between readers, bytes, and PSNR against the scene.
Defaults chosen on: nika, for the size of a block.
"""

from __future__ import annotations

import argparse
import logging
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, realdata, write_result

from gsvis.io import load_scene, save_scene
from gsvis.io.ksplat import load_ksplat, save_ksplat
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0

SCENES = {
    "nika LOD 2": ("nika_sh3/lod-meta.json", 2),
    "flowers LOD 3": ("flowers_sh2/lod-meta.json", 3),
    "biker": ("formats/biker.spz", None),
}
VIEWS, WIDTH, HEIGHT = 6, 320, 240
SCRIPT = Path(__file__).with_name("_ksplat.mjs")


def main() -> None:
    logging.disable(logging.WARNING)  # of SH degree 3, once a file
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--node-modules", type=Path, help="folder of the two peers and of three")
    options = parser.parse_args()
    need(options.node_modules, "--node-modules DIR, where npm has installed the peers and three")
    modules = options.node_modules.resolve()
    figures: list[dict[str, Any]] = []
    found: dict[str, Any] = {}
    for name, (path, lod) in SCENES.items():
        scene = load_scene(realdata() / "scenes" / path, lod)
        with tempfile.TemporaryDirectory() as folder:
            found[name] = look(scene, Path(folder), modules)
    for reader in ("GaussianSplats3D", "splat-transform", "GaussianSplats3D, its own files"):
        worst = max(each["differences"][reader] for one in found.values() for each in one["levels"].values())
        figures.append(figure(f"largest difference to {reader}", 1e-5, worst, "of the value", "lower"))
    for name, one in found.items():
        for level, each in one["levels"].items():
            what, theirs = f"{name}: compression {level}", each["psnr of GaussianSplats3D"]
            figures.append(figure(what, None, each["psnr"], "dB", "higher"))
            figures.append(figure(f"{what}, above GaussianSplats3D's", -0.1, each["psnr"] - theirs, "dB", "higher"))
            size = each["bytes"] / one["gaussians"]
            figures.append(figure(f"{what}, size", None, size, "bytes a Gaussian", "lower"))
        for kind in ("clipped, SH degree 2, not rounded", ".spz", ".sog"):
            figures.append(figure(f"{name}: {kind}", None, one[kind]["psnr"], "dB", "higher"))
    details = {"scenes": found, "views": VIEWS, "width": WIDTH, "height": HEIGHT}
    write_result(options.out, "Do other programs read the same numbers in a .ksplat?", figures, details)


def figure(name: str, target: float | None, reached: float, unit: str, better: str) -> dict[str, Any]:
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": better}


def look(scene: Gaussians, folder: Path, modules: Path) -> dict[str, Any]:
    """Differences between readers, bytes and PSNR at each compression, beside SPZ and SOG."""
    middle, size = scene.bounds(0.8).mean(axis=0), np.linalg.norm(np.diff(scene.bounds(0.8), axis=0))
    around = Cameras.orbit(middle, 0.6 * size, VIEWS, width=WIDTH, height=HEIGHT, fov=60.0)
    wanted = drawn(scene, around)
    found: dict[str, Any] = {"gaussians": len(scene), "sh_degree": scene.sh_degree, "levels": {}}
    save_scene(scene, folder / "scene.ply")
    for level in (0, 1, 2):
        path, theirs = folder / f"{level}.ksplat", folder / f"theirs{level}.ksplat"
        save_ksplat(scene, path, compression=level)
        run(modules, "write", folder / "scene.ply", theirs, str(level))
        got = load_ksplat(path)
        found["levels"][level] = {
            "bytes": path.stat().st_size,
            "bytes of GaussianSplats3D": theirs.stat().st_size,
            "psnr": psnr(drawn(got, around), wanted),
            "psnr of GaussianSplats3D": psnr(drawn(load_ksplat(theirs), around), wanted),
            "differences": {
                "GaussianSplats3D": difference(got, rows_of(path, folder, modules)),
                "splat-transform": difference(got, transformed(path, folder, modules)),
                "GaussianSplats3D, its own files": difference(load_ksplat(theirs), rows_of(theirs, folder, modules)),
            },
        }
    for suffix in (".spz", ".sog"):
        path = folder / f"scene{suffix}"
        save_scene(scene, path)
        found[suffix] = {"bytes": path.stat().st_size, "psnr": psnr(drawn(load_scene(path), around), wanted)}
    dull = np.clip(scene.sh0, -0.5 / SH_C0, 0.5 / SH_C0)
    clipped = Gaussians(scene.means, scene.quats, scene.scales, scene.opacities, dull, scene.shN[:, :8])
    found["clipped, SH degree 2, not rounded"] = {"psnr": psnr(drawn(clipped, around), wanted)}
    return found


def rows_of(path: Path, folder: Path, modules: Path) -> dict[str, np.ndarray]:
    """What GaussianSplats3D reads."""
    run(modules, "read", path, folder / "rows.f32")
    count = int(np.frombuffer(path.read_bytes()[16:20], "<u4")[0])
    rows = np.fromfile(folder / "rows.f32", "<f4").reshape(count, -1)
    return {
        "means": rows[:, :3],
        "scales": rows[:, 3:6],
        "quats": rows[:, 6:10],
        "opacities": rows[:, 13] / 255.0,
        "sh0": ((rows[:, 10:13] / 255.0 - 0.5) / SH_C0)[:, None],
        "shN": rows[:, 14:].reshape(count, -1, 3),
    }


def transformed(path: Path, folder: Path, modules: Path) -> dict[str, np.ndarray]:
    """What splat-transform reads, by way of its PLY."""
    command = modules / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    words = ["node", str(command), "-q", "-w", "-g", "cpu", str(path), str(folder / "other.ply")]
    subprocess.run(words, check=True, capture_output=True)
    scene = load_scene(folder / "other.ply")
    return {name: getattr(scene, name) for name in ("means", "scales", "quats", "opacities", "sh0", "shN")}


def run(modules: Path, *words: object) -> None:
    subprocess.run(["node", str(SCRIPT), str(modules), *map(str, words)], check=True, capture_output=True)


def difference(scene: Gaussians, other: dict[str, np.ndarray]) -> float:
    """Largest difference of any value, relative for those above 1; rotations as 1 - |dot|."""
    worst = 0.0
    for name, values in other.items():
        ours = getattr(scene, name).astype(np.float64)
        if name == "quats":
            unit = values / np.linalg.norm(values, axis=1, keepdims=True)
            away = 1.0 - np.abs((ours * unit).sum(axis=1))
        else:
            away = np.abs(ours - values) / np.maximum(2.0**-24 if name == "scales" else 1.0, np.abs(ours))
        worst = max(worst, float(away.max(initial=0.0)))
    return worst


def psnr(images: np.ndarray, wanted: np.ndarray) -> float:
    return -10.0 * float(np.log10(max(1e-15, np.mean((images - wanted) ** 2))))


def drawn(scene: Gaussians, cameras: Cameras) -> np.ndarray:
    return np.stack([np.clip(rasterize(scene, cameras[k : k + 1]).images, 0.0, 1.0) for k in range(len(cameras))])


if __name__ == "__main__":
    main()
