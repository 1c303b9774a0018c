"""Paint pictures: landscapes, abstracts and sketches that hang on walls, and the mats around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.flat.charts import Chart, Look, Paint, box, plain, rectangle
from gsvis.scene.flat.materials import mixed
from gsvis.scene.flat.noise import chance, grain

__all__ = ["abstract", "framed", "hills", "waves"]

F64 = NDArray[np.float64]
Triple = tuple[float, float, float]


def framed(
    wide: float, tall: float, art: Paint, *, frame: Triple = (0.16, 0.13, 0.11), mat: float = 0.05
) -> list[Chart]:
    """Return a picture centered at the origin that hangs on a wall behind it and faces +y.

    Args:
        wide: Width, meters.
        tall: Height, meters.
        art: Paint of the picture, over the whole size.
        frame: Color of the frame.
        mat: Width of the white border inside the frame, meters.
    """
    rim = 0.022
    found: list[Chart] = []
    rail = plain(frame, gloss=0.04, texel=0.01)
    for low, high in (
        ((-wide / 2, 0.0, -tall / 2), (-wide / 2 + rim, 0.025, tall / 2)),
        ((wide / 2 - rim, 0.0, -tall / 2), (wide / 2, 0.025, tall / 2)),
        ((-wide / 2, 0.0, -tall / 2), (wide / 2, 0.025, -tall / 2 + rim)),
        ((-wide / 2, 0.0, tall / 2 - rim), (wide / 2, 0.025, tall / 2)),
    ):
        found += box(low, high, rail, faces="xXYzZ")

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        inner = np.minimum.reduce([u, wide - u, v, tall - v]) > mat + rim
        return np.asarray(np.where(inner[..., None], art(u / wide, v / tall), np.array([0.93, 0.92, 0.88])))

    sheet = Look(paint, gloss=0.04, texel=0.0065, detail=1.3)
    found.append(rectangle((wide / 2, 0.012, -tall / 2), (-wide, 0.0, 0.0), (0.0, 0.0, tall), sheet))
    return found


def hills(sky: Triple, tones: tuple[Triple, ...], seed: int = 1) -> Paint:
    """Return a landscape: a sun, and ranges of hills from far to near; u and v in [0, 1]."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        color = mixed((0.97, 0.88, 0.74), sky, np.clip(v * 1.4 - 0.3, 0.0, 1.0))
        color = np.where((np.hypot(u - 0.68, (v - 0.72) * 0.8) < 0.07)[..., None], np.array([0.98, 0.82, 0.55]), color)
        for i, tone in enumerate(tones):
            x = u * (1.5 + i) + 0.37 * i + 0.21 * seed
            ridge = (
                0.62 - 0.13 * i + 0.06 * np.sin(4.0 * x) + 0.03 * np.sin(11.0 * x) + 0.012 * grain(0.3 * x, 0.11 * i)
            )
            shade = 1.0 + 0.06 * grain(0.6 * u, 0.6 * v + 0.3 * i)
            color = np.where((v < ridge)[..., None], np.array(tone) * shade[..., None], color)
        return np.asarray(np.clip(color, 0.0, 1.0))

    return paint


def abstract(ground: Triple, tones: tuple[Triple, ...], seed: int = 1) -> Paint:
    """Return overlapping round and square shapes."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        color = np.broadcast_to(np.array(ground), (*u.shape, 3)).copy()
        for i in range(9):
            x, y, size, kind = (float(chance(i, k, seed)) for k in range(4))
            tone = tones[i % len(tones)]
            dx = u - 0.15 - 0.7 * x
            dy = v - 0.15 - 0.7 * y
            reach = 0.06 + 0.17 * size
            inside = np.hypot(dx, dy) < reach if kind < 0.6 else np.maximum(np.abs(dx), 0.5 * np.abs(dy)) < 0.6 * reach
            color[inside] = tone
        return np.asarray(np.clip(color * (1.0 + 0.04 * grain(0.9 * u, 0.9 * v))[..., None], 0.0, 1.0))

    return paint


def waves(low: Triple, high: Triple, seed: int = 1) -> Paint:
    """Return bands of brush strokes from one color to another, like a sea."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        bent = v + 0.03 * np.sin(9.0 * u + seed) + 0.02 * grain(0.3 * u + 0.1 * seed, 0.3 * v)
        share = np.clip(np.floor(9.0 * bent) / 9.0 + 0.05 * grain(0.2 * u, 2.0 * v), 0.0, 1.0)
        foam = (np.abs(9.0 * bent - np.rint(9.0 * bent)) < 0.05) & (grain(0.9 * u, 0.2 * v) > 0.1)
        return np.asarray(np.where(foam[..., None], np.array([0.95, 0.95, 0.92]), mixed(low, high, share)))

    return paint
