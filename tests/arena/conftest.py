"""A small course, shared by all tests of the arena."""

from __future__ import annotations

import pytest
from arena.course import Course, write_synthetic_photos


@pytest.fixture(scope="session")
def course(tmp_path_factory: pytest.TempPathFactory) -> Course:
    """Ten photographs of a built-in scene, two of them held out."""
    folder = write_synthetic_photos(tmp_path_factory.mktemp("arena") / "photos", 10, (48, 32))
    return Course.open(folder, (48, 32))
