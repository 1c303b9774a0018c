"""Scene files that are cut, and some that promise more than they hold: `FormatError` of one line, in bounded memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from gsvis.errors import FormatError
from gsvis.io import load_scene
from tests.fuzz.families import TARGETS
from tests.fuzz.targets import Case, run_case

FILES = {
    "ply": (0, 1, 2, 3),
    "compressed-ply": (0,),
    "splat": (0,),
    "ksplat": (0, 3, 6, 9),
    "spz-gzip": (0, 3, 6),
    "spz-zstd": (0,),
    "sog-zip": (0, 3),
}
"""Numbers of the cases: every encoding and every version once."""


@pytest.mark.parametrize(("name", "number"), [(name, k) for name, numbers in FILES.items() for k in numbers])
def test_every_prefix_of_every_file(tmp_path: Path, name: str, number: int) -> None:
    target = TARGETS[name]
    ((file, data),) = target.cases[number].items()
    verdicts = [
        run_case(target, tmp_path, {file: data[:size]}) for size in range(0, len(data), max(1, len(data) // 60))
    ]
    assert verdicts[0] == "refused"


@pytest.mark.parametrize("name", ["sog-folder", "streamed-sog"])
def test_every_prefix_of_every_file_of_a_folder(tmp_path: Path, name: str) -> None:
    target = TARGETS[name]
    case: Case = target.cases[0]
    for file, data in case.items():
        for size in range(0, len(data), max(1, len(data) // 4)):
            run_case(target, tmp_path, {**case, file: data[:size]})


@pytest.mark.parametrize(("name", "number"), [("ply", 0), ("ply", 2), ("compressed-ply", 0)])
@pytest.mark.parametrize("count", [10**9, 2**31, 2**63, 10**12])
def test_a_thousand_bytes_that_declare_a_thousand_million_rows(
    tmp_path: Path, name: str, number: int, count: int
) -> None:
    data = TARGETS[name].cases[number]["a.ply"]
    assert b"element vertex 12\n" in data
    data = data.replace(b"element vertex 12\n", b"element vertex %d\n" % count)
    data = data.replace(b"element chunk 1\n", b"element chunk %d\n" % -(-count // 256))
    (tmp_path / "a.ply").write_bytes(data)
    tracemalloc.start()
    with pytest.raises(FormatError):
        load_scene(tmp_path / "a.ply")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 << 20
