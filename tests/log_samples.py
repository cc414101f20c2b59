"""Records as the loop would make them: plausible ones with noise, and arbitrary ones."""

from __future__ import annotations

import math
import random
import shutil
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_type_hints

from hypothesis import strategies as st

from pneud.log.files.naming import create_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import Detail, LogHeader
from pneud.log.live import packing
from pneud.rt.folders import cache_folder
from pneud.signals import (
    REQUEST_VALUES,
    Answer,
    Command,
    Estimate,
    Frame,
    Hold,
    Hunting,
    Measurement,
    Progress,
    Record,
    Reference,
    Request,
    RequestKind,
    Stage,
    State,
    Station,
    Tick,
    Timing,
    Told,
    Weighed,
)
from pure2c import load_source

FAULTS = ("sensor_stale", "over_travel", "tracking_error")
WAYS: dict[str, packing.Pack | None] = {"python": None}  # how records are put into a ring
if shutil.which("cc") is not None:  # the loop goes without, too
    WAYS["c"] = load_source(packing.SOURCE, cache=cache_folder("compiled")).pack
OFFSET_NS = 1_700_000_000_000_000_000


def header(detail: Detail = "full") -> LogHeader:
    return LogHeader(
        name="virtual",
        bus="unixcan:x",
        rate_hz=1000.0,
        detail=detail,
        config_name="virtual.toml",
        config_text='name = "virtual"  # Ω\n',
        dbc_name="pneud.dbc",
        dbc=b'VERSION ""\n\xff',
        fault_names=FAULTS,
        realtime_offset_ns=OFFSET_NS,
        extra={"seed": "7"},
    )


def bits(record: object) -> object:
    """A record such that two are equal only if they agree to the bit, NaN and the sign of zero included."""
    if isinstance(record, float):
        return struct.pack("<d", record)
    if isinstance(record, tuple):
        return tuple(bits(part) for part in record)
    return record


def tick_at(t_ns: int, state: int = State.TRACKING) -> Tick:
    measurement = Measurement(t_ns, 7, 0.25, 3.0e5, 3.3e5, 6.0e5, 0.5, 1, 2, 0, 0, 0, 0, 0, 0, 61_000, 0, 0)
    estimate = Estimate(0.25, 0.1, 30.0, 400.0, 401.0, 5.0, 1e-7, 0.5)
    command = Command(0.5, 1, 0, 0.51, 0.01, -0.5)
    return Tick(t_ns, measurement, None, estimate, Reference(0.25, 0.1, 0.2, 0.3), command, int(state), 0, 0)


def noisy(count: int, seed: int = 1, rate_hz: float = 1000.0) -> Iterator[Record]:
    """Records of an axis that tracks a sine, with the noise of its sensors."""
    rng = random.Random(seed)
    noise = rng.gauss
    for k in range(count):
        t_ns = 1_000_000_000_000 + round(k * 1e9 / rate_hz) + abs(int(noise(60e3, 15e3)))
        phase = math.pi * k / rate_hz
        x, v, u = 0.25 + 0.05 * math.sin(phase), 0.157 * math.cos(phase), math.cos(phase) + noise(0, 0.05)
        counts = [round(p / 20 + noise(0, 5)) for p in (3e5, 3.3e5, 6e5)]
        count_byte = k & 255
        payloads = (
            (0x181, struct.pack("<iBBB", round(x * 1e6 + noise(0, 0.5)), 1, rng.randrange(3, 6), count_byte)),
            (0x182, struct.pack("<HHHB", *counts, count_byte)),
            (0x183, struct.pack("<hBHBB", round(u * 2000), 2, 0, 0, count_byte)),
            (0x203, struct.pack("<hBBHB", round(u * 2000), 1, k % 240 + 1, 0, count_byte)),
        )
        frames = [
            Frame(
                t_ns + 250_000 + 130_000 * i + int(noise(0, 3e3)),
                can_id,
                data + bytes((zlib.crc32(data) & 255,)),
            )
            for i, (can_id, data) in enumerate(payloads)
        ]
        sync = Frame(t_ns + abs(int(noise(8e3, 1e3))), 0x080, bytes((k % 240 + 1,)))
        tick = tick_at(t_ns)
        tick = tick._replace(
            measurement=tick.measurement._replace(
                position_m=round(x * 1e6) * 1e-6,
                p1_pa=counts[0] * 20.0,
                p2_pa=counts[1] * 20.0,
                supply_pa=counts[2] * 20.0,
                applied_v=round(u * 2000) / 2000,
            ),
            estimate=Estimate(
                x + noise(0, 1e-7), v + noise(0, 1e-4), 30 + noise(0, 0.5), 400 + noise(0, 0.2),
                400 + noise(0, 0.1), noise(100, 30), noise(0, 5e-7), u,
            ),
            reference=Reference(x, v, -0.5 * math.sin(phase), -1.5 * math.cos(phase)),
            command=Command(round(u * 2000) / 2000, 1, 0, u, noise(0, 1), noise(0, 0.1)),
        )  # fmt: skip
        timing = Timing(*(abs(int(noise(m, m / 20))) for m in (60e3, 520e3, 30e3, 9e3, 60e3, 5e3)))
        yield Record(tick, timing, tuple(frames[:3]), 0, (sync, frames[3]), x)


def write_log(path: Path, records: list[Record], detail: Detail = "full", per_chunk: int = 100) -> LogWriter:
    writer = LogWriter(create_log(path), header(detail))
    for index, record in enumerate(records):
        writer.write(record)
        if index % per_chunk == per_chunk - 1:
            writer.flush()
    writer.close()
    return writer


_floats = st.floats(width=64)
_ns = st.integers(-(2**61), 2**62)
_word = st.integers(0, 2**32 - 1)
_mask = st.one_of(st.integers(0, 2**63 - 1), st.integers(0, 2**126 - 1))
_t = st.integers(0, 2**61)


def _filled(of: Any) -> st.SearchStrategy[Any]:
    types = get_type_hints(of)
    parts = [
        _floats if types[name] is float else _ns if name.endswith("_ns") else _word for name in of._fields
    ]
    return st.builds(of, *parts)


_frames = st.lists(st.builds(Frame, st.integers(0, 2**61), _word, st.binary(max_size=8)), max_size=90).map(
    tuple
)
_requests = st.none() | st.builds(
    Request,
    st.sampled_from(RequestKind).map(int),
    st.lists(_floats, max_size=REQUEST_VALUES).map(tuple),
)
_ticks = st.builds(
    Tick,
    _t,
    _filled(Measurement),
    _requests,
    _filled(Estimate),
    _filled(Reference),
    _filled(Command),
    st.sampled_from(State).map(int),
    _mask,
    _mask,
    st.sampled_from(Answer).map(int),
    st.integers(0, 1),
    st.sampled_from(Hunting).map(int),
    st.none() | _filled(Told),
    st.none() | st.builds(Progress, _word, _word, st.sampled_from(Stage).map(int), _word),
    st.none() | st.builds(Station, _word, _word, st.sampled_from(Hold).map(int)),
    st.none() | st.builds(Weighed, _floats, _ns),
)


@st.composite
def any_record(draw: st.DrawFn) -> Record:
    """Any record whose numbers lie within their types."""
    frames = draw(_frames)
    before = draw(st.integers(0, len(frames)))
    return Record(draw(_ticks), draw(_filled(Timing)), frames, before, draw(_frames), draw(_floats))
