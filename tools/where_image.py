"""Draw where people stand in the built-in flat: `python tools/where_image.py`, into docs/images/where.jpg."""

from __future__ import annotations

import io
import sys
from pathlib import Path

from PIL import Image

from gsvis.cli.options import Where
from gsvis.cli.where import find_place
from gsvis.io.sources import load_source
from gsvis.report.readings import picture_of

ROOT = Path(__file__).resolve().parents[1]


def main(scene: str) -> None:
    source = load_source(scene, None)
    png = picture_of(source, find_place(source, Where()))
    image = Image.open(io.BytesIO(png)).convert("RGB")
    image.save(ROOT / "docs" / "images" / "where.jpg", quality=85, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "builtin:flat")
