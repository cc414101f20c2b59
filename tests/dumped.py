"""What candump hears of vcan0."""

from __future__ import annotations

import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

RECEIVE_BYTES = 8 * 1024 * 1024  # it may have to wait for its turn while thousands of frames come
WRITES_S = 4.0  # for which it may have to write, sharing the one CPU; where a rig runs on, it never stops


@contextmanager
def dumped(file: Path) -> Iterator[None]:
    """Have candump write what is on vcan0 meanwhile."""
    with file.open("w") as seen:
        candump = subprocess.Popen(["candump", "-L", "-r", str(RECEIVE_BYTES), "vcan0"], stdout=seen)
        try:
            yield
        finally:
            size, deadline = -1, time.monotonic() + WRITES_S
            while size < file.stat().st_size and time.monotonic() < deadline:
                size = file.stat().st_size
                time.sleep(1.0)
            candump.send_signal(signal.SIGINT)
            candump.wait(10)


def frames(file: Path) -> list[tuple[str, str]]:
    """The identifiers and data, as it writes them, in order."""
    parts = (line.split()[2].partition("#") for line in file.read_text().splitlines())
    return [(can_id, data) for can_id, _, data in parts]


def identifiers(file: Path) -> Counter[str]:
    """How often each identifier was heard."""
    return Counter(can_id for can_id, _ in frames(file))
