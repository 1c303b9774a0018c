"""The Arrow container: two seals, batches in any order, and footers that lie."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pytest

from gsvis.errors import FormatError
from gsvis.files import arrow
from gsvis.files.arrow import ArrowFile, Seal, write_arrow
from gsvis.files.limits import Budget

FIELDS = [pa.field("a", pa.int32(), nullable=False), pa.field("b", pa.large_binary(), nullable=False)]


def write(path: Path, seal: Seal, count: int = 5) -> Path:
    rows = [[pa.array([k, k + 1], pa.int32()), pa.array([b"x" * k, b"y"], pa.large_binary())] for k in range(count)]
    batches = (pa.record_batch(columns, schema=pa.schema(FIELDS)) for columns in rows)
    write_arrow(path, FIELDS, {"format": "test", "version": 1, "rows": 2 * count}, batches, seal=seal)
    return path


@pytest.mark.parametrize("seal", ["whole", "header"])
def test_batches_come_in_any_order(tmp_path: Path, seal: Seal) -> None:
    file = ArrowFile(write(tmp_path / "x.arrow", seal), "test", 1, seal=seal)
    file.check_schema(pa.schema(FIELDS))
    assert (file.num_batches, file.header.integer("rows", 0, 100)) == (5, 10)
    for number in (4, 0, 2, 2):
        assert file.batch(number, Budget(file.path, file.nbytes))["a"].to_pylist() == [number, number + 1]
    assert [batch["a"][0].as_py() for batch in file.batches(Budget(file.path, file.nbytes))] == [0, 1, 2, 3, 4]
    with pa.memory_map(str(file.path)) as source:
        assert pa.ipc.open_file(source).read_all().num_rows == 10
    file.close()
    with pytest.raises(ValueError, match="closed"):
        file.batch(0, Budget(file.path, file.nbytes))


@pytest.mark.parametrize("seal", ["whole", "header"])
def test_a_file_without_batches_has_none(tmp_path: Path, seal: Seal) -> None:
    file = ArrowFile(write(tmp_path / "x.arrow", seal, 0), "test", 1, seal=seal)
    assert list(file.batches(Budget(file.path, file.nbytes))) == []


def test_one_seal_is_not_taken_for_the_other(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="expected a checksum, got none"):
        ArrowFile(write(tmp_path / "h.arrow", "header"), "test", 1, seal="whole")
    with pytest.raises(FormatError, match="an Arrow file without them"):
        ArrowFile(write(tmp_path / "w.arrow", "whole"), "test", 1, seal="header")


def test_a_changed_header_does_not_fit_its_seal(tmp_path: Path) -> None:
    path = write(tmp_path / "x.arrow", "header")
    path.write_bytes(path.read_bytes().replace(b'"rows": 10', b'"rows": 99'))
    with pytest.raises(FormatError, match="a header that fits its checksum"):
        ArrowFile(path, "test", 1, seal="header")


@pytest.mark.parametrize(("place", "value"), [(0, -8), (0, 1 << 40), (0, 12), (8, -1), (16, -1), (16, 1 << 62)])
def test_a_footer_that_points_elsewhere_is_refused(tmp_path: Path, place: int, value: int) -> None:
    """Each number of the place of a batch, out of the file or into the midst of another."""
    path = write(tmp_path / "x.arrow", "header")
    data = bytearray(path.read_bytes())
    with pa.OSFile(str(path)) as source:
        footer = arrow._footer_start(path, memoryview(source.read()))
    blocks = arrow._list_blocks(bytes(data[footer:-10]))
    at = bytes(data).index(blocks[3].tobytes(), footer) + place
    size = 4 if place == 8 else 8
    data[at : at + size] = value.to_bytes(size, "little", signed=True)
    path.write_bytes(data)
    file = ArrowFile(path, "test", 1, seal="header")
    with pytest.raises(FormatError, match="a place of batch 3 within the file"):
        file.batch(0, Budget(path, file.nbytes))


def test_columns_of_another_type_are_named(tmp_path: Path) -> None:
    file = ArrowFile(write(tmp_path / "x.arrow", "whole"), "test", 1)
    with pytest.raises(FormatError, match="column 'b': expected string, got large_binary"):
        file.check_schema(pa.schema([FIELDS[0], pa.field("b", pa.string(), nullable=False)]))
    with pytest.raises(FormatError, match="columns: expected a, got a, b"):
        file.check_schema(pa.schema(FIELDS[:1]))
