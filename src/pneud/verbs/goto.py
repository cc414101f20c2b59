"""Go to a position and hold there; a later one redirects it in motion."""

import time
from typing import Annotated, Any

import typer

from pneud.console.client import Client, RefusedError
from pneud.console.results import ask, refused, show
from pneud.console.waiting import wait as wait_for
from pneud.verbs import NEGATIVE_NUMBERS, JsonOption, SocketOption, VerbError

SETTINGS = NEGATIVE_NUMBERS


def goto(
    x: Annotated[float, typer.Argument(metavar="MM", help="Position in the stroke coordinate [mm].")],
    speed: Annotated[float | None, typer.Option("--speed", metavar="MM_S", help="At most.")] = None,
    accel: Annotated[float | None, typer.Option("--accel", metavar="MM_S2", help="At most.")] = None,
    jerk: Annotated[float | None, typer.Option("--jerk", metavar="MM_S3", help="At most.")] = None,
    wait: Annotated[
        bool, typer.Option("--wait", help="Until the load is in position; 1 if it is not.")
    ] = False,
    tolerance: Annotated[
        float | None,
        typer.Option("--tolerance", metavar="MM", help="With --wait: error, in place of in_position."),
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option("--timeout", metavar="S", help="With --wait; default 5 s from the reference's end."),
    ] = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Ask for it, and wait if that is wanted.

    Returns:
        Exit status: 0, or 1 where it was refused or the load has not come there.
    """
    given = (("speed_mm_s", speed), ("acceleration_mm_s2", accel), ("jerk_mm_s3", jerk))
    fields: dict[str, Any] = {name: value for name, value in given if value is not None}
    if not all(0.0 < value <= 1e9 for value in fields.values()) or not abs(x) <= 1e6:
        raise VerbError("goto: MM is a position, --speed, --accel and --jerk are positive numbers")
    bounds = [value for value in (tolerance, timeout) if value is not None]
    if (bounds and not wait) or not all(0.0 < value <= 1e9 for value in bounds):
        raise VerbError("goto: --tolerance and --timeout are positive numbers, with --wait")
    if not wait:
        return ask(socket, json, "goto", x_mm=x, **fields)
    with Client(socket) as client:
        begun_s = time.monotonic()
        try:
            reply = client.ask("goto", x_mm=x, **fields)
            found = wait_for(client, reply["order"], x, tolerance, timeout)
        except RefusedError as e:
            return refused(e, json)
    told = {name: found[name] for name in ("state", "in_position", "position_mm", "error_mm")}
    took_s = round(time.monotonic() - begun_s, 3)
    words = f"at {found['position_mm']:.3f} mm, error {found['error_mm']:.3f} mm, after {took_s:g} s"
    show({**reply, **told, "waited_s": took_s}, json, words)
    return 0
