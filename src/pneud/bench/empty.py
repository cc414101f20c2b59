"""Reference: a Python loop that does nothing but wait for absolute deadlines, set up like ours.

Run as a process: `python -m pneud.bench.empty RATE_HZ SECONDS PRIORITY CPU`.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from pneud.bench.sample import Usage
from pneud.rt import setup


def run(rate_hz: float, seconds: float, priority: int, cpu: int | None) -> dict[str, Any]:
    """The object of one turn."""
    period_ns, total = round(1e9 / rate_hz), max(1, round(rate_hz * seconds))
    lateness_ns, wakeup_ns = [0] * total, [-1] * total
    setup.apply(priority, cpu, True)
    clock, sleep = time.monotonic_ns, time.sleep
    usage = Usage()
    skipped = 0
    deadline = clock()
    for n in range(total):
        deadline += period_ns
        slept = clock() < deadline
        while (left_ns := deadline - clock()) > 0:
            sleep(left_ns * 1e-9)
        late_ns = clock() - deadline
        lateness_ns[n] = late_ns
        if slept:
            wakeup_ns[n] = late_ns
        missed = late_ns // period_ns
        skipped += missed
        deadline += missed * period_ns
    return {
        "lateness_ns": lateness_ns,
        "wakeup_ns": [ns for ns in wakeup_ns if ns >= 0],
        "ticks": total,
        "skipped": skipped,
        **usage.as_object(),
    }


if __name__ == "__main__":
    rate, duration, fifo, processor = sys.argv[1:5]
    print(
        json.dumps(
            run(float(rate), float(duration), int(fifo), int(processor) if int(processor) >= 0 else None)
        )
    )
