"""Press with a force of the piston, within bounds of travel, speed and time."""

import time
from typing import Annotated, Any

import typer

from pneud.console.client import Client, RefusedError
from pneud.console.results import ask, refused, show
from pneud.console.waiting import wait_for_force
from pneud.verbs import NEGATIVE_NUMBERS, AxisOption, JsonOption, SocketOption, VerbError

SETTINGS = NEGATIVE_NUMBERS


def force(
    newtons: Annotated[
        float, typer.Argument(metavar="N", help="Of the piston on the load; positive pushes outwards.")
    ],
    ramp: Annotated[
        float | None, typer.Option("--ramp", metavar="N_S", help="Default limits.force.rate_n_s.")
    ] = None,
    between: Annotated[
        tuple[float, float] | None,
        typer.Option("--between", metavar="MM MM", help="Window of the travel; default all of it."),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option("--speed", metavar="MM_S", help="At most; default limits.force.speed_m_s."),
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option("--timeout", metavar="S", help="To have the force; default limits.force.time_s."),
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Until the force is there; 1 if it is not.")] = False,
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Ask for it, and wait if that is wanted.

    Returns:
        Exit status: 0, or 1 where it was refused or the force is not reached.
    """
    given = (("rate_n_s", ramp), ("speed_mm_s", speed), ("timeout_s", timeout))
    fields: dict[str, Any] = {name: value for name, value in given if value is not None}
    if not abs(newtons) <= 1e6 or not all(0.0 < value <= 1e9 for value in fields.values()):
        raise VerbError("force: N is a force, --ramp, --speed and --timeout are positive numbers")
    if between is not None:
        if not between[0] < between[1]:
            raise VerbError("force: --between takes two positions [mm], the lower one first")
        fields["low_mm"], fields["high_mm"] = between
    if not wait:
        return ask(socket, json, "force", axis=axis, force_n=newtons, **fields)
    with Client(socket, axis) as client:
        begun_s = time.monotonic()
        try:
            reply = client.ask("force", force_n=newtons, **fields)
            found = wait_for_force(client, reply["order"], newtons)
        except RefusedError as e:
            return refused(e, json)
    took_s = round(time.monotonic() - begun_s, 3)
    told = {name: found[name] for name in ("state", "in_position", "force_n", "position_mm")}
    words = f"{found['force_n']:.1f} N at {found['position_mm']:.3f} mm, after {took_s:g} s"
    show({**reply, **told, "waited_s": took_s}, json, words)
    return 0
