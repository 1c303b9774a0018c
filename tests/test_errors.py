"""The exception tree: what is caught together, and the one line that a bad file gives."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from gsvis.errors import BackendError, FormatError, GsvisError, SceneError
from gsvis.progress import silent


@pytest.mark.parametrize("kind", [FormatError, SceneError, BackendError])
def test_all_are_caught_as_one_and_none_is_a_bad_argument(kind: type[GsvisError]) -> None:
    assert issubclass(kind, GsvisError)
    assert not issubclass(kind, ValueError)


def test_a_format_error_is_one_line_with_place_and_remedy() -> None:
    error = FormatError(Path("a") / "b.ply", "byte 12", "4 vertices", "3", "download it again")
    assert str(error) == "a/b.ply: byte 12: expected 4 vertices, got 3; download it again"
    assert (error.path, error.where, error.expected, error.got, error.remedy) == (
        "a/b.ply",
        "byte 12",
        "4 vertices",
        "3",
        "download it again",
    )
    assert str(FormatError("x", "", "a scene", "nothing")) == "x: expected a scene, got nothing"


def test_what_a_file_says_cannot_break_the_line_or_fill_the_terminal() -> None:
    error = FormatError("x", "key\n2", "a name", "'\x1b[2J" + "y" * 100_000, "try\r\nagain")
    assert str(error).isprintable()
    assert len(str(error)) < 500
    assert str(error).startswith("x: key\\n2: expected a name, got '\\x1b[2Jyyy")
    assert str(error).endswith("...; try\\r\\nagain")


def test_errors_come_back_from_worker_processes() -> None:
    error = FormatError("x", "y", "a", "b", "c")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_silent_progress_takes_any_stage() -> None:
    silent("rays", 0, 10)
    silent("rays", 10, 10)
