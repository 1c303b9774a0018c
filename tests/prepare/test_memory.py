"""The memory of a preparation: what a line asks for suffices, whatever the levels hold."""

from __future__ import annotations

import re

import numpy as np
import pytest

from gsvis.errors import ArgumentError
from gsvis.jobs.workers import Workers
from gsvis.prepare.memory import left_for_sets
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.memory import fitting_workers
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import random_scene


@pytest.mark.parametrize("count", [1000, 12_345, 40_000])
def test_a_limit_that_is_asked_for_leaves_room_for_sets(count: int) -> None:
    levels = Levels.single(random_scene(np.random.default_rng(0), count))
    with pytest.raises(ArgumentError, match="max_memory: expected at least") as refusal:
        left_for_sets(Workers(2, max_memory=1), levels, count, PvsConfig())
    found = re.search(r"at least ([0-9.]+) GB", str(refusal.value))
    assert found is not None
    enough = Workers(2, max_memory=round(float(found[1]) * 1e9))
    left = left_for_sets(enough, levels, count, PvsConfig())
    assert left is not None
    assert fitting_workers(levels, PvsConfig(), left) == 1


def test_no_limit_stays_none() -> None:
    levels = Levels.single(random_scene(np.random.default_rng(0), 100))
    for workers in (None, Workers(2)):
        assert left_for_sets(workers, levels, 100, PvsConfig()) is workers
