"""Profiles for a running daemon: made here, uploaded piece by piece, then tracked."""

from __future__ import annotations

import json as json_
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pneud.config.models import ConfigError
from pneud.console import profiles
from pneud.console.client import Client, RefusedError
from pneud.console.profiles import ProfileError
from pneud.console.protocol import MAX_PIECES
from pneud.console.results import refused, show
from pneud.control.reference import Bounds, Septic

_MM = 1e-3


@dataclass(frozen=True, slots=True)
class TrackOptions:
    """What was asked for on the command line."""

    name: str  # sine, profile, chirp, steps, or a file
    positions_mm: list[float]
    centre_mm: float | None
    amplitude_mm: float
    from_hz: float
    to_hz: float
    duration_s: float
    dwell_s: float
    socket: str | None
    json: bool


def track(o: TrackOptions) -> int:
    """Upload what is asked for, where it has to be, and follow it.

    Returns:
        Exit status: 0, or 1 where it was refused or is more than the axis may do.

    Raises:
        ConfigError: there is no such profile.
        PlaceError: no daemon to talk to.
    """
    if o.positions_mm and o.name != "steps":
        raise ConfigError(f"track {o.name}: takes no positions")
    with Client(o.socket) as client:
        try:
            if o.name in ("sine", "profile"):
                reply = client.ask("track", what="reference" if o.name == "sine" else "profile")
                show(reply, o.json, reply["state"])
                return 0
            status = client.ask("status")
            allowed = status["limits"]
            bounds = Bounds(
                *(allowed[key] * _MM for key in ("speed_mm_s", "acceleration_mm_s2", "jerk_mm_s3"))
            )
            try:
                pieces = _pieces(o, bounds, status)
            except ProfileError as e:
                raise ConfigError(str(e)) from None
            try:
                profiles.check(pieces, bounds, allowed["min_mm"] * _MM, allowed["max_mm"] * _MM)
            except ProfileError as e:
                raise RefusedError({"type": "beyond_limits", "message": f"track {o.name}: {e}"}) from None
            for at in range(0, len(pieces), MAX_PIECES):
                some = [list(piece) for piece in pieces[at : at + MAX_PIECES]]
                client.ask("upload", first=at == 0, last=at + MAX_PIECES >= len(pieces), pieces=some)
            reply = client.ask("track", what="profile")
        except RefusedError as e:
            return refused(e, o.json)
    more = {"pieces": len(pieces), "duration_s": profiles.duration_s(pieces)}
    words = f"{reply['state']}: {more['pieces']} pieces, {more['duration_s']:.3f} s"
    show({**reply, **more}, o.json, words)
    return 0


def _pieces(o: TrackOptions, bounds: Bounds, status: dict[str, Any]) -> list[Septic]:
    if o.name == "steps":
        return profiles.steps([x * _MM for x in o.positions_mm], o.dwell_s, bounds)
    if o.name == "chirp":
        centre_mm = o.centre_mm if o.centre_mm is not None else status["position_mm"]
        if centre_mm is None:
            raise ProfileError("the position is not known; give --centre")
        return profiles.chirp(centre_mm * _MM, o.amplitude_mm * _MM, o.from_hz, o.to_hz, o.duration_s)
    path = Path(o.name)
    if path.suffix == ".csv":
        return profiles.from_csv(path)
    if path.suffix == ".json":
        return _from_json(path)
    raise ConfigError(f"track {o.name}: is none of sine, chirp, steps, profile, FILE.csv, FILE.json")


def _from_json(path: Path) -> list[Septic]:
    """Pieces as `upload` has them: a list of [duration, eight coefficients], seconds and metres."""
    try:
        found = json_.loads(path.read_text(encoding="utf-8"))
        return [Septic(*map(float, piece)) for piece in found]
    except OSError as e:
        raise ProfileError(f"{path}: cannot be read: {e.strerror}") from None
    except (ValueError, TypeError) as e:
        raise ProfileError(f"{path}: is no list of pieces [T, c0 … c7]: {e}") from None
