"""The fault engine: plays a scenario on the software rig, and sees what becomes of the load.

It stands between the nodes and the wire (`PlantNode.hook`), and between the nodes and the cylinder
(`PlantNode`'s `advance`). Time is that of the frames' stamps, so the same scenario and seed give the same run
in simulated time. Faults begin and end with a SYNC.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any, get_args

from pneud.bus.codec import ROLES, Codec, Codecs
from pneud.bus.wire import CAN_ERR_FLAG, wire_time_ns
from pneud.physics.plant import PlantParameters
from pneud.rig import dynamics
from pneud.rig.damage import UNDAMAGED, advance_damaged, scaled
from pneud.rig.dynamics import PlantState
from pneud.rig.node import ENCODER_NODE, PRESSURE_NODE, VALVE_NODE, Advance, PlantNode, ids_of_nodes
from pneud.rig.segment import Segment
from pneud.scenario import format as kinds
from pneud.scenario.format import SIGNALS, Scenario
from pneud.signals import Frame, ValveState

NODES = {"encoder": ENCODER_NODE, "pressure": PRESSURE_NODE, "valve": VALVE_NODE}
SETTLE_S = 2.0  # how long the load is watched after the controller has ended
WATCH_S = 1e-3  # how closely
BUS_OFF, RESTARTED = 0x40, 0x100  # classes of error frames
_OF_NODE = {  # what a node sends, then what it alone hears
    "encoder": ("encoder",),
    "pressure": ("pressure",),
    "valve": ("valve_status", "valve_command"),
}
_TOUCHING = (kinds.ChosenFault, kinds.Reboot, kinds.Silence)  # frames show them
_PHYSICAL = get_args(kinds.PLANT)
_EMCY, _HEARTBEAT = 0x081, 0x701  # of the first node
_OPERATIONAL = 5

Machine = Callable[[int], None]
"""Told the number of a fault of the machine when it begins; how it ends is the machine's business."""


def _nothing(_: int) -> None:
    """Without a machine."""


class _Playing:
    """One fault, and what is remembered of it."""

    def __init__(self, number: int, fault: Any) -> None:
        self.number = number
        self.fault = fault
        self.began_ns = -1
        self.counts: dict[int, int] = {}  # frames seen, by identifier
        self.memory: dict[int, Any] = {}  # by identifier


def _over(playing: _Playing, t_ns: int) -> bool:
    for_s = playing.fault.for_s
    return for_s is not None and t_ns >= playing.began_ns + for_s * 1e9


class Effects:
    """What plant and bus have shown from the first fault's onset on."""

    def __init__(self) -> None:
        self.onset_ns = -1
        self.onset_m_s = math.nan
        self.evidence_ns = -1  # of the first frame that shows it
        self.centred_ns = -1  # of the first disabled command after it, or when the valve gave up waiting
        self.ticks = 0  # SYNCs from evidence to centre, that of the evidence included
        self.onset_ticks = 0  # as before, from the onset
        self.from_m = math.nan  # where the load was at the evidence, without one when it was centred
        self.travel_m = 0.0  # furthest from there
        self.peak_pa = 0.0
        self.impact_m_s = 0.0  # hardest on an end stop
        self.engaged = False  # the valve was enabled at any time

    def as_dict(self) -> dict[str, Any]:
        """For JSON: times from the onset [ms], travel [mm]; None for what did not happen."""
        seen, centred = self.evidence_ns >= 0, self.centred_ns >= 0
        return {
            "onset": self.onset_ns >= 0,
            "speed_m_s": self.onset_m_s if self.onset_ns >= 0 else None,
            "evidence_ms": (self.evidence_ns - self.onset_ns) * 1e-6 if seen else None,
            "centred_ms": (self.centred_ns - self.onset_ns) * 1e-6 if centred else None,
            "ticks": self.ticks if seen and centred else None,
            "onset_ticks": self.onset_ticks if centred else None,
            "travel_mm": 1e3 * self.travel_m if centred else None,
            "peak_bar": 1e-5 * self.peak_pa,
            "impact_m_s": self.impact_m_s,
            "engaged": self.engaged,
        }


