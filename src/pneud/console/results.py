"""Results of requests, printed for a person or as one JSON object."""

from __future__ import annotations

import json as json_
import sys
from typing import Any

from pneud.console.client import RefusedError


def show(reply: dict[str, Any], json: bool, words: str) -> None:
    """Print a result."""
    print(json_.dumps({"schema": 1, "ok": True, **reply}) if json else words)


def refused(e: RefusedError, json: bool) -> int:
    """Print a refusal.

    Returns:
        Exit status: 1.
    """
    if json:
        print(json_.dumps({"schema": 1, "ok": False, "error": e.error}))
    else:
        print(f"pneud: {e}", file=sys.stderr)
    return 1
