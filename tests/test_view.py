"""The live screen: what it shows, that it fits, and that it leaves the terminal as it was."""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from pneud import crew
from pneud.log.live.amiss import Counts
from pneud.signals import (
    ALL_SOURCES,
    HUNTING_CURES,
    Command,
    Defect,
    Estimate,
    Frame,
    Host,
    Hunting,
    Measurement,
    Record,
    Reference,
    State,
    Tick,
    Timing,
)
from pneud.view import app as app  # noqa: PLC0414 - loaded once, before all forks
from pneud.view import processes
from pneud.view.history import BUCKET_NS, SPAN_S, Column, History, Trace, span_s
from pneud.view.info import ScreenInfo
from pneud.view.plot import Cells, Curve, Guide, bar, plot, range_limits, samples, signed_limits
from pneud.view.processes import LEAVE_SCREEN
from pneud.view.screen import Page, ScreenState, Typed, status_line
from pneud.view.show import Show
from pneud.view.terminal import run, run_child
from pneud.view.text import BOLD, DIM

numbers = st.one_of(st.floats(), st.floats(-1, 1), st.sampled_from([math.nan, math.inf, -math.inf, 0.0]))
MS = 1_000_000
T0 = 10**15
NEVER_NS = 2**62
INFO = ScreenInfo(
    name="virtual",
    bus="unixcan:x1",
    rate_hz=1000.0,
    travel_min_m=0.02,
    travel_max_m=0.98,
    u_max_v=5.0,
    note="no vcan0 here",
    fault_names=("encoder_stale", "over_travel", "valve_timed_out"),
    log_path="/var/lib/pneud/virtual-1.mcap",
)
MEASUREMENT = Measurement(
    *(T0, ALL_SOURCES, 0.436801, 312_100.0, 298_300.0, 600_400.0, -0.312, 1, 2),
    *(0, 0, 0, 0, 0, 0, 61_000, 0, 0),
)
TICK = Tick(
    t_ns=T0,
    measurement=MEASUREMENT,
    request=None,
    estimate=Estimate(0.436801, 0.1571, -43.7, 100.0, 101.0, 1546.0, 1e-6, -0.31),
    reference=Reference(0.436790, 0.1571, 0.0, 0.0),
    command=Command(-0.312, 1, 0, -0.312, 0.0, 0.0),
    state=int(State.TRACKING),
    present=0,
    latched=0,
)
TIMING = Timing(27_500, 500_000, 30_000, 20_000, 84_000, 9_000)
FRAMES = tuple(Frame(T0, can_id, bytes(8)) for can_id in (0x181, 0x182, 0x183))
RECORD = Record(TICK, TIMING, FRAMES, 0, (), 0.436795)


def at(tick: int, record: Record = RECORD, **measured: int) -> Record:
    """A record `tick` milliseconds on."""
    t_ns = T0 + tick * MS
    measurement = record.tick.measurement._replace(t_ns=t_ns, **measured)
    return record._replace(tick=record.tick._replace(t_ns=t_ns, measurement=measurement))


def drawn(
    history: History,
    size: tuple[int, int] = (80, 24),
    info: ScreenInfo = INFO,
    ascii_only: bool | None = None,
    typed: Typed = Typed(),  # noqa: B008
) -> list[str]:
    """The page's lines as plain text."""
    console = Console(file=io.StringIO(), width=size[0], color_system=None, legacy_windows=False)
    with console.capture() as capture:
        console.print(Page(ScreenState(history.last, info, typed), history, size, ascii_only), end="")
    return capture.get().splitlines()


def history_of(*records: Record) -> History:
    history = History()
    history.add(records)
    return history


def test_everything_an_operator_needs_stands_on_80_by_24() -> None:
    history = history_of(*(at(i) for i in range(100)), at(102, skipped=2))
    history.log_written, history.log_dropped = 12_345, 7
    page = "\n".join(drawn(history, typed=Typed(hints=(("space", "stop"),))))
    wanted = """virtual|unixcan:x1|1000 Hz|tracking|no vcan0 here|follows the reference|20 ├|┤ 980 mm
        |436.801 mm|436.790 mm|-11.0 µm|+157.1 mm/s|-14.6 µm|3.121 bar|2.983 bar|6.004 bar
        |-43.7 N|+1546 N/s|enabled
        |-0.312 V|27.5 µs|84.0 µs|2 ticks skipped in 10 s|run 101|skipped 2|saturated 0.0 % of 10 s
        |frames in 303|missing 0|corrupt 0|frozen 0|late 0|written 12,345|dropped 7|space  stop|417 mm left
        |speed|supply|force|virtual-1.mcap"""
    for text in re.split(r"\s*\|", wanted):
        assert text in page


