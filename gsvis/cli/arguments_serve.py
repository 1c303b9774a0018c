"""The arguments of `gsvis serve`; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli.readers import ADDRESSES, BYTES, COUNTED, HOSTS, ORIGINS, PACKAGES, PLAIN, PORT, SECONDS, WHOLE, hint

__all__ = ["Serve"]

Flag = Annotated[bool, PLAIN]


@dataclass(frozen=True)
class Serve:
    """Serve packages to viewers over WebSockets, until Ctrl-C."""

    package: Annotated[Positional[tuple[str, ...]], PACKAGES, arg(help_behavior_hint="")]
    """Folders of packages, such as scene.gsvis; each is served under its name, the first also without one."""
    host: Annotated[str, arg(metavar="HOST", help_behavior_hint="(default: 127.0.0.1)")] = "127.0.0.1"
    """Address to listen on. The default is reached from this machine alone; 0.0.0.0 from everywhere."""
    port: Annotated[int, PORT] = 8765
    """Port; 0 takes one that is free."""
    token: Annotated[str | None, arg(metavar="TOKEN", help_behavior_hint="(default: GSVIS_TOKEN, or none)")] = None
    """What clients have to show. Other users of this machine can see it here: the environment is the better place."""
    ssl_certfile: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: no TLS)")] = None
    """Certificate chain (PEM) for TLS."""
    ssl_keyfile: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: in --ssl-certfile)")] = None
    """Its key (PEM)."""
    origins: Annotated[tuple[str, ...], ORIGINS, hint("its own address")] = ()
    """Web pages of these origins may stream, too, such as https://example.org; * is every page."""
    hosts: Annotated[tuple[str, ...], HOSTS, hint("--host")] = ()
    """Names under which the server is reached, such as stream.example.org; .example.org is all below, * every name."""
    proxies: Annotated[tuple[str, ...], ADDRESSES, hint("none")] = ()
    """Addresses of proxies in front, such as 127.0.0.1 or 10.0.0.0/8; what they say of viewers is believed."""
    policy: Annotated[Literal["utility", "fov-first", "low-first"], PLAIN] = "utility"
    """What is sent first. (default: utility)"""
    clients: Annotated[int, COUNTED] = 100
    """Most viewers at once."""
    per_address: Annotated[int | None, COUNTED, hint("half of --clients, at least 8")] = None
    """Most viewers of one address at once, and most other connections of it."""
    messages: Annotated[int, COUNTED] = 200
    """Most messages of a viewer a second, on average over ten seconds."""
    message_bytes: Annotated[int | None, BYTES, hint("what holdings of the largest scene take")] = None
    """Longest message of a viewer, such as 1MB."""
    poses: Annotated[int, COUNTED] = 60
    """Poses of a viewer a second that are looked at."""
    handshake: Annotated[float, SECONDS] = 10.0
    """Seconds in which a viewer has to say hello."""
    keep_alive: Annotated[float, SECONDS] = 15.0
    """Seconds from an answer to the next request of a connection."""
    idle: Annotated[float, SECONDS] = 60.0
    """Seconds of silence after which a viewer is gone."""
    stall: Annotated[float, SECONDS] = 30.0
    """Seconds after which one that does not read what was sent is sent away."""
    cache: Annotated[int, BYTES, hint("512MB")] = 512_000_000
    """Most memory for what is decoded for cells, beside the records."""
    planners: Annotated[int, WHOLE] = 0
    """Threads that plan what to send; 0 plans where the sockets are."""
    log_format: Annotated[Literal["text", "json"], PLAIN] = "text"
    """Form of the log on stderr: lines for people, or one JSON object a line. (default: text)"""
    json: Flag = False
    """Print one JSON document with the address once it listens."""
    debug: Flag = False
    """Show the traceback of an error."""
