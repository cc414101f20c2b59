"""What bad information does to the command, without any physical disturbance: a table.

    python -m hil.information                       # moving at peak speed and holding still, on virtual.toml
    python -m hil.information --rows 'late*' --phases 2
    python -m hil.information --config rig.toml --json

Simulated time. Each row does one thing to the frames between nodes and inbox, from one tick on, which is
another one in each phase; the worst phase is shown, against the same run without. Frames are fed one by one,
as in the running loop, and the same seed gives the same table. A run that ends on a fault counts until then.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import math
import multiprocessing
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from itertools import islice
from typing import Any, NamedTuple

from pneud.bus.codec import Codec, Codecs
from pneud.loading import Loaded, load
from pneud.replay.lockstep import START_NS, Simulation, backend_of
from pneud.rig.node import ENCODER_NODE, PRESSURE_NODE, VALVE_NODE
from pneud.safety.faults import BLOCKS_ARM, F, names
from pneud.scenario.format import Scenario
from pneud.signals import Frame, Request, RequestKind, State

ENCODER, PRESSURE, VALVE = "encoder", "pressure", "valve_status"
ALL = (ENCODER, PRESSURE, VALVE)
NODES = {ENCODER: ENCODER_NODE, PRESSURE: PRESSURE_NODE, VALVE: VALVE_NODE}
POSITION, STATUS, AGE = (ENCODER, 0), (ENCODER, 1), (ENCODER, 2)
P1, P2, SUPPLY = (PRESSURE, 0), (PRESSURE, 1), (PRESSURE, 2)
APPLIED, VALVE_STATE = (VALVE, 0), (VALVE, 1)
FOREVER = 1 << 30
STALLED = "2 ticks skipped"  # by the controller
ARMED_TICKS, SEARCH_TICKS = 1000, 2100  # where the onset is sought: the reference is joined by then
WATCHED_TICKS, APART_TICKS = 500, 7  # after the onset; from phase to phase
RANDOM_S = 60.0
LOST, LATE, ODD = 0.002, 0.002, 0.001  # shares of sets and, of ±1 mm, of the encoder's frames
SOON, BEHIND = 0.1, 0.7  # before a set's own first frame, behind its last one; parts of the period
OLDER_S = 0.00102  # how old a frame of the last period is that tells its age


class Stream:
    """Stands between the nodes and the wire (`PlantNode.hook`), and lets an act happen from a SYNC on."""

    def __init__(self, run: Simulation, loaded: Loaded, act: Act, onset: int) -> None:
        self.run = run
        self.codecs: Codecs = loaded.codecs
        self.period_ns = round(1e9 / loaded.config.loop.rate_hz)
        self.chance = random.Random(f"information {onset}")
        self.memory: dict[str, Frame] = {}  # what an act keeps, by role
        self.fate = ""  # of a whole set
        self.sync_ns = 0  # when the last one was sent
        self._act = act
        self._syncs = -onset - 1
        self._roles = {getattr(loaded.codecs, role).can_id: role for role in ALL}

    def __call__(self, frame: Frame, _outgoing: bool) -> Sequence[Frame]:
        role = self._roles.get(frame.can_id, "")
        if frame.can_id == self.codecs.sync.can_id:
            self._syncs += 1
            self.sync_ns = frame.stamp_ns
        if not role:
            return (frame,)
        if self._syncs < 0:
            self.memory[role] = frame
            return (frame,)
        return self._act(self, self._syncs, role, frame)

    def rewritten(self, role: str, frame: Frame, place: int, value: float) -> Frame:
        """The frame with another value and a valid checksum."""
        codec: Codec = getattr(self.codecs, role)
        values = list(codec.decode(frame.data))
        values[place] = value
        return frame._replace(data=codec.encode(*values, counter=codec.counter(frame.data)))


Act = Callable[[Stream, int, str, Frame], Sequence[Frame]]
"""(stream, SYNCs since the onset, role, frame) → the frames that take its place."""


def nothing(_: Stream, __: int, ___: str, frame: Frame) -> Sequence[Frame]:
    """Without a disturbance."""
    return (frame,)


def late(
    s: Stream, i: int, role: str, frame: Frame, *,
    roles: Sequence[str] = ALL, count: int = 1, periods: int = 1, at: float | None = None, aged: bool = False,
) -> Sequence[Frame]:  # fmt: skip
    """Frames come when a later SYNC should have been answered, a whole set at once: `at` a part of a period.

    Without it they come as long after that SYNC as they would have come after their own.
    """
    if role not in roles or i >= count:
        return (frame,)
    if aged and role == ENCODER:
        frame = s.rewritten(role, frame, AGE[1], OLDER_S)
    stamp_ns = frame.stamp_ns if at is None else s.sync_ns + round(at * s.period_ns) + ALL.index(role)
    return (frame._replace(stamp_ns=stamp_ns + periods * s.period_ns),)


def lost(
    _: Stream, i: int, role: str, frame: Frame, *, roles: Sequence[str] = ALL, count: int = 1, every: int = 1
) -> Sequence[Frame]:
    """Frames get lost on their way."""
    return () if role in roles and i < count and i % every == 0 else (frame,)


def skipped(
    s: Stream, i: int, role: str, frame: Frame, *, roles: Sequence[str], count: int = 1
) -> Sequence[Frame]:
    """Nodes do not hear SYNC, and do not count it."""
    if role not in roles or i >= count:
        return (frame,)
    s.run.node.take_back(NODES[role])
    return ()


def twice(_: Stream, i: int, role: str, frame: Frame, *, roles: Sequence[str]) -> Sequence[Frame]:
    """Frames come twice."""
    return (frame, frame) if role in roles and i == 0 else (frame,)


def swapped(s: Stream, i: int, role: str, frame: Frame, *, roles: Sequence[str]) -> Sequence[Frame]:
    """Frames come after the next ones of their kind."""
    if role not in roles or i > 1:
        return (frame,)
    if i == 0:
        s.memory[role] = frame
        return ()
    return (frame, s.memory[role]._replace(stamp_ns=frame.stamp_ns))


def reverse(s: Stream, i: int, role: str, frame: Frame) -> Sequence[Frame]:
    """The encoder's frame comes last, the valve's first."""
    delay_ns = {ENCODER: 0.26, PRESSURE: 0.01, VALVE: -0.24}[role] * s.period_ns
    return (frame._replace(stamp_ns=frame.stamp_ns + round(delay_ns)),) if i == 0 else (frame,)


def repeated(
    s: Stream, i: int, role: str, frame: Frame, *, signal: tuple[str, int], count: int = 1
) -> Sequence[Frame]:
    """A value stands still while its counter goes on."""
    if role != signal[0] or i >= count:
        return (frame,)
    codec: Codec = getattr(s.codecs, role)
    return (s.rewritten(role, frame, signal[1], codec.decode(s.memory[role].data)[signal[1]]),)


def off(
    s: Stream, i: int, role: str, frame: Frame, *,
    signal: tuple[str, int], by: float, count: int = 1, alternating: bool = False,
) -> Sequence[Frame]:  # fmt: skip
    """A value is off by so much."""
    if role != signal[0] or i >= count:
        return (frame,)
    codec: Codec = getattr(s.codecs, role)
    value = codec.decode(frame.data)[signal[1]]
    return (s.rewritten(role, frame, signal[1], value + (-by if alternating and i % 2 else by)),)


def told(
    s: Stream, i: int, role: str, frame: Frame, *, signal: tuple[str, int], value: float
) -> Sequence[Frame]:
    """A value is another one, once."""
    return (s.rewritten(role, frame, signal[1], value) if (role, i) == (signal[0], 0) else frame,)


def now_and_then(s: Stream, _: int, role: str, frame: Frame) -> Sequence[Frame]:
    """Sets get lost or come late, and the encoder is off by 1 mm, each with its share."""
    if role == ENCODER:
        drawn = s.chance.random()
        s.fate = "lost" if drawn < LOST else "late" if drawn < LOST + LATE else ""
        if not s.fate and drawn < LOST + LATE + ODD:
            return off(s, 0, role, frame, signal=POSITION, by=1e-3 * s.chance.choice((-1, 1)))
    if s.fate == "lost":
        return ()
    return late(s, 0, role, frame, at=SOON) if s.fate == "late" else (frame,)


def _rows() -> Iterator[tuple[str, Act]]:
    """What can be wrong, by name."""
    one = {"encoder": (ENCODER,), "pressure": (PRESSURE,), "valve status": (VALVE,)}
    yield "none", nothing
    yield STALLED, nothing
    yield "late set, whole, 1 period, 1x", partial(late, at=SOON)
    yield "late set, behind the next", partial(late, at=BEHIND)
    yield "late set, together with the next", late
    yield "late set, whole, encoder tells its age", partial(late, at=SOON, aged=True)
    for name, roles in one.items():
        yield f"late {name} only", partial(late, roles=roles, at=SOON)
    for count in (2, 5, 20):
        yield f"late set {count}x in a row", partial(late, count=count, at=SOON)
    yield "late set 20x in a row, at its usual time", partial(late, count=20)
    for periods in (2, 3):
        yield f"late by {periods} periods, 1x", partial(late, periods=periods, at=SOON)
    yield "slip: one period late for ever", partial(late, count=FOREVER)
    for name, roles in one.items():
        yield f"slip {name} only", partial(late, roles=roles, count=FOREVER)
    yield "SYNC skipped by all nodes", partial(skipped, roles=ALL)
    for name, roles in one.items():
        yield f"SYNC skipped by {name}", partial(skipped, roles=roles)
    yield "3 SYNCs skipped by all nodes", partial(skipped, roles=ALL, count=3)
    yield "lost set 1x", lost
    for name, roles in one.items():
        yield f"lost {name} 1x", partial(lost, roles=roles)
    for count in (3, 10):
        yield f"lost encoder {count}x", partial(lost, roles=(ENCODER,), count=count)
    for count in (3, 10, 40):
        yield f"lost set {count}x", partial(lost, count=count)
    yield "lost pressure 10x", partial(lost, roles=(PRESSURE,), count=10)
    yield "every 2nd encoder lost, 200 ticks", partial(lost, roles=(ENCODER,), count=200, every=2)
    yield "duplicated set", partial(twice, roles=ALL)
    yield "duplicated encoder", partial(twice, roles=(ENCODER,))
    yield "set swapped with the next one", partial(swapped, roles=ALL)
    yield "encoder swapped with the next one", partial(swapped, roles=(ENCODER,))
    yield "pressure swapped with the next one", partial(swapped, roles=(PRESSURE,))
    yield "order within the set reversed", reverse
    for count in (1, 2):
        yield f"old position with new counter {count}x", partial(repeated, signal=POSITION, count=count)
    for by, unit, times in (
        (2, "um", 1), (10, "um", 1), (30, "um", 1), (100, "um", 1), (-100, "um", 1), (300, "um", 1),
        (1, "mm", 1), (10, "mm", 1), (100, "mm", 1), (100, "um", 2), (1, "mm", 2), (1, "mm", 5),
    ):  # fmt: skip
        metres = by * (1e-3 if unit == "mm" else 1e-6)
        yield f"encoder {by:+d} {unit} {times}x", partial(off, signal=POSITION, by=metres, count=times)
    for um in (10, 100):
        alternating = partial(off, signal=POSITION, by=1e-6 * um, alternating=True)
        yield f"encoder +-{um} um alternating 100 ticks", partial(alternating, count=100)
        yield f"encoder +-{um} um alternating for ever", partial(alternating, count=FOREVER)
    yield "encoder step +100 um stays", partial(off, signal=POSITION, by=1e-4, count=FOREVER)
    yield "encoder step +1 mm stays", partial(off, signal=POSITION, by=1e-3, count=FOREVER)
    for bar in (0.1, 0.2, 0.5, 1.0, -1.0):
        yield f"p1 {bar:+g} bar 1x", partial(off, signal=P1, by=1e5 * bar)
    yield "p2 +1 bar 1x", partial(off, signal=P2, by=1e5)
    yield "p1 +1 bar 2x", partial(off, signal=P1, by=1e5, count=2)
    yield "p1 +0.2 bar 20x", partial(off, signal=P1, by=2e4, count=20)
    yield "p1 +-0.1 bar alternating 100", partial(off, signal=P1, by=1e4, count=100, alternating=True)
    for bar in (1, -1, -2):
        yield f"supply {bar:+d} bar 1x", partial(off, signal=SUPPLY, by=1e5 * bar)
    yield "applied +1 V 1x", partial(off, signal=APPLIED, by=1.0)
    yield "applied = 0 1x", partial(told, signal=APPLIED, value=0.0)
    for state, value in (("centred", 1), ("timed out", 3), ("boot", 0)):
        yield f"valve state {state} 1x", partial(told, signal=VALVE_STATE, value=value)
    for name, value in (("error bit", 5), ("warning bit", 3), ("unreferenced", 0)):
        yield f"encoder {name} 1x", partial(told, signal=STATUS, value=value)
    yield "encoder age 255 1x", partial(told, signal=AGE, value=0.00255)


ROWS = dict(_rows())
RANDOM = f"{RANDOM_S:g} s with {LOST:.1%} lost, {LATE:.1%} late, {ODD:.1%} off by 1 mm"


class Sample(NamedTuple):
    """One tick of a run."""

    number: int  # of the period
    volts: float
    truth_m: float
    error_m: float  # against the reference
    speed_m_s: float  # of the reference
    saturated: int
    faults: int
    state: int


class Case(NamedTuple):
    """One run that is to be done."""

    config: str
    moving: bool
    row: str
    phase: int


class Outcome(NamedTuple):
    """What came of a run."""

    peak_v: float
    change_v: float  # largest difference of the command to the run without
    saturated: int
    dev_m: float  # largest distance to the run without
    error_m: float
    faults: tuple[str, ...]
    state: str


@cache
def _loaded(config: str) -> Loaded:
    return load(config)


def samples(config: str, moving: bool, row: str, onset: int, duration_s: float) -> Iterator[Sample]:
    """The ticks of a run whose row begins with a tick."""
    loaded = _loaded(config)
    rate = loaded.config.loop.rate_hz

    def operator(state: int, present: int) -> Request | None:
        if state == State.DISARMED and not present & BLOCKS_ARM:
            return Request(RequestKind.ARM, (1.0,) if moving else ())
        return None

    stall = stalled(onset / rate, 2.0 / rate) if row == STALLED else None
    run = Simulation(loaded, duration_s, 0, backend_of(loaded), scenario=stall, operator=operator)
    if stall is None:
        run.node.hook = Stream(run, loaded, ROWS.get(row, now_and_then), onset)
    for record in run.records():
        tick = record.tick
        r, c = tick.reference, tick.command
        # the reference of the sampling instant, taken back to the instant of SYNC
        wanted_m = r.position_m - r.velocity_m_s * tick.measurement.encoder_offset_ns * 1e-9
        yield Sample(
            round((tick.t_ns - START_NS) * 1e-9 * rate),
            c.voltage_v,
            record.truth_m,
            record.truth_m - wanted_m,
            r.velocity_m_s,
            c.saturated,
            (tick.latched or tick.present) & ~(1 << F.SATURATED),  # which has a column
            int(tick.state),
        )


def stalled(at_s: float, for_s: float) -> Scenario:
    """The controller stands still once."""
    fault = {"kind": "stop", "who": "daemon", "since": "start", "at_s": at_s, "for_s": for_s}
    return Scenario.model_validate({
        "schema": 1, "name": "stalled", "description": STALLED, "fault": [fault],
        "expect": {"reaction": "none"},
    })  # fmt: skip


def rate_hz(config: str) -> float:
    """Of an axis."""
    return float(_loaded(config).config.loop.rate_hz)


@cache
def undisturbed(config: str, moving: bool) -> list[Sample]:
    """The run that others are held against."""
    ticks = SEARCH_TICKS + WATCHED_TICKS + 1000
    return list(islice(samples(config, moving, "none", 0, 2.0 * ticks / rate_hz(config)), ticks))


def onset_of(case: Case) -> int:
    """The tick in which a case begins: at the reference's highest speed, where it moves."""
    searched = undisturbed(case.config, case.moving)[ARMED_TICKS:SEARCH_TICKS]
    fastest = max(range(len(searched)), key=lambda i: (round(abs(searched[i].speed_m_s), 6), -i))
    return ARMED_TICKS + (fastest if case.moving else 0) + APART_TICKS * case.phase


