"""What has been found, written into a configuration: each value with its interval, log and date behind it.

Comments and order stay; what stands behind a value of where it was from, a data sheet, a guess or an earlier
commissioning, is replaced.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import tomlkit

from pneud.config.models import Config
from pneud.config.toml import flat, tables_of
from pneud.config.writing import NOTE, put, rewritten
from pneud.study.commissioning.estimated import Values
from pneud.study.identification.parameters import Estimate

GUESS = re.compile(r"(typical|likewise)\b.*|.*\bof (its|your) sheet$|.*\bANR\b.*")  # where a value was from
DIGITS = 7


class Change(NamedTuple):
    """A key that gets another value."""

    key: str
    was: Any  # None: it was not there, nor had a default
    value: Any  # None: it is taken out
    interval: str  # of 95 %, empty where there is none


def changes(c: Config, text: str, values: Values, found: Mapping[str, Estimate]) -> list[Change]:
    """What is to be changed in a configuration.

    Args:
        c: the configuration.
        text: of its file.
        values: what is to hold, by dotted key; a table is one whole, None takes a key out.
        found: estimates, by key.
    """
    has, own = flat(c.model_dump(by_alias=True)), flat(tables_of(text))
    wanted: Values = {}
    for name, value in values.items():
        if isinstance(value, dict):
            wanted |= {key: None for key in own if key.startswith(f"{name}.")}
            wanted |= flat(value, name) if value else {}
        else:
            wanted[name] = value
    return [
        Change(name, has.get(name), _plain(value), _interval(name, found))
        for name, value in wanted.items()
        if (name in own if value is None else _plain(value) != has.get(name))
    ]


def _plain(value: Any) -> Any:
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def _interval(name: str, found: Mapping[str, Estimate]) -> str:
    e = found.get(name)
    return f"{e.low:.4g} … {e.high:.4g}" if e is not None and e.told else ""


def text_with(text: str, name: str, what: Sequence[Change], source: str) -> str:
    """A configuration's text with other values.

    Args:
        text: of the file.
        name: of the file, for errors.
        what: from `changes`.
        source: of the values: log and date.

    Raises:
        ConfigError: what would become of it cannot be used.
    """

    def change(document: Any) -> None:
        for c in what:
            key = tuple(c.key.split("."))
            if c.value is None:
                _at(document, key[:-1]).remove(key[-1])
            else:
                _put(document, key, c.value, f"{c.interval} by {source}" if c.interval else f"by {source}")

    return rewritten(text, change, name)


def _put(document: Any, key: tuple[str, ...], value: Any, note: str) -> None:
    before = _at(document, key)
    item = tomlkit.item(value)
    kept = "" if before is None else NOTE.sub("", before.trivia.comment.lstrip("# ").strip())
    kept = GUESS.sub("", kept)
    item.comment(f"{kept}; {note}" if kept else note)
    item.trivia.comment_ws = (before.trivia.comment_ws if before is not None else "") or "  "
    put(document, key, item)


def _at(document: Any, key: tuple[str, ...]) -> Any:
    """What is there, or None."""
    for step in key:
        if document is None or step not in document:
            return None
        document = document[step]
    return document
