"""Which broker, and what it takes to be let in."""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from pneud.rt.addresses import in_url, is_loopback
from pneud.rt.passwords import first_line

_PORTS = {"mqtt": 1883, "mqtts": 8883}


class BrokerError(Exception):
    """There can be no such broker; the text is one line for a person."""

    exit_code = 2


class Broker(NamedTuple):
    """A broker."""

    host: str
    port: int
    tls: ssl.SSLContext | None = None
    user: str | None = None
    password: str | None = None

    @property
    def url(self) -> str:
        """As a person reads it."""
        return f"mqtt{'s' if self.tls else ''}://{in_url(self.host)}:{self.port}"


def broker_of(
    url: str,
    user: str | None = None,
    password: str | None = None,
    ca: Path | None = None,
    certificate: Path | None = None,
    key: Path | None = None,
    *,
    plain: bool = False,
) -> Broker:
    """The broker that was asked for.

    Args:
        url: mqtt://HOST, or mqtts://HOST for TLS, each with a port or without.
        user: who is to be let in.
        password: his.
        ca: certificates that vouch for the broker, where those of the system do not.
        certificate: of this client, where the broker asks for one.
        key: its key.
        plain: send a password without TLS.

    Raises:
        BrokerError: it is none, or what was given does not go together.
        OSError: a file cannot be read, or is none.
    """
    try:
        found = urlsplit(url)
        port = found.port
    except ValueError:
        found, port = urlsplit(""), None
    host = found.hostname or ""
    if found.username is not None or found.password is not None:
        raise BrokerError("--broker: others see a password there; --user and PNEUD_MQTT_PASSWORD are for it")
    if found.scheme not in _PORTS or not host or found.path.strip("/") or found.query or found.fragment:
        raise BrokerError(f"--broker {url}: must be mqtt://HOST or mqtts://HOST, such as mqtts://plant:8883")
    tls = found.scheme == "mqtts"
    if not tls and (ca or certificate or key):
        raise BrokerError(f"--broker {url}: certificates are for TLS: mqtts://{in_url(host)}")
    if (certificate is None) != (key is None):
        raise BrokerError("--tls-cert and --tls-key belong together")
    if password is not None and user is None:
        raise BrokerError("a password needs --user")
    if password is not None and not (tls or plain or _is_here(host)):
        raise BrokerError(
            f"--broker {url}: the password could be read on the way; mqtts://{host}, or --plain"
        )
    context = _context(ca, certificate, key) if tls else None
    return Broker(host, port or _PORTS[found.scheme], context, user, password)


def _is_here(host: str) -> bool:
    try:
        return is_loopback(host)
    except ValueError:
        return host == "localhost"


def _context(ca: Path | None, certificate: Path | None, key: Path | None) -> ssl.SSLContext:
    """Raises OSError."""
    for path in (ca, certificate, key):
        if path is not None:
            path.open("rb").close()
    try:
        context = ssl.create_default_context(cafile=ca)
    except ssl.SSLError:
        raise OSError(None, "no certificate in it", str(ca)) from None
    if certificate is not None:
        try:
            context.load_cert_chain(certificate, key, lambda: "")
        except (ssl.SSLError, ValueError):
            why = "no certificate with its key beside it; a key with a passphrase cannot be used"
            raise OSError(None, why, str(certificate), None, str(key)) from None
    return context


def password_of(path: Path) -> str:
    """The password in the first line of a file that is its owner's alone.

    Raises:
        BrokerError: others may read it, or it is empty.
        OSError: it cannot be read.
    """
    found = first_line(path, BrokerError)
    if not found:
        raise BrokerError(f"{path}: its first line is empty")
    return found
