"""Write the page of the viewer with a static scene: as a site for any file server, or as one file that opens from disk.

Both hold the built files of the viewer (`gsvis/viewer`). The single file contains everything: the scene and the Workers
as base64, and a policy that runs only its own three scripts. Names of scenes are escaped; nothing in a scene can run.
"""

from __future__ import annotations

import json
import logging
import re
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from hashlib import sha256
from html import escape
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import BackendError, FormatError
from gsvis.export.publish import PageOptions, check_page, read_settings
from gsvis.export.static import (
    SCENE,
    StaticOptions,
    StaticScene,
    check_target,
    is_static,
    remove_other_files,
    write_static,
)
from gsvis.files.atomic import atomic_folder, atomic_path
from gsvis.files.limits import open_regular, read_whole
from gsvis.files.origins import connect_sources, parse_origins
from gsvis.files.output import TEMPORARY, output_errors
from gsvis.files.temporary import temporary_folder
from gsvis.package.package import Package
from gsvis.progress import Progress, silent
from gsvis.scene.gaussians import Gaussians, rotations_from_quats
from gsvis.scene.levels import Levels
from gsvis.scene.poses import decimals_of

__all__ = ["VIEWER", "SiteReport", "check_site", "check_viewer", "write_html", "write_site"]

VIEWER = Path(__file__).parents[1] / "viewer"
"""Folder of the built files of the viewer."""

PAGE = "index.html"
SETTINGS = "settings.json"
FOLDER = "scene"
_STYLE = '<link rel="stylesheet"'
_EMPTY = '<main class="scene">'

_PARTS = (
    "author.js",
    "embed.js",
    "hotspots.js",
    "tour.js",
    "words-de.js",
)  # loaded when used; a page in one file holds them
_SCRIPTS = ("page.js", "sort.js", "static.js", "network.js", "xr.js", "element.js", *_PARTS)
_WORKERS = ("sort.js", "static.js", "network.js")
_LOG = logging.getLogger(__name__)
_MARK = "gsvis"  # key in the settings of the digest of exported settings
_PIECE = 3 << 20  # bytes of a file that are written at a time as base64
_MOST_WALK = 22_000  # bytes of what is known of walking, in one file: 30 kB as base64
_DISTANCE = 3.0  # distance from an eye to its target, in the settings

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:;"
    " worker-src 'self'; base-uri 'none'; form-action 'none'"
)

_FAILED = """(() => {
const say = (file, type) => {
const line = document.createElement("p");
line.role = "alert";
line.className = "card";
line.textContent = `${file} did not load: the host has to have it, and to send it as ${type}.`;
document.body.prepend(line);
};
addEventListener("error", ({ target }) => {
if (target.localName === "script") addEventListener("load", () => say(target.src, "text/javascript"));
}, true);
addEventListener("load", () => {
for (const link of document.querySelectorAll('link[rel="stylesheet"]')) {
if (!link.sheet?.cssRules.length) say(link.href, "text/css");
}
});
})();
"""
"""Name a script or a style of the page that does not load, such as one that a host sends with a wrong type."""

_EARLY = """(() => {
if (/[?&]content=/.test(location.search)) return;
try {
const base = new URL("%(folder)s/", location.href).href;
const worker = new Worker("viewer/static.js", { type: "module", name: "gsvis static" });
worker.onerror = () => { globalThis.gsvisEarly = null; };
worker.postMessage({ kind: "ahead", base, names: location.hash.length > 1 ? ["%(scene)s"] : %(names)s });
globalThis.gsvisEarly = { base, worker };
} catch {}
})();"""
"""Start the Worker of the scene before the scripts of the page are here, and ask for what the first view needs."""

_START = """(() => {
const own = {};
for (const each of document.querySelectorAll('script[type="text/gsvis-worker"]')) {
const text = Uint8Array.from(atob(each.textContent), (letter) => letter.charCodeAt(0));
own[each.dataset.name] = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
}
const Plain = Worker;
globalThis.Worker = class extends Plain {
constructor(url, options) {
const found = own[String(url).split("/").pop()];
super(found ?? url, found ? { ...options, type: "classic" } : options);
}
};
})();"""
"""Start the Workers of a single-file page from its own text, because it cannot load other files from disk.

They are classic scripts: Chromium loads no module of a page from disk. The bundles import and export nothing.
"""


