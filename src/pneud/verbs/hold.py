"""Come to rest and hold there."""

from pneud.console.results import ask
from pneud.verbs import AxisOption, JsonOption, SocketOption


def hold(axis: AxisOption = None, socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it."""
    return ask(socket, json, "hold", axis=axis)
