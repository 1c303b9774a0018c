"""Build a scene from decoded numbers: activations, packed quaternions, and errors that name the file.

Readers pass raw or activated arrays; a value that `Gaussians` rejects becomes a `FormatError`. All arrays are float32
unless stated otherwise, quaternions wxyz. This module opens no file.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.io.invalid import REMEDY, find_invalid, is_dropping
from gsvis.io.losses import report_loss, report_note
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0

__all__ = [
    "bytes_of_scene",
    "exp_scales",
    "format_error",
    "gaussians_from",
    "largest_from_three",
    "logits",
    "report_dropped",
    "sh0_from_rgb",
    "sigmoid",
    "smallest_three",
]

F32 = NDArray[np.float32]
_NOTHING_KNOWN = SceneFacts()
NOTHING_LEFT = "none; no row would be left"
LEAST_SCALE = float(np.finfo(np.float32).tiny)


def sigmoid(logit_opacities: NDArray[np.floating[Any]], out: F32 | None = None) -> F32:
    """Return 1 / (1 + exp(-x)) in float32; infinite logits become 0 and 1, NaN stays NaN for the caller's check."""
    result: F32 = np.empty(logit_opacities.shape, np.float32) if out is None else out
    with np.errstate(all="ignore"):
        np.negative(logit_opacities, out=result)
        np.exp(result, out=result)
        np.add(result, np.float32(1.0), out=result)
        np.reciprocal(result, out=result)
    return result


def logits(opacities: NDArray[np.floating[Any]]) -> F32:
    """Return the inverse of `sigmoid`; 0 and 1 become -120 and 40, finite values that `sigmoid` maps back exactly."""
    p = opacities.astype(np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray(np.clip(np.log(p) - np.log1p(-p), -120.0, 40.0), np.float32)


def exp_scales(log_scales: NDArray[np.floating[Any]], out: F32 | None = None) -> F32:
    """Return exp in float32, kept above 0: a flat Gaussian has a log scale of -inf. NaN and overflow remain."""
    with np.errstate(all="ignore"):
        result: F32 = np.exp(log_scales, out=out, dtype=np.float32)
        np.maximum(result, LEAST_SCALE, out=result)
    return result


def sh0_from_rgb(rgb: NDArray[np.floating[Any]]) -> F32:
    """Return (N, 1, 3) constant coefficients of (N, 3) base colors, 0 to 1."""
    with np.errstate(over="ignore"):  # a huge color becomes infinite and is rejected later
        return ((rgb - 0.5) / SH_C0).astype(np.float32)[:, None, :]


def largest_from_three(three: NDArray[np.floating[Any]], largest: NDArray[np.integer[Any]]) -> F32:
    """Return unit quaternions from their three smaller components.

    Args:
        three: (N, 3) the other components, in their order.
        largest: (N,) 0 to 3, the index of the missing component, which is positive.

    Returns:
        (N, 4) in the component order of the file.
    """
    rest = np.sqrt(np.maximum(0.0, 1.0 - np.einsum("ij,ij->i", three, three)))
    quats = np.empty((len(three), 4), np.float32)
    for place in range(4):
        rows = largest == place
        quats[rows, place] = rest[rows]
        for column, other in enumerate(c for c in range(4) if c != place):
            quats[rows, other] = three[rows, column]
    return quats


def smallest_three(quats: F32) -> tuple[F32, NDArray[np.int64]]:
    """Return the three smaller components (N, 3) of unit quaternions (N, 4), and the index of the largest.

    The inverse of `largest_from_three`: signs are chosen so that the largest component is positive.
    """
    largest = np.abs(quats).argmax(axis=1)
    positive = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -quats, quats)
    others = np.array([[c for c in range(4) if c != place] for place in range(4)])
    return np.take_along_axis(positive, others[largest], axis=1), largest


def bytes_of_scene(count: int, sh_degree: int) -> int:
    """Return the bytes of a scene's arrays in memory."""
    return count * 4 * (11 + 3 * (sh_degree + 1) ** 2)


def gaussians_from(
    path: str | os.PathLike[str],
    means: F32,
    quats: F32,
    scales: F32,
    opacities: F32,
    sh0: F32,
    shN: F32 | None = None,  # noqa: N803  the field's own name
    facts: SceneFacts = _NOTHING_KNOWN,
) -> Gaussians:
    """Return a scene from the values in a file.

    A quaternion of zeros is no rotation, as in the rasterizer of 3DGS. Rows with other values that no Gaussian can
    have are left out inside `dropping_invalid`, and refused elsewhere.

    Raises:
        FormatError: If there is no Gaussian, a value is not finite or out of its range.
    """
    if len(means) == 0:
        raise FormatError(path, "", "at least one Gaussian", "none", "the file holds an empty scene")
    try:
        return Gaussians(means, quats, scales, opacities, sh0, shN, facts=facts)
    except ValueError as error:
        refused = error
    arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh0": sh0}
    if shN is not None:
        arrays["shN"] = shN
    if len({len(values) for values in arrays.values()}) > 1:
        raise format_error(path, refused) from refused
    return _without_invalid_rows(path, arrays, facts, refused)


def _without_invalid_rows(
    path: str | os.PathLike[str], arrays: dict[str, NDArray[Any]], facts: SceneFacts, refused: ValueError
) -> Gaussians:
    """Return the scene without invalid rows if they may be dropped; raise otherwise."""
    choice = is_dropping()
    bad = find_invalid(arrays)
    with np.errstate(all="ignore"):
        unturned = ~bad & (np.einsum("ij,ij->i", arrays["quats"], arrays["quats"], dtype=np.float64) < 1e-24)
    if unturned.any():
        arrays["quats"] = np.where(unturned[:, None], np.array([1, 0, 0, 0], np.float32), arrays["quats"])
        report_note(path, f"{int(unturned.sum()):,} Gaussians have a quaternion of zeros, which is read as no rotation")
    if bad.any():
        if not choice.drops:
            found = format_error(path, refused)
            remedy = f"{int(bad.sum()):,} of {len(bad):,} rows have such values; {REMEDY}"
            raise FormatError(path, found.where, found.expected, found.got, remedy) from refused
        if bad.all():
            raise FormatError(path, "", "at least one valid row", NOTHING_LEFT) from refused
        arrays = {name: values[~bad] for name, values in arrays.items()}
        if not choice.quiet:
            report_dropped(path, int(bad.sum()), len(bad))
    try:
        return Gaussians(**arrays, facts=facts)
    except ValueError as error:
        raise format_error(path, error) from error


def report_dropped(path: str | os.PathLike[str], count: int, total: int) -> None:
    """Log how many rows were left out."""
    text = f"{count:,} of {total:,} rows are dropped; their values are not finite or out of range"
    report_loss(path, "rows", text, count)


def format_error(path: str | os.PathLike[str], error: ValueError) -> FormatError:
    """Return the error about a file for an error about arrays that came from it."""
    where, _, rest = str(error).partition(": expected ")
    expected, _, got = rest.partition(", got ")
    got = got.partition("; ")[0]  # drop the remedy, which is for callers that pass arrays
    return FormatError(path, where if rest else "", expected or "valid values", got or str(error))
