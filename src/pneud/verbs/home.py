"""Find the encoder's reference."""

from pneud.console.results import ask
from pneud.verbs import AxisOption, JsonOption, SocketOption


def home(axis: AxisOption = None, socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it."""
    return ask(socket, json, "home", axis=axis)
