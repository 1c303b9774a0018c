"""A WELCOME with anything in place of any value is read or refused as ProtocolError, in little memory."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from gsvis.errors import ProtocolError, SceneError
from gsvis.package import Package
from gsvis.stream import Receiver, StreamedScene
from gsvis.stream import header as headers
from gsvis.stream.coding import Coding, Steps
from gsvis.stream.header import HEAD, MOST, SCHEMA, SceneHeader
from gsvis.stream.wire import PROTOCOL, WELCOME
from tests.damage import OTHERS, places, replaced, without
from tests.stream.worlds import package_of


@pytest.fixture(scope="module", params=["rgb", "hsl"])
def said(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a WELCOME says."""
    with package_of(tmp_path_factory.mktemp("said") / "s.gsvis", 60, request.param, stores=False) as package:
        data = StreamedScene.open(package).header
    metadata = pa.ipc.read_schema(pa.py_buffer(data[HEAD.size :])).metadata
    return json.loads(metadata[headers._KEY])  # type: ignore[no-any-return]


def welcome(value: Any, schema: pa.Schema = SCHEMA) -> bytes:
    """The message."""
    described = schema.with_metadata({headers._KEY: json.dumps(value).encode()})
    return HEAD.pack(WELCOME, PROTOCOL, 0, 0) + bytes(described.serialize())


def resident() -> int:
    """Bytes of memory that this process has touched; 0 where the system does not say."""
    path = Path("/proc/self/statm")
    return int(path.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if path.exists() else 0


def takes(data: bytes) -> bool:
    """Whether a client takes a WELCOME; nothing but ProtocolError may stop it."""
    try:
        Receiver(data)
    except ProtocolError as error:
        assert "\n" not in str(error)
        return False
    return True


@pytest.mark.parametrize("name", OTHERS)
def test_another_value_anywhere_is_read_or_refused(said: dict[str, Any], name: str) -> None:
    trails = list(places(said))
    good = sum(takes(welcome(replaced(said, trail, OTHERS[name]))) for trail in trails)
    assert good < len(trails)


def test_a_value_that_is_missing_is_read_or_refused(said: dict[str, Any]) -> None:
    assert takes(welcome(said))
    for trail in places(said):
        if trail:
            takes(welcome(without(said, trail)))


def test_names_that_are_not_utf_8_are_refused(said: dict[str, Any]) -> None:
    data = welcome(said, pa.schema([pa.field("secti\u00f6ns", pa.binary(), nullable=False)]))
    assert data.count("\u00f6".encode()) == 1
    assert not takes(data.replace("\u00f6".encode(), b"\xc3\xff"))


def test_a_claimed_size_takes_no_memory(said: dict[str, Any]) -> None:
    large = said | {"gaussians": MOST, "terms": MOST, "chunks": 1}
    large["levels"] = [{"name": "all", "count": MOST}]
    before = resident()
    with pytest.raises(ProtocolError, match="raise most_bytes"):
        Receiver(welcome(large), most_bytes=1 << 20)
    receiver = Receiver(welcome(large), most_bytes=1 << 40)
    assert len(receiver.shown()) == 0
    assert resident() - before < 64 << 20
    for key in ("gaussians", "terms"):
        with pytest.raises(ProtocolError, match=key):
            Receiver(welcome(large | {key: MOST + 1}))


def test_what_no_client_takes_is_not_offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with package_of(tmp_path / "s.gsvis", 60, stores=False) as package:
        monkeypatch.setattr(headers, "MOST", 59)
        with pytest.raises(SceneError, match="at most 59 Gaussians"):
            SceneHeader.from_manifest(package.manifest, Coding.from_contents(package.contents))


def test_the_identity_is_of_all_that_ids_and_records_mean(tmp_path: Path) -> None:
    def about(name: str, variant: str = "rgb", seed: int = 0) -> SceneHeader:
        with package_of(tmp_path / name / "s.gsvis", 60, variant, seed, stores=False) as package:
            return SceneHeader.from_manifest(package.manifest, Coding.from_contents(package.contents))

    one = about("one")
    assert one == about("again")
    assert len({one.identity, about("variant", "hsl").identity, about("content", seed=1).identity}) == 3
    with Package.open(tmp_path / "one" / "s.gsvis") as package:
        manifest, coding = package.manifest, Coding.from_contents(package.contents)
        renamed = dataclasses.replace(manifest, names=(*manifest.names[:-1], "another"))
        assert SceneHeader.from_manifest(renamed, coding).identity != one.identity
        for block in range(len(manifest.blocks)):
            less = (*manifest.blocks[:block], *manifest.blocks[block + 1 :])
            other = SceneHeader.from_manifest(dataclasses.replace(manifest, blocks=less), coding)
            assert other.identity != one.identity
        rounded = dataclasses.replace(coding, steps=Steps(1, 2))
        assert SceneHeader.from_manifest(manifest, rounded).identity != one.identity
