"""Where viewers of a run find it."""

from __future__ import annotations

import ipaddress
import secrets
import socket
from typing import NamedTuple
from urllib.parse import quote

from pneud.config.sections import ConfigError
from pneud.rt.addresses import AddressError, in_url, is_loopback, listening, parsed
from pneud.rt.extras import require
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
        ConfigError: it is none, or taken, or an origin is none.
        ExtraError: the library that serves is missing.
    """
    try:
        host, port = parsed(where, "127.0.0.1:8765")
    except AddressError as e:
        raise ConfigError(f"--live-at {where}: {e}") from None
    for origin in origins:
        if not is_origin(origin):
            raise ConfigError(f"--live-origin {origin}: must be as browsers say it, https://example.org")
    require("--live", "live")
    try:
        listener = listening(host, port, both=True)
    except AddressError as e:
        raise ConfigError(f"--live-at {where}: {e}") from None
    address = listener.getsockname()[0]
    if is_loopback(address):
        url = f"ws://{in_url(address)}:{port}"
        return ViewersPlace(listener, Admission(None, VIEWERS.union(origins)), f"viewers look at {url}", url)
    token = secrets.token_urlsafe(16)
    url = f"ws://{_reachable(address)}:{port}/?token={token}"
    return ViewersPlace(listener, Admission(token, VIEWERS.union(origins)), f"viewers look at {url}", url)


def _reachable(address: str) -> str:
    """What stands in the URL: this machine's name where it listens at all of its addresses."""
    if ipaddress.ip_address(address.partition("%")[0]).is_unspecified:
        return socket.gethostname()
    return in_url(address)
