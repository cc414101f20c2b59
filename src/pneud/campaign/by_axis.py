"""A run of the whole axis in simulated time: frames, checks, supervisor, scenarios; perhaps a log."""

from __future__ import annotations

import math
from collections.abc import Callable

from pneud.axis.state import AxisParameters
from pneud.campaign.by_law import RunError, aim_m
from pneud.campaign.parts import MovePart, Parts, PushPart, RestPart, SinePart, finite
from pneud.config.conversions import axis_of, expected_of
from pneud.control.reference import rest, sine, transfer
from pneud.loading import Loaded
from pneud.log.files.writer import LogWriter
from pneud.physics.ratings import DENSITY_ANR_KG_M3
from pneud.replay.lockstep import Simulation, backend_of
from pneud.replay.running import through
from pneud.rig.node import PlantNode
from pneud.safety.faults import BLOCKS_ARM, names
from pneud.scenario import verdict
from pneud.scenario.format import Scenario
from pneud.signals import Answer, Record, Request, RequestKind, State
from pneud.study.closed_loop import supply_flow_kg_s
from pneud.study.trial import SATURATED

MOST_S = 60.0  # that a way of a part may take
Figure = float | int | str | None


class _Sums:
    """What a part comes to, tick by tick."""

    def __init__(self) -> None:
        self.count = self.finite = self.saturated = 0
        self.square = self.most_m = self.step_v = self.air_kg = 0.0
        self.high_m, self.low_m = -math.inf, math.inf

    def add(
        self, error_m: float, truth_m: float, volt: float, before_v: float, full_v: float, kg: float
    ) -> None:
        self.count += 1
        self.step_v += abs(volt - before_v)
        self.saturated += abs(volt) >= full_v
        self.air_kg += kg
        self.high_m, self.low_m = max(self.high_m, truth_m), min(self.low_m, truth_m)
        if math.isfinite(error_m):
            self.finite += 1
            self.square += error_m * error_m
            self.most_m = max(self.most_m, abs(error_m))

    def figures(self) -> dict[str, Figure]:
        n = max(1, self.count)
        seen = self.finite > 0
        return {
            "rms_m": math.sqrt(self.square / self.finite) if seen else None,
            "max_m": self.most_m if seen else None,
            "chatter_v": self.step_v / n,
            "saturated": self.saturated / n,
            "air_nl": 1e3 * self.air_kg / DENSITY_ANR_KG_M3,
        }


class Player:
    """An operator of a simulation who has the parts done in turn, and measures them.

    Attributes:
        found: the figures so far.
        over: all parts are done, or something has ended them.
        refused: why, where that was a refusal.
    """

    def __init__(self, axis: AxisParameters, parts: Parts, tolerance_m: float, node: PlantNode) -> None:
        self.found: dict[str, Figure] = {}
        self.over, self.refused = False, ""
        self._axis, self._parts, self._tolerance_m, self._node = axis, list(parts), tolerance_m, node
        self._full_v = SATURATED * axis.controller.valve.u_max_v
        self._armed = self._ended = self._asked = self._arrived = self._pushes = False
        self._sums = _Sums()
        self._last_v = self._goal_m = self._from_m = 0.0
        self._stands_m = math.nan
        self._began_ns = self._behind_ns = self._span_ns = self._out_ns = -1  # the last: of an error
        self._joining_s = self._settled_s = 0.0

    @property
    def begun(self) -> bool:
        """A part has begun."""
        return self._began_ns >= 0 or bool(self.found)

    def watch(self) -> None:
        """Ask for nothing: the axis arms and tracks by itself."""
        self._armed = self._asked = True

    def close(self) -> None:
        """The run has ended in the midst of a part: what that came to until then counts."""
        if self._parts and self._began_ns >= 0:
            self._finish(self._out_ns)

    def ask(self, state: int, present: int) -> Request | None:
        """What is asked of the axis in this tick; an `Operator`."""
        if self.over:
            ended, self._ended = self._ended, True
            return None if ended else Request(RequestKind.SHUTDOWN)
        part = self._parts[0]
        if not self._armed:
            if state != State.DISARMED or present & BLOCKS_ARM:
                return None
            self._armed = True
            self._asked = isinstance(part, SinePart)
            return Request(RequestKind.ARM, (1.0,) if self._asked else ())
        if self._asked or state not in (State.HOLDING, State.TRACKING):
            return None
        self._asked = True
        stands_m = self._axis.reference.centre_m if state == State.TRACKING else self._stands_m
        if isinstance(part, SinePart):
            return Request(RequestKind.TRACK, (0.0,))
        if isinstance(part, MovePart):
            self._goal_m = aim_m(part, stands_m, self._axis)
        elif isinstance(part, RestPart) and state == State.TRACKING:
            self._goal_m = stands_m
        else:
            return None
        return Request(RequestKind.GOTO, (self._goal_m,))

    def see(self, record: Record) -> None:
        """What became of it in a tick."""
        tick = record.tick
        if self.over:
            return
        if tick.state == State.FAULT:
            self.over = True
            return
        if tick.request is not None and tick.answer != Answer.TAKEN:
            kind, answer = RequestKind(tick.request.kind), Answer(tick.answer)
            self.refused = f"{self._parts[0].name}: {kind.name.lower()}: {answer.name.lower()}"
            self.over = True
            return
        self._stands_m = tick.reference.position_m
        if not self._asked or (isinstance(self._parts[0], SinePart) and tick.state != State.TRACKING):
            self._last_v = tick.command.voltage_v
            return
        if self._began_ns < 0:
            self._begin(record)
        self._measure(record)
        self._last_v = tick.command.voltage_v

    def _begin(self, record: Record) -> None:
        part, now = self._parts[0], record.tick.reference
        self._began_ns, self._behind_ns, self._from_m = record.tick.t_ns, -1, now.position_m
        self._out_ns, self._arrived, self._settled_s = -1, False, 0.0
        self._sums = _Sums()
        if isinstance(part, SinePart):
            s = self._axis.reference
            self._joining_s = transfer(rest(now.position_m), sine(0.0, s), self._axis.transfer).T
        elif isinstance(part, PushPart):
            self._node.force_ext_n, self._pushes = part.force_n, True

    def _measure(self, record: Record) -> None:
        part, tick = self._parts[0], record.tick
        t_ns, error_m = tick.t_ns, record.true_error_m
        if isinstance(part, MovePart) and tick.in_position and tick.request is None and not self._arrived:
            self._arrived = True
            self.found[f"{part.name}_in_position_s"] = 1e-9 * (t_ns - self._began_ns)
        if self._behind_ns < 0 and self._way_is_over(record):
            self._behind_ns = self._span_ns = t_ns
        if not abs(error_m) <= self._tolerance_m:
            self._out_ns = t_ns
        behind_s = 1e-9 * (t_ns - self._behind_ns) if self._behind_ns >= 0 else -1.0
        quiet_s = {"sine": "learn_s", "rest": "settle_s"}.get(part.do)
        if quiet_s is None or behind_s >= getattr(part, quiet_s):
            kg = supply_flow_kg_s(self._node.truth().state, self._node.p) * self._axis.controller.h
            self._sums.add(error_m, record.truth_m, tick.command.voltage_v, self._last_v, self._full_v, kg)
        if isinstance(part, PushPart) and self._pushes and behind_s >= part.seconds:
            self._settle(t_ns)
            self._node.force_ext_n, self._span_ns, self._pushes = 0.0, t_ns, False
        whole_s = part.seconds + part.back_s if isinstance(part, PushPart) else part.seconds
        if behind_s >= whole_s:
            self._finish(t_ns)

    def _way_is_over(self, record: Record) -> bool:
        part, tick = self._parts[0], record.tick
        if isinstance(part, SinePart):
            return 1e-9 * (tick.t_ns - self._began_ns) >= self._joining_s
        return isinstance(part, PushPart) or (tick.state == State.HOLDING and tick.request is None)

    def _settle(self, t_ns: int) -> None:
        """How long it took since the span began; never, where the last error is that of this tick."""
        settled_s = math.inf if self._out_ns == t_ns else max(0.0, 1e-9 * (self._out_ns - self._span_ns))
        self._settled_s = max(self._settled_s, settled_s)

    def _finish(self, t_ns: int) -> None:
        part = self._parts.pop(0)
        found = self._sums.figures()
        if isinstance(part, MovePart | PushPart):
            self._settle(t_ns)
            found["settled_s"] = finite(self._settled_s)
        if isinstance(part, MovePart):
            s, way_m = self._sums, self._goal_m - self._from_m
            found["overshoot_m"] = max(
                0.0, s.high_m - self._goal_m if way_m > 0.0 else self._goal_m - s.low_m
            )
        self.found |= {f"{part.name}_{figure}": value for figure, value in found.items()}
        self._asked, self._began_ns = False, -1
        self.over = not self._parts


