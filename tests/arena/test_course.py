"""The walk, who sees which photograph, links, budgets: laws of the arena that hold for every system."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from arena.budget import Allowance, Budget, BudgetTrainer, descend
from arena.course import EVERY, Course
from arena.judge import LEVELS_DB, judge
from arena.links import drawn_links, recorded_links
from arena.report import compare, summarize
from numpy.typing import NDArray

from gsvis.errors import FormatError, SceneError
from gsvis.scene.cameras import Cameras

NOTHING = torch.zeros(())


class Photograph:
    """A client that shows the held-out photographs themselves from a moment on."""

    def __init__(self, course: Course, since: float) -> None:
        self.course = course
        self.since = since
        self.asked: list[int] = []

    def image(self, view: int, t: float) -> NDArray[np.float32] | None:
        self.asked.append(view)
        return self.course.held_out.image(view) if t >= self.since else None

    def bytes_at(self, t: float) -> float:
        return 1.0


def test_the_walk_passes_each_photograph_at_its_time(course: Course) -> None:
    positions, _ = course.path.at(np.arange(len(course.photos.views)) / 10.0)
    np.testing.assert_allclose(positions, course.photos.views.cameras.viewpoints, atol=1e-6)
    at, _ = course.path.at(course.passed)
    np.testing.assert_allclose(at, course.held_out.cameras.viewpoints, atol=1e-6)


def test_no_photograph_both_trains_and_judges(course: Course) -> None:
    to_train, to_judge = (set(views.cameras.names) for views in (course.views, course.held_out))
    assert not to_train & to_judge
    assert to_train | to_judge == set(course.photos.names)
    assert sorted(to_judge) == sorted(course.photos.names)[::EVERY]


def test_every_training_draws_training_photographs_alone(course: Course) -> None:
    drawn: list[str] = []
    color = torch.zeros(3, requires_grad=True)

    def draw(camera: Cameras) -> tuple[torch.Tensor, torch.Tensor]:
        drawn.extend(camera.names)
        return color.expand(camera.height, camera.width, 3) * 1.0, NOTHING

    descend(course, Budget(Allowance(60.0, steps=20)), draw, {color: 0.1})
    assert len(drawn) == 20
    assert set(drawn) <= set(course.views.cameras.names)
    assert BudgetTrainer(course, Budget(Allowance(60.0, steps=1))).views is course.views


def test_the_truth_is_the_photograph(course: Course) -> None:
    shown = Photograph(course, 0.0)
    session = judge(course, shown)
    assert np.isinf(session.psnr).all() or (session.psnr >= 50.0).all()
    assert session.first == dict.fromkeys(LEVELS_DB, 0.0)
    assert session.qoe(20.0) == pytest.approx(1.0)
    assert set(shown.asked) == set(range(len(course.held_out)))


def test_what_comes_late_is_latency_up_to_the_time_out(course: Course) -> None:
    session = judge(course, Photograph(course, 0.45))
    assert session.first[20.0] == pytest.approx(0.5)
    assert session.latency[20.0][0] == pytest.approx(0.5)
    assert session.psnr[0] == 0.0
    never = judge(course, Photograph(course, 1e9))
    assert never.latency[25.0].tolist() == [1.0] * len(course.held_out)
    assert np.isinf(never.first[25.0])
    assert never.qoe(25.0) == pytest.approx(-5.0)
    assert never.figures()["first_25"] is None


def test_a_budget_ends_by_the_clock_or_by_steps() -> None:
    now = [0.0]
    budget = Budget(Allowance(10.0), 0.5, clock=lambda: now[0])
    assert budget.step()
    now[0] = 2.5
    assert budget.share == 0.5
    now[0] = 5.0
    assert not budget.step()
    few = Budget(Allowance(10.0, steps=2), clock=lambda: 0.0)
    assert [few.step() for _ in range(3)] == [True, True, False]
    with pytest.raises(ValueError, match="seconds: expected processor seconds > 0"):
        Allowance(0.0)


def test_links_are_the_same_each_time_and_carry_their_rate() -> None:
    first, second = (drawn_links(3.0, 3, 29.2) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.trace.mbit_per_s, b.trace.mbit_per_s)
        assert a.trace.mean == pytest.approx(3.0)


def test_recordings_are_scaled_and_silent_ones_left_out(tmp_path: Path) -> None:
    for name in ("cooked_3gp", "traces_oboe", "5g_download"):
        (tmp_path / name).mkdir()
    for k in range(3):
        (tmp_path / "cooked_3gp" / f"trace_{k}").write_text("".join(f"{t} {1.0 + k}\n" for t in range(1, 41)))
    (tmp_path / "traces_oboe" / "silent").write_text("".join(f"{t} 0.0\n" for t in range(1, 41)))
    links = recorded_links(tmp_path, 10.0, 3, 29.0)
    assert sorted(link.trace.name for link in links) == ["trace_0", "trace_1", "trace_2"]
    for link in links:
        assert link.trace.bytes_between(0.0, 29.0) / 29.0 / 125e3 == pytest.approx(10.0)
    with pytest.raises(SceneError, match="expected 4 recorded links"):
        recorded_links(tmp_path, 10.0, 4, 29.0)


def row(system: str, link: str, psnr: float, first: float | None = 0.5) -> dict[str, object]:
    return {
        "system": system, "mbit": 3.0, "link": link, "psnr": psnr, "megabytes": 1.0, "qoe_20": psnr / 50.0,
        "qoe_25": 0.0, "first_20": first, "first_25": None, "curve": [psnr, psnr],
    }  # fmt: skip


def test_systems_are_compared_over_the_same_links_alone() -> None:
    rows = [row(name, link, value) for name, value in (("gsvis", 20.0), ("other", 18.0)) for link in "ab"]
    apart = compare(rows, "gsvis")
    assert [(each["system"], each["psnr"]["mean"]) for each in apart] == [("other", 2.0)]
    with pytest.raises(ValueError, match="over the links of gsvis"):
        compare([*rows, row("other", "c", 1.0)], "gsvis")


def test_what_never_happened_has_no_median() -> None:
    means = summarize([row("gsvis", "a", 20.0), row("gsvis", "b", 30.0, None), row("gsvis", "c", 30.0, None)])
    assert means[0]["first_20"] is None
    assert means[0]["first_25"] is None
    assert means[0]["curve"] == pytest.approx([80.0 / 3.0] * 2, abs=1e-3)


def test_missing_photographs_are_one_line(tmp_path: Path, course: Course) -> None:
    with pytest.raises(FileNotFoundError):
        Course.open(tmp_path / "none", (48, 32))
    with pytest.raises(FormatError, match="COLMAP model"):
        Course.open(tmp_path, (48, 32))
    few = replace(course.photos, views=course.photos.views[:8])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("arena.course.load_photos", lambda folder, size: few)
        with pytest.raises(SceneError, match="expected more than 8 photographs"):
            Course.open(tmp_path, (48, 32))
