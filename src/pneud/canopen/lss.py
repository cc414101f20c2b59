"""Layer setting services (LSS): nodes fresh from their boxes, and nodes that need another identifier.

Fastscan finds only nodes that have no identifier yet. Two that have the same one are told apart by their
serial numbers, which stand on them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pneud.canopen import objects
from pneud.canopen.objects import Command

ANSWER_S = 0.05  # for each bit of an identity that is a one, fastscan waits for nobody
_WAITING = 0

Identity = tuple[int, int, int, int]
"""Vendor, product, revision and serial number."""


class LssError(Exception):
    """No node has taken it; the text is one line for a person."""

    exit_code = 1


def scan(network: Any, told: Callable[[Identity], None] = lambda _: None, most: int = 127) -> list[Identity]:
    """The nodes that have no identifier yet.

    Args:
        network: of the library.
        told: of each as it is found, which takes seconds.
        most: how many at most.
    """
    lss = network.lss
    lss.RESPONSE_TIMEOUT = ANSWER_S
    found: list[Identity] = []
    while len(found) < most:
        there, identity = lss.fast_scan()
        if not there:
            break
        found.append(tuple(identity))
        told(found[-1])  # it is in configuration, and silent until all are told to wait
    lss.send_switch_state_global(_WAITING)
    return found


def give(network: Any, identity: Identity, node: int, *, before: int | None = None) -> None:
    """Give a node its identifier, and have it store that.

    Args:
        network: of the library.
        identity: of the one node that is meant.
        node: its identifier from now on.
        before: that it has had; it is reset by it, so that the other one holds.

    Raises:
        LssError: no such node answers, or it takes or keeps no identifier.
    """
    lss = network.lss
    lss.RESPONSE_TIMEOUT = max(ANSWER_S, 0.5)
    shown = ", ".join(f"{o.what} 0x{part:X}" for o, part in zip(objects.IDENTITY, identity, strict=True))
    lss.send_switch_state_global(_WAITING)
    try:
        if not lss.send_switch_state_selective(*identity):
            raise LssError(f"the node with {shown} answers otherwise than it should; see its manual on LSS")
    except _lss_error():
        raise LssError(
            f"no node with {shown} answers; see what stands on it, and whether it has LSS at all"
        ) from None
    try:
        lss.configure_node_id(node)
    except _lss_error() as e:
        raise LssError(f"the node with {shown} does not take the id {node}: {e}; choose another") from None
    try:
        lss.store_configuration()
    except _lss_error() as e:
        raise LssError(f"the node with {shown} does not store its id: {e}; set it at the device") from None
    finally:
        lss.send_switch_state_global(_WAITING)
    if before is not None:
        network.send_message(objects.NMT_ID, bytes((Command.RESET_COMMUNICATION, before)))


def _lss_error() -> type[Exception]:
    from canopen.lss import LssError as Theirs  # noqa: PLC0415

    found: type[Exception] = Theirs
    return found
