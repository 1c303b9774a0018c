"""Find the address of a client behind proxies, and check the host names of requests.

Addresses are text, as the socket gives them. An IPv6 host usually has its own /64 network, so a /64 counts as one.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple
from urllib.parse import urlsplit

__all__ = ["Client", "Proxies", "is_known_host", "owner_of"]


def owner_of(address: str) -> str:
    """Return what counts as one address: an IPv4 address itself, the /64 network of an IPv6 address.

    Examples:
        >>> owner_of("10.1.2.3"), owner_of("2001:db8::1:2"), owner_of("::ffff:10.1.2.3")
        ('10.1.2.3', '2001:db8::/64', '10.1.2.3')
    """
    found = _parse(address)
    if found is None:
        return address
    if isinstance(found, ipaddress.IPv6Address):
        return str(ipaddress.ip_network((found, 64), strict=False))
    return str(found)


class Client(NamedTuple):
    """Where a client is.

    Attributes:
        address: Its address.
        owner: Its address or network, for limits per address; see `owner_of`.
    """

    address: str
    owner: str

    @classmethod
    def at(cls, address: str) -> Client:
        """Return the client at an address."""
        return cls(address, owner_of(address))


def _parse(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return an address, IPv4 for one that is mapped into IPv6; None if the text is no address."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return None
    mapped = found.ipv4_mapped if isinstance(found, ipaddress.IPv6Address) else None
    return mapped or found


@dataclass(frozen=True)
class Proxies:
    """Proxies whose X-Forwarded-For header is trusted.

    Attributes:
        names: Addresses or networks, such as "127.0.0.1" or "10.0.0.0/8".

    Raises:
        ValueError: If a name is neither an address nor a network.

    Examples:
        >>> proxies = Proxies(("127.0.0.1",))
        >>> proxies.client_of("127.0.0.1", ["6.6.6.6, 10.1.2.3"]), proxies.client_of("10.9.9.9", ["1.2.3.4"])
        ('10.1.2.3', '10.9.9.9')
    """

    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in self.names:
            try:
                ipaddress.ip_network(name, strict=False)
            except ValueError:
                raise ValueError(f"proxies: expected an address or a network, got {name!r}") from None

    def __contains__(self, address: str) -> bool:
        found = _parse(address)
        return found is not None and any(found in ipaddress.ip_network(name, strict=False) for name in self.names)

    def client_of(self, peer: str, forwarded: Sequence[str]) -> str:
        """Return the address of a client: that of the socket, or the one that trusted proxies report.

        Args:
            peer: Address of the socket.
            forwarded: Values of X-Forwarded-For; each proxy appends the address of its own peer.
        """
        client = peer
        entries = [entry.strip() for value in forwarded for entry in value.split(",")]
        while entries and client in self:
            entry = _bare(entries.pop())
            if _parse(entry) is None:
                break  # "unknown", or invalid: keep the last valid address
            client = entry
        return client


def _bare(entry: str) -> str:
    """Return an address without port and brackets."""
    if entry.startswith("["):
        return entry[1:].partition("]")[0]
    return entry.partition(":")[0] if entry.count(":") == 1 else entry


def is_known_host(host: str, names: Iterable[str]) -> bool:
    """Return whether a server accepts a request with this Host header.

    A page can make its own name point to this server (DNS rebinding), so names must be known. Addresses are always
    accepted, because nobody can make an address point elsewhere.

    Args:
        host: Value of the header, with or without port.
        names: Known names; "*" means every name, ".example.org" every name below example.org.

    Examples:
        >>> [is_known_host(host, ["me.example"]) for host in ("me.example:80", "[::1]:80", "localhost", "evil.example")]
        [True, True, True, False]
    """
    known = [name.lower().rstrip(".") for name in names]
    if "*" in known:
        return True
    try:
        parts = urlsplit(f"//{host}")
        name = (parts.hostname or "").rstrip(".")
        _ = parts.port
    except ValueError:
        return False
    if not name or parts.username is not None or parts.path or parts.query or parts.fragment:
        return False
    if _parse(name) is not None or name == "localhost" or name.endswith(".localhost"):
        return True
    return any(name == entry or (entry.startswith(".") and name.endswith(entry)) for entry in known)
