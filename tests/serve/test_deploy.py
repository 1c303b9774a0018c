"""The files of examples/deploy: a viewer streams through nginx with TLS and a prefix; the unit starts what there is."""

from __future__ import annotations

import json
import logging
import re
import shlex
import shutil
import ssl
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urljoin

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from gsvis.serve import ClientConfig, Limits, Server
from tests.serve.nginx import GUARD_S, NGINX, free_port, nginx
from tests.serve.servers import ask, has_all, patient, serving

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "examples" / "deploy"
OPENSSL = shutil.which("openssl")

needs_nginx = pytest.mark.skipif(NGINX is None or OPENSSL is None, reason="needs nginx, and openssl for a certificate")


def certificate(folder: Path) -> tuple[Path, Path]:
    """A chain and its key, for 127.0.0.1."""
    chain, key = folder / "chain.pem", folder / "key.pem"
    subprocess.run(
        [
            *(str(OPENSSL), "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=127.0.0.1"),
            *("-addext", "subjectAltName=IP:127.0.0.1", "-keyout", str(key), "-out", str(chain)),
        ],
        check=True, capture_output=True,
    )  # fmt: skip
    return chain, key


def site(text: str, changes: dict[str, str]) -> str:
    """The site of the example, with what an operator puts in."""
    for old, new in changes.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


@contextmanager
def proxied(server: Server, folder: Path, **changes: str) -> Iterator[tuple[str, ssl.SSLContext]]:
    """nginx in front of a server: "127.0.0.1:PORT", and who trusts its certificate."""
    chain, key = certificate(folder)
    port = free_port()
    text = site(
        (DEPLOY / "nginx.conf").read_text(),
        {
            "listen 443 ssl;": f"listen 127.0.0.1:{port} ssl;",
            "server_name scenes.example.org;": "server_name 127.0.0.1;",
            "/etc/letsencrypt/live/scenes.example.org/fullchain.pem": str(chain),
            "/etc/letsencrypt/live/scenes.example.org/privkey.pem": str(key),
            "http://127.0.0.1:8765/;": f"http://127.0.0.1:{server.port}/;",
            **changes,
        },
    )
    with nginx(folder, text, port):
        yield f"127.0.0.1:{port}", ssl.create_default_context(cafile=str(chain))


