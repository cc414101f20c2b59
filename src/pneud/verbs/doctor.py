"""Say what this machine can and cannot do in real time, worst first, and what helps."""

from __future__ import annotations

import sys

from pneud.service.examination import diagnose
from pneud.verbs import FileArgument, JsonOption, VerbError


def doctor(
    file: FileArgument = "virtual.toml",
    json: JsonOption = False,
) -> int:
    """Examine this machine; see `diagnose`."""
    if sys.platform != "linux":
        raise VerbError("the loop needs Linux, and so does its doctor", 3)
    return diagnose(file, json)
