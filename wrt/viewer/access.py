"""Who may reach the viewer: the token, and the values of Host and Origin, that a request must carry.

The token stands in the address that is printed, and then in the path of the page (`/TOKEN/`), from which viser's page makes the
address of its WebSocket. It is no cookie: a browser sends those to every port of a host, so that a server of another user of the
machine would get it.
"""

from __future__ import annotations

import hmac
import re
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qsl, urlencode

from wrt.core.errors import InputError

LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
ORIGIN = re.compile(r"(https?)://([a-z0-9._-]+|\[[0-9a-f:.]+\])(?::([1-9][0-9]{0,4}))?/?")
PORTS = {"http": 80, "https": 443}  # which a browser leaves out of an origin


class Refused(Exception):
    """A request that is not answered; `about` names its kind, the message is for the one who started the viewer."""

    def __init__(self, about: str, message: str) -> None:
        super().__init__(message)
        self.about = about


@dataclass(frozen=True)
class Access:
    """What a request must carry. origins: such as "http://127.0.0.1:8080"; the values of Host that go with them are taken. port:
    where the server listens."""

    origins: frozenset[str]
    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    def check(self, hosts: Sequence[str], origins: Sequence[str], address: str) -> None:
        """Raise Refused unless the values of the headers Host and Origin are this viewer's. address: the local one that the
        connection came to: as a number, it cannot be a name that somebody pointed here."""
        own = self.origins | {origin_of("http", as_host(address), self.port)}
        if len(hosts) != 1 or hosts[0] not in {origin.partition("//")[2] for origin in own}:
            raise Refused("host", f"a request for {shown(hosts)}, which is not this viewer; --allow-origin would let it in")
        if origins and (len(origins) != 1 or origins[0] not in own):
            raise Refused("origin", f"a request by a page of {shown(origins)}; --allow-origin would let it in")

    def inside(self, target: str) -> tuple[str, str]:
        """Where a request's target leads: a path without the token; and the address, relative to it, where it has to ask again,
        or "". Raises Refused unless it carries the token, as the first part of its path or as `?token=`."""
        path, _, query = target.partition("?")
        first, slash, rest = path[1:].partition("/")
        if path.startswith("/") and self._is_token(first):
            return "/" + rest, "" if slash else self._page(query)
        pairs = parse_qsl(query, keep_blank_values=True)
        tokens = [value for name, value in pairs if name == "token"]
        if path.startswith("/") and len(tokens) == 1 and self._is_token(tokens[0]):
            others = [pair for pair in pairs if pair[0] != "token"]
            return path, self._page(urlencode(others)) if path == "/" else ""
        raise Refused("token", "a request without the token of the printed address")

    def _page(self, query: str) -> str:
        """Relative to the root, which a proxy may have put elsewhere."""
        return f"{self.token}/" + (f"?{query}" if query else "")

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode("utf-8", "replace"), self.token.encode())


@dataclass(frozen=True)
class Place:
    """The address that the viewer listens on. host: 127.0.0.1 is for this machine only, 0.0.0.0 for all that reach it; port: 0 is
    any free one; allow_origins: further addresses under which browsers find it, such as "https://example.org" of a proxy. Raises
    InputError for an origin that is none."""

    host: str = "127.0.0.1"
    port: int = 8080
    allow_origins: Iterable[str] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "allow_origins", tuple(as_origin(text) for text in self.allow_origins))


HERE = Place()


def access_for(place: Place, address: str, port: int) -> tuple[Access, str]:
    """The access to a server, and the address to print. address, port: where the server listens."""
    where = ip_address(address.partition("%")[0])
    names = {as_host(address), as_host(place.host.lower())}
    home = as_host(address)
    if where.is_unspecified:  # every address of this machine
        names, home = set(LOOPBACK), LOOPBACK[0] if where.version == 4 else LOOPBACK[2]
    elif where.is_loopback:
        names |= set(LOOPBACK)
    origins = {origin_of("http", name, port) for name in names} | set(place.allow_origins)
    access = Access(frozenset(origins), port)
    return access, f"{origin_of('http', home, port)}/?token={access.token}"


def as_host(address: str) -> str:
    """As it stands in a URL."""
    return f"[{address}]" if ":" in address else address


def origin_of(scheme: str, host: str, port: int) -> str:
    """As a browser writes it."""
    return f"{scheme}://{host}" + ("" if port == PORTS[scheme] else f":{port}")


def as_origin(text: str) -> str:
    """The origin that a user wrote, as a browser writes it. Raises InputError where it is none."""
    match = ORIGIN.fullmatch(text.lower())
    port = 0 if match is None else int(match[3] or PORTS[match[1]])
    if match is None or port > 65535:
        raise InputError(f"{text!r} is no origin", hint="write one such as https://example.org or http://localhost:9000")
    return origin_of(match[1], match[2], port)


def shown(values: Any) -> str:
    """What a stranger sent, for a line of a message."""
    text = ", ".join(map(repr, values)) if isinstance(values, list) else repr(values)
    text = text or "no name"
    return text if len(text) <= 60 else text[:57] + "..."
