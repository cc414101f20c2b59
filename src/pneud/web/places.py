"""Where the page is to be: an address that is free, and what it takes to be seen from elsewhere."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import NamedTuple

from pneud.rt.addresses import AddressError, listening, parsed
from pneud.rt.passwords import first_line
from pneud.web.admission import Place

SHORTEST = 12  # letters of a password


class ListenError(Exception):
    """The page cannot be there; the text is one line for a person."""

    exit_code = 2


class Listener(NamedTuple):
    """A socket that listens."""

    socket: socket.socket
    place: Place


def listen(where: str, tls: bool, names: tuple[str, ...]) -> Listener:
    """Take an address.

    Args:
        where: ADDRESS:PORT; port 0 for any.
        tls: there is a certificate.
        names: by which others know it.

    Raises:
        ListenError: it is none, or taken, or others reach it without a certificate.
    """
    try:
        listener = listening(*parsed(where, "127.0.0.1:8770", least_port=0))
    except AddressError as e:
        raise ListenError(f"--listen {where}: {e}") from None
    address, bound = listener.getsockname()[:2]
    place = Place(address, bound, tls, tuple(name.lower() for name in names))
    if not place.local and not tls:
        listener.close()
        raise ListenError(
            f"--listen {where}: others reach it: give --tls-cert, --tls-key and --password-file, or go"
            " through a tunnel: ssh -L 8770:localhost:8770 HOST"
        )
    return Listener(listener, place)


def password_of(path: Path) -> str:
    """The password in the first line of a file that is its owner's alone.

    Raises:
        ListenError: others may read it, or it is too short.
        OSError: it cannot be read.
    """
    found = first_line(path, ListenError).strip()
    if len(found) < SHORTEST:
        raise ListenError(f"{path}: a password has {SHORTEST} letters at least")
    return found
