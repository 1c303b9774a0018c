"""Plain pose files: round trip, faults reported with line and column, and the format found from the header."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.io.poses import load_path, read_poses, write_poses
from gsvis.scene.paths import HeadPath

HEADER = "t,x,y,z,qw,qx,qy,qz"


def wander(count: int = 30) -> HeadPath:
    rng = np.random.default_rng(0)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.01, 0.2, count - 1))])
    return HeadPath(times, rng.normal(size=(count, 3)), rng.normal(size=(count, 4)))


@pytest.mark.parametrize("name", ["walk.csv", "walk.csv.gz", "walk"])
def test_what_is_written_is_read_back(tmp_path: Path, name: str) -> None:
    path = wander()
    write_poses(path, tmp_path / name)
    for again in (read_poses(tmp_path / name), load_path(tmp_path / name)):
        assert np.array_equal(again.times, path.times)
        assert np.array_equal(again.positions, path.positions)
        assert np.allclose(again.quats, path.quats, atol=1e-15, rtol=0)
        assert again.up is None
    first = (tmp_path / name).read_bytes()
    write_poses(path, tmp_path / name)
    assert (tmp_path / name).read_bytes() == first
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "walk.csv"
    write_poses(wander(), file)
    before = file.read_bytes()

    def full(self: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="cannot be written: no space left"):
        write_poses(wander(5), file)
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]


def test_columns_may_come_in_any_order_with_others_among_them(tmp_path: Path) -> None:
    file = tmp_path / "walk.csv"
    rows = ["note, qw ,qx,qy,qz,z,y,x,t", "a,2e0,0,0,0,3,2,1,5", "", '"b, c",1,0,0,0,6,5,4,7.5', ""]
    file.write_bytes(("\ufeff" + "\r\n".join(rows).replace("2e0", "1e0")).encode())
    path = load_path(file)
    assert path.times.tolist() == [0.0, 2.5]
    assert path.positions.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("rows", "where", "got"),
    [
        (["0,0,0,0,1,0,0,0", "1,0,zero,0,1,0,0,0"], "line 3, column y", "'zero'"),
        (["0,0,0,0,1,0,0,0", "1,0,nan,0,1,0,0,0"], "line 3, column y", "'nan'"),
        (["0,0,0,1e999,1,0,0,0"], "line 2, column z", "'1e999'"),
        (["0,0,0,,1,0,0,0"], "line 2, column z", "''"),
        (["0,0,0,0,1,0,0"], "line 2", "7"),
        (["0,0,0,0,1,0,0,0", "0,0,0,0,1,0,0,0"], "line 3, column t", "0"),
        (["5,0,0,0,1,0,0,0", "4,0,0,0,1,0,0,0"], "line 3, column t", "4"),
        (["0,0,0,0,1,0,0,1"], "line 2, column qw to qz", "length 1.41"),
        (["0,0,0,0,0,0,0,0"], "line 2, column qw to qz", "length 0"),
        ([], "line 2", "the end of the file"),
        (['0,0,0,"0,1,0,0,0'], "line 2", "unexpected end of data"),
    ],
)
def test_faults_are_reported_with_line_and_column(tmp_path: Path, rows: list[str], where: str, got: str) -> None:
    file = tmp_path / "walk.csv"
    file.write_text("\n".join([HEADER, *rows]) + "\n", encoding="utf-8")
    for read in (read_poses, load_path):
        with pytest.raises(FormatError) as caught:
            read(file)
        assert caught.value.where == where
        assert got in caught.value.got
        assert caught.value.path == str(file)


def test_headers_that_are_no_poses(tmp_path: Path) -> None:
    file = tmp_path / "walk.csv"
    for text, message in (
        ("", "empty"),
        ("\n\n", "empty"),
        ("a,b\n1,2\n", "got a, b$"),
        (HEADER.replace("qz", "w") + "\n0,0,0,0,1,0,0,0\n", "got no qz; unexpected: w$"),
        (HEADER + ",t\n0,0,0,0,1,0,0,0,0\n", "one column t, got 2 of that name"),
    ):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(FormatError, match=message):
            load_path(file)
    with pytest.raises(FormatError, match="a folder"):
        load_path(tmp_path)
    with pytest.raises(FileNotFoundError):
        load_path(tmp_path / "none.csv")


def test_damaged_bytes_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "walk.csv.gz"
    write_poses(wander(200), file)
    whole = file.read_bytes()
    for damaged in (whole[:-30], whole[:20], whole[:40] + b"\x00\xff\x00" + whole[43:]):
        file.write_bytes(damaged)
        with pytest.raises(FormatError, match="gzip"):
            read_poses(file)
    file.write_bytes((HEADER + "\n0,0,0,\xe9,1,0,0,0\n").encode("latin-1"))
    with pytest.raises(FormatError, match=r"line 2: expected UTF-8 text, got byte 0xe9"):
        read_poses(file)
    file.write_bytes(gzip.compress(HEADER.encode() + b"," * (1 << 20)))
    with pytest.raises(FormatError, match="line 1: expected at most 65,536 characters"):
        read_poses(file)
    file.write_bytes(gzip.compress(bytes(100 << 20)))
    with pytest.raises(FormatError, match="damaged or made to exhaust memory"):
        read_poses(file)
