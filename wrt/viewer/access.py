"""Access to the viewer: every request must carry the token, and a Host and an Origin of this viewer.

The printed address has the path `/TOKEN/`, from which the page derives the address of its WebSocket. The token is no cookie, because a
browser sends cookies to every port of a host, also to another user's server.
"""

import hmac
import re
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from ipaddress import ip_address

from wrt.core.errors import InputError

LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
ORIGIN = re.compile(r"(https?)://([a-z0-9._-]+|\[[0-9a-f:.]+\])(?::([1-9][0-9]{0,4}))?/?")
PORTS = {"http": 80, "https": 443}  # default ports, which browsers leave out of an origin


class Refused(Exception):
    """A refused request or message. kind: key of the refusal; each key is reported once. message: for the user that started the viewer."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


@dataclass(frozen=True)
class Access:
    """The token and the addresses that requests must carry."""

    origins: frozenset[str]  # allowed values of Origin, such as "http://127.0.0.1:8080"; their hosts are the allowed values of Host
    port: int  # of the server
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    def check(self, hosts: Sequence[str], origins: Sequence[str], address: str) -> None:
        """Raise Refused unless the headers Host (one value) and Origin (at most one value) name this viewer.

        address: the connection's local IP address, which may also be the host. The check prevents DNS rebinding, which needs a name."""
        own = self.origins | {origin_of("http", as_host(address), self.port)}
        if len(hosts) != 1 or hosts[0] not in {origin.partition("//")[2] for origin in own}:
            raise Refused("host", f"a request for the host {shown(hosts)}, which is not this viewer; --allow-origin can allow it")
        if origins and (len(origins) != 1 or origins[0] not in own):
            raise Refused("origin", f"a request by a page of the origin {shown(origins)}; --allow-origin can allow it")

    def strip_token(self, target: str) -> str:
        """Return the path of a request without the token and the query. Raises Refused unless the path begins with the token.

        target: path and query of the request."""
        token, slash, rest = target.partition("?")[0][1:].partition("/")
        known = hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode())
        if not (target.startswith("/") and slash and known):
            raise Refused("token", "a request without the token of the printed address")
        return "/" + rest


@dataclass(frozen=True)
class Place:
    """The address that the viewer listens on. Raises InputError for an invalid origin."""

    host: str = "127.0.0.1"  # this machine only; 0.0.0.0: all machines that can reach this machine
    port: int = 8080  # 0: a free port
    allow_origins: Iterable[str] = ()  # further origins under which browsers reach the viewer, such as "https://example.org"

    def __post_init__(self) -> None:
        object.__setattr__(self, "allow_origins", tuple(as_origin(text) for text in self.allow_origins))


HERE = Place()


def access_for(place: Place, address: str, port: int) -> tuple[Access, str]:
    """Return the Access of a server that listens at `address` and `port`, and the viewer's URL with the token."""
    ip = ip_address(address.partition("%")[0])
    names = {as_host(address), as_host(place.host.lower())}
    home = as_host(address)
    if ip.is_unspecified:  # the server listens at every address of this machine
        names, home = set(LOOPBACK), LOOPBACK[0] if ip.version == 4 else LOOPBACK[2]
    elif ip.is_loopback:
        names |= set(LOOPBACK)
    access = Access(frozenset(origin_of("http", name, port) for name in names) | frozenset(place.allow_origins), port)
    return access, f"{origin_of('http', home, port)}/{access.token}/"


def as_host(address: str) -> str:
    """Return an IP address or a host name in the form of URLs: IPv6 addresses in brackets."""
    return f"[{address}]" if ":" in address else address


def origin_of(scheme: str, host: str, port: int) -> str:
    """Return an origin as browsers write it: without the scheme's default port."""
    return f"{scheme}://{host}" + ("" if port == PORTS[scheme] else f":{port}")


def as_origin(text: str) -> str:
    """Return a user's origin as browsers write it. Raises InputError for text that is no origin."""
    match = ORIGIN.fullmatch(text.lower())
    port = 0 if match is None else int(match[3] or PORTS[match[1]])
    if match is None or port > 65535:
        raise InputError(f"{text!r} is no origin", hint="write one such as https://example.org or http://localhost:9000")
    return origin_of(match[1], match[2], port)


def shown(value: object) -> str:
    """Return a value from a client as text of at most 60 characters, for a message."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