@dataclass(frozen=True)
class SiteReport:
    """Result of an export.

    Attributes:
        path: The folder of a site, or the file of a page.
        scene: The scene in it.
        nbytes: Total bytes.
    """

    path: Path
    scene: StaticScene
    nbytes: int


def write_site(
    folder: str | PathLike[str],
    scene: Package | Levels | Gaussians,
    options: StaticOptions | None = None,
    *,
    viewer: str | PathLike[str] | None = None,
    opens: Sequence[str] = (),
    page: PageOptions | None = None,
    progress: Progress = silent,
) -> SiteReport:
    """Write a site: the page, and the static scene that it shows, in the folder `scene`.

    Args:
        folder: Folder of the site; other files in it stay, and so does a `settings.json` that a person wrote or
            changed, as long as the scene keeps its name.
        scene: A package, or a bare scene; see `write_static`.
        options: See `write_static`.
        viewer: Folder of the built files of the viewer; None takes those of this package.
        opens: Further origins from which the page may open scenes, such as "https://cdn.example.org"; none by default.
        page: How the page presents the scene; a `settings.json` that is named there replaces any other.
        progress: See `write_static`.

    Raises:
        ValueError: If the scene is empty, or one of `opens` is not an origin.
        FormatError: If `scene` in the folder holds something else, or the package is damaged.
        BackendError: If the viewer is not built.
        OSError: If the folder cannot be written.
    """
    target = _check.path("folder", folder)
    files = _viewer_files(VIEWER if viewer is None else Path(viewer))
    origins = parse_origins("opens", opens)
    shown = page or PageOptions()
    check_page(shown)
    check_target(target / FOLDER)
    with atomic_folder(target, last=(f"{FOLDER}/{SCENE}", PAGE)) as partial:
        found = write_static(partial / FOLDER, scene, options, progress=progress)
        document = json.loads(read_whole(found.path / SCENE))
        (partial / "viewer").mkdir()
        for name in ("page.css", *_SCRIPTS):
            (partial / "viewer" / name).write_bytes(files[name])
        keeps = shown.settings is None and _has_settings_to_keep(target, document["name"])
        is_own = shown.settings is None and not keeps  # then visitors begin at the first view of the scene
        if not keeps:
            (partial / SETTINGS).write_bytes(_chosen_settings(shown, document))
        pictures = dict(shown.pictures())
        for name, data in pictures.items():
            (partial / name).write_bytes(data)
        names = [SCENE, *(found.ahead if is_own else ())]
        early = _FAILED + _EARLY % {"folder": FOLDER, "scene": SCENE, "names": json.dumps(names)}
        own = _POLICY.replace("script-src 'self'", f"script-src 'self' {_hash(early)}")
        policy = f"{own}; connect-src {connect_sources(origins)}"
        metas = {"gsvis-content": f"{FOLDER}/", "gsvis-settings": SETTINGS}
        if origins:
            metas["gsvis-origins"] = " ".join(origins)
        text = _page(files["view.html"].decode(), document, metas, policy, shown)
        text = text.replace(_EMPTY, _EMPTY + shown.poster_element(inside=False))
        text = text.replace(_STYLE, "\n    ".join([f"<script>{early}</script>", *_preloads(found), _STYLE]), 1)
        (partial / PAGE).write_text(text.replace("../viewer/", "viewer/"), encoding="utf-8")
    found = replace(found, path=target / FOLDER)
    remove_other_files(found)
    names = [PAGE, SETTINGS, *pictures, f"{FOLDER}/{SCENE}", *(f"viewer/{name}" for name in ("page.css", *_SCRIPTS))]
    return SiteReport(target, found, found.nbytes + sum((target / name).stat().st_size for name in names))


def _preloads(scene: StaticScene) -> list[str]:
    """Return elements that ask for the files that the page itself reads before it shows the scene."""
    names = [f"{FOLDER}/{SCENE}", SETTINGS]
    if "facts" in scene.files:
        names.append(f"{FOLDER}/{scene.files['facts'].names[0]}")
    return [f'<link rel="preload" as="fetch" crossorigin="anonymous" href="{name}">' for name in names]


