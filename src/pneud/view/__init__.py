"""The live screen of an axis: one page, and the process that keeps it on a terminal."""

from pneud.view.history import History
from pneud.view.screen import ScreenInfo, Snapshot, render, status_line
from pneud.view.terminal import LEAVE_SCREEN, run, run_child

__all__ = [
    "LEAVE_SCREEN",
    "History",
    "ScreenInfo",
    "Snapshot",
    "render",
    "run",
    "run_child",
    "status_line",
]
