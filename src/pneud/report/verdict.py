"""What a log comes to in a word, and why: good, look here, or bad."""

from __future__ import annotations

import math
from collections.abc import Iterator

from pneud.log.format.schema import Level
from pneud.loop.tracking import over_in_words
from pneud.report.frame import BAD, GOOD, LOOK, Verdict
from pneud.report.gather import LoggedRun
from pneud.report.spans import Span
from pneud.signals import ENGAGED, HUNTING_CURES, State, state_name

_NEAR = 0.5  # part of a limit from which it deserves a look
_OFTEN = 0.01  # part of the ticks
_LATE = 0.2  # part of a period


def judge(run: LoggedRun, shift_s: float = 0.0) -> Verdict:
    """The verdict on a log, whose page takes so much from its times."""
    order = [BAD, LOOK, GOOD]
    reasons = sorted(_reasons(run, shift_s), key=lambda found: order.index(found[0]))
    return Verdict(reasons[0][0] if reasons else GOOD, tuple(reason for _, reason in reasons))


def _reasons(run: LoggedRun, shift_s: float) -> Iterator[tuple[str, str]]:
    yield from _whole(run)
    yield from _faults(run, shift_s)
    yield from _error(run)
    yield from _motions(run)
    yield from _standing(run)
    yield from _timing(run)


def _whole(run: LoggedRun) -> Iterator[tuple[str, str]]:
    if run.log.truncated:
        yield BAD, f"the log is not whole: {run.log.damage}; shown is what could be read"
    if run.missing:
        yield LOOK, f"{run.missing:,} records are missing"
    if math.isnan(run.first_engaged_s):
        yield LOOK, "the axis was never engaged"


def _faults(run: LoggedRun, shift_s: float) -> Iterator[tuple[str, str]]:
    if run.latched:
        first = min(span.begin_s for spans in run.latched.values() for span in spans)
        names = ", ".join(map(run.fault_name, run.latched))
        yield BAD, f"faults latched: {names}; the first one at {first - shift_s:.3f} s"
    elif run.counted.state == State.FAULT:
        yield BAD, "the axis is in fault"
    engaged = [
        run.fault_name(bit)
        for bit, spans in run.present.items()
        if bit not in run.latched and any(_while_engaged(run, span) for span in spans)
    ]
    if engaged:
        yield LOOK, f"warnings while engaged: {', '.join(engaged)}"
    worse = sum(event.level >= Level.ERROR and event.name not in ("fault", "state") for event in run.events)
    if worse:
        yield LOOK, f"{worse} errors among the events"


def _while_engaged(run: LoggedRun, span: Span) -> bool:
    return any(
        state.begin_s < span.end_s and span.begin_s < state.end_s
        for state in run.states
        if state_name(state.value - 1) in _ENGAGED
    )


_ENGAGED = tuple(s.label for s in ENGAGED)


def _error(run: LoggedRun) -> Iterator[tuple[str, str]]:
    found = run.tracking_mm
    if found["rms"] is None:
        if not math.isnan(run.first_engaged_s):
            yield GOOD, f"no error to judge: {over_in_words(found)}"
        return
    limit_mm = 1e3 * run.config.limits.tracking_error_m
    level = LOOK if found["max"] > _NEAR * limit_mm else GOOD
    yield (
        level,
        f"error {found['rms']:.3f} mm RMS, {found['max']:.3f} mm at most of {limit_mm:g} allowed"
        f" ({over_in_words(found)}, against the {run.error_against})",
    )


def _motions(run: LoggedRun) -> Iterator[tuple[str, str]]:
    held = [m for m, behind in zip(run.motions, run.motions[1:], strict=False) if behind.kind == "hold"]
    moves = [m for m in held if m.kind in ("goto", "jog", "profile")]
    late = [m for m in moves if math.isnan(m.in_position_s)]
    if late:
        yield LOOK, f"{len(late)} of {len(moves)} moves did not come to be in position"
    elif moves:
        longest = max(m.begin_s + m.in_position_s - m.end_s for m in moves)
        count = f"all {len(moves)} moves" if len(moves) > 1 else "the move"
        yield GOOD, f"{count} in position, at the latest {longest:.3f} s after the reference"


def _standing(run: LoggedRun) -> Iterator[tuple[str, str]]:
    for cause in sorted({span.value for span in run.hunting}):
        seconds = sum(span.end_s - span.begin_s for span in run.hunting if span.value == cause)
        yield LOOK, f"hunting for {seconds:.1f} s: check {HUNTING_CURES.get(cause)}"
    if run.counted.saturated > _OFTEN * max(run.counted.ticks, 1):
        share = 100.0 * run.counted.saturated / run.counted.ticks
        yield LOOK, f"the command was held back in {share:.1f} % of the ticks"
    for name, value in run.learning.last.items():
        if value["check"]:
            yield LOOK, f"{name} was learnt up to its bound: check {value['check']}"


def _timing(run: LoggedRun) -> Iterator[tuple[str, str]]:
    if run.counted.skipped:
        level = BAD if run.counted.skipped > _OFTEN * run.counted.ticks else LOOK
        yield level, f"{run.counted.skipped:,} of {run.counted.ticks:,} ticks were skipped"
    amiss = run.readings.total()
    if amiss:
        level = LOOK if amiss > 1e-3 * run.counted.ticks else GOOD
        yield level, f"readings amiss: {run.readings.total_in_words()}"
    lateness = run.timing["lateness_ns"]
    if not run.simulated and lateness.count:
        p99_us, worst_us = (lateness.percentile_ns(q) / 1e3 for q in (99, 100))
        level = LOOK if p99_us > _LATE * 1e6 / run.log.rate_hz else GOOD
        yield level, f"wake-up {p99_us:.0f} µs late at p99, {worst_us:.0f} at most"
