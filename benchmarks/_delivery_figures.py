"""Figures of sessions that deliver one scene by several systems: by class of link, over walks, with intervals.

A session is a row: scene, walk, class, link, system, figures and curves of `Viewing.as_dict`, `bytes_to_35`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from _delivery_systems import ABLATED, OTHERS, OURS, VARIANTS

from gsvis.abr import paired_difference

__all__ = [
    "CLASSES",
    "best_rival",
    "by_walk",
    "curves_over_bytes",
    "figures_of",
    "means_of_frames",
    "report",
    "targets_of",
    "throughput",
]

CLASSES = (1, 3, 10, 30)
"""Mbit/s."""
SEEN = ("psnr", "latency", "qoe")
"""Curves that judge an image: steps at which the full scene shows nothing do not count."""
MOST_DB = 50.0
"""PSNR counts up to this, as in the QoE."""
KEYS = ("score", "psnr", "latency", "stall")

Rows = list[dict[str, Any]]


def chosen(rows: Rows, **named: Any) -> Rows:
    """The rows with these values."""
    return [row for row in rows if all(row[key] == value for key, value in named.items())]


def systems_of(rows: Rows) -> list[str]:
    """The systems in the order of the table."""
    there = {row["system"] for row in rows}
    return [name for name in (OURS, *VARIANTS, *ABLATED, *OTHERS) if name in there]


def by_walk(rows: Rows, key: str) -> np.ndarray:
    """(W,) the mean of a figure over the links of each walk, in the order of the walks' names."""
    walks = sorted({row["walk"] for row in rows})
    return np.array([np.mean([row["figures"][key] for row in rows if row["walk"] == walk]) for walk in walks])


def best_rival(rows: Rows) -> str | None:
    """The rival, not one of our ablations, with the highest mean QoE of a step; None without any."""
    means = {name: float(by_walk(chosen(rows, system=name), "score").mean()) for name in systems_of(rows)}
    means = {name: score for name, score in means.items() if name in OTHERS}
    return max(means, key=lambda name: means[name]) if means else None


def median_of(rows: Rows, key: str) -> float | None:
    """The median of a figure that may never have happened; None if it did not in half of the sessions."""
    found = [row["figures"].get(key, row.get(key)) for row in rows]
    middle = float(np.median([np.inf if value is None else value for value in found]))
    return middle if np.isfinite(middle) else None


def figures_of(rows: Rows, classes: list[int]) -> list[dict[str, Any]]:
    """One row for each class and system, and our difference from the best rival and from each ablation."""
    out: list[dict[str, Any]] = []
    for scene in sorted({row["scene"] for row in rows}):
        for rate in classes:
            some = chosen(rows, scene=scene, **{"class": rate})
            where = f"{rate} Mbit/s, {scene}"
            for system in systems_of(some):
                own = chosen(some, system=system)
                out.append(_figure(f"QoE of a step, {where}, {system}", by_walk(own, "score").mean(), _said(own)))
            best = best_rival(some)
            ours = by_walk(chosen(some, system=OURS), "score")
            if best is None or len(ours) < 2:
                continue
            for key, label, better in (("score", "QoE of a step", "higher"), ("psnr", "PSNR", "higher"),
                                       ("latency", "latency", "lower")):  # fmt: skip
                own, other = (by_walk(chosen(some, system=name), key) for name in (OURS, best))
                apart = paired_difference(own, other)
                unit = f"{best}; 95% CI {apart.low:.3f} to {apart.high:.3f} over {apart.pairs} walks"
                out.append(_figure(f"{label}, {where}, gsvis minus the best rival", apart.mean, unit, better))
                if key == "score":
                    name = f"the same, lower end of its interval, {where}"
                    out.append({**_figure(name, apart.low, f"over {apart.pairs} walks"), "target": 0.0})
    return out