def test_what_is_learnt_and_what_is_amiss_fit_into_80_columns_and_what_is_at_its_bound_stands_out() -> None:
    def value(value: float, configured: float, check: str | None = None) -> dict[str, float | str | None]:
        return {"value": value, "configured": configured, "check": check}

    learnt = {
        "dead_zone_positive_v": value(0.4, 0.1, "the valve's centre"),
        "dead_zone_negative_v": value(0.1124, 0.1),
        "orifice_area_m2": value(2.1e-5, 2e-5),
        "bandwidth_hz": value(80.0, 100.0),
        "coulomb_n": value(35.0, 36.0),
        "load_n": value(-12.3, 0.0),
        "moving_mass_kg": value(15.0, 15.0),
    }
    late = at(1, fresh=6, encoder_defects=int(Defect.LATE))
    history, info = history_of(at(0), late, at(2, fresh=5)), INFO._replace(learnt=learnt)
    (row,) = [line for line in drawn(history, info=info) if line.startswith("learnt")]
    assert row.split() == (
        [
            "learnt",
            "zone",
            "400/112",
            "mV",
            "flow",
            "+5%",
            "valve",
            "-20%",
            "dry",
            "-3%",
            "mass",
            "+0%",
            "load",
            "-12",
            "N",
        ]
    )
    (frames,) = [line for line in drawn(history, info=info) if line.startswith("readings")]
    assert "missing 1  late 1  odd 0  per min 2  corrupt 0  frozen 0" in frames
    assert not [line for line in drawn(history) if line.startswith("learnt")]
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system="standard")
    console.print(Page(ScreenState(history.last, info), history, (80, 24)))
    assert "33m400/112 mV" in console.file.getvalue()  # type: ignore[attr-defined]


def test_latched_and_present_faults_are_named_and_so_is_what_the_host_says() -> None:
    tick = TICK._replace(state=int(State.FAULT), latched=0b010, present=0b110 | 1 << 30)
    record = RECORD._replace(tick=tick)
    lines = drawn(history_of(at(0, record, host=int(Host.LINK_DOWN | Host.RECORDER_LOST))))
    assert "fault" in lines[0]
    (row,) = [line for line in lines if line.startswith("faults")]
    assert row.rstrip().split("  ") == [
        *("faults", "", "over_travel", "valve_timed_out", "bit 30", "link down", "recorder lost")
    ]


def test_how_the_load_stands_at_its_target_is_shown_with_what_to_look_at() -> None:
    holding = RECORD._replace(tick=TICK._replace(state=int(State.HOLDING), in_position=1))
    assert drawn(history_of(holding))[0].rstrip().endswith("holding, in position")
    hunting = holding._replace(tick=holding.tick._replace(in_position=0, hunting=int(Hunting.FRICTION)))
    history = history_of(at(0, holding), at(1, hunting))
    lines = drawn(history)
    assert lines[0].rstrip().endswith("holding, hunting")
    assert lines[1].startswith("hunting: ")
    assert lines[2].rstrip() == f"check {HUNTING_CURES[Hunting.FRICTION]}"
    assert any("hunting: friction" in line for line in lines)
    assert "holding, hunting" in status_line(ScreenState(history.last, INFO), history)
    history.add([at(2, holding)])
    assert any("hunting over" in line for line in drawn(history))
    assert all(len(f"hunting: check {cure}") <= 80 for cure in HUNTING_CURES.values())


