"""A package as the paper makes it: every piece of the paper is called, and the package says so."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.color.fit import FitConfig
from gsvis.package import Package
from gsvis.package.active_terms import ActiveTerms
from gsvis.prepare import estimate_preparation
from gsvis.prepare.colors import ColorConfig
from gsvis.pvs.config import PvsConfig
from gsvis.scene.procedural import OccluderScene, two_rooms
from gsvis.train.levels import LevelsConfig
from tests.prepare.test_prepare import CONFIG, FEW, prepare, small

PAPER = replace(
    CONFIG,
    levels=LevelsConfig(iterations=2, importance="gradient", merged=0.0, preview=0.0),
    sets=PvsConfig(size=16, rays=0),
    colors=ColorConfig(FitConfig("hsl", max_terms=2, refine=False), FEW, 0, "faces"),
    epsilon=None,
    cell_terms="stored",
)


@pytest.fixture(scope="module")
def rooms() -> OccluderScene:
    return small(two_rooms(1000, sh_degree=1))


def count_calls(monkeypatch: pytest.MonkeyPatch, *places: str) -> Counter[str]:
    """Count how often functions are called, each by its module and name."""
    counts = Counter[str]()

    def counting(place: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*words: Any, **named: Any) -> Any:
            counts[place] += 1
            return function(*words, **named)

        return call

    for place in places:
        module, _, name = place.rpartition(".")
        found = getattr(__import__(module, fromlist=[name]), name)
        monkeypatch.setattr(place, counting(place, found))
    return counts


def test_every_piece_of_the_paper_is_called_and_none_of_ours(
    rooms: OccluderScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = (
        "gsvis.color._pursuit.orthogonal_matching_pursuit",
        "gsvis.train.levels.rank_by_error",
        "gsvis.prepare.stage_records.calibrate_by_flip",
        "gsvis.prepare.stage_records.list_package_terms",
        "gsvis.hpr.hybrid",
    )
    ours = ("gsvis.train.levels.choose_subsets", "gsvis.prepare.importance.direction_weights")
    counts = count_calls(monkeypatch, *theirs, *ours)
    monkeypatch.setattr("gsvis.prepare.stage_records.OBSERVED", FEW)
    dry = estimate_preparation(rooms.gaussians, tmp_path / "p.gsvis", rooms.navigable, PAPER)
    assert "epsilon" in [stage.name for stage in dry.stages]
    counts.clear()
    found = prepare(rooms, tmp_path / "p.gsvis", PAPER)
    assert {place: counts[place] > 0 for place in (*theirs, *ours)} == dict.fromkeys(theirs, True) | dict.fromkeys(
        ours, False
    )
    names = [stage.name for stage in found.stages]
    assert names == ["levels", "sets", "colors", "epsilon", "cost", "fidelity", "terms", "package"]
    assert found.certificates is not None
    assert not found.certificates.known.any()
    with Package.open(tmp_path / "p.gsvis") as package:
        assert package.verify().strays == 0
        assert package.manifest.grids.variant == "hsl"
        assert package.manifest.sizes()["active_terms"] > 0
        assert isinstance(package.active_terms, ActiveTerms)
        about = package.manifest.info.provenance
        assert package.epsilon == package.active_terms.epsilon == about["staircase"]["epsilon"]
        assert about["staircase"]["provenance"]["observer"] == "flip"
        assert about["config"]["levels"]["importance"] == "gradient"
    again = prepare(rooms, tmp_path / "p.gsvis", PAPER)
    assert all(stage.reused for stage in again.stages)
    dry = estimate_preparation(rooms.gaussians, tmp_path / "p.gsvis", rooms.navigable, PAPER)
    assert {stage.state for stage in dry.stages if stage.name in ("epsilon", "fidelity")} == {"done"}


def test_a_list_of_terms_is_what_the_package_computes_without_it(rooms: OccluderScene, tmp_path: Path) -> None:
    config = replace(CONFIG, levels=None, epsilon=0.05)
    prepare(rooms, tmp_path / "a.gsvis", config)
    prepare(rooms, tmp_path / "b.gsvis", replace(config, cell_terms="stored"))
    with Package.open(tmp_path / "a.gsvis") as computed, Package.open(tmp_path / "b.gsvis") as stored:
        for cell in range(len(computed.visibility)):
            listed = stored.active_terms.active_ids(cell)
            assert np.array_equal(listed, computed.active_terms.active_ids(cell))


def test_what_is_wrong_is_refused() -> None:
    with pytest.raises(ValueError, match="cell_terms: expected one of"):
        replace(CONFIG, cell_terms="listed")
