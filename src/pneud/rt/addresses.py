"""Addresses of this machine that programs listen at."""

from __future__ import annotations

import ipaddress
import os
import socket

_BACKLOG = 32


class AddressError(Exception):
    """It is no address, or cannot be listened at; says why, and the cure."""


def parsed(where: str, example: str, least_port: int = 1) -> tuple[str, int]:
    """Host and port of ADDRESS:PORT.

    Raises:
        AddressError: it is none.
    """
    host, colon, port = where.rpartition(":")
    if not colon or not host or not port.isdecimal() or not least_port <= int(port) < 65536:
        raise AddressError(f"must be ADDRESS:PORT, such as {example}")
    return host.strip("[]"), int(port)


def listening(host: str, port: int, *, both: bool = False) -> socket.socket:
    """A socket that listens.

    Args:
        host: address or name.
        port: 0 for any.
        both: an address of version 6 takes callers of version 4, too.

    Raises:
        AddressError: it cannot.
    """
    six = ":" in host
    try:
        return socket.create_server(
            (host, port),
            family=socket.AF_INET6 if six else socket.AF_INET,
            backlog=_BACKLOG,
            dualstack_ipv6=six and both,
        )
    except (OSError, UnicodeError, OverflowError) as e:
        why = "no such name"
        if isinstance(e, OSError):  # names that are none have numbers below 0; else Python adds the address
            number = e.errno or 0
            why = os.strerror(number) if number > 0 else str(e.strerror)
        raise AddressError(f"cannot listen there: {why}; name another") from None


def is_loopback(address: str) -> bool:
    """Whether only this machine reaches an address."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


def in_url(address: str) -> str:
    """An address as it stands in a URL."""
    return f"[{address}]" if ":" in address else address
