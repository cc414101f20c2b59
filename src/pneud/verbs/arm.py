"""Engage the axis and hold where it is."""

from pneud.console.results import ask
from pneud.verbs import JsonOption, SocketOption


def arm(socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it."""
    return ask(socket, json, "arm")
