"""Go to a position and hold there; a later one redirects it in motion."""

import time
from contextlib import nullcontext
from typing import Annotated, Any

import typer

from pneud.console.client import Client, RefusedError
from pneud.console.results import ask, refused, show
from pneud.console.waiting import wait as wait_for
from pneud.verbs import NEGATIVE_NUMBERS, AxisOption, JsonOption, SocketOption, VerbError

SETTINGS = NEGATIVE_NUMBERS


def goto(
    to: Annotated[
        list[str],
        typer.Argument(
            metavar="MM", help="Position in the stroke coordinate [mm]; of several axes x=MM y=MM together."
        ),
    ],
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
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Ask for it, and wait if that is wanted.

    Returns:
        Exit status: 0, or 1 where it was refused or the load has not come there.
    """
    given = (("speed_mm_s", speed), ("acceleration_mm_s2", accel), ("jerk_mm_s3", jerk))
    fields: dict[str, Any] = {name: value for name, value in given if value is not None}
    places = _places(to, axis)
    if not all(0.0 < value <= 1e9 for value in fields.values()) or not all(
        abs(x) <= 1e6 for x in places.values()
    ):
        raise VerbError("goto: MM is a position, --speed, --accel and --jerk are positive numbers")
    bounds = [value for value in (tolerance, timeout) if value is not None]
    if (bounds and not wait) or not all(0.0 < value <= 1e9 for value in bounds):
        raise VerbError("goto: --tolerance and --timeout are positive numbers, with --wait")
    verb = "goto"
    if len(places) == 1:
        ((axis, fields["x_mm"]),) = places.items()
    elif fields:
        raise VerbError(
            "goto: --speed, --accel and --jerk are for one axis; several keep to what is configured"
        )
    else:
        verb, fields["axes"] = "goto_all", places
    if not wait:
        return ask(socket, json, verb, axis=axis, **fields)
    with Client(socket, axis) as client:
        begun_s = time.monotonic()
        try:
            reply = client.ask(verb, **fields)
            for name, x in places.items():
                with Client(socket, name) if len(places) > 1 else nullcontext(client) as one:
                    found = wait_for(one, reply["order"], x, tolerance, timeout)
        except RefusedError as e:
            return refused(e, json)
    told = {name: found[name] for name in ("state", "in_position", "position_mm", "error_mm")}
    took_s = round(time.monotonic() - begun_s, 3)
    words = f"at {found['position_mm']:.3f} mm, error {found['error_mm']:.3f} mm, after {took_s:g} s"
    if len(places) > 1:
        told, words = {}, f"all in position after {took_s:g} s"
    show({**reply, **told, "waited_s": took_s}, json, words)
    return 0


def _places(to: list[str], axis: str | None) -> dict[str | None, float]:
    """Positions by the names of the axes; the only one may have none."""
    found: dict[str | None, float] = {}
    for word in to:
        name, equals, number = word.rpartition("=")
        try:
            found[name if equals else axis] = float(number)
        except ValueError:
            raise VerbError(f"goto: {word!r} is neither a position [mm] nor AXIS=MM") from None
    if len(found) < len(to) or (len(found) > 1 and (None in found or axis is not None)):
        raise VerbError("goto: give one position, or one for each axis: goto x=300 y=120")
    return found
