"""The scene that a package was made from: its manifest names it, so that no benchmark compares with another one.

It is looked for where the manifest says, beside the package, and among the real scenes (`GSVIS_REALDATA`).
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from _harness import find_realdata

from gsvis.errors import GsvisError
from gsvis.io import save_scene
from gsvis.package import Package
from gsvis.package.original import Original, find_original, load_original
from gsvis.scene.gaussians import Gaussians
from gsvis.simulate import morton_order

__all__ = ["Packaged", "open_original", "spz_bytes"]


@dataclass(frozen=True)
class Packaged:
    """The scene of a package.

    Attributes:
        gaussians: The scene before it was packaged.
        file_bytes: Bytes of its files as published; as SPZ if there are none.
        file: What these files are, in words.
        meters_per_unit: Meters in a scene unit; None if unknown.
    """

    gaussians: Gaussians
    file_bytes: int
    file: str
    meters_per_unit: float | None


def open_original(package: str | Path) -> Packaged:
    """Return the scene that a package was made from.

    Raises:
        SystemExit: With one line, if the package cannot be read, or its scene is not found or is another one.
    """
    try:
        with Package.open(package) as opened:
            info = opened.manifest.info
        original = find_original(str(package), info.provenance, [])
        if not original.scenes:
            original = _among_real_scenes(str(package), original, info.provenance)
        g, remark = load_original(original, given=True)
    except (GsvisError, ValueError, OSError) as error:
        raise SystemExit(f"{Path(package).name}: {error}") from None
    if g is None:
        raise SystemExit(
            f"{Path(package).name}: {remark}; put the scene beside the package, or its folder into scenes/ of"
            " GSVIS_REALDATA"
        )
    nbytes, file = _published(original, g)
    return Packaged(g, nbytes, file, info.meters_per_unit or None)


def spz_bytes(g: Gaussians) -> int:
    """Return the bytes of a scene as SPZ, in Morton order."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.spz"
        save_scene(g[morton_order(g.means)], path)
        return path.stat().st_size


def _among_real_scenes(package: str, original: Original, provenance: dict[str, object]) -> Original:
    """Return the same scene in the folder of real scenes, if it is there."""
    root = find_realdata()
    if root is None or len(original.made) != 1:
        return original
    (made,) = original.made
    found = [path for path in (root / "scenes" / made.name, *root.glob(f"scenes/*/{made.name}")) if path.exists()]
    return find_original(package, provenance, [(str(found[0]), made.lod)]) if found else original


def _published(original: Original, g: Gaussians) -> tuple[int, str]:
    """Return the bytes of the published files of a scene, and what they are."""
    path, lod = original.scenes[0]
    file = Path(path)
    folder = file.parent if file.name == "lod-meta.json" else file
    parts = list(folder.glob(f"{lod}_*")) if folder.is_dir() else []
    if parts:
        files = [each for part in parts for each in part.rglob("*") if each.is_file()]
        return sum(each.stat().st_size for each in files), "SOG as published"
    if file.is_file() and file.suffix in (".sog", ".spz"):
        return file.stat().st_size, f"{file.suffix[1:].upper()} as published"
    return spz_bytes(g), "SPZ, written for this"