def play(
    loaded: Loaded,
    parts: Parts,
    seed: int,
    scenario: Scenario | None = None,
    writer: LogWriter | None = None,
    look: Callable[[float, float], None] = lambda _, __: None,
) -> dict[str, Figure]:
    """The figures of all parts, and what became of the axis.

    Args:
        loaded: the axis.
        parts: what is done; beside a scenario one sine, whose time is that of the run.
        seed: of the sensors' noise and of what a scenario leaves to chance.
        scenario: faults to inject.
        writer: gets the ticks.
        look: told how many seconds are done, and of how many at most.

    Raises:
        BuildError: the compiled law is required and cannot be had.
        RunError: it has never armed, or a part could not be done.
    """
    c = loaded.config
    axis = axis_of(c, loaded.codecs.command_lsb_v)
    longest_s = sum(p.seconds + getattr(p, "back_s", 0.0) + MOST_S for p in parts)
    if scenario is not None:
        longest_s = parts[0].seconds
    players: list[Player] = []

    def ask(state: int, present: int) -> Request | None:
        return players[0].ask(state, present)

    how = backend_of(loaded)
    run = Simulation(
        loaded, longest_s, seed, how, scenario=scenario, operator=ask if scenario is None else None
    )
    player = Player(axis, parts, expected_of(c).tolerance_m, run.node)
    players.append(player)
    if scenario is not None:
        player.watch()
    h = axis.controller.h

    def see(number: int, record: Record) -> None:
        if not run.shut:
            player.see(record)
        if number % 100 == 0:
            look(number * h, longest_s)

    tally, seen = through(run, c.loop.rate_hz, writer, see)
    if run.axis.failure is not None:
        raise RunError(f"exception in the cycle: {run.axis.failure!r}")
    if scenario is None:  # else that may be what is expected
        if player.refused:
            raise RunError(f"refused: {player.refused}")
        if never := tally.never_armed() if not player.begun else None:
            raise RunError(f"never armed: {', '.join(never)}")
    found: dict[str, Figure] = {
        **player.found,
        "state": State(tally.state).label,
        "faults": " ".join(names(tally.ever_latched)),
        "frames_lost": run.inbox.counts().lost,
    }
    if run.engine is not None and scenario is not None:
        player.close()
        found |= player.found
        run.engine.settle()
        effects, blind = run.engine.effects.as_dict(), verdict.blind_spots(loaded)
        found["as_expected"] = int(verdict.judge(scenario, c, seen, effects, blind)["met"])
    return found
