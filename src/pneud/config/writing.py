"""Changes of a configuration's file, as a person would make them: comments and order stay."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import InlineTable, Item, Table

from pneud import resources
from pneud.config.axes import Part, one_of, parts_of
from pneud.config.reading import AXIS, parse
from pneud.config.sections import ConfigError
from pneud.config.toml import flat, tables_of
from pneud.rt.outputs import replacing

NOTE = re.compile(r"(^|; )[^;]*\bby \S+, \d{4}-\d\d-\d\d$")
"""What stands behind a value that was identified: its interval, if there is one, log and date."""


class InlineError(ValueError):
    """A table does not fit into one that is written in a line, {…}."""


def rewritten(text: str, change: Callable[[Any], None], name: str) -> str:
    """A configuration's text, changed.

    Args:
        text: of the file.
        change: does it to the file's tables.
        name: of the file, for errors.

    Raises:
        ConfigError: the text, or what would become of it, cannot be used.
    """
    try:
        document = tomlkit.parse(text)
        change(document)
        text = tomlkit.dumps(document)
    except (TOMLKitError, InlineError) as e:
        raise ConfigError(f"{name}: {e}") from None
    parse(text, name)
    return text


def rewrite(path: Path, change: Callable[[Any], None], axis: str | None = None) -> None:
    """Change a file at once or not at all; what could not be loaded is not written.

    Args:
        path: of the file.
        change: does it to the file's tables; to what one axis is in all, where there are several.
        axis: whose, where there are several.

    Raises:
        ConfigError: the file, or what would become of it, cannot be used, or it comes with pneud.
        OSError: it cannot be read or written.
    """
    if path.resolve().is_relative_to(resources.configs().resolve()):
        raise ConfigError(
            f"{path}: comes with pneud and stays as it is; copy it, and name the copy with --config"
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as e:
        raise ConfigError(f"{path}: {e}") from None
    part = one_of(parts_of(text, path), axis, str(path))
    put_text(path, with_axis(text, path, part, rewritten(part.text, change, str(path))))


def with_axis(text: str, path: Path, part: Part, own: str) -> str:
    """The text of a file in which one axis is another one from now on.

    What an axis says itself takes the place of what stands above for all, so that is where it is written.

    Args:
        text: of the file.
        path: of the file, for errors.
        part: the axis, as it is in the file.
        own: its text as that of one axis, as it is to be.

    Raises:
        ConfigError: what would become of it cannot be used, or what all have in common would have to go.
    """
    if AXIS not in tables_of(text):
        return own
    name, before, after = part.config.name, flat(tables_of(part.text)), flat(tables_of(own))
    document, said = tomlkit.parse(text), tomlkit.parse(own)
    table = next(table for table in document[AXIS] if table.get("name") == name)
    try:
        usual = flat(parse(own, str(path)).model_dump(by_alias=True))
        for key in sorted(before.keys() - after.keys()):
            _take_out(table, key, usual.get(key), f"axis {name}: {key}")
        for key, value in after.items():
            if key not in before or before[key] != value or repr(before[key]) != repr(value):
                put(table, tuple(key.split(".")), _item_at(said, key))
        found = tomlkit.dumps(document)
    except (TOMLKitError, InlineError) as e:
        raise ConfigError(f"{path}: {e}") from None
    wanted = {one.config.name: one.config for one in parts_of(text, path)} | {name: parse(own, str(path))}
    if {one.config.name: one.config for one in parts_of(found, path)} != wanted:
        raise ConfigError(f"{path}: axis {name} cannot be written there; give each a file of its own")
    return found


def _item_at(document: Any, key: str) -> Any:
    for step in key.split("."):
        document = document[step]
    return document


def _take_out(table: Any, key: str, usual: Any, where: str) -> None:
    """Take a key out of an axis's own tables; what stands above, for all, is as it usually is for this one.

    Raises:
        InlineError: it stands above, and is usually nothing.
    """
    own, (*steps, last) = table, key.split(".")
    for step in steps:
        own = own.get(step, {})
    if last in own:
        own.remove(last)
    elif usual is None:
        raise InlineError(f"{where} stands above [[axis]], for all, and would have to go: write it into each")
    else:
        put(table, tuple(key.split(".")), list(usual) if isinstance(usual, tuple) else usual)


def put_text(path: Path, text: str) -> None:
    """Put another text into a file that is there, whole or not at all; its owner stays.

    Raises:
        OSError: it cannot be written.
    """
    before = path.stat()
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")
        with contextlib.suppress(PermissionError):
            os.chown(beside, before.st_uid, before.st_gid)


def put(document: Any, key: tuple[str, ...], value: Any) -> None:
    """Set a key of a document, its tables made where they are missing.

    Raises:
        InlineError: a table would have to go into one that is written in a line.
    """
    table = document
    for place, step in enumerate(key[:-1], start=1):
        if step not in table:
            _within(table, key[:place])[step] = tomlkit.table()
        table = table[step]
    if isinstance(value, Table):
        _within(table, key)
    table[key[-1]] = value


def _within(table: Any, key: tuple[str, ...]) -> Any:
    """A table that may hold others (not each tomlkit says so itself)."""
    if isinstance(table, InlineTable):
        above = ".".join(key[:-1])
        raise InlineError(f"{above} is written in one line, which cannot hold {key[-1]}: write [{above}]")
    return table


def noted(text: str) -> list[tuple[str, str, str]]:
    """The values of a configuration that say by what they were identified.

    Args:
        text: of its file, which can be read.

    Returns:
        Of each: dotted key, value, and what stands behind it.
    """
    return list(_noted(tomlkit.parse(text), ()))


def _noted(table: Any, above: tuple[str, ...]) -> Iterator[tuple[str, str, str]]:
    for key, item in table.items():
        if isinstance(item, Table):
            yield from _noted(item, (*above, key))
        elif isinstance(item, Item) and (found := NOTE.search(item.trivia.comment.lstrip("# "))):
            yield ".".join((*above, key)), item.as_string().strip(), found[0].removeprefix("; ")
