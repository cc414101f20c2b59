"""What an axis had learnt at the end of a log; to start from with the next run."""

from __future__ import annotations

import json as json_
import sys
import time
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

import tomlkit
import typer

from pneud.config.axes import Part, axes_of, one_of
from pneud.config.learnt import Values, values_learnt
from pneud.config.models import Config
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.config.writing import put, rewrite
from pneud.log.files.reader import LogReader, read_log
from pneud.replay.learning import last_learnt
from pneud.verbs import AxisOption, JsonOption, LogArgument

_START = ("control", "adaptation", "start")
_SAME = (
    "name",
    *("cylinder.piston_area_1_m2", "cylinder.piston_area_2_m2", "cylinder.stroke_m", "valve.u_max_v"),
)


def learnt(
    log: LogArgument,
    into: Annotated[
        Path | None,
        typer.Option("--into", metavar="CONFIG", help="Write it there: runs with that file start from it."),
    ] = None,
    axis: AxisOption = None,
    json: JsonOption = False,
) -> int:
    """Say what had been learnt beside what is configured, and keep it on request.

    Returns:
        Exit status: 0.

    Raises:
        ConfigError: adaptation was off, or the file is of another rig, or cannot be used or written.
        LogError: not a log that this version reads, or it does not tell.
    """
    reader = read_log(log)
    found, time_ns = last_learnt(reader)
    config = parse(reader.config_text, f"{reader.path}:{reader.config_name}")
    values = values_learnt(found, config)
    if reader.truncated:
        print(f"pneud: {reader.path}: not whole: {reader.damage}", file=sys.stderr)
    if not values:
        raise ConfigError(f"{reader.path}: control.adaptation was off: nothing has been learnt")
    if into is not None:
        part = _part(into, axis, config)
        _write(part, values, config, reader, time_ns)
    if json:
        fields = {"axis": config.name, "log": reader.path.name, "into": str(into) if into else None}
        print(json_.dumps({"schema": 1, **fields, "learnt": values}))
        return 0
    print("\n".join(in_words(values)))
    if into is not None:
        print(f"written into {into}: the next start is from there")
    return 0


def in_words(values: Values) -> list[str]:
    """A line for each value."""
    lines = [f"{'':24}{'learnt':>12}{'configured':>12}   bounds"]
    for name, v in values.items():
        check = f"; at its bound: check {v['check']}" if v["check"] else ""
        lines.append(
            f"{name:24}{v['value']:>12.6g}{v['configured']:>12.6g}   {v['least']:g} … {v['most']:g}{check}"
        )
    return lines


def _part(file: Path, axis: str | None, config: Config) -> Part:
    """The axis of a file or a folder: the one named, the only one, or that of the log's name."""
    if not file.exists():
        raise ConfigError(f"{file}: there is no such file")
    parts = axes_of(file)
    named = axis or (config.name if any(part.config.name == config.name for part in parts) else None)
    return one_of(parts, named if axis or len(parts) > 1 else None, str(file))


def _write(part: Part, values: Values, config: Config, log: LogReader, time_ns: int) -> None:
    target, path = part.config, part.path
    if not target.control.adaptation.enabled:
        raise ConfigError(f"{path}: control.adaptation.enabled is false: what was learnt would not count")
    for key in _SAME:
        mine, theirs = attrgetter(key)(target), attrgetter(key)(config)
        if mine != theirs:
            raise ConfigError(f"{path}: {key} is {mine}, in {log.path.name} {theirs}: learnt on another rig")
    bus = log.metadata.get("bus", "an unknown bus")
    when = "" if bus == "simulated" else time.strftime(", %Y-%m-%d %H:%M UTC", time.gmtime(time_ns * 1e-9))
    start = tomlkit.table()
    start.add(tomlkit.comment(f"learnt on {bus}{when}; pneud learnt LOG --into FILE writes it"))
    start.update({"axis": config.name, "log": log.path.name})
    start.update({name: v["value"] for name, v in values.items()})
    start.add(tomlkit.nl())

    def change(document: Any) -> None:
        put(document, _START, start)

    try:
        rewrite(path, change, target.name)
    except OSError as e:
        raise ConfigError(f"{path}: cannot be written: {e.strerror}") from None
