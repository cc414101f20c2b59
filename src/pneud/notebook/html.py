"""What notebooks show in place of a `repr`: small tables, without style sheets or scripts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

DIGITS = 4
_LEFT = 'style="text-align:left"'
_CELL = 'style="text-align:right;padding:0 0.5em"'


def shown(value: Any) -> str:
    """A value as people read it; nothing for what is not there."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else str(value)


def facts(title: str, rows: Mapping[str, Any]) -> str:
    """Names and values below a title."""
    lines = "".join(
        f"<tr><th {_LEFT}>{escape(name)}</th><td {_LEFT}>{escape(shown(value))}</td></tr>"
        for name, value in rows.items()
    )
    return f"<table><caption {_LEFT}>{escape(title)}</caption>{lines}</table>"


def table(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Rows below the names of their columns."""
    head = "".join(f"<th {_CELL}>{escape(name)}</th>" for name in names)
    body = "".join(
        "<tr>" + "".join(f"<td {_CELL}>{escape(shown(value))}</td>" for value in row) + "</tr>"
        for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"
