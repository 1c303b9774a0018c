"""Read a scene of any format, and write one in the format of its suffix.

The content decides the format; the suffix decides only if there is no magic number (`.splat`, `.ksplat`). Each format
has its own module.
"""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable
from pathlib import Path

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.fields import parse_object
from gsvis.files.limits import open_regular, read_whole
from gsvis.io._origin import settle_origin
from gsvis.io._table import join_names
from gsvis.io._wrapped import GZIP, HEAD, check_pointer, gunzip, peek_gzip
from gsvis.io.checkpoint import is_checkpoint, load_checkpoint
from gsvis.io.compressed_ply_writer import save_compressed_ply
from gsvis.io.folders import scene_remedy
from gsvis.io.gltf_splats import MAGIC, decode_gltf_splats, load_gltf_splats
from gsvis.io.invalid import dropping_invalid, is_dropping
from gsvis.io.ksplat import load_ksplat, save_ksplat
from gsvis.io.ply import load_ply, read_ply, save_ply
from gsvis.io.sog import load_sog
from gsvis.io.sog_writer import save_sog
from gsvis.io.splat import decode_splat, load_splat
from gsvis.io.spz import load_spz, save_spz
from gsvis.io.streamed_sog import load_streamed_sog
from gsvis.scene.gaussians import Gaussians

__all__ = ["WRITTEN", "check_scene", "load_scene", "save_scene", "suffix_of"]

_KNOWN = (
    "a scene: PLY (.ply, .compressed.ply), .splat, .ksplat, SPZ (.spz), SOG (.sog or a folder with meta.json), "
    "streamed SOG (lod-meta.json or its folder), glTF with Gaussians (.glb, .gltf) "
    "or a checkpoint of gsplat or nerfstudio (.pt, .ckpt)"
)
_READERS: dict[str, Callable[[str | os.PathLike[str]], Gaussians]] = {
    ".ply": load_ply,
    ".splat": load_splat,
    ".ksplat": load_ksplat,
    ".spz": load_spz,
    ".sog": load_sog,
    ".glb": load_gltf_splats,
    ".gltf": load_gltf_splats,
}
_PLACED = (load_splat, load_ksplat, load_gltf_splats, load_checkpoint)
"""Readers of formats with centers as floats, which may lie too far from (0, 0, 0) for float32."""

_WRITERS: dict[str, Callable[[Gaussians, str | os.PathLike[str]], None]] = {
    ".ply": save_ply,
    ".spz": save_spz,
    ".sog": save_sog,
    ".ksplat": save_ksplat,
    ".compressed.ply": save_compressed_ply,
}
WRITTEN = tuple(_WRITERS)
"""Suffixes of the formats that `save_scene` writes."""

_MAGICS = {b"ply": ".ply", b"NGSP": ".spz", b"PK": ".sog", b"glTF": ".glb"}


def check_scene(path: str | os.PathLike[str], lod: int | None = None) -> bool:
    """Raise unless a path holds a scene of a known format; return whether it is a streamed SOG.

    Reads only names and first bytes, so that inputs can be checked before long work.

    Args:
        path: As for `load_scene`.
        lod: As for `load_scene`.

    Raises:
        FileNotFoundError: If there is nothing at `path`.
        FormatError: If the format is unknown.
        ValueError: If `lod` is given for a format with one level.
    """
    return _find_reader(_check.path("path", path), lod) is None


def load_scene(path: str | os.PathLike[str], lod: int | None = None, *, drop_invalid: bool | None = None) -> Gaussians:
    """Read a scene of 3D Gaussians in any known format.

    Args:
        path: An INRIA or compressed PLY, a `.splat`, a `.ksplat`, an SPZ (version 1 to 4), a SOG (`.sog`, `meta.json`
            or its folder), a streamed SOG (`lod-meta.json` or its folder), glTF with Gaussians (`.glb`, or `.gltf` with
            its `.bin`), or a checkpoint of gsplat or of nerfstudio's splatfacto (`.pt`, `.ckpt`). A PLY, a
            `.splat` or glTF may be gzipped.
        lod: Level of detail of a streamed SOG, 0 the finest; None takes the finest present. Other formats have one
            level and need None.
        drop_invalid: Drop rows whose values are not finite or out of range, with one line in the log; False makes them
            an error. None takes the choice of `gsvis.io.invalid.dropping_invalid`, by default an error.

    Returns:
        The scene, in the file's order and frame, activated. SPZ is rotated to the frame of the same scene's PLY; glTF
        has +y up. `facts` holds other properties that the file states. Centers far from (0, 0, 0) are relative to
        `facts.origin`.

    Raises:
        FileNotFoundError: If there is nothing at `path`.
        FormatError: If the format is unknown, or the file is damaged, truncated, empty or made to exhaust memory.
        ValueError: If `lod` is not an integer >= 0, or is given for a format with one level.
    """
    where = _check.path("path", path)
    choice = is_dropping()
    with dropping_invalid(choice.drops if drop_invalid is None else drop_invalid, quiet=choice.quiet):
        reader = _find_reader(where, lod)
        if reader is None:
            return load_streamed_sog(where, lod)
        scene = reader(where)
    return settle_origin(scene) if reader in _PLACED and not any(scene.facts.origin) else scene


