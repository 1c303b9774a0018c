"""Read checkpoints of gsplat and nerfstudio (`.pt`, `.ckpt`), and raw values as these trainers have them in memory.

Raw values are means, log scales, quaternions wxyz of any length, logit opacities and SH coefficients. Two layouts:

- gsplat's `simple_trainer`: {"step", "splats": {means, scales, quats, opacities, sh0, shN}}, one file for each rank.
- nerfstudio's `splatfacto`: {"step", "pipeline": {"_model.gauss_params.means", ... scales, quats, opacities,
  features_dc, features_rest}, "optimizers", ...}; older files lack "gauss_params.". Without features_rest the colors
  are sigmoid(features_dc), otherwise SH.

Everything else in a file (optimizers, camera poses, appearance, metrics) is skipped and never read.

The frame is the trainer's, not that of the photos: gsplat normalizes the world by default, and nerfstudio rotates,
centers and scales it by the `dataparser_transforms.json` beside its `nerfstudio_models`. Cameras of the same run agree;
a COLMAP model or `transforms.json` of the input does not.

A checkpoint is a zip with a pickle of the structure and the raw bytes of each tensor. The pickle is read with weights
only, more strictly than by `torch.load(weights_only=True)`: it can create dicts, lists, numbers, texts and descriptions
of tensors. Any class or function that it names becomes an inert placeholder and is neither imported nor called. Numpy
scalars, which make torch 2.6 reject nerfstudio's files, are therefore harmless, and the size of the file bounds memory
and time: keys are texts and small numbers (hashing deeply nested tuples takes forever), and calls take few arguments.

References:
    gsplat, `examples/simple_trainer.py`; nerfstudio, `nerfstudio/engine/trainer.py` and `models/splatfacto.py`.
    Layout of the zip: `torch/serialization.py`, since torch 1.6.
"""

from __future__ import annotations

import glob
import io
import logging
import os
import pickle
import pickletools
import re
import struct
import zipfile
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.limits import open_regular, read_whole
from gsvis.io._build import exp_scales, format_error, gaussians_from, sh0_from_rgb, sigmoid
from gsvis.io._table import join_names
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians

__all__ = ["from_gsplat", "is_checkpoint", "load_checkpoint"]

SUFFIXES = (".pt", ".pth", ".ckpt")

_GEOMETRY = ("means", "scales", "quats", "opacities")
_PREFIXES = ("module.", "_model.", "gauss_params.")
_MOST_STRUCTURE = 512 << 10  # bytes of the pickle; checkpoints of both trainers have about 20 kB
_MOST_ARGUMENTS = 64  # largest number of arguments of a call; a tensor has eight
_KNOWN = "a checkpoint of gsplat ('splats') or of nerfstudio's splatfacto ('pipeline')"
_CONFIGS = ("cfg.yml", "cfg.yaml", "config.yml")
_MOST_CONFIG = 1 << 20
_ANTIALIASED = re.compile(
    rb"^\s*(?:antialiased:\s*true|rasterize_mode:\s*(?:&\S+\s+)?['\"]?antialiased)\b", re.M | re.I
)
_DAMAGED = "is the file damaged, or still being written?"
_STORAGES = {"FloatStorage": "f4", "DoubleStorage": "f8", "HalfStorage": "f2", "BFloat16Storage": "u2"}

_BAD_ZIP = (zipfile.BadZipFile, EOFError, NotImplementedError, OSError, RuntimeError, ValueError, struct.error)

F32 = NDArray[np.float32]

_log = logging.getLogger(__name__)


def from_gsplat(splats: Mapping[str, ArrayLike]) -> Gaussians:
    """Return the scene of raw values as gsplat's trainers hold them; log scales and logits are activated.

    Args:
        splats: A dict or `torch.nn.ParameterDict` with means (N, 3), scales (N, 3) log, quats (N, 4) wxyz,
            opacities (N,) or (N, 1) logit, sh0 (N, 1, 3), and optionally shN (N, K-1, 3). Or splatfacto's
            `gauss_params`, with features_dc (N, 3) and features_rest (N, K-1, 3). On any device; other keys are
            ignored.

    Returns:
        The scene, in the order and the frame of the values, which are copied.

    Raises:
        ValueError: If a key is missing, or a shape or a value is wrong.

    Examples:
        >>> from_gsplat({"means": [[0, 0, 0]], "scales": [[0, 0, 0]], "quats": [[1, 0, 0, 0]], "opacities": [0.0],
        ...              "sh0": [[[0, 0, 0]]]}).opacities
        array([0.5], dtype=float32)
    """
    a = _activated(*_raw(splats))
    return Gaussians(a["means"], a["quats"], a["scales"], a["opacities"], a["sh0"], a.get("shN"))


