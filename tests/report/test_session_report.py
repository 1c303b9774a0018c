"""The report on simulated sessions: complete, self-contained, the same every time."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsvis.abr import AbrConfig, BandwidthTrace
from gsvis.report.session_document import Simulation, session_document
from gsvis.report.session_page import _lead, content_remarks, describe_eyes
from gsvis.report.session_report import write_session_report
from gsvis.simulate import Adaptive, Link, MortonProgressive, Visit, WholeFile, play, show_at, watch
from gsvis.simulate.visits import judged_in
from tests.report.test_color_report import Outline
from tests.simulate.streets import QUICK, street, walk

pytestmark = pytest.mark.usefixtures("coarse_plots")
AWKWARD = "<b>\"streets\" & 'squares'</b> $title"
PLOTS = {"qoe", "psnr", "latency", "bandwidth", "shares", "bytes", "start"}
LINK = Link(BandwidthTrace([1.0, 4.0], [0.4, 0.2], name="<a link> & more"))


@pytest.fixture(scope="module")
def simulation(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Simulation]:
    scene, stage = street(tmp_path_factory.mktemp("street"))
    visits = []
    with scene.source:
        for k in range(2):
            deliveries = (
                Adaptive(scene, QUICK.view, AbrConfig(start_rate=5e3, fill=False)),
                WholeFile(scene.contents, 100_000),  # never arrives
                MortonProgressive(scene.contents),
            )
            link = LINK.from_time(2.0 * k)
            played = [play(d, link, walk(), stage.size, seconds=QUICK.watched) for d in deliveries]
            sessions = tuple(watch(stage, played, walk(), QUICK))
            full, shown = show_at(stage, played, walk(), 1.0, QUICK)
            pictures = [(1.0, "", full)]
            pictures += [(1.0, p.name, image) for p, image in zip(played, shown, strict=True) if image is not None]
            title = f"{AWKWARD} {k}"
            visits.append(Visit(title, sessions, stage.compared_with, {"rule": "<kept>"}, {}, tuple(pictures)))
        yield Simulation(tuple(visits), LINK, "gsvis simulate <x> & y", "0", {"a<b": "<c>"}, {"watching": 1.0})


@pytest.fixture(scope="module")
def written(simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """The document and the folder of a report, in which another one was."""
    folder = tmp_path_factory.mktemp("session")
    (folder / "shown_9_500_0.png").write_bytes(b"of an earlier report")
    return write_session_report(folder, simulation), folder


def test_the_folder_is_complete(written: tuple[dict[str, Any], Path]) -> None:
    document, folder = written
    pictures = {f"shown_{v}_1000_{k}" for v in (0, 1) for k in (0, 1, 3)}  # of the whole file there is none
    assert {path.stem for path in folder.glob("*.png")} == PLOTS | pictures
    for path in folder.glob("*.png"):
        Image.open(path).verify()
    assert document == json.loads((folder / "report.json").read_text())


def test_the_document_says_what_was_measured(simulation: Simulation) -> None:
    document = session_document(simulation)
    json.dumps(document, allow_nan=False)
    assert document["format"] == "gsvis-simulation"
    assert document["link"]["mean_mbit_per_s"] == pytest.approx((0.4 + 3 * 0.2) / 4)
    assert [len(visit["systems"]) for visit in document["visits"]] == [3, 3]
    ours, whole, _ = document["visits"][0]["systems"]
    assert whole["figures"]["seconds_to_first_image"] is None
    assert whole["figures"]["psnr"] == 0.0
    assert ours["figures"]["score"] == simulation.visits[0].sessions[0].qoe.score
    assert ours["about"]["policy"] == "utility"


def test_the_page_stands_alone(written: tuple[dict[str, Any], Path]) -> None:
    html = (written[1] / "report.html").read_text(encoding="utf-8")
    outline = Outline(html)
    assert outline.open == []
    assert all(link.startswith("data:image/png;base64,") for link in outline.links)
    assert all(outline.alternatives)
    assert not {"script", "link"} & set(outline.tags)
    assert outline.tags.count("img") == len(PLOTS) + 6
    text = " ".join(" ".join(outline.words).split())
    for label in (f"{AWKWARD} 0", "<a link> & more", "whole file", "never", "0 dB", "gsvis simulate <x> & y", "<kept>"):
        assert label in text
    assert "$" not in text.replace("$title", "")


@pytest.mark.parametrize(
    ("against", "said"),
    [
        (("", ""), "compared with the scene from which the package was made."),
        (("the world itself", "the world itself"), "compared with the world itself, which hides"),
        (("the package itself", ""), "compared with the scene, or with the package itself where the title says so"),
    ],
    ids=str,
)
def test_the_page_says_what_clients_are_compared_with(
    simulation: Simulation, against: tuple[str, str], said: str
) -> None:
    visits = tuple(replace(visit, against=each) for visit, each in zip(simulation.visits, against, strict=True))
    html = _lead(session_document(replace(simulation, visits=visits)))
    assert said in "".join(Outline(html).words)


def test_the_page_warns_of_walks_and_judges_outside_of_cells(simulation: Simulation) -> None:
    one, other = simulation.visits
    judged = {"judged": {"line": "x", "judge_eyes_in_cells": 0.4, "warning": "Warning: eyes see <little>\x1b[2J."}}
    visits = (
        replace(one, path={"in_cells": 0.995}, scene=judged_in(judged)),
        replace(
            other, path={"in_cells": 0.25}, scene=judged_in({"judged": {"warning": 3, "judge_eyes_in_cells": "a"}})
        ),
    )
    document = session_document(replace(simulation, visits=visits))
    first, second = content_remarks(document)
    assert first == rf"{one.title} was prepared with a warning. Warning: eyes see <little>\x1b[2J."
    assert second.startswith(f"Warning: only 25% of the path lies in cells of {other.title}")
    assert [describe_eyes(visit) for visit in document["visits"]] == [
        f"100% of the path lies in cells of {one.title}, and 40% of the eyes that judged it.",
        f"25% of the path lies in cells of {other.title}.",
    ]
    assert judged_in({}) == judged_in({"judged": []}) == {}


def test_the_same_sessions_give_the_same_files(
    simulation: Simulation, written: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    write_session_report(tmp_path, simulation)
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in written[1].iterdir()}
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (written[1] / path.name).read_bytes()


def test_a_simulation_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one visit"):
        write_session_report(tmp_path, Simulation((), LINK, "", ""))


def test_pictures_are_those_of_the_moment(simulation: Simulation) -> None:
    for visit in simulation.visits:
        by_name = {name: image for _, name, image in visit.pictures}
        assert by_name[""].shape == (36, 48, 3)
        assert not np.array_equal(by_name["gsvis"], by_name[""])
