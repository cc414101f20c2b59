"""Follow the configured reference, a chirp, steps, or a profile from a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from pneud.config.sections import ConfigError
from pneud.console import profiles
from pneud.console.client import Client, RefusedError
from pneud.console.profiles import ProfileError
from pneud.console.results import ask, refused, show
from pneud.control.reference import Bounds, Septic
from pneud.verbs import NEGATIVE_NUMBERS, AxisOption, JsonOption, SocketOption

SETTINGS = NEGATIVE_NUMBERS
_MM = 1e-3


def track(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="reference (the configured one, as is sine), chirp, steps, profile, FILE.csv or FILE.json.",
        ),
    ],
    positions: Annotated[list[float] | None, typer.Argument(metavar="[MM]...", help="Of steps.")] = None,
    centre: Annotated[
        float | None, typer.Option("--centre", metavar="MM", help="Of a chirp; default where it stands.")
    ] = None,
    amplitude: Annotated[float, typer.Option("--amplitude", metavar="MM", help="Of a chirp.")] = 10.0,
    from_hz: Annotated[float, typer.Option("--from", metavar="HZ", help="First frequency of a chirp.")] = 0.2,
    to_hz: Annotated[float, typer.Option("--to", metavar="HZ", help="Last frequency of a chirp.")] = 2.0,
    duration: Annotated[float, typer.Option("--duration", metavar="S", help="Of a chirp.")] = 20.0,
    dwell: Annotated[float, typer.Option("--dwell", metavar="S", help="Rest at each of the steps.")] = 1.0,
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Upload what is asked for, where it has to be, and follow it.

    Returns:
        Exit status: 0, or 1 where it was refused or is more than the axis may do.
    """
    if positions and name != "steps":
        raise ConfigError(f"track {name}: takes no positions")
    if name in ("reference", "sine", "profile"):
        return ask(socket, json, "track", axis=axis, what="profile" if name == "profile" else "reference")

    def made(bounds: Bounds, position_mm: float | None) -> list[Septic]:
        if name == "steps":
            return profiles.steps([x * _MM for x in positions or []], dwell, bounds)
        if name != "chirp":
            return profiles.from_file(Path(name))
        middle_mm = centre if centre is not None else position_mm
        if middle_mm is None:
            raise ProfileError("the position is not known; give --centre")
        return profiles.chirp(middle_mm * _MM, amplitude * _MM, from_hz, to_hz, duration)

    with Client(socket, axis) as client:
        try:
            pieces = _upload(client, name, made)
            reply = client.ask("track", what="profile")
        except RefusedError as e:
            return refused(e, json)
    more = {"pieces": len(pieces), "duration_s": profiles.duration_s(pieces)}
    words = f"{reply['state']}: {more['pieces']} pieces, {more['duration_s']:.3f} s"
    show({**reply, **more}, json, words)
    return 0


def _upload(client: Client, name: str, make: Callable[[Bounds, float | None], list[Septic]]) -> list[Septic]:
    status = client.ask("status")
    allowed = status["limits"]
    bounds = profiles.bounds_in(allowed)
    try:
        pieces = make(bounds, status["position_mm"])
    except ProfileError as e:
        raise ConfigError(str(e)) from None
    try:
        profiles.check(pieces, bounds, allowed["min_mm"] * _MM, allowed["max_mm"] * _MM)
    except ProfileError as e:
        raise RefusedError({"type": "beyond_limits", "message": f"track {name}: {e}"}) from None
    for fields in profiles.uploads(pieces):
        client.ask("upload", **fields)
    return pieces
