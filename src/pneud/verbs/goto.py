"""Go to a position and hold there; a later one redirects it in motion."""

from typing import Annotated, Any

import typer

from pneud.console.results import ask
from pneud.verbs import NEGATIVE_NUMBERS, JsonOption, SocketOption, VerbError

SETTINGS = NEGATIVE_NUMBERS


def goto(
    x: Annotated[float, typer.Argument(metavar="MM", help="Position in the stroke coordinate [mm].")],
    speed: Annotated[float | None, typer.Option("--speed", metavar="MM_S", help="At most.")] = None,
    accel: Annotated[float | None, typer.Option("--accel", metavar="MM_S2", help="At most.")] = None,
    jerk: Annotated[float | None, typer.Option("--jerk", metavar="MM_S3", help="At most.")] = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Ask for it."""
    given = (("speed_mm_s", speed), ("acceleration_mm_s2", accel), ("jerk_mm_s3", jerk))
    fields: dict[str, Any] = {name: value for name, value in given if value is not None}
    if not all(0.0 < value <= 1e9 for value in fields.values()) or not abs(x) <= 1e6:
        raise VerbError("goto: MM is a position, --speed, --accel and --jerk are positive numbers")
    return ask(socket, json, "goto", x_mm=x, **fields)
