"""Exports and served scenes of any name are found by the addresses in them, resolved as a browser does."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote, urljoin
from urllib.request import urlopen

import numpy as np
import pytest

from gsvis.export import StaticOptions, StreamedOptions, TilesOptions, write_streamed_sog, write_tiles
from gsvis.export.static import write_static
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene
from tests.serve.servers import ask, serving

NAMES = ["scan #1 100%", "a?b&c=d", "Größe ñ", "%41+b"]


@pytest.fixture(scope="module")
def g() -> Gaussians:
    return random_scene(np.random.default_rng(0), 300, sh_degree=1)


class _Silent(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *values: Any) -> None:
        """Print nothing."""


@contextmanager
def plain_server(folder: Path) -> Iterator[str]:
    """Address of a file server that knows nothing of gsvis."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Silent, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


def addresses(document: Any) -> Iterator[str]:
    """Yield the texts of a JSON document that name files."""
    if isinstance(document, dict):
        document = list(document.values())
    if isinstance(document, list):
        for each in document:
            yield from addresses(each)
    elif isinstance(document, str) and re.search(r"\.(bin|glb|json|webp|arrow)$", document):
        yield document


def fetch_all(address: str) -> int:
    """Fetch a document and all that it names; return the number of files."""
    with urlopen(address, timeout=30) as answer:
        content = answer.read()
    if not address.endswith(".json"):
        return 1
    return 1 + sum(fetch_all(urljoin(address, each)) for each in addresses(json.loads(content)))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", ["static", "streamed-sog", "3dtiles"])
def test_an_export_of_any_name_is_found_by_its_addresses(tmp_path: Path, g: Gaussians, name: str, kind: str) -> None:
    if kind == "static":
        write_static(tmp_path / name, g, StaticOptions(name))
        first = "scene.json"
    elif kind == "streamed-sog":
        write_streamed_sog(tmp_path / name, g, StreamedOptions(leaf=64))
        first = "lod-meta.json"
    else:
        write_tiles(tmp_path / name, g, TilesOptions(leaf=64))
        first = "tileset.json"
    with plain_server(tmp_path) as root:
        assert fetch_all(f"{root}{quote(name)}/{first}") > 2


@pytest.mark.parametrize("name", NAMES)
def test_a_static_scene_of_any_name_is_served_by_its_addresses(tmp_path: Path, g: Gaussians, name: str) -> None:
    write_static(tmp_path / name, g, StaticOptions(name))
    with serving(tmp_path / name) as server:
        (row,) = json.loads(ask(server, "/")[2])["scenes"]
        assert row["name"] == name
        for address in (row["view"], row["static"]):
            assert re.fullmatch(r"[A-Za-z0-9._~%/-]+", address)
        status, _, body = ask(server, urljoin("/", row["static"]))
        assert status == 200
        for each in addresses(json.loads(body)["files"]):
            assert ask(server, urljoin("/" + row["static"], each))[0] == 200
