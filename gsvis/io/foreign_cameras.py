"""Name the program that wrote cameras in a format that gsvis cannot read, and how it exports a COLMAP model.

Metashape, RealityCapture and others export photographs with distortion, each with its own lens model. Scenes are
trained on undistorted photographs, so the COLMAP model used for training holds the right cameras.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from gsvis.files.limits import open_regular

__all__ = ["foreign_cameras", "foreign_cameras_in", "foreign_json"]

_METASHAPE = "File > Export > Export Cameras, type Colmap (Metashape 2.2 and later)"
_REALITY = "Export > Registration, type COLMAP, in RealityScan or RealityCapture"
_ANY = "the COLMAP model or transforms.json that the scene was trained from"

_BY_NAME = {
    ".psx": ("a project of Metashape", _METASHAPE),
    ".psz": ("a project of Metashape", _METASHAPE),
    ".rcproj": ("a project of RealityCapture", _REALITY),
    ".rsproj": ("a project of RealityScan", _REALITY),
    ".rcalign": ("an alignment of RealityCapture", _REALITY),
    ".rsalign": ("an alignment of RealityScan", _REALITY),
    ".xmp": ("an XMP sidecar of one photograph, as RealityCapture writes it", _REALITY),
    ".p4d": ("a project of Pix4D", _ANY),
    ".abc": ("cameras in Alembic", _ANY),
    ".fbx": ("cameras in FBX", _ANY),
    ".db": ("a database of COLMAP, which holds no poses", "the model in sparse/0 beside it"),
}
_BY_START = (
    (rb"<document[^>]*>\s*<chunk|<document[^>]*version=\"[0-9.]+\"", ("cameras of Metashape (XML)", _METASHAPE)),
    (rb"<BlocksExchange", ("cameras in BlocksExchange (XML)", _METASHAPE)),
    (rb"xcr:|www\.capturingreality\.com", _BY_NAME[".xmp"]),
    (rb"^# ?Bundle file", ("cameras in the format of Bundler", f"{_METASHAPE}; {_REALITY}")),
    (rb"^NVM_V3", ("cameras of VisualSFM (NVM)", _ANY)),
    (rb"(?i)^#(cameras [0-9]|name,? ?x,? ?y,? ?(alt|z))", ("a registration of RealityCapture (CSV)", _REALITY)),
    (rb"(?i)^#? ?(photoid|imagename)[, \t]+x[, \t]+y[, \t]+z", ("cameras in omega, phi, kappa", _ANY)),
)
_SUFFIXES = (".xml", ".out", ".nvm", ".csv", *_BY_NAME)
_MOST = 64


def foreign_cameras(path: Path, start: bytes) -> tuple[str, str] | None:
    """Return what a file with cameras is, and how to export a COLMAP model instead; None if unknown.

    Args:
        path: The file.
        start: Its first bytes.
    """
    for pattern, found in _BY_START:
        if re.search(pattern, start):
            return found[0], _remedy(found[1])
    named = _BY_NAME.get(path.suffix.lower())
    return None if named is None else (named[0], _remedy(named[1]))


def foreign_json(content: Any) -> tuple[str, str] | None:
    """Return what a JSON value with cameras is, and how to export a COLMAP model instead; None if unknown."""
    if isinstance(content, list):
        first = content[0] if content else None
        if isinstance(first, dict) and {"cameras", "shots"} <= first.keys():
            return "a reconstruction of OpenSfM (WebODM)", _remedy("opensfm export_colmap")
        return None
    if not isinstance(content, dict):
        return None
    if "sfm_data_version" in content:
        return "cameras of OpenMVG", _remedy("openMVG_main_openMVG2Colmap")
    if {"views", "poses"} <= content.keys() or {"views", "intrinsics"} <= content.keys():
        return "cameras of Meshroom (SfM)", _remedy("the node ExportColmap")
    return None


def foreign_cameras_in(folder: Path) -> tuple[str, str] | None:
    """Return what the first such file in a folder is, with its name; None if there is none."""
    named = sorted(each for each in folder.iterdir() if each.suffix.lower() in _SUFFIXES)
    for each in named[:_MOST]:
        if not each.is_file():
            continue
        with open_regular(each) as stream:
            found = foreign_cameras(each, stream.read(2048))
        if found is not None:
            return f"{found[0]}: {each.name}", found[1]
    return None


def _remedy(way: str) -> str:
    """Return advice that names a way to export a COLMAP model."""
    if way == _ANY:
        return f"give {way}"
    return f"export them as a COLMAP model, with undistorted photographs ({way}), and give its folder"
