"""Find the smallest whole file of a scene with view-dependent color and good quality, as a realistic baseline.

Each format that gsvis writes is written, measured, read back, and compared with the scene. Bytes, dB.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.color.to_sh import to_sh
from gsvis.files.output import TEMPORARY, output_errors
from gsvis.files.temporary import temporary_folder
from gsvis.io.losses import LOGGER
from gsvis.io.scenes import load_scene
from gsvis.io.sog_writer import save_sog
from gsvis.io.spz import save_spz
from gsvis.package.contents import Contents
from gsvis.progress import Progress, silent
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.morton import morton_order
from gsvis.simulate.frames import psnr_of
from gsvis.simulate.viewing import GOOD_DB

__all__ = ["WholeFileSize", "choose_whole_file", "describe_whole_file", "measure_whole_files", "scene_with_sh"]

_MOST_DB = 100.0
_SH_DEGREE = 3

_FORMATS: tuple[tuple[str, str, Callable[[Gaussians, Path], None]], ...] = (
    ("SOG as gsvis writes it", "scene.sog", save_sog),
    ("SPZ as gsvis writes it", "scene.spz", save_spz),
    ("compact SPZ as gsvis writes it", "compact.spz", lambda g, path: save_spz(g, path, compact=True)),
)


@dataclass(frozen=True)
class WholeFileSize:
    """One file of a scene.

    Attributes:
        name: Its format, or the name of the file.
        nbytes: Its bytes.
        psnr: Mean PSNR of its images against those of the scene, dB, at most 100.
    """

    name: str
    nbytes: int
    psnr: float

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        return asdict(self)


def measure_whole_files(
    scene: Gaussians, cameras: Cameras, own: tuple[str, int] | None = None, *, progress: Progress = silent
) -> tuple[WholeFileSize, ...]:
    """Write a scene in each format; return sizes and image quality.

    Args:
        scene: The scene, with its spherical harmonics.
        cameras: Views in which the files are compared with the scene.
        own: Name and bytes of the scene's own file, which is lossless.
        progress: Called with stage "whole files".

    Raises:
        OutputError: If the temporary folder cannot be written.
    """
    full = _images(scene, cameras)
    ordered = scene[morton_order(scene.means)]
    found = [] if own is None else [WholeFileSize(*own, _MOST_DB)]
    progress("whole files", 0, len(_FORMATS))
    with temporary_folder() as folder, _quiet():
        for k, (name, file, save) in enumerate(_FORMATS):
            path = Path(folder) / file
            with output_errors(folder, remedy=TEMPORARY):
                save(ordered, path)
            drawn = _images(load_scene(path), cameras)
            quality = [min(psnr_of(a, b), _MOST_DB) for a, b in zip(drawn, full, strict=True)]
            found.append(WholeFileSize(name, path.stat().st_size, round(float(np.mean(quality)), 2)))
            progress("whole files", k + 1, len(_FORMATS))
    return tuple(found)


def choose_whole_file(sizes: tuple[WholeFileSize, ...]) -> WholeFileSize:
    """Return the smallest file with good images; the best file if none has good images.

    Args:
        sizes: At least one file.
    """
    good = [each for each in sizes if each.psnr >= GOOD_DB]
    return min(good, key=lambda each: each.nbytes) if good else max(sizes, key=lambda each: each.psnr)


def describe_whole_file(sizes: tuple[WholeFileSize, ...], chosen: WholeFileSize, of: str) -> str:
    """Return a description of how the size of the whole file was measured, for reports.

    Args:
        sizes: All files.
        chosen: One of them.
        of: Name of the scene in the files.
    """
    others = [f"{each.name} {each.nbytes / 1e6:.2f} MB, {each.psnr:.1f} dB" for each in sizes if each is not chosen]
    why = f"the smallest of at least {GOOD_DB:g} dB" if chosen.psnr >= GOOD_DB else f"the best; none has {GOOD_DB:g} dB"
    text = f"{chosen.name} of {of}, with view-dependent color, {chosen.psnr:.1f} dB: {why}"
    return "; others: ".join([text, "; ".join(others)]) if others else text


def scene_with_sh(contents: Contents, ids: NDArray[np.int64]) -> Gaussians:
    """Return Gaussians of a package with SH fitted to their terms; with base colors if there are no terms.

    Args:
        contents: The package.
        ids: (M,) Gaussians.
    """
    g = contents.gaussians(ids)
    if len(contents.term_records) == 0:
        return g
    sh = to_sh(contents.colors().dequantize(), sh_degree=_SH_DEGREE)
    return Gaussians(g.means, g.quats, g.scales, g.opacities, sh.sh0[ids], sh.shN[ids], facts=g.facts)


def _images(scene: Gaussians, cameras: Cameras) -> NDArray[np.float32]:
    """Return (C, H, W, 3) images in [0, 1]."""
    drawn = rasterize(scene, cameras, backend="cpu").images
    return np.clip(np.asarray(drawn, np.float32), 0.0, 1.0)


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress losses in the log: quality is measured, and these files are deleted."""
    logger = logging.getLogger(LOGGER)
    logger.addFilter(_drop)
    try:
        yield
    finally:
        logger.removeFilter(_drop)


def _drop(record: logging.LogRecord) -> bool:
    """Return False, which drops a log record."""
    return False
