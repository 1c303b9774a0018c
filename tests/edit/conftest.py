"""Grids over the small scenes of these tests have few voxels, but where the grid itself is the subject."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module", autouse=True)
def few_voxels(request: pytest.FixtureRequest) -> Iterator[None]:
    """Find surfaces on a grid of a million voxels; `test_shape` has the grid of real scenes."""
    with pytest.MonkeyPatch.context() as patch:
        if request.module.__name__.rpartition(".")[2] != "test_shape":
            patch.setattr("gsvis.edit.shape._VOXELS", 1 << 20)
        yield
