"""A scene in a page of another origin: the element, its frame, what it may ask, and what it may not."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from gsvis.export import PageOptions, write_html, write_site, write_static
from gsvis.scene.procedural import two_rooms
from tests.serve.servers import PATIENCE, serving
from tests.stream.worlds import package_of
from tests.viewer.browser import chromium, page_in, viewer_files
from tests.viewer.page_server import TOUR

pytestmark = pytest.mark.slow
WAIT = 1000 * PATIENCE
SMALL: dict[str, Any] = {"viewport": {"width": 480, "height": 320}}
VIEW = "eye=1,1,1.5&to=3,2,1.2"
HOST = """<!doctype html><title>blog</title><script type="module" src="element.js"></script>
<style>gsvis-viewer { width: 400px; height: 240px }</style><body><script>
window.heard = [];
window.messages = [];
addEventListener("message", ({ data }) => messages.push(data));
window.show = (attributes) => {
    const element = document.createElement("gsvis-viewer");
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    for (const name of ["ready", "progress", "pose", "pick", "hotspot", "animation", "error"])
        element.addEventListener(name, ({ detail }) => heard.push([name, detail]));
    document.body.append(element);
    window.scene = element;
};
window.names = () => heard.map(([name]) => name);
window.why = (work) => work.then(() => "", (error) => error.message);
</script>"""


class _Quiet(SimpleHTTPRequestHandler):
    extensions_map = {**SimpleHTTPRequestHandler.extensions_map, ".js": "text/javascript"}

    def log_message(self, format: str, *args: object) -> None:
        pass

    def end_headers(self) -> None:
        if self.path.endswith("strict.html"):
            self.send_header("content-security-policy", self.policy)
        super().end_headers()

    policy = ""


@contextmanager
def hosting(folder: Path) -> Iterator[str]:
    """Serve a folder without any header of isolation, as a blog does."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """Address of a site of a scene, and of a page of another origin; the site names nobody."""
    chromium(), viewer_files()
    made, blog = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("blog")
    scene = two_rooms(1500, sh_degree=0).gaussians
    write_site(made, scene)
    write_html(made / "one.html", scene)
    shutil.copy(viewer_files() / "element.js", blog / "element.js")
    for name in ("index.html", "strict.html"):
        (blog / name).write_text(HOST if name == "index.html" else STRICT)
    (blog / "host.js").write_text(HOST.split("<body><script>")[1].removesuffix("</script>"))
    with hosting(made) as site, hosting(blog) as other:
        _Quiet.policy = f"default-src 'none'; script-src 'self'; frame-src {site}"
        (made / "read").mkdir()
        write_site(made / "read", scene, page=PageOptions(embedders=(other,)))
        yield site, other


STRICT = """<!doctype html><title>blog</title><script type="module" src="element.js"></script>
<body><script src="host.js"></script>"""


def wait(page: Any, what: str) -> None:
    page.wait_for_function(f"() => {what}", timeout=WAIT)  # a policy lets pages ask a function again, not a text


def pose(page: Any) -> Any:
    return page.evaluate("heard.findLast(([name]) => name === 'pose')[1]")


def test_a_page_of_another_origin_flies_hears_and_projects_and_may_not_read(browser: Any, pages: Any) -> None:
    site, other = pages
    with page_in(browser, f"{other}/index.html", **SMALL) as (page, said):
        page.evaluate(
            "args => show(args)",
            {"src": f"{site}/", "eye": "1,1,1.5", "to": "3 2 1.2", "mode": "fly", "noui": "", "quality": "low"},
        )
        wait(page, "names().includes('ready') && heard.some(([, x]) => x?.state === 'complete')")
        assert {"pose", "progress", "ready"} <= set(page.evaluate("names()"))
        assert "quality=low" in page.frames[1].url
        page.evaluate("scene.budget = 1000")
        found = pose(page)
        assert (found["eye"], found["mode"]) == ([1, 1, 1.5], "fly")
        middle = page.evaluate("scene.project([3, 2, 1.2])")
        assert (round(middle["x"]), round(middle["y"])) == (200, 120)
        assert page.evaluate("scene.project([-30, -20, 1.2])") is None
        page.evaluate("scene.flyTo({eye: [2, 1, 1.4]}, {jump: true})")
        wait(page, "heard.findLast(([name]) => name === 'pose')[1].eye[0] === 2")
        page.evaluate("scene.eye = [1.5, 1, 1.4]")
        wait(page, "Math.abs(heard.findLast(([name]) => name === 'pose')[1].eye[0] - 1.5) < 1e-6")
        assert "this page has none" in page.evaluate("why(scene.play())")
        for asked in ("scene.screenshot()", "scene.pick(200, 120)"):
            assert "may read the scene" in page.evaluate(f"why({asked})")
        page.frames[1].locator("canvas").first.click(position={"x": 200, "y": 120})
        assert "view: expected" in page.evaluate("why(scene.flyTo({eye: [1, 2], to: 3}))")
        assert "pick" not in page.evaluate("names()")
        assert [line for line in said if "favicon" not in line and "404" not in line] == []


def test_a_page_around_it_plays_seeks_and_pauses_the_animation(browser: Any, pages: Any) -> None:
    site, other = pages
    with page_in(browser, f"{other}/index.html", **SMALL) as (page, _):
        page.route("**/tour.json", lambda route: route.fulfill(json=TOUR, headers={"access-control-allow-origin": "*"}))
        page.evaluate("args => show(args)", {"src": f"{site}/?settings=tour.json&noanim#{VIEW}", "noui": ""})
        wait(page, "heard.some(([name]) => name === 'animation')")
        first = page.evaluate("heard.find(([name]) => name === 'animation')[1]")
        assert first == {"playing": False, "seconds": 0, "duration": 8, "loops": "repeat"}
        wait(page, "names().includes('ready')")
        page.evaluate("scene.seek(2)")
        wait(page, "heard.findLast(([name]) => name === 'animation')[1].seconds === 2")
        wait(page, "Math.abs(heard.findLast(([name]) => name === 'pose')[1].eye[0] - 5) < 1e-6")
        page.evaluate("scene.play()")
        wait(page, "(([, now]) => now.playing && now.seconds > 2)(heard.findLast(([name]) => name === 'animation'))")
        page.evaluate("scene.pause()")
        wait(page, "!heard.findLast(([name]) => name === 'animation')[1].playing")
        assert "seconds: expected" in page.evaluate("why(scene.seek('x'))")


def test_an_embedder_that_the_site_names_reads_pictures_and_picks(browser: Any, pages: Any) -> None:
    site, other = pages
    with page_in(browser, f"{other}/index.html", **SMALL) as (page, _):
        page.evaluate("args => show(args)", {"src": f"{site}/read/#{VIEW}"})
        wait(page, "names().includes('ready') && heard.some(([, x]) => x?.state === 'complete')")
        head = page.evaluate(
            "scene.screenshot().then((blob) => blob.arrayBuffer()).then((all) => [...new Uint8Array(all, 0, 4)])"
        )
        assert bytes(head) == b"\x89PNG"
        found = page.evaluate("scene.pick(200, 120)")
        assert found is None or len(found["position"]) == 3
        page.frames[1].locator("canvas").first.click(position={"x": 200, "y": 120})
        wait(page, "names().includes('pick')")


def test_a_sandboxed_frame_shows_a_page_in_one_file(browser: Any, pages: Any) -> None:
    site, other = pages
    with page_in(browser, f"{other}/index.html", **SMALL) as (page, _):
        page.evaluate("args => show(args)", {"src": f"{site}/one.html#{VIEW}", "sandbox": "allow-scripts"})
        wait(page, "names().includes('ready')")
        page.evaluate("scene.flyTo({eye: [2, 1, 1.4]}, {jump: true})")
        wait(page, "heard.findLast(([name]) => name === 'pose')[1].eye[0] === 2")
        assert "may read the scene" in page.evaluate("why(scene.screenshot())")


def test_the_element_works_under_a_strict_policy_of_its_host(browser: Any, pages: Any) -> None:
    site, other = pages
    with page_in(browser, f"{other}/strict.html", **SMALL) as (page, said):
        shown = "args => (show(args), new Promise((done) => scene.addEventListener('ready', () => done(1))))"
        assert page.evaluate(shown, {"src": f"{site}/#{VIEW}"}) == 1
        assert [line for line in said if "Policy" in line] == []
        assert page.evaluate("scene.getBoundingClientRect().height") >= 150


ASK = """([name, ...args]) => new Promise((done) => {
    const id = window.next = (window.next ?? 0) + 1;
    addEventListener("message", ({data}) => {
        if (data.gsvis === "answer" && data.id === id) done(data.error ?? data.value);
    });
    frames[0].postMessage({gsvis: "ask", id, name, args}, "*");
})"""
FRAME = """source => new Promise((done) => {
    const frame = document.createElement("iframe");
    frame.onload = () => done();
    if (source.startsWith("http")) frame.src = source;
    else frame.srcdoc = source;
    document.body.append(frame);
})"""


def test_a_plain_frame_hears_its_parent_alone_and_opens_what_it_may_open(browser: Any, pages: Any) -> None:
    site, other = pages
    ready = "messages.some(({name}) => name === 'ready')"
    with page_in(browser, f"{other}/index.html", **SMALL) as (page, _):
        page.evaluate(FRAME, f"{site}/#{VIEW}")
        wait(page, "messages.some(({name}) => name === 'here')")
        page.evaluate(ASK, ["listen"])
        wait(page, ready)
        page.evaluate(FRAME, "<p>brother")
        page.frames[2].evaluate("""parent.frames[0].postMessage(
            {gsvis: 'ask', id: 1, name: 'flyTo', args: [{eye: [9, 9, 9]}, {jump: true}]}, '*')""")
        middle = page.evaluate(ASK, ["project", [3, 2, 1.2]])  # is answered behind that message
        box = page.frames[1].evaluate("[innerWidth / 2, innerHeight / 2]")
        assert [round(middle["x"]), round(middle["y"])] == [round(each) for each in box]
        assert "expected listen" in page.evaluate(ASK, ["constructor"])
        assert "may open" in page.evaluate(ASK, ["load", "http://127.0.0.1:9/scene/"])
        assert page.frames[1].url.startswith(f"{site}/#")
        page.evaluate("messages.length = 0")
        page.evaluate(ASK, ["load", "scene/"])
        wait(page, "messages.some(({name}) => name === 'here')")
        page.evaluate(ASK, ["listen"])
        wait(page, ready)
        assert "content=" in page.frames[1].url


def test_load_shows_another_page_and_ends_with_its_first_picture(browser: Any, pages: Any) -> None:
    site, other = pages
    with page_in(browser, f"{other}/index.html", **SMALL) as (page, _):
        page.evaluate("args => show(args)", {"src": f"{site}/#{VIEW}"})
        wait(page, "names().includes('ready')")
        page.evaluate("args => scene.load(args)", f"{site}/one.html")
        assert page.frames[1].url.startswith(f"{site}/one.html")


def test_the_token_of_a_server_is_in_no_message(browser: Any, pages: Any, tmp_path: Path) -> None:
    _, other = pages
    package_of(tmp_path / "scene.gsvis", 800, stores=False).close()
    with serving(tmp_path / "scene.gsvis", token="secret-of-a-server", origins=(other,)) as server:
        at = server.url.replace("ws", "http", 1).replace("/stream", "") + "/view/scene?token=secret-of-a-server"
        with page_in(browser, f"{other}/index.html", **SMALL) as (page, _):
            page.evaluate("args => show(args)", {"src": at})
            wait(page, "names().includes('ready')")
            assert page.evaluate("scene.screenshot().then((blob) => blob.size)") > 100  # --origins names its readers
            assert "secret" not in page.evaluate("JSON.stringify([heard, messages])")


def test_a_bare_scene_is_shown_by_the_page_of_the_package(browser: Any, tmp_path: Path) -> None:
    shutil.copytree(viewer_files(), tmp_path / "lib")
    (tmp_path / "index.html").write_text(HOST.replace("element.js", "lib/element.js"))
    write_static(tmp_path / "scene", two_rooms(1500, sh_degree=0).gaussians)
    with hosting(tmp_path) as address, page_in(browser, f"{address}/index.html", **SMALL) as (page, _):
        page.evaluate("args => show(args)", {"src": "scene/scene.json"})
        wait(page, "names().includes('ready')")
        assert page.evaluate("scene.screenshot().then((blob) => blob.size)") > 100  # its own origin reads


def test_a_scene_that_does_not_come_is_an_error_and_a_poster_stays_until_a_picture(browser: Any, pages: Any) -> None:
    site, other = pages
    dot = "data:image/gif;base64,R0lGODlhAQABAIAAAP///wAAACH5BAEAAAAALAAAAAABAAEAAAICRAEAOw=="
    with page_in(browser, f"{other}/index.html", **SMALL) as (page, _):
        page.evaluate("args => show(args)", {"src": f"{site}/?content=none/", "poster": dot})
        wait(page, "names().includes('error')")
        assert page.evaluate("scene.poster.startsWith('data:')")
        assert "scene.json" in page.evaluate("heard.findLast(([name]) => name === 'error')[1].message")