def _raw(splats: Mapping[str, ArrayLike]) -> tuple[dict[str, Any], tuple[str, str]]:
    """Return the raw arrays of the Gaussians, and the names of their colors.

    Raises:
        ValueError: If a key is missing.
    """
    names = list(splats.keys())
    colors = ("features_dc", "features_rest") if "features_dc" in names else ("sh0", "shN")
    missing = [name for name in (*_GEOMETRY, colors[0]) if name not in names]
    if missing:
        remedy = "; colors of an appearance module cannot be read" if {"features", "colors"} <= {*names} else ""
        wanted = ", ".join((*_GEOMETRY, *colors))
        raise ValueError(f"splats: expected {wanted}, got no {', '.join(missing)} but {join_names(names)}{remedy}")
    raw = {name: _check.plain(splats[name]) for name in (*_GEOMETRY, *colors) if name in names}
    if np.ndim(raw["opacities"]) == 2 and np.shape(raw["opacities"])[1] == 1:
        raw["opacities"] = np.reshape(raw["opacities"], -1)
    return raw, colors


def _activated(raw: Mapping[str, Any], colors: tuple[str, str]) -> dict[str, F32]:
    """Return the arrays of `Gaussians` from raw arrays, copied; checks only shapes."""
    shapes: dict[str, tuple[str | int, ...]] = {
        "means": ("N", 3),
        "quats": ("N", 4),
        "scales": ("N", 3),
        "opacities": ("N",),
    }
    found = {name: _check.floats(name, raw[name], shape, finite=False).copy() for name, shape in shapes.items()}
    higher = None
    if colors[1] in raw:
        higher = _check.floats(colors[1], raw[colors[1]], ("N", "K-1", 3), finite=False).copy()
    if colors[0] == "sh0":
        sh0 = _check.floats("sh0", raw["sh0"], ("N", 1, 3), finite=False).copy()
    else:
        base = _check.floats("features_dc", raw["features_dc"], ("N", 3), finite=False)
        sh0 = base[:, None, :].copy() if higher is not None and higher.shape[1] else sh0_from_rgb(sigmoid(base))
    found |= {"scales": exp_scales(found["scales"]), "opacities": sigmoid(found["opacities"]), "sh0": sh0}
    return found if higher is None else found | {"shN": higher}


def is_checkpoint(path: str | os.PathLike[str]) -> bool:
    """Return whether a zip file is a checkpoint of torch; the suffix decides for a zip that cannot be opened."""
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            return _structure_name(archive) is not None
    except _BAD_ZIP:
        return os.fspath(path).lower().endswith(SUFFIXES)


def load_checkpoint(path: str | os.PathLike[str]) -> Gaussians:
    """Read the Gaussians of a checkpoint.

    Args:
        path: The file.

    Returns:
        The scene, in the order and the frame of the trainer.

    Raises:
        FormatError: If the file is not a checkpoint with Gaussians, is damaged, or has invalid values.
        OSError: If it cannot be opened.
    """
    _warn_of_other_ranks(Path(path))
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            raw = _tensors(path, archive)
            if "means" in raw and np.shape(raw["means"])[:1] == (0,):
                raise FormatError(path, "means", "at least one Gaussian", "none", "the file holds an empty scene")
            facts = SceneFacts(antialiased=_is_antialiased(Path(path)))
            return gaussians_from(path, **_activated(*_raw(raw)), facts=facts)
    except ValueError as error:
        raise format_error(path, error) from error
    except _BAD_ZIP as error:
        if isinstance(error, OSError) and error.filename is not None:  # it could not be opened
            raise
        raise FormatError(
            path, "zip", "a complete checkpoint", str(error) or "the end of the file", _DAMAGED
        ) from error


