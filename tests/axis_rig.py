"""An axis with the software rig in simulated time, with whatever a test does to it between ticks."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import cache
from itertools import pairwise

import pytest

from pneud.axis.cycle import Axis
from pneud.bus.inbox import Inbox
from pneud.compiled.backend import INTERPRETED, Backend, compiled
from pneud.config import conversions
from pneud.control.reference import Bounds
from pneud.loading import Loaded, load
from pneud.rig.node import PlantNode
from pneud.safety.supervisor import is_engaged
from pneud.signals import Frame, Measurement, Request, RequestKind, State, Tick
from pure2c import BuildError

PERIOD_NS = 1_000_000
H = PERIOD_NS * 1e-9
ENCODER, PRESSURE, VALVE = 0x181, 0x182, 0x183
ARM, DISARM, CLEAR, SHUTDOWN = (
    RequestKind.ARM,
    RequestKind.DISARM,
    RequestKind.CLEAR,
    RequestKind.SHUTDOWN,
)


@cache
def loaded() -> Loaded:
    return load("virtual.toml")


@cache
def quick() -> Backend:
    """Axis and plant compiled, which are the same to the last bit, where that can be had."""
    try:
        return compiled()
    except BuildError:
        return INTERPRETED


def same(frame: Frame) -> Frame | None:
    return frame


class Rig:
    """`frame` and `measurement` stand between the rig and the axis; `host` and `gap` go into every tick."""

    def __init__(self) -> None:
        config, codecs = loaded().config, loaded().codecs
        self.axis = Axis(conversions.axis_of(config, codecs.command_lsb_v))
        self.inbox = Inbox(codecs, config.bus)
        p = conversions.plant_of(config)._replace(pressure_noise_pa=0.0)
        self.node = PlantNode(p, codecs, 0, advance=quick().advance)
        self.frame: Callable[[Frame], Frame | None] = same
        self.measurement: Callable[[Measurement], Measurement] = lambda m: m
        self.host = 0
        self.t_ns = 1_000_000_000
        self.count = 0

    def tick(self, kind: int = 0, *values: float, skipped: int = 0) -> Tick:
        """One tick; what leaves for the valve is checked in each."""
        codecs = loaded().codecs
        self.t_ns += (1 + skipped) * PERIOD_NS
        for frame in self.node.poll(self.t_ns):
            self.inbox.feed(frame)
        number = self.count % 240 + 1
        self.node.on_frame(Frame(self.t_ns, codecs.sync.can_id, codecs.sync.encode(counter=number)))
        self.inbox.begin(self.t_ns)
        for answer in self.node.poll(self.t_ns + 800_000):
            altered = self.frame(answer)
            if altered is not None:
                self.inbox.feed(altered)
        m = self.measurement(self.inbox.measurement(skipped, self.host))
        tick = self.axis.cycle(m, Request(kind, values) if kind else None, self.t_ns)
        self._check(tick)
        data = codecs.valve_command.encode(
            tick.command.voltage_v, tick.command.enable, number, counter=self.count & 0xFF
        )
        self.node.on_frame(Frame(self.t_ns + 850_000, codecs.valve_command.can_id, data))
        self.count += 1
        return tick

    def go_on(self, how: Backend) -> None:
        """Compute the axis another way from now on."""
        axis = how.axis(self.axis.parameters)
        axis.thaw(self.axis.freeze())
        self.axis = axis

    def ticks(self, n: int) -> list[Tick]:
        return [self.tick() for _ in range(n)]

    def until(self, state: State, limit: int = 3000) -> Tick:
        """Tick until the axis is in a state."""
        for _ in range(limit):
            tick = self.tick()
            if tick.state == state:
                return tick
        raise AssertionError(f"not {state.label} after {limit} ticks")

    @staticmethod
    def _check(tick: Tick) -> None:
        command = tick.command
        if is_engaged(tick.state):
            assert command.enable == 1
            assert abs(command.voltage_v) <= 5.0
        else:
            assert (command.voltage_v, command.enable) == (0.0, 0)
        if tick.state != State.STOPPING:
            assert bool(tick.latched) == (tick.state == State.FAULT)


def ready() -> Rig:
    """Disarmed, with nothing that keeps it from arming."""
    return twin(_ready())


def tracking() -> Rig:
    """Armed, and on its way to the reference."""
    return twin(_tracking())


@cache
def _ready() -> Rig:
    rig = Rig()
    rig.until(State.DISARMED)
    while rig.tick().present:
        assert rig.count < 200
    return rig


@cache
def _tracking() -> Rig:
    rig = ready()
    assert rig.tick(ARM, 1.0).state == State.TRACKING
    assert all(tick.state == State.TRACKING and not tick.latched for tick in rig.ticks(60))
    return rig


def twin(rig: Rig) -> Rig:
    codecs = loaded().codecs
    shared = (
        codecs,
        codecs.sync,
        codecs.encoder,
        codecs.pressure,
        codecs.valve_status,
        codecs.valve_command,
    )
    return copy.deepcopy(rig, {id(part): part for part in shared})


def in_position_without(rig: Rig, source: int, missing: range, ticks: int) -> list[int]:
    """Whether the axis is in position, tick by tick; in some of them a source's frame does not come."""
    found = []
    for i in range(ticks):
        rig.frame = lambda f, i=i: None if f.can_id == source and i in missing else f  # type: ignore[misc]
        found.append(rig.tick().in_position)
    return found


def assert_smooth(ticks: list[Tick], bounds: Bounds, room: float = 1.0) -> None:
    """Position, velocity and acceleration of the reference never step, and the jerk keeps its bound."""
    jerk = room * bounds.jerk_m_s3
    for a, b in pairwise(tick.reference for tick in ticks):
        dv, da = b.velocity_m_s - a.velocity_m_s, b.acceleration_m_s2 - a.acceleration_m_s2
        dx = b.position_m - a.position_m
        assert dx == pytest.approx(0.5 * H * (a.velocity_m_s + b.velocity_m_s), abs=1.01 * jerk * H**3)
        assert dv == pytest.approx(
            0.5 * H * (a.acceleration_m_s2 + b.acceleration_m_s2), abs=1.01 * jerk * H**2
        )
        assert abs(da) <= 1.001 * jerk * H
        assert abs(b.jerk_m_s3) <= 1.001 * jerk