def check_site(folder: str | PathLike[str], overwrite: bool) -> None:
    """Raise unless a folder can take a site: it is new, empty, or holds an earlier site.

    Raises:
        ValueError: If it has a page of something else and `overwrite` is false.
    """
    target = _check.path("folder", folder)
    if not overwrite and (target / PAGE).exists() and not is_static(target / FOLDER):
        raise ValueError(
            f"--out: expected a new folder or an earlier site, got {target}, which has {PAGE} of something else; name"
            " another, or say --overwrite"
        )


def write_html(
    path: str | PathLike[str],
    scene: Package | Levels | Gaussians,
    options: StaticOptions | None = None,
    *,
    viewer: str | PathLike[str] | None = None,
    page: PageOptions | None = None,
    progress: Progress = silent,
) -> SiteReport:
    """Write one HTML file that holds the viewer and the scene, and opens from disk.

    Args:
        path: The file; replaced when the new one is complete.
        scene: A package, or a bare scene; see `write_static`.
        options: See `write_static`.
        viewer: Folder of the built files of the viewer; None takes those of this package.
        page: How the page presents the scene.
        progress: See `write_static`.

    Raises:
        ValueError: If the scene is empty.
        FormatError: If the package is damaged.
        BackendError: If the viewer is not built.
        OSError: If the file cannot be written.
    """
    target = _check.path("path", path)
    shown = page or PageOptions()
    check_page(shown)
    files = _viewer_files(VIEWER if viewer is None else Path(viewer))
    with temporary_folder() as made_in:
        with output_errors(made_in, remedy=TEMPORARY):
            small = replace(options or StaticOptions(), most_walk=_MOST_WALK, most_first=0, most_glances=0.0)
            found = write_static(Path(made_in) / FOLDER, scene, small, progress=progress)
        document = json.loads(read_whole(found.path / SCENE))
        style, script, *parts = (_inline(files[name].decode()) for name in ("page.css", "page.js", *_PARTS))
        hashes = " ".join(_hash(text) for text in (_START, *parts, script))
        policy = (
            f"default-src 'none'; script-src {hashes}; style-src {_hash(style)}; img-src data: blob:;"
            " connect-src data:; worker-src blob:; base-uri 'none'; form-action 'none'"
        )
        settings = "data:application/json;base64," + b64encode(_chosen_settings(shown, document)).decode()
        metas = {"gsvis-content": "inline:", "gsvis-settings": settings}
        text = _page(files["view.html"].decode(), document, metas, policy, shown)
        text = text.replace(_EMPTY, _EMPTY + shown.poster_element(inside=True))
        head, tail = _split(text, style)
        with atomic_path(target) as partial, partial.open("wb") as out:
            out.write(head.encode())
            for name in _WORKERS:
                out.write(f'<script type="text/gsvis-worker" data-name="{name}">'.encode())
                out.write(b64encode(files[name]) + b"</script>\n")
            for name in [SCENE, *(name for file in found.files.values() for name in file.names)]:
                out.write(f'<script type="text/gsvis" data-name="{name}">'.encode())
                with open_regular(found.path / name) as file:
                    while piece := file.read(_PIECE):
                        out.write(b64encode(piece))
                out.write(b"</script>\n")
            modules = "".join(f'<script type="module">{text}</script>\n' for text in (*parts, script))
            out.write(f"<script>{_START}</script>\n{modules}".encode())
            out.write(tail.encode())
        return SiteReport(target, found, target.stat().st_size)


def check_viewer() -> None:
    """Raise unless the viewer, which pages need, is built.

    Raises:
        BackendError: If a file of it is missing.
    """
    _viewer_files(VIEWER)


def _viewer_files(folder: Path) -> dict[str, bytes]:
    """Return the built files of the viewer.

    Raises:
        BackendError: If one is missing.
    """
    names = ("view.html", "page.css", *_SCRIPTS)
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise BackendError(
            f"the viewer is not built: {folder / missing[0]} is missing; install a wheel of gsvis, or run make viewer"
        )
    return {name: read_whole(folder / name) for name in names}


