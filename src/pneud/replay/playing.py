"""The frames that a log's axis received, on a bus again, at the times at which they came."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from pneud.bus.link import Link
from pneud.log.files.reader import LogReader
from pneud.log.format.records import LoggedTick
from pneud.signals import Frame


class Played(NamedTuple):
    """What became of it."""

    frames: int
    failed: int  # that the bus did not take
    late_ms: float  # the latest frame, after its time


def play(
    log: LogReader,
    link: Link,
    speed: float = 1.0,
    from_s: float = 0.0,
    stop: Callable[[], bool] = lambda: False,
) -> Played:
    """Send what was received, each frame in its time; one that cannot be sent is not tried again."""
    sent = failed = latest_ns = 0
    began_ns = first_ns = 0
    for stamp_ns, can_id, data in _received(log, from_s):
        if stop():
            break
        if not first_ns:
            first_ns, began_ns = stamp_ns, time.monotonic_ns()
        due_ns = began_ns + round((stamp_ns - first_ns) / speed)
        while (left_ns := due_ns - time.monotonic_ns()) > 0:
            time.sleep(min(left_ns * 1e-9, 0.1))
            if stop():
                return Played(sent, failed, latest_ns * 1e-6)
        latest_ns = max(latest_ns, time.monotonic_ns() - due_ns)
        if link.send(can_id, data) < 0:
            failed += 1
        else:
            sent += 1
    return Played(sent, failed, latest_ns * 1e-6)


def _received(log: LogReader, from_s: float) -> Iterator[Frame]:
    from_ns = log.start_ns() + round(from_s * 1e9) if from_s > 0.0 else 0
    for item in log.items(from_ns):
        if isinstance(item, LoggedTick) and item.log_time_ns >= from_ns:
            yield from item.frames
