"""The viewer's page and its files, as they lie in `gsvis/viewer`: read once, sent with strict headers.

Clients can request only the files that were found there at the start; no text of a client becomes a path. A page may
load and ask nothing but this server and the origins that its operator names (Content-Security-Policy), and nothing in
it runs that is not a file of ours. Workers have a policy of their own: browsers take it from the answer with their
script, not from the page.
"""

from __future__ import annotations

import gzip
import hashlib
from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from gsvis.files.limits import read_whole
from gsvis.files.origins import connect_sources
from gsvis.serve.parts import is_known

__all__ = ["VIEWER", "Pages", "wants_page"]

VIEWER = Path(__file__).parents[1] / "viewer"
"""Folder of the built files of the viewer."""

_KINDS = {
    ".js": "text/javascript; charset=utf-8",
    ".ts": "text/plain; charset=utf-8",  # types of the module, for editors
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".json": "application/json",
    ".webmanifest": "application/manifest+json",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".ico": "image/x-icon",
    ".txt": "text/plain; charset=utf-8",
}
_STREAMED = b'<meta name="gsvis-streamed" content="true">\n    <title>'
_VIEW = "view.html"
_LEAST_PACKED = 1024  # bytes from which compression pays
_HTML = "text/html; charset=utf-8"

_STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:26rem;margin:20vh auto;padding:0 1rem;color-scheme:light dark}"
    "input,button{font:inherit;padding:.4rem .7rem}"
)
_STYLE_HASH = "'sha256-" + b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode() + "'"


@dataclass(frozen=True)
class _File:
    """A file of the viewer, ready to send."""

    data: bytes
    packed: bytes | None  # by gzip, where that is smaller
    tag: str
    kind: str


def wants_page(request: Request) -> bool:
    """Return whether a request prefers HTML over JSON: browsers that open an address do, programs do not."""
    best = {"text/html": 0.0, "application/json": 0.0}
    for entry in request.headers.get("accept", "").split(","):
        name, *details = (part.strip().lower() for part in entry.split(";"))
        weight = next((detail[2:].strip() for detail in details if detail.startswith("q=")), "1")
        if name in best:
            try:
                best[name] = max(best[name], float(weight))
            except ValueError:
                continue
    return best["text/html"] > best["application/json"]


