"""A server with the pages of the viewer and made-up facts, for tests of the page's controls without a scene."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from base64 import b64encode
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

VIEWER = Path(__file__).parents[2] / "viewer"
POLICY = (
    "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'"
)
NAME = "show room"
AXE = """axe.run(document, {resultTypes: ["violations"]}).then((all) =>
    all.violations.map((found) => [found.id, found.nodes.map((node) => node.html.slice(0, 120))]))"""
OUTSIDE = """[...document.querySelectorAll(".scene > *, .tools > *, .dock > *")]
    .filter((each) => each.checkVisibility({visibilityProperty: true}) && !each.matches(".hidden"))
    .filter((each) => {
        const box = each.getBoundingClientRect();
        return box.left < -1 || box.right > innerWidth + 1 || box.top < -1 || box.bottom > innerHeight + 1;
    }).map((each) => each.className)"""
HOSTILE = "<img src=x onerror=alert(1)>"


def build_page(folder: Path) -> Path:
    """Bundle the page with its stand-in for the core; skip without node or its packages."""
    node, esbuild = shutil.which("node"), VIEWER / "node_modules" / ".bin" / "esbuild"
    if node is None:
        pytest.skip("no node: install Node 20 to build the page")
    if not esbuild.exists():
        pytest.skip("no esbuild: run npm ci in viewer/")
    out = folder / "page.js"
    subprocess.run(
        [str(esbuild), "test/fake-page.ts", "--bundle", "--format=esm", "--target=es2022", f"--outfile={out}"],
        cwd=VIEWER, check=True, capture_output=True,
    )  # fmt: skip
    return out


def make_facts() -> dict[str, Any]:
    """Return cells, floor and an answer to "why" for a room of 6 x 4 units."""
    boxes = [[x, y, 0] for x in range(6) for y in range(4) if (x, y) != (4, 2)]
    heights = [None if (x, y) == (4, 2) else 1.6 for y in range(4) for x in range(6)]
    seeing = [
        {"cell": k, "distance": 1.0 + k / 4, "direction": [0, 0, 1], "weight": [0.02, 0.31] if k < 9 else None}
        for k in range(0, 18, 1)
    ]
    seen = [[-1.0, 0.1 * k - 1.2, 0.15 * k - 0.9] for k in range(24)]
    return {
        "cells": {
            "origin": [0, 0, 0.4], "size": 1.0, "shape": [6, 4, 2], "up": [0, 0, 1], "boxes": boxes,
            "visible": [1] * 23,
        },
        "seen": {"cells": b64encode(bytes(100)).decode(), "weights": b64encode(bytes(100)).decode()},
        "floor": {
            "origin": [0, 0, 0], "side": 1.0, "first": [1, 0, 0], "second": [0, 1, 0], "up": [0, 0, 1],
            "columns": 6, "rows": 4, "heights": heights,
        },
        "walk": None,
        "why/52110": {"cells": {"of": 23, "size": 1.0, "seeing": seeing}, "directions": {"of": 80, "seen": seen}},
    }  # fmt: skip


SETTINGS = {
    "version": 2,
    "frame": "scene",
    "cameras": [{"initial": {"position": [1, 1, 1.6], "target": [4, 2, 0.6], "fov": 60}}],
    "annotations": [
        {"title": "Window", "camera": {"initial": {"position": [2, 3, 1.6], "target": [5, 1, 1], "fov": 60}}},
        {"title": HOSTILE, "camera": {"initial": {"position": [5, 3, 1.6], "target": [2, 1, 1], "fov": 75}}},
    ],
}
TOUR = {
    **SETTINGS,
    "startMode": "animTrack",
    "animTracks": [{
        "name": "around", "duration": 8, "frameRate": 30, "loopMode": "repeat", "interpolation": "spline",
        "smoothness": 1,
        "keyframes": {
            "times": [0, 60, 120, 180],
            "values": {
                "position": [1, 1, 1.6, 5, 1, 1.6, 5, 3, 1.6, 1, 3, 1.6], "target": [3, 2, 1] * 4, "fov": [60] * 4,
            },
        },
    }],
}  # fmt: skip


SPOTS = {
    **SETTINGS,
    "annotations": [
        {
            "position": position, "title": title, "text": "One of the places.\nWith a second line.",
            "extras": {"link": link},
            "camera": {"initial": {"position": [2, 1, 1.6], "target": [4, 2, 0.6], "fov": 60}},
        }
        for position, title, link in (
            ([3, 1.6, 0.8], "Table", "https://example.org/table"), ([9, 4, 0.2], "Behind the wall", ""),
            ([0.5, 0.5, 1], HOSTILE, "javascript:alert(1)"),
        )
    ],
}  # fmt: skip


@contextmanager
def serve_page(script: Path) -> Iterator[str]:
    """Serve the pages as `gsvis serve` does; gives the address."""
    pages, built = VIEWER / "src" / "page", VIEWER.parent / "gsvis" / "viewer"
    scripts = ("author.js", "list.js", "tour.js", "hotspots.js", "words-de.js")
    facts = {f"/scenes/show%20room/{name}": json.dumps(value).encode() for name, value in make_facts().items()}
    scenes = {
        "scenes": [{"name": name, "gaussians": 780_582, "stream": "s", "static": None} for name in (NAME, HOSTILE)]
    }
    files = {
        "/viewer/page.js": (script.read_bytes(), "text/javascript"),
        "/viewer/page.css": ((pages / "page.css").read_bytes(), "text/css"),
        "/viewer/list.css": ((pages / "list.css").read_bytes(), "text/css"),
        **{f"/viewer/{name}": ((built / name).read_bytes(), "text/javascript") for name in scripts},
        "/view/show%20room": ((built / "view.html").read_bytes(), "text/html; charset=utf-8"),
        "/view/spots.json": (json.dumps(SPOTS).encode(), "application/json"),
        "/view/tour.json": (json.dumps(TOUR).encode(), "application/json"),
        "/view/settings.json": (json.dumps(SETTINGS).encode(), "application/json"),
        **{path: (data, "application/json") for path, data in facts.items()},
    }

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            found = files.get(path)
            if path == "/":
                is_page = "text/html" in self.headers.get("accept", "")
                page = ((built / "list.html").read_bytes(), "text/html; charset=utf-8")
                found = page if is_page else (json.dumps(scenes).encode(), "application/json")
            self.send_response(200 if found else 404)
            data, kind = found or (b"no such file", "text/plain")
            self.send_header("content-type", kind)
            self.send_header("content-length", str(len(data)))
            self.send_header("content-security-policy", POLICY)
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()
