"""Leave a remark in the log."""

from typing import Annotated

import typer

from pneud.console.results import ask
from pneud.verbs import AxisOption, JsonOption, SocketOption, VerbError


def mark(
    text: Annotated[str, typer.Argument(metavar="TEXT", help="For the log.")],
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Ask for it."""
    if not 0 < len(text) <= 200:
        raise VerbError("mark: TEXT has 1 to 200 characters")
    return ask(socket, json, "mark", axis=axis, text=text)
