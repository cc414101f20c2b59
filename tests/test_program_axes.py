"""A program of two axes: both go through it record by record, and neither without the other."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from axis_rig import quick
from pneud.console import programs, protocol, together
from pneud.console.programs import AxisFacts, Compiled
from pneud.console.protocol import ProtocolError
from pneud.control.reference import Bounds
from pneud.loading import load_axes
from pneud.replay.lockstep import backend_of
from pneud.replay.programming import ProgrammingTogether
from pneud.replay.together import Together
from pneud.safety.faults import BLOCKS_ARM, names
from pneud.signals import Record, Request, RequestKind, Stage, State, Tick
from several import several
from test_goto_wait import status as plain_status

ARM, CLEAR = Request(RequestKind.ARM), Request(RequestKind.CLEAR)
PROGRAM = Path(__file__).parent.parent / "examples/programs/two-axes-pick-and-place.toml"
TREE: dict[str, Any] = {
    "schema": 1,
    "name": "both",
    "defaults": {"tolerance_mm": 0.5, "settle_s": 0.0, "standing_mm_s": 20.0},
    "record": [
        {"do": "goto", "to_mm": {"a1": 440.0, "a2": 450.0}},
        {"do": "goto", "axis": "a2", "to_mm": 455.0, "class": "start"},
        {"do": "until", "axis": "a2", "above_mm": 452.0},
        {"do": "wait", "for_s": 0.02},
        {"do": "goto", "axis": "a1", "to_mm": 438.0},
    ],
}


def run(folder: Path, cycles: int = 1, struck: int = 0) -> tuple[ProgrammingTogether, list[Sequence[Record]]]:
    """In simulated time; the bus of the first axis is lost in its record `struck`."""
    axes = several(folder, 2)
    found = programs.compiled(TREE, [programs.facts_of(axis.config) for axis in axes])
    wanted = programs.requests_to_begin(found, 1, cycles)
    operator = ProgrammingTogether(wanted, found.steps, 1e-6)
    sim = Together(axes, 60.0, 0, [quick()] * 2, ask=operator.ask)
    all_: list[Sequence[Record]] = []
    for records in sim.records():
        all_.append(records)
        operator.see(records)
        if struck and records[0].tick.progress.step == struck and records[0].tick.state != State.FAULT:
            sim.lanes[0].conditions = SimpleNamespace(early=lambda *_: 0, host=lambda *_: 1)  # type: ignore[assignment]
        if operator.over and len(all_) > 50:
            sim.end()
    return operator, all_


def test_every_record_begins_in_one_tick_when_all_have_done_the_one_before(tmp_path: Path) -> None:
    operator, all_ = run(tmp_path, cycles=2)
    assert operator.ended
    assert not any(passing.wrong for passing in operator.passing)
    x, y = (passing.passed for passing in operator.passing)
    assert [(one.lap, one.record, one.begin_s) for one in x] == [(o.lap, o.record, o.begin_s) for o in y]
    assert [(one.lap, one.record) for one in x] == [(lap, n) for lap in (0, 1) for n in (1, 2, 3, 4, 5)]
    kinds = {r.tick.request.kind for pair in all_ for r in pair if r.tick.request is not None}
    assert RequestKind.GO_ON in kinds


def test_where_one_is_stopped_the_other_holds(tmp_path: Path) -> None:
    operator, all_ = run(tmp_path, struck=4)
    x, y = (record.tick for record in all_[-1])
    assert operator.why.startswith("fault link_down in record 4: ip link set ")
    assert (x.progress.step, x.progress.stage) == (4, Stage.STOPPED)
    assert (y.progress.step, y.progress.stage) == (4, Stage.STOPPED)
    assert not y.latched


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_a_fault_in_any_record_of_either_is_named_and_both_go_on_there(seed: int) -> None:
    """Of the twelve records that come with pneud; which axis is struck, and when, is left to chance."""
    r, axes = random.Random(seed), load_axes("two-axes.toml")
    found = programs.compiled(programs.tree_of(PROGRAM), [programs.facts_of(axis.config) for axis in axes])
    wanted = programs.requests_to_begin(found, 1, 1)
    operator, record, axis = ProgrammingTogether(wanted, found.steps, 1e-6), seed + 1, r.randrange(2)
    struck, after = False, [ARM, Request(RequestKind.RUN, (0.0, 0.0, 1.0))]
    seen: list[tuple[int, int]] = []

    def ask(last: Sequence[Tick]) -> Mapping[int, Request]:
        if not struck:
            return operator.ask(last)
        faulty = {n: CLEAR for n, tick in enumerate(last) if tick.state == State.FAULT}
        if faulty:
            return faulty
        held = State.HOLDING, Stage.STOPPED
        armed = all((tick.state, tick.progress.stage) == held for tick in last)
        off = {n: ARM for n, tick in enumerate(last) if tick.state == State.DISARMED}
        if off and all(not last[n].present & BLOCKS_ARM for n in off):
            return off
        return dict.fromkeys((0, 1), after.pop()) if armed and len(after) > 1 else {}

    sim = Together(axes, 30.0, seed, [backend_of(axes[0])] * 2, ask=ask)
    healthy, wait = sim.lanes[axis].conditions, r.randrange(3)
    for records in sim.records():
        ticks = [one.tick for one in records]
        operator.see(records)
        sim.lanes[axis].conditions = healthy
        if not struck and ticks[axis].progress.step >= record:
            wait -= 1
            if wait < 0:
                sim.lanes[axis].conditions = SimpleNamespace(early=lambda *_: 0, host=lambda *_: 1)  # type: ignore[assignment]
                struck, at = True, ticks[0].progress.step
        elif struck and ticks[axis].latched:
            assert names(ticks[axis].latched) == ["link_down"]
            assert ticks[axis].command.enable == 0
            assert ticks[axis].progress.stage == Stage.STOPPED
        if struck and ticks[0].progress.stage >= Stage.UNDER_WAY:
            seen.append((ticks[0].progress.step, ticks[1].progress.step))
        if struck and all(tick.progress.stage == Stage.ENDED for tick in ticks):
            sim.end()
    assert all(one.turn.tick.progress.stage == Stage.ENDED for one in sim.lanes)
    assert len(after) == 1
    assert set(range(at + 1, 13)) <= {x for x, _ in seen} & {y for _, y in seen}


FACTS = AxisFacts("a1", 0.02, 0.98, Bounds(0.5, 5.0, 100.0), 2e-5, 2e-3, 0.05)


class Desk:
    def __init__(self, name: str) -> None:
        self.name = name
        self.found: Compiled | None = None

    def facts(self) -> AxisFacts:
        return FACTS._replace(name=self.name)

    def taken(self, found: Compiled) -> dict[str, Any]:
        self.found = found
        return {}

    def shares(self) -> tuple[str, ...]:
        return self.found.axes if self.found is not None else ()


def test_the_console_asks_all_axes_that_a_program_names_in_one_tick() -> None:
    desks: list[Any] = [Desk("a0"), Desk("a1"), Desk("a2")]
    plan = partial(together.plan, desks)
    with pytest.raises(ProtocolError, match="run names no axis; give one of a0, a1, a2"):
        plan(protocol.Run(v=1, id=1, verb="run"))
    orders = plan(protocol.Run(v=1, id=1, verb="run", program=TREE, cycles=3, attended=True))
    assert (orders.axes, orders.attended, orders.words) == ((1, 2), True, "run both, 3 times")
    assert len(orders.requests) == len(orders.steps) == 7
    assert set(orders.step(1)) == {1, 2}
    assert orders.step(6) == dict.fromkeys((1, 2), Request(RequestKind.RUN, (1.0, 3.0, 1.0)))
    assert orders.done is not None
    assert orders.done() == {"records": 5}
    again = plan(protocol.Run(v=1, id=2, verb="run"))
    assert (again.axes, again.requests) == ((1, 2), (Request(RequestKind.RUN, (0.0, 0.0, 1.0)),))
    with pytest.raises(ProtocolError, match="record 1"):
        plan(protocol.Run(v=1, id=3, verb="run", program={"schema": 1, "record": [{"do": "dance"}]}))


def test_of_several_the_one_that_matters_is_told() -> None:
    from pneud.console.going import Sharing  # noqa: PLC0415

    def told(stage: str, **more: Any) -> dict[str, Any]:
        return plain_status(program={"stage": stage}, **more)

    class Client:
        def ask(self, _: str) -> dict[str, Any]:
            fault = [{"name": "travel", "latched": True}]
            return {
                "axes": {"x": told("under_way"), "y": told("stopped"), "z": told("stopped", faults=fault)}
            }

    for axes, matters in ((["x", "y"], "y"), (["x", "y", "z"], "z"), (["x"], "x")):
        assert Sharing(Client(), axes).ask("status")["axis"] == matters  # type: ignore[arg-type]