def _is_antialiased(path: Path) -> bool:
    """Return whether the configuration beside the file says so: cfg.yml of gsplat, config.yml of nerfstudio.

    The configuration is searched as text; nothing in it is parsed or run.
    """
    for name in _CONFIGS:
        for folder in (path.parent, path.parent.parent):
            file = folder / name
            try:
                if file.is_file() and _ANTIALIASED.search(read_whole(file, _MOST_CONFIG)):
                    return True
            except (FormatError, OSError):
                continue
    return False


def _warn_of_other_ranks(path: Path) -> None:
    """Log a warning if the file is one of several ranks and has only part of the scene."""
    stem, rank, number = path.stem.rpartition("_rank")
    others = [other for other in path.parent.glob(f"{glob.escape(stem)}_rank*{path.suffix}") if other.name != path.name]
    if rank and number.isdecimal() and others:
        _log.warning(
            "%s holds only the part of rank %s; files of %d other ranks are beside it", path, number, len(others)
        )


def _tensors(path: str | os.PathLike[str], archive: zipfile.ZipFile) -> dict[str, F32]:
    """Return the values of the Gaussians by their names, in either layout."""
    name = _structure_name(archive)
    if name is None:
        raise FormatError(path, "zip", "data.pkl", join_names(archive.namelist()), "is this a checkpoint of torch?")
    found = _gaussians_of(path, _unpickle(path, archive, name))
    records = _Records(path, archive, name.removesuffix("data.pkl"))
    return {key: records.array(key, tensor) for key, tensor in found.items()}


def _structure_name(archive: zipfile.ZipFile) -> str | None:
    """Return the entry with the pickle: data.pkl in the one folder of the archive."""
    return next((name for name in archive.namelist() if name.count("/") <= 1 and name.endswith("data.pkl")), None)


def _gaussians_of(path: str | os.PathLike[str], content: Any) -> dict[str, _Tensor]:
    """Return descriptions of the tensors of the Gaussians by the names of `from_gsplat`."""
    if not isinstance(content, dict):
        remedy = "for INRIA's checkpoints read point_cloud.ply" if isinstance(content, tuple) else ""
        raise FormatError(path, "data.pkl", _KNOWN, f"a {type(content).__name__.lstrip('_')}", remedy)
    for key in ("splats", "pipeline"):
        if isinstance(content.get(key), dict):
            content = content[key]
            break
    wanted = {*_GEOMETRY, "sh0", "shN", "features_dc", "features_rest"}
    found = {}
    for key, value in content.items():
        name = key if isinstance(key, str) else ""
        for prefix in _PREFIXES:
            name = name.removeprefix(prefix)
        if name in wanted and isinstance(value, _Tensor):
            found[name] = value
    if "means" not in found:
        raise FormatError(
            path,
            "data.pkl",
            _KNOWN,
            f"keys {join_names([str(key)[:40] for key in content if isinstance(key, str | int)])}",
        )
    return found


class _Storage(NamedTuple):
    """The bytes of a tensor, which are not read yet: numpy type, name of the record, number of values."""

    kind: str
    key: str
    values: int


class _Tensor(NamedTuple):
    """The place of a tensor's values in its storage, in counts of values."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _Ignored:
    """Placeholder for every class and function that is not needed; every operation on it does nothing."""

    def __init__(self, *_: object, **__: object) -> None: ...

    def __call__(self, *_: object, **__: object) -> _Ignored:
        return self

    def __setstate__(self, _: object) -> None: ...

    def __setitem__(self, _: object, __: object) -> None: ...

    def append(self, _: object) -> None: ...

    def extend(self, _: object) -> None: ...


class _Dict(dict):  # type: ignore[type-arg]
    """An OrderedDict as in state dicts; created empty, and without the attributes that a file may give it."""

    def __init__(self) -> None:
        super().__init__()

    def __setstate__(self, _: object) -> None: ...


class _StorageKind(str):
    """The type of a storage, as numpy's code; empty if it cannot be read."""


def _tensor(storage: Any = None, offset: Any = 0, shape: Any = (), strides: Any = (), *_: object) -> Any:
    """Return the description of a tensor, or a placeholder if it is not valid."""
    are_short = all(isinstance(each, tuple) and len(each) <= 8 for each in (shape, strides))
    numbers = (offset, *shape, *strides) if are_short else (-1,)
    good = isinstance(storage, _Storage) and all(type(n) is int and 0 <= n < 1 << 48 for n in numbers)
    return _Tensor(storage, offset, shape, strides) if good and len(shape) == len(strides) else _Ignored()