def test_where_it_presses_the_force_stands_in_the_place_of_the_error() -> None:
    command = TICK.command._replace(s=1.7, ustar=62.0)
    pressing = RECORD._replace(tick=TICK._replace(state=int(State.PRESSING), command=command))
    info = INFO._replace(area_1_m2=1.256e-3, area_2_m2=1.056e-3, atmosphere_pa=1e5)
    before = [at(i) for i in range(50)]
    page = "\n".join(drawn(history_of(*before, *(at(50 + i, pressing) for i in range(50))), (110, 40), info))
    for text in ("── force  +80.0 N", "wanted +62.0 N", "error +1.7 N", "load bears -43.7 N", "60 N"):
        assert text in page
    assert "── error" not in page
    assert "── force" not in "\n".join(drawn(history_of(*before), (110, 40), info))


def test_before_the_first_tick_and_in_silence_the_screen_says_so() -> None:
    history = History()
    assert any("waiting for the first tick" in line for line in drawn(history))
    history.add([RECORD])
    history.silent_s = 1.25
    assert any("no ticks for 1.2 s" in line for line in drawn(history))


@st.composite
def records(draw: st.DrawFn) -> Record:
    m = MEASUREMENT._replace(
        position_m=draw(numbers),
        p1_pa=draw(numbers),
        p2_pa=draw(numbers),
        supply_pa=draw(numbers),
        applied_v=draw(numbers),
        valve_state=draw(st.integers(0, 255)),
        host=draw(st.integers(0, 255)),
        fresh=draw(st.integers(0, 7)),
        skipped=draw(st.integers(0, 10**9)),
    )
    tick = TICK._replace(
        t_ns=T0 + draw(st.integers(0, 10**11)),
        measurement=m,
        estimate=Estimate(*(draw(numbers) for _ in Estimate._fields)),
        reference=Reference(*(draw(numbers) for _ in Reference._fields)),
        command=Command(draw(numbers), 1, draw(st.integers(0, 1)), draw(numbers), 0.0, 0.0),
        state=draw(st.integers(0, 20)),
        in_position=draw(st.integers(0, 1)),
        hunting=draw(st.integers(0, 5)),
        present=draw(st.integers(0, 2**40)),
        latched=draw(st.integers(0, 2**40)),
    )
    timing = Timing(*(draw(st.integers(-1, 2**62)) for _ in Timing._fields))
    return Record(tick, timing, FRAMES, 0, (), draw(numbers))


@settings(deadline=None, max_examples=40)
@given(st.lists(records(), max_size=3), st.tuples(st.integers(1, 250), st.integers(1, 80)), st.booleans())
def test_the_page_fills_any_terminal_exactly_whatever_the_values(
    some: list[Record], size: tuple[int, int], ascii_only: bool
) -> None:
    history = history_of(*some)
    lines = drawn(history, size, ascii_only=ascii_only)
    assert len(lines) == size[1]
    assert all(cell_len(line) == size[0] for line in lines)  # nothing of an older page shows through
    assert not ascii_only or all(line.isascii() for line in lines)
    assert "\n" not in status_line(ScreenState(history.last, INFO), history)


def swinging(tick: int) -> Record:
    """A record of a load that swings about its reference."""
    x, s = 1e-5 * math.sin(0.005 * tick), 1e4 * math.sin(0.003 * tick)
    record = at(tick)
    now = record.tick
    return record._replace(
        tick=now._replace(
            reference=now.reference._replace(position_m=now.estimate.position_m + x),
            measurement=now.measurement._replace(
                p1_pa=MEASUREMENT.p1_pa + s, p2_pa=MEASUREMENT.p2_pa - 2 * s
            ),
            command=now.command._replace(voltage_v=1e4 * x),
        )
    )


def test_a_larger_terminal_gives_larger_curves() -> None:
    history = history_of(*(swinging(i) for i in range(0, 12_000, 10)))
    dots = [
        sum(0x2800 < ord(c) < 0x2900 for line in drawn(history, size) for c in line)
        for size in ((80, 24), (80, 40), (140, 40), (140, 60))
    ]
    assert dots == sorted(set(dots))


def test_names_from_outside_cannot_command_the_terminal() -> None:
    evil = "a\x1b[2J\x07\nb"
    info = INFO._replace(name=evil, bus=evil, note=evil, log_path=evil, fault_names=(evil,))
    record = RECORD._replace(tick=TICK._replace(latched=1))
    text = "\n".join(drawn(history_of(record), info=info))
    assert "\x1b" not in text
    assert "\x07" not in text
    assert text.count("\n") == 23


