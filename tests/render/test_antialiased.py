"""A scene that says it is antialiased is drawn so: by every backend, in weights, in effects of removal, in packages."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsvis.export import StaticOptions, write_static
from gsvis.io.ply import load_ply
from gsvis.package import PackageInfo, unpack_package, write_package
from gsvis.render import rasterize
from gsvis.render.removal import removal_effects
from gsvis.render.weights import contributors, view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.stream.coding import Coding
from gsvis.stream.header import SceneHeader
from tests.package.worlds import colors_of, levels_of

FACTS = SceneFacts(antialiased=True, origin=(1e6, 2e6, 0.0), up=(0.0, 0.6, 0.8), up_source="a test")


def small(seed: int = 0) -> Gaussians:
    """Gaussians about as wide as a pixel of `VIEW`, where the compensation counts."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-1, 1, (200, 3))
    return Gaussians(
        means, rng.normal(size=(200, 4)), rng.uniform(0.01, 0.05, (200, 3)), rng.uniform(0.3, 0.9, 200),
        rng.normal(size=(200, 1, 3)),
    )  # fmt: skip


VIEW = Cameras.look_at([[4.0, 0.0, 0.0]], (0.0, 0.0, 0.0), width=48, height=36)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_images_follow_the_facts(backend: str) -> None:
    stated = small().with_facts(FACTS)
    plain, asked = (rasterize(small(), VIEW, backend=backend, antialiased=lowered) for lowered in (False, True))
    np.testing.assert_array_equal(rasterize(stated, VIEW, backend=backend).images, asked.images)
    np.testing.assert_array_equal(rasterize(small(), VIEW, backend=backend).images, plain.images)
    np.testing.assert_array_equal(rasterize(stated, VIEW, backend=backend, antialiased=False).images, plain.images)
    assert np.abs(asked.images - plain.images).max() > 0.05


def test_a_lowered_opacity_is_what_the_determinants_say() -> None:
    ball = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[0.02] * 3], [0.8], [[[0, 0, 0]]])
    view = Cameras.look_at([[4.0, 0.0, 0.0]], (0.0, 0.0, 0.0), width=49, height=37)
    alone = contributors(ball.with_facts(FACTS), view, (24, 18))
    variance = (float(view.Ks[0, 0, 0]) * 0.02 / 4.0) ** 2
    np.testing.assert_allclose(alone.alphas, 0.8 * variance / (variance + 0.3), rtol=1e-3)


def test_weights_and_effects_of_removal_follow_the_facts() -> None:
    stated = small().with_facts(FACTS)
    wanted = view_weights(small(), VIEW, antialiased=True)
    np.testing.assert_array_equal(view_weights(stated, VIEW).largest, wanted.largest)
    effects, without = removal_effects(stated, VIEW), removal_effects(small(), VIEW)
    assert effects.squared.sum() < without.squared.sum()
    one = int(effects.squared.argmax())
    kept = stated[np.arange(len(stated)) != one]
    change = rasterize(stated, VIEW).images - rasterize(kept, VIEW).images
    np.testing.assert_allclose(effects.squared[one], np.square(change.astype(float)).sum() / 3.0, rtol=0.02)


def test_packages_and_sites_carry_the_facts(tmp_path: Path) -> None:
    found, (_, colors) = levels_of(100), colors_of(100, "rgb")
    levels = Levels(found.union.with_facts(FACTS), found.first, found.last, found.names)
    with write_package(tmp_path / "a.gsvis", levels, colors, info=PackageInfo((0, -1, 0))) as package:
        assert package.manifest.info.facts == FACTS
        assert package.contents.gaussians().facts == FACTS
        header = SceneHeader.from_manifest(package.manifest, Coding.from_contents(package.contents))
        assert header.antialiased
        assert SceneHeader.parse(header.to_message()).antialiased
        unpack_package(package, tmp_path / "levels", sh_degree=0)
        write_static(tmp_path / "site", package, StaticOptions("a"))
    facts = load_ply(tmp_path / "levels" / f"{found.names[0]}.ply").facts
    assert replace(facts, up=None) == replace(FACTS, up=None)
    write_static(tmp_path / "bare", levels, StaticOptions("b"))
    for folder in ("site", "bare"):
        document = json.loads((tmp_path / folder / "scene.json").read_text())
        assert document["antialiased"] is True
