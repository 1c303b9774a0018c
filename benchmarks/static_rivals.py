"""How many seconds until a view is good: a static site of gsvis, PlayCanvas' streamed SOG, and a SOG in Spark?

All three are files on the same slow host (`_slow_host.py`), opened in Debian's Chromium without a GPU, each visit with
an empty cache. gsvis is its page. PlayCanvas is a page of one script (its engine and 20 lines, bundled and minified)
that hands `lod-meta.json` to the engine and leaves the choice to it. Spark is such a page, with three.js, that loads
one SOG file. A rival's Gaussians count as drawn when the last byte of their files has come, without the time to decode
and sort them, which favors rivals; those of gsvis when the page has decoded them. Each is compared with all that it
holds itself.

Given: a package with visible sets (--package), a scene (--scene, --lod) whose highest level it has, npm packages
    (--modules), --eyes eyes within cells drawn by --seed, --visits visits at each.
Measured: seconds from navigation until the image of what has come reaches 20 and 35 dB, 320 x 180, 65 degrees high;
    bytes of the page and its scripts, gzipped.
Defaults chosen on: nothing.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _browsers import visits
from _harness import add_arguments, first_reaching, need, realdata, write_result
from _reader import VIEWER
from _slow_host import Host, slow_host
from static_seconds import _WATCH, SIZE, TARGETS, WIDE, drawn_views, seconds_until, spell, summarize
from static_seconds import address as address_of
from static_site import Eye, camera_of, name_arrivals, package_ids

from gsvis.color.evaluate import Evaluator
from gsvis.export import write_site
from gsvis.export.streamed import StreamedOptions, write_streamed_sog
from gsvis.io import load_scene, save_scene
from gsvis.package import Package
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians, rotations_from_quats

LONGEST = 20.0  # seconds of a visit
NOTHING = "window.arrived = [];"
PAGE = """<!doctype html><meta charset="utf-8">
<style>html, body, canvas { margin: 0; width: 100%; height: 100% }</style>
<canvas></canvas><script type="module" src="page.js"></script>"""
EYE = """
const asked = new URLSearchParams(location.search), triple = (name) => asked.get(name).split(",").map(Number);
const canvas = document.querySelector("canvas"), eye = triple("eye"), target = triple("target"), up = triple("up");
"""
PLAYCANVAS = (
    """
import * as pc from "playcanvas";
"""
    + EYE
    + """
const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false, alpha: false } });
app.setCanvasFillMode(pc.FILLMODE_FILL_WINDOW);
app.setCanvasResolution(pc.RESOLUTION_AUTO);
const camera = new pc.Entity("camera");
camera.addComponent("camera", { clearColor: new pc.Color(0, 0, 0), fov: 65, nearClip: 0.02, farClip: 1000 });
app.root.addChild(camera);
camera.setPosition(...eye);
camera.lookAt(new pc.Vec3(...target), new pc.Vec3(...up));
app.start();
const asset = new pc.Asset("scene", "gsplat", { url: "scene/lod-meta.json" });
asset.once("load", () => {
  const entity = new pc.Entity("scene");
  entity.addComponent("gsplat", { asset });
  app.root.addChild(entity);
});
app.assets.add(asset);
app.assets.load(asset);
"""
)
SPARK = (
    """
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
"""
    + EYE
    + """
