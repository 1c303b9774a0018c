"""Keep NumPy archives between runs: arrays by name, with a checksum and with memory bounded by file size.

An archive is a `.npz` file that NumPy also reads. Its comment, at the end of the file, holds the CRC-32 of all bytes
before the digits. Nothing is unpickled or decompressed.
"""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Mapping
from io import BufferedReader
from typing import Any, cast

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import open_regular

__all__ = ["load_arrays", "save_arrays"]

_MARK = b"gsvis-crc32:"
_DIGITS = 8
_BLOCK = 1 << 20


def save_arrays(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays under their names, atomically.

    Raises:
        OSError: If the file cannot be written; an older file stays.
    """
    with atomic_path(path) as partial:
        with zipfile.ZipFile(partial, "w") as archive:  # closed if a write fails; np.savez 1.26 leaves it open
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, np.asarray(array), allow_pickle=False)
            archive.comment = _MARK + b"0" * _DIGITS
        with partial.open("r+b") as file:
            checksum = _checksum(cast(BufferedReader, file), partial.stat().st_size - _DIGITS)
            file.seek(-_DIGITS, os.SEEK_END)
            file.write(checksum)


def load_arrays(path: str | os.PathLike[str], *, sealed: bool = False) -> dict[str, NDArray[Any]]:
    """Return the arrays that `save_arrays` wrote, by name.

    Args:
        path: The file.
        sealed: Raise for archives without a checksum, which earlier versions wrote.

    Raises:
        FormatError: If the file is no such archive, is damaged, or claims more bytes than it has.
        OSError: If the file cannot be opened.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        file.seek(max(size - len(_MARK) - _DIGITS, 0))
        tail = file.read()
        if tail.startswith(_MARK) and tail[len(_MARK) :] != _checksum(file, size - _DIGITS):
            raise FormatError(path, "", "bytes that fit their checksum", "other bytes")
        if sealed and not tail.startswith(_MARK):
            raise FormatError(path, "", "a checksum at the end", "none")
        try:
            with zipfile.ZipFile(file) as archive:
                return {info.filename.removesuffix(".npy"): _read(archive, info, size) for info in archive.infolist()}
        except Exception as error:  # any error of reading means damaged bytes
            got = f"{type(error).__name__}: {error}"[:200]
            raise FormatError(path, "", "an archive of arrays", got) from error


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo, most: int) -> NDArray[Any]:
    """Return one array; it needs no more memory than the file has bytes."""
    if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size or info.file_size > most:
        got = f"{info.file_size:,} bytes in {info.compress_size:,}, by method {info.compress_type}"
        raise ValueError(f"{info.filename}: expected an array stored as it is, got {got}")
    with archive.open(info) as stream:
        major, _ = npy.read_magic(stream)
        read_header = npy.read_array_header_1_0 if major == 1 else npy.read_array_header_2_0
        shape, by_column, dtype = read_header(stream)
        needed = int(np.prod([dtype.itemsize, *shape], dtype=object))
        left = info.file_size - stream.tell()
        if dtype.hasobject or min(shape, default=0) < 0 or needed != left:
            raise ValueError(f"{info.filename}: expected {needed:,} bytes of numbers, got {left:,}")
        flat = np.empty(needed, np.uint8)
        filled = 0
        while block := stream.read(_BLOCK):  # to the end: there zipfile compares the checksum of the entry
            flat[filled : filled + len(block)] = np.frombuffer(block, np.uint8)
            filled += len(block)
    if filled != needed:
        raise ValueError(f"{info.filename}: expected {needed:,} bytes, got {filled:,}")
    array: NDArray[Any] = flat.view(dtype).reshape(shape[::-1] if by_column else shape)
    return array.T if by_column else array


def _checksum(file: BufferedReader, size: int) -> bytes:
    """Return the CRC-32 of the first `size` bytes of a file, as 8 hexadecimal digits."""
    file.seek(0)
    crc = 0
    left = size
    while left > 0 and (block := file.read(min(_BLOCK, left))):
        crc = zlib.crc32(block, crc)
        left = left - len(block)
    return b"%08x" % crc
