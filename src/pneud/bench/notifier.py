"""Reference: a loop as python-can invites to write it. A Notifier's thread collects, the main thread sleeps.

Frames, codecs, law and output chain are ours; there is no supervisor and no record.
Run as a process: `python -m pneud.bench.notifier CONFIG BUS RATE_HZ SECONDS PRIORITY CPU`.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from typing import Any

import can

from pneud.bench.law_cost import LawState, begin, law_of, tick
from pneud.bench.sample import Usage
from pneud.bus import wire
from pneud.bus.codec import Codec
from pneud.loading import Loaded, load
from pneud.rt import setup

ANSWERED = 0.65  # part of the period after which the answers are looked at
SETTLE_S = 0.3  # before anything counts: the plant, too, has to get going
SYNC_COUNTERS = 240
_COMPLETE = 7


class _Latest(can.Listener):
    """The newest valid values of each source."""

    def __init__(self, codecs: dict[int, tuple[int, Codec]]) -> None:
        self._codecs = codecs
        self._offset_ns = wire.realtime_offset_ns()
        self.values: dict[int, tuple[Any, ...]] = {}
        self.fresh = 0
        self.stamp_ns = 0
        self.taken_ns = 0  # when the newest frame had been decoded

    def on_message_received(self, msg: can.Message) -> None:
        found = self._codecs.get(msg.arbitration_id)
        if found is None:
            return
        bit, codec = found
        data = bytes(msg.data)
        if codec.valid(data):
            self.values[bit] = codec.decode(data)
            self.stamp_ns = round(msg.timestamp * 1e9) - self._offset_ns
            self.fresh |= bit
            self.taken_ns = time.monotonic_ns()


def run(
    axis: Loaded, bus: str, rate_hz: float, seconds: float, priority: int, cpu: int | None
) -> dict[str, Any]:
    """The object of one turn."""
    period_ns, settle = round(1e9 / rate_hz), round(rate_hz * SETTLE_S)
    total = settle + max(1, round(rate_hz * seconds))
    answered_ns = round(period_ns * ANSWERED)
    c = axis.codecs
    p = law_of(axis)
    law: LawState | None = None
    latest = _Latest(
        {codec.can_id: (1 << i, codec) for i, codec in enumerate((c.encoder, c.pressure, c.valve_status))}
    )
    lateness_ns, wakeup_ns = [0] * total, [-1] * total
    latency_ns, own_ns = [-1] * total, [-1] * total
    setup.apply(0, cpu, True)
    if priority > 0:
        with contextlib.suppress(OSError):  # the notifier's thread, too: it inherits
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    interface, _, channel = bus.partition(":")
    skipped, incomplete = 0, 0
    clock = time.monotonic_ns
    with can.Bus(interface=interface, channel=channel) as link:
        notifier = can.Notifier(link, [latest])
        usage = Usage()
        begin_ns = deadline = clock()
        for n in range(total):
            if n == settle:
                skipped = incomplete = 0
                usage = Usage()
            deadline += period_ns
            left_ns = deadline - clock()
            time.sleep(max(0.0, left_ns * 1e-9))
            sync_ns = clock()
            lateness_ns[n] = sync_ns - deadline
            if left_ns > 0:
                wakeup_ns[n] = lateness_ns[n]
            missed = lateness_ns[n] // period_ns
            skipped += missed
            deadline += missed * period_ns
            latest.fresh = 0
            index = n % SYNC_COUNTERS + 1
            _send(link, c.sync, c.sync.encode(counter=index))
            time.sleep(max(0.0, (sync_ns + answered_ns - clock()) * 1e-9))
            woken_ns = clock()
            complete = latest.fresh == _COMPLETE
            if complete:
                p1_pa, p2_pa, supply_pa = latest.values[2]
                position_m, applied_v = latest.values[1][0], latest.values[4][0]
                if law is None:
                    law = begin(position_m, p1_pa, p2_pa, supply_pa, p)
                t_s = (sync_ns - begin_ns) * 1e-9
                law = tick(law, position_m, p1_pa, p2_pa, supply_pa, applied_v, t_s, p)
            else:
                incomplete += 1
            volts, enable = (law.command_v, 1) if law is not None else (0.0, 0)
            data = c.valve_command.encode(volts, enable, index, counter=n % c.valve_command.counter_values)
            _send(link, c.valve_command, data)
            sent_ns = clock()
            if complete:
                latency_ns[n] = sent_ns - latest.stamp_ns
                own_ns[n] = latest.taken_ns - latest.stamp_ns + sent_ns - woken_ns
        used = usage.as_object()
        notifier.stop()
    return {
        "lateness_ns": lateness_ns[settle:],
        "wakeup_ns": [ns for ns in wakeup_ns[settle:] if ns >= 0],
        "latency_ns": [ns for ns in latency_ns[settle:] if ns >= 0],
        "own_ns": [ns for ns in own_ns[settle:] if ns >= 0],
        "ticks": total - settle,
        "skipped": skipped,
        "incomplete": incomplete,
        **used,
    }


def _send(link: can.BusABC, codec: Codec, data: bytes) -> None:
    link.send(can.Message(arbitration_id=codec.can_id, data=data, is_extended_id=False))


if __name__ == "__main__":
    file, name, rate, duration, fifo, processor = sys.argv[1:7]
    only = int(processor) if int(processor) >= 0 else None
    print(json.dumps(run(load(file), name, float(rate), float(duration), int(fifo), only)))
