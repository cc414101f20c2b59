"""Clear latched faults whose causes are gone."""

from pneud.console.results import ask
from pneud.verbs import AxisOption, JsonOption, SocketOption


def clear(axis: AxisOption = None, socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it."""
    return ask(socket, json, "clear", axis=axis)
