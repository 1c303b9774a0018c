"""Read comma-separated tables; errors name the line and the column.

Plain or gzipped (detected from the first bytes), UTF-8 with or without a byte-order mark, quoted cells. Knows no
format.
"""

from __future__ import annotations

import csv
import gzip
import io
import os
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.limits import Budget, read_whole

__all__ = ["Table", "join_names", "read_table"]

_CHUNK = 1 << 20
_LONGEST_LINE = 1 << 16
# largest memory overhead of a cell beyond its text, and of a row beyond its cells
_CELL = 72
_ROW = 144


class Table:
    """The rows of a comma-separated file under a header.

    Args:
        path: The file, for messages.
        header: Names of the columns, stripped.
        rows: Cells; each row has as many as the header.
        lines: Line of the file on which the header and then each row ends, from 1.
    """

    def __init__(self, path: Path, header: list[str], rows: list[list[str]], lines: list[int]) -> None:
        self.path = path
        self.header = header
        self.rows = rows
        self.lines = lines

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, row: int, column: str) -> str:
        """Return the line and column of a cell, for messages."""
        return f"line {self.lines[row + 1]}, column {column}"

    def column(self, name: str) -> int:
        """Return the index of a column.

        Raises:
            FormatError: If no column has that name, or more than one has.
        """
        return self.columns((name,))[0]

    def columns(self, names: tuple[str, ...], known: tuple[str, ...] = ()) -> list[int]:
        """Return the indices of columns; the message about missing ones names every column that differs.

        Args:
            names: The columns.
            known: Further columns of the format; they are not listed as unexpected.

        Raises:
            FormatError: If one of them is missing, or more than one has its name.
        """
        counts = Counter(self.header)
        missing = [name for name in names if name not in counts]
        if missing:
            others = [name for name in counts if name not in names and name not in known]
            what = ("columns " if len(names) > 1 else "a column ") + ", ".join(names)
            got = f"no {', '.join(missing)}" + (f"; unexpected: {join_names(others)}" if others else "")
            raise FormatError(self.path, f"line {self.lines[0]}", what, got)
        repeated = next((name for name in names if counts[name] > 1), None)
        if repeated is not None:
            where = f"line {self.lines[0]}, column {repeated}"
            raise FormatError(self.path, where, f"one column {repeated}", f"{counts[repeated]} of that name")
        return [self.header.index(name) for name in names]

    def numbers(self, names: tuple[str, ...], known: tuple[str, ...] = ()) -> NDArray[np.float64]:
        """Return (rows, len(names)) finite numbers of the given columns; `known` as in `columns`.

        Raises:
            FormatError: If a column is missing, or at the first cell that is not a finite number.
        """
        places = self.columns(names, known)
        cells = [[row[place] for place in places] for row in self.rows]
        try:
            values = np.array(cells, np.float64).reshape(len(cells), len(names))
        except ValueError:
            values = np.array([[_number(cell) for cell in row] for row in cells])
        bad = ~(np.abs(values) < 1e300)  # NaN and infinity fail too
        if bad.any():
            row, column = (int(i) for i in np.argwhere(bad)[0])
            got = repr(cells[row][column][:40])
            raise FormatError(self.path, self.where(row, names[column]), "a finite number", got)
        return values


def join_names(names: list[str], most: int = 16) -> str:
    """Return the names for a message, long ones cut; names beyond the first `most` are only counted."""
    shown = ", ".join(repr(name[:40]) if len(name) > 40 or not name.isprintable() else name for name in names[:most])
    return shown + (f" and {len(names) - most:,} more" if len(names) > most else "")


def read_table(path: str | os.PathLike[str]) -> Table:
    """Read a comma-separated file whose first line names its columns; skip blank lines.

    Raises:
        FileNotFoundError: If there is no file.
        FormatError: If it is not text, is damaged, has no header, or a row has more or fewer cells than the header.
    """
    path = _check.path("path", path)
    data = read_whole(path)
    budget = Budget(path, len(data))
    reader = csv.reader(_lines(path, _text(path, data, budget), budget), strict=True)
    rows: list[list[str]] = []
    lines: list[int] = []
    header: list[str] | None = None
    try:
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            if header is None:
                header = [cell.strip() for cell in cells]
                lines.append(reader.line_num)
                continue
            if len(cells) != len(header):
                where = f"line {reader.line_num}"
                remedy = "is the file truncated?"
                raise FormatError(path, where, f"{len(header)} cells, as in the header", f"{len(cells)}", remedy)
            rows.append(cells)
            lines.append(reader.line_num)
    except csv.Error as error:
        raise FormatError(path, f"line {reader.line_num}", "comma-separated cells", str(error)) from error
    if header is None:
        raise FormatError(path, "line 1", "a header that names the columns", "an empty file")
    return Table(path, header, rows, lines)


def _lines(path: Path, text: str, budget: Budget) -> Iterator[str]:
    """Yield the lines of a text; reject overlong ones, and claim the memory of their cells before they are split."""
    for number, line in enumerate(io.StringIO(text, newline=""), 1):
        if len(line) > _LONGEST_LINE:
            raise FormatError(path, f"line {number}", f"at most {_LONGEST_LINE:,} characters", f"{len(line):,}")
        budget.claim(_ROW + _CELL * (line.count(",") + 1) + 4 * len(line), "the cells of the table")
        yield line


def _text(path: Path, data: bytes, budget: Budget) -> str:
    """Return the text of a file, unzipped and decoded."""
    if data[:2] == b"\x1f\x8b":
        data = _unzip(path, data, budget)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise FormatError(path, f"line {line}", "UTF-8 text", f"byte 0x{data[error.start]:02x}") from error


def _unzip(path: Path, data: bytes, budget: Budget) -> bytes:
    """Return the unpacked bytes of a gzip file."""
    parts = []
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            while part := stream.read(_CHUNK):
                budget.claim(len(part), "gzip")
                parts.append(part)
    except (OSError, EOFError, zlib.error) as error:
        raise FormatError(path, "gzip", "a complete gzip file", str(error), "download it again") from error
    return b"".join(parts)


def _number(cell: str) -> float:
    """Return the number in a cell; NaN if it holds none."""
    try:
        return float(cell)
    except ValueError:
        return np.nan
