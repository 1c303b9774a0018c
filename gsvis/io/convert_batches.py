"""Convert scenes of any size to a PLY, batch by batch. The bytes are those of `merge_scenes` and `convert_scene`.

Memory holds one batch. Scenes are read twice if a first reading must count the Gaussians that are left.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from gsvis.errors import SceneError
from gsvis.io.batches import Batch, align_batches, facts_of_batches, read_batch
from gsvis.io.convert import report_merge
from gsvis.io.ply import save_ply_parts
from gsvis.progress import Progress, silent
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians

__all__ = ["Converted", "convert_batches"]

Convert = Callable[[Gaussians], Gaussians]


@dataclass(frozen=True)
class Converted:
    """Counts of Gaussians read and written.

    Attributes:
        counts: Gaussians of each scene.
        sh_degrees: SH degree of each scene.
        gaussians: Number of Gaussians written.
        sh_degree: SH degree written.
    """

    counts: tuple[int, ...]
    sh_degrees: tuple[int, ...]
    gaussians: int
    sh_degree: int


def convert_batches(
    scenes: Sequence[Sequence[Batch]],
    out: str | os.PathLike[str],
    convert: Convert,
    *,
    drops: bool,
    max_sh_degree: int = 3,
    progress: Progress = silent,
) -> Converted:
    """Write scenes to one PLY, in their order, each batch converted by itself.

    Args:
        scenes: The batches of each scene.
        out: The PLY.
        convert: Function that converts a batch, such as `convert_scene`; raises SceneError if it leaves nothing.
        drops: Whether `convert` may leave Gaussians out.
        max_sh_degree: Highest SH degree that `convert` keeps.
        progress: Called with stages "reading", if all has to be read first, and "writing", in batches.

    Raises:
        SceneError: If nothing is left.
        FormatError: If a scene is damaged.
        OSError: If the file cannot be written.
    """
    by_header = not drops and all(batch.kind == "rows" for scene in scenes for batch in scene)
    survey = _headers(scenes) if by_header else _survey(scenes, convert if drops else None, progress)
    if not survey.gaussians:
        raise SceneError(
            f"convert: crop and min_opacity leave none of {sum(survey.counts):,} Gaussians; gsvis inspect shows"
            " where the scene lies"
        )
    degree = max(survey.sh_degrees)
    written = min(degree, max_sh_degree)
    parts = _parts(scenes, degree, convert, progress)
    first = next(parts)  # exists, because the survey has counted Gaussians
    save_ply_parts(chain([first], parts), out, survey.gaussians, written, first.facts)
    return replace(survey, sh_degree=written)


def _headers(scenes: Sequence[Sequence[Batch]]) -> Converted:
    """Return the counts from headers and first rows of PLYs, if all Gaussians are kept."""
    counts = tuple(sum(batch.count for batch in scene) for scene in scenes)
    degrees = tuple(read_batch(replace(scene[0], count=1)).sh_degree for scene in scenes)
    return Converted(counts, degrees, sum(counts), max(degrees))


def _survey(scenes: Sequence[Sequence[Batch]], convert: Convert | None, progress: Progress) -> Converted:
    """Return the counts by reading all batches; None converts nothing."""
    total = sum(map(len, scenes))
    done = 0
    left = 0
    counts = [0] * len(scenes)
    degrees = [0] * len(scenes)
    progress("reading", 0, total)
    for k, scene in enumerate(scenes):
        for batch in scene:
            part = read_batch(batch)
            counts[k] += len(part)
            degrees[k] = max(degrees[k], part.sh_degree)
            left += len(part) if convert is None else sum(map(len, _converted(part, convert)))
            done += 1
            progress("reading", done, total)
    return Converted(tuple(counts), tuple(degrees), left, max(degrees))


def _parts(scenes: Sequence[Sequence[Batch]], degree: int, convert: Convert, progress: Progress) -> Iterator[Gaussians]:
    """Yield the converted batches that are not empty."""
    aligned = align_batches(scenes)
    batches = [batch for scene in aligned for batch in scene]
    facts = _merged_facts(aligned) if len(scenes) > 1 else None
    progress("writing", 0, len(batches))
    for done, batch in enumerate(batches, 1):
        part = _padded(read_batch(batch), degree)
        yield from _converted(part if facts is None else part.with_facts(facts), convert)
        progress("writing", done, len(batches))


def _merged_facts(scenes: Sequence[Sequence[Batch]]) -> SceneFacts:
    """Return the facts of the merged scene, from the first batch of each scene."""
    facts = [facts_of_batches(scene) for scene in scenes]
    report_merge(facts)
    return SceneFacts.merge(facts)


def _converted(part: Gaussians, convert: Convert) -> list[Gaussians]:
    """Return the converted batch; an empty list if nothing is left."""
    try:
        return [convert(part)]
    except SceneError:
        return []


def _padded(part: Gaussians, degree: int) -> Gaussians:
    """Return a batch with zeros for SH coefficients up to a degree."""
    missing = (degree + 1) ** 2 - 1 - part.shN.shape[1]
    if not missing:
        return part
    higher = np.pad(part.shN, ((0, 0), (0, missing), (0, 0)))
    g = part
    return Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0, higher, facts=g.facts)
