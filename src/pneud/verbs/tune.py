"""Gains of a running daemon: read, changed, compared with the file, written into it."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from pneud.config import ConfigError, load_config
from pneud.console.client import Client, RefusedError
from pneud.console.place import PlaceError
from pneud.console.results import refused, show
from pneud.console.tuning import Gains, difference, gains_of, keys
from pneud.control.tuning import TUNABLE


def get(socket: str | None, json: bool) -> int:
    """Print the running gains.

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
    """Change gains, all or none.

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
    gains: Gains = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or name not in TUNABLE:
            raise ConfigError(f"{setting!r} is no NAME=VALUE; names are {', '.join(TUNABLE)}")
        gains[name] = value
        if name != "law":
            try:
                gains[name] = float(value)
            except ValueError:
                raise ConfigError(f"{setting!r}: {value!r} is no number") from None
    return _ask(socket, json, "tune_set", gains=gains)


def reload(socket: str | None, json: bool) -> int:
    """Let the daemon take the gains of its file.

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
    """Print what the running gains have that the file has not.

    Returns:
        Exit status: 0.

    Raises:
        ConfigError: the file cannot be used.
        PlaceError: no daemon to talk to.
    """
    running, path = _running(socket)
    found = gains_of(load_config(path))
    changes = {n: {"file": found[n], "running": running[n]} for n in TUNABLE if found[n] != running[n]}
    show({"config": str(path), "changes": changes}, json, difference(found, running) or "nothing differs")
    return 0


def save(socket: str | None, json: bool) -> int:
    """Write the running gains into the daemon's file, whose comments and order stay as they are.

    Returns:
        Exit status: 0.

    Raises:
        ConfigError: the file cannot be used.
        PlaceError: no daemon to talk to, or the file cannot be written.
    """
    running, path = _running(socket)
    found = gains_of(load_config(path))
    changes = difference(found, running)
    if changes:
        try:
            _replace(path, _with_gains(path.read_text(encoding="utf-8"), found, running))
        except TOMLKitError as e:
            raise ConfigError(f"{path}: {e}") from None
        except OSError as e:
            raise PlaceError(f"{path}: cannot be written: {e.strerror}; try sudo") from None
    show({"config": str(path), "changed": changes}, json, f"{path}: {changes or 'has these gains'}")
    return 0


def _running(socket: str | None) -> tuple[Gains, Path]:
    with Client(socket) as client:
        reply = client.ask("tune_get")
    return reply["gains"], Path(reply["config"])


def _with_gains(text: str, old: Gains, new: Gains) -> str:
    document = tomlkit.parse(text)
    for name in TUNABLE:
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
