"""How faithful are SRBF colors on cameras that the fit never saw, by variant, by number of terms and by bytes?

One scene a run. Directions: traced outward, one ray a face, joined with those that 160 fitting cameras (480 x 360,
drawn from seed 7 in navigable space) see; what a Gaussian counts comes from the same cameras. Twelve held-out cameras
(640 x 480, seed 99) draw the SH scene and the SRBF scene; PSNR is that of the images as they are, not clipped above,
mean over cameras. "wire" colors are rounded to the records that travel, whose size is counted before entropy coding.
The ceiling of a variant is what its space can say at all: exact functions of direction in place of terms, base colors
as fitted.

Given: a scene, the number of terms asked for, direction sets and importance from fitting cameras.
Measured: PSNR of held-out cameras, bytes of the records.
Defaults chosen on: nika and flowers, the scenes that are measured too, on other cameras.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from numpy.typing import NDArray
from paper.held import HELD, HeldColors, fit_held

from gsvis.color import (
    FitConfig,
    SrbfColors,
    fit_srbf,
    hsl_to_rgb,
    quantize,
    record_bytes,
    rgb_to_hsl,
    save_srbf,
    sh_bytes,
    sh_colors,
)
from gsvis.io import load_scene
from gsvis.prepare.importance import importance_from_views
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.raycast.directions import trace_directions
from gsvis.render import flip, rasterize, ssim
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

SCENES = {"nika": ("nika_sh3", 0), "flowers": ("flowers_sh2", 1)}
UP = "-y"
LEVELS = (34.0, 37.0, 40.0, 43.0, 46.0)
FEW = ((0.5, 8), (2.0, 8))
POINTS = {
    "rgb": ((0.5, 8), (1.0, 8), (2.0, 8), (4.0, 8), (7.0, 12)),
    "hsl": FEW,
    **dict.fromkeys(HELD, FEW[:1]),
}
"""Mean and most terms asked for; points after one of at least 43 dB are left out."""
Images = NDArray[np.float32]


def psnr_of(images: Images, reference: Images) -> NDArray[np.float64]:
    """(C,) dB, data range 1."""
    squared = np.square(images.astype(np.float64) - reference).mean(axis=(1, 2, 3))
    return np.asarray(-10.0 * np.log10(np.maximum(squared, 1e-10)))  # 100 dB is the same


def ceiling(g: Gaussians, colors: SrbfColors | HeldColors, cameras: Cameras) -> Images:
    """Images of what a variant could show at best: exact functions of direction, its base colors."""
    shown = []
    for eye in cameras.viewpoints:
        exact = sh_colors(g, eye)
        if isinstance(colors, HeldColors):
            exact = colors.nearest(exact)
        elif colors.variant == "hsl":
            scale = np.maximum(colors.scales, exact.max(axis=1))[:, None]
            hsl = rgb_to_hsl(np.clip(exact / scale, 0, 1))
            hsl[:, 0] = colors.base[:, 0]
            exact = np.asarray(hsl_to_rgb(hsl) * scale, np.float32)
        shown.append(exact)
    return rasterize(g, cameras, colors=np.stack(shown)).images


def drawn(g: Gaussians, colors: SrbfColors | HeldColors, cameras: Cameras) -> Images:
    """Images of the Gaussians in these colors."""
    if isinstance(colors, SrbfColors):
        return rasterize(g, cameras, colors=colors).images
    return rasterize(g, cameras, colors=np.stack([colors.colors(g.means, eye) for eye in cameras.viewpoints])).images


def bytes_at(rows: list[dict[str, Any]], psnr: float) -> float | None:
    """Bytes a Gaussian at which a variant reaches a PSNR, linear between its points; None if outside of them."""
    rows = [row for row in rows if "wire_psnr" in row]
    if not rows:
        return None
    x, y = (np.array([row[key] for row in rows]) for key in ("bytes_per_gaussian", "wire_psnr"))
    order = np.argsort(x)
    x, y = x[order], np.maximum.accumulate(y[order])
    if y[-1] < psnr or y[0] > psnr:
        return None
    return float(np.interp(psnr, y, x))


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene", choices=tuple(SCENES), default="nika")
    parser.add_argument("--variants", nargs="+", choices=tuple(POINTS), default=list(POINTS))
    parser.add_argument("--colors", type=Path, help="folder that keeps the fitted colors of the default variant")
    arguments = parser.parse_args()
    folder, lod = SCENES[arguments.scene]
    g = load_scene(realdata() / "scenes" / folder / "lod-meta.json", lod=lod)
    space = NavigableSpace.from_scene(g, up=UP)
    fitting = space.sample_cameras(160, np.random.default_rng(7), width=480, height=360)
    held_out = space.sample_cameras(12, np.random.default_rng(99), width=640, height=480)
    views = importance_from_views(g, fitting)
    traced = trace_directions(Tracer(EllipsoidProxies.from_scene(g)), space, rays_per_face=1)
    sets = traced | views.sets
    reference = rasterize(g, held_out).images
    curves: dict[str, list[dict[str, Any]]] = {}
    ceilings: dict[str, float] = {}
    for name, points in ((name, POINTS[name]) for name in arguments.variants):
        curves[name] = []
        for mean_terms, most in points:
            if any(row["psnr"] >= 43.0 for row in curves[name]) and mean_terms > 2.0:
                continue
            colors: SrbfColors | HeldColors
            if name in HELD:
                colors = fit_held(g, sets, name, mean_terms, most, views.importance)
            else:
                config = FitConfig(variant=name, mean_terms=mean_terms, max_terms=most)
                colors = fit_srbf(g, sets, config, importance=views.importance).colors
            images = drawn(g, colors, held_out)
            exact = psnr_of(images, reference)
            counts = colors.counts
            row = {
                "asked": mean_terms,
                "max_terms": most,
                "mean_terms": float(counts.mean()),
                "psnr": float(exact.mean()),
                "worst_psnr": float(exact.min()),
                "share_with_terms": float((counts > 0).mean()),
                "of_those_with_1_to_4": float((counts[counts > 0] <= 4).mean()) if counts.any() else 1.0,
            }
            if isinstance(colors, SrbfColors):  # records hold no others
                wire = drawn(g, quantize(colors, "wire").dequantize(), held_out)
                row["wire_psnr"] = float(psnr_of(wire, reference).mean())
                row["bytes_per_gaussian"] = record_bytes(colors) / len(g)
            if mean_terms == 2.0:  # FLIP takes seconds an image
                row["ssim"] = float(np.mean(ssim(images.clip(0, 1), reference.clip(0, 1))))
                row["flip"] = float(np.mean(flip(images.clip(0, 1), reference.clip(0, 1))))
            curves[name].append(row)
            print(name, {key: round(value, 3) for key, value in row.items()}, flush=True)
            if arguments.colors and name == "rgb" and mean_terms == 2.0:
                save_srbf(arguments.colors / f"{arguments.scene}-{name}.srbf.arrow", g, colors)
        ceilings[name] = float(psnr_of(ceiling(g, colors, held_out), reference).mean())
        print(name, "ceiling", round(ceilings[name], 2), flush=True)
        if name == "rgb" and isinstance(colors, SrbfColors):
            base = rasterize(g, held_out, colors=colors.first(0)).images
        report(arguments, g, curves, ceilings, float(psnr_of(base, reference).mean()))  # so far


def report(
    arguments: argparse.Namespace,
    g: Gaussians,
    curves: dict[str, list[dict[str, Any]]],
    ceilings: dict[str, float],
    base_psnr: float,
) -> None:
    """Figures of the default variant and the table of all."""
    rows, called = curves["rgb"], f"{arguments.scene}, variant rgb"

    def psnr(mean_terms: float) -> float:
        return max((row["psnr"] for row in rows if row["mean_terms"] <= mean_terms), default=0.0)

    def figure(what: str, target: float | None, reached: float, unit: str = "dB") -> dict[str, Any]:
        better = "higher" if unit == "dB" else "lower"
        return {"name": what, "target": target, "reached": reached, "unit": unit, "better": better}

    figures = [
        figure(f"{called}: PSNR with at most 4 terms a Gaussian", 40.0, psnr(4.0)),
        figure(f"{called}: PSNR with at most 8 terms a Gaussian", 43.0, psnr(8.0)),
    ]
    for row in rows:
        size = f"{row['mean_terms']:.2f} terms, {row['bytes_per_gaussian']:.1f} bytes a Gaussian"
        figures.append(figure(f"{called}: PSNR at {size}", None, row["psnr"]))
    for name, curve in curves.items():
        found = bytes_at(curve, 40.0)
        if found is not None:
            figures.append(figure(f"{arguments.scene}, {name}: record bytes a Gaussian at 40 dB", None, found, "bytes"))
    details = {
        "gaussians": len(g),
        "sh_degree": g.sh_degree,
        "base_psnr": base_psnr,
        "sh_bytes": {str(bits): sh_bytes(g.sh_degree, bits) for bits in (32, 16, 8)},
        "ceilings_db": ceilings,
        "bytes_at_db": {str(db): {name: bytes_at(curve, db) for name, curve in curves.items()} for db in LEVELS},
        "curves": curves,
    }
    write_result(arguments.out, "How faithful are SRBF colors on cameras that the fit never saw?", figures, details)


if __name__ == "__main__":
    main()
