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
        where: the tables and the key; of tables that come one after the other each by its number, from 0, and
            behind it, as pydantic has it, perhaps the kind of table that it is.
    """
    wanted = tuple(where)
    kindless = {wanted[: n + 1] + wanted[n + 2 :] for n, part in enumerate(wanted) if part.isdecimal()}
    best, length = 0, 0
    for number, found in _places(text):
        for path in (wanted, *kindless):
            if length < len(found) <= len(path) and found == path[: len(found)]:
                best, length = number, len(found)
    return best


def _places(text: str) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Lines with the keys and tables that stand there."""
    table: tuple[str, ...] = ()
    counts: dict[tuple[str, ...], int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if head := _TABLE.match(line):
            *above, name = _parts(head.group(1))
            table = (*_counted(above, counts), name)
            if line.lstrip().startswith("[["):
                counts[table] = counts.get(table, -1) + 1
                yield number, table
            table = _counted((name,), counts, table[:-1])
            yield number, table
        elif key := _KEY.match(line):
            yield number, (*table, *_parts(key.group(1)))


def _counted(
    names: Sequence[str], counts: dict[tuple[str, ...], int], above: tuple[str, ...] = ()
) -> tuple[str, ...]:
    """The names of tables, behind each that comes again and again the number of the last one."""
    found = above
    for name in names:
        found = (*found, name)
        if found in counts:
            found = (*found, str(counts[found]))
    return found


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
