"""Find the encoder's reference."""

from pneud.console.results import ask
from pneud.verbs import JsonOption, SocketOption


def home(socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it."""
    return ask(socket, json, "home")
