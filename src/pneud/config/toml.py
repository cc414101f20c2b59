"""TOML as tables, and what is wrong with it in one line."""

from __future__ import annotations

import tomllib
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