def _parameter(data: Any = None, *_: object) -> Any:
    """Return the tensor of a parameter."""
    return data if isinstance(data, _Tensor) else _Ignored()


_MAKERS = {
    ("collections", "OrderedDict"): _Dict,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): _parameter,
    ("torch._utils", "_rebuild_parameter_with_state"): _parameter,
}


def _is_key(value: object) -> bool:
    """Return whether a value may be a dictionary key: hashing it must cost no more than reading it."""
    is_short = type(value) is int and value.bit_length() <= 64
    return is_short or value is None or isinstance(value, str | bytes | float | bool | _Ignored)


class _Unpickler(pickle._Unpickler):
    """Create plain values and descriptions of tensors; import nothing, and do a bounded amount of work for each byte.

    It derives from Python's unpickler because the steps of the C one cannot be replaced. Gaussians need no tuples as
    keys, sets, object states or calls with many arguments, so these become placeholders.
    """

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)
    stack: list[Any]
    readline: Any

    def _pop_since_mark(self) -> list[Any]:
        return self.pop_mark()  # type: ignore[attr-defined,no-any-return]

    def _set_item(self) -> None:
        """Add one pair to the dictionary on the stack."""
        value = self.stack.pop()
        key = self.stack.pop()
        self._add_pairs([key, value])

    def _set_items(self) -> None:
        self._add_pairs(self._pop_since_mark())

    def _add_pairs(self, items: list[Any]) -> None:
        """Add pairs of keys and values to the dictionary on top of the stack."""
        target = self.stack[-1]
        if isinstance(target, dict):
            target.update((k, v) for k, v in zip(items[::2], items[1::2], strict=True) if _is_key(k))
        elif not isinstance(target, _Ignored):
            raise pickle.UnpicklingError(f"items of a {type(target).__name__}")

    def _make_dict(self) -> None:
        """Push a dictionary of the pairs since the mark."""
        items = self._pop_since_mark()
        self.stack.append({})
        self._add_pairs(items)

    def _make_set(self) -> None:
        self.stack.append(_Ignored())

    def _add_items(self) -> None:
        self._pop_since_mark()

    def _make_frozen_set(self) -> None:
        """Push a placeholder for a frozen set."""
        self._pop_since_mark()
        self.stack.append(_Ignored())

    def _build(self) -> None:
        """Ignore the state of an object."""
        self.stack.pop()  # drop the state of an object

    def _call(self) -> None:
        """Call a function with the arguments on the stack, if they are few."""
        arguments = self.stack.pop()
        maker = self.stack.pop()
        few = isinstance(arguments, tuple) and len(arguments) <= _MOST_ARGUMENTS
        self.stack.append(maker(*arguments) if few and callable(maker) else _Ignored())

    def _call_with_names(self) -> None:
        """Call a function, and ignore its keyword arguments."""
        self.stack.pop()
        self._call()

    def _call_since_mark(self) -> None:
        """Push a placeholder for the result of a call."""
        self._pop_since_mark()
        self.stack.append(_Ignored())

    def _call_named(self) -> None:
        """Push a placeholder for the result of a call by name."""
        self.readline(), self.readline()
        self._call_since_mark()

    dispatch |= {
        pickle.SETITEM[0]: _set_item,
        pickle.SETITEMS[0]: _set_items,
        pickle.DICT[0]: _make_dict,
        pickle.EMPTY_SET[0]: _make_set,
        pickle.ADDITEMS[0]: _add_items,
        pickle.FROZENSET[0]: _make_frozen_set,
        pickle.BUILD[0]: _build,
        pickle.REDUCE[0]: _call,
        pickle.NEWOBJ[0]: _call,
        pickle.NEWOBJ_EX[0]: _call_with_names,
        pickle.OBJ[0]: _call_since_mark,
        pickle.INST[0]: _call_named,
    }

    def find_class(self, module: str, name: str) -> Any:
        """Return our own stand-in for a class or function."""
        if module in ("torch", "torch.storage") and name.endswith("Storage"):
            return _StorageKind(_STORAGES.get(name, ""))
        return _MAKERS.get((module, name), _Ignored)

    def persistent_load(self, pid: Any) -> Any:
        """Return the storage that a reference describes."""
        good = isinstance(pid, tuple) and len(pid) == 5 and pid[0] == "storage" and isinstance(pid[1], _StorageKind)
        if not (good and isinstance(pid[2], str) and type(pid[4]) is int):
            raise pickle.UnpicklingError("a reference to something other than a tensor's storage")
        return _Storage(str(pid[1]), pid[2], pid[4])


