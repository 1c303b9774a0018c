"""What do figures 9 to 14 of the paper, and PSNR against bytes, look like for the systems of `streaming_rivals.py`?

One PNG for each scene and class of link, with a panel for each figure: QoE of a step (9), PSNR (10) and latency (11)
against seconds, throughput (12 and 14), the share of the Gaussians that a client holds (13), and PSNR against bytes.
Mean over walks and links. Ours and its rivals; with `--variants` ours with other settings, or without one of its parts.

Given: a JSON file of `streaming_rivals.py`.
Measured: nothing; this draws.
Defaults chosen on: none.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from _delivery_systems import OTHERS, OURS
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gsvis.report.theme import LIGHT

_INKS = ("#d2600a", "#128a4b", "#b0126f", "#6b4fbb", "#0e8f9c", "#8a6d00", "#a33a2a", "#4d5b6b", "#3b7d2b", "#7a4a86")
Curves = dict[str, dict[str, Any]]


def style_of(name: str, names: Sequence[str]) -> dict[str, Any]:
    """Return the line of a system: ours is thick and blue."""
    if name == OURS:
        return {"color": LIGHT.gathered, "linewidth": 2.6, "zorder": 5}
    others = [other for other in names if other != OURS]
    return {"color": _INKS[others.index(name) % len(_INKS)], "linewidth": 1.3}


def draw_lines(axes: Axes, curves: Curves, names: Sequence[str], x: str, y: str, labels: tuple[str, str]) -> None:
    """Draw one quantity of all systems."""
    for name in names:
        if y in curves.get(name, {}):
            axes.plot(curves[name][x], curves[name][y], label=name, **style_of(name, names))
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])


def draw_class(details: dict[str, Any], key: str, names: Sequence[str], out: Path) -> None:
    """Write the panels of a scene and a class of link."""
    figure = Figure(figsize=(15.0, 8.4), dpi=110, layout="constrained")
    panels = figure.subplots(2, 3)
    curves, over_bytes, carried = (details[part][key] for part in ("curves", "over_bytes", "throughput"))
    rates: Curves = {
        name: {"second": list(range(1, 1 + len(row["mbit_per_s"]))), "rate": row["mbit_per_s"]}
        for name, row in carried.items()
    }
    sizes: Curves = {
        name: {
            "megabytes": [size / 1e6 for size, psnr in zip(row["bytes"], row["psnr"], strict=True) if psnr is not None],
            "psnr": [psnr for psnr in row["psnr"] if psnr is not None],
        }
        for name, row in over_bytes.items()
    }
    draw_lines(panels[0, 0], curves, names, "times", "qoe", ("seconds", "QoE of a step (figure 9)"))
    draw_lines(panels[0, 1], curves, names, "times", "psnr", ("seconds", "PSNR, dB (figure 10)"))
    draw_lines(panels[0, 2], curves, names, "times", "latency", ("seconds", "latency, seconds (figure 11)"))
    draw_lines(panels[1, 0], rates, names, "second", "rate", ("seconds", "Mbit/s (figures 12 and 14)"))
    draw_lines(panels[1, 1], curves, names, "times", "gaussian_share", ("seconds", "Gaussians held (figure 13)"))
    draw_lines(panels[1, 2], sizes, names, "megabytes", "psnr", ("MB", "PSNR, dB"))
    for axes in panels.flat:
        axes.grid(color=LIGHT.grid)
        axes.spines[["top", "right"]].set_visible(False)
    handles, labels = panels[0, 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    figure.suptitle(f"{key}, mean over {len(details['walks'])} walks")
    figure.savefig(out)
    print(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("json", type=Path, help="what streaming_rivals.py wrote")
    parser.add_argument("--out", type=Path, default=Path("out/streaming_plots"), help="folder of the PNG files")
    parser.add_argument("--variants", action="store_true", help="variants of ours, not rivals")
    arguments = parser.parse_args()
    details = json.loads(arguments.json.read_text(encoding="utf-8"))["details"]
    arguments.out.mkdir(parents=True, exist_ok=True)
    for key, curves in details["curves"].items():
        names = [name for name in curves if name == OURS or (name not in OTHERS) == arguments.variants]
        slug = key.replace(", ", "-").replace(" Mbit/s", "").replace(" ", "-")
        draw_class(details, key, names, arguments.out / f"{slug}{'-variants' if arguments.variants else ''}.png")


if __name__ == "__main__":
    main()