def test_an_ascii_console_gets_ascii_without_being_told() -> None:
    raw = io.BytesIO()
    console = Console(file=io.TextIOWrapper(raw, encoding="ascii"), width=80, force_terminal=True)
    history = history_of(*(at(i) for i in range(1000)))
    console.print(Page(ScreenState(history.last, INFO), history, (80, 24)))
    console.file.flush()
    assert b"us" in raw.getvalue()
    assert raw.getvalue().isascii()


@given(
    st.lists(st.tuples(st.integers(1, 400 * MS), st.floats(-1e3, 1e3)), min_size=1, max_size=300),
    st.integers(2, 700),
)
def test_extremes_survive_every_width(steps: list[tuple[int, float]], width: int) -> None:
    series, t_ns, values = Trace(), T0, []
    for step, value in steps:
        t_ns += step
        series.add(t_ns, value)
        values.append((t_ns, value))
    first = (t_ns // BUCKET_NS + 1) * BUCKET_NS - round(SPAN_S * 1e9)
    recent = [v for t, v in values if t >= first]
    columns = [c for c in series.columns(t_ns, width) if c is not None]
    assert min(c[0] for c in columns) <= min(recent)
    assert max(c[1] for c in columns) >= max(recent)
    assert {v for c in columns for v in c} <= {v for _, v in values}


@given(st.integers(2, 300), st.integers(0, 499))
def test_a_spike_of_one_tick_is_seen_at_full_height(width: int, bucket: int) -> None:
    series = Trace()
    for i in range(500):
        series.add(T0 + i * BUCKET_NS, 9.0 if i == bucket else 0.0)
    columns = series.columns(T0 + 499 * BUCKET_NS, samples(width, False))
    top, *_ = plot([Curve(columns, DIM)], (0.0, 9.0), (width, 3))
    assert any(0x2800 < ord(c) < 0x2900 for text, _ in top for c in text)


def test_a_curve_moves_without_changing_its_shape() -> None:
    series, width = Trace(), 52
    for i in range(0, 20_000, 10):
        series.add(T0 + i * MS, math.sin(i * 0.003))
    end = T0 + 19_990 * MS
    column_ns = round(span_s(width) * 1e9) // width
    assert series.columns(end, width)[1:-1] == series.columns(end + column_ns, width)[:-2]


@given(
    st.lists(
        st.tuples(st.integers(1, 900 * MS), st.floats(-1e3, 1e3), st.booleans()), min_size=1, max_size=200
    ),
    st.sampled_from([(52, 52), (2, 52), (52, 53)]),
)
def test_a_curve_looked_at_while_it_grows_is_the_same_as_one_looked_at_once(
    steps: list[tuple[int, float, bool]], widths: tuple[int, int]
) -> None:
    watched, unwatched, t_ns = Trace(), Trace(), T0
    for step, value, look in steps:
        t_ns += step
        watched.add(t_ns, value)
        unwatched.add(t_ns, value)
        if look:
            watched.columns(t_ns, widths[0])
    assert watched.columns(t_ns, widths[1]) == unwatched.columns(t_ns, widths[1])


def test_values_that_are_not_finite_leave_a_gap_and_old_ones_are_forgotten() -> None:
    series = Trace()
    for i in range(100_000):
        series.add(T0 + i * BUCKET_NS, math.nan if i % 2 else 1.0)
    columns = series.columns(T0 + 99_999 * BUCKET_NS, 501)
    assert columns == [None if i % 2 else (1.0, 1.0) for i in range(99_499, 100_000)]
    assert len(series._buckets) <= 1000
    assert series.rms(T0 + 99_999 * BUCKET_NS) == 1.0
    assert math.isnan(series.rms(T0 + 200_000 * BUCKET_NS))


known = st.one_of(st.floats(-1e30, 1e30), st.floats(-1, 1), st.just(0.0))  # as a trace has them


def text_of(rows: list[Cells]) -> list[str]:
    return ["".join(text for text, _ in row) for row in rows]


def test_a_curve_of_dots_has_no_holes_and_its_guides_are_behind_it() -> None:
    steps: list[Column] = [(1.0, 1.0), (1.0, 1.0), (-1.0, -1.0), None, None, None]
    zero = Guide(0.0, "─")
    assert text_of(plot([Curve(steps, DIM)], (-1.0, 1.0), (3, 2), [zero])) == ["⠉⡆ ", "─⡇─"]
    assert text_of(plot([], (-1.0, 1.0), (3, 2), [zero])) == ["   ", "───"]


def test_of_two_curves_the_last_one_is_in_front_and_letters_tell_them_apart_without_colours() -> None:
    flat, ramp = Curve([(0.0, 0.0)] * 3, DIM, "a"), Curve([(v, v) for v in (0.0, 1.0, 2.0)], BOLD, "b")
    assert text_of(plot([flat, ramp], (0.0, 2.0), (3, 3), ascii_only=True)) == ["  b", " b ", "baa"]
    (row,) = plot([Curve(flat.columns * 2, DIM), Curve(ramp.columns * 2, BOLD)], (0.0, 2.0), (3, 1))
    assert {style for _, style in row} == {BOLD}


@settings(deadline=None, max_examples=40)
@given(st.lists(st.none() | st.tuples(known, known).map(sorted), max_size=9), st.floats(1e-9, 1e9))
def test_whatever_the_values_a_plot_has_its_size(found: list[Any], least: float) -> None:
    columns = [c and tuple(c) for c in found]
    known = [c for c in columns if c]
    limits = range_limits((min(c[0] for c in known), max(c[1] for c in known)) if known else None, least)
    for ascii_only in (False, True):
        curve = Curve(columns[: samples(5, ascii_only)], DIM)
        rows = plot([curve], limits, (5, 2), [Guide(0.0, "-")], ascii_only)
        assert [len(text) for text in text_of(rows)] == [5, 5]


@settings(deadline=None)
@given(st.floats(1e-9, 1e9))
def test_scales_are_round_and_hold_all_values(value: float) -> None:
    low, high = signed_limits((-0.3 * value, value), 1e-12)
    assert low == -high
    assert value <= high * (1 + 1e-9) < 2.6 * value
    assert f"{high:.0e}"[0] in "125"
    low, high = range_limits((value, 1.5 * value), 1e-12)
    assert low <= value
    assert 1.5 * value <= high * (1 + 1e-9)


def test_bars_are_filled_to_a_fraction_and_marked_at_the_worst() -> None:
    assert bar(0.5, 0.5, 4, False) == "██│·"
    assert bar(0.3, 0.9, 4, False) == "█▎·│"
    assert bar(0.3, 0.9, 4, True) == "█··│"
    assert bar(math.nan, math.nan, 4, False) == "····"
    assert bar(7.0, 8.0, 4, False) == "████"


def test_frames_that_were_not_used_are_counted_by_their_defect() -> None:
    history = history_of(
        at(0),
        at(1, fresh=6, encoder_defects=int(Defect.CORRUPT)),
        at(2, fresh=5, pressure_defects=int(Defect.FROZEN)),
        at(3, fresh=3, valve_defects=int(Defect.LATE)),
        at(4, fresh=0),
        at(5, fresh=0, encoder_age_ns=NEVER_NS, pressure_age_ns=NEVER_NS, valve_age_ns=NEVER_NS),
    )
    assert (history.amiss.corrupt, history.amiss.frozen, history.amiss.all) == (1, 1, Counts(3, 1, 0))


def test_free_running_sensors_owe_no_frame_in_every_tick() -> None:
    history = History(sync=False)
    history.add([at(0), at(1, fresh=0), at(2, fresh=6, encoder_defects=int(Defect.CORRUPT))])
    assert (history.amiss.all.missing, history.amiss.corrupt) == (0, 1)


def test_times_that_were_not_taken_are_in_no_histogram() -> None:
    history = history_of(RECORD, RECORD._replace(timing=Timing(-1, -1, -1, -1, -1, -1)))
    assert (history.lateness.count, history.latency.count) == (1, 1)


def streams() -> list[Any]:
    """Standard input, output and error, as they are after a descriptor has been given another one."""
    return [open(n, how, encoding="utf-8", closefd=False) for n, how in ((0, "r"), (1, "w"), (2, "w"))]


class Screen:
    """A view in a child process on a terminal of its own."""

    def __init__(self, environment: dict[str, str], through: bool = False, textual: bool = True) -> None:
        self.master, slave = os.openpty()
        termios.tcsetwinsize(slave, (24, 80))
        self.before = termios.tcgetattr(slave)
        self.slave = os.dup(slave)  # a terminal that nobody has open forgets its habits
        told_r, self.stop_w = os.pipe()
        names_r, names_w = os.pipe()
        self.between = os.fork() if through else 0
        if through and self.between:
            self.child = int(os.read(names_r, 20))
        else:
            self.child = crew.fork(
                lambda: self._be_the_view(slave, told_r, environment, textual),
                keep=(slave, told_r),
                terminal=True,
                orphaned=signal.SIGTERM,
            )
            if through:
                os.write(names_w, str(self.child).encode())
                while True:
                    signal.pause()
        for descriptor in (slave, told_r, names_r, names_w):
            os.close(descriptor)
        self.seen = ""

    @staticmethod
    def _be_the_view(slave: int, told: int, environment: dict[str, str], textual: bool) -> None:
        for descriptor in (0, 1, 2):
            os.dup2(slave, descriptor)
        os.close(slave)
        for name in ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
            os.environ.pop(name, None)
        os.environ.update({"TERM": "xterm-256color", **environment})
        sys.stdin, sys.stdout, err = streams()
        sys.__stdin__, sys.__stderr__ = sys.stdin, err  # type: ignore[misc]
        if not textual:
            sys.modules["textual"] = sys.modules["pneud.view.app"] = None  # type: ignore[assignment]
        ticks = iter(range(10**9))
        run_child(
            lambda over: Show(
                lambda: [at(next(ticks)) for _ in range(50)],
                INFO,
                lambda: over(bool(select.select([told], [], [], 0)[0])),
                log_counts=lambda: (1, 0, 0),
            )
        )

    def read_until(self, ends: Callable[[str], object]) -> None:
        """Read what the view writes until a condition holds for all of it, or the view is gone."""
        give_up = time.monotonic() + 60
        while not ends(self.seen) and time.monotonic() < give_up:
            if not select.select([self.master], [], [], 0.1)[0]:
                continue
            try:
                more = os.read(self.master, 65536)
            except OSError:  # every other end is closed
                return
            self.seen += more.decode(errors="replace")

    def status(self) -> int:
        """Exit status of the view, which must end within a minute."""
        for _ in range(6000):
            pid, status = os.waitpid(self.child, os.WNOHANG)
            if pid:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.01)
        raise AssertionError("the view does not end")

    def close(self) -> None:
        for pid in (self.child, self.between):
            if pid:
                with contextlib.suppress(ProcessLookupError, ChildProcessError):
                    os.kill(pid, signal.SIGKILL)
                    os.waitpid(pid, 0)
        with contextlib.suppress(OSError):
            os.close(self.stop_w)
        os.close(self.master)
        os.close(self.slave)

    def read_to_the_end(self) -> None:
        """Read what it writes until it is gone."""
        self.read_until(lambda _: gone(self.child))
        while select.select([self.master], [], [], 0.05)[0]:
            self.seen += os.read(self.master, 65536).decode(errors="replace")


