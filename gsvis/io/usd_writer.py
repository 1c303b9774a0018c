"""Write Gaussians as OpenUSD with the schema ParticleField3DGaussianSplat: `.usdz`, `.usdc`, `.usda` or `.usd`.

Data keep the frame of the scene, value by value; the transform of one prim turns them to +y up and moves them to the
origin of the source. Needs the package `usd-core` (extra `usd`), 26.3 or newer.

References:
    OpenUSD, "ParticleField3DGaussianSplat", https://openusd.org/release/user_guides/schemas/usdVol/ParticleField.html:
    scales are standard deviations, the coefficients of a particle are adjacent, and radiance is that of 3DGS.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check, _extras
from gsvis.files.atomic import atomic_path
from gsvis.files.folders import GENERATOR
from gsvis.files.temporary import temporary_folder
from gsvis.io.losses import report_loss
from gsvis.scene.gaussians import Gaussians

__all__ = ["USD_SUFFIXES", "check_usd", "save_usd"]

USD_SUFFIXES = (".usdz", ".usdc", ".usda", ".usd")
_PRIM = "/Scene"
_SCHEMA = "ParticleField3DGaussianSplat"
_EXTENT = 3.0  # standard deviations from the center to the border of a Gaussian, as the schema counts them


def check_usd(path: str | os.PathLike[str]) -> None:
    """Raise unless USD can be written to a path: its suffix, and an OpenUSD that knows Gaussians.

    Raises:
        ValueError: If the path ends in none of `USD_SUFFIXES`, or the release of OpenUSD is older than 26.3.
        MissingExtraError: If `usd-core` is not installed.
    """
    where = _check.path("path", path)
    if where.suffix.lower() not in USD_SUFFIXES:
        raise ValueError(f"path: expected a name that ends in {', '.join(USD_SUFFIXES)}, got {where.name!r}")
    _extras.require("OpenUSD", "pxr")
    from pxr import Usd

    if not Usd.SchemaRegistry().FindConcretePrimDefinition(_SCHEMA):
        release = ".".join(map(str, Usd.GetVersion()[1:]))
        raise ValueError(f"usd-core: expected 26.3 or newer, which knows {_SCHEMA}, got {release}; upgrade it")


def save_usd(scene: Gaussians, path: str | os.PathLike[str], *, upright: NDArray[np.float64] | None = None) -> int:
    """Write a scene as OpenUSD, atomically. Every value is kept.

    Args:
        scene: The scene; its order is kept.
        path: The file; its folder is created if missing. `.usdz` is a package, `.usda` text.
        upright: (4, 4) matrix from the frame of the scene to +y up, in meters; None for the identity.

    Returns:
        Bytes of the file.

    Raises:
        ValueError: If the scene is empty, or as `check_usd`.
        MissingExtraError: If `usd-core` is not installed.
        OSError: If it cannot be written.
    """
    check_usd(path)
    if len(scene) == 0:
        raise ValueError("scene: expected at least one Gaussian, got none")
    if scene.facts.antialiased:
        report_loss(path, "antialiased", "OpenUSD has no flag for antialiased scenes")
    with atomic_path(path) as partial:
        with temporary_folder() as folder:
            made = _write_stage(scene, folder, partial.suffix.lower(), np.eye(4) if upright is None else upright)
            shutil.copyfile(made, partial)
        return partial.stat().st_size


def _write_stage(scene: Gaussians, folder: Path, suffix: str, upright: NDArray[np.float64]) -> Path:
    """Write the stage into a folder; return its file."""
    from pxr import Sdf, Usd, UsdGeom, UsdUtils

    packed = suffix == ".usdz"
    file = folder / f"scene{'.usdc' if packed else suffix}"
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().comment = GENERATOR
    prim = stage.DefinePrim(_PRIM, _SCHEMA)
    stage.SetDefaultPrim(prim)
    with Sdf.ChangeBlock():
        for name, value in _attributes(scene).items():
            prim.GetAttribute(name).Set(value)
    _place(prim, upright, scene.facts.origin)
    stage.GetRootLayer().Save()
    if not packed:
        return file
    package = folder / "scene.usdz"
    UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(file)), str(package))
    return package


def _attributes(scene: Gaussians) -> dict[str, Any]:
    """Return the values of the attributes of the prim, as OpenUSD holds them."""
    from pxr import Vt

    imaginary_first = np.ascontiguousarray(scene.quats[:, [1, 2, 3, 0]])
    coefficients = np.concatenate([scene.sh0, scene.shN], axis=1).reshape(-1, 3)
    reach = _EXTENT * scene.scales.max(axis=1)[:, None]
    extent = np.stack([(scene.means - reach).min(axis=0), (scene.means + reach).max(axis=0)])
    return {
        "positions": Vt.Vec3fArray.FromNumpy(scene.means),
        "orientations": Vt.QuatfArray.FromNumpy(imaginary_first),
        "scales": Vt.Vec3fArray.FromNumpy(scene.scales),
        "opacities": Vt.FloatArray.FromNumpy(scene.opacities),
        "radiance:sphericalHarmonicsDegree": scene.sh_degree,
        "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(coefficients),
        "extent": Vt.Vec3fArray.FromNumpy(extent.astype(np.float32)),
    }


def _place(prim: Any, upright: NDArray[np.float64], origin: tuple[float, float, float]) -> None:
    """Give a prim the transform from the frame of the scene: to its origin, then upright."""
    from pxr import Gf, UsdGeom

    moved = np.eye(4)
    moved[:3, 3] = origin
    matrix = np.asarray(upright, np.float64) @ moved
    UsdGeom.Xformable(prim).AddTransformOp().Set(Gf.Matrix4d(matrix.T.tolist()))  # USD has row vectors
