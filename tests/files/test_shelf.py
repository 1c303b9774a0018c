"""Objects on a shelf are what they were: content, what is read-only, what is one array; their files hold no code."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsvis.files.shelf import Shelf


@dataclass(frozen=True)
class Thing:
    name: str
    arrays: tuple[Any, ...]
    again: Any


def thing_of(seed: int) -> Thing:
    rng = np.random.default_rng(seed)
    fixed, wide = rng.random(5000), rng.integers(0, 99, (300, 7)).astype(np.int16)
    fixed.flags.writeable = False
    return Thing(f"thing {seed}", (fixed, wide, np.zeros((0, 3), np.float32), wide.T[::2]), fixed)


def test_an_object_on_a_shelf_is_what_it_was_before_and_after_its_memory_is_given_back(tmp_path: Path) -> None:
    shelf = Shelf(tmp_path / "new" / "shelf")
    found = [shelf.put(thing_of(seed)) for seed in range(3)]
    for _ in range(2):
        for seed, thing in enumerate(found):
            given = thing_of(seed)
            assert thing.name == given.name
            assert thing.again is thing.arrays[0]
            for got, want in zip(thing.arrays, given.arrays, strict=True):
                np.testing.assert_array_equal(got, want)
                assert (got.dtype, got.shape, got.flags.writeable) == (want.dtype, want.shape, want.flags.writeable)
        shelf.release()


def test_files_of_a_shelf_hold_arrays_alone(tmp_path: Path) -> None:
    Shelf(tmp_path).put(thing_of(0))
    (file,) = tmp_path.iterdir()
    assert b"Thing" not in file.read_bytes()
    assert b"thing 0" not in file.read_bytes()
