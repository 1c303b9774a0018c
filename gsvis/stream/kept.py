"""Tables of packages, computed once and kept in files: opening a package again reads its manifest and maps a file.

Everything that planners and coders need is computed from the records: spheres, links between levels, split records, the
tables of the coder. `open_kept` computes it as `StreamedScene.open` does and writes it to a file named by the content.
After that, memory holds only the pages that viewers need, which the processes of a machine share and which can be freed
at any time. Messages are the same to the byte. Files are checked when they are opened, at 6 GB a second, and made again
if a byte has changed.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from gsvis import _check
from gsvis.errors import FormatError, GsvisError
from gsvis.files.limits import DAMAGED
from gsvis.files.locks import try_lock
from gsvis.files.mapped import MappedArrays
from gsvis.files.sums import file_sum
from gsvis.package.package import Package
from gsvis.package.rounding import Quality
from gsvis.stream.header import identity_of
from gsvis.stream.piecewise import SceneTables, write_tables
from gsvis.stream.scene import StreamedScene
from gsvis.stream.source import SceneSource, as_source

__all__ = ["KeptTables", "check_kept", "open_kept"]

_FORMAT = 7  # raise it when the content of the tables changes
_LOG = logging.getLogger(__name__)
_AGAIN = "remove the file; it is made again"
_POLL_S = 0.05  # seconds between two attempts to take a lock
_PIXEL = 2e-3  # radians
_UNUSED_S = 30 * 86400.0  # after so many seconds without use, tables are removed when others are written
_TABLES = ".tables"
_SETS = ".pvs"  # copies of visible sets that earlier versions made
_LOCK = ".lock"
_MAKING = ".making"


class KeptTables:
    """The mapped file of tables of a scene from `open_kept`.

    Attributes:
        nbytes: Bytes of the file.
    """

    def __init__(self, mapped: MappedArrays) -> None:
        self._mapped = mapped
        self.nbytes = mapped.nbytes

    def release(self, shares: Sequence[tuple[float, float]] | None = None) -> None:
        """Free the memory of pages; they are read from the file again when needed. Safe at any time.

        Args:
            shares: Ranges of ids, as shares of all ids in [0, 1], such as those of a tile; None means all.
        """
        self._mapped.release(shares)


def open_kept(
    scene: SceneSource | Package,
    folder: str | os.PathLike[str],
    *,
    max_cache_bytes: int = 512 << 20,
    pixel: float = _PIXEL,
    quality: Quality | None = None,
) -> tuple[StreamedScene, KeptTables | None]:
    """Open a package for streaming from its tables; compute and keep them if they are missing.

    If another process computes the same tables, this one waits for it.

    Args:
        scene: An open package or source, which the caller closes.
        folder: Folder of tables; created if it is missing. Only its owner should be able to write to it.
        max_cache_bytes: Most bytes of decoded sets and candidates of cells to keep; the last is kept in any case.
        pixel: Angle of a pixel of the clients, radians.
        quality: How to round records before they are sent; None means not at all.

    Returns:
        The scene and its tables. The tables are None if they could not be written; then the scene is in memory.

    Raises:
        FormatError: If the package is damaged.
        OSError: If the package cannot be read.
    """
    place = _check.path("folder", folder)
    source = as_source(scene)
    key = _key(source, pixel, quality)
    source.check_parts()
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        path = place / (key + _TABLES)
        mapped = _find(path, source) or _make(source, place, key, pixel=pixel, quality=quality)
    except OSError as error:
        _LOG.warning("tables are not kept: %s", error)
        return StreamedScene.open(source, max_cache_bytes=max_cache_bytes, pixel=pixel, quality=quality), None
    _check_sets(source, mapped)
    tables = SceneTables(mapped.arrays, mapped.facts)
    opened = StreamedScene(source, tables, max_cache_bytes=max_cache_bytes, quality=quality)
    return opened, KeptTables(mapped)


def check_kept(scene: SceneSource | Package, folder: str | os.PathLike[str]) -> list[Path]:
    """Check all tables that a folder keeps of a scene; change nothing.

    Args:
        scene: The open package or source.
        folder: Folder of tables; it may be missing.

    Returns:
        The files of the scene, all valid.

    Raises:
        FormatError: If a file is damaged.
        OSError: If a file cannot be read.
    """
    source = as_source(scene)
    ours = {_key(source, _PIXEL, quality) for quality in (None, Quality())}
    found = []
    for path in sorted(Path(folder).glob(f"*{_TABLES}")):
        mapped = _read_own(path, source, certain=path.stem in ours)
        if mapped is not None:
            found.append(path)
    return found


def _read_own(path: Path, source: SceneSource, *, certain: bool) -> MappedArrays | None:
    """Return the checked tables of a file; None if they belong to a different package.

    Args:
        path: The file.
        source: The scene.
        certain: Whether the name of the file says that it belongs to the scene. If not, a file with a damaged head is
            taken for that of a different package.
    """
    is_ours = certain
    try:
        mapped = MappedArrays(path)
        is_ours = mapped.facts.get("identity") == identity_of(source.manifest, None)
        if is_ours:
            mapped.check()
            return mapped
    except FormatError as error:
        if is_ours:
            raise FormatError(path, error.where, error.expected, error.got, _AGAIN) from error
    return None


def _key(source: SceneSource, pixel: float, quality: Quality | None) -> str:
    """Return the name of the tables: a hash of everything that they depend on."""
    manifest = source.manifest
    facts = [
        _FORMAT,
        _version(),
        sorted(part.name for part in manifest.parts()),
        identity_of(manifest, None),
        manifest.info.epsilon,
        manifest.info.up,
        manifest.info.meters_per_unit,
        manifest.scene,
        pixel,
        None if quality is None else asdict(quality),
    ]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:32]


def _version() -> str:
    """Return the version of the installed gsvis."""
    try:
        return version("gsvis")
    except PackageNotFoundError:  # run from its sources
        return "unknown"


def _find(path: Path, source: SceneSource) -> MappedArrays | None:
    """Return the tables of a file; None if it is missing, damaged, or of a different package."""
    try:
        found = MappedArrays(path)
        identity = identity_of(source.manifest, None)
        if identity != found.facts.get("identity"):
            got = repr(found.facts.get("identity"))[:80]
            raise FormatError(path, "identity", f"{identity!r}, that of the package", got, _AGAIN)
        found.check()
    except FileNotFoundError:
        return None
    except GsvisError as error:
        _LOG.warning("tables are made again: %s", error)
        return None
    with suppress(OSError):
        os.utime(path)
    return found


def _check_sets(source: SceneSource, mapped: MappedArrays) -> None:
    """Raise FormatError unless the visible sets are those from which the tables were computed."""
    for path, known in zip(source.set_files(), mapped.facts["sets"], strict=True):
        found = file_sum(path)
        if found != known:
            raise FormatError(path, "", f"visible sets with checksum {known}", found, DAMAGED)


def _make(source: SceneSource, folder: Path, key: str, *, pixel: float, quality: Quality | None) -> MappedArrays:
    """Compute, write and return tables; if another process is computing them, wait and return its tables."""
    path = folder / (key + _TABLES)
    with (folder / (key + _LOCK)).open("w") as lock:
        while try_lock(lock.fileno()) == "busy":
            time.sleep(_POLL_S)
        if (found := _find(path, source)) is not None:
            return found
        _remove_unused(folder)
        sets = [file_sum(each) for each in source.set_files(verify=True)]
        own = {"identity": identity_of(source.manifest, None), "sets": sets}
        with _empty_folder(folder / (key + _MAKING)) as work:
            write_tables(path, source, own, work, pixel=pixel, quality=quality)
    source.forget_records()
    return MappedArrays(path)


@contextmanager
def _empty_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder, and remove it at the end; files that a killed process left in it are deleted."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _remove_unused(folder: Path) -> None:
    """Remove tables that have not been opened for a month."""
    now = time.time()
    for path in folder.iterdir():
        if path.suffix in (_TABLES, _SETS, _LOCK, _MAKING):
            with suppress(OSError):
                if now - path.stat().st_mtime > _UNUSED_S:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
