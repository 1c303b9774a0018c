"""The commands and programs of the tutorials, how-to pages and notebooks run as they stand, on a small scene."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gsvis.cli import main, parse
from gsvis.io.spz import save_spz
from gsvis.raycast import TAU, EllipsoidProxies, Tracer, visible_from
from gsvis.scene.procedural import BUILTIN_SCENES, furnished_flat, two_rooms
from gsvis.simulate import morton_order
from tests.few_views import take_few_views
from tests.known_parsers import remember_parsers
from tests.known_spaces import coarse_spaces, remember_spaces
from tests.quick_reports import draw_no_places, take_few_judges

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [DOCS / "index.md", *sorted((DOCS / "tutorials").glob("*.md")), *sorted((DOCS / "how-to").glob("*.md"))]
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
BLOCK = re.compile(r"^```(sh|python)\n(.*?)^```", flags=re.DOTALL | re.MULTILINE)

# What makes a command quick and changes nothing that a page says. An option of the page itself wins.
SETS = {"--cells": "2", "--limit": "0.05", "--max-inner": "1", "--workers": "1"}
QUICK = {
    "analyze": {"--views": "2", "--width": "128", "--height": "96", "--traced-sample": "10", "--rays-per-face": "1"},
    "clean": {"--eyes": "2", "--held-out": "2"},
    "color": {"--views": "2"},
    "cut": {"--face-size": "16", "--held-out": "1"},
    "levels": {"--steps": "2", "--views": "2", "--held-out": "1", "--width": "24", "--height": "20"},
    "prepare": {
        **SETS,
        "--face-size": "16",
        "--max-terms": "0",
        "--steps": "2",
        "--views": "2",
        "--width": "24",
        "--height": "20",
    },
    "paint": {"--face-size": "16", "--eyes": "2"},
    "pvs": {**SETS, "--face-size": "16", "--certify": "256"},
    "render": {},
    "simulate": {"--seconds": "1", "--every": "0.5", "--width": "32", "--height": "24"},
}
SHORTENED = {"--eyes", "--seconds", "--views"}  # given by a page, shortened here
PARSED = {"serve", "color"}  # `serve` never ends; tests/serve and tests/cli run both


def blocks(page: Path) -> list[tuple[str, str]]:
    return [(found[1], found[2]) for found in BLOCK.finditer(page.read_text(encoding="utf-8"))]


def words_of(line: str) -> list[str]:
    return shlex.split(line, comments=True)


def quicker(words: list[str]) -> list[str]:
    """Return a command with the options of QUICK in place of, or beside, its own."""
    words = list(words)
    if "--apply" in words:  # `clean` then looks for nothing
        return words
    for option, value in QUICK.get(words[0], {}).items():
        if option not in words:
            words += [option, value]
        elif option in SHORTENED:
            words[words.index(option) + 1] = value
    return words


@pytest.fixture(autouse=True)
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blank_plots: None) -> Iterator[None]:
    """A small scene under the name that the pages use, no kernels in advance, few views, coarse grids, blank plots."""
    draw_no_places(monkeypatch)
    take_few_judges(monkeypatch)
    made = two_rooms(1000, sh_degree=1)
    for name in ("two_rooms", "flat"):
        monkeypatch.setitem(BUILTIN_SCENES, name, lambda: made)
    for name in ("warm_sets", "warm_levels", "warm_colors"):
        monkeypatch.setattr(f"gsvis.cli.prepare.{name}", lambda config, status: None, raising=False)
    monkeypatch.setattr("gsvis.edit.shape._VOXELS", 1 << 18)
    monkeypatch.chdir(tmp_path)
    with take_few_views():
        yield


@pytest.fixture(scope="module", autouse=True)
def known_spaces(shared_folder: Path) -> Iterator[None]:
    """Find the space of the small scene once, among few voxels: most pages ask for it."""
    with remember_spaces(shared_folder), coarse_spaces():
        yield


@pytest.fixture(scope="module", autouse=True)
def known_parsers() -> Iterator[None]:
    """Build the parser of each command once."""
    with remember_parsers():
        yield


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_the_page_runs_from_top_to_bottom(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {"__name__": "__main__"}
    for kind, text in blocks(page):
        if kind == "python":
            exec(compile(text, str(page), "exec"), names)
            continue
        for line in filter(None, map(words_of, text.splitlines())):
            if line[0] == "gsvis" and line[1] in PARSED:
                parse(line[1:])
            elif line[0] == "gsvis":
                code = main(quicker(line[1:]))
                assert code == 0, f"{page.name}: {shlex.join(line)}\n{capsys.readouterr().err}"
            else:
                assert line[0] in {"make", "pip"}, f"{page.name}: {shlex.join(line)} is not tested"


def printed(page: Path, pattern: str) -> list[float]:
    found = re.search(pattern, page.read_text(encoding="utf-8"))
    assert found is not None, f"{page.name}: {pattern}"
    return [float(each.replace(",", "")) for each in found.groups()]


def test_numbers_that_pages_print_of_the_flat_are_those_of_the_flat() -> None:
    """The full flat, once. Within 2% of counts and bytes, within 3 points of a share: tracers differ a little."""
    flat = furnished_flat()
    count = len(flat.gaussians)
    share, stated = printed(DOCS.parent / "README.md", r"This eye needs (\d+)% of ([\d,]+) Gaussians, in all")
    assert count == pytest.approx(stated, rel=0.02)
    gaussians, megabytes = printed(
        DOCS / "tutorials/view-needs.md", r"has ([\d,]+) Gaussians of SH degree 3 and ([\d.]+) MB"
    )
    assert count == pytest.approx(gaussians, rel=0.02)
    assert count * 62 * 4 / 1e6 == pytest.approx(megabytes, rel=0.02)  # 62 floats a row of the PLY
    whole_file, seconds = printed(
        DOCS / "tutorials/serve.md",
        r"is a compact SPZ of ([\d.]+) MB. At 5 Mbit/s nothing of it is seen for ([\d.]+) s",
    )
    save_spz(flat.gaussians[morton_order(flat.gaussians.means)], "compact.spz", compact=True)
    assert Path("compact.spz").stat().st_size / 1e6 == pytest.approx(whole_file, rel=0.02)
    assert whole_file * 8 / 5 == pytest.approx(seconds, abs=0.15)
    (small,) = printed(DOCS / "tutorials/lighter.md", r"`.spz --compact` \| ([\d.]+) MB")
    assert small == pytest.approx(whole_file, rel=0.05)  # there in the order of the file
    kept, total, part, size = printed(
        DOCS / "how-to/cut.md", r"corner.ply: ([\d,]+) of ([\d,]+) Gaussians \(([\d.]+)%\), ([\d.]+) MB"
    )
    assert (total, kept * 62 * 4 / 1e6) == pytest.approx((count, size), rel=0.02)
    assert 100.0 * kept / total == pytest.approx(part, abs=0.1)
    tracer = Tracer(EllipsoidProxies.from_scene(flat.gaussians))
    weights = visible_from(tracer, flat.viewpoints[:1], sampling="gaussians")
    assert 100.0 * (weights >= TAU).mean() == pytest.approx(share, abs=3.0)


def test_every_page_of_the_tutorials_has_commands() -> None:
    assert sum(len(blocks(page)) for page in PAGES) > 30


FENCED = re.compile(r"^```(\w*)\n(.*?)^```", flags=re.DOTALL | re.MULTILINE)
COMMANDS = [
    (page.name, line)
    for page in [DOCS.parent / "README.md", *sorted(DOCS.glob("*.md"))]
    for language, block in FENCED.findall(page.read_text(encoding="utf-8"))
    if language in {"", "sh"}
    for line in re.findall(r"^(?:[A-Z_]+=\S+ )?gsvis (.*?)(?: \| .*)?$", block, flags=re.MULTILINE)
]


def test_commands_that_pages_only_show_are_commands() -> None:
    wrong = []
    for page, line in COMMANDS:
        try:
            parse(words_of(line))
        except SystemExit as error:
            wrong.append((page, line, error))
    assert wrong == []


def test_the_pages_show_commands() -> None:
    assert {"README.md", "cli.md"} <= {page for page, _ in COMMANDS}
    assert len(COMMANDS) > 30


def cells_of(notebook: Path) -> list[dict[str, Any]]:
    found = json.loads(notebook.read_text(encoding="utf-8"))
    assert (found["nbformat"], found["nbformat_minor"]) == (4, 5)
    return list(found["cells"])


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.name)
def test_the_notebook_runs_from_top_to_bottom(notebook: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    drawn: list[int] = []
    monkeypatch.setattr(plt, "show", lambda: (drawn.append(1), plt.close("all")))
    plt.switch_backend("agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    for cell in cells_of(notebook):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{notebook.name}, {cell['id']}", "exec"), names)
    assert len(drawn) >= 3
    assert not plt.get_fignums()


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_hold_what_a_person_wrote_and_no_outputs(notebook: Path) -> None:
    cells = cells_of(notebook)
    assert len({cell["id"] for cell in cells}) == len(cells)
    for cell in cells:
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None), cell["id"]


def test_the_page_of_notebooks_lists_each() -> None:
    page = (DOCS / "notebooks" / "index.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) == 2
    assert all(f"]({notebook.name})" in page for notebook in NOTEBOOKS)
