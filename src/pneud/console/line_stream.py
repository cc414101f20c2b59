"""A line of the protocol; apart from the messages, whose models a client need not load to ask for a stop."""

from __future__ import annotations

import json
from typing import Any

VERSION = 1
MAX_LINE = 16 * 1024  # bytes, its end included


def line(what: dict[str, Any]) -> bytes:
    """An object as a line; it must not hold a number that is not finite."""
    return json.dumps(what, allow_nan=False, separators=(",", ":")).encode() + b"\n"
