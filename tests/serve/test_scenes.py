"""One damaged package is refused and named in the log; those beside it are served."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from pathlib import Path
from typing import Any

import pytest

from gsvis.abr.candidates import CandidateIndex
from gsvis.errors import FormatError
from gsvis.files import arrow as _arrow
from gsvis.package import manifest as manifests
from gsvis.serve import open_scenes, scenes
from tests.damage import replaced
from tests.serve.servers import ask, patient, serving


def rewrite(folder: Path, value: dict[str, Any]) -> None:
    """Write a manifest under a digest that fits."""
    value.pop("sha256", None)
    (folder / manifests.MANIFEST).write_text(json.dumps({**value, "sha256": manifests._digest(value)}))


def with_manifest(folder: Path, trail: tuple[Any, ...], other: Any) -> None:
    rewrite(folder, replaced(json.loads((folder / manifests.MANIFEST).read_bytes()), trail, other))


def with_column(folder: Path, name: bytes) -> None:
    """Give a column of a part a name of the same length, under hashes that fit."""
    value = json.loads((folder / manifests.MANIFEST).read_bytes())
    row = value["chunks"][0]
    path = folder / "parts" / f"{row['sha256']}.arrow"
    data = path.read_bytes()
    assert data.count(b"first_level") == 2  # in the schema and in the footer
    data = data.replace(b"first_level", name)
    marks = _arrow._checksum_places(path, memoryview(data))
    digits = b"%08x" % _arrow._checksum(memoryview(data), marks)
    for mark in marks:
        data = data[:mark] + digits + data[mark + len(digits) :]
    row["sha256"] = hashlib.sha256(data).hexdigest()
    (folder / "parts" / f"{row['sha256']}.arrow").write_bytes(data)
    rewrite(folder, value)


DAMAGES = {
    "a variant that is a list": lambda folder: with_manifest(folder, ("quantization", "colors", "variant"), []),
    "a variant that is an object": lambda folder: with_manifest(folder, ("quantization", "colors", "variant"), {}),
    "a column whose name is not UTF-8": lambda folder: with_column(folder, b"first_le\xff\xfel"),
    "no manifest": lambda folder: (folder / manifests.MANIFEST).unlink(),
    "a manifest that is no JSON": lambda folder: (folder / manifests.MANIFEST).write_bytes(b"{"),
    "a manifest that is a folder": lambda folder: [
        (folder / "manifest.json").unlink(),
        (folder / "manifest.json").mkdir(),
    ],
    "no parts": lambda folder: shutil.rmtree(folder / "parts"),
    "no folder": lambda folder: shutil.rmtree(folder),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_package_does_not_keep_others_from_being_served(
    plain: Path, tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    damaged = tmp_path / "damaged.gsvis"
    shutil.copytree(plain, damaged)
    DAMAGES[name](damaged)
    with caplog.at_level(logging.ERROR, logger="gsvis.serve"), serving(damaged, plain) as server:
        (line,) = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
        assert line.startswith("damaged scene=damaged why=")
        states = {row["name"]: row["state"] for row in json.loads(ask(server, "/")[2])["scenes"]}
        assert states == {"damaged": "refused", "plain": "ready"}
        patient(f"{server.url}/plain", plain)
    with pytest.raises((FormatError, OSError)):
        open_scenes([damaged])


def test_a_reader_that_fails_in_a_way_of_its_own_does_not_either(
    plain: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other.gsvis"
    shutil.copytree(plain, other)
    opened = scenes.open_scene

    def fail(path: Path, name: str, **options: Any) -> Any:
        if name == "other":
            raise ZeroDivisionError("of a reader")
        return opened(path, name, **options)

    monkeypatch.setattr(scenes, "open_scene", fail)
    with caplog.at_level(logging.ERROR, logger="gsvis.serve"), open_scenes([other, plain]) as found:
        assert [served.opened is None for served in found.values()] == [True, False]
        assert found["other"].fault == "ZeroDivisionError: of a reader"
    assert "ZeroDivisionError" in caplog.text
    with pytest.raises(ZeroDivisionError):
        open_scenes([other])


def test_a_warm_up_computes_what_the_second_plan_in_a_cell_needs(celled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, bounds_of = list[bool](), CandidateIndex.bounds_of

    def noted(self: CandidateIndex, *given: Any, make: bool) -> Any:
        found.append(make)
        return bounds_of(self, *given, make=make)

    monkeypatch.setattr(CandidateIndex, "bounds_of", noted)
    with open_scenes([celled]) as served:
        served["celled"].warm_up()
    assert True in found
