"""The guard of a cleaning is not fooled by wrong eyes: judge's eyes see what it cannot."""

from __future__ import annotations

import pytest

from gsvis.edit import CleanConfig, clean
from tests.scene.tilted_platform import right_eyes, tilted_platform, wrong_eyes

SCENE = tilted_platform()
QUICK = CleanConfig(eyes=6, size=64, resolution=64, held_out=4)


@pytest.fixture(scope="module")
def fooled():
    return clean(SCENE, navigable=wrong_eyes(), config=QUICK)


def test_wrong_eyes_pass_the_guard_and_judges_warn(fooled) -> None:
    assert fooled.kept.mean() < 0.8
    assert fooled.costs["all"].worst_db > 45.0  # the guard draws from the same eyes
    assert fooled.judged is not None
    assert fooled.judged.builder.min() > 45.0
    assert fooled.judged.judge.max() < 35.0
    assert fooled.judged.warning is not None


def test_right_eyes_are_not_warned_about() -> None:
    found = clean(SCENE, navigable=right_eyes(), config=QUICK)
    assert found.judged is not None
    assert found.judged.warning is None


def test_there_is_no_judgment_without_a_guard() -> None:
    few = CleanConfig(eyes=2, size=32, resolution=32, held_out=0)
    assert clean(SCENE, navigable=right_eyes(), config=few).judged is None