def fetched(url: str, tls: ssl.SSLContext) -> tuple[int, bytes]:
    """Status and body of a GET."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=tls))
    try:
        with opener.open(url, timeout=GUARD_S) as answer:
            return answer.status, answer.read()
    except HTTPError as error:
        return error.code, error.read()


@needs_nginx
def test_a_viewer_streams_through_a_proxy_with_tls_and_a_prefix(plain: Path, tmp_path: Path) -> None:
    with serving(plain, limits=Limits(), token="s3cret") as server, proxied(server, tmp_path) as (place, tls):
        for name in ("", "/plain"):
            config = ClientConfig(token="s3cret", tls=tls)
            client, _ = patient(f"wss://{place}/scenes/stream{name}", plain, seconds=GUARD_S, config=config)
            assert has_all(client.receiver, plain)
        page = {"Origin": f"https://{place}"}  # as a browser on the page of the same address sends it
        url = f"wss://{place}/scenes/stream?token=s3cret"
        with connect(url, ssl=tls, additional_headers=page, proxy=None, open_timeout=GUARD_S):
            pass


@needs_nginx
@pytest.mark.parametrize(
    ("line", "status"),
    [("proxy_set_header Host $http_host;", 101), ("proxy_set_header Upgrade $http_upgrade;", 404)],
)
def test_without_a_line_it_fails_as_the_readme_says(
    plain: Path, tmp_path: Path, line: str, status: int, caplog: pytest.LogCaptureFixture
) -> None:
    with (
        caplog.at_level(logging.WARNING, logger="gsvis.serve"),
        serving(plain, limits=Limits()) as server,
        proxied(server, tmp_path, **{line: ""}) as (place, tls),
    ):
        page = {"Origin": f"https://{place}"}
        url = f"wss://{place}/scenes/stream"
        if status == 404:
            with pytest.raises(InvalidStatus) as caught:
                connect(url, ssl=tls, additional_headers=page, proxy=None)
            assert caught.value.response.status_code == status
        else:
            with connect(url, ssl=tls, additional_headers=page, proxy=None) as ws:
                assert b"may not stream from here" in ws.recv(timeout=GUARD_S)
            (said,) = (record.getMessage() for record in caplog.records if "reason=origin" in record.getMessage())
            for part in (f"https://{place}", f"127.0.0.1:{server.port}", "pass Host on"):
                assert part in said


@needs_nginx
def test_addresses_of_the_index_lead_to_what_they_name_under_a_prefix(plain: Path, tmp_path: Path) -> None:
    with serving(plain, limits=Limits(), proxies=("127.0.0.1",)) as server, proxied(server, tmp_path) as (place, tls):
        base = f"https://{place}/scenes/"
        (row,) = json.loads(fetched(base, tls)[1])["scenes"]
        assert fetched(urljoin(base, row["manifest"]), tls) == (200, (plain / "manifest.json").read_bytes())
        stream = urljoin(base, row["stream"]).replace("https:", "wss:", 1)
        client, _ = patient(stream, plain, seconds=GUARD_S, config=ClientConfig(tls=tls))
        assert has_all(client.receiver, plain)
        assert fetched(f"https://{place}/scenes", tls)[1] == fetched(base, tls)[1]
        assert fetched(base + "healthz", tls)[0] == 200
        assert fetched(base + "metrics", tls)[0] == 403
        assert ask(server, "/metrics")[0] == 200
        assert fetched(f"https://{place}/", tls)[0] == 404  # nothing but the prefix is passed on


def test_addresses_of_the_index_lead_to_what_they_name_without_a_proxy(plain: Path) -> None:
    with serving(plain, limits=Limits()) as server:
        (row,) = json.loads(ask(server, "/")[2])["scenes"]
        assert ask(server, urljoin("/", row["manifest"]))[0] == 200
        assert urljoin(server.url, row["stream"]) == f"{server.url}/plain"
        assert ask(server, "/healthz/")[0] == 404  # a redirect would name the server without the prefix


def test_the_unit_starts_a_command_that_there_is() -> None:
    lines = dict(re.findall(r"^(\w+)=(.*)$", (DEPLOY / "gsvis.service").read_text(), re.MULTILINE))
    command = shlex.split(lines["ExecStart"])
    assert [Path(command[0]).name, command[1]] == ["gsvis", "serve"]
    help_text = (ROOT / "docs" / "cli.md").read_text().partition("help: gsvis serve -->")[2].partition("<!-- /help")[0]
    known = re.findall(r"^  (--[a-z-]+)", help_text, re.MULTILINE)
    options = [word for word in command if word.startswith("--")]
    assert options
    assert set(options) <= set(known)


def test_the_readme_speaks_of_what_is_there() -> None:
    text, config = (DEPLOY / "README.md").read_text(), (DEPLOY / "nginx.conf").read_text()
    for name in ("nginx.conf", "gsvis.service"):
        assert name in text
        assert (DEPLOY / name).is_file()
    for line in ("proxy_set_header Host $http_host", "proxy_read_timeout"):
        assert line in text
        assert line in config


STUBS = {
    "python3": 'test "$1 $2" = "-m venv" && mkdir -p "$3/bin" && ln -s /bin/true "$3/bin/pip"',
    "systemctl": "true",
    "nginx": "true",
    "openssl": "echo 0123abcd",
}


def test_the_commands_of_the_readme_work_on_a_fresh_machine(tmp_path: Path) -> None:
    root, work, stubs = tmp_path / "root", tmp_path / "work", tmp_path / "stubs"
    for folder in ("opt", "srv", "etc/systemd/system", "etc/nginx/sites-available", "etc/nginx/sites-enabled"):
        (root / folder).mkdir(parents=True)  # Debian with systemd and nginx has them
    (work / "scene.gsvis" / "parts").mkdir(parents=True)
    (work / "scene.gsvis" / "manifest.json").write_text("{}")
    for name in ("nginx.conf", "gsvis.service"):
        shutil.copy(DEPLOY / name, work)
    stubs.mkdir()
    for name, line in STUBS.items():
        (stubs / name).write_text(f"#!/bin/sh\n{line}\n")
        (stubs / name).chmod(0o755)
    block = (DEPLOY / "README.md").read_text().partition("```sh\n")[2].partition("```")[0]
    script = re.sub(r"(?<= )/(?=opt/|srv/|etc/)", f"{root}/", block)
    done = subprocess.run(
        ["sh", "-eux"], input=script, cwd=work, env={"PATH": f"{stubs}:/usr/bin:/bin"}, text=True, capture_output=True,
        timeout=GUARD_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (root / "srv/gsvis/scene.gsvis/manifest.json").is_file()
    assert (root / "etc/gsvis/serve.env").read_text() == "GSVIS_TOKEN=0123abcd\n"
    assert (root / "etc/gsvis/serve.env").stat().st_mode & 0o777 == 0o600
    for path in ("etc/systemd/system/gsvis.service", "etc/nginx/sites-enabled/gsvis"):
        assert "your-name.example" in (root / path).read_text()
        assert "scenes.example.org" not in (root / path).read_text()
