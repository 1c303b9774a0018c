"""What a client gets: parts of the distance from a scene, its manifest, and damage of that."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.color.evaluate import evaluate
from gsvis.color.srbf import SrbfColors
from gsvis.errors import FormatError
from gsvis.files.fields import Fields
from gsvis.package import (
    Contents,
    ExactLevel,
    Fidelity,
    PackageInfo,
    Spread,
    in_package_order,
    measure_fidelity,
    write_package,
)
from gsvis.package import manifest as manifests
from gsvis.package.fidelity import STEPS
from gsvis.package.manifest import Manifest
from gsvis.package.package import Package
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from tests.damage import OTHERS, places, replaced, without
from tests.package.worlds import EPSILON, colors_of, levels_of, sets_of

COUNT = 300


class World:
    """A scene of one level with SH of degree 1, terms that are not its SH, and views of it."""

    def __init__(self) -> None:
        g = levels_of(COUNT).union
        rng = np.random.default_rng(3)
        shaded = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0, rng.normal(0.0, 0.1, (COUNT, 3, 3)))
        self.levels = in_package_order(Levels.single(shaded))
        self.scene = self.levels.union
        self.exact, self.packed = colors_of(COUNT)
        self.contents = Contents.from_levels(self.levels, self.packed)
        middle = self.scene.means.mean(axis=0)
        self.cameras = Cameras.orbit(middle, 2.0 * float(np.ptp(self.scene.means)), 3, width=48, height=36, fov=50.0)

    def measure(self, **more: Any) -> Fidelity:
        return measure_fidelity(
            self.scene, self.contents, self.cameras, exact=ExactLevel(self.scene, self.exact), **more
        )


@pytest.fixture(scope="module")
def world() -> World:
    return World()


def drawn(g: Gaussians, camera: Cameras, colors: SrbfColors | None = None) -> np.ndarray:
    shown = None if colors is None else evaluate(colors, g.means, camera.viewpoints[0])
    return np.clip(rasterize(g, camera, colors=shown).images[0], 0.0, 1.0)


def test_a_package_that_loses_nothing_is_equal_in_every_part(world: World) -> None:
    contents, base = world.contents, world.packed.dequantize().base
    none = np.zeros((0, contents.term_records.shape[1]), np.uint8)
    nothing = replace(contents, term_counts=np.zeros(COUNT, np.uint8), term_records=none)
    bare, flat = nothing.gaussians(), SrbfColors.without_terms(base)
    found = measure_fidelity(bare, nothing, world.cameras, exact=ExactLevel(bare, flat))
    assert found.records == Spread(100.0, 100.0)
    assert found.steps == dict.fromkeys(STEPS[:3], Spread(100.0, 100.0))
    assert found.cell is None


def test_every_part_is_measured_as_it_is_defined(world: World) -> None:
    found, decoded = world.measure(), world.contents.gaussians()
    wanted: dict[str, list[float]] = {name: [] for name in ("levels", "terms", "rounding", "records")}
    for c in range(len(world.cameras)):
        camera = world.cameras[c]
        scene, terms = drawn(world.scene, camera), drawn(world.scene, camera, world.exact)
        records = drawn(decoded, camera, world.packed.dequantize())
        wanted["levels"].append(100.0)
        wanted["terms"].append(float(psnr(terms, scene)))
        wanted["rounding"].append(float(psnr(records, terms)))
        wanted["records"].append(float(psnr(records, scene)))
    for name, values in wanted.items():
        spread = found.records if name == "records" else found.steps[name]
        assert (spread.psnr, spread.worst) == pytest.approx((np.mean(values), np.min(values)), abs=1e-3)
    assert found.steps["terms"].psnr < 60 > found.records.psnr  # there is something to measure


def test_the_whole_is_no_farther_than_its_parts_together_and_no_nearer_than_the_largest_less_the_rest(
    world: World,
) -> None:
    """Root mean squared errors of images obey the triangle inequality, view by view."""
    for c in range(len(world.cameras)):
        found = measure_fidelity(
            world.scene, world.contents, world.cameras[c], exact=ExactLevel(world.scene, world.exact)
        )
        parts = [10.0 ** (-spread.psnr / 20.0) for spread in found.steps.values()]
        whole = 10.0 ** (-found.records.psnr / 20.0)
        assert 2.0 * max(parts) - sum(parts) - 1e-6 <= whole <= sum(parts) + 1e-6


def test_without_exact_values_only_the_end_is_known(world: World) -> None:
    found = measure_fidelity(world.scene, world.contents, world.cameras)
    assert (found.records, found.steps, found.cell) == (world.measure().records, {}, None)


def test_what_a_cell_needs_is_its_set_and_its_active_terms(world: World, tmp_path: Path) -> None:
    info, sets = PackageInfo(epsilon=EPSILON), sets_of(tmp_path, world.levels)
    with write_package(tmp_path / "s", world.levels, world.packed, info=info, visibility=sets) as package:
        found = world.measure(sets=package.visibility, active=package.active_terms)
        later = world.measure(sets=package.visibility, active=lambda: package.active_terms)
        silent = world.measure(sets=package.visibility)
        grid, decoded, colors = package.visibility.grid, world.contents.gaussians(), world.packed.dequantize()
        values = []
        for c in range(len(world.cameras)):
            eye = world.cameras[c].viewpoints[0]
            cell = int(np.linalg.norm(grid.centers - eye, axis=1).argmin())  # all eyes lie outside of all cells
            assert grid.cell_at(eye[None])[0] == -1
            active = np.isin(np.arange(colors.num_terms), package.active_terms.active_ids(cell))
            shown, ids = evaluate(colors, decoded.means, eye, active=active), package.visibility.visible_ids(cell)
            image = rasterize(decoded[ids], world.cameras[c], colors=shown[ids]).images[0]
            values.append(float(psnr(np.clip(image, 0.0, 1.0), drawn(world.scene, world.cameras[c]))))
    assert later == found
    assert found.cell is not None
    assert silent.cell is not None
    assert found.cell.psnr == pytest.approx(np.mean(values), abs=1e-3)
    assert found.cell.worst == pytest.approx(np.min(values), abs=1e-3)
    assert found.steps["cells"].psnr < 100
    assert silent.cell != found.cell


def test_wrong_arguments_are_named(world: World) -> None:
    with pytest.raises(ValueError, match="cameras: expected at least one"):
        measure_fidelity(world.scene, world.contents, world.cameras[:0])
    with pytest.raises(ValueError, match="exact: expected colors of 300"):
        measure_fidelity(
            world.scene, world.contents, world.cameras, exact=ExactLevel(world.scene, world.exact[np.arange(9)])
        )


def test_the_views_and_figures_come_back_from_json(world: World) -> None:
    found = world.measure()
    read = Fidelity.from_fields(Fields("a.json", "", json.loads(json.dumps(found.as_dict()))))
    assert read == found
    np.testing.assert_allclose(read.cameras.viewmats, world.cameras.viewmats, atol=1e-12)
    np.testing.assert_allclose(read.cameras.Ks, world.cameras.Ks, atol=1e-5)
    assert "poses" not in found.summary()
    assert found.summary()["views"] == len(world.cameras)
    again = measure_fidelity(world.scene, world.contents, read.cameras)
    assert again.records.psnr == pytest.approx(found.records.psnr, abs=1e-3)


@pytest.fixture(scope="module")
def package(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("package") / "s.gsvis"
    write_package(folder, world.levels, world.packed, info=PackageInfo(fidelity=world.measure())).close()
    return folder


def test_a_manifest_keeps_it_and_may_lack_it(world: World, package: Path, tmp_path: Path) -> None:
    with Package.open(package) as read:
        assert read.manifest.info.fidelity == world.measure()
    with write_package(tmp_path / "bare", world.levels, world.packed) as bare:
        assert bare.manifest.info.fidelity is None
        assert "fidelity" not in json.loads((tmp_path / "bare" / manifests.MANIFEST).read_bytes())


@pytest.mark.parametrize("name", [*OTHERS, "missing"])
def test_another_value_anywhere_is_read_or_refused(package: Path, tmp_path: Path, name: str) -> None:
    value = json.loads((package / manifests.MANIFEST).read_bytes())
    del value["sha256"]
    good = 0
    trails = [trail for trail in places(value) if trail[:1] == ("fidelity",)]
    for trail in trails:
        changed = without(value, trail) if name == "missing" else replaced(value, trail, OTHERS[name])
        (tmp_path / "m.json").write_text(json.dumps({**changed, "sha256": manifests._digest(changed)}))
        try:
            read = Manifest.read(tmp_path / "m.json").info.fidelity
        except FormatError as error:
            assert "\n" not in str(error)
            continue
        good += 1
        if read is not None:
            assert len(read.cameras) == len(read.poses)
    assert good < len(trails)