const renderer = new THREE.WebGLRenderer({ canvas, antialias: false }), scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(65, innerWidth / innerHeight, 0.02, 1000);
camera.up.set(...up);
camera.position.set(...eye);
camera.lookAt(...target);
scene.add(new SparkRenderer({ renderer }));
scene.add(new SplatMesh({ url: "scene.sog" }));
renderer.setAnimationLoop(() => renderer.render(scene, camera));
"""
)


@dataclass(frozen=True, eq=False)
class Rival:
    """A page of another engine, and what its files hold.

    Attributes:
        folder: The site.
        files: For each group of files that belong together, their paths.
        groups: The Gaussians of each group.
    """

    folder: Path
    files: list[list[str]]
    groups: list[Gaussians]

    def arrivals(self, host: Host) -> list[tuple[float, int]]:
        """Return when each group had come, in order; groups that have not are left out."""
        ends = {path: last for path, _, _, last in host.log}
        found = [
            (max(ends[name] for name in names), k)
            for k, names in enumerate(self.files)
            if all(name in ends for name in names)
        ]
        return sorted(found)


def build_page(folder: Path, source: str, modules: Path) -> None:
    """Write a page whose only script is `source` with all that it imports, minified."""
    folder.mkdir()
    (folder / "index.html").write_text(PAGE, encoding="utf-8")
    script = folder / "page.js"
    script.write_text(source, encoding="utf-8")
    words = ["npx", "esbuild", str(script), "--bundle", "--minify", "--format=esm", f"--outfile={script}"]
    environment = {**os.environ, "NODE_PATH": str(modules.absolute())}
    subprocess.run([*words, "--allow-overwrite", "--log-level=error"], cwd=VIEWER, check=True, env=environment)


def playcanvas(folder: Path, g: Gaussians, up: tuple[float, ...], modules: Path) -> Rival:
    """Return the page of PlayCanvas' engine with a streamed SOG."""
    build_page(folder, PLAYCANVAS, modules)
    write_streamed_sog(folder / "scene", g, StreamedOptions(up=(up[0], up[1], up[2])))
    meta = json.loads((folder / "scene" / "lod-meta.json").read_text(encoding="utf-8"))
    names = [*meta["filenames"], *([meta["environment"]] if meta.get("environment") else [])]
    files = []
    groups = []
    for name in names:
        part = (folder / "scene" / name).parent
        files.append([f"/scene/{part.name}/{path.name}" for path in sorted(part.iterdir())])
        groups.append(load_scene(part / "meta.json"))
    return Rival(folder, files, groups)


def spark(folder: Path, g: Gaussians, modules: Path) -> Rival:
    """Return the page of Spark with one SOG file."""
    build_page(folder, SPARK, modules)
    save_scene(g, folder / "scene.sog")
    return Rival(folder, [["/scene.sog"]], [load_scene(folder / "scene.sog")])


@dataclass(frozen=True, eq=False)
class Ours:
    """The site of a package, and what draws what has come of it.

    Attributes:
        folder: The site.
        package: The package.
        evaluator: Evaluates its colors.
        ids: Id in the package of each id of the site.
    """

    folder: Path
    package: Package
    evaluator: Evaluator
    ids: np.ndarray

    @classmethod
    def open(cls, package: Package, folder: Path) -> Ours:
        """Return the site of a package in a folder."""
        evaluator = Evaluator(package.contents.colors().dequantize())
        return cls(folder, package, evaluator, package_ids(package))

    def visit(self, browser: Any, host: Host, pose: dict[str, Any], link: tuple[float, float]) -> dict[str, Any]:
        """Return when the view of a pose was good, over a link of a delay and Mbit/s."""
        begin = partial(host.begin, link[0], 125e3 * link[1])
        steps = browser(host.url + address_of(pose), _WATCH, LONGEST, begin)
        scripts = script_bytes(host)
        name_arrivals(steps, self.ids, self.package.contents)
        eye = Eye(self.package.contents, self.evaluator, camera_of(pose, SIZE, WIDE))
        return {"scripts": scripts, **{str(target): seconds_until(eye, steps, target) for target in TARGETS}}


def visit(
    browser: Any, host: Host, rival: Rival, asked: str, camera: Cameras, link: tuple[float, float]
) -> dict[str, Any]:
    """Return when a rival's view was good, over a link of a delay and Mbit/s."""
    begin = partial(host.begin, link[0], 125e3 * link[1])
    browser(host.url + asked, NOTHING, LONGEST, begin)
    return {"scripts": script_bytes(host), **seconds_of(rival, camera, host)}


def script_bytes(host: Host) -> int:
    """Return the bytes of the page, its scripts and style sheets that a visit has loaded."""
    return sum(size for path, size, _, _ in host.log if path.endswith((".js", ".html", ".css", "/")))


