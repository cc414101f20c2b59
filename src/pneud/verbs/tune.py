"""Gains and reference of a running daemon: read, changed, compared with the file, written into it."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from pneud.config.models import ConfigError, load_config
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.console.results import refused, show
from pneud.console.tuning import NAMES, Values, difference, keys, values_of


def get(socket: str | None, json: bool) -> int:
    """Print the running values.

    Returns:
        Exit status: 0.

    Raises:
        PlaceError: no daemon to talk to.
    """
    with Client(socket) as client:
        reply = client.ask("tune_get")
    show(reply, json, "\n".join(f"{name} = {value}" for name, value in reply["gains"].items()))
    return 0


def change(socket: str | None, json: bool, settings: list[str]) -> int:
    """Change some of them, all or none.

    Args:
        socket: `--socket`.
        json: print an object.
        settings: NAME=VALUE each.

    Returns:
        Exit status: 0, or 1 where it was refused.

    Raises:
        ConfigError: not such settings.
        PlaceError: no daemon to talk to.
    """
    values: Values = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or name not in NAMES:
            raise ConfigError(f"{setting!r} is no NAME=VALUE; names are {', '.join(NAMES)}")
        values[name] = value
        if name != "law":
            try:
                values[name] = float(value)
            except ValueError:
                raise ConfigError(f"{setting!r}: {value!r} is no number") from None
    return _ask(socket, json, "tune_set", gains=values)


def reload(socket: str | None, json: bool) -> int:
    """Let the daemon take the values of its file.

    Returns:
        Exit status: 0, or 1 where it was refused.

    Raises:
        PlaceError: no daemon to talk to.
    """
    return _ask(socket, json, "tune_reload")


def _ask(socket: str | None, json: bool, verb: str, **fields: Any) -> int:
    with Client(socket) as client:
        try:
            reply = client.ask(verb, **fields)
        except RefusedError as e:
            return refused(e, json)
    words = reply["changed"] or "nothing to change"
    if reply.get("at_restart"):
        words += f"\nat the next start only: {', '.join(reply['at_restart'])}"
    show(reply, json, words)
    return 0


def diff(socket: str | None, json: bool) -> int:
    """Print where what runs differs from the file.

    Returns:
        Exit status: 0.

    Raises:
        ConfigError: the file cannot be used.
        PlaceError: no daemon to talk to.
    """
    running, path = _running(socket)
    found = values_of(load_config(path))
    changes = {n: {"file": found[n], "running": running[n]} for n in NAMES if found[n] != running[n]}
    show({"config": str(path), "changes": changes}, json, difference(found, running) or "nothing differs")
    return 0


def save(socket: str | None, json: bool) -> int:
    """Write what runs into the daemon's file, whose comments and order stay as they are.

    Returns:
        Exit status: 0.

    Raises:
        ConfigError: the file cannot be used.
        PlaceError: no daemon to talk to, or the file cannot be written.
    """
    running, path = _running(socket)
    found = values_of(load_config(path))
    changes = difference(found, running)
    if changes:
        try:
            _replace(path, _with(path.read_text(encoding="utf-8-sig"), found, running))
        except TOMLKitError as e:
            raise ConfigError(f"{path}: {e}") from None
        except OSError as e:
            raise PlaceError(f"{path}: cannot be written: {e.strerror}; try sudo") from None
    show({"config": str(path), "changed": changes}, json, f"{path}: {changes or 'has these values'}")
    return 0


def _running(socket: str | None) -> tuple[Values, Path]:
    with Client(socket) as client:
        reply = client.ask("tune_get")
    return reply["gains"], Path(reply["config"])


def _with(text: str, old: Values, new: Values) -> str:
    document = tomlkit.parse(text)
    for name in NAMES:
        if new[name] == old[name]:
            continue
        value = new[name]
        parts = value.split("-") if isinstance(value, str) else [value]
        for key, part in zip(keys(name), parts, strict=True):
            table: Any = document
            for step in key[:-1]:
                table = table[step]
            table[key[-1]] = part
    return tomlkit.dumps(document)


def _replace(path: Path, text: str) -> None:
    """Write a file at once or not at all; what could not be loaded is not written."""
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        load_config(name)
        before = path.stat()
        Path(name).chmod(before.st_mode & 0o7777)
        with contextlib.suppress(PermissionError):
            os.chown(name, before.st_uid, before.st_gid)
        Path(name).replace(path)
    finally:
        Path(name).unlink(missing_ok=True)
