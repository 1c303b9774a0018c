"""Read and write scenes with SRBF colors as one Arrow file: one row per Gaussian, with its terms as a list.

Any Arrow client reads it. Floats are exact. Quantized colors are the integers of `QuantizedColors`, and the header has
the parameters of their tables. Frame and units are the scene's own. `gsvis.files.arrow` guards the bytes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from gsvis.color.evaluate import evaluate_along
from gsvis.color.records import Grids, Precision, QuantizedColors, has_scales, quantize
from gsvis.color.srbf import SrbfColors
from gsvis.color.variants import VARIANTS, Variant
from gsvis.errors import FormatError
from gsvis.files.arrow import ArrowFile, write_arrow
from gsvis.files.fields import Fields
from gsvis.files.limits import Budget
from gsvis.jobs.freed_memory import release_freed_memory
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0

__all__ = ["SrbfInfo", "grids_of", "load_srbf", "load_srbf_colors", "save_srbf", "srbf_info"]

FORMAT = "gsvis-srbf"
VERSION = 1
ROWS = 1 << 16
"""Maximum number of Gaussians in a batch; bounds the memory of writing."""

_MOST = (1 << 31) - 1
_GEOMETRY = {"means": 3, "quats": 4, "scales": 3, "opacities": 1}


@dataclass(frozen=True)
class SrbfInfo:
    """Contents of a file's header.

    Attributes:
        variant: One of `VARIANTS`.
        gaussians: N.
        terms: T.
        scene: `scene_hash` of the saved scene, with its SH colors.
        grids: Tables that the integers index; None if colors are floats.
        provenance: Origin of the colors, as given to `save_srbf`.
        nbytes: Size of the file.
    """

    variant: str
    gaussians: int
    terms: int
    scene: str
    grids: Grids | None
    provenance: dict[str, Any]
    nbytes: int


def save_srbf(
    path: str | os.PathLike[str],
    g: Gaussians,
    colors: SrbfColors | QuantizedColors,
    *,
    precision: Precision | str | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write the geometry of a scene and its SRBF colors, atomically.

    Args:
        path: The file, by convention `.arrow`.
        g: N Gaussians. Their SH colors are not stored; their hash is.
        colors: Colors of the same N Gaussians, as floats or quantized.
        precision: Quantize first, as `quantize` does; None keeps all floats exact.
        provenance: JSON values to store in the file.

    Raises:
        ValueError: If the numbers of Gaussians differ, colors would be quantized twice, or `provenance` is not JSON.
        OSError: If the file cannot be written.
    """
    if len(g) != len(colors):
        raise ValueError(f"colors: expected one for each of {len(g):,} Gaussians, got {len(colors):,}")
    if precision is not None:
        if isinstance(colors, QuantizedColors):
            raise ValueError(f"precision: expected None for quantized colors, got {precision!r}; quantize them once")
        colors = quantize(colors, precision)
    try:
        kept = json.loads(json.dumps(dict(provenance or {}), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"provenance: expected JSON values, got {error}") from error
    grids = colors.grids if isinstance(colors, QuantizedColors) else None
    kind = VARIANTS[grids.variant] if grids else VARIANTS[colors.variant]  # type: ignore[union-attr]
    header = {
        "format": FORMAT,
        "version": VERSION,
        "variant": kind.name,
        "gaussians": len(colors),
        "terms": colors.num_terms,
        "scene": scene_hash(g),
        "quantized": None if grids is None else asdict(grids),
        "provenance": kept,
    }
    columns = _schema(kind, grids)
    write_arrow(path, columns, header, _batches(g, colors, pa.schema(columns)))


def load_srbf(path: str | os.PathLike[str]) -> tuple[Gaussians, SrbfColors]:
    """Read a file of `save_srbf`.

    Args:
        path: The file.

    Returns:
        The Gaussians, of SH degree 0: sh0 is the base color in RGB, so that a viewer without SRBF shows the scene
        without its view dependence. And the colors, dequantized if the file has integers.

    Raises:
        FormatError: If the file has another format, a newer version, is truncated or damaged, or has inconsistent
            values.
        OSError: If it cannot be opened.
    """
    colors, columns = _read(path)
    with _explained(path):
        rgb = evaluate_along(colors.first(0), [[0.0, 0.0, 1.0]])[:, 0]
        sh0 = ((rgb.astype(np.float64) - 0.5) / SH_C0)[:, None]
        scene = Gaussians(columns["means"], columns["quats"], columns["scales"], columns["opacities"][:, 0], sh0)
    return scene, colors


def load_srbf_colors(path: str | os.PathLike[str]) -> SrbfColors:
    """Read the colors of a file of `save_srbf`, dequantized if it has integers; geometry is not looked at.

    Raises:
        FormatError: As `load_srbf` does, but for values of the geometry.
        OSError: If it cannot be opened.
    """
    return _read(path)[0]


def _read(path: str | os.PathLike[str]) -> tuple[SrbfColors, dict[str, NDArray[Any]]]:
    """Return the colors of a file, and its columns."""
    file = ArrowFile(path, FORMAT, VERSION)
    info = _info(file)
    kind = VARIANTS[info.variant]
    file.check_schema(pa.schema(_schema(kind, info.grids)))
    columns, counts = _read_columns(file)
    release_freed_memory()
    for what, claimed, found in (("gaussians", info.gaussians, len(counts)), ("terms", info.terms, int(counts.sum()))):
        if claimed != found:
            raise FormatError(path, what, f"{claimed:,} as the header says", f"{found:,}", "the file is damaged")
    offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    with _explained(path):
        return _colors(kind, info.grids, columns, offsets), columns


@contextmanager
def _explained(path: str | os.PathLike[str]) -> Iterator[None]:
    """Raise `FormatError` for values that do not fit."""
    try:
        yield
    except ValueError as error:
        where, _, rest = str(error).partition(": expected ")
        expected, _, got = rest.partition(", got ")
        raise FormatError(path, where, expected or "valid values", got or "values that do not fit") from error


def srbf_info(path: str | os.PathLike[str]) -> SrbfInfo:
    """Read the header of a file; verify its checksum and skip its rows.

    Raises:
        FormatError: If the file has another format or a newer version, or is truncated or damaged.
        OSError: If it cannot be opened.
    """
    return _info(ArrowFile(path, FORMAT, VERSION))


def _schema(kind: Variant, grids: Grids | None) -> list[pa.Field]:
    """Return the fields of the file; parts that a variant lacks have no column."""

    def field(name: str, kind: pa.DataType, length: int = 0) -> pa.Field:
        """Return a field of fixed-length lists, or of single values for length 0."""
        return pa.field(name, _fixed_list(kind, length) if length else kind, nullable=False)

    def number(bits: str) -> pa.DataType:
        """Return the Arrow type of numbers with these bits."""
        if grids is None:
            return pa.float32()
        return pa.uint8() if getattr(grids.precision, bits) <= 8 else pa.uint16()

    columns = [field(name, pa.float32(), 0 if length == 1 else length) for name, length in _GEOMETRY.items()]
    columns.append(field("base", number("base"), 3))
    if grids is None or has_scales(kind):
        columns.append(field("color_scales", number("scale")))
    term = [
        field("function", pa.uint8()),
        field("theta", number("center")),
        field("phi", pa.float32() if grids is None else pa.uint16()),
        field("decay", number("decay")),
        field("intensities", number("intensity"), kind.intensities),
    ]
    columns.append(field("terms", pa.list_(pa.field("item", pa.struct(term), nullable=False))))
    return columns


def _fixed_list(kind: pa.DataType, length: int) -> pa.DataType:
    """Return the type of lists of a fixed length."""
    return pa.list_(pa.field("item", kind, nullable=False), length)


def _batches(g: Gaussians, colors: SrbfColors | QuantizedColors, schema: pa.Schema) -> Iterator[pa.RecordBatch]:
    """Yield the rows of the file, a batch at a time."""
    for start in range(0, len(g), ROWS):
        rows = slice(start, min(start + ROWS, len(g)))
        offsets = colors.offsets[rows.start : rows.stop + 1]
        terms = slice(int(offsets[0]), int(offsets[-1]))
        values: dict[str, NDArray[Any]] = {name: getattr(g, name)[rows] for name in _GEOMETRY}
        values |= {"base": colors.base[rows], "color_scales": colors.scales[rows]}
        parts = {
            "function": colors.functions[terms],
            "theta": colors.centers[terms, 0],
            "phi": colors.centers[terms, 1],
            "decay": colors.decays[terms],
            "intensities": colors.intensities[terms],
        }
        columns = [_array(values[field.name], field.type) for field in schema if field.name != "terms"]
        kind = schema.field("terms").type
        members = [kind.value_type.field(k) for k in range(kind.value_type.num_fields)]
        struct = pa.StructArray.from_arrays([_array(parts[m.name], m.type) for m in members], fields=members)
        starts = pa.array(offsets - offsets[0], pa.int32())
        columns.append(pa.ListArray.from_arrays(starts, struct, type=kind))
        yield pa.record_batch(columns, schema=schema)


def _array(values: NDArray[Any], kind: pa.DataType) -> pa.Array:
    """Return values as an Arrow array of a type."""
    if not pa.types.is_fixed_size_list(kind):
        return pa.array(values.astype(kind.to_pandas_dtype(), copy=False), kind)
    flat = values.reshape(-1).astype(kind.value_type.to_pandas_dtype(), copy=False)
    return pa.FixedSizeListArray.from_arrays(pa.array(flat, kind.value_type), type=kind)


def _read_columns(file: ArrowFile) -> tuple[dict[str, NDArray[Any]], NDArray[np.int64]]:
    """Return every column and every part of terms as (rows, length), and the number of terms of each Gaussian."""
    budget = Budget(file.path, file.nbytes)
    pieces: dict[str, list[NDArray[Any]]] = {}
    counts = [np.zeros(0, np.int64)]
    for batch in file.batches(budget):
        budget.claim(batch.nbytes, "all batches together")
        columns = {name: batch.column(name) for name in batch.schema.names}
        lists = columns.pop("terms")
        counts.append(np.diff(lists.offsets.to_numpy()).astype(np.int64))
        struct = lists.flatten()
        columns |= {f"terms.{field.name}": struct.field(field.name) for field in struct.type}
        for name, column in columns.items():
            pieces.setdefault(name, []).append(_numbers(column))
    if not pieces:
        return _empty_columns(file.schema), counts[0]
    return {name: np.concatenate(pieces.pop(name)) for name in list(pieces)}, np.concatenate(counts)


def _numbers(column: pa.Array) -> NDArray[Any]:
    """Return the numbers of a column."""
    if not pa.types.is_fixed_size_list(column.type):
        return np.asarray(column.to_numpy())[:, None]
    return np.asarray(column.flatten().to_numpy()).reshape(-1, column.type.list_size)


def _empty_columns(schema: pa.Schema) -> dict[str, NDArray[Any]]:
    """Return the columns of a file without rows."""
    empty = pa.RecordBatch.from_pylist([], schema=schema)
    columns = {name: empty.column(name) for name in schema.names}
    struct = columns.pop("terms").flatten()
    columns |= {f"terms.{field.name}": struct.field(field.name) for field in struct.type}
    return {name: _numbers(column) for name, column in columns.items()}


def _colors(
    kind: Variant, grids: Grids | None, columns: Mapping[str, NDArray[Any]], offsets: NDArray[np.int64]
) -> SrbfColors:
    """Return the colors that the columns hold."""
    t = int(offsets[-1])
    dtype = np.float32 if grids is None else np.uint16
    scales: NDArray[Any] = columns["color_scales"][:, 0] if "color_scales" in columns else np.zeros(0, dtype)
    centers = np.concatenate([columns["terms.theta"].astype(dtype), columns["terms.phi"].astype(dtype)], axis=1)
    functions = columns["terms.function"][:, 0]
    decays = columns["terms.decay"][:, 0]
    intensities = columns["terms.intensities"].reshape(t, kind.intensities)
    if grids is None:
        return SrbfColors(kind.name, columns["base"], scales, offsets, functions, centers, decays, intensities)
    packed = QuantizedColors(grids, columns["base"], scales, offsets, functions, centers, decays, intensities)
    return packed.dequantize()


def _info(file: ArrowFile) -> SrbfInfo:
    """Return the contents of a header, checked."""
    header = file.header
    name = header.text("variant", VARIANTS)
    scene = header.raw("scene")
    if not isinstance(scene, str) or len(scene) > 1000:
        raise FormatError(file.path, "scene", "the hash of a scene", repr(scene)[:60])
    return SrbfInfo(
        name,
        header.integer("gaussians", 0, _MOST),
        header.integer("terms", 0, _MOST),
        scene,
        grids_of(header.child("quantized"), name) if "quantized" in header else None,
        header.child("provenance").value,
        file.nbytes,
    )


def grids_of(quantized: Fields, name: str) -> Grids:
    """Return the tables that a JSON object of `asdict(grids)` describes, for a variant.

    Raises:
        FormatError: If the object does not describe tables.
    """
    bits = quantized.child("precision")
    label = bits.text("name")
    base = quantized.items("base", 3)
    try:
        precision = Precision(label[:100], *(bits.integer(f.name, 2, 16) for f in fields(Precision)[1:]))
        ranges = [Fields(quantized.path, "base", {"range": pair}).numbers("range", 2).tolist() for pair in base]
        scales, decays = (quantized.numbers(key, 2).tolist() for key in ("scales", "decays"))
        return Grids(
            name,
            precision,
            tuple((low, high) for low, high in ranges),  # type: ignore[arg-type]
            (scales[0], scales[1]),
            (decays[0], decays[1]),
            quantized.number("intensity"),
        )
    except ValueError as error:
        raise FormatError(quantized.path, "quantized", "ranges of tables", str(error)) from error
