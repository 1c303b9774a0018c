"""When eyes of two rules disagree there is a warning, and only then."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.judged import APART, GOOD, LEAST, Judged


def judged(mine: float, theirs: float, **more) -> Judged:
    return Judged(np.full(5, mine), np.full(4, theirs), np.array([True, False, False, False]), **more)


@pytest.mark.parametrize(
    ("mine", "theirs"),
    [
        (LEAST + 10, LEAST - 1),
        (LEAST - 1, LEAST + 10),
        (LEAST - 5, LEAST - 5),
        (GOOD + 30, GOOD - 1),
        (LEAST + 8, LEAST + 8 - APART - 0.1),
    ],
)
def test_a_low_median_or_a_difference_that_shows_is_warned_about(mine: float, theirs: float) -> None:
    warning = judged(mine, theirs).warning
    assert warning is not None
    assert "25% of the judging eyes" in warning


@pytest.mark.parametrize(
    ("mine", "theirs"), [(100.0, GOOD), (GOOD, 100.0), (LEAST, LEAST), (LEAST + 7, LEAST + 7 - APART + 0.1)]
)
def test_what_nobody_sees_is_not(mine: float, theirs: float) -> None:
    assert judged(mine, theirs).warning is None


def test_levels_need_not_equal_the_scene() -> None:
    assert judged(28.0, 27.0, least=0.0).warning is None
    assert judged(28.0, 21.0, least=0.0).warning is not None


def test_eyes_given_judge_apart_from_those_drawn_and_are_named() -> None:
    values = np.array([60.0] * 6 + [20.0] * 4)
    found = Judged(np.full(5, 60.0), values, np.ones(10, bool), "4 cameras of photos.json", 4)
    assert found.warning is not None
    assert "20.0 dB at eyes of 4 cameras of photos.json" in found.warning
    assert found.as_dict()["given"] == {
        "from": "4 cameras of photos.json", "views": 4, "mean": 20.0, "median": 20.0, "p5": 20.0, "worst": 20.0
    }  # fmt: skip


def test_without_judges_or_cells_nothing_is_claimed() -> None:
    none = Judged(np.full(3, 60.0), np.zeros(0), np.zeros(0, bool))
    assert none.warning is None
    assert none.as_dict()["judge_eyes_in_cells"] is None
    assert "not checked" in none.line
    assert "in cells" not in Judged(np.full(3, 60.0), np.full(3, 60.0), None).line


def test_parts_join_to_the_whole() -> None:
    one, other = judged(60.0, 20.0), judged(40.0, 50.0)
    both = Judged.joined([one.as_dict(), other.as_dict()])
    assert both.builder.tolist() == [*one.builder, *other.builder]
    assert both.judge.tolist() == [*one.judge, *other.judge]
    assert both.share_in_cells == 0.25


def test_joined_parts_keep_what_cameras_saw_apart() -> None:
    """In each part cameras see 20 dB; drawn eyes are more, and see 60 dB."""
    values = np.array([60.0] * 6 + [20.0] * 2)
    part = Judged(np.full(5, 60.0), values, np.arange(8) < 6, "the cameras given", 2)
    alone = Judged(np.full(5, 60.0), np.full(4, 60.0), np.ones(4, bool))
    joined = Judged.joined([part.as_dict(), alone.as_dict(), part.as_dict()])
    assert (joined.given, joined.named) == (4, "the cameras given")
    assert joined.judge.tolist() == [60.0] * 16 + [20.0] * 4
    assert joined.share_in_cells == 16 / 20
    assert joined.warning is not None
    assert "20.0 dB at eyes of the cameras given" in joined.warning
    assert Judged.joined([alone.as_dict()]).as_dict() == alone.as_dict()
    blind = Judged(np.full(2, 60.0), np.full(2, 60.0), None)
    assert Judged.joined([blind.as_dict()]).share_in_cells is None
