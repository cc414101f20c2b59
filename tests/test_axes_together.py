"""Several axes on one bus in simulated time: how they track, and what a fault of one does to the others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from commands import Figures
from pneud.compiled.backend import Backend
from pneud.loading import Loaded
from pneud.loop.tally import Tally
from pneud.replay.lockstep import Simulation, backend_of
from pneud.replay.together import ARM, Together
from pneud.safety.faults import F
from pneud.signals import Frame, Request, RequestKind, State, Tick
from several import several

UNTIL_S, DIES_S = 0.6, 0.35


def hows(axes: Sequence[Loaded]) -> list[Backend]:
    """How each is computed."""
    return [backend_of(axis) for axis in axes]


def tracked(run: Any) -> list[float]:
    """RMS error [mm] of each axis."""
    tallies: list[Tally] = []
    for records in run:
        tallies = tallies or [Tally(truth=True, timed=False) for _ in records]
        for tally, record in zip(tallies, records, strict=True):
            tally.add(record, ending=False)
    assert not any(tally.ever_latched for tally in tallies)
    return [tally.tracking.tracking_mm()["rms"] for tally in tallies]


@pytest.mark.slow
@pytest.mark.parametrize(("axes", "rate_hz"), [(2, 700.0), (4, 300.0)])
def test_several_track_as_one_alone(axes: int, rate_hz: float, tmp_path: Path, figures: Figures) -> None:
    all_ = several(tmp_path, axes, rate_hz)
    alone = Simulation(several(tmp_path, 1, rate_hz)[0], 5.0, 0, hows(all_)[0])
    (one_mm,) = tracked((record,) for record in alone.records())
    together = Together(all_, 5.0, 0, hows(all_))
    rms_mm = tracked(together.records())
    figures(f"{axes} axes at {rate_hz:g} Hz: {', '.join(f'{x:.4f}' for x in rms_mm)} mm; alone {one_mm:.4f}")
    assert all(x <= 1.2 * one_mm for x in rms_mm)
    for lane in together.lanes:
        counts = lane.turn.inbox.counts()
        assert (counts.lost, counts.late, counts.crc, counts.foreign) == (0, 0, 0, 0)
        assert counts.rx == 3 * together.lanes[0].turn.inbox.freeze().syncs


def dead_from(axes: Sequence[Loaded], at_s: float) -> list[Any]:
    """The first axis's encoder falls silent."""
    can_id, at_ns = axes[0].codecs.encoder.can_id, 1_000_000_000 + round(at_s * 1e9)

    def hook(frame: Frame, outgoing: bool) -> Sequence[Frame]:
        return () if outgoing and frame.can_id == can_id and frame.stamp_ns > at_ns else (frame,)

    return [hook, *[None] * (len(axes) - 1)]


def states(run: Together) -> tuple[list[list[State]], list[list[Request]]]:
    """The states that each axis came through, and what was asked of it."""
    seen: list[list[State]] = [[] for _ in run.lanes]
    asked: list[list[Request]] = [[] for _ in run.lanes]
    for records in run.records():
        for record, through, requests in zip(records, seen, asked, strict=True):
            if not through or through[-1] != record.tick.state:
                through.append(State(record.tick.state))
            if record.tick.request is not None and record.tick.request.kind != RequestKind.SHUTDOWN:
                requests.append(record.tick.request)
    return seen, asked


@pytest.mark.parametrize(
    ("others", "kind", "ends"),
    [
        ("", RequestKind.STOP, State.STOPPING),
        ('centre = "stop"', RequestKind.STOP, State.STOPPING),
        ('centre = "centre"', RequestKind.CENTRE, State.DISARMED),
        ('centre = "go_on"', None, State.TRACKING),
        ('centre = "go_on"\nstop = "centre"', None, State.TRACKING),
    ],
)
def test_a_node_that_dies_touches_the_others_as_the_table_says(
    others: str, kind: RequestKind | None, ends: State, tmp_path: Path
) -> None:
    axes = several(tmp_path, 2, 200.0, others)
    run = Together(axes, UNTIL_S, how=hows(axes), hooks=dead_from(axes, DIES_S))
    (first, second), (_, asked) = states(run)
    start = [State.STARTING, State.WAITING, State.DISARMED, State.TRACKING]
    assert first == [*start, State.FAULT]
    assert run.lanes[0].turn.tick.latched == 1 << F.ENCODER_MISSING
    assert second[: len(start)] == start
    assert run.lanes[1].turn.tick.latched == 0
    assert asked == [ARM] if kind is None else asked == [ARM, Request(kind)]
    if kind is not None:
        assert second[len(start)] == ends
    else:  # it is the end of the run that stops it
        assert second[len(start) :] == [State.STOPPING, State.DISARMED]


def test_all_arm_in_one_tick_or_none(tmp_path: Path) -> None:
    axes = several(tmp_path, 2, 200.0)
    _, (first, second) = states(run := Together(axes, 0.3, how=hows(axes)))
    assert first == second == [ARM]
    seen, asked = states(Together(axes, 0.3, how=hows(axes), hooks=dead_from(axes, 0.0)))
    assert asked == [[], []]
    assert all(State.TRACKING not in through for through in seen)
    assert run.lanes[0].identifiers.isdisjoint(run.lanes[1].identifiers)


def test_axes_that_set_out_together_arrive_together(tmp_path: Path) -> None:
    from pneud.config.conversions import axis_of  # noqa: PLC0415
    from pneud.control.together import alike  # noqa: PLC0415

    axes = several(tmp_path, 2, 200.0)
    motion = axis_of(axes[0].config, axes[0].codecs.command_lsb_v).motion
    to_m = (0.5, 0.46)
    begun: list[float] = []

    def ask(ticks: Sequence[Tick]) -> dict[int, Request]:
        if all(tick.state == State.DISARMED for tick in ticks) and not begun:
            return dict.fromkeys((0, 1), Request(RequestKind.ARM))
        if begun or any(tick.state != State.HOLDING for tick in ticks):
            return {}
        begun.extend(tick.reference.position_m for tick in ticks)
        ways = [abs(to - at) for to, at in zip(to_m, begun, strict=True)]
        found = alike(ways, [motion, motion])
        return {n: Request(RequestKind.GOTO, (to_m[n], *bounds)) for n, bounds in enumerate(found)}

    shares: list[float] = []
    arrived: list[int | None] = [None, None]
    for count, records in enumerate(Together(axes, 1.2, how=hows(axes), ask=ask).records()):
        if not begun or all(arrived):
            continue
        now = [
            (record.tick.reference.position_m - a) / (b - a)
            for record, a, b in zip(records, begun, to_m, strict=True)
        ]
        shares.append(now[0] - now[1])
        for n, record in enumerate(records):
            if arrived[n] is None and record.tick.state == State.HOLDING:
                arrived[n] = count
    assert begun
    assert arrived[0] is not None
    assert arrived[0] == arrived[1]
    assert max(map(abs, shares)) < 1e-9
