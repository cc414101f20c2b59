"""Where viewers of a run find it."""

from __future__ import annotations

import importlib.util
import ipaddress
import secrets
import socket
from typing import NamedTuple
from urllib.parse import quote

from pneud.config.sections import ConfigError
from pneud.view.admission import VIEWERS, Admission, is_origin

FOXGLOVE = "https://app.foxglove.dev/~/view"


class ViewersPlace(NamedTuple):
    """An address that viewers come to."""

    listener: socket.socket
    admission: Admission
    note: str  # what a person must know in order to look
    url: str

    @property
    def link(self) -> str:
        """What a browser opens; empty where that would tell somebody else's server the token."""
        if self.admission.token is not None:
            return ""
        return f"{FOXGLOVE}?ds=foxglove-websocket&ds.url={quote(self.url, safe='')}"


def viewers_place(where: str, origins: tuple[str, ...]) -> ViewersPlace:
    """Listen for viewers; an address that other machines may reach asks for a token, made here.

    Args:
        where: ADDRESS:PORT.
        origins: of pages elsewhere that may look.

    Raises:
        ConfigError: it is none, or taken, or an origin is none, or the package that serves is missing.
    """
    host, colon, port = where.rpartition(":")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"--live-at {where}: must be ADDRESS:PORT, such as 127.0.0.1:8765")
    for origin in origins:
        if not is_origin(origin):
            raise ConfigError(f"--live-origin {origin}: must be as browsers say it, https://example.org")
    if importlib.util.find_spec("foxglove") is None:
        raise ConfigError("--live needs foxglove-sdk; install it with: pip install 'pneud[live]'")
    listener = _listen(host.strip("[]"), int(port), where)
    address = listener.getsockname()[0]
    if ipaddress.ip_address(address.partition("%")[0]).is_loopback:
        url = f"ws://{_in_url(address)}:{port}"
        return ViewersPlace(listener, Admission(None, VIEWERS.union(origins)), f"viewers look at {url}", url)
    token = secrets.token_urlsafe(16)
    url = f"ws://{_reachable(address)}:{port}/?token={token}"
    return ViewersPlace(listener, Admission(token, VIEWERS.union(origins)), f"viewers look at {url}", url)


def _listen(host: str, port: int, where: str) -> socket.socket:
    six = ":" in host
    try:
        return socket.create_server(
            (host, port), family=socket.AF_INET6 if six else socket.AF_INET, backlog=32, dualstack_ipv6=six
        )
    except (OSError, UnicodeError) as e:
        why = e.strerror if isinstance(e, OSError) else "no such name"
        raise ConfigError(f"--live-at {where}: cannot listen there: {why}; name another") from None


def _reachable(address: str) -> str:
    """What stands in the URL: this machine's name where it listens at all of its addresses."""
    if ipaddress.ip_address(address.partition("%")[0]).is_unspecified:
        return socket.gethostname()
    return _in_url(address)


def _in_url(address: str) -> str:
    return f"[{address}]" if ":" in address else address
