"""Coerce and check array arguments; every error about a shape, a dtype or a range is worded here.

Shapes are tuples of integers and names: `("N", 3)` accepts any first length. Nothing here copies an array that already
has the right dtype and is contiguous. Torch tensors are accepted from any device; torch is not imported.
"""

from __future__ import annotations

import difflib
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "floats",
    "in_range",
    "integers",
    "is_tensor",
    "one_of",
    "path",
    "plain",
    "positive_int",
    "same_length",
    "suggestion",
    "unit_vectors",
]

Shape = tuple[int | str, ...]


def _spell(shape: Shape) -> str:
    """Return a shape as text, such as "(N, 3)"."""
    return "(" + ", ".join(str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"


def _check_shape(name: str, array: NDArray[Any], shape: Shape) -> None:
    """Raise ValueError unless an array has a shape."""
    if not _fits(array.shape, shape):
        remedy = _suggest_reshape(name, array.shape, shape)
        raise ValueError(f"{name}: expected shape {_spell(shape)}, got {array.shape}" + _append(remedy))


def _fits(have: tuple[int, ...], shape: Shape) -> bool:
    """Return whether the shape of an array fits an expected shape."""
    return len(have) == len(shape) and all(
        isinstance(want, str) or want == side for want, side in zip(shape, have, strict=True)
    )


def _suggest_reshape(name: str, have: tuple[int, ...], shape: Shape) -> str:
    """Return the remedy for a shape with an axis of length 1 too many or too few; "" for any other shape."""
    if have[-1:] == (1,) and _fits(have[:-1], shape):
        return f"pass {name}[..., 0]"
    for axis, want in enumerate(shape):
        if want == 1 and _fits((*have[:axis], 1, *have[axis:]), shape):
            return f"pass {name}[{':, ' * axis}None]"
    return ""


def is_tensor(value: Any) -> bool:
    """Return whether the value is a torch tensor, without importing torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def plain(value: Any) -> Any:
    """Convert a torch tensor, or a list of them, to NumPy arrays; return anything else unchanged.

    A tensor that requires a gradient is copied, because an optimizer will write to it.
    """
    torch = sys.modules.get("torch")
    if torch is None:  # then nothing can be a tensor
        return value
    if isinstance(value, torch.Tensor):
        array = value.detach().float() if value.dtype == torch.bfloat16 else value.detach()
        return array.numpy(force=True).copy() if value.requires_grad else array.numpy(force=True)
    if isinstance(value, list | tuple) and _holds_tensors(value, torch.Tensor):
        return [plain(each) for each in value]
    return value


def _holds_tensors(value: Any, tensor: type) -> bool:
    """Return whether the first item, at any depth, is a tensor."""
    while isinstance(value, list | tuple) and value:
        value = value[0]
    return isinstance(value, tensor)


def floats(
    name: str, value: ArrayLike, shape: Shape, dtype: type[np.floating[Any]] = np.float32, *, finite: bool = True
) -> NDArray[Any]:
    """Return a C-contiguous float array of the given shape; with `finite`, reject NaN and infinity."""
    try:
        numbers = plain(value)
        if np.iscomplexobj(numbers):
            raise TypeError
        with np.errstate(over="ignore"):  # overflow becomes inf, which is rejected below
            array = np.asarray(numbers, dtype=dtype, order="C")
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise ValueError(f"{name}: expected numbers of shape {_spell(shape)}, got {type(value).__name__}") from error
    _check_shape(name, array, shape)
    if finite and array.size and not all_finite(array):
        bad = np.argwhere(~np.isfinite(array))[0]
        raise ValueError(f"{name}: expected finite values, got {array[tuple(bad)]} at index {tuple(bad.tolist())}")
    return array


def all_finite(array: NDArray[Any]) -> bool:
    """Return whether no entry is NaN or infinite; usually one pass without a mask."""
    with np.errstate(over="ignore", invalid="ignore"):
        # A sum of finite float32 values in float64 cannot overflow, and NaN and inf survive it.
        total = np.add.reduce(array, axis=None, dtype=np.float64)
    return bool(np.isfinite(total)) or bool(np.isfinite(array).all())


def integers(name: str, value: ArrayLike, shape: Shape, dtype: type[np.integer[Any]] = np.int64) -> NDArray[Any]:
    """Return a C-contiguous integer array of the given shape; reject floats instead of rounding them."""
    array = np.asarray(plain(value))
    if array.size and not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name}: expected integers, got dtype {array.dtype}")
    if array.size and not np.can_cast(array.dtype, dtype):  # would wrap around silently
        in_range(name, array, np.iinfo(dtype).min, np.iinfo(dtype).max)
    array = np.asarray(array, dtype=dtype, order="C")
    _check_shape(name, array, shape)
    return array


def read_only(*arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return read-only views.

    numba compiles a kernel once for writable arrays and once for read-only ones. Read-only views for both avoid the
    second compilation.
    """
    views = tuple(array.view() for array in arrays)
    for view in views:
        view.flags.writeable = False
    return views


def in_range(
    name: str, array: NDArray[Any], low: float, high: float, *, open_low: bool = False, remedy: str = ""
) -> None:
    """Raise unless low <= array <= high everywhere (low < array with `open_low`)."""
    if array.size == 0:
        return
    least = array.min()
    most = array.max()
    above = least > low if open_low else least >= low
    if not (above and most <= high):  # NaN fails this test too
        worst = most if above else least
        left = "(" if open_low or low == -np.inf else "["
        right = ")" if high == np.inf else "]"
        raise ValueError(f"{name}: expected values in {left}{low:g}, {high:g}{right}, got {worst:g}" + _append(remedy))


def _append(remedy: str) -> str:
    """Return a remedy as the end of a message; "" for none."""
    return f"; {remedy}" if remedy else ""


def not_rising(
    values: NDArray[Any], *, first: float | None = None, last: float | None = None, strictly: bool = False
) -> str:
    """Return where values (n,) do not rise from `first` to `last`, such as "3 after 7 at index 2"; "" if they rise.

    Args:
        values: At least one value.
        first: Required first value; None allows any.
        last: Required last value; None allows any.
        strictly: Whether equal neighbors count as a fall.
    """
    style = "," if values.dtype.kind in "iu" else "g"
    if first is not None and values[0] != first:
        return f"{values[0]:{style}} at index 0"
    falls = np.flatnonzero(~(np.diff(values) > 0 if strictly else np.diff(values) >= 0))
    if len(falls):
        at = int(falls[0])
        return f"{values[at + 1]:{style}} after {values[at]:{style}} at index {at + 1}"
    return "" if last is None or values[-1] == last else f"{values[-1]:{style}} at the end"


def same_length(**arrays: NDArray[Any]) -> int:
    """Return the common first length of the arrays, given by their names."""
    lengths = {name: len(array) for name, array in arrays.items()}
    if len(set(lengths.values())) > 1:
        got = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"{' / '.join(lengths)}: expected one length for all, got {got}")
    return next(iter(lengths.values()))


