"""What a console is told of the daemon that it belongs to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pneud.config.models import Config


class RunFacts(NamedTuple):
    """What stays the same while a daemon runs."""

    config: Config
    path: Path  # of the configuration
    text: str  # of the configuration, as it was loaded
    bus: str
    note: str  # one line, for example how the bus was chosen
    log_path: str
    log_is_given: bool = False  # this very file, not a folder in which each run has its own
    hindrance: Callable[[], str] = str  # why no run could begin with what the files say now; "" for nothing
