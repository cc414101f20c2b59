"""What runs in Python that could run in C: said once a process, however many runs there are of it."""

from __future__ import annotations

import sys

_said: dict[str, None] = {}
_hushed = False


def say(what: str, why: str) -> None:
    """Tell a person that something takes many times as long as it could.

    Args:
        what: runs in Python.
        why: it cannot run in C, and the cure.
    """
    words = f"{what} runs in Python: {why}"
    if words not in _said and not _hushed:
        print(f"pneud: {words}", file=sys.stderr)
    _said[words] = None


def field() -> dict[str, list[str]]:
    """What has been said in this process, for a result as JSON; nothing where all runs in C."""
    return {"in_python": list(_said)} if _said else {}


def hush() -> None:
    """Say no more, as in a worker: whoever has begun it has said so."""
    global _hushed  # noqa: PLW0603 - of this process
    _hushed = True
