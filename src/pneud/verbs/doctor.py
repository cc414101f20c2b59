"""What this machine can and cannot do in real time, and the cure for each lack."""

from __future__ import annotations

from pneud.service.doctor import diagnose


def doctor(config_file: str, json: bool) -> int:
    """Examine this machine; see `diagnose`."""
    return diagnose(config_file, json)
