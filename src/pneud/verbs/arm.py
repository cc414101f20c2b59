"""Engage the axis and hold where it is."""

from typing import Annotated

import typer

from pneud.console.results import ask
from pneud.verbs import AxisOption, JsonOption, SocketOption


def arm(
    unproven: Annotated[
        bool, typer.Option("--unproven", help="Without a movement test, from now on in this run.")
    ] = False,
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Ask for it."""
    return ask(socket, json, "arm", axis=axis, unproven=unproven)
