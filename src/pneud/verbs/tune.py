"""Gains and reference of the running daemon, dead zone, friction and filters."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from pneud.config.axes import axes_of, one_of
from pneud.config.sections import ConfigError
from pneud.config.writing import put, rewrite
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.console.results import ask, show
from pneud.console.tuning import MAYBE_NONE, NAMES, Values, difference, keys, name_of, values_of
from pneud.verbs import AxisOption, JsonOption, SocketOption, VerbError, complete_tunable


def get(axis: AxisOption = None, socket: SocketOption = None, json: JsonOption = False) -> int:
    """What runs of all that may be tuned."""
    return ask(socket, json, "tune_get", _gains, axis=axis)


def change(
    settings: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME=VALUE...", help="As in tune get, or by keys.", autocompletion=complete_tunable
        ),
    ],
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Change gains, reference, dead zone, friction or filters, all or none, without a step of the command.

    Returns:
        Exit status: 0, or 1 where it was refused.
    """
    values: Values = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        name = name_of(key)
        if not equals or name not in NAMES:
            raise ConfigError(
                f"{setting!r} is no NAME=VALUE; names are {', '.join(NAMES)}, or their keys in the file,"
                " whose other values take effect at a restart"
            )
        values[name] = value
        if name != "law":
            try:
                values[name] = number = float(value)
            except ValueError:
                raise ConfigError(f"{setting!r}: {value!r} is no number") from None
            if not math.isfinite(number):
                raise ConfigError(f"{setting!r}: {value!r} is no finite number")
    status = ask(socket, json, "tune_set", _changed, axis=axis, gains=values)
    if status == 0:
        from pneud.study.running import doubts_running  # noqa: PLC0415 - slow to load

        for doubt in doubts_running(*_running(socket, axis)):
            print(f"pneud: warning: {doubt}", file=sys.stderr)
    return status


def reload(axis: AxisOption = None, socket: SocketOption = None, json: JsonOption = False) -> int:
    """Take gains and reference of the daemon's configuration, as SIGHUP does.

    Returns:
        Exit status: 0, or 1 where it was refused.
    """
    return ask(socket, json, "tune_reload", _changed, axis=axis)


def _gains(reply: dict[str, Any]) -> str:
    return "\n".join(f"{name} = {value}" for name, value in reply["gains"].items())


def _changed(reply: dict[str, Any]) -> str:
    words: str = reply["changed"] or "nothing to change"
    if reply.get("at_restart"):
        words += f"\nat the next start only: {', '.join(reply['at_restart'])}"
    return words


def diff(axis: AxisOption = None, socket: SocketOption = None, json: JsonOption = False) -> int:
    """Where the running gains and reference differ from the file."""
    running, path = _running(socket, axis)
    found = values_of(one_of(axes_of(path), axis, str(path)).config)
    changes = {n: {"file": found[n], "running": v} for n, v in running.items() if found[n] != v}
    show({"config": str(path), "changes": changes}, json, difference(found, running) or "nothing differs")
    return 0


def save(axis: AxisOption = None, socket: SocketOption = None, json: JsonOption = False) -> int:
    """Write the running gains and reference into the daemon's configuration; comments stay."""
    running, path = _running(socket, axis)
    found = values_of(one_of(axes_of(path), axis, str(path)).config)
    changes = difference(found, running)
    if changes:
        try:
            rewrite(path, lambda document: _put(document, found, running), axis)
        except OSError as e:
            raise PlaceError(f"{path}: {e.strerror}; try sudo") from None
    show({"config": str(path), "changed": changes}, json, f"{path}: {changes or 'has these values'}")
    return 0


VERBS = {"get": get, "set": change, "diff": diff, "save": save, "reload": reload}


def _running(socket: str | None, axis: str | None) -> tuple[Values, Path]:
    with Client(socket, axis) as client:
        try:
            reply = client.ask("tune_get")
        except RefusedError as e:
            raise VerbError(f"tune: {e}") from None
    return reply["gains"], Path(reply["config"])


def _put(document: Any, old: Values, new: Values) -> None:
    for name, value in new.items():
        if value == old[name]:
            continue
        if name in MAYBE_NONE and not value:
            _take_out(document, keys(name)[0])
            continue
        parts = value.split("-") if isinstance(value, str) else [value]
        for key, part in zip(keys(name), parts, strict=False):  # not each law has a form
            put(document, key, part)


def _take_out(document: Any, key: tuple[str, ...]) -> None:
    table = document
    for step in key[:-1]:
        table = table.get(step, {})
    table.pop(key[-1], None)
