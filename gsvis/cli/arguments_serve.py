"""The arguments of `gsvis serve`; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli.readers import ADDRESSES, BYTES, COUNTED, HOSTS, ORIGINS, PACKAGES, PLAIN, PORT, SECONDS, WHOLE, hint

__all__ = ["Serve"]

Flag = Annotated[bool, PLAIN]
TABLES = arg(metavar="DIR", help_behavior_hint="(default: in GSVIS_CACHE, or in ~/.cache/gsvis)")


@dataclass(frozen=True)
class Serve:
    """Serve packages to viewers over WebSockets, until Ctrl-C."""

    package: Annotated[Positional[tuple[str, ...]], PACKAGES, arg(help_behavior_hint="")]
    """Folders of packages or worlds, such as scene.gsvis; each is served under its name, the first also without one."""
    host: Annotated[str, arg(metavar="HOST", help_behavior_hint="(default: 127.0.0.1)")] = "127.0.0.1"
    """Address to listen on. 127.0.0.1 accepts this machine only, 0.0.0.0 every machine."""
    port: Annotated[int, PORT] = 8765
    """Port; 0 takes one that is free."""
    token: Annotated[str | None, arg(metavar="TOKEN", help_behavior_hint="(default: GSVIS_TOKEN, or none)")] = None
    """Token that clients must send. Other users of this machine can see this option: prefer the environment."""
    ssl_certfile: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: no TLS)")] = None
    """Certificate chain (PEM) for TLS."""
    ssl_keyfile: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: in --ssl-certfile)")] = None
    """Its key (PEM)."""
    origins: Annotated[tuple[str, ...], ORIGINS, hint("its own address")] = ()
    """Allow web pages of these origins, such as https://example.org; * allows every page."""
    page_origins: Annotated[tuple[str, ...], ORIGINS, hint("its own address")] = ()
    """Other origins that the page may open scenes of, by ?content=, such as https://cdn.example.org; no token goes
    there."""
    hosts: Annotated[tuple[str, ...], HOSTS, hint("--host")] = ()
    """Names under which the server is reached, such as stream.example.org; .example.org is all below, * every name."""
    proxies: Annotated[tuple[str, ...], ADDRESSES, hint("none")] = ()
    """Addresses of trusted proxies, such as 127.0.0.1 or 10.0.0.0/8; the server believes their X-Forwarded-For."""
    policy: Annotated[Literal["utility", "fov-first", "low-first"], PLAIN] = "utility"
    """What is sent first. (default: utility)"""
    no_fill: Flag = False
    """Send only what a view needs: an idle link does not bring the rest of the scene."""
    coarse: Flag = False
    """Round records before they are sent: about 10 bytes a Gaussian instead of 14, at about 45 dB."""
    clients: Annotated[int, COUNTED] = 100
    """Most viewers at once."""
    per_address: Annotated[int | None, COUNTED, hint("half of --clients, at least 8")] = None
    """Most viewers of one address at once, and most other connections of it."""
    messages: Annotated[int, COUNTED] = 200
    """Most messages of a viewer a second, on average over ten seconds."""
    message_bytes: Annotated[int | None, BYTES, hint("what holdings of the largest scene take")] = None
    """Longest message of a viewer, such as 1MB."""
    poses: Annotated[int, COUNTED] = 60
    """Most poses of a viewer a second; the server ignores more."""
    handshake: Annotated[float, SECONDS] = 10.0
    """Time limit from a connection to HELLO, seconds."""
    keep_alive: Annotated[float, SECONDS] = 15.0
    """Time limit from an answer to the next request of a connection, seconds."""
    idle: Annotated[float, SECONDS] = 60.0
    """Disconnect a viewer after so many seconds of silence."""
    stall: Annotated[float, SECONDS] = 30.0
    """Disconnect a viewer that does not read for so many seconds."""
    cache: Annotated[int, BYTES, hint("512MB")] = 512_000_000
    """Memory limit for decoded cells, for each process."""
    tables: Annotated[str | None, TABLES] = None
    """Folder for tables that are computed once for each package and memory-mapped after that."""
    no_tables: Flag = False
    """Decode packages into memory at the start instead, and never close them."""
    tables_memory: Annotated[int, BYTES, hint("800MB")] = 800_000_000
    """Memory limit for mapped tables, for each process."""
    close: Annotated[float, SECONDS] = 600.0
    """Close a scene that nobody looks at for so many seconds; the next viewer opens it again."""
    workers: Annotated[int, COUNTED] = 1
    """Number of processes that serve on the one port; as many as cores serve most viewers."""
    planners: Annotated[int, WHOLE] = 0
    """Threads that plan what to send; 0 plans in the event loop."""
    log_format: Annotated[Literal["text", "json"], PLAIN] = "text"
    """Form of the log on stderr: lines for people, or one JSON object a line. (default: text)"""
    json: Flag = False
    """Print one JSON document with the address once it listens."""
    debug: Flag = False
    """Show the traceback of an error."""