def targets_of(rows: Rows, classes: list[int]) -> list[dict[str, Any]]:
    """Figures with a target: first images, bytes until 35 dB, terms without filling, PSNR beside the whole file."""
    out: list[dict[str, Any]] = []
    for scene in sorted({row["scene"] for row in rows}):
        for rate in classes:
            some, where = chosen(rows, scene=scene, **{"class": rate}), f"{rate} Mbit/s, {scene}"
            ours = chosen(some, system=OURS)
            for key, least, targets in (("first", 20, {3: 0.3, 10: 0.1}), ("good", 35, {3: 2.0, 10: 0.5})):
                seconds = median_of(ours, f"seconds_to_{key}_image")
                name = f"{least} dB after, median, {where}"
                reached = 1e9 if seconds is None else round(seconds, 6)  # three ticks of 0.1 s are 0.3 s
                out.append({**_figure(name, reached, "s", "lower"),
                            "target": targets.get(rate)})  # fmt: skip
            rivals = [name for name in systems_of(some) if name in OTHERS]
            others = {name: median_of(chosen(some, system=name), "bytes_to_35") for name in rivals}
            nbytes, mine = {k: v for k, v in others.items() if v is not None}, median_of(ours, "bytes_to_35")
            if nbytes and mine is not None:
                least = min(nbytes, key=lambda name: nbytes[name])
                figure = _figure(
                    f"bytes until 35 dB, {where}, of those of the best rival", mine / nbytes[least], least, "lower"
                )
                out.append({**figure, "target": 0.5})
            bare = chosen(some, system="gsvis, links not filled")
            if bare and by_walk(bare, "terms").any():
                figure = _figure(f"SRBFs sent in 30 s, links not filled, {where}", by_walk(bare, "term_share").mean(),
                                 "of all", "lower")  # fmt: skip
                out.append({**figure, "target": 0.35 if rate == 10 else None})
            share = _final_share(ours, chosen(some, system="whole file"))
            if share is not None:
                name = f"final PSNR, {where}, of the whole file's, worst walk in which it arrives"
                out.append({**_figure(name, share, "at most 50 dB each"), "target": 0.9})
    return out


def _final_share(ours: Rows, whole: Rows) -> float | None:
    """The least share of the whole file's final PSNR that ours has, in sessions in which the file has arrived."""
    found = []
    for mine, theirs in zip(ours, whole, strict=False):
        assert (mine["walk"], mine["link"]) == (theirs["walk"], theirs["link"])
        content = np.flatnonzero(theirs["curves"]["content"])
        if len(content) and theirs["figures"]["seconds_to_first_image"] is not None:
            last = content[-1]
            found.append(min(mine["curves"]["psnr"][last], MOST_DB) / min(theirs["curves"]["psnr"][last], MOST_DB))
    return min(found) if found else None


def _figure(name: str, reached: float, unit: str, better: str = "higher") -> dict[str, Any]:
    return {"name": name, "target": None, "reached": float(reached), "unit": unit, "better": better}


def _said(rows: Rows) -> str:
    """What else a line says of a system."""
    first, good = (median_of(rows, f"seconds_to_{k}_image") for k in ("first", "good"))
    nbytes = median_of(rows, "bytes_to_35")
    parts = [
        f"at most 1; {by_walk(rows, 'psnr').mean():.1f} dB, latency {by_walk(rows, 'latency').mean():.2f} s",
        "20 dB never" if first is None else f"20 dB after {first:.1f} s",
        "35 dB never" if good is None else f"35 dB after {good:.1f} s",
    ]
    if nbytes is not None:
        parts[-1] += f" and {nbytes / 1e6:.2f} MB"
    return ", ".join(parts)


def report(rows: Rows, classes: list[int]) -> dict[str, Any]:
    """Everything that a page of the paper's figures needs, for each scene and class."""
    out: dict[str, Any] = {"differences": {}, "curves": {}, "over_bytes": {}, "throughput": {}}
    for scene in sorted({row["scene"] for row in rows}):
        for rate in classes:
            some = chosen(rows, scene=scene, **{"class": rate})
            where = f"{scene}, {rate} Mbit/s"
            out["differences"][where] = _differences(some)
            steady = [row for row in some if row["link"] == f"{rate:g} Mbit/s"] or some
            each = {name: chosen(steady, system=name) for name in systems_of(steady)}
            out["curves"][where] = {name: _mean_curves(own) for name, own in each.items()}
            out["over_bytes"][where] = {name: curves_over_bytes(own) for name, own in each.items()}
            out["throughput"][where] = {name: throughput(own, rate) for name, own in each.items()}
    keys = ("scene", "walk", "class", "link", "system")
    names = list(rows[0]["figures"])
    lines = [
        [*(row[key] for key in keys), *(_short(row["figures"][name]) for name in names), row["bytes_to_35"]]
        for row in rows
    ]
    out["sessions"] = {"columns": [*keys, *names, "bytes_to_35"], "rows": lines}
    return out


