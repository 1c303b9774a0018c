"""Convert a package to PLY files, one for each level, for viewers that do not read packages."""

from __future__ import annotations

from os import PathLike

from gsvis.color.to_sh import to_sh
from gsvis.io.levels import save_levels
from gsvis.package.package import Package
from gsvis.progress import Progress, silent
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

__all__ = ["unpack_levels", "unpack_package"]


def unpack_levels(package: Package, *, sh_degree: int | None = None, progress: Progress = silent) -> Levels:
    """Return the levels of a package, with SH colors.

    Args:
        package: An open package.
        sh_degree: Degree of the SH fitted to the terms; 0 keeps base colors alone. None means 3 if the package has
            terms, 0 otherwise.
        progress: Called by the fit of the SH.

    Raises:
        ValueError: If the degree is not 0 to 3.
        FormatError: If the package is damaged.
    """
    if sh_degree is not None and sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree: expected 0 to 3, got {sh_degree!r}")
    contents = package.contents
    degree = (3 if len(contents.term_records) else 0) if sh_degree is None else sh_degree
    levels = contents.levels()
    if degree == 0:
        return levels
    sh = to_sh(contents.colors().dequantize(), sh_degree=degree, progress=progress)
    g = levels.union
    union = Gaussians(g.means, g.quats, g.scales, g.opacities, sh.sh0, sh.shN, facts=g.facts)
    return Levels(union, levels.first, levels.last, levels.names)


def unpack_package(
    package: Package, folder: str | PathLike[str], *, sh_degree: int | None = None, progress: Progress = silent
) -> Levels:
    """Write a package as one PLY for each level and the map of reuse, as `gsvis.io.levels.save_levels` does.

    Args:
        package: An open package.
        folder: Folder to write to; created if it is missing.
        sh_degree: Degree of the SH, as in `unpack_levels`.
        progress: Called by the fit of the SH.

    Returns:
        The levels that were written.

    Raises:
        ValueError: If the degree is not 0 to 3, or a level's name is no file name.
        FormatError: If the package is damaged.
        OSError: If the folder cannot be written.
    """
    levels = unpack_levels(package, sh_degree=sh_degree, progress=progress)
    info = package.manifest.info
    extra = {"up": list(info.up), "meters_per_unit": info.meters_per_unit, "scene": package.manifest.scene}
    save_levels(levels, folder, extra)
    return levels
