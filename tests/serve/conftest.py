"""Scenes that servers of tests serve."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.stream.worlds import package_of


@pytest.fixture(scope="session")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package without visible sets: from everywhere all is wanted."""
    folder = tmp_path_factory.mktemp("plain") / "plain.gsvis"
    package_of(folder, 6000, stores=False).close()
    return folder


@pytest.fixture(scope="session")
def celled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package with visible sets of cells."""
    folder = tmp_path_factory.mktemp("celled") / "celled.gsvis"
    package_of(folder, 1500).close()
    return folder
