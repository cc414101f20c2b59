"""Who may look at a run: what a viewer's first words must say before it is let through.

Nothing here reads or writes: heads of HTTP requests go in, refusals come out.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
from collections.abc import Iterable
from http import HTTPStatus
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

VIEWERS = frozenset({"https://app.foxglove.dev", "https://studio.foxglove.dev", "file://"})
"""Origins of Foxglove's pages, and of desktop applications, which Electron loads from files."""

_REQUEST = re.compile(rb"GET ([\x21-\x7e]+) HTTP/1\.1")
_FIELD = re.compile(rb"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([^\x00-\x08\x0a-\x1f\x7f]*?)[ \t]*")


Refusal = tuple[HTTPStatus, str]
"""An answer's status, and a line for whoever asked."""


class Admission(NamedTuple):
    """What is asked of whoever wants to look."""

    token: str | None = None  # None where only this machine reaches the address
    origins: frozenset[str] = VIEWERS  # of pages that may look, beside those of this machine

    def refusal(self, head: bytes) -> Refusal | None:
        """Why a request is refused, by its head with its empty line; None for one that may pass."""
        first, *lines = head.removesuffix(b"\r\n\r\n").split(b"\r\n")
        request, fields = _REQUEST.fullmatch(first), [_FIELD.fullmatch(line) for line in lines]
        if request is None or None in fields:
            return HTTPStatus.BAD_REQUEST, "this is no request for a WebSocket"
        said = [(f[1].lower(), f[2].decode("latin-1")) for f in fields if f is not None]
        if not any(name == b"upgrade" and value.lower() == "websocket" for name, value in said):
            return HTTPStatus.UPGRADE_REQUIRED, "viewers connect here by WebSocket"
        for name, origin in said:
            if name == b"origin" and origin not in self.origins and not _of_this_machine(origin):
                return HTTPStatus.FORBIDDEN, "pages of this origin may not look: pneud --live-origin ORIGIN"
        if self.token is not None and not self._knows_token(request[1].decode("ascii"), said):
            return HTTPStatus.UNAUTHORIZED, "the URL needs the token that pneud has told at its start"
        return None

    def _knows_token(self, target: str, said: Iterable[tuple[bytes, str]]) -> bool:
        try:
            tokens = parse_qs(urlsplit(target).query, max_num_fields=100).get("token", [])
        except ValueError:
            return False
        tokens += [value[7:] for name, value in said if (name, value[:7]) == (b"authorization", "Bearer ")]
        wanted = (self.token or "").encode()
        return any(hmac.compare_digest(token.encode(errors="replace"), wanted) for token in tokens)


def is_origin(text: str) -> bool:
    """Whether a browser could send this as the origin of a page."""
    return re.fullmatch(r"[a-z][a-z0-9+.-]*://[\x21-\x2e\x30-\x7e]*", text) is not None


def _of_this_machine(origin: str) -> bool:
    try:
        url = urlsplit(origin)
        host = url.hostname or ""
        if url.scheme not in ("http", "https") or f"{url.scheme}://{url.netloc}" != origin:
            return False
        return host == "localhost" or host.endswith(".localhost") or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
