"""Packages to be streamed in tests: small, with levels, terms and visible sets."""

from __future__ import annotations

from pathlib import Path

from gsvis.package import Package, PackageInfo, write_package
from tests.package.worlds import colors_of, levels_of, stores_of


def package_of(folder: Path, n: int = 400, variant: str = "rgb", seed: int = 0, *, stores: bool = True) -> Package:
    levels, (exact, colors) = levels_of(n, seed), colors_of(n, variant, seed)
    given = stores_of(folder.parent / f"{folder.name}-stores", levels, exact) if stores else {}
    return write_package(folder, levels, colors, info=PackageInfo((0, -1, 0), 0.5), **given)
