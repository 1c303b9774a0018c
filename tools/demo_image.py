"""Compose the picture at the top of the README from a demo: `make demo && .venv/bin/python tools/demo_image.py`."""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
HEIGHT, GAP = 400, 12


def main(folder: Path) -> None:
    parts = [Image.open(folder / f"{name}.png").convert("RGB") for name in ("view_most", "map_most", "cdf")]
    parts = [part.resize((part.width * HEIGHT // part.height, HEIGHT), Image.Resampling.LANCZOS) for part in parts]
    width = sum(part.width for part in parts) + GAP * (len(parts) - 1)
    picture = Image.new("RGB", (width, HEIGHT), "white")
    left = 0
    for part in parts:
        picture.paste(part, (left, 0))
        left += part.width + GAP
    target = ROOT / "docs" / "images" / "demo.png"
    target.parent.mkdir(exist_ok=True)
    picture.save(target, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "demo-out")
