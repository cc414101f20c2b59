"""Where frames come from: a bus that is listened to, or a recording of one. Nothing is sent."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from pneud.bus.link import Link
from pneud.config.sections import ConfigError
from pneud.log.files.naming import LogError
from pneud.log.files.reader import read_log
from pneud.replay import traffic
from pneud.replay.remarks import Remarks
from pneud.signals import Frame

LOG = ".mcap"
PERIOD_S = 0.05  # how often a bus is emptied


def recorded(path: Path, remarks: Remarks) -> Iterator[Frame]:
    """The frames of a recording, or of a log of pneud, in order.

    Raises:
        ConfigError: its name says another format.
        LogError: it cannot be read.
    """
    if path.suffix.lower() == LOG or path.is_dir():
        yield from _logged(path)
        return
    if path.suffix.lower() not in traffic.FORMATS:
        known = ", ".join((*traffic.FORMATS, LOG))
        raise ConfigError(f"{path}: no such format; its name must end in one of {known}")
    channel = None
    for passing in traffic.read(path, remarks, fd=True):
        channel = passing.channel if channel is None else channel
        if passing.channel == channel:
            yield passing.frame
        else:
            remarks.add(f"frames on channels other than {channel}, left out", path.name, partial=False)


def _logged(path: Path) -> Iterator[Frame]:
    found = False
    for tick in read_log(path):
        found = True
        yield from tick.frames[: tick.before]
        sent = [f for f in tick.sent if f.stamp_ns >= 0]
        yield from sorted((*tick.frames[tick.before :], *sent), key=lambda f: f.stamp_ns)
    if not found:
        raise LogError(f"{path}: no tick in it")


def heard(link: Link, seconds: float, stop: Callable[[], bool]) -> Iterator[list[Frame]]:
    """What comes on a bus, a portion at a time, until the time is over or `stop()`."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0.0 and not stop():
        frames: list[Frame] = []
        link.watch_clock()
        link.wait(min(PERIOD_S, left))
        time.sleep(min(PERIOD_S, max(0.0, until - time.monotonic())))
        link.drain(frames)
        yield frames