def seconds_of(rival: Rival, camera: Cameras, host: Host) -> dict[str, float | None]:
    """Return when a rival's view was good, by the files that had come."""
    came = rival.arrivals(host)
    whole = draw(rival.groups, camera)
    row: dict[str, float | None] = {}

    def quality(count: int) -> float:
        return float(psnr(draw([rival.groups[k] for _, k in came[:count]], camera), whole))

    for target in TARGETS:
        count = first_reaching(quality, len(came), target)
        if count is None:
            row[str(target)] = None
        else:
            row[str(target)] = came[count - 1][0] if count > 0 else 0.0
    return row


def draw(groups: list[Gaussians], camera: Cameras) -> np.ndarray:
    """Return the image of some groups of Gaussians."""
    if not groups:
        return np.zeros((camera.height, camera.width, 3), np.float32)
    image = rasterize(Gaussians.concatenate(groups), camera).images[0]
    return np.asarray(np.clip(image, 0.0, 1.0))


def asked_of(pose: dict[str, Any], up: tuple[float, ...]) -> str:
    """Return the query of a rival's page for a pose."""
    turn = rotations_from_quats(np.array([pose["rotation"]]))[0]
    to = np.array(pose["position"]) + 2.0 * turn[:, 2]
    return f"?eye={spell(pose['position'])}&target={spell(to)}&up={spell(up)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_arguments(parser)
    parser.add_argument("--package", help="folder of a package with visible sets")
    parser.add_argument("--scene", default="showroom/lod-meta.json", help="its scene, in the real data")
    parser.add_argument("--lod", type=int, default=3)
    parser.add_argument("--modules", type=Path, help="node_modules with playcanvas, three and @sparkjsdev/spark")
    parser.add_argument("--eyes", type=int, default=3)
    parser.add_argument("--visits", type=int, default=2)
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument("--links", type=float, nargs="+", default=[0.03, 30.0], help="delay and Mbit/s, in pairs")
    args = parser.parse_args()
    need(args.package, "--package, that `gsvis prepare` makes")
    need(args.modules, "--modules DIR: npm packages of the other engines")
    g = load_scene(realdata() / "scenes" / args.scene, lod=args.lod)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as made_in, Package.open(args.package) as package:
        work = Path(made_in)
        up = package.manifest.info.up
        rivals = {
            "PlayCanvas": playcanvas(work / "playcanvas", g, up, args.modules),
            "Spark": spark(work / "spark", g, args.modules),
        }
        ours = Ours.open(package, Path(write_site(work / "gsvis", package).path))
        views = drawn_views(package, ours.evaluator, args.eyes, args.seed)
        links = list(zip(args.links[::2], args.links[1::2], strict=True))
        with ExitStack() as stack:
            # hosts first: they need their own event loops
            hosts = {name: stack.enter_context(slow_host(rival.folder)) for name, rival in rivals.items()}
            hosts["gsvis"] = stack.enter_context(slow_host(ours.folder))
            browser = stack.enter_context(visits("chromium"))
            for link, view in itertools.product(links, views * args.visits):
                pose = view["pose"]
                found = {"gsvis": ours.visit(browser, hosts["gsvis"], pose, link)}
                camera = camera_of(pose, SIZE, WIDE)
                for name, rival in rivals.items():
                    found[name] = visit(browser, hosts[name], rival, asked_of(pose, up), camera, link)
                rows += [{"name": name, "delay": link[0], "rate": link[1], **row} for name, row in found.items()]
                print(found, flush=True)
    write_result(args.out, __doc__.splitlines()[0], figures_of(rows), {"visits": rows})


def figures_of(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the medians of each way on each link."""
    out: list[dict[str, Any]] = []
    for delay, rate in sorted({(row["delay"], row["rate"]) for row in rows}):
        for name in ("gsvis", "PlayCanvas", "Spark"):
            mine = [row for row in rows if (row["delay"], row["rate"], row["name"]) == (delay, rate, name)]
            out += summarize(f"{name}, {1000 * delay:.0f} ms, {rate:.0f} Mbit/s, eyes in cells", mine, LONGEST)
    return out


if __name__ == "__main__":
    main()
