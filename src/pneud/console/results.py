"""Results of requests, printed for a person or as one JSON object."""

from __future__ import annotations

import json as json_
import sys
from typing import Any

from pneud.console.client import RefusedError


def show(reply: dict[str, Any], json: bool, words: str) -> None:
    """Print a result, with the axis that it is of."""
    axis = f"{reply['axis']}: " if "axis" in reply else ""
    print(json_.dumps({"schema": 1, "ok": True, **reply}) if json else f"{axis}{words}")


def refused(e: RefusedError, json: bool) -> int:
    """Print a refusal.

    Returns:
        Exit status: 1.
    """
    if json:
        axis = {"axis": e.axis} if e.axis else {}
        print(json_.dumps({"schema": 1, "ok": False, **axis, "error": e.error}))
    else:
        print(f"pneud: {e.axis}: {e}" if e.axis else f"pneud: {e}", file=sys.stderr)
    return 1
