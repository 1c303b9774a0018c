"""What a walk needs of the colors: by cameras and by cells, against the activation itself."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paper.walk import WalkConfig, measure_walk
from paper.walk_terms import PAPER_TERMS, WalkTerms, terms_over_walk

from gsvis.color.activation import Activation
from gsvis.color.records import bytes_per_term
from gsvis.color.srbf import SrbfColors
from gsvis.errors import FormatError
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.render.weights import view_weights
from gsvis.scene.paths import HeadPath
from gsvis.scene.procedural import OccluderScene, two_rooms
from tests.color.samples import random_colors
from tests.prepare.test_active_terms import EPSILON, World, world

SMALL = WalkConfig(seconds=4.0, rate=2.0, width=32, height=24)


@cache
def rooms() -> tuple[OccluderScene, SrbfColors]:
    scene = two_rooms(1500, sh_degree=0)
    return scene, random_colors(np.random.default_rng(2), len(scene.gaussians))


def through(*points: Any) -> HeadPath:
    """From point to point, 2 s each, without a turn of the head."""
    times = 2.0 * np.arange(len(points))
    return HeadPath(times, np.array(points, float), np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)))


def in_rooms() -> HeadPath:
    eye = rooms()[0].viewpoints[0]
    return through(eye, eye + 0.2, eye - 0.2)


def lawful(found: WalkTerms) -> WalkTerms:
    """What holds for every walk."""
    for curve in (found.gaussians, found.terms, found.unpruned):
        assert np.all(np.diff(curve) >= 0)
        assert curve.min() >= 0.0
        assert curve.max() <= 1.0
    assert np.all(found.terms <= found.unpruned + 1e-12)
    assert np.all(found.active <= found.terms + 1e-12)
    assert np.all(found.terms <= np.cumsum(found.active) + 1e-12)
    assert np.all((found.of_visible >= 0.0) & (found.of_visible <= 1.0))
    counted = [np.count_nonzero(found.first_active <= np.float32(time)) for time in found.times]
    assert np.allclose(counted, found.terms * len(found.first_active))
    assert np.allclose(found.bytes, found.term_bytes * len(found.first_active) * found.terms)
    record = json.loads(json.dumps(found.as_dict()))
    assert record["terms_at_end"] == pytest.approx(found.terms[-1])
    assert record["paper"]["end"] == PAPER_TERMS["end"]
    return found


@pytest.mark.parametrize("by", ["raster", "raycast"])
def test_by_cameras_terms_are_active_at_the_eye(by: str) -> None:
    scene, colors = rooms()
    g, path = scene.gaussians, in_rooms()
    tracer = Tracer(EllipsoidProxies.from_scene(g)) if by == "raycast" else None
    found = lawful(terms_over_walk(colors, g, path, EPSILON, sets=tracer, config=SMALL))
    assert found.by == f"{by}, active at the eye"
    assert found.term_bytes == bytes_per_term("rgb")
    seen = measure_walk(tracer or g, path, SMALL)
    assert np.allclose(found.gaussians, seen.seen)
    if by == "raster":
        walk, activation = path.cut(0.0, 4.0).resample(2.0), Activation(colors, g.means, EPSILON)
        visible = view_weights(g, walk.cameras(32, 24, 90.0)).largest >= 1 / 255
        active = [activation.active(walk.positions[i], np.flatnonzero(visible[i])) for i in range(len(walk))]
        assert np.allclose(found.terms, [np.any(active[: i + 1], axis=0).mean() for i in range(len(walk))])
        assert np.allclose(found.active, [mask.mean() for mask in active])


def test_weights_send_less() -> None:
    scene, colors = rooms()
    plain, weighted = (
        terms_over_walk(colors, scene.gaussians, in_rooms(), EPSILON, weighted=w, config=SMALL) for w in (False, True)
    )
    lawful(weighted)
    assert np.all(weighted.first_active >= plain.first_active)
    assert weighted.terms[-1] < plain.terms[-1]
    assert np.array_equal(weighted.gaussians, plain.gaussians)


def test_larger_epsilons_send_less() -> None:
    scene, colors = rooms()
    ends = [terms_over_walk(colors, scene.gaussians, in_rooms(), e, config=SMALL).terms[-1] for e in (0.0, 0.05, 5.0)]
    assert ends == sorted(ends, reverse=True)
    assert ends[-1] == 0.0


def inside(w: World) -> HeadPath:
    """Through the middles of three cells."""
    return through(*w.store.grid.centers[[2, 5, 9]])


def test_by_cells_terms_are_active_anywhere_in_the_cell(tmp_path: Path) -> None:
    w = world(tmp_path)
    path, config = inside(w), WalkConfig(rate=1.5)
    found = lawful(terms_over_walk(w.colors, w.g, path, EPSILON, sets=w.store, config=config))
    assert found.by == "cells, active in the cell"
    with w.build(weighted=True) as terms:
        for epsilon in (terms, EPSILON):
            weighted = terms_over_walk(w.colors, w.g, path, epsilon, sets=w.store, weighted=True, config=config)
            assert np.all(lawful(weighted).first_active >= found.first_active)
            assert weighted.terms[-1] < found.terms[-1]
    with w.build() as terms:
        stored = lawful(terms_over_walk(w.colors, w.g, path, terms, sets=w.store, config=config))
        cells = [w.store.cell_at(point) for point in path.resample(1.5).positions]
        union = set().union(*(terms.active(cell) for cell in cells if cell >= 0))
    assert stored.epsilon == EPSILON
    assert np.array_equal(stored.first_active, found.first_active)
    assert set(np.flatnonzero(np.isfinite(stored.first_active)).tolist()) == union
    assert stored.outside == sum(cell < 0 for cell in cells) == found.outside
    assert np.array_equal(stored.gaussians, measure_walk(w.store, path, config).seen)
    expected = w.colors.counts[w.seen[[c for c in cells if c >= 0]].any(axis=0)].sum() / w.colors.num_terms
    assert stored.unpruned[-1] == pytest.approx(expected)


class Plain:
    """Cells that are no store: everything is visible."""

    def __init__(self, count: int) -> None:
        self.count = count

    def cell_at(self, position: Any, /) -> int | None:
        return 0 if position[0] < 1e6 else None

    def visible(self, cell: int, /) -> range:
        return range(self.count)


def test_other_cells_have_terms_active_at_the_eye(tmp_path: Path) -> None:
    w = world(tmp_path)
    path, config = through([0, 0, 0], [1, 1, 1]), WalkConfig(rate=1.0)
    found = lawful(terms_over_walk(w.colors, w.g, path, EPSILON, sets=Plain(len(w.g)), config=config))
    assert found.by == "cells, active at the eye"
    assert found.unpruned[0] == found.gaussians[0] == 1.0
    masks = [Activation(w.colors, w.g.means, EPSILON).active(eye) for eye in path.resample(1.0).positions]
    assert found.terms[-1] == pytest.approx(np.any(masks, axis=0).mean())
    away = lawful(terms_over_walk(w.colors, w.g, through([2e6, 0, 0], [2e6, 1, 0]), EPSILON, sets=Plain(len(w.g))))
    assert away.outside == len(away.times)
    assert away.terms[-1] == 0.0


def test_colors_without_terms(tmp_path: Path) -> None:
    w = world(tmp_path)
    plain = SrbfColors.without_terms(np.full((len(w.g), 3), 0.5))
    found = lawful(terms_over_walk(plain, w.g, inside(w), EPSILON, sets=w.store))
    assert found.terms[-1] == found.bytes[-1] == 0.0


def test_what_does_not_belong_together_is_refused(tmp_path: Path) -> None:
    w, other = world(tmp_path), world(tmp_path, seed=1, name="other.pvs")
    path = inside(w)
    with pytest.raises(ValueError, match="colors: expected those of 150 Gaussians, got 3"):
        terms_over_walk(w.colors[:3], w.g, path, EPSILON, sets=w.store)
    with pytest.raises(FormatError, match="scene: expected a store of 3 Gaussians"):
        terms_over_walk(w.colors[:3], w.g[:3], path, EPSILON, sets=w.store)
    with pytest.raises(FormatError, match="scene"):
        terms_over_walk(w.colors, w.g, path, EPSILON, sets=other.store)
    with pytest.raises(ValueError, match=r"visible: expected ids in \[0, 150\), got 0 to 199"):
        terms_over_walk(w.colors, w.g, path, EPSILON, sets=Plain(200))
    with w.build() as terms:
        with pytest.raises(ValueError, match="sets: expected the VisibilityStore"):
            terms_over_walk(w.colors, w.g, path, terms)
        with pytest.raises(FormatError, match="colors: expected"):
            terms_over_walk(w.colors.first(1), w.g, path, terms, sets=w.store)
    with pytest.raises(ValueError, match="epsilon: expected"):
        terms_over_walk(w.colors, w.g, path, -0.5, sets=w.store)
