from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.store import CellSet, StoreInfo, VisibilityStore, write_store
from gsvis.pvs.why import why
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians

EDGES = np.array([1 / 255, 1 / 16, 1 / 4])
WALL, BALL, HAZE, FAINT, BEHIND = 0, 1, 2, 3, 4
"""Along +x from two cells around the origin: haze, then a wall, then a ball; a faint one; one behind the eyes."""


@cache
def tracer() -> Tracer:
    means = [[4, 0, 0], [6, 0, 0], [2.5, 0, 0], [0, 4, 0], [-5, 0, 0]]
    scales = [[0.05, 6, 6], [0.2, 0.2, 0.2], [0.3, 3, 3], [0.2, 0.2, 0.2], [0.2, 0.2, 0.2]]
    opacities = [0.999, 0.9, 0.2, 0.003, 0.9]
    return Tracer(
        EllipsoidProxies.from_scene(Gaussians(means, [[1, 0, 0, 0]] * 5, scales, opacities, [[[0, 0, 0]]] * 5))
    )


def open_store(folder: Path, scene: Gaussians, cells: list[list[int]]) -> VisibilityStore:
    """Cells in a row along x, one unit wide, the first around the origin, which see the given Gaussians, in class 1."""
    coords = np.stack([np.arange(len(cells)), np.zeros(len(cells)), np.zeros(len(cells))], axis=1).astype(np.int32)
    grid = CellGrid(np.full(3, -0.5), 1.0, (len(cells), 1, 1), coords, np.array([0.0, 0.0, 1.0]))
    info = StoreInfo(len(scene), scene_hash(scene), 1 / 255, EDGES)
    sets = [CellSet(ids, [1] * len(ids)) for ids in cells]
    write_store(folder / "x.pvs", grid, info, sets, np.zeros((len(scene), 10), np.uint8))
    return VisibilityStore.open(folder / "x.pvs", scene=scene)


def test_what_is_visible_is_reported_with_its_weight(tmp_path: Path) -> None:
    with open_store(tmp_path, tracer().proxies.gaussians, [[WALL, HAZE], []]) as store:
        answer = store.why(WALL, 0, tracer())
        assert answer.verdict == "visible"
        assert answer.interval == pytest.approx((1 / 16, 1 / 4))
        assert str(answer) == "Gaussian 0 is visible from cell 0: its largest weight there is between 0.0625 and 0.25."
        assert (answer.nearest_cell, answer.nearest_distance) == (0, 0.0)


def test_what_is_hidden_is_reported_with_what_hides_it(tmp_path: Path) -> None:
    with open_store(tmp_path, tracer().proxies.gaussians, [[WALL], [], [BALL]]) as store:
        answer = store.why(BALL, 0, tracer())
        assert answer.verdict == "hidden"
        assert answer.blockers.tolist() == [WALL, HAZE]  # the wall takes most, though the haze stands in front of it
        assert answer.shares[0] == pytest.approx(0.8, abs=0.05)
        assert answer.shares[1] == pytest.approx(0.2, abs=0.05)
        assert answer.weight < 1 / 255
        assert answer.rays == 9
        assert (answer.nearest_cell, answer.nearest_distance) == (2, 2.0)
        text = str(answer)
        assert text.startswith("Gaussian 1 is not visible from cell 0: its largest weight there is below 0.003922.\n")
        assert "  Gaussian 0: 8" in text
        assert text.endswith("Nearest cell that sees it: 2, 2 away.")


def test_shares_are_those_of_the_rays_themselves(tmp_path: Path) -> None:
    eyes = np.array([[0.0, 0.0, 0.0], [0.2, 0.3, -0.4], [-0.3, 0.1, 0.2]])
    with open_store(tmp_path, tracer().proxies.gaussians, [[], []]) as store:
        answer = why(store, tracer(), BALL, 0, viewpoints=eyes)
        alone = [why(store, tracer(), BALL, 0, viewpoints=eye[None]) for eye in eyes]
        assert answer.rays == 3
        for blocker, share in zip(answer.blockers, answer.shares, strict=True):
            each = [dict(zip(one.blockers.tolist(), one.shares, strict=True)).get(int(blocker), 0.0) for one in alone]
            assert share == pytest.approx(np.mean(each))
        assert answer.shares.sum() <= 1.0 + 1e-6
        assert answer.weight == pytest.approx(max(one.weight for one in alone))


def test_the_light_taken_and_the_weight_add_up_where_nothing_is_opaque(tmp_path: Path) -> None:
    g = tracer().proxies.gaussians
    thin = Gaussians(g.means, g.quats, g.scales, np.minimum(g.opacities, 0.5), g.sh0)
    rays = Tracer(EllipsoidProxies.from_scene(thin))
    with open_store(tmp_path, thin, [[], []]) as store:
        answer = why(store, rays, BALL, 0, viewpoints=[[0.0, 0.0, 0.0]])
        assert answer.verdict == "missed"
        assert answer.weight == pytest.approx(0.5 * (1.0 - answer.shares.sum()), rel=1e-4)
        assert "views that made the set stepped over it" in str(answer)