def _find_reader(path: Path, lod: int | None) -> Callable[[str | os.PathLike[str]], Gaussians] | None:
    """Return the reader for a path; None for a streamed SOG, which has levels of detail."""
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no scene file or folder here", str(path))
    _check_content(path)
    if _is_streamed(path):
        return None
    reader = _reader(path)
    if lod is not None:
        raise ValueError(f"lod: expected None for a file with one level of detail, got {lod!r}; omit it")
    return reader


def save_scene(scene: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write a scene in the format of the path's suffix, atomically.

    INRIA PLY (`.ply`) keeps everything; SPZ (`.spz`) and SOG (`.sog`) are about ten times smaller and lossy; `.ksplat`
    for GaussianSplats3D and compressed PLY (`.compressed.ply`) for PlayCanvas are also lossy.

    Args:
        scene: The scene.
        path: A file name that ends in `.ply`, `.spz`, `.sog`, `.ksplat` or `.compressed.ply`; its folder is
            created if missing.

    Raises:
        ValueError: If the suffix is not one of these, the scene is empty, or the format cannot hold it.
        OSError: If the file cannot be written.
    """
    where = _check.path("path", path)
    writer = _WRITERS.get(suffix_of(where))
    if writer is None:
        near = _check.suggestion(where.suffix, _WRITERS)
        raise ValueError(
            f"path: expected a name that ends in {', '.join(_WRITERS)}, got {where.name!r}; "
            + (near or "gsvis can only read other formats")
        )
    if len(scene) == 0:
        raise ValueError("scene: expected at least one Gaussian, got an empty scene; there is nothing to write")
    writer(scene, where)


def suffix_of(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a scene file in small letters: '.ply', or '.compressed.ply' where both parts are there."""
    name = os.fspath(path).lower()
    return ".compressed.ply" if name.endswith(".compressed.ply") else Path(name).suffix


def _check_content(path: Path) -> None:
    """Raise if a file, or the JSON of a folder, is a pointer of Git LFS or git-annex."""
    files = [path] if path.is_file() else [path / name for name in ("lod-meta.json", "meta.json")]
    for file in files:
        if file.is_file():
            with open_regular(file) as stream:
                check_pointer(file, stream.read(HEAD))


def _load_gzip(path: str | os.PathLike[str]) -> Gaussians:
    """Read a gzipped scene: SPZ of version 1 to 3, PLY, `.splat`, or glTF."""
    head = peek_gzip(path)
    name = os.fspath(path).lower()
    if head.startswith(b"NGSP") or name.endswith(".spz"):
        return load_spz(path)
    if head.startswith(b"ply"):
        data = gunzip(path)
        return read_ply(path, io.BytesIO(data), len(data))
    if name.removesuffix(".gz").endswith(".splat"):
        return settle_origin(decode_splat(path, gunzip(path)))
    if head.startswith(MAGIC) or name.removesuffix(".gz").endswith(".gltf"):
        scene = decode_gltf_splats(path, gunzip(path))
        return scene if any(scene.facts.origin) else settle_origin(scene)
    got = f"a gzip of something that begins {head[:8]!r}"
    raise FormatError(path, "", "a gzip of SPZ, PLY, .splat or glTF", got, "unpack it with gunzip, or tar -xzf")


def _is_streamed(path: Path) -> bool:
    """Return whether this is a streamed SOG scene: by file name in a folder, by content otherwise."""
    if path.is_dir():
        return (path / "lod-meta.json").is_file()
    if path.suffix.lower() != ".json":
        return False
    fields = parse_object(path, read_whole(path))
    if not any(key in fields for key in ("tree", "filenames", "means")) and path.name not in (
        "meta.json",
        "lod-meta.json",
    ):
        keys = join_names(list(fields.value))
        raise FormatError(path, "", _KNOWN, f"JSON with keys {keys}", scene_remedy(path.parent))
    return "tree" in fields or "filenames" in fields or path.name == "lod-meta.json"


def _reader(path: Path) -> Callable[[str | os.PathLike[str]], Gaussians]:
    """Return the reader for a file or folder that is not a streamed SOG."""
    if path.is_dir():
        if not (path / "meta.json").is_file():
            raise FormatError(path, "", _KNOWN, "a folder without meta.json or lod-meta.json", scene_remedy(path))
        return load_sog
    if path.suffix.lower() == ".json":
        return load_sog
    with open_regular(path) as stream:
        head = stream.read(8)
    if not head:
        raise FormatError(path, "", _KNOWN, "an empty file", "was the download or the export interrupted?")
    if head.startswith(GZIP):
        return _load_gzip
    for magic, suffix in _MAGICS.items():
        if head.startswith(magic):
            return load_checkpoint if magic == b"PK" and is_checkpoint(path) else _READERS[suffix]
    reader = _READERS.get(path.suffix.lower())
    if reader is None and head.startswith(b"\x80"):
        expected = "a zip, as torch writes checkpoints since 1.6"
        remedy = "load it with torch and torch.save it again"
        raise FormatError(path, "", expected, "a bare pickle, perhaps of torch before 1.6", remedy)
    if reader is None:
        # nerfstudio and gsplat write a config.yml or cfg.yml beside their checkpoints
        remedy = scene_remedy(path.parent) if path.suffix.lower() in (".yml", ".yaml") else ""
        raise FormatError(path, "", _KNOWN, f"a file beginning {head!r} named {path.name!r}", remedy)
    return reader
