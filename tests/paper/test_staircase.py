from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
from base64 import b64decode
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from paper.staircase import PERSON_RULE, draw_ladder, load_staircase_result, write_staircase_page
from PIL import Image

from gsvis.color.epsilon import EpsilonCalibration, MetricObserver, Staircase, StaircaseRule, calibrate_epsilon
from gsvis.errors import FormatError

AWKWARD = "<b>\"nika\" & 'co'</b> $title</script>"
RULE = StaircaseRule(0.1, math.log(2.0), (), 1, 4, 60, 0.0125, 0.2)


def pictures(rule: StaircaseRule = RULE, views: int = 2) -> tuple[NDArray[Any], NDArray[Any]]:
    """Noise, and noise with more noise, as large as epsilon."""
    rng = np.random.default_rng(0)
    reference = rng.uniform(0.2, 0.8, (views, 12, 16, 3))
    error = rng.uniform(-1.0, 1.0, (views, 1, 12, 16, 3)) * rule.rungs[None, :, None, None, None]
    return reference, reference[:, None] + error


class Outline(HTMLParser):
    """Collects ids, links and the contents of scripts."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.scripts: dict[str, str] = {}
        self.words: list[str] = []
        self.script: str | None = None
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = {name: str(value) for name, value in attrs}
        self.ids += [named["id"]] if "id" in named else []
        self.links += [named[name] for name in ("src", "href", "srcset") if name in named]
        if tag == "script":
            self.script = named.get("id", "code")
            self.scripts[self.script] = ""

    def handle_endtag(self, tag: str) -> None:
        self.script = None if tag == "script" else self.script

    def handle_data(self, data: str) -> None:
        if self.script:
            self.scripts[self.script] += data
        else:
            self.words.append(data)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "new" / "staircase.html"
    size = write_staircase_page(path, *pictures(), RULE, title=AWKWARD, about={"scene_file": "<x>", "seed": 3})
    assert size == path.stat().st_size
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    return path


@pytest.fixture(scope="module")
def outline(page: Path) -> Outline:
    return Outline(page.read_text(encoding="utf-8"))


def test_the_page_needs_nothing_else(page: Path, outline: Outline) -> None:
    html = page.read_text(encoding="utf-8")
    assert outline.links == []
    assert "default-src 'none'" in html
    code = outline.scripts["code"]
    assert not re.search(r"https?:|fetch\(|XMLHttpRequest|import\b|\$\{?title", code)
    assert list(outline.scripts) == ["data", "code"]
    assert AWKWARD in "".join(outline.words)


def test_everything_that_the_script_asks_for_is_there(outline: Outline) -> None:
    assert len(set(outline.ids)) == len(outline.ids)
    asked = set(re.findall(r'byId\("([^"]+)"\)', outline.scripts["code"]))
    assert asked <= set(outline.ids)
    assert {f"image-{name}" for name in ("reference", "A", "B")} | {"choose-A", "choose-B"} <= set(outline.ids)


def test_the_pictures_come_back_without_loss_and_equal_ones_are_stored_once(outline: Outline, tmp_path: Path) -> None:
    data = json.loads(outline.scripts["data"])
    reference, approximations = pictures()

    def levels(index: int) -> NDArray[np.uint8]:
        return np.asarray(Image.open(BytesIO(b64decode(data["pictures"][index]))).convert("RGB"))

    for view in range(2):
        assert np.array_equal(levels(data["reference"][view]), np.rint(reference[view] * 255))
        for rung in range(len(RULE.rungs)):
            wanted = np.rint(np.clip(approximations[view, rung], 0, 1) * 255)
            assert np.array_equal(levels(data["approximations"][view][rung]), wanted)
    write_staircase_page(tmp_path / "a.html", reference, reference[:, None].repeat(len(RULE.rungs), 1), RULE, title="a")
    same = json.loads(Outline((tmp_path / "a.html").read_text(encoding="utf-8")).scripts["data"])
    assert len(same["pictures"]) == 2
    assert same["approximations"] == [[index] * len(RULE.rungs) for index in same["reference"]]


def test_the_page_states_how_far_to_sit(outline: Outline) -> None:
    text = " ".join("".join(outline.words).split())
    degrees = 16 / 67.0
    assert f"{0.5 / math.tan(math.radians(0.5 * degrees)):.2g} picture widths" in text
    assert "67 pixels then fill one degree" in text


def test_the_same_input_gives_the_same_bytes(page: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.html"
    write_staircase_page(again, *pictures(), RULE, title=AWKWARD, about={"scene_file": "<x>", "seed": 3})
    assert again.read_bytes() == page.read_bytes()


def test_a_page_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    path.write_text("old", encoding="utf-8")

    def stop(stage: str, done: int, total: int) -> None:
        if done == total:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_staircase_page(path, *pictures(), RULE, title="a", progress=stop)
    assert path.read_text(encoding="utf-8") == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]


def test_pictures_that_do_not_fit_the_rule_are_refused(tmp_path: Path) -> None:
    reference, approximations = pictures()
    for wrong, message in (
        ((reference, approximations[:, 1:]), r"approximations: expected shape \(2, 5, 12, 16, 3\), got \(2, 4"),
        ((reference[:1], approximations), r"approximations: expected shape \(1, 5"),
        ((reference[:0], approximations[:0]), "reference: expected at least one view"),
        ((reference[0], approximations), r"reference: expected shape \(V, H, W, 3\)"),
        ((reference * np.nan, approximations), "reference: expected finite values"),
        ((reference.astype(np.uint8), approximations), "reference: expected floats, got bytes"),
    ):
        with pytest.raises(ValueError, match=message):
            write_staircase_page(tmp_path / "x.html", *wrong, RULE, title="a")
    with pytest.raises(ValueError, match="pixels_per_degree: expected a value in"):
        write_staircase_page(tmp_path / "x.html", reference, approximations, RULE, title="a", pixels_per_degree=0.0)


def test_the_rule_for_people_asks_for_few_trials() -> None:
    assert len(PERSON_RULE.rungs) == 19
    assert PERSON_RULE.rungs[PERSON_RULE.above] == 0.1
    ratios = PERSON_RULE.rungs[:-1] / PERSON_RULE.rungs[1:]
    assert np.allclose(ratios, 10.0 ** (1 / 8))
    errors, trials = [], []
    for seed in range(100):
        observer = MetricObserver(lambda epsilon: epsilon, 0.02, slope=0.3, guess=0.5, rng=seed)
        found = calibrate_epsilon(observer, PERSON_RULE)
        errors.append(math.log(found.epsilon / 0.02))
        trials.append(len(found.epsilons))
    assert abs(np.mean(errors)) < 0.1
    assert np.std(errors) < 0.3
    assert 45 < np.mean(trials) < 55


@pytest.mark.skipif(shutil.which("node") is None, reason="node runs the page's script; it is not installed")
def test_the_page_walks_as_the_library_does(outline: Outline, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    data = json.loads(outline.scripts["data"])
    rules = [data["rule"]]
    person = pictures(PERSON_RULE, 1)
    write_staircase_page(tmp_path / "p.html", *person, title="a")
    rules.append(json.loads(Outline((tmp_path / "p.html").read_text(encoding="utf-8")).scripts["data"])["rule"])
    shares = (0.0, 0.3, 0.5, 0.75, 0.75, 0.9, 1.0)
    answers = [(rng.random(120) < share).tolist() for share in shares for _ in range(4)]
    (tmp_path / "staircase.js").write_text(outline.scripts["code"], encoding="utf-8")
    (tmp_path / "cases.json").write_text(json.dumps([rules, answers]), encoding="utf-8")
    code = """
        const { Staircase } = require("./staircase.js");
        const [rules, answers] = require("./cases.json");
        const walk = (rule, given) => {
          const staircase = new Staircase(rule);
          for (const answer of given) if (!staircase.finished) staircase.answer(answer);
          return { ...staircase.result(), finished: staircase.finished, reversals: staircase.reversals };
        };
        console.log(JSON.stringify(rules.map((rule) => answers.map((given) => walk(rule, given)))));
    """
    run = subprocess.run(["node", "-e", code], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=300)
    for rule, walks in zip((RULE, PERSON_RULE), json.loads(run.stdout), strict=True):
        reasons = set()
        for given, walked in zip(answers, walks, strict=True):
            staircase = Staircase(rule)
            for answer in given:
                if not staircase.finished:
                    staircase.answer(answer)
            found = staircase.result()
            assert walked["finished"] == staircase.finished
            assert walked["trials"] == found.as_dict()["trials"]
            assert walked["reversals"] == found.reversals.tolist()
            assert walked["converged"] == found.converged
            assert walked["epsilon"] == pytest.approx(found.epsilon, rel=1e-12)
            error = math.nan if walked["standard_error"] is None else walked["standard_error"]
            assert error == pytest.approx(found.standard_error, rel=1e-9, nan_ok=True)
            reasons.add(walked["reason"])
        assert reasons >= ({"stuck", "at a bound"} if rule is RULE else {"converged", "stuck"})


def saved(tmp_path: Path, **changes: Any) -> tuple[Path, EpsilonCalibration]:
    observer = MetricObserver(lambda epsilon: epsilon, 0.02, slope=0.3, guess=0.5, rng=1)
    found = calibrate_epsilon(observer, PERSON_RULE)
    path = tmp_path / "epsilon.json"
    path.write_text(json.dumps({**found.as_dict(), **changes}), encoding="utf-8")
    return path, found


def test_a_saved_result_comes_back(tmp_path: Path) -> None:
    path, found = saved(tmp_path)
    assert load_staircase_result(path).as_dict() == found.as_dict()
    path, found = saved(tmp_path, reason="whatever the page wrote", converged=False)
    assert load_staircase_result(path).converged == found.converged


@pytest.mark.parametrize(
    ("changes", "where"),
    [
        ({"format": "other"}, "format"),
        ({"version": 2}, "version"),
        ({"rule": {}}, "rule"),
        ({"rule": None}, "rule"),
        ({"rule": {**PERSON_RULE.as_dict(), "start": "0.1"}}, "trials"),
        ({"rule": {**PERSON_RULE.as_dict(), "coarse": 3}}, "trials"),
        ({"rule": {**PERSON_RULE.as_dict(), "down_step": 0.2}}, "trials"),
        ({"provenance": 3}, "provenance"),
        ({"trials": []}, "trials"),
        ({"trials": [[0.1]]}, "trials"),
        ({"trials": [[True, True]]}, "trials"),
        ({"trials": [[0.1, 1]]}, "trials"),
        ({"trials": [[0.2, True]]}, "trials"),
        ({"epsilon": 0.5}, "epsilon"),
        ({"epsilon": None}, "epsilon"),
        ({"epsilon": 10**400}, "epsilon"),
        ({"trials": [[10**400, True]]}, "trials"),
        ({"rule": {**PERSON_RULE.as_dict(), "start": 10**400}}, "trials"),
    ],
)
def test_results_that_are_none_are_refused(tmp_path: Path, changes: dict[str, Any], where: str) -> None:
    path, _ = saved(tmp_path, **changes)
    with pytest.raises(FormatError) as caught:
        load_staircase_result(path)
    assert caught.value.where == where
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("text", [b"", b"[1]", b"{", b"\xff", b'{"a": NaN}', b"[" * 100000])
def test_files_that_are_no_json_object_are_refused(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "epsilon.json"
    path.write_bytes(text)
    with pytest.raises(FormatError, match=r"expected (JSON|a JSON object), got"):
        load_staircase_result(path)
    with pytest.raises(FileNotFoundError):
        load_staircase_result(tmp_path / "none.json")


def test_a_ladder_is_the_images_of_its_rungs() -> None:
    class Flat:
        def images(self, epsilon: float) -> NDArray[np.float32]:
            return np.full((2, 3, 4, 3), epsilon, np.float32)

    calls: list[tuple[str, int, int]] = []
    ladder = draw_ladder(Flat(), [0.5, 0.25], progress=lambda *step: calls.append(step))  # type: ignore[arg-type]
    assert ladder.shape == (2, 2, 3, 4, 3)
    assert np.array_equal(ladder[:, 1], Flat().images(0.25))
    assert calls == [("rungs", 0, 2), ("rungs", 1, 2), ("rungs", 2, 2)]