def gone(pid: int) -> bool:
    """Whether a process has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


@contextlib.contextmanager
def screen(
    environment: dict[str, str] | None = None, through: bool = False, textual: bool = True
) -> Iterator[Screen]:
    s = Screen(environment or {}, through, textual)
    try:
        yield s
    finally:
        s.close()


MARK = "saturated"  # in a row that every picture draws anew
BOTH = pytest.mark.parametrize("textual", [True, False], ids=["textual", "rich"])


def assert_left_clean(s: Screen) -> None:
    text = s.seen
    assert "\x1b[?1049h" in text
    assert text.rindex("\x1b[?1049l") > text.rindex("\x1b[?1049h")
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")
    assert text.rindex("\x1b[?1049l") > text.rindex(MARK)
    assert termios.tcgetattr(s.slave) == s.before


@BOTH
@pytest.mark.parametrize("how", ["stop", "SIGTERM", "SIGHUP", "q"])
def test_the_terminal_is_left_as_it_was(how: str, textual: bool) -> None:
    with screen(textual=textual) as s:
        s.read_until(lambda text: text.count(MARK) >= 2)
        assert termios.tcgetattr(s.slave) != s.before
        if how == "stop":
            os.close(s.stop_w)
        elif how == "q":
            os.write(s.master, b"q")
        else:
            os.kill(s.child, getattr(signal, how))
        s.read_to_the_end()
        assert s.status() == 0
        assert "tracking" in s.seen
        assert_left_clean(s)


@BOTH
def test_the_terminal_is_left_clean_when_the_parent_is_killed(textual: bool) -> None:
    with screen(through=True, textual=textual) as s:
        s.read_until(lambda text: MARK in text)
        os.kill(s.between, signal.SIGKILL)
        s.read_to_the_end()
        assert_left_clean(s)


@BOTH
def test_keys_that_send_signals_are_the_parents_matter(textual: bool) -> None:
    with screen(textual=textual) as s:
        s.read_until(lambda text: MARK in text)
        assert termios.tcgetattr(s.slave)[3] & termios.ISIG
        for signum in (signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP):
            os.kill(s.child, signum)
        before = s.seen.count(MARK)
        s.read_until(lambda text: text.count(MARK) >= before + 2)
        assert s.seen.count(MARK) >= before + 2


@pytest.mark.parametrize("killed", [True, False])
def test_the_waiting_process_puts_a_terminal_right_that_was_not_left(killed: bool) -> None:
    master, slave = os.openpty()
    before = termios.tcgetattr(slave)

    def view() -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        tty.setraw(0)
        time.sleep(60)

    def waits() -> None:
        for descriptor in (0, 1):
            os.dup2(slave, descriptor)
        sys.stdin, sys.stdout, _ = streams()
        found = processes.Screen(view)
        while termios.tcgetattr(0) == before:
            time.sleep(0.01)
        if killed:
            os.kill(found.pid, signal.SIGKILL)
            found.wait()
        else:
            found.end()

    pid = crew.fork(waits, keep=(slave,), terminal=True)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert termios.tcgetattr(slave) == before
    assert LEAVE_SCREEN.encode() in os.read(master, 4096)
    os.close(master)
    os.close(slave)


@pytest.mark.slow
def test_a_view_on_a_stalled_terminal_still_ends() -> None:
    with screen() as s:
        s.read_until(lambda text: MARK in text)
        time.sleep(0.5)  # nobody reads: a page of some kilobytes no longer fits into the terminal's queue
        os.kill(s.child, signal.SIGTERM)
        assert s.status() in (0, -signal.SIGALRM)


@BOTH
def test_the_page_follows_the_size_of_the_terminal(textual: bool) -> None:
    with screen(textual=textual) as s:
        s.read_until(lambda text: MARK in text)
        assert "─" * 100 not in s.seen
        termios.tcsetwinsize(s.master, (40, 132))
        os.kill(s.child, signal.SIGWINCH)  # the kernel tells a terminal's own processes alone
        s.read_until(lambda text: "─" * 100 in text)
        assert "─" * 100 in s.seen


@BOTH
def test_no_color_means_no_colour(textual: bool) -> None:
    def colours(text: str) -> list[str]:
        codes = [c for group in re.findall(r"\x1b\[([\d;]*)m", text) for c in group.split(";") if c]
        return [c for c in codes if int(c) >= 30 and c not in ("39", "49")]  # which are the terminal's own

    for environment in ({}, {"NO_COLOR": "1"}):
        with screen(environment, textual=textual) as s:
            s.read_until(lambda text: MARK in text)
            assert bool(colours(s.seen)) == (not environment)


def test_a_dumb_terminal_gets_lines_without_control_codes() -> None:
    with screen({"TERM": "dumb"}) as s:
        s.read_until(lambda text: "faults none" in text)
        assert "tracking" in s.seen
        assert "\x1b" not in s.seen


def test_without_a_terminal_lines_are_written() -> None:
    out = io.StringIO()
    pictures = iter([False, False, True])
    run(Show(lambda: [RECORD], INFO, lambda: next(pictures)), console=Console(file=out, width=40))
    assert out.getvalue().splitlines()[0] == status_line(ScreenState(RECORD, INFO), history_of(RECORD))


def test_what_a_parent_writes_after_a_kill_restores_screen_and_cursor() -> None:
    assert "\x1b[?1049l" in LEAVE_SCREEN
    assert "\x1b[?25h" in LEAVE_SCREEN
