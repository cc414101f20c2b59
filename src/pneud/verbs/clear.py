"""Clear latched faults whose causes are gone."""

from pneud.console.results import ask
from pneud.verbs import JsonOption, SocketOption


def clear(socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it."""
    return ask(socket, json, "clear")