class Pages:
    """The files of the viewer.

    Args:
        folder: Folder of the files, None for `VIEWER`; a missing one serves no page.
        origins: Origins whose pages may show the viewer in a frame.
        opens: Other origins that the viewer may read scenes from.
    """

    def __init__(self, folder: Path | None = None, origins: Sequence[str] = (), opens: Sequence[str] = ()) -> None:
        self._files: dict[str, _File] = {}
        at = VIEWER if folder is None else folder
        for path in sorted(at.iterdir()) if at.is_dir() else ():
            if path.suffix in _KINDS and not path.is_symlink() and path.is_file():
                self._files[path.name] = _file(read_whole(path), _KINDS[path.suffix])
        view = self._files.get(_VIEW)
        metas = _metas({"gsvis-origins": opens, "gsvis-embedders": origins})
        if view is not None and metas:
            view = self._files[_VIEW] = _file(view.data.replace(b"<title>", metas + b"<title>", 1), view.kind)
        self._streamed = None if view is None else _file(view.data.replace(b"<title>", _STREAMED, 1), view.kind)
        asks = f"connect-src {connect_sources(opens)}"
        frames = " ".join(["'self'", *(("*",) if "*" in origins else origins)])
        self._policy = "; ".join(
            [
                "default-src 'none'",
                "script-src 'self'",
                "worker-src 'self'",
                "style-src 'self'",
                "img-src 'self' data: blob:",
                asks,
                "manifest-src 'self'",
                "base-uri 'none'",
                "form-action 'none'",
                f"frame-ancestors {frames}",
            ]
        )
        self._script_policy = f"default-src 'none'; script-src 'self'; {asks}; base-uri 'none'; form-action 'none'"
        self._frames = frames

    def __contains__(self, name: str) -> bool:
        return name in self._files

    def page(self, request: Request, name: str) -> Response:
        """Answer with a page, under the strict policy; 503 where the viewer is not built."""
        found = self._files.get(name)
        if found is None:
            line = "the viewer is not built here: run `make viewer`, or install gsvis from a wheel\n"
            return PlainTextResponse(line, 503, {"cache-control": "no-store"})
        return self._with_policy(request, found)

    def view(self, request: Request, streamed: bool) -> Response:
        """Answer with the page of a scene, which says whether the scene is streamed: then the page need not ask."""
        if streamed and self._streamed is not None:
            return self._with_policy(request, self._streamed)
        return self.page(request, _VIEW)

    def _with_policy(self, request: Request, found: _File) -> Response:
        """Answer with a page, under the strict policy."""
        response = self._send(request, found)
        self._set_policy(response, self._policy)
        response.headers.add_vary_header("Accept")
        return response

    def file(self, request: Request, name: str) -> Response:
        """Answer with a file; browsers keep it and ask whether it has changed."""
        found = self._files.get(name)
        if found is None:
            return PlainTextResponse("no such file\n", 404)
        if name.endswith(".html"):
            return self._with_policy(request, found)
        response = self._send(request, found)
        if name.endswith(".js"):
            response.headers["content-security-policy"] = self._script_policy
        return response

    def _send(self, request: Request, found: _File) -> Response:
        """Answer with a file, compressed if the browser takes that; with 304 if the browser has it."""
        packed = found.packed if "gzip" in _codings(request) else None
        tag = f'"{found.tag}{"-gz" if packed else ""}"'
        headers = {
            "etag": tag,
            "cache-control": "no-cache",
            "vary": "Accept-Encoding",
            "x-content-type-options": "nosniff",
            "cross-origin-resource-policy": "same-origin",
        }
        if is_known(request, tag):
            return Response(status_code=304, headers=headers)
        if packed is not None:
            headers["content-encoding"] = "gzip"
        body = found.data if packed is None else packed
        headers["content-length"] = str(len(body))
        return Response(b"" if request.method == "HEAD" else body, 200, headers, found.kind)

    def enter(self, address: str) -> Response:
        """Answer with a page that goes on to an address of this server by itself.

        A redirect would not do: after one that began on another site, browsers hold a cookie of SameSite=Strict back.
        """
        at = escape(address, quote=True)
        head = f'<meta http-equiv="refresh" content="0; url={at}">'
        return self._small_page("Opening the viewer", f'<p><a href="{at}">Open the viewer</a></p>', head)

    def ask_token(self, fields: Iterable[tuple[str, str]] = ()) -> Response:
        """Answer with a page that asks for the token, and then asks this address again with these query fields."""
        kept = "".join(
            f'<input type="hidden" name="{escape(name)}" value="{escape(value)}">'
            for name, value in fields
            if name != "token"
        )
        form = (
            "<p>This server needs a token. Ask the person who runs it.</p>"
            f"<form>{kept}<label>Token "
            '<input name="token" type="password" autocomplete="current-password" autofocus required>'
            "</label> <button>Open</button></form>"
        )
        response = self._small_page("A token is needed", form, forms="'self'")
        response.status_code = 401
        response.headers["www-authenticate"] = "Bearer"
        return response

    def say(self, title: str, line: str, status: int) -> Response:
        """Answer with a page of one line, such as that a scene is not there."""
        response = self._small_page(title, f"<p>{escape(line)}</p>")
        response.status_code = status
        return response

    def _small_page(self, title: str, body: str, head: str = "", forms: str = "'none'") -> Response:
        """Return a page that is made here, without files."""
        text = (
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
            f'<meta name="viewport" content="width=device-width">{head}<style>{_STYLE}</style>'
            f"<body><h1>{escape(title)}</h1>{body}</body></html>"
        )
        response = Response(text, 200, {"cache-control": "no-store"}, _HTML)
        policy = f"default-src 'none'; style-src {_STYLE_HASH}; base-uri 'none'; form-action {forms}"
        self._set_policy(response, f"{policy}; frame-ancestors {self._frames}")
        response.headers["x-content-type-options"] = "nosniff"
        return response

    def _set_policy(self, response: Response, policy: str) -> None:
        """Add a policy, and headers that keep other sites out."""
        response.headers["content-security-policy"] = policy
        response.headers["referrer-policy"] = "no-referrer"
        response.headers["cross-origin-opener-policy"] = "same-origin"
        response.headers["permissions-policy"] = "camera=(), microphone=(), geolocation=(), payment=(), usb=()"


def _metas(named: dict[str, Sequence[str]]) -> bytes:
    """Return the elements that name origins to the page: those it may open, and those that may read it in a frame."""
    lines = [
        f'<meta name="{name}" content="{escape(" ".join(origins))}">\n    '
        for name, origins in named.items()
        if origins
    ]
    return "".join(lines).encode()


def _file(data: bytes, kind: str) -> _File:
    """Return a file, compressed where that pays."""
    packed = gzip.compress(data, 9, mtime=0) if len(data) >= _LEAST_PACKED else data
    small = packed if len(packed) < len(data) else None
    return _File(data, small, hashlib.sha256(data).hexdigest()[:32], kind)


def _codings(request: Request) -> set[str]:
    """Return the encodings that a client takes."""
    names = set()
    for entry in request.headers.get("accept-encoding", "").split(","):
        name, _, weight = entry.replace(" ", "").lower().partition(";q=")
        if weight not in ("0", "0.0", "0.00", "0.000"):
            names.add(name)
    return names
