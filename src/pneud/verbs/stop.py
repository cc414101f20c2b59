"""Stop the axis, and all where there are several, whoever commands them."""

from pneud.console.results import ask
from pneud.verbs import JsonOption, SocketOption


def stop(socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it."""
    return ask(socket, json, "stop")
