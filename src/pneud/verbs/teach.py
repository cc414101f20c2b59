"""Take the present position into a file of points, by a name that programs use."""

from pathlib import Path
from typing import Annotated, Any

import typer

from pneud.config.toml import TomlError, changed_text, tables_of
from pneud.console.client import Client, RefusedError
from pneud.console.results import refused, show
from pneud.rt.outputs import require_folder, write_whole
from pneud.verbs import AxisOption, JsonOption, SocketOption, VerbError

POINTS = Path("points.toml")


def teach(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of the point.")],
    points: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help="The file of points.")
    ] = POINTS,
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Ask where the axis is, and write it down; of several axes all, unless one is named.

    Returns:
        Exit status: 0, or 1 where the daemon does not know the position.
    """
    if not 0 < len(name) <= 64 or not name.isprintable() or not name.strip():
        raise VerbError(f"teach: a point has a name of at most 64 characters, not {name!r}")
    require_folder(points)
    text = ""
    if points.exists():
        try:
            text = points.read_text(encoding="utf-8")
            there = tables_of(text)
        except (OSError, UnicodeDecodeError, TomlError) as e:
            raise VerbError(f"{points}: cannot be read: {getattr(e, 'strerror', None) or e}") from None
        if other := next((key for key, value in there.items() if not _is_point(value)), ""):
            raise VerbError(f"{points}: is no file of points, as {other!r} is no position; take another one")
    with Client(socket, axis) as client:
        try:
            status = client.ask("status")
            found = _found(status, axis)
        except RefusedError as e:
            return refused(e, json)
    write_whole(points, changed_text(text, {name: found}))
    place = found if isinstance(found, float) else " ".join(f"{a}={x:g}" for a, x in found.items())
    words = f"{name} = {place if isinstance(place, str) else f'{place:g}'} mm, in {points}"
    each = status.get("axes", {"": status}).values()
    words += ", taken in motion" if any(one["state"] in ("tracking", "moving") for one in each) else ""
    show({"point": name, "mm": found, "file": str(points)}, json, words)
    return 0


def _is_point(value: Any) -> bool:
    """Whether it is a position, or one by axis."""
    each = value.values() if isinstance(value, dict) else (value,)
    return all(isinstance(one, int | float) and not isinstance(one, bool) for one in each)


def _found(status: dict[str, Any], axis: str | None) -> float | dict[str, float]:
    """Where it is, or all are [mm].

    Raises:
        RefusedError: an axis does not know.
    """
    if "axes" not in status:
        known = _known(status, axis or "")
        return {axis: known} if axis is not None else known
    return {name: _known(one, name) for name, one in status["axes"].items()}


def _known(status: dict[str, Any], name: str) -> float:
    position_mm, blind = status["position_mm"], status["state"] in ("starting", "waiting")
    unknown = any(fault["name"] == "encoder_unreferenced" for fault in status["faults"])
    if position_mm is None or blind or unknown:
        text = "the position is not known" + (
            ": pneud home" if unknown else f": the axis is {status['state']}"
        )
        raise RefusedError({"type": "wrong_state", "message": f"teach: {text}"}, name)
    return round(float(position_mm), 4)