def test_a_gaussian_that_nothing_hides_is_reported_as_missed(tmp_path: Path) -> None:
    with open_store(tmp_path, tracer().proxies.gaussians, [[], []]) as store:
        answer = store.why(BEHIND, 0, tracer())
        assert answer.verdict == "missed"
        assert answer.weight == pytest.approx(0.9, abs=0.01)
        assert len(answer.blockers) == 0
        assert "Nothing stands in front of it on 9 rays" in str(answer)
        assert answer.interval == (answer.weight, 1.0)
        assert str(answer).startswith("Gaussian 4 is visible from cell 0 and missing in its set: a ray to its center")
        assert str(answer).endswith("No set holds it.")


def test_no_answer_calls_visible_what_it_calls_hidden(tmp_path: Path) -> None:
    """Every Gaussian of a random cloud from every cell: one verdict, in the first sentence, by set and by rays."""
    rng = np.random.default_rng(5)
    n = 120
    cloud = Gaussians(
        rng.uniform(-3.0, 6.0, (n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.05, 1.5, (n, 3)),
        rng.choice([0.003, 0.0045, 0.05, 0.5, 0.99], n), np.zeros((n, 1, 3)),
    )  # fmt: skip
    rays, sets, seen = Tracer(EllipsoidProxies.from_scene(cloud)), [np.arange(0, n, 3), np.arange(n // 2), []], set()
    with open_store(tmp_path, cloud, [list(map(int, each)) for each in sets]) as store:
        for gaussian in range(n):
            for cell in range(3):
                answer = store.why(gaussian, cell, rays)
                first, *rest = str(answer).split("\n")
                seen.add(answer.verdict)
                visible = gaussian in set(sets[cell]) or answer.weight >= store.tau
                assert (answer.verdict in ("visible", "missed")) == visible
                assert ("is visible from cell" in first) == visible
                assert ("is not visible" in first) == (answer.verdict == "hidden")
                assert not any(word in " ".join(rest) for word in ("is visible", "is not visible", "Yet"))
                assert answer.interval[0] <= answer.interval[1]
                if answer.verdict in ("hidden", "missed"):
                    assert (answer.interval[0] >= store.tau) == (answer.verdict == "missed")
    assert seen == {"visible", "missed", "hidden", "faint"}


def test_what_is_too_faint_is_reported_as_faint(tmp_path: Path) -> None:
    with open_store(tmp_path, tracer().proxies.gaussians, [[WALL], []]) as store:
        answer = store.why(FAINT, 0, tracer())
        assert answer.verdict == "faint"
        assert str(answer) == "Gaussian 3 is too faint to be seen from anywhere: its opacity is below 0.003922."


def test_without_a_tracer_the_store_reports_what_it_knows(tmp_path: Path) -> None:
    with open_store(tmp_path, tracer().proxies.gaussians, [[WALL], [BALL]]) as store:
        answer = store.why(BALL, 0)
        assert (answer.verdict, answer.rays, answer.nearest_cell) == ("hidden", 0, 1)
        assert "In front" not in str(answer)
        assert "Nothing stands" not in str(answer)
        assert store.why(WALL, 0).verdict == "visible"


def test_an_eye_in_the_center_of_the_gaussian_is_no_trouble(tmp_path: Path) -> None:
    with open_store(tmp_path, tracer().proxies.gaussians, [[], []]) as store:
        answer = why(store, tracer(), BEHIND, 0, viewpoints=[[-5.0, 0.0, 0.0]])
        assert answer.verdict == "missed"
        assert len(answer.blockers) == 0


def test_a_long_list_is_cut_and_summed_up(tmp_path: Path) -> None:
    x = np.arange(1.0, 12.0)
    means = np.stack([x, 0 * x, 0 * x], axis=1)
    veils = Gaussians(means, [[1, 0, 0, 0]] * 11, [[0.05, 5, 5]] * 11, [0.6] * 11, [[[0, 0, 0]]] * 11)
    with open_store(tmp_path, veils, [[], []]) as store:
        answer = store.why(10, 0, Tracer(EllipsoidProxies.from_scene(veils)))
        assert answer.blockers.tolist() == list(range(10))
        assert (np.diff(answer.shares) <= 0).all()
        assert "5 more: " in str(answer)
        assert len(str(answer).splitlines()) == 10


def test_a_tracer_of_another_scene_is_refused(tmp_path: Path) -> None:
    g = tracer().proxies.gaussians
    with open_store(tmp_path, g, [[WALL], []]) as store:
        for other in (g[:3], g[::-1]):
            with pytest.raises(FormatError, match="scene: expected a store of"):
                store.why(0, 0, Tracer(EllipsoidProxies.from_scene(other)))
        with pytest.raises(ValueError, match="viewpoints"):
            why(store, tracer(), BALL, 0, viewpoints=[0.0, 0.0, 0.0])
        with pytest.raises(ValueError, match=r"cell: expected a number in \[0, 1\]"):
            store.why(0, 2, tracer())
