"""Stop the axis, whoever commands it."""

from pneud.console.results import ask
from pneud.verbs import JsonOption, SocketOption


def stop(socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it."""
    return ask(socket, json, "stop")
