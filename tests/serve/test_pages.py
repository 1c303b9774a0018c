"""The viewer's page and its files: who gets them, under which headers, and how a token leaves the address."""

from __future__ import annotations

import gzip
import json
import re
import shutil
from pathlib import Path
from urllib.parse import urljoin

import pytest

from gsvis.serve import pages
from gsvis.stream import Hello
from tests.serve.servers import VIEW, ask, close_code, heard, serving

PAGE = "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"
TOKEN = "s3cret-word"
SCRIPT = "export const many = 1;\n" * 200

STREAMED = '<meta name="gsvis-streamed" content="true">\n    '


@pytest.fixture
def viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Files that stand for the built ones."""
    folder = tmp_path / "viewer"
    folder.mkdir()
    for name, text in (
        ("list.html", "<!doctype html><title>list</title>"),
        ("view.html", "<!doctype html><title>view</title>"),
        ("page.js", SCRIPT),
        ("secret.py", "raise SystemExit"),
    ):
        (folder / name).write_text(text)
    (folder / "linked.js").symlink_to(tmp_path / "elsewhere.js")
    (tmp_path / "elsewhere.js").write_text("1")
    monkeypatch.setattr(pages, "VIEWER", folder)
    return folder


def cookie_of(fields: dict[str, str]) -> str:
    """What a browser sends back."""
    return fields["set-cookie"].partition(";")[0]


def test_browsers_get_pages_and_all_others_json(plain: Path, viewer: Path) -> None:
    with serving(plain) as server:
        status, fields, body = ask(server, "/", Accept=PAGE)
        assert (status, fields["content-type"], body) == (
            200,
            "text/html; charset=utf-8",
            b"<!doctype html><title>list</title>",
        )
        for headers in ({}, {"Accept": "*/*"}, {"Accept": "application/json"}, {"Accept": "text/html;q=x"}):
            status, fields, body = ask(server, "/", **headers)
            assert (status, fields["content-type"], "accept" in fields["vary"]) == (200, "application/json", True)
        (row,) = json.loads(body)["scenes"]
        assert (row["view"], row["stream"], row["static"]) == ("view/plain", "stream/plain", None)
        assert ask(server, "/" + row["view"])[2] == f"<!doctype html>{STREAMED}<title>view</title>".encode()
        status, fields, body = ask(server, "/view/none<b>", Accept=PAGE)
        assert (status, b"<b>" in body, b"none&lt;b&gt;" in body) == (404, False, True)


def test_addresses_of_a_scene_are_percent_encoded_and_lead_to_it(plain: Path, viewer: Path, tmp_path: Path) -> None:
    scene = tmp_path / "a b%ü.gsvis"
    shutil.copytree(plain, scene)
    with serving(scene) as server:
        (row,) = json.loads(ask(server, "/")[2])["scenes"]
        assert (row["name"], row["view"], row["manifest"]) == (
            "a b%ü", "view/a%20b%25%C3%BC", "packages/a%20b%25%C3%BC/manifest.json",
        )  # fmt: skip
        assert [ask(server, "/" + row[kind])[0] for kind in ("view", "manifest")] == [200, 200]


def test_a_page_can_load_and_ask_nothing_but_this_server(plain: Path, viewer: Path) -> None:
    with serving(plain, origins=("https://friend.example",)) as server:
        for path, status in (("/", 200), ("/view/plain", 200), ("/view/none", 404)):
            found, fields, _ = ask(server, path, Accept=PAGE)
            policy = dict(part.strip().partition(" ")[::2] for part in fields["content-security-policy"].split(";"))
            assert (found, policy["default-src"], policy["base-uri"]) == (status, "'none'", "'none'")
            assert policy["frame-ancestors"] == "'self' https://friend.example"
            assert "unsafe" not in fields["content-security-policy"]
            assert (fields["x-content-type-options"], fields["referrer-policy"]) == ("nosniff", "no-referrer")
            if status == 200:
                assert policy["script-src"] == policy["worker-src"] == policy["connect-src"] == "'self'"


def test_only_files_of_the_viewer_are_sent(plain: Path, viewer: Path) -> None:
    with serving(plain) as server:
        for name in (
            "secret.py",
            "linked.js",
            "none.js",
            "..%2fsecret.py",
            "../serve/app.py",
            "%2e%2e/app.py",
            ".",
            "",
        ):
            assert ask(server, f"/viewer/{name}")[0] == 404
        status, fields, body = ask(server, "/viewer/page.js")
        assert (status, body.decode(), fields["content-type"]) == (200, SCRIPT, "text/javascript; charset=utf-8")
        assert fields["cache-control"] == "no-cache"
        assert ask(server, "/viewer/page.js", If_None_Match=fields["etag"])[0] == 304
        status, packed, body = ask(server, "/viewer/page.js", Accept_Encoding="br, gzip")
        assert (gzip.decompress(body).decode(), packed["content-encoding"]) == (SCRIPT, "gzip")
        assert packed["etag"] != fields["etag"]
        assert "content-encoding" not in ask(server, "/viewer/page.js", Accept_Encoding="gzip;q=0")[1]
        status, fields, body = ask(server, "/viewer/page.js", method="HEAD")
        assert (status, int(fields["content-length"]), body) == (200, len(SCRIPT), b"")


@pytest.mark.parametrize("name", ["scan #1 100%", "a?b&c", "日本 café", "%41+b"])
def test_addresses_of_any_name_are_encoded(plain: Path, tmp_path: Path, name: str) -> None:
    shutil.copytree(plain, tmp_path / name)
    with serving(tmp_path / name) as server:
        (row,) = json.loads(ask(server, "/")[2])["scenes"]
        assert row["name"] == name
        for key in ("view", "stream", "manifest"):
            assert re.fullmatch(r"[A-Za-z0-9._~%/-]+", row[key]), row[key]
        assert ask(server, urljoin("/", row["manifest"]))[0] == 200


def test_a_viewer_that_is_not_built_says_how(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "VIEWER", tmp_path / "none")
    with serving(plain) as server:
        status, _, body = ask(server, "/", Accept=PAGE)
        assert (status, b"make viewer" in body) == (503, True)
        assert ask(server, "/")[0] == 200


def test_a_token_leaves_the_address_for_a_cookie(plain: Path, viewer: Path) -> None:
    with serving(plain, token=TOKEN) as server:
        status, fields, body = ask(server, "/view/plain", Accept=PAGE)
        assert (status, fields["www-authenticate"], b'type="password"' in body) == (401, "bearer", True)
        assert ask(server, f"/view/plain?token={TOKEN}x", Accept=PAGE)[0] == 401
        status, fields, _ = ask(server, f"/view/plain?content=a%26b&token={TOKEN}", Accept=PAGE)
        assert (status, "set-cookie" in fields) == (303, False)
        place = urljoin("/view/plain", fields["location"])
        status, fields, body = ask(server, place, Accept=PAGE)
        assert (status, fields["referrer-policy"], fields["cache-control"]) == (200, "no-referrer", "no-store")
        (to,) = re.findall(r"url=([^\"]*)\"", body.decode())
        assert to == "view/plain?content=a%26b"
        cookie = cookie_of(fields)
        assert TOKEN not in fields["set-cookie"] + body.decode()
        assert fields["set-cookie"].partition("; ")[2] == "httponly; samesite=strict"
        for path in ("/", "/" + to, "/viewer/page.js", "/packages/plain/manifest.json", "/metrics"):
            assert ask(server, path, Cookie=cookie)[0] == 200
            assert ask(server, path, Cookie=cookie[:-1])[0] == 401
            assert ask(server, path, Cookie=cookie, Authorization="Bearer wrong")[0] == 401
    with serving(plain, token=TOKEN) as server:  # the same after a restart, so that pages reconnect
        assert ask(server, "/", Cookie=cookie)[0] == 200
    with serving(plain, token=TOKEN + "2") as server:
        assert ask(server, "/", Cookie=cookie)[0] == 401


def test_a_cookie_counts_only_for_pages_of_this_server(plain: Path, viewer: Path) -> None:
    from websockets.sync.client import connect

    with serving(plain, token=TOKEN, origins=("https://friend.example",)) as server:
        cookie = cookie_of(ask(server, f"/?token={TOKEN}", Accept=PAGE)[1])
        own = f"http://127.0.0.1:{server.port}"
        for headers, status in (
            ({}, 200), ({"Sec-Fetch-Site": "same-origin"}, 200), ({"Sec-Fetch-Site": "none"}, 200),
            ({"Sec-Fetch-Site": "same-site"}, 401), ({"Sec-Fetch-Site": "cross-site"}, 401),
            ({"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "navigate"}, 200),
            ({"Origin": "http://127.0.0.1:1"}, 401), ({"Origin": "https://friend.example"}, 401),
        ):  # fmt: skip
            assert ask(server, "/packages/plain/manifest.json", Cookie=cookie, **headers)[0] == status, headers
        for origin, kind in ((own, 129), ("https://friend.example", 131)):
            headers = {"Cookie": cookie, "Origin": origin, "Sec-Fetch-Site": "same-origin"}
            with connect(server.url, additional_headers=headers, proxy=None) as ws:
                ws.send(Hello(VIEW).to_bytes())
                assert heard(ws)[0] == kind
                assert kind == 129 or close_code(ws) == 1008


def test_a_cookie_is_for_tls_alone_where_the_proxy_has_it(plain: Path, viewer: Path) -> None:
    with serving(plain, token=TOKEN, proxies=("127.0.0.1",)) as server:
        place = f"/?token={TOKEN}"
        assert "; secure" in ask(server, place, Accept=PAGE, X_Forwarded_Proto="https")[1]["set-cookie"]
        assert "; secure" not in ask(server, place, Accept=PAGE)[1]["set-cookie"]
    with serving(plain, token=TOKEN) as server:  # nobody else is believed
        assert "; secure" not in ask(server, place, Accept=PAGE, X_Forwarded_Proto="https")[1]["set-cookie"]


def test_the_form_for_a_token_keeps_the_scene_and_runs_nothing(plain: Path, viewer: Path) -> None:
    with serving(plain, token=TOKEN) as server:
        status, _, body = ask(server, f"/?token={TOKEN}x&scene=plain&noui=%22%3E%3Cscript%3E", Accept=PAGE)
    text = body.decode()
    assert status == 401
    assert re.findall(r'<input type="hidden" name="([^"]*)" value="([^"]*)">', text) == [
        ("scene", "plain"),
        ("noui", "&quot;&gt;&lt;script&gt;"),
    ]
    assert TOKEN not in text
    assert "<script" not in text


@pytest.mark.parametrize("scene", ["//evil.example", "https://evil.example", '"><script>', "..", "other"])
def test_nobody_is_sent_elsewhere(plain: Path, viewer: Path, scene: str) -> None:
    from urllib.parse import quote

    with serving(plain, token=TOKEN) as server:
        body = ask(server, f"/?token={TOKEN}&scene={quote(scene, safe='')}", Accept=PAGE)[2].decode()
        assert re.findall(r"url=([^\"]*)\"", body) == ["./"]
        assert "script" not in body


def test_pages_of_allowed_origins_may_read(plain: Path, viewer: Path) -> None:
    friend = {"Origin": "https://friend.example"}
    preflight = {"Access-Control-Request-Method": "GET", "Access-Control-Request-Headers": "authorization, range"}
    paths = ("/", "/packages/plain/manifest.json", "/viewer/page.js", "/scenes/plain/cells")
    with serving(plain, token=TOKEN, origins=("https://friend.example",)) as server:
        for path in paths:
            status, fields, _ = ask(server, path, "OPTIONS", **friend, **preflight)
            assert (status, fields["access-control-allow-origin"]) == (204, "https://friend.example")
            assert {"authorization", "range"} <= set(fields["access-control-allow-headers"].split(", "))
            status, fields, _ = ask(server, path, **friend, Authorization=f"Bearer {TOKEN}")
            assert (status, fields["access-control-allow-origin"]) == (200, "https://friend.example")
            assert "origin" in fields["vary"]
            assert "access-control-allow-credentials" not in fields
            for other in ({}, {"Origin": "https://evil.example"}, {"Origin": "null"}):
                fields = ask(server, path, **other, Authorization=f"Bearer {TOKEN}")[1]
                assert ("access-control-allow-origin" in fields, "origin" in fields["vary"]) == (False, True)
            assert ask(server, path, "OPTIONS", Origin="https://evil.example", **preflight)[0] == 403
        private = {"Access-Control-Request-Private-Network": "true"}
        assert (
            "access-control-allow-private-network" in ask(server, "/", "OPTIONS", **friend, **preflight, **private)[1]
        )
        assert ask(server, "/metrics", "OPTIONS", **friend, **preflight)[0] == 405
        assert ask(server, "/", "OPTIONS", Host="evil.example", **friend, **preflight)[0] == 421
    with serving(plain, origins=("*",)) as server:
        assert ask(server, "/", **friend)[1]["access-control-allow-origin"] == "*"
        assert ask(server, "/")[1]["access-control-allow-origin"] == "*"
    with serving(plain) as server:
        assert ask(server, "/", "OPTIONS", **friend, **preflight)[0] == 403
        assert "access-control-allow-origin" not in ask(server, "/", **friend)[1]