def positive_int(name: str, value: Any, *, at_least: int = 1) -> int:
    """Return a Python integer of at least `at_least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < at_least:
        raise ValueError(f"{name}: expected an integer of at least {at_least}, got {value!r}")
    return int(value)


def one_of(name: str, value: str, choices: tuple[str, ...]) -> str:
    """Return the value if it is one of the choices."""
    if value not in choices:
        raise ValueError(
            f"{name}: expected one of {', '.join(map(repr, choices))}, got {value!r}"
            + _append(suggestion(value, choices))
        )
    return value


def suggestion(value: object, choices: Iterable[str]) -> str:
    """Return 'did you mean X?' for the choice nearest to the value, or '' if none is near.

    Examples:
        >>> suggestion("anlyze", ("analyze", "convert"))
        'did you mean analyze?'
    """
    if not isinstance(value, str) or len(value) > 100:  # the comparison takes quadratic time
        return ""
    lowered = {choice.lower(): choice for choice in choices}
    near = difflib.get_close_matches(value.lower(), lowered, n=1, cutoff=0.7)
    return f"did you mean {lowered[near[0]]}?" if near else ""


def path(name: str, value: str | os.PathLike[str]) -> Path:
    """Return the path of a string or path object; a leading `~` of a string becomes the home folder.

    A `~` in a `Path` is kept, because `Path("./~/x")` equals `Path("~/x")`.
    """
    try:
        text = os.fsdecode(value)
    except TypeError:
        raise ValueError(f"{name}: expected a path, got {type(value).__name__}") from None
    if not text:
        raise ValueError(f"{name}: expected a path, got an empty text")
    if "\0" in text:
        raise ValueError(f"{name}: expected a path, got a text with a NUL in it")
    return Path(os.path.expanduser(text) if isinstance(value, str) else text)


def unit_vectors(name: str, value: ArrayLike, dtype: type[np.floating[Any]] = np.float64) -> NDArray[Any]:
    """Return directions (R, 3) scaled to unit length; reject zero vectors."""
    array = floats(name, value, ("R", 3), dtype)
    norms = _lengths(array)
    if array.size and not 1e-150 < norms.min() <= norms.max() < 1e150:  # the squares left the range of float64
        array = array / np.maximum(np.abs(array).max(axis=1, keepdims=True), np.finfo(dtype).tiny)
        norms = _lengths(array)
    if array.size and norms.min() <= 0.0:
        raise ValueError(f"{name}: expected non-zero directions, got a zero vector at index {int(norms.argmin())}")
    unit: NDArray[Any] = (array / norms[:, None]).astype(dtype)
    return unit


def _lengths(vectors: NDArray[Any]) -> NDArray[np.float64]:
    """Return the lengths (R,) of vectors (R, 3)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors, dtype=np.float64)))
