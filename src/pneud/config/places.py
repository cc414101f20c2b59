"""Where in the text of a configuration something stands, and what a key that is none may have meant."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence

from pydantic import BaseModel

_TABLE = re.compile(r"\s*\[+\s*([^\[\]]+?)\s*\]+")
_KEY = re.compile(r"""\s*((?:[\w-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[\w-]+|"[^"]*"|'[^']*'))*)\s*=""")


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in dotted.split("."))


def line_of(text: str, where: Sequence[str]) -> int:
    """The line, from 1, on which a key or its table stands; 0 where neither does.

    Args:
        text: TOML that can be parsed.
        where: the tables and the key.
    """
    wanted, table = tuple(where), ()  # type: tuple[str, ...], tuple[str, ...]
    best, length = 0, 0
    for number, line in enumerate(text.splitlines(), start=1):
        found: tuple[str, ...] = ()
        if head := _TABLE.match(line):
            found = table = _parts(head.group(1))
        elif key := _KEY.match(line):
            found = (*table, *_parts(key.group(1)))
        if length < len(found) <= len(wanted) and found == wanted[: len(found)]:
            best, length = number, len(found)
    return best


def keys_of(model: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """All keys and tables that a file may have, each with the tables above it."""
    for name, field in model.model_fields.items():
        here = (*path, field.alias or name)
        yield here
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from keys_of(inner, here)


def meant(model: type[BaseModel], where: Sequence[str]) -> str:
    """The known key that an unknown one may have meant: the like in its table, the same in another; or ""."""
    *tables, key = where
    known = list(keys_of(model))
    beside = [found[-1] for found in known if list(found[:-1]) == tables]
    if near := difflib.get_close_matches(key, beside, n=1, cutoff=0.6):
        return near[0]
    elsewhere = [found for found in known if found[-1] == key]
    return ".".join(elsewhere[0]) if elsewhere else ""
