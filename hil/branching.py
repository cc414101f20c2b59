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
from pneud.replay.together import Together
from pneud.safety.faults import CENTRES, names
from pneud.safety.supervisor import is_engaged
from pneud.scenario import verdict
from pneud.scenario.format import Babble, BusOff, ErrorFrames, Scenario
from pneud.scenario.verdict import Observed
from pneud.signals import Record, State

Case = dict[str, Any]
BESIDE_S = 0.5  # in which an axis that is to stop beside another one has stopped
_NEVER_S = 1e9


def simulated(axes: Sequence[Loaded], scenarios: Sequence[Scenario]) -> list[Case]:
    """What comes of each scenario; all are equally long.

    Args:
        axes: one; or several on one bus, of which the scenarios happen to the first.
        scenarios: for several axes nothing that they would do to a machine is done.

    Returns:
        What `verdict.judge` says, and how far the true load was from where it should be [mm]. Of several axes
        it is a problem, too, where another one does not do what its table says.
    """
    return _Tree(axes, scenarios).cases()


class _AllBegunError(Exception):
    """There is nothing left to wait for."""


class _Tree:
    """A run, and the copies that have branched off."""

    def __init__(self, axes: Sequence[Loaded], scenarios: Sequence[Scenario]) -> None:
        assert len({scenario.duration_s for scenario in scenarios}) == 1
        self.axis, self.others = axes[0], axes[1:]
        self.waiting = dict(enumerate(scenarios))
        self.found: dict[int, Case] = {}
        self.out = -1  # where a copy says what has come of its scenario
        self.blind = verdict.blind_spots(self.axis)
        self.off_m = 0.0
        first = scenarios[0]
        never = tuple(fault.model_copy(update={"at_s": _NEVER_S}) for fault in first.fault)
        self.scenario = first.model_copy(update={"fault": never})
        hows = [backend_of(axis) for axis in axes]
        self.run: Simulation | Together
        if self.others:
            self.run = Together(axes, first.duration_s, how=hows, scenario=self.scenario)
        else:
            self.run = Simulation(self.axis, first.duration_s, how=hows[0], scenario=self.scenario)
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

    def seen(self) -> list[Observed] | None:
        """The run to its end, of each axis; None where that of every scenario is another's."""
        try:
            if isinstance(self.run, Together):
                seen = self.through_together(self.run)
            else:
                seen = [through(self.run, self.axis.config.loop.rate_hz, look=self.look).seen]
        except _AllBegunError:
            return None
        self.engine.settle()
        return seen

    def through_together(self, run: Together) -> list[Observed]:
        """All ticks of several axes; in fault of the first one, as long as it takes the others to stop."""
        seen, ticks = [Observed() for _ in run.lanes], 0
        for records in run.records():
            self.look(0, records[0])
            for n, (lane, record) in enumerate(zip(run.lanes, records, strict=True)):
                if not lane.shut:
                    seen[n] = seen[n].then(record.tick)
            ticks += records[0].tick.state == State.FAULT
            if ticks == round(BESIDE_S * self.axis.config.loop.rate_hz):
                run.end()
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
                self.engine.take(scenario)
                return
            os.close(says)
            self.found[number] = _heard(hears, child)
        if not self.waiting:
            raise _AllBegunError

    def look(self, _: int, record: Record) -> None:
        if self.engine.effects.onset_ns >= 0 and is_engaged(record.tick.state):
            self.off_m = max(self.off_m, abs(record.true_error_m))

    def judged(self, seen: Sequence[Observed], scenario: Scenario) -> Case:
        told = verdict.judge(scenario, self.axis.config, seen[0], self.engine.effects.as_dict(), self.blind)
        problems = list(told["problems"])
        for axis, other in zip(self.others, seen[1:], strict=True):
            problems += [f"{axis.config.name}: {why}" for why in beside(axis, other, seen[0], scenario)]
        return told | {"met": not problems, "problems": problems, "off_mm": 1e3 * self.off_m}

    def say(self, case: Case) -> None:
        """The end of a copy."""
        with os.fdopen(self.out, "w") as out:
            json.dump(case, out)
        os._exit(0)


def beside(axis: Loaded, seen: Observed, struck: Observed, scenario: Scenario) -> list[str]:
    """What is wrong with how an axis got on beside the one that a scenario happened to."""
    problems, table = list[str](), axis.config.faults.others
    of_bus = any(
        isinstance(fault, Babble | ErrorFrames)
        or (isinstance(fault, BusOff) and fault.of == "controller")
        or "sync" in getattr(fault, "frames", ())
        for fault in scenario.fault
    )
    named = (*scenario.expect.faults, *scenario.expect.also) if of_bus else ()
    if own := [name for name in names(seen.latched) if name not in named]:
        problems.append(f"{', '.join(own)} of its own")
    if not seen.latched and struck.engaged:
        touched = table.centre if struck.latched & CENTRES else table.stop
        wanted = {
            "go_on": (State.TRACKING,),
            "stop": (State.STOPPING, State.HOLDING),
            "centre": (State.DISARMED,),
        }
        ends = wanted[touched if struck.latched else "go_on"]
        if seen.state not in ends:
            problems.append(f"ended {State(seen.state).label}, not {ends[-1].label}")
    return problems


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
