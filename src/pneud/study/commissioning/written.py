"""What has been found, written into a configuration: each value with its interval, log and date behind it.

Comments and order stay; what an earlier commissioning has written behind a value is replaced.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import tomlkit

from pneud.config.models import Config
from pneud.config.toml import flat
from pneud.config.writing import put, rewritten
from pneud.study.commissioning.estimated import Values
from pneud.study.identification.parameters import Estimate

NOTE = re.compile(r"(^|; )[^;]*\bby \S+, \d{4}-\d\d-\d\d$")


class Change(NamedTuple):
    """A key that gets another value."""

    key: str
    was: Any  # None: it was not there
    value: Any  # None: it is taken out
    interval: str  # of 95 %, empty where there is none


def changes(c: Config, values: Values, found: Mapping[str, Estimate]) -> list[Change]:
    """What differs from a configuration.

    Args:
        c: the configuration.
        values: what is to be written, by dotted key.
        found: estimates, by key.
    """
    had = flat(c.model_dump(by_alias=True))
    return [
        Change(name, had.get(name), value, _interval(name, found))
        for name, value in _flattened(values).items()
        if value != had.get(name) and (value is not None or had.get(name))
    ]


def _flattened(values: Values) -> Values:
    found: Values = {}
    for name, value in values.items():
        found |= flat(value, name) if isinstance(value, dict) else {name: value}
    return found


def _interval(name: str, found: Mapping[str, Estimate]) -> str:
    e = found.get(name)
    return f"{e.low:.4g} … {e.high:.4g}" if e is not None and e.told else ""


def text_with(text: str, name: str, values: Values, found: Mapping[str, Estimate], source: str) -> str:
    """A configuration's text with values put in.

    Args:
        text: of the file.
        name: of the file, for errors.
        values: by dotted key; a table is one whole, None takes a key out.
        found: estimates, by key.
        source: of the values: log and date.

    Raises:
        ConfigError: what would become of it cannot be used.
    """

    def change(document: Any) -> None:
        for dotted, value in values.items():
            key = tuple(dotted.split("."))
            interval = _interval(dotted, found)
            if value is None or value == {}:
                _take(document, key)
            elif isinstance(value, dict):
                _put_table(document, key, value, f"by {source}")
            else:
                _put(document, key, value, f"{interval} by {source}" if interval else f"by {source}")

    return rewritten(text, change, name)


def _put(document: Any, key: tuple[str, ...], value: Any, note: str) -> None:
    before = _at(document, key)
    if before is not None and before == value:
        return
    kept = NOTE.sub("", before.trivia.comment.lstrip("# ").strip()) if hasattr(before, "trivia") else ""
    item = tomlkit.item(value)
    item.comment(f"{kept}; {note}" if kept else note)
    put(document, key, item)


def _put_table(document: Any, key: tuple[str, ...], values: dict[str, Any], note: str) -> None:
    """A table one whole: what it has besides is taken out."""
    for name in list(_at(document, key) or ()):
        if name not in values:
            _take(document, (*key, name))
    for name, value in values.items():
        if value is not None:
            _put(document, (*key, name), value, note)


def _take(document: Any, key: tuple[str, ...]) -> None:
    table = _at(document, key[:-1])
    if table is not None and key[-1] in table:
        table.remove(key[-1])


def _at(document: Any, key: tuple[str, ...]) -> Any:
    """What is there, or None."""
    for step in key:
        if document is None or step not in document:
            return None
        document = document[step]
    return document
