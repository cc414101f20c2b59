"""Move for as long as this command runs, then hold."""

import time
from typing import Annotated

import typer

from pneud.console.client import Client, RefusedError
from pneud.console.results import refused, show
from pneud.verbs import NEGATIVE_NUMBERS, AxisOption, JsonOption, SocketOption, VerbError

SETTINGS = NEGATIVE_NUMBERS
_LEASE_S = 0.3
_RENEWALS = 3  # of a lease, before it would run out


def jog(
    velocity: Annotated[float, typer.Argument(metavar="MM_S", help="Signed speed [mm/s].")],
    duration: Annotated[
        float | None, typer.Option("--for", metavar="S", help="Default: until Ctrl-C.")
    ] = None,
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Move until Ctrl-C or the end of a time, then hold; if this process dies, the lease runs out.

    Returns:
        Exit status: 0, or 1 where it was refused.
    """
    if not abs(velocity) <= 1e6 or (duration is not None and not 0.0 < duration < 1e6):
        raise VerbError("jog: MM_S is a speed, --for a positive number of seconds")
    with Client(socket, axis) as client:
        try:
            end_s = time.monotonic() + (duration if duration is not None else float("inf"))
            try:
                while time.monotonic() < end_s:
                    client.ask("jog", velocity_mm_s=velocity, lease_s=_LEASE_S)
                    time.sleep(max(0.0, min(_LEASE_S / _RENEWALS, end_s - time.monotonic())))
            except KeyboardInterrupt:
                pass
            reply = client.ask("hold")
        except RefusedError as e:
            return refused(e, json)
    show(reply, json, reply["state"])
    return 0
