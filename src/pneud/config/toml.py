"""TOML as tables, and what is wrong with it in one line."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from typing import Any


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
