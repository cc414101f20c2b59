"""TOML as tables, and what is wrong with it in one line."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from typing import Any

_BARE = re.compile(r"[A-Za-z0-9_-]+")


class TomlError(ValueError):
    """A text is no TOML that could be a configuration; one line for a person."""


def tables_of(text: str) -> dict[str, Any]:
    """The tables of a text; a mark of the order of bytes before it is passed over.

    Raises:
        TomlError: it is no TOML, or has numbers or brackets beyond all measure.
    """
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))
    except tomllib.TOMLDecodeError as e:
        raise TomlError(f"not valid TOML: {e}") from None
    except RecursionError:
        raise TomlError("not valid TOML: brackets within brackets, far too deep") from None
    except ValueError as e:  # an integer of thousands of digits
        raise TomlError(f"not valid TOML: {str(e).partition(';')[0]}") from None


def flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Nested tables as names with dots between them."""
    if not isinstance(value, Mapping):
        return {prefix: value}
    found: dict[str, Any] = {}
    for key, inner in value.items():
        found |= flat(inner, f"{prefix}.{key}" if prefix else str(key))
    return found


def changed_text(text: str, change: dict[str, Any]) -> str:
    """A configuration's text, plain, with values put in place of its own; None takes a key out."""
    return toml_text(merged(tables_of(text), change))


def toml_text(data: dict[str, Any], prefix: str = "") -> str:
    """Tables of plain values as TOML; None is left out."""
    plain = {key: v for key, v in data.items() if not isinstance(v, dict) and v is not None}
    tables = [
        f"\n[{prefix}{_key(key)}]\n{toml_text(v, f'{prefix}{_key(key)}.')}"
        for key, v in data.items()
        if isinstance(v, dict)
    ]
    return "".join([f"{_key(key)} = {_value(v)}\n" for key, v in plain.items()] + tables)


def _key(name: str) -> str:
    """A name as TOML has it: dots and spaces would be more than one."""
    return name if _BARE.fullmatch(name) else _quoted(name)


def _quoted(text: str) -> str:
    """A text; JSON's escapes are TOML's, but for halves of a character, and for the one that deletes."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    """A value in one line."""
    if isinstance(value, float):  # JSON has TOML's strings and truths, but not its infinite numbers
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_key(k)} = {_value(v)}' for k, v in value.items() if v is not None)}}}"
    return _quoted(value) if isinstance(value, str) else json.dumps(value)


def merged(data: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """Tables with values put in place of theirs, table by table."""
    result = dict(data)
    for key, value in change.items():
        below = result.get(key)
        result[key] = merged(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return result