def outcome(case: Case) -> Outcome:
    """Do one run."""
    onset = onset_of(case)
    duration_s = 2.0 * (onset + WATCHED_TICKS) / rate_hz(case.config)
    run = samples(case.config, case.moving, case.row, onset, duration_s)
    peak_v = change_v = dev_m = error_m = 0.0
    saturated = faults = state = 0
    without = undisturbed(case.config, case.moving)
    for got in islice(run, onset, onset + WATCHED_TICKS):
        was, state = without[got.number], got.state
        faults |= got.faults
        if state == State.FAULT:
            break
        peak_v, change_v = max(peak_v, abs(got.volts)), max(change_v, abs(got.volts - was.volts))
        saturated += got.saturated
        dev_m, error_m = max(dev_m, abs(got.truth_m - was.truth_m)), max(error_m, abs(got.error_m))
    return Outcome(peak_v, change_v, saturated, dev_m, error_m, tuple(names(faults)), State(state).label)


def chance(config: str) -> dict[str, Any]:
    """A long run with a little of everything."""
    rate = rate_hz(config)
    count = total_sq = changes = worst = faults = 0.0
    bits, state, volts = 0, 0, math.nan
    run = samples(config, True, RANDOM, ARMED_TICKS, RANDOM_S + 10.0)
    for got in islice(run, ARMED_TICKS, ARMED_TICKS + round(RANDOM_S * rate)):
        bits, state = bits | got.faults, got.state
        faults += state == State.FAULT
        if state == State.FAULT:
            break
        count += 1
        total_sq += got.error_m**2
        worst = max(worst, abs(got.error_m))
        changes += abs(got.volts - volts) if math.isfinite(volts) else 0.0
        volts = got.volts
    return {
        "row": RANDOM, "seconds": count / rate, "rms_um": 1e6 * math.sqrt(total_sq / max(1.0, count)),
        "err_um": 1e6 * worst, "mean_change_v": changes / max(1.0, count - 1), "faults": names(bits),
        "state": State(state).label,
    }  # fmt: skip


