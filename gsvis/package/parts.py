"""Parts: files of one folder, named by the SHA-256 of their content. They are written once and checked at each read.

A name is 64 hexadecimal digits and a suffix, so no name leads out of the folder. This module does not interpret the
content of parts.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.arrow import ArrowFile, write_arrow
from gsvis.files.atomic import remove_all_partials
from gsvis.files.fields import Fields
from gsvis.files.limits import DAMAGED, Budget, check_regular, digest_of, read_whole
from gsvis.files.output import output_errors

__all__ = ["MOST_BYTES", "Part", "PartFolder"]

FORMAT = "gsvis-part"
VERSION = 1

MOST_BYTES = 1 << 20
"""Most bytes of a part, before compression."""

_DIGEST = re.compile("[0-9a-f]{64}")
_OURS = re.compile(
    r"[0-9a-f]{64}\.(arrow|bin)|\.part-[0-9a-f]{12}\.(arrow|bin)|\.\.part-[0-9a-f]{12}(-|\.gsvis-).*\.(arrow|bin)"
)


@dataclass(frozen=True)
class Part:
    """One file of a package.

    Attributes:
        digest: SHA-256 of the content, 64 hexadecimal digits.
        nbytes: Size of the file, bytes.
        suffix: "arrow" or "bin".
    """

    digest: str
    nbytes: int
    suffix: str = "arrow"

    @classmethod
    def from_fields(cls, fields: Fields, suffix: str = "arrow") -> Part:
        """Return the part that an object of a manifest names.

        Raises:
            FormatError: If the object has no valid hash or size.
        """
        digest = fields.raw("sha256")
        if not isinstance(digest, str) or not _DIGEST.fullmatch(digest):
            got = repr(digest)[:80]
            raise FormatError(fields.path, fields.where("sha256"), "64 hexadecimal digits", got)
        return cls(digest, fields.integer("bytes", 0, 1 << 40), suffix)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the part for a manifest."""
        return {"sha256": self.digest, "bytes": self.nbytes}

    @property
    def name(self) -> str:
        """File name."""
        return f"{self.digest}.{self.suffix}"


class PartFolder:
    """The folder of parts of a package.

    Args:
        folder: Path of the folder.

    Attributes:
        written: Number of parts that this object wrote; parts that existed already do not count.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.written = 0
        self._swept = False

    def write_columns(self, kind: str, columns: dict[str, NDArray[Any]]) -> Part:
        """Write columns of one length as an Arrow file, and return its part.

        Args:
            kind: Kind of the columns, stored in the header.
            columns: (R,) arrays of numbers by name.
        """
        fields = [pa.field(name, pa.from_numpy_dtype(values.dtype), nullable=False) for name, values in columns.items()]
        arrays = [pa.array(np.ascontiguousarray(values)) for values in columns.values()]
        batch = pa.record_batch(arrays, schema=pa.schema(fields))
        header = {"format": FORMAT, "version": VERSION, "kind": kind, "rows": batch.num_rows}
        return self._write("arrow", lambda path: write_arrow(path, fields, header, [batch], sweep=False))

    def write_bytes(self, data: bytes) -> Part:
        """Write bytes as they are, and return their part."""

        def write(path: Path) -> None:
            """Write the bytes to a file."""
            path.write_bytes(data)

        return self._write("bin", write)

    def path_of(self, part: Part) -> Path:
        """Check the size and content of a part, and return its path.

        Raises:
            FormatError: If the part is missing, a link, a folder, or its content does not fit its name.
        """
        path = self.check_size(part)
        digest = digest_of(path)
        if digest != part.digest:
            raise FormatError(path, "", "content that fits its name", f"SHA-256 {digest[:12]}...", DAMAGED)
        return path

    def check_size(self, part: Part) -> Path:
        """Return the path of a part that is a file of the right size; do not read it.

        Raises:
            FormatError: If the part is missing, a link, a folder, or has a wrong size.
        """
        path = self.folder / part.name
        if path.is_symlink():
            raise FormatError(
                path, "", "a file of the package", "a link", "links are not followed; copy the file itself"
            )
        try:
            size = check_regular(path).st_size
        except (FileNotFoundError, NotADirectoryError) as error:
            raise FormatError(path, "", "a part of the package", "no such file", "prepare the package again") from error
        except IsADirectoryError as error:
            raise FormatError(path, "", "a part of the package", "a folder", "prepare the package again") from error
        if size != part.nbytes:
            raise FormatError(path, "", f"{part.nbytes:,} bytes", f"{size:,}", DAMAGED)
        return path

    def content_of(self, part: Part) -> bytes:
        """Return the bytes of a part.

        Raises:
            FormatError: If the part is missing, a link, a folder, or its content does not fit its name.
        """
        return read_whole(self.path_of(part))

    def read_columns(
        self, part: Part, kind: str, types: dict[str, type[np.generic]], rows: int, budget: Budget | None = None
    ) -> dict[str, Any]:
        """Return the columns of a part.

        Args:
            part: The part.
            kind: Expected kind of the columns.
            types: Expected columns and their types, in order.
            rows: Expected number of rows.
            budget: Memory budget to claim from; None gives the part a budget of its own.

        Raises:
            FormatError: If the part is missing, a link or a folder, its content does not fit its name, or its kind,
                columns or number of rows are not those expected.
        """
        path = self.path_of(part)
        file = ArrowFile(path, FORMAT, VERSION)
        if file.header.raw("kind") != kind:
            raise FormatError(path, "kind", kind, repr(file.header.raw("kind"))[:60])
        expected = pa.schema([pa.field(k, pa.from_numpy_dtype(np.dtype(t)), nullable=False) for k, t in types.items()])
        file.check_schema(expected)
        batches = list(file.batches(Budget(path, file.nbytes) if budget is None else budget))
        found = sum(batch.num_rows for batch in batches)
        if found != rows:
            raise FormatError(path, "rows", f"{rows:,} as the manifest says", f"{found:,}", DAMAGED)
        return {
            name: np.concatenate([batch.column(name).to_numpy() for batch in batches] or [np.zeros(0, kind)])
            for name, kind in types.items()
        }

    def remove_all_but(self, kept: Iterable[Part]) -> int:
        """Remove all parts except `kept`, and temporary files of killed runs. Other files stay.

        Returns:
            Number of files removed.
        """
        names = {part.name for part in kept}
        stale = [p for p in sorted(self.folder.iterdir()) if p.name not in names and _OURS.fullmatch(p.name)]
        for path in stale:
            path.unlink()
        return len(stale)

    def _write(self, suffix: str, write: Callable[[Path], None]) -> Part:
        """Write a temporary file with `write`, and rename it to its hash unless that part exists; return the part."""
        partial = self.folder / f".part-{secrets.token_hex(6)}.{suffix}"
        with output_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            if not self._swept:  # once: listing the folder for each of many parts is slow
                remove_all_partials(self.folder)
                self._swept = True
            try:
                write(partial)
                part = Part(digest_of(partial), partial.stat().st_size, suffix)
                try:
                    self.path_of(part)
                except FormatError:
                    os.replace(partial, self.folder / part.name)
                    self.written += 1
            finally:
                partial.unlink(missing_ok=True)
        return part