def _unpickle(path: str | os.PathLike[str], archive: zipfile.ZipFile, name: str) -> Any:
    """Return the content of the pickle of a checkpoint."""
    size = archive.getinfo(name).file_size
    if size > _MOST_STRUCTURE:
        raise FormatError(
            path, name, f"at most {_MOST_STRUCTURE:,} bytes", f"{size:,}", "does it contain more than tensors?"
        )
    data = _record(path, archive, name)
    try:
        for opcode, argument, at in pickletools.genops(data):
            # A memo index makes the unpickler allocate memory; every other length has been checked here.
            if opcode.name.endswith("PUT") and not (type(argument) is int and 0 <= argument < len(data)):
                raise FormatError(path, f"{name}, byte {at:,}", f"a memo index below {len(data):,}", str(argument)[:40])
        return _Unpickler(io.BytesIO(data)).load()
    except FormatError:
        raise
    except Exception as error:  # a damaged pickle can raise anything
        what = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
        raise FormatError(path, name, "the structure of a checkpoint", what, _DAMAGED) from error


class _Records:
    """The raw tensors of a checkpoint.

    Args:
        path: The file, for messages.
        archive: The open zip.
        folder: Prefix of the names of its records.
    """

    def __init__(self, path: str | os.PathLike[str], archive: zipfile.ZipFile, folder: str) -> None:
        self.path = path
        self.archive = archive
        self.folder = folder
        self.names = frozenset(archive.namelist())
        order = f"{folder}byteorder"
        big = order in self.names and _record(path, archive, order)[:16] == b"big"
        self.order = ">" if big else "<"

    def array(self, name: str, tensor: _Tensor) -> F32:
        """Return (shape) float32 values of a tensor.

        Raises:
            FormatError: If they are not floating-point numbers, or exceed their record.
        """
        storage = tensor.storage
        shape = tensor.shape
        stored = tensor.storage.values
        if not storage.kind:
            raise FormatError(self.path, name, "float16, bfloat16, float32 or float64", "integers or other values")
        dtype = np.dtype(self.order + storage.kind)
        record = f"{self.folder}data/{storage.key}"
        if record not in self.names:
            raise FormatError(self.path, name, f"its values in {record}", "no such record", _DAMAGED)
        size = self.archive.getinfo(record).file_size
        count = prod(shape)
        last = tensor.offset + sum((n - 1) * step for n, step in zip(shape, tensor.strides, strict=True))
        if count and not (
            last < storage.values and count <= storage.values and storage.values * dtype.itemsize <= size
        ):
            promised = f"{count:,} values up to number {last:,} of {stored:,}"
            raise FormatError(self.path, name, f"values inside the {size:,} bytes of {record}", promised, _DAMAGED)
        if not count:
            return np.zeros(shape, np.float32)
        flat = np.frombuffer(_record(self.path, self.archive, record), dtype, storage.values)
        steps = tuple(step * dtype.itemsize for step in tensor.strides)
        values = np.lib.stride_tricks.as_strided(flat[tensor.offset :], shape, steps, writeable=False)
        if storage.kind == "u2":  # bfloat16 is the upper half of float32
            return (values.astype(np.uint32) << 16).view(np.float32)
        with np.errstate(over="ignore"):  # overflow is rejected later, as not finite
            return np.ascontiguousarray(values, np.float32)


def _record(path: str | os.PathLike[str], archive: zipfile.ZipFile, name: str) -> bytes:
    """Return all bytes of a record, which torch never compresses."""
    info = archive.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
        raise FormatError(path, name, "a record that is not compressed", "a compressed one")
    data = archive.read(name)
    if len(data) != info.file_size:
        raise FormatError(path, name, f"{info.file_size:,} bytes", f"{len(data):,}", _DAMAGED)
    return data
