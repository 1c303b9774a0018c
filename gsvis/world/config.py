"""Options of the preparation of a world."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gsvis import _check
from gsvis.prepare.config import PrepareConfig
from gsvis.scene.cameras import Cameras
from gsvis.world.tiling import TilingConfig

__all__ = ["WorldConfig"]


@dataclass(frozen=True)
class WorldConfig:
    """Everything that decides the content of a world, besides its scenes.

    Attributes:
        tiling: How the world is cut into tiles.
        package: Options of the package of each tile; `cells` is for each tile. Levels have no preview, because
            districts replace what is far. Tiles keep the fit of their colors, in records of the usual precision, so it
            may ask for nothing else.
        far: Most Gaussians of a district.
        angle: Largest spacing of a node over its distance from a tile, radians, at which it may be used around the
            tile.
        looks: Number of eyes in a tile that look for visible nodes around it, at low resolution.
        resolution: Voxels along the longest side of a tile with its margin. Farther around, voxels have the same size,
            or a larger one if they would be too many.
        walk: (T, 3) positions of a walk, scene frame, along which eyes are, with straight lines between them. None
            searches the space of each tile. Tiles far from the walk have no cells.
        margin: Distance from the walk within which eyes may be, scene units.
        cameras: Cameras that took photos of the scenes, in their frame. They give the up axis; half of them add space
            for eyes around them; the other half judges the visible sets of tiles. None for none.

    Raises:
        ValueError: If a value is out of range, or the package asks for what tiles do not take.
    """

    tiling: TilingConfig = field(default_factory=TilingConfig)
    package: PrepareConfig = field(default_factory=lambda: PrepareConfig(cells=32))
    far: int = 8_192
    angle: float = 0.006
    looks: int = 24
    resolution: int = 160
    walk: tuple[tuple[float, float, float], ...] | None = None
    margin: float = 1.0
    cameras: Cameras | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        for name, least in (("far", 16), ("looks", 1), ("resolution", 8)):
            _check.positive_int(name, getattr(self, name), at_least=least)
        if not (np.isfinite(self.angle) and 0.0 < self.angle <= 1.0):
            raise ValueError(f"angle: expected radians in (0, 1], got {self.angle!r}")
        if not (np.isfinite(self.margin) and self.margin > 0.0):
            raise ValueError(f"margin: expected a finite number > 0, got {self.margin!r}")
        if self.walk is not None:
            walk = _check.floats("walk", self.walk, ("T", 3), np.float64)
            if len(walk) == 0:
                raise ValueError("walk: expected at least one position, got none")
            object.__setattr__(self, "walk", tuple((x, y, z) for x, y, z in walk.tolist()))
        if self.package.level_size is not None:
            raise ValueError("package: expected no level_size, got one; tiles have no photos")
        if (precision := self.package.colors.precision) != "wire":
            raise ValueError(f"package: expected colors of the precision 'wire' in tiles, got {precision!r}")
        if self.package.colors.record_psnr is not None:
            raise ValueError("package: expected no record_psnr, got one; records of tiles keep all bits")
        if self.package.color_steps:
            raise ValueError(f"package: expected no color_steps, got {self.package.color_steps}; tiles keep the fit")
        if (levels := self.package.levels) is not None:
            object.__setattr__(self, "package", replace(self.package, levels=replace(levels, preview=0.0)))