def _differences(rows: Rows) -> dict[str, Any]:
    """Our paired differences from every other system, over walks."""
    ours, out = chosen(rows, system=OURS), {}
    for name in systems_of(rows):
        other = chosen(rows, system=name)
        if name == OURS or len({row["walk"] for row in ours}) < 2:
            continue
        out[name] = {key: paired_difference(by_walk(ours, key), by_walk(other, key)).as_dict() for key in KEYS}
    return {"best_rival": best_rival(rows), "ours_minus": out}


def _mean_curves(rows: Rows) -> dict[str, list[float | None]]:
    """Mean curves over seconds; what judges an image, over the walks that see something then."""
    content = np.array([row["curves"]["content"] for row in rows], bool)
    counts, out = content.sum(axis=0), {}
    for key in ("times", "psnr", "latency", "qoe", "bytes", "gaussian_share", "term_share"):
        curves = np.array([row["curves"][key] for row in rows], np.float64)
        if key in SEEN:
            sums = np.where(content, curves, 0.0).sum(axis=0)
            means = [s / n if n else None for s, n in zip(sums.tolist(), counts.tolist(), strict=True)]
        else:
            means = curves.mean(axis=0).tolist()
        out[key] = [None if mean is None else float(f"{mean:.5g}") for mean in means]
    return out


def curves_over_bytes(rows: Rows, steps: int = 24) -> dict[str, list[float | None]]:
    """Mean PSNR by the bytes that have arrived, 20 kB to 20 MB: at the last step with at most so many.

    A session counts from its first step with content on, up to the bytes that it received in all.
    """
    grid = np.geomspace(2e4, 2e7, steps)
    found = np.full((len(rows), steps), np.nan)
    for row, line in zip(rows, found, strict=True):
        content = np.array(row["curves"]["content"], bool)
        nbytes, db = (np.array(row["curves"][key])[content] for key in ("bytes", "psnr"))
        last = np.searchsorted(nbytes, grid, side="right") - 1
        reached = (last >= 0) & (grid <= max(row["figures"]["bytes"], 0.0))
        line[reached] = db[last[reached]]
    there = np.isfinite(found)
    means = np.where(there, found, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    return {
        "bytes": [round(value) for value in grid.tolist()],
        "sessions": there.sum(axis=0).tolist(),
        "psnr": [round(m, 3) if n else None for m, n in zip(means.tolist(), there.sum(axis=0).tolist(), strict=True)],
    }


def throughput(rows: Rows, rate: float) -> dict[str, Any]:
    """Mbit/s that arrive, in each second (figure 14 of the paper), and as a share of the link over all."""
    times = np.array(rows[0]["curves"]["times"])
    nbytes = np.array([row["curves"]["bytes"] for row in rows]).mean(axis=0)
    edges = np.arange(0.0, np.floor(times[-1]) + 0.5)
    at = np.interp(edges, times, nbytes)
    each = np.diff(at) * 8e-6
    total = float(np.mean([row["figures"]["bytes"] for row in rows]))
    return {
        "mbit_per_s": [round(value, 3) for value in each.tolist()],
        "megabytes": round(total / 1e6, 3),
        "share_of_link": round(total * 8e-6 / (rate * (2.0 * times[-1] - times[-2])), 3),
    }


def means_of_frames(frames: Rows) -> dict[str, Any]:
    """Mean PSNR, SSIM and FLIP of the same frames for each system, and each frame by itself."""
    out: dict[str, Any] = {}
    for name in systems_of(frames):
        some = chosen(frames, system=name)
        means = {
            "psnr": round(float(np.mean([min(row["psnr"], MOST_DB) for row in some])), 3),
            **{key: round(float(np.mean([row[key] for row in some])), 4) for key in ("ssim", "flip")},
        }
        each = [[row["scene"], row["walk"], row["t"], row["psnr"], row["ssim"], row["flip"]] for row in some]
        out[name] = {**means, "columns": ["scene", "walk", "t", "psnr", "ssim", "flip"], "frames": each}
    return out


def _short(value: Any) -> Any:
    return float(f"{value:.5g}") if isinstance(value, float) else value
