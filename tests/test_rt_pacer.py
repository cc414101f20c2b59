"""The grid: phase, one tick a period, exact skip counts; then the real clock under signals and SIGSTOP."""

from __future__ import annotations

import itertools
import os
import signal
import struct
import time
from types import FrameType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.loop.pacer import Pacer

MS = 1_000_000


class FakeClock:
    """A clock that only moves when somebody sleeps, works or looks; sleeps end early or late as told."""

    def __init__(self, start_ns: int, errors_ns: list[int], look_ns: int) -> None:
        self.now = start_ns
        self.errors = list(errors_ns)
        self.look_ns = look_ns
        self.longest_sleep_s = 0.0

    def clock(self) -> int:
        self.now += self.look_ns
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.longest_sleep_s = max(self.longest_sleep_s, seconds)
        error = self.errors.pop() if self.errors else 0
        self.now += max(round(seconds * 1e9) + error, 1)


@given(
    start=st.integers(0, 2**62),
    period=st.integers(100_000, 100 * MS),
    work=st.lists(st.integers(0, 500 * MS), min_size=1, max_size=30),
    errors=st.lists(st.one_of(st.integers(-MS, 2 * MS), st.integers(0, 10_000 * MS)), max_size=30),
    look=st.integers(20, 2_000),
    spin=st.integers(0, 90_000),
)
def test_phase_is_kept_one_tick_a_period_and_skips_are_exact(
    start: int, period: int, work: list[int], errors: list[int], look: int, spin: int
) -> None:
    fake = FakeClock(start, errors, look)
    pacer = Pacer(period, spin, fake.clock, fake.sleep)
    origin, lateness, skipped = pacer.next()
    assert (lateness, skipped) == (0, 0)
    previous = origin
    for duration in work:
        fake.now += duration
        before = fake.now
        deadline, lateness, skipped = pacer.next()
        assert (deadline - origin) % period == 0
        assert 0 <= lateness < period
        assert deadline + lateness == fake.now  # the lateness is that of the return
        assert deadline - previous == (skipped + 1) * period
        assert skipped >= max(0, (before - previous) // period - 1)
        previous = deadline


@given(period=st.integers(100_000, 10 * MS), ticks_of_work=st.integers(0, 10_000), part=st.floats(0, 0.99))
def test_only_whole_missed_periods_are_skipped(period: int, ticks_of_work: int, part: float) -> None:
    fake = FakeClock(0, [], 1)
    pacer = Pacer(period, 0, fake.clock, fake.sleep)
    pacer.next()
    fake.now += ticks_of_work * period + int(part * period)
    _, _, skipped = pacer.next()
    assert skipped == max(0, ticks_of_work - 1)
    assert pacer.next()[2] == 0


def test_a_grid_that_is_put_off_goes_on_from_there() -> None:
    clock = FakeClock(5 * MS, [], 0)
    pacer = Pacer(MS, clock=clock.clock, sleep=clock.sleep)
    pacer.put_off(77)  # nothing has begun yet
    assert pacer.next() == (5 * MS, 0, 0)
    for by_ns, at_ns in ((300, 6 * MS + 300), (-500, 7 * MS - 200), (0, 8 * MS - 200)):
        pacer.put_off(by_ns)
        assert pacer.next()[::2] == (at_ns, 0)


def test_a_stop_during_the_sleep_gives_one_skip_and_no_burst() -> None:
    fake = FakeClock(0, [25 * MS + 300_000], 1)
    pacer = Pacer(MS, 0, fake.clock, fake.sleep)
    pacer.next()
    deadline, lateness, skipped = pacer.next()
    assert (skipped, lateness // 100_000) == (25, 3)
    assert pacer.next()[::2] == (deadline + MS, 0)


def test_spinning_ends_the_sleep_early_and_still_hits_the_grid_point() -> None:
    fake = FakeClock(0, [], 100)
    pacer = Pacer(MS, 50_000, fake.clock, fake.sleep)
    pacer.next()
    _, lateness, _ = pacer.next()
    assert fake.longest_sleep_s <= 0.00095
    assert lateness <= 100


@pytest.mark.parametrize(("period", "spin"), [(0, 0), (-1, 0), (1000, -1), (1000, 1000)])
def test_senseless_arguments_are_refused(period: int, spin: int) -> None:
    with pytest.raises(ValueError, match="must"):
        Pacer(period, spin)


def test_signals_neither_shorten_nor_shift_a_period() -> None:
    rung = 0

    def ring(signum: int, frame: FrameType | None) -> None:
        nonlocal rung
        rung += 1

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, 0.001, 0.001)
    try:
        pacer = Pacer(10 * MS)
        origin, _, _ = pacer.next()
        previous = origin
        for _ in range(10):
            deadline, lateness, skipped = pacer.next()
            assert time.monotonic_ns() >= deadline + lateness >= deadline
            assert deadline - previous == (skipped + 1) * 10 * MS
            previous = deadline
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert rung > 0


def test_a_stopped_process_wakes_to_one_big_skip() -> None:
    period, stop_s = 5 * MS, 0.3
    readable, writable = os.pipe()
    child = os.fork()
    if child == 0:
        pacer = Pacer(period)
        while True:
            os.write(writable, struct.pack("qqq", *pacer.next()))
    os.close(writable)
    try:
        ticks = [struct.unpack("qqq", os.read(readable, 24)) for _ in range(3)]
        os.kill(child, signal.SIGSTOP)
        os.waitpid(child, os.WUNTRACED)
        time.sleep(stop_s)
        os.kill(child, signal.SIGCONT)
        needed = int(stop_s * 1e9) // period - 1
        while max(t[2] for t in ticks) < needed:
            ticks.append(struct.unpack("qqq", os.read(readable, 24)))
            assert len(ticks) < 2 * needed, "the stop was caught up tick by tick"
        ticks += [struct.unpack("qqq", os.read(readable, 24)) for _ in range(3)]
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(readable)
    for (a, _, _), (b, lateness, skipped) in itertools.pairwise(ticks):
        assert b - a == (skipped + 1) * period
        assert 0 <= lateness < period
