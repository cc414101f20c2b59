"""Many scenarios from one run in simulated time: until one of them begins, its run is that of all.

The run goes on with none of them. Where one would begin, a copy of the process takes it to its end, so what
comes of it is to the bit what comes of it alone.
"""

from __future__ import annotations

import json
import os
import traceback
from collections.abc import Sequence
from typing import Any

from pneud.loading import Loaded
from pneud.replay.lockstep import Simulation, backend_of
from pneud.replay.running import through
from pneud.safety.supervisor import is_engaged
from pneud.scenario import verdict
from pneud.scenario.format import Scenario
from pneud.signals import Record

Case = dict[str, Any]
_NEVER_S = 1e9


def simulated(axis: Loaded, scenarios: Sequence[Scenario]) -> list[Case]:
    """What comes of each scenario on an axis; all are equally long.

    Returns:
        What `verdict.judge` says, and how far the true load was from where it should be [mm].
    """
    return _Tree(axis, scenarios).cases()


class _AllBegunError(Exception):
    """There is nothing left to wait for."""


class _Tree:
    """A run, and the copies that have branched off."""

    def __init__(self, axis: Loaded, scenarios: Sequence[Scenario]) -> None:
        assert len({scenario.duration_s for scenario in scenarios}) == 1
        self.axis = axis
        self.waiting = dict(enumerate(scenarios))
        self.found: dict[int, Case] = {}
        self.out = -1  # where a copy says what has come of its scenario
        self.blind = verdict.blind_spots(axis)
        self.off_m = 0.0
        first = scenarios[0]
        never = tuple(fault.model_copy(update={"at_s": _NEVER_S}) for fault in first.fault)
        self.scenario = first.model_copy(update={"fault": never})
        self.run = Simulation(axis, first.duration_s, how=backend_of(axis), scenario=self.scenario)
        assert self.run.engine is not None
        self.engine = self.run.engine
        self.engine.before = self.begin

    def cases(self) -> list[Case]:
        try:
            seen = self.seen()
            if self.out >= 0:
                assert seen is not None
                self.say(self.judged(seen, self.scenario))
        except BaseException:
            if self.out < 0:
                raise
            traceback.print_exc()
            os._exit(1)
        found = self.found
        if seen is not None:  # of what never began, too
            found = found | {number: self.judged(seen, one) for number, one in self.waiting.items()}
        return [found[number] for number in sorted(found)]

    def seen(self) -> verdict.Observed | None:
        """The run to its end; None where that of every scenario is another's."""
        try:
            seen = through(self.run, self.axis.config.loop.rate_hz, look=self.look).seen
        except _AllBegunError:
            return None
        self.engine.settle()
        return seen

    def begin(self, t_ns: int) -> None:
        """A copy for each scenario that begins."""
        for number, scenario in list(self.waiting.items()):
            if not self.engine.begins(scenario, t_ns):
                continue
            del self.waiting[number]
            hears, says = os.pipe()
            child = os.fork()
            if not child:
                os.close(hears)
                self.out, self.scenario = says, scenario
                self.engine.before = None
                self.run.take(scenario)
                return
            os.close(says)
            self.found[number] = _heard(hears, child)
        if not self.waiting:
            raise _AllBegunError

    def look(self, _: int, record: Record) -> None:
        if self.engine.effects.onset_ns >= 0 and is_engaged(record.tick.state):
            self.off_m = max(self.off_m, abs(record.true_error_m))

    def judged(self, seen: verdict.Observed, scenario: Scenario) -> Case:
        told = verdict.judge(scenario, self.axis.config, seen, self.engine.effects.as_dict(), self.blind)
        return told | {"off_mm": 1e3 * self.off_m}

    def say(self, case: Case) -> None:
        """The end of a copy."""
        with os.fdopen(self.out, "w") as out:
            json.dump(case, out)
        os._exit(0)


def _heard(hears: int, child: int) -> Case:
    """What a copy says of its scenario."""
    with os.fdopen(hears) as out:
        text = out.read()
    _, status = os.waitpid(child, 0)
    if not text or status:
        why = f"its process ended with {os.waitstatus_to_exitcode(status)}"
        return {"met": False, "problems": [why], "unnoticed": [], "faults": []}
    case: Case = json.loads(text)
    return case
