"""A program of two axes: both go through it record by record, and neither without the other."""

from __future__ import annotations

from collections.abc import Sequence
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
from pneud.replay.programming import ProgrammingTogether
from pneud.replay.together import Together
from pneud.signals import Record, Request, RequestKind, Stage, State
from several import several
from test_goto_wait import status as plain_status

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
    wanted = [[*programs.requests(steps), programs.begun(found, 1, cycles)] for steps in found.steps]
    operator = ProgrammingTogether(wanted, found.steps, 1e-6)
    sim = Together(axes, 60.0, 0, [quick()] * 2, ask=operator.ask)
    all_: list[Sequence[Record]] = []
    for records in sim.records():
        all_.append(records)
        operator.see(records)
        if struck and records[0].tick.progress.step == struck and records[0].tick.state != State.FAULT:
            sim.lanes[0].conditions = SimpleNamespace(host=lambda *_: 1)  # type: ignore[assignment]
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
    assert operator.why == "fault link_down in record 4"
    assert (x.progress.step, x.progress.stage) == (4, Stage.STOPPED)
    assert (y.progress.step, y.progress.stage) == (4, Stage.STOPPED)
    assert not y.latched


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
