"""Save and load a training run: all that its future steps depend on, in one NumPy archive.

Writing is atomic. A checkpoint identifies its run: it is rejected if the configuration, images or initial Gaussians
differ. Loading one never runs code.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.archive import load_arrays, save_arrays
from gsvis.files.fields import parse_object
from gsvis.train.config import decisive_options
from gsvis.train.history import Record
from gsvis.train.parameters import NAMES

if TYPE_CHECKING:
    from gsvis.train.trainer import Trainer

__all__ = ["load_checkpoint", "run_key", "save_checkpoint"]

_FORMAT = "gsvis-training"
_VERSION = 1
_STORES = ("values", "first", "second")
_AGAIN = "delete it to train from the beginning"


def run_key(trainer: Trainer) -> str:
    """Return a hash of a run: its configuration, its images and cameras, and its initial Gaussians; on any device."""
    digest = hashlib.sha256(json.dumps(decisive_options(trainer.config), sort_keys=True).encode())
    views = trainer.views
    for array in (views.images, views.cameras.viewmats, views.cameras.Ks):
        digest.update(str((array.shape, array.dtype)).encode())
        digest.update(np.ascontiguousarray(array).data)
    digest.update(trainer.beginning.encode())
    return digest.hexdigest()


def save_checkpoint(path: str | os.PathLike[str], trainer: Trainer) -> None:
    """Write the current state of a run.

    Raises:
        OSError: If it cannot be written; an existing file is kept.
    """
    p = trainer.parameters
    rules = trainer.densifier
    arrays: dict[str, NDArray[Any]] = {
        f"{store}/{name}": getattr(p, store)[name].detach().cpu().numpy() for store in _STORES for name in NAMES
    }
    if rules is not None:
        arrays |= {"densifier/total": rules.total.cpu().numpy(), "densifier/seen": rules.seen.cpu().numpy()}
    header = {
        "format": _FORMAT,
        "version": _VERSION,
        "run": trainer.key,
        "step": trainer.step,
        "adam_steps": p.steps,
        "seconds": trainer.seconds,
        "loss": trainer.loss,
        "history": [asdict(record) for record in trainer.history],
    }
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    save_arrays(path, arrays)


def load_checkpoint(path: str | os.PathLike[str], trainer: Trainer) -> float:
    """Restore a run from a checkpoint, on the device of its values; return the step.

    Raises:
        torch.OutOfMemoryError: If it does not fit the memory of the device; to load it again on another restores all.
        FormatError: If the file is damaged, or has another format or a newer version.
        ValueError: If it belongs to a different run.
    """
    header, arrays = _read(path)
    if header.get("run") != trainer.key:
        raise ValueError(
            f"checkpoint: expected {os.fspath(path)} to belong to the same images, Gaussians and configuration, "
            f"got the checkpoint of a run with different ones; {_AGAIN}, or name another file"
        )
    try:
        p = trainer.parameters
        _check_shapes(arrays)
        for store in _STORES:
            for name in NAMES:
                tensor = torch.from_numpy(arrays[f"{store}/{name}"]).to(p.values[name].device)
                getattr(p, store)[name] = tensor.requires_grad_(store == "values")
        if trainer.densifier is not None:
            like = p.values["means"]
            trainer.densifier.total = torch.from_numpy(arrays["densifier/total"]).to(like)
            trainer.densifier.seen = torch.from_numpy(arrays["densifier/seen"]).to(like)
        p.steps, trainer.step = int(header["adam_steps"]), int(header["step"])
        trainer.seconds, trainer.loss = float(header["seconds"]), float(header["loss"])
        trainer.history = [Record(**record) for record in header["history"]]
    except torch.OutOfMemoryError:
        raise
    except (LookupError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise FormatError(path, "", "a complete checkpoint", f"{type(error).__name__}: {error}", _AGAIN) from error
    return float(trainer.step)


def _check_shapes(arrays: dict[str, NDArray[Any]]) -> None:
    """Raise ValueError unless values and moments have the shapes of one set of Gaussians."""
    count = len(arrays["values/means"])
    terms = arrays["values/shN"].shape[1]
    shapes = dict(zip(NAMES, ((3,), (3,), (4,), (), (1, 3), (terms, 3)), strict=True))
    expected = {f"{store}/{name}": (count, *shape) for store in _STORES for name, shape in shapes.items()}
    expected |= {name: (count,) for name in ("densifier/total", "densifier/seen") if name in arrays}
    for name, shape in expected.items():
        if arrays[name].shape != shape or arrays[name].dtype != np.float32:
            raise ValueError(f"{name}: float32 of shape {shape}, not {arrays[name].dtype} of {arrays[name].shape}")


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return header and arrays of a checkpoint; one of an earlier version may have no checksum."""
    try:
        arrays = load_arrays(path)
        header = parse_object(path, arrays.pop("header", np.zeros(0, np.uint8)).tobytes())
        if header.raw("format") != _FORMAT:
            raise FormatError(path, "format", _FORMAT, repr(header.raw("format"))[:60])
        version = header.integer("version", 1, 1 << 30)
    except FormatError as error:
        got = f"{error.where}: {error.got}" if error.where else error.got
        raise FormatError(path, "", "a checkpoint of gsvis", got, _AGAIN) from error
    if version > _VERSION:
        raise FormatError(path, "version", f"at most {_VERSION}", str(version), "update gsvis")
    return header.value, arrays
