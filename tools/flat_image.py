"""Draw the built-in flat from some eyes: `python tools/flat_image.py`, into docs/images/flat.jpg."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from gsvis.io import load_scene
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.procedural import furnished_flat

ROOT = Path(__file__).resolve().parents[1]
SIZE, GAP, COLUMNS = (480, 300), 4, 3
VIEWS = (
    ((5.3, 3.85, 1.6), (1.0, 0.7, 0.9)),
    ((0.6, 0.55, 1.5), (5.5, 3.4, 1.1)),
    ((9.5, 1.0, 1.6), (6.3, 3.8, 0.95)),
    ((6.4, 3.9, 1.6), (9.3, 0.8, 1.0)),
    ((0.6, 5.0, 1.6), (3.2, 8.3, 0.8)),
    ((6.5, 7.6, 1.6), (4.5, 7.6, 1.2)),
)


def main(scene: str | None) -> None:
    g = load_scene(scene) if scene else furnished_flat().gaussians
    rows = -(-len(VIEWS) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * (SIZE[0] + GAP) - GAP, rows * (SIZE[1] + GAP) - GAP), "white")
    for i, (eye, target) in enumerate(VIEWS):
        camera = Cameras.look_at(np.array([eye]), np.array(target), width=SIZE[0], height=SIZE[1], fov=82.0)
        image = rasterize(g, camera).images[0].clip(0.0, 1.0)
        at = (i % COLUMNS * (SIZE[0] + GAP), i // COLUMNS * (SIZE[1] + GAP))
        sheet.paste(Image.fromarray((image * 255.0).round().astype(np.uint8)), at)
    sheet.save(ROOT / "docs" / "images" / "flat.jpg", quality=88, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
