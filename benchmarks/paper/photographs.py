"""Photographs as the truth of a study: every eighth by name is held out to judge, as `gsvis prepare --photos` does.

Pixels; scene frame.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.cameras import Cameras
from gsvis.train.photos import load_photos

__all__ = ["Photographs", "add_options"]

_EVERY = 8


@dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs of a scene.

    Attributes:
        folder: Where they are, with the model that posed them.
        cameras: Those of all.
        judges: Those of the photographs held out.
        truth: These photographs, (H, W, 3) in [0, 1].
        size: Width and height they were shrunk to; None for the size that they have.
    """

    folder: Path
    cameras: Cameras
    judges: Cameras
    truth: tuple[NDArray[np.float32], ...]
    size: tuple[int, int] | None

    @classmethod
    def read(cls, options: argparse.Namespace) -> Photographs | None:
        """Return the photographs of the options; None without them.

        Raises:
            FileNotFoundError: If there is no such folder.
            FormatError: If photographs are missing or damaged, or nothing says where they were taken from.
            ValueError: If one side of the size is given alone, or a size without photographs.
        """
        sides = options.width, options.height
        if (sides[0] is None) != (sides[1] is None) or (options.photos is None and sides[0] is not None):
            raise ValueError(
                "--width, --height: expected both with --photos, or none; got " + " and ".join(map(str, sides))
            )
        if options.photos is None:
            return None
        size = None if sides[0] is None else sides
        views = load_photos(options.photos, size=size).views
        held_out = views.split(_EVERY)[1]
        truth = tuple(held_out.image(k) for k in range(len(held_out)))
        return cls(options.photos, views.cameras, held_out.cameras, truth, size)

    @property
    def words(self) -> list[str]:
        """Return the options of `gsvis prepare` that train on the others."""
        sides = [] if self.size is None else ["--width", str(self.size[0]), "--height", str(self.size[1])]
        return ["--photos", str(self.folder), *sides]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of photographs to those of a benchmark."""
    parser.add_argument("--photos", type=Path, help="photographs of the scene with their model; every eighth judges")
    parser.add_argument("--width", type=int, help="pixels to shrink photographs to")
    parser.add_argument("--height", type=int)
