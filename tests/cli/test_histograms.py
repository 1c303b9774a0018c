"""Histograms as text: lines of at most 80 columns, in ASCII where the terminal has no blocks; in JSON as numbers."""

from __future__ import annotations

import io
import json
import sys

import pytest

from gsvis.cli import main
from gsvis.cli.histograms import TITLES, band_lines, can_draw_blocks, histogram_lines
from gsvis.scene.histograms import Band, Histogram

Capture = pytest.CaptureFixture[str]
FOUND = Histogram([-1.0, 0.0, 1.0, 5.0], [0, 30, 9970], 1, 99_999_999, 0.5)


@pytest.mark.parametrize("blocks", [True, False])
@pytest.mark.parametrize("width", [79, 40])
def test_lines_fit_and_the_longest_bar_is_the_fullest_bin(blocks: bool, width: int) -> None:
    lines = list(histogram_lines("log10_scale", FOUND, width=width, blocks=blocks))
    assert len(lines) == 1 + 5
    assert max(map(len, lines)) <= width
    assert all(line.isascii() for line in lines) is not blocks
    mark = "█" if blocks else "#"
    assert [line.count(mark) for line in lines[1:]] == [0, 0, 0, 0, width - 31]
    assert [line.split()[-1] for line in lines[1:]] == ["<0.1%", "0", "<0.1%", "<0.1%", "100.0%"]
    assert ("▏" if blocks else ".") in lines[1]  # one of a hundred million is seen
    assert lines[5].split()[:2] == ["above", "1e+05"]


def test_labels_are_values_and_not_their_logarithms() -> None:
    lines = list(histogram_lines("log10_distance", Histogram([-0.5, 0.0, 2.5, 3.0], [1, 2, 1], 0, 0, 2.0)))
    assert lines[0] == " distance from the median center, scene units; median 100"
    assert [line.split()[:3] for line in lines[1:]] == [["0.32", "to", "1"], ["1", "to", "316"], ["316", "to", "1,000"]]
    assert next(iter(histogram_lines("opacity", Histogram([0.0, 1.0], [0], 0, 0, None)))) == " opacity"
    assert len(list(histogram_lines("log10_scale", Histogram([300.0, 400.0], [0], 0, 0, 390.0)))) == 2


def test_bands_are_drawn_by_their_color() -> None:
    lines = list(band_lines([Band(0, 1.0, 0.9, 0.4), Band(1, 0.1, 0.1, 0.1), Band(2, 0.0, 0.0, 0.0)], blocks=False))
    assert [line.count("#") for line in lines] == [0, 48, 12, 0]
    assert [line.split()[-1] for line in lines[1:]] == ["0.400", "0.100", "0.000"]


@pytest.mark.parametrize(
    ("encoding", "can"), [("utf-8", True), ("ascii", False), ("cp1252", False), ("latin-1", False)]
)
def test_blocks_are_drawn_where_the_encoding_has_them(
    encoding: str, can: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding=encoding))
    assert can_draw_blocks() is can


def test_inspect_draws_them_when_asked_alone(capsys: Capture) -> None:
    assert main(["inspect", "builtin:wall_with_hole"]) == 0
    plain = capsys.readouterr().out
    assert main(["inspect", "builtin:wall_with_hole", "--histograms"]) == 0
    text = capsys.readouterr().out
    for title in (*TITLES.values(), "color in each SH band"):
        assert f" {title}" in text
        assert f" {title};" not in plain
    assert max(map(len, text.splitlines())) <= 80
    assert text.splitlines()[: plain.count("\n") - 3] == plain.splitlines()[: plain.count("\n") - 3]


def test_json_has_edges_and_counts(capsys: Capture) -> None:
    assert main(["inspect", "builtin:wall_with_hole", "--histograms", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert list(document["histograms"]) == list(TITLES)
    for each in document["histograms"].values():
        assert len(each["edges"]) == len(each["counts"]) + 1
        assert sum(each["counts"]) + each["below"] + each["above"] == document["count"]
    assert [band["band"] for band in document["sh_bands"]] == list(range(document["sh_degree"] + 1))
    assert main(["inspect", "builtin:wall_with_hole", "--json"]) == 0
    assert "histograms" not in json.loads(capsys.readouterr().out)