def worst_of(row: str, found: Sequence[Outcome]) -> dict[str, Any]:
    """The phases of a row in one."""
    told = Counter(name for one in found for name in one.faults)
    return {
        "row": row,
        "peak_v": max(one.peak_v for one in found),
        "change_v": max(one.change_v for one in found),
        "saturated": max(one.saturated for one in found),
        "dev_um": 1e6 * max(one.dev_m for one in found),
        "err_um": 1e6 * max(one.error_m for one in found),
        "faults": dict(sorted(told.items())),
        "states": dict(sorted(Counter(one.state for one in found).items())),
    }


HEAD = f"{'disturbance':42}  peak|u| d|u|max  sat    dev um    err um  faults, state"


def in_words(row: dict[str, Any]) -> str:
    """One line of the table."""
    told = " ".join(f"{name}:{count}" for name, count in row["faults"].items())
    states = " ".join(f"{name}:{count}" for name, count in row["states"].items() if name == "fault")
    return (
        f"{row['row']:42} {row['peak_v']:8.2f} {row['change_v']:7.2f} {row['saturated']:4d} "
        f"{row['dev_um']:9.1f} {row['err_um']:9.1f}  {told}{' → ' + states if states else ''}".rstrip()
    )


def table(config: str, pattern: str, phases: int, processes: int | None) -> Iterator[tuple[str, Any]]:
    """The rows that match, moving, then holding still, each as soon as it is known: (part, row)."""
    rows = [row for row in ROWS if fnmatch.fnmatch(row, pattern)]
    cases = [Case(config, moving, row, i) for moving in (True, False) for row in rows for i in range(phases)]
    for moving in (True, False):
        undisturbed(config, moving)  # before there are processes, so that each has it
    with multiprocessing.get_context("fork").Pool(processes) as pool:
        long = pool.apply_async(chance, (config,)) if fnmatch.fnmatch(RANDOM, pattern) else None
        found: list[Outcome] = []
        for case, one in zip(cases, pool.imap(outcome, cases, chunksize=4), strict=True):
            found.append(one)
            if len(found) == phases:
                yield ("moving" if case.moving else "holding"), worst_of(case.row, found)
                found = []
        if long is not None:
            yield "random", long.get()


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--config", default="virtual.toml", help="the axis")
    parser.add_argument("--rows", default="*", metavar="PATTERN", help="only rows whose name matches")
    parser.add_argument("--phases", type=int, default=8, metavar="N", help="runs of each row")
    parser.add_argument("--processes", type=int, metavar="N", help="at once; all cores without it")
    parser.add_argument("--json", action="store_true", help="one object, at the end")
    a = parser.parse_args(arguments)
    parts: dict[str, list[Any]] = {"moving": [], "holding": [], "random": []}
    for part, row in table(a.config, a.rows, a.phases, a.processes):
        parts[part].append(row)
        if a.json:
            continue
        if part == "random":
            print(
                f"\n{row['row']}: RMS {row['rms_um']:.1f} um, worst {row['err_um']:.1f} um, "
                f"mean |du| {row['mean_change_v']:.4f} V in {row['seconds']:.1f} s; "
                f"{' '.join(row['faults']) or 'no fault'}"
            )
        else:
            if len(parts[part]) == 1:
                print(f"{'' if part == 'moving' else chr(10)}{part.capitalize()}:\n{HEAD}")
            print(in_words(row), flush=True)
    if a.json:
        print(json.dumps({"config": a.config, "phases": a.phases, **parts}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
