"""Logs of a simulated run whose bus loses, repeats, delays and corrupts frames."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

from axis_rig import quick
from pneud.bus.inbox import Counts
from pneud.loading import load
from pneud.log.files.naming import create_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import LogHeader
from pneud.log.format.schema import Level
from pneud.log.live.notes import Note
from pneud.replay.lockstep import Simulation
from pneud.safety.faults import FAULT_NAMES
from pneud.signals import Frame, Request, RequestKind

EMERGENCY = Frame(0, 0x081, b"\x10\x23\x01\0\0\0\0\0")
OFFSET_NS = 1_700_000_000_123_456_789


def unchanged(frame: Frame, _: random.Random) -> list[Frame]:
    return [frame]


def mangle(frame: Frame, rng: random.Random) -> list[Frame]:
    match rng.randrange(400):
        case 0:
            return []
        case 1:
            return [frame._replace(data=bytes([frame.data[0] ^ 1]) + frame.data[1:])]
        case 2:
            return [frame, frame]
        case 3:
            return [frame._replace(stamp_ns=frame.stamp_ns - 2_000_000)]
        case 4:
            return [frame, EMERGENCY._replace(stamp_ns=frame.stamp_ns)]
        case 5:
            return [frame._replace(data=frame.data[:5])]
    return [frame]


def header_of(config: str) -> LogHeader:
    loaded = load(config)
    return LogHeader(
        name=loaded.config.name,
        bus="simulated",
        rate_hz=loaded.config.loop.rate_hz,
        detail="compact",
        config_name=loaded.path.name,
        config_text=loaded.text,
        dbc_name=loaded.dbc.name,
        dbc=loaded.dbc.read_bytes(),
        fault_names=FAULT_NAMES,
        realtime_offset_ns=OFFSET_NS,
        extra={},
    )


def simulated(
    path: Path,
    duration_s: float,
    change: Callable[[Frame, random.Random], list[Frame]] = unchanged,
    config: str = "virtual.toml",
    seed: int = 1,
    remark: str = "",
) -> Counts:
    """Write a log, with an operator's remark in its 300th tick; what the axis's inbox counted comes back."""
    loaded = load(config)
    run = Simulation(loaded, duration_s, seed, quick())
    rng = random.Random(seed)
    poll = run.node.poll
    run.node.poll = lambda t_ns, **how: [  # type: ignore[method-assign]
        after for before in poll(t_ns, **how) for after in change(before, rng)
    ]
    writer = LogWriter(create_log(path), header_of(config))
    for number, record in enumerate(run.records(), start=1):
        if remark and number == 300:
            request = Request(int(RequestKind.MARK))
            record = record._replace(tick=record.tick._replace(request=request))  # noqa: PLW2901
            writer.say(Note(record.tick.t_ns, Level.INFO, "console", f"uid 0: mark {remark} → taken"))
        writer.write(record)
    assert writer.close()
    return run.inbox.counts()
