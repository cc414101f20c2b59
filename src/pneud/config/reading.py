"""Configurations out of files and texts, and what is wrong with them in one line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from pneud import resources
from pneud.config.models import Config
from pneud.config.places import line_of, meant
from pneud.config.sections import ConfigError
from pneud.config.toml import TomlError, tables_of

NONE = "none"  # in place of a value
AXIS = "axis"  # the tables that a file of several axes has


def parse(text: str, name: str) -> Config:
    """A configuration from the text of its file.

    Args:
        text: TOML.
        name: what to call it in messages.

    Raises:
        ConfigError: names the file, the key, the value and the bound.
    """
    data = _tables(text, name)
    try:
        return Config.model_validate(data)
    except ValidationError as e:
        raise ConfigError(f"{name}: {explain(e, text, Config)}") from None


def _tables(text: str, name: str) -> dict[str, Any]:
    """Those of one axis."""
    try:
        data = tables_of(text)
    except TomlError as e:
        raise ConfigError(f"{name}: {e}") from None
    if isinstance(several := data.get(AXIS), list):
        found = ", ".join(str(one.get("name", "?")) for one in several if isinstance(one, dict))
        raise ConfigError(f"{name}: has several axes ({found}); choose one, with --axis")
    return data


def with_settings(text: str, name: str, settings: Sequence[str]) -> Config:
    """A configuration with some of its values replaced.

    Args:
        text: TOML.
        name: what to call it in messages.
        settings: such as "control.k1=2500", the value as in TOML; a string needs no quotes, and `none` takes
            the key out.

    Raises:
        ConfigError: as `parse`, or a setting has not this form.
    """
    data = _tables(text, name)
    for setting in settings:
        key, equals, value = setting.partition("=")
        *tables, last = key.strip().split(".")
        if not equals or not last:
            raise ConfigError(f"--set {setting}: give key=value, such as control.k1=2500")
        table = data
        for part in tables:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ConfigError(f"--set {setting}: {part} is no table")
        if value.strip() == NONE:
            table.pop(last, None)
            continue
        try:
            table[last] = tables_of(f"x = {value}")["x"]
        except TomlError:
            table[last] = value.strip()
    try:
        return Config.model_validate(data)
    except ValidationError as e:
        raise ConfigError(f"{name} with --set: {explain(e)}") from None


def load_config(file: str | Path) -> Config:
    """The configuration in a file, or one of those that come with pneud by its bare name.

    Raises:
        ConfigError: the file is missing, unreadable or wrong.
    """
    return load_with_text(file)[0]


def load_with_text(file: str | Path) -> tuple[Config, str, Path]:
    """As `load_config`, with the file's text and where it was found."""
    text, path = text_of(file)
    return parse(text, str(path)), text, path


def text_of(file: str | Path) -> tuple[str, Path]:
    """The text of a file, or of one of those that come with pneud, and where it was found.

    Raises:
        ConfigError: it is missing or unreadable.
    """
    try:
        path = resources.find(file)
        return path.read_text(encoding="utf-8-sig"), path
    except FileNotFoundError as e:
        raise ConfigError(str(e)) from None
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"{file}: cannot be read: {getattr(e, 'strerror', e)}") from None


Finder = Callable[[Sequence[str]], int]
"""The line on which a key stands; 0 where it is not known."""


def explain(e: ValidationError, text: str | Finder = "", model: type[BaseModel] | None = None) -> str:
    """What is wrong, in one line: where, key, value and bound of each error.

    Args:
        e: the errors.
        text: of the file, to say on which line each is; or what finds that.
        model: of the file, to say what an unknown key may have meant.
    """
    return "; ".join(_sentence(error, text, model) for error in e.errors())


def _sentence(error: Any, text: str | Finder, model: type[BaseModel] | None) -> str:
    path = [str(part) for part in error["loc"]]
    line, where = line_of(text, path) if isinstance(text, str) else text(path), ".".join(path)
    prefix = f"line {line}: " if line else ""
    if error["type"] == "extra_forbidden":
        near = meant(model, path) if model is not None else ""
        return f"{prefix}{where}: unknown key" + (f"; is {near} meant?" if near else "")
    if error["type"] == "missing":
        return f"{prefix}{where}: missing"
    message = error["msg"].removeprefix("Value error, ")
    value = error["input"]
    shown = f" = {value!r}" if isinstance(value, (int, float, str, bool)) else ""
    return f"{prefix}{where}{shown}: {message}" if where else str(message)
