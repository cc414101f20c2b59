"""Stop the axis and centre its valve; needs no lease, as stop."""

from pneud.console.results import ask
from pneud.verbs import AxisOption, JsonOption, SocketOption


def disarm(axis: AxisOption = None, socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it."""
    return ask(socket, json, "disarm", axis=axis)
