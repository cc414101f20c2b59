"""Who may look at the page, and who may command through it. Neither reads nor writes.

A page of another origin, and a name that leads here without being this place's, get nothing. Where only this
machine reaches the page, whoever does may look; elsewhere a cookie says that the password was given. Commands
need more: a key that only the page that was given the secret knows, and that no browser sends by itself.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections import OrderedDict
from collections.abc import Mapping
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import NamedTuple

from pneud.rt.addresses import in_url, is_loopback

_SESSIONS = 64
_PEERS = 256  # whose wrong tries are remembered
_PAUSE_S = 1.0  # behind a wrong try

Refusal = tuple[HTTPStatus, str]
"""An answer's status, and a line for whoever asked."""


class Place(NamedTuple):
    """Where the page is."""

    address: str
    port: int
    tls: bool = False
    names: tuple[str, ...] = ()  # by which others know it, beside its address

    @property
    def local(self) -> bool:
        """Whether only this machine reaches it."""
        return is_loopback(self.address)

    @property
    def url(self) -> str:
        """What a browser opens."""
        host = self.names[0] if self.names and not self.local else in_url(self.address)
        return f"{'https' if self.tls else 'http'}://{host}:{self.port}/"

    def is_here(self, host: str) -> bool:
        """Whether a Host names this place.

        Nobody can turn an address in numbers elsewhere; a name has to be known (DNS rebinding).
        """
        name, colon, port = host.rpartition(":")
        if not colon or name.endswith(":") or port.endswith("]"):
            name, port = host, "443" if self.tls else "80"
        if port != str(self.port):
            return False
        if name.lower() in (*self.names, *(("localhost",) if self.local else ())):
            return True
        try:
            found = ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
        except ValueError:
            return False
        return found.is_loopback or not self.local


class Session(NamedTuple):
    """Given to whoever knows the secret."""

    cookie: str  # lets a browser look
    key: str  # lets one page command


class Door:
    """The door of a place."""

    def __init__(self, place: Place, secret: str | None, operate: bool) -> None:
        """Begin with nobody.

        Args:
            place: where it is.
            secret: token or password; None where nobody needs one.
            operate: whoever knows it may command.
        """
        self.place = place
        self.operate = operate and secret is not None
        self._secret = secret
        self._sessions: OrderedDict[str, str] = OrderedDict()  # keys by cookies
        self._wrong: OrderedDict[str, float] = OrderedDict()  # when peers may try again
        self.cookie_name = "__Host-pneud" if place.tls else f"pneud-{place.port}"

    def refusal(self, headers: Mapping[str, list[str]]) -> Refusal | None:
        """Why a request is refused whatever it asks for; None for one that may go on."""
        hosts, origins = headers.get("host", []), headers.get("origin", [])
        if len(hosts) != 1 or not self.place.is_here(hosts[0]):
            return HTTPStatus.MISDIRECTED_REQUEST, "no such name here: pneud web --name NAME makes it known"
        own = f"{'https' if self.place.tls else 'http'}://{hosts[0]}"
        if any(origin != own for origin in origins):
            return HTTPStatus.FORBIDDEN, "pages of other places get nothing here"
        return None

    def may_look(self, headers: Mapping[str, list[str]]) -> bool:
        """Whether a request comes from whoever may see what runs."""
        if self.place.local:
            return True
        for said in headers.get("authorization", []):
            kind, _, value = said.partition(" ")
            if kind.lower() == "bearer" and self._is_secret(value):
                return True
        for said in headers.get("cookie", []):
            try:
                found = SimpleCookie(said).get(self.cookie_name)
            except CookieError:
                continue
            if found is not None and found.value in self._sessions:
                return True
        return False

    def may_command(self, key: object) -> bool:
        """Whether a page knows the key of a session."""
        if not self.operate or not isinstance(key, str):
            return False
        return any(hmac.compare_digest(key.encode(), known.encode()) for known in self._sessions.values())

    def enter(self, secret: object, peer: str, now_s: float) -> Session | Refusal:
        """A session for whoever knows the secret; a wrong try makes its peer wait."""
        if self._secret is None:
            return HTTPStatus.FORBIDDEN, "this page only shows: pneud web --operate lets it command"
        if now_s < self._wrong.get(peer, 0.0):
            return HTTPStatus.TOO_MANY_REQUESTS, "wait a second after a wrong try"
        if not isinstance(secret, str) or not self._is_secret(secret):
            self._wrong[peer] = now_s + _PAUSE_S
            self._wrong.move_to_end(peer)
            if len(self._wrong) > _PEERS:
                self._wrong.popitem(last=False)
            return HTTPStatus.UNAUTHORIZED, "that is not it"
        session = Session(secrets.token_urlsafe(24), secrets.token_urlsafe(24))
        self._sessions[session.cookie] = session.key
        if len(self._sessions) > _SESSIONS:
            self._sessions.popitem(last=False)
        return session

    def _is_secret(self, text: str) -> bool:
        known = (self._secret or "").encode()
        return bool(known) and hmac.compare_digest(text.encode(errors="replace"), known)
