"""Mapped arrays that were written piece by piece are those that were written at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsvis.files.mapped import ArrayFiles, MappedArrays, write_arrays


def test_arrays_that_grow_in_pieces_are_read_as_those_written_at_once(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    first, second, wide = rng.random(3000), rng.random(3000), rng.integers(0, 9, (777, 3)).astype(np.int16)
    (tmp_path / "parts").mkdir()
    with ArrayFiles(tmp_path / "parts") as out:
        for k in range(3):
            out.append("x", first[1000 * k : 1000 * (k + 1)])
            out.append("y", second[1000 * k : 1000 * (k + 1)])
            out.append("wide", wide[259 * k : 259 * (k + 1)])
        out.append("none", np.zeros((0, 4), np.uint8))
        assert out.count("wide") == 777
        assert np.array_equal(out.rows("wide", 5, 300), wide[5:300])
        joined, same = {"rows": ["x", "y"]}, {"again": "wide"}
        out.write(tmp_path / "pieces", {"a": 1}, joined=joined, same=same, frozen=["wide"])
    found = MappedArrays(tmp_path / "pieces")
    assert found.facts == {"a": 1}
    assert np.array_equal(found.arrays["rows"], np.stack([first, second]))
    assert np.array_equal(found.arrays["wide"], wide)
    assert np.array_equal(found.arrays["again"], wide)
    assert found.arrays["none"].shape == (0, 4)
    assert not found.arrays["wide"].flags.writeable
    assert found.arrays["rows"].flags.writeable


def test_what_is_released_reads_as_before_and_only_shares_of_each_line_are(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    arrays = {"long": rng.random(1 << 16), "lines": rng.random((3, 1 << 15)).astype(np.float32), "none": np.zeros(0)}
    write_arrays(tmp_path / "x", arrays, {})
    found = MappedArrays(tmp_path / "x")
    assert sorted(size for _, size in found._lines if size) == [*3 * [4 << 15], 8 << 16]
    for array in found.arrays.values():
        array.reshape(-1)[:] = 0.0  # stays in this process until its page is given back
    found.release([(0.25, 0.5), (0.9, 0.9)])
    for name, whole in arrays.items():
        low, high = whole.shape[-1] // 4, whole.shape[-1] // 2
        assert np.array_equal(found.arrays[name][..., low:high], whole[..., low:high])
        assert not found.arrays[name][..., :low].any()
        assert not found.arrays[name][..., high:].any()
    found.release()
    for name, whole in arrays.items():
        assert np.array_equal(found.arrays[name], whole)