class Engine:
    """Plays one scenario on one plant; `node` is that plant's node."""

    def __init__(
        self,
        scenario: Scenario,
        p: PlantParameters,
        codecs: Codecs,
        seed: int,
        rate_hz: float,
        machine: Machine = _nothing,
        advance: Advance = dynamics.advance,
        segment: Segment | None = None,
    ) -> None:
        self.effects = Effects()
        self.before: Callable[[int], None] | None = None
        """Told of every SYNC, where sensors run free of every command, before anything begins with it."""
        self.node = PlantNode(p, codecs, seed, hook=self._hook, advance=self._advance, segment=segment)
        self._healthy = p
        self._damage = UNDAMAGED
        self._codecs = codecs
        self._machine = machine
        self._inner = advance
        self._period_ns = round(1e9 / rate_hz)
        self._random = random.Random(f"scenario {seed}")
        self.take(scenario)
        self._active: list[_Playing] = []
        command = codecs.valve_command
        self._enables = command.encode(0.0, 0, 1, counter=0) != command.encode(0.0, 1, 1, counter=0)
        self._free = p.free_s > 0.0  # nobody sends SYNC: a tick is from command to command
        self._roles = {codecs.sync.can_id: "sync", codecs.valve_command.can_id: "valve_command"}
        for role, ids in zip(("encoder", "pressure", "valve_status"), ids_of_nodes(codecs), strict=True):
            self._roles |= dict.fromkeys(ids, role)
        if self.node.station is not None:
            self._roles |= dict.fromkeys(self.node.station.ids, "outputs")
        self._last: dict[int, bytes] = {}  # the newest frame of each kind, as it was meant
        self._start_ns = self._armed_ns = self._sync_ns = -1

    def take(self, scenario: Scenario) -> None:
        """Play a scenario from here on; what has been is as with any other of which nothing has begun.

        Raises:
            ValueError: something has.
        """
        if self.effects.onset_ns >= 0:
            raise ValueError("a scenario has begun, and no other one can take its place")
        self.scenario = scenario
        playing = [_Playing(i, fault) for i, fault in enumerate(scenario.fault)]
        playing.sort(key=lambda one: -float(one.fault.at_s))
        self._later = {since: [p for p in playing if p.fault.since == since] for since in ("start", "armed")}
        self._due: list[_Playing] = []  # whose time has come, if not their condition

    def begins(self, scenario: Scenario, t_ns: int) -> bool:
        """Whether a scenario would begin with the SYNC at an instant, of which `before` tells."""
        of = {"start": self._start_ns, "armed": self._armed_ns}
        return any(
            of[fault.since] >= 0 and t_ns >= of[fault.since] + fault.at_s * 1e9 and self._holds(fault.when)
            for fault in scenario.fault
        )

    def settle(self) -> None:
        """The controller is gone for good: watch the load until it must have come to rest."""
        if self.node.started:
            self.node.advance(self.node.now_ns + round(SETTLE_S * 1e9))

    def _hook(self, frame: Frame, outgoing: bool) -> Sequence[Frame]:
        role = self._roles[frame.can_id]
        if role == ("valve_command" if self._free else "sync"):
            self._tick(frame.stamp_ns)
        frames = [frame]
        for playing in self._active:
            frames = [f for before in frames for f in self._touch(playing, before, role)]
        if frames != [frame] and self.scenario.expect.evidence is None:
            self._show(frame.stamp_ns)
        self._last[frame.can_id] = frame.data
        if outgoing:
            for shown in frames:
                self._look(shown)
        elif role == "valve_command":
            self._command(frame)
        return frames

    def _tick(self, t_ns: int) -> None:
        effects = self.effects
        self._sync_ns = t_ns
        if self._start_ns < 0:
            self._start_ns = t_ns
        if self.before is not None:
            self.before(t_ns)
        if effects.centred_ns < 0:
            effects.onset_ticks += effects.onset_ns >= 0
            effects.ticks += effects.evidence_ns >= 0
        for playing in [p for p in self._active if _over(p, t_ns)]:
            self._active.remove(playing)
            self._end(playing, t_ns)
        for since_ns, later in (
            (self._start_ns, self._later["start"]),
            (self._armed_ns, self._later["armed"]),
        ):
            while later and since_ns >= 0 and t_ns >= since_ns + later[-1].fault.at_s * 1e9:
                self._due.append(later.pop())
        for playing in [p for p in self._due if self._holds(p.fault.when)]:
            self._due.remove(playing)
            self._active.append(playing)
            self._begin(playing, t_ns)
        for playing in self._active:
            self._disturb(playing, t_ns)
        self._alter(t_ns)

    def _holds(self, when: kinds.When) -> bool:
        truth = self.node.truth()
        x, v = truth.position_m, truth.state.v
        return not (
            (when.position_above_m is not None and x <= when.position_above_m)
            or (when.position_below_m is not None and x >= when.position_below_m)
            or (when.velocity_above_m_s is not None and v <= when.velocity_above_m_s)
            or (when.velocity_below_m_s is not None and v >= when.velocity_below_m_s)
        )

    def _begin(self, playing: _Playing, t_ns: int) -> None:
        node, effects, fault = self.node, self.effects, playing.fault
        playing.began_ns = t_ns
        if effects.onset_ns < 0:
            effects.onset_ns, effects.onset_ticks = t_ns, 1
            effects.onset_m_s = node.truth().state.v
        if isinstance(fault, kinds.Reboot):
            node.reboot(NODES[fault.node])
        elif isinstance(fault, kinds.Emcy):
            data = fault.code.to_bytes(2, "little") + bytes(6)
            node.put(Frame(t_ns, _EMCY + NODES[fault.node], data))
        elif isinstance(fault, kinds.ValveFailure):
            node.valve.fail()
        elif isinstance(fault, kinds.BusOff) and fault.of == "controller":
            node.put(_error(t_ns, BUS_OFF))
        elif isinstance(fault, kinds.STATION):
            self._switch(playing, began=True)
        elif isinstance(fault, kinds.MACHINE):
            self._machine(playing.number)
        if not isinstance(fault, (*_TOUCHING, *_PHYSICAL)) and self.scenario.expect.evidence is None:
            self._show(t_ns)

    def _end(self, playing: _Playing, t_ns: int) -> None:
        node, fault = self.node, playing.fault
        if isinstance(fault, kinds.Reboot):
            node.reboot(NODES[fault.node])  # from now on it counts
            node.put(Frame(t_ns, _HEARTBEAT + NODES[fault.node], bytes(1)))
        elif isinstance(fault, kinds.ValveFailure):
            node.reboot(VALVE_NODE)
        elif isinstance(fault, kinds.STATION):
            self._switch(playing, began=False)
        elif isinstance(fault, kinds.BusOff) and fault.of == "controller":
            node.put(_error(t_ns, RESTARTED))

    def _switch(self, playing: _Playing, *, began: bool) -> None:
        """What happens to inputs, brake and load cell; files see to it that there are such."""
        station, fault = self.node.station, playing.fault
        if isinstance(fault, kinds.LoadCellFault):
            self.node.cell_silent = began and fault.offset_n is None
            self.node.cell_zero_n = (fault.offset_n or 0.0) if began else 0.0
            return
        assert station is not None
        if isinstance(fault, kinds.InputsLost):
            station.speaker.silent = began
        elif isinstance(fault, kinds.BrakeFault):
            station.stuck = int(fault.stuck == "released") if began else -1
        else:
            one = station.speaker
            bit = one.bit_of(fault.input)
            one.inputs = one.inputs | bit if fault.on == began else one.inputs & ~bit

    def _disturb(self, playing: _Playing, t_ns: int) -> None:
        """What others put on the bus in this period."""
        fault = playing.fault
        if isinstance(fault, kinds.Babble):
            data = bytes.fromhex(fault.data)
            if fault.load is None:
                count = fault.per_period or 0
            else:
                on_wire_ns = wire_time_ns(len(data), self._healthy.bitrate_bit_s)
                count = round(fault.load * self._period_ns / max(1, on_wire_ns))
            for i in range(count):
                self.node.put(Frame(t_ns + i * self._period_ns // count, fault.can_id, data))
        elif isinstance(fault, kinds.ErrorFrames):
            for _ in range(fault.per_period):
                self.node.put(_error(t_ns, fault.error_class, fault.controller_status))
        elif isinstance(fault, kinds.Heartbeat):
            due_ns = playing.memory.get(0, t_ns)
            if t_ns >= due_ns:
                playing.memory[0] = due_ns + round(fault.every_ms * 1e6)
                self.node.put(Frame(t_ns, _HEARTBEAT + NODES[fault.node], bytes((_OPERATIONAL,))))

    def _alter(self, t_ns: int) -> None:
        """The plant as its faults leave it at this instant."""
        p, damage, force_n = self._healthy, UNDAMAGED, 0.0
        for playing in self._active:
            fault, elapsed_s = playing.fault, (t_ns - playing.began_ns) * 1e-9
            if isinstance(fault, kinds.Supply):
                part = min(1.0, elapsed_s / fault.ramp_s) if fault.ramp_s > 0.0 else 1.0
                supply_pa = p.gas.supply_pa + part * (fault.supply_pa - p.gas.supply_pa)
                p = p._replace(gas=p.gas._replace(supply_pa=supply_pa))
            elif isinstance(fault, kinds.Leak) and fault.chamber == 1:
                damage = damage._replace(leak1=damage.leak1 + fault.size)
            elif isinstance(fault, kinds.Leak):
                damage = damage._replace(leak2=damage.leak2 + fault.size)
            elif isinstance(fault, kinds.ValveStuck):
                damage = damage._replace(spool_v=0.01 * fault.opening_percent * p.valve.u_max_v)
            elif isinstance(fault, kinds.Seized):
                damage = damage._replace(seized=True)
            elif isinstance(fault, kinds.Mass):
                p = p._replace(cylinder=p.cylinder._replace(M=p.cylinder.M * fault.factor))
            elif isinstance(fault, kinds.FrictionFault):
                p = p._replace(friction=scaled(p.friction, fault.factor))
            elif isinstance(fault, kinds.Force):
                force_n -= fault.force_n * math.cos(2.0 * math.pi * fault.frequency_hz * elapsed_s)
        self.node.p, self._damage, self.node.force_ext_n = p, damage, force_n

    def _touch(self, playing: _Playing, frame: Frame, role: str) -> Sequence[Frame]:
        """What a fault makes of one frame."""
        fault = playing.fault
        if isinstance(fault, kinds.FrameFault):
            if role in fault.frames and self._hits(playing, fault, frame.can_id):
                return self._mishandle(playing, frame)
        elif isinstance(fault, kinds.BusOff):
            if fault.of == "controller" or role in _OF_NODE[fault.of]:
                return ()
        elif isinstance(fault, kinds.Reboot):
            if role in _OF_NODE[fault.node]:
                return ()
        elif isinstance(fault, kinds.Silence):
            if any(role == _OF_NODE[node][0] for node in fault.nodes):
                return ()
        elif isinstance(fault, kinds.Skip):
            for node in fault.nodes:
                if role == _OF_NODE[node][0] and self._hits(playing, fault, frame.can_id):
                    self.node.take_back(NODES[node], frame.can_id)
                    return ()
        elif (
            isinstance(fault, kinds.Value)
            and self._teller(fault.signal, frame) is not None
            and self._hits(playing, fault, frame.can_id)
        ):
            return self._misreport(playing, fault, frame)
        return (frame,)

    def _hits(self, playing: _Playing, fault: kinds.ChosenFault, can_id: int) -> bool:
        count = playing.counts.get(can_id, 0)
        playing.counts[can_id] = count + 1
        hit = (count % fault.every == fault.phase) != fault.keep
        return hit and (fault.probability == 1.0 or self._random.random() < fault.probability)

    def _mishandle(self, playing: _Playing, frame: Frame) -> Sequence[Frame]:
        fault, can_id = playing.fault, frame.can_id
        match fault.kind:
            case "drop":
                return ()
            case "duplicate":
                return (frame, frame)
            case "corrupt":
                bit = self._random.randrange(8 * len(frame.data))
                data = int.from_bytes(frame.data, "little") ^ 1 << bit
                return (frame._replace(data=data.to_bytes(len(frame.data), "little")),)
            case "freeze":
                last = playing.memory.setdefault(can_id, self._last.get(can_id, frame.data))
                return (frame._replace(data=last),)
            case "reorder":
                kept = playing.memory.pop(can_id, None)
                if kept is None:
                    playing.memory[can_id] = frame
                    return ()
                return (frame, kept._replace(stamp_ns=frame.stamp_ns))
        delay_ns = round(fault.delay_ms * 1e6 + fault.delay_periods * self._period_ns)
        if fault.after_sync is None:
            stamp_ns = frame.stamp_ns
        else:
            stamp_ns = self._sync_ns + round(fault.after_sync * self._period_ns)
        return (frame._replace(stamp_ns=stamp_ns + delay_ns),)

    def _misreport(self, playing: _Playing, fault: kinds.Value, frame: Frame) -> Sequence[Frame]:
        teller = self._teller(fault.signal, frame)
        assert teller is not None
        codec, place = teller
        values = list(codec.decode(frame.data))
        true = values[place]
        if fault.alternate:
            sign = playing.memory[frame.can_id] = -playing.memory.get(frame.can_id, -1)
            fault = fault.model_copy(update={"value": sign * fault.value})
        if fault.kind == "stuck":
            values[place] = playing.memory.setdefault(frame.can_id, true)
        elif fault.kind == "offset":
            values[place] = true + fault.value
        elif fault.kind == "drift":
            values[place] = true + fault.value * (frame.stamp_ns - playing.began_ns) * 1e-9
        elif fault.kind == "scale":
            values[place] = true * fault.value
        else:
            values[place] = fault.value
        if isinstance(true, int):
            values[place] = round(values[place])
        try:
            return (frame._replace(data=codec.encode(*values, counter=codec.counter(frame.data))),)
        except ValueError:
            return ()  # beyond what the frame can carry: the node has nothing to send

    def _teller(self, signal: str, frame: Frame) -> tuple[Codec, int] | None:
        """The codec by which a frame tells a value, and the value's place; None where it does not."""
        role, place = SIGNALS[signal]
        key = tuple(ROLES[role])[place]
        for answer in self._codecs.answers:
            if answer.codec.can_id == frame.can_id and key in answer.filled:
                row = self._codecs.row
                if answer.kind is None or row is None or row.kind_of[frame.can_id](frame.data) == answer.kind:
                    return answer.codec, answer.keys.index(key)
        return None

    def _look(self, frame: Frame) -> None:
        """Look for the evidence that the scenario tells of."""
        wanted = self.scenario.expect.evidence
        if wanted is None or self.effects.onset_ns < 0:
            return
        teller = self._teller(wanted.signal, frame)
        if teller is not None and teller[0].valid(frame.data):
            value = teller[0].decode(frame.data)[teller[1]]
            if (wanted.above is not None and value > wanted.above) or (
                wanted.below is not None and value < wanted.below
            ):
                self._show(frame.stamp_ns)

    def _show(self, t_ns: int) -> None:
        effects = self.effects
        if effects.evidence_ns < 0 and effects.centred_ns < 0 and effects.onset_ns >= 0:
            effects.evidence_ns, effects.ticks = t_ns, 1
            effects.from_m = self.node.state.x1

    def _command(self, frame: Frame) -> None:
        codec, effects = self._codecs.valve_command, self.effects
        if not codec.valid(frame.data):
            return
        voltage_v, enable, _ = codec.decode(frame.data)
        if enable if self._enables else voltage_v != 0.0:
            effects.engaged = True
            if self._armed_ns < 0:
                self._armed_ns = frame.stamp_ns
        elif effects.onset_ns >= 0 and effects.centred_ns < 0:
            self._centred(frame.stamp_ns)

    def _centred(self, t_ns: int) -> None:
        effects = self.effects
        effects.centred_ns = t_ns
        if effects.evidence_ns < 0:
            effects.from_m = self.node.state.x1

    def _advance(
        self,
        state: PlantState,
        command_v: float,
        force_n: float,
        t0_s: float,
        t1_s: float,
        p: PlantParameters,
    ) -> PlantState:
        if self.effects.onset_ns < 0:
            return self._inner(state, command_v, force_n, t0_s, t1_s, p)
        if self.effects.centred_ns < 0 and self.node.valve.state == ValveState.TIMED_OUT:
            self._centred(self._start_ns + round(t0_s * 1e9))  # by itself, for want of commands
        count = max(1, math.ceil((t1_s - t0_s) / WATCH_S - 1e-6))
        h = (t1_s - t0_s) / count
        for i in range(count):
            t_s = t0_s + i * h
            after = advance_damaged(state, command_v, force_n, t_s, t_s + h, p, self._damage, self._inner)
            self._watch(state, after, p)
            state = after
        return state

    def _watch(self, before: PlantState, after: PlantState, p: PlantParameters) -> None:
        effects, c = self.effects, p.cylinder
        effects.peak_pa = max(effects.peak_pa, after.p1, after.p2)
        if after.x1 <= c.x_e1 or after.x1 >= c.x_e1 + c.stroke_m:
            effects.impact_m_s = max(effects.impact_m_s, abs(before.v))
        if math.isfinite(effects.from_m):
            effects.travel_m = max(effects.travel_m, abs(after.x1 - effects.from_m))


def _error(t_ns: int, error_class: int, controller_status: int = 0) -> Frame:
    return Frame(t_ns, CAN_ERR_FLAG | error_class, bytes((0, controller_status, 0, 0, 0, 0, 0, 0)))
