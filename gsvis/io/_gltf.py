"""Read the values of glTF accessors from a binary chunk, files or text; and the names of KHR_gaussian_splatting."""

from __future__ import annotations

import base64
import binascii
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.fields import Fields
from gsvis.files.limits import Budget, inside, read_whole, safe_name
from gsvis.io._wrapped import HEAD, check_pointer

__all__ = ["LINEAR", "SPLATS", "SPZ", "SRGB", "Accessors", "sh_names"]

F32 = NDArray[np.float32]

SPLATS = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"
SRGB = "srgb_rec709_display"
LINEAR = "lin_rec709_display"

_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_MOST = 1 << 40


def sh_names(degree: int) -> tuple[str, ...]:
    """Return the attributes of the coefficients of one degree, lowest order first."""
    return tuple(f"{SPLATS}:SH_DEGREE_{degree}_COEF_{n}" for n in range(2 * degree + 1))


class Accessors:
    """The accessors of a glTF document.

    Args:
        root: The document. Its buffers are the binary chunk, files in its folder, or data in the document itself.
        binary: The chunk; None if the document is no GLB.
        budget: Memory that values may claim.
    """

    def __init__(self, root: Fields, binary: memoryview | None, budget: Budget) -> None:
        self._root = root
        self._budget = budget
        self._buffers: dict[int, memoryview] = {} if binary is None else {0: binary}
        self._chunk = binary is not None

    def read(self, attributes: Fields, name: str, kind: str) -> F32:
        """Return the (N, K) values of an attribute, float32; normalized integers become numbers up to 1.

        Raises:
            FormatError: If it is missing, of another type, sparse, or reaches beyond the chunk.
        """
        accessor = self._entry("accessors", attributes, name)
        width = _WIDTHS[accessor.text("type", (kind,))]
        code = accessor.integer("componentType", 0, 1 << 16)
        if code not in _KINDS:
            raise FormatError(accessor.path, accessor.where("componentType"), "8 or 16 bits, or a float", f"{code}")
        if "sparse" in accessor:
            raise FormatError(accessor.path, accessor.where("sparse"), "none", "a sparse accessor", "write it in full")
        count = accessor.integer("count", 1, _MOST)
        dtype = np.dtype(_KINDS[code])
        view, stride = self._slice(accessor, "bufferView")
        start = accessor.integer("byteOffset", 0, _MOST) if "byteOffset" in accessor else 0
        packed = width * dtype.itemsize
        stride = stride or packed
        if stride < packed or start + (count - 1) * stride + packed > len(view):
            got = f"{len(view) - start:,} from byte {start:,}, {stride} apart"
            raise FormatError(accessor.path, accessor.trail, f"bytes for {count:,} values of {packed}", got)
        self._budget.claim(4 * count * width, accessor.trail)
        raw = np.ndarray((count, width), dtype, view, start, (stride, dtype.itemsize))
        if dtype.kind == "f":
            return np.ascontiguousarray(raw, np.float32)
        values: F32 = raw.astype(np.float32)
        if accessor.raw("normalized") is True:
            values = np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1.0))
        return values

    def view(self, fields: Fields) -> memoryview:
        """Return the bytes of the buffer view that an object names."""
        return self._slice(fields, "bufferView")[0]

    def _slice(self, fields: Fields, key: str) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view and its stride, 0 without one."""
        if key not in fields:
            remedy = "without one, gsvis can read values only through the extensions that it supports"
            raise FormatError(fields.path, fields.where(key), "the number of a buffer view", "nothing", remedy)
        view = self._entry("bufferViews", fields, key)
        binary = self._buffer(view)
        start = view.integer("byteOffset", 0, _MOST) if "byteOffset" in view else 0
        size = view.integer("byteLength", 1, _MOST)
        if start + size > len(binary):
            expected = f"at most {len(binary):,} bytes"
            raise FormatError(view.path, view.trail, expected, f"{size:,} from byte {start:,}", "is it truncated?")
        stride = view.integer("byteStride", 4, 252) if "byteStride" in view else 0
        return binary[start : start + size], stride

    def _buffer(self, view: Fields) -> memoryview:
        """Return the bytes of the buffer that a view names; read once."""
        buffer = self._entry("buffers", view, "buffer")
        number = view.integer("buffer", 0, _MOST)
        if "uri" not in buffer:
            if number or not self._chunk:
                raise FormatError(view.path, buffer.trail, "a uri, or the binary chunk of a .glb", "neither")
            return self._buffers[0]
        key = number + 1 if self._chunk else number
        if key not in self._buffers:
            self._buffers[key] = memoryview(self._read(buffer))
        return self._buffers[key]

    def _read(self, buffer: Fields) -> bytes:
        """Return the content behind the uri of a buffer: base64 text, or a file in the folder of the document."""
        uri = buffer.raw("uri")
        if isinstance(uri, str) and uri.startswith("data:"):
            head, _, text = uri.partition(",")
            try:
                if not head.endswith(";base64"):
                    raise ValueError("data without base64")
                return base64.b64decode(text, validate=True)
            except (ValueError, binascii.Error) as error:
                raise FormatError(buffer.path, buffer.where("uri"), "base64 data", str(error)) from error
        place = Path(buffer.path)
        name = safe_name(buffer.path, buffer.where("uri"), unquote(uri) if isinstance(uri, str) else uri)
        file = inside(place, buffer.where("uri"), place.parent, name)
        if not file.is_file():
            remedy = "copy it beside the .gltf, or pack both into one .glb"
            raise FormatError(place, buffer.where("uri"), f"the file {name}", "no such file", remedy)
        data = read_whole(file)
        check_pointer(place, data[:HEAD], name)
        self._budget.file_bytes += len(data)
        return data

    def _entry(self, kind: str, fields: Fields, key: str) -> Fields:
        """Return an entry of a list of the document; the object holds its number at a key."""
        every = self._root.items(kind) if kind in self._root else []
        index = fields.integer(key, 0, max(len(every) - 1, 0))
        if not every:
            raise FormatError(fields.path, kind, "a list", "nothing")
        return Fields(fields.path, f"{kind}[{index}]", every[index])
