"""The page decodes records as the package has them, to the bit, in both variants, as they are and coarse."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from gsvis.abr.classes import FieldOfView
from gsvis.package import Contents
from gsvis.stream import Quality, Receiver, Session, StreamedScene
from tests.stream.worlds import package_of
from tests.viewer.bundles import NEEDS_NODE, bundle

pytestmark = NEEDS_NODE


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bundle("records", tmp_path_factory.mktemp("records"))


@pytest.mark.parametrize("lattice", [False, True])
@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@pytest.mark.parametrize("quality", [None, Quality(), Quality(place=2.0, turn=9.0, opacity=3, shape=3, color=3)])
def test_the_page_decodes_what_the_package_has(
    program: Path, tmp_path: Path, variant: str, quality: Quality | None, lattice: bool
) -> None:
    contents = decode_in_page(program, tmp_path, variant, lattice, quality, None)
    assert contents.table.logarithmic.any() == (lattice and quality is None)


@pytest.mark.parametrize("quality", [Quality(), Quality(place=None)])
def test_the_page_decodes_rounded_records(program: Path, tmp_path: Path, quality: Quality) -> None:
    contents = decode_in_page(program, tmp_path, "rgb", True, None, quality)
    assert contents.table.logarithmic.any() == (quality.place is None)


def decode_in_page(
    program: Path, tmp_path: Path, variant: str, lattice: bool, quality: Quality | None, rounded: Quality | None
) -> Contents:
    """Send some records of a package to the page, compare what it decodes, and return all records as sent."""
    with package_of(tmp_path / "s.gsvis", 3000, variant, stores=False, lattice=lattice, quality=rounded) as package:
        scene = StreamedScene.open(package, quality=quality)
        session = Session(scene, FieldOfView.from_degrees(110, 90))
        session.on_pose(0.0, [0, 0, 0], [1, 0, 0, 0])
        message = session.next_message(0.0, 60_000.0)
        assert message is not None
        contents = scene.contents
    received = Receiver(scene.header).receive(message.data)
    assert min(len(received.gaussians), len(received.terms)) > 200
    for name, data in (("welcome", scene.header), ("batch", message.data)):
        (tmp_path / name).write_bytes(data)
    run = subprocess.run(
        ["node", program, tmp_path / "welcome", tmp_path / "batch"], check=True, capture_output=True, text=True
    )
    found = json.loads(run.stdout)
    records = np.array(found["records"], np.uint32).view(np.uint8).reshape(-1, 16)
    np.testing.assert_array_equal(records, contents.records[received.gaussians])
    terms = np.array(found["terms"], np.uint32).view(np.uint8).reshape(-1, 8)
    width = contents.term_records.shape[1]
    np.testing.assert_array_equal(terms[:, :width], contents.term_records[received.terms])
    assert not terms[:, width:].any()
    return contents