def _page(page: str, document: dict[str, Any], where: Mapping[str, str], policy: str, shown: PageOptions) -> str:
    """Return the page with its title, its policy, the addresses of its scene and settings, and what was chosen."""
    metas = {"gsvis-scene": document["name"], **where, **shown.metas()}
    lines = [f'<meta http-equiv="Content-Security-Policy" content="{escape(policy)}">']
    lines += [f'<meta name="{name}" content="{escape(text)}">' for name, text in metas.items()]
    lines += shown.preview(document["name"])
    title = f"<title>{escape(shown.title or document['name'] + ' · gsvis')}</title>"
    page = page.replace('<html lang="en">', f'<html lang="{shown.language or "en"}">')
    page = re.sub(r"<title>.*?</title>", lambda _: title, page, count=1, flags=re.DOTALL)
    return re.sub(r"<meta charset=[^>]*>", lambda found: "\n    ".join([found[0], *lines]), page, count=1)


def _split(page: str, style: str) -> tuple[str, str]:
    """Return the parts of a page before and after the place for scripts, with its style inlined."""
    page = re.sub(r"\s*<script[^>]*\bsrc=[^>]*></script>", "", page)
    page = re.sub(r"<link rel=\"stylesheet\"[^>]*>", lambda _: f"<style>{style}</style>", page)
    head, end, tail = page.rpartition("</body>")
    return head, end + tail


def _inline(script: str) -> str:
    """Return a script that can stand inside a page."""
    return script.replace("</script", "<\\/script").replace("<!--", "<\\!--")


def _hash(text: str) -> str:
    """Return the hash of a script or style, for the policy."""
    return f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'"


def _chosen_settings(shown: PageOptions, document: dict[str, Any]) -> bytes:
    """Return the settings of a page: those that were chosen, else its first views."""
    return _settings(document) if shown.settings is None else _spelled(read_settings(Path(shown.settings)))


def _settings(document: dict[str, Any]) -> bytes:
    """Return the first views as `settings.json`, with a digest that marks them as ours."""
    cameras = [{"initial": view} for view in _views(document)]
    said = {"version": 2, "frame": "scene", "cameras": cameras}
    return _spelled({**said, _MARK: sha256(_spelled(said)).hexdigest()[:16]})


def _spelled(said: dict[str, Any]) -> bytes:
    """Return settings as JSON text."""
    return json.dumps(said, indent=1).encode() + b"\n"


def _has_settings_to_keep(target: Path, name: str) -> bool:
    """Return whether a site has settings that a person wrote for a scene of this name."""
    if not (target / SETTINGS).exists():
        return False
    with suppress(OSError, FormatError, ValueError, RecursionError):
        said = json.loads(read_whole(target / SETTINGS))
        if isinstance(said, dict) and said.pop(_MARK, None) == sha256(_spelled(said)).hexdigest()[:16]:
            return False
    with suppress(OSError, FormatError, ValueError, KeyError, TypeError):
        before = json.loads(read_whole(target / FOLDER / SCENE))
        if before["name"] != name:
            _LOG.warning("%s shows %s, not %s; it is written anew", target / SETTINGS, before["name"], name)
            return False
        plain = _spelled({"version": 2, "frame": "scene", "cameras": [{"initial": view} for view in _views(before)]})
        return read_whole(target / SETTINGS) != plain  # settings without a mark
    return True


def _distance(document: dict[str, Any], eye: NDArray[np.float64], ahead: NDArray[np.float64]) -> float:
    """Return how far an eye looks: some cells, or to the middle of a scene without cells."""
    if document["cells"]["size"]:
        return float(document["cells"]["size"]) * _DISTANCE
    to_middle = np.array(document["places"]["middle"]) - eye
    least = 4.0 * float(document["places"]["scale"])  # about the size of a few hundred Gaussians
    return max(float(to_middle @ ahead), least)


def _views(document: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the first views as settings."""
    for pose in document["poses"]:
        ahead = rotations_from_quats(np.array([pose["rotation"]]))[0][:, 2]
        away = pose.get("reach") or _distance(document, np.array(pose["position"]), ahead)
        places = decimals_of([away])
        target = [round(a + away * b, places) for a, b in zip(pose["position"], ahead.tolist(), strict=True)]
        yield {"position": pose["position"], "target": target, "fov": 65}
