"""The movement test: is what moves the encoder, the right way, and do the right pressures answer?

Small bounded openings both ways, first with less force than friction holds, then until the load comes loose.
What each has shown is read from the recorded ticks alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from statistics import fmean
from typing import NamedTuple

from pneud.axis.state import AxisParameters
from pneud.control.probe import Probe
from pneud.physics.gas import signed_flow
from pneud.safety.faults import F, names
from pneud.safety.supervisor import BLOCKS
from pneud.signals import RequestKind, State, Tick

HELD = 0.6  # of Coulomb friction: it holds the load on its bristles
TOUCH_M, MOVE_M, SPEED_M_S = 1e-3, 1e-3, 0.02
RATE_V_S = 0.1  # so that the valve's edge is passed slowly
GOAL = 0.25  # of the greatest command
LOOSE = 4.0  # times static friction: whatever could move has come loose
STUCK_SHARE = 0.9  # of limits.stuck_force_n, beyond which the axis itself says that it is jammed
BETWEEN = math.sqrt(10.0)  # a scale is off by ten: nearer to that than to none
STIFFER = 7.0  # and bristles may be a few times as stiff as believed
COUNTS = 3.0  # of the encoder, up to which nothing moves
SHOWN = 1.5  # beyond which it is not still either
MEAN_S = 0.02  # of readings at either end
SPAN_S = 0.3  # of the last part, which is compared with the one before
LOOSE_S, NOISE_PA = 0.005, 300.0  # from where a load gives way, readings are few
DRIFT_M, PRESSED = 1e-4, 0.8  # at rest; of the supply in one chamber while the other is empty
LEAST_V = 0.5  # opened so far, a valve that works is open
ANSWER = 0.15  # of Coulomb friction: with less of a push a load but creeps
SILENT_PA, SILENT_SHARE = 500.0, 0.15  # less is no answer, nor so little of the other chamber's


class Finding(StrEnum):
    """What is wrong."""

    SWAPPED_HOSES = "swapped_hoses"
    ENCODER_INVERTED = "encoder_inverted"
    EXCHANGED_PRESSURES = "exchanged_pressures"
    DEAD_PRESSURE_1 = "dead_pressure_1"
    DEAD_PRESSURE_2 = "dead_pressure_2"
    SUPPLY_SHUT = "supply_shut"
    VALVE_UNPLUGGED = "valve_unplugged"
    VALVE_SILENT = "valve_silent"
    ENCODER_SCALE_LARGE = "encoder_scale_large"
    ENCODER_SCALE_SMALL = "encoder_scale_small"
    BLOCKED = "blocked"
    OPEN_AT_REST = "open_at_rest"
    BY_FAULT = "by_fault"
    STOPPED = "stopped"
    UNDECIDED = "undecided"


CURES: dict[Finding, str] = {
    Finding.SWAPPED_HOSES: "exchange the two hoses at the valve, or invert the valve's command",
    Finding.ENCODER_INVERTED: "let the encoder count the other way: it has to grow as the rod comes out;"
    " where the pressure sensors sit at the valve, see whether the hoses are exchanged",
    Finding.EXCHANGED_PRESSURES: "exchange the two pressure sensors, or their signals in the DBC",
    Finding.DEAD_PRESSURE_1: "check the sensor of chamber 1, its cable and its hose: it does not answer",
    Finding.DEAD_PRESSURE_2: "check the sensor of chamber 2, its cable and its hose: it does not answer",
    Finding.SUPPLY_SHUT: "open the supply; check the regulator",
    Finding.VALVE_UNPLUGGED: "plug the valve in: its node puts the command out and no pressure answers",
    Finding.VALVE_SILENT: "check the valve's node: what it puts out does not follow the command",
    Finding.ENCODER_SCALE_LARGE: "check the encoder's scale in the DBC: it shows several times the way that"
    " the force explains (a factor of 10 or 25.4)",
    Finding.ENCODER_SCALE_SMALL: "check the encoder's scale in the DBC: it shows a part of the way that the"
    " force explains (a factor of 10 or 25.4)",
    Finding.BLOCKED: "free the load, or couple the encoder to it: pushed both ways, nothing is seen to move",
    Finding.BY_FAULT: "see to the faults that are shown, and test again",
    Finding.STOPPED: "test again: it was stopped, or its operator was lost",
    Finding.OPEN_AT_REST: "set the valve's centre, or mend it: it lets air through at 0 V and the load does"
    " not stay where it is",
    Finding.UNDECIDED: "test again with the load in the middle of its travel, and nothing that pushes it",
}


class Seen(NamedTuple):
    """What a probe has shown, turned where it opened the other way.

    Changes are those of its last part beyond those of the part before it: what drifts is nothing that it did.
    """

    way_m: float  # greatest, as the encoder shows it
    force_n: float  # greatest change since the beginning
    p1_pa: float
    p2_pa: float
    opened_v: float  # most that was asked for
    followed_v: float  # most that the valve's node has put out
    faults: int  # that ended it
    given_m: float = 0.0  # greatest way since the beginning
    loose_m: float = 0.0  # way since the load has given way, as the encoder shows it
    pressed_m: float = 0.0  # as the pressures explain it
    blur_m: float = 0.0  # how well they can


class Expected(NamedTuple):
    """What the configuration has to say."""

    coulomb_n: float
    stiffness_n_m: float  # of the bristles
    step_m: float  # of the encoder
    answer_pa: float = 0.0  # least change of the pressures' difference that moves a load


class Verdict(NamedTuple):
    """What the movement test comes to."""

    findings: tuple[Finding, ...]
    faults: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Nothing is wrong."""
        return not self.findings

    @property
    def unfinished(self) -> bool:
        """It says nothing of the rig: what was known before still holds."""
        return bool(self.findings) and {*self.findings} <= {Finding.BY_FAULT, Finding.STOPPED}


def expected_of(p: AxisParameters) -> Expected:
    """What is looked for on an axis."""
    f = p.controller.friction
    step_m, area_m2 = p.controller.motion.blind_m * 2.0, p.controller.cylinder.A1
    return Expected(f.coulomb_n, f.sigma0_n_m, step_m, ANSWER * f.coulomb_n / area_m2)


def touches(p: AxisParameters, lease: int) -> list[Probe]:
    """Openings both ways with which the load stays where its friction holds it."""
    force_n = HELD * p.controller.friction.coulomb_n
    return _both_ways(p, TOUCH_M, force_n, lease) if force_n > 0.0 else []


def moves(p: AxisParameters, lease: int, quicker: float = 1.0) -> list[Probe]:
    """Openings both ways that let the load come loose; quicker ones give it less time to creep."""
    static_n, most_n = LOOSE * p.controller.friction.static_n, STUCK_SHARE * p.limits.stuck_force_n
    probes = _both_ways(p, MOVE_M, min(static_n, most_n) if static_n > 0.0 else most_n, lease)
    return [probe._replace(rate_v_s=quicker * probe.rate_v_s) for probe in probes]


def _both_ways(p: AxisParameters, travel_m: float, force_n: float, lease: int) -> list[Probe]:
    goal_v = GOAL * p.output.u_max_v
    return [Probe(way * goal_v, RATE_V_S, travel_m, SPEED_M_S, force_n, lease) for way in (1.0, -1.0)]


def seen(ticks: Sequence[Tick], p: AxisParameters) -> Seen:
    """What a probe has shown.

    Args:
        ticks: of the probe and the one behind it.
        p: parameters.
    """
    during = [t for t in ticks if t.state == State.PROBING]
    way = math.copysign(1.0, next((t.command.voltage_v for t in during if t.command.voltage_v), 1.0))
    opening = [t for t in during if way * t.command.voltage_v >= 0.0]  # the rest brakes
    few, span = round(MEAN_S / p.controller.h), round(SPAN_S / p.controller.h)
    span = max(1, min(span, (len(opening) - few) // 2))

    def change(of: str) -> float:
        values = [_value(t, of) for t in opening]
        ends = [fmean(values[max(0, n - few) : n]) for n in (len(values), len(values) - span)]
        before = fmean(values[max(0, len(values) - 2 * span - few) : max(1, len(values) - 2 * span)])
        return way * (ends[0] - 2.0 * ends[1] + before)

    from_m = opening[-span].measurement.position_m
    drift_m = opening[-span].measurement.position_m - opening[-2 * span].measurement.position_m
    ways = [way * (t.measurement.position_m - from_m) for t in during[len(opening) - span :]]
    loose_m, pressed_m, blur_m = _given_way(opening, p)
    return Seen(
        way_m=max(ways, key=abs) - way * drift_m,
        force_n=max(abs(t.estimate.x3_n - opening[0].estimate.x3_n) for t in opening),
        p1_pa=change("p1_pa"),
        p2_pa=change("p2_pa"),
        opened_v=max(abs(t.command.voltage_v) for t in opening),
        followed_v=max(abs(t.measurement.applied_v) for t in during),
        faults=ticks[-1].latched,
        given_m=max(abs(t.measurement.position_m - opening[0].measurement.position_m) for t in during),
        loose_m=way * loose_m,
        pressed_m=way * pressed_m,
        blur_m=blur_m,
    )


def _value(t: Tick, of: str) -> float:
    return float(getattr(t.measurement, of))


def _given_way(opening: Sequence[Tick], p: AxisParameters) -> tuple[float, float, float]:
    """The way from the greatest force on: as the encoder shows it, and as the pressures explain it.

    What flows into one chamber and out of the other is in a ratio that pressures and supply give; with it
    the flow, of which the valve's size would have to be known, leaves both balances of air; the way stays.
    """
    c, g, few = p.controller.cylinder, p.controller.gas, max(1, round(LOOSE_S / p.controller.h))
    forces = [t.estimate.x3_n for t in opening]
    peak = max(range(len(opening)), key=lambda n: abs(forces[n] - forces[0]))
    parts = opening[max(0, peak - few) : peak + 1], opening[-few:]

    def mean(of: str) -> tuple[float, float]:
        first, last = (fmean(_value(t, of) for t in part) for part in parts)
        return 0.5 * (first + last), last - first

    (p1, dp1), (p2, dp2), (x, dx), (supply, _) = map(mean, ("p1_pa", "p2_pa", "position_m", "supply_pa"))
    x1 = min(max(x + c.x_e1, c.x_e1), c.x_e1 + c.stroke_m)
    v1, v2 = c.A1 * x1, c.A2 * (c.L - x1)
    fills = opening[-1].command.voltage_v > 0.0
    one = signed_flow(supply, p1, g) if fills else c.exhaust * signed_flow(p1, g.atmosphere_pa, g)
    two = c.exhaust * signed_flow(p2, g.atmosphere_pa, g) if fills else signed_flow(supply, p2, g)
    weight = g.k * (one * p2 * c.A2 - two * p1 * c.A1)
    least = 0.2 * g.k * (abs(one) * p2 * c.A2 + abs(two) * p1 * c.A1)
    if abs(weight) <= least:
        return dx, dx, math.inf
    blur = NOISE_PA * math.hypot(two * v1, one * v2) / abs(weight)
    return dx, (two * dp1 * v1 + one * dp2 * v2) / weight, blur


def judge_rest(present: int) -> Verdict | None:
    """What keeps an axis at rest from being tested at all; None for nothing."""
    hindering = present & BLOCKS[RequestKind.PROBE]
    if not hindering:
        return None
    shut = hindering & (1 << F.SUPPLY_PRESSURE | 1 << F.SUPPLY_FALLING)
    return Verdict((Finding.SUPPLY_SHUT if shut else Finding.BY_FAULT,), tuple(names(hindering)))


def is_driven(rest: Sequence[Tick], p: AxisParameters) -> bool:
    """Whether the load of a disarmed axis is moved by air, or pressed against an end of its travel.

    Args:
        rest: ticks without a command.
        p: parameters.
    """
    if not rest:
        return False
    first, last = rest[0].measurement, rest[-1].measurement
    low_pa, high_pa = sorted((last.p1_pa, last.p2_pa))
    pressed = high_pa >= PRESSED * last.supply_pa and low_pa <= p.controller.gas.atmosphere_pa / PRESSED
    return pressed or abs(last.position_m - first.position_m) > DRIFT_M + COUNTS * expected_of(p).step_m


def judge(probes: Sequence[Seen], x: Expected, loose: bool) -> Verdict:
    """What openings both ways have shown.

    Args:
        probes: one each way, or more.
        x: what the configuration has to say.
        loose: the load was to come loose; else it was to stay on its bristles.
    """
    found = _of_valve(probes) or _of_pressures(probes) or _of_way(probes, x, loose)
    faults = 0
    for s in probes:
        faults |= s.faults
    if not found and faults:
        found = (Finding.BY_FAULT,)
    return Verdict(found, tuple(names(faults)))


def _of_valve(probes: Sequence[Seen]) -> tuple[Finding, ...]:
    if any(s.followed_v < 0.5 * s.opened_v for s in probes):
        return (Finding.VALVE_SILENT,)
    if all(max(abs(s.p1_pa), abs(s.p2_pa)) < SILENT_PA and s.opened_v >= LEAST_V for s in probes):
        return (Finding.VALVE_UNPLUGGED,)
    return ()


def _of_pressures(probes: Sequence[Seen]) -> tuple[Finding, ...]:
    one, two = (max(abs(p) for p in ps) for ps in zip(*((s.p1_pa, s.p2_pa) for s in probes), strict=True))
    if max(one, two) < SILENT_PA:
        return ()
    if one < SILENT_SHARE * two:
        return (Finding.DEAD_PRESSURE_1,)
    return (Finding.DEAD_PRESSURE_2,) if two < SILENT_SHARE * one else ()


def _of_way(probes: Sequence[Seen], x: Expected, loose: bool) -> tuple[Finding, ...]:
    least_m = COUNTS * x.step_m
    ratios = [s.given_m * x.stiffness_n_m / max(abs(s.force_n), 1e-9) for s in probes]
    if not loose and min(ratios) > BETWEEN and all(s.given_m > least_m for s in probes):
        return (Finding.ENCODER_SCALE_LARGE,)
    if loose and all(_hides(s, least_m) for s in probes):
        return (Finding.ENCODER_SCALE_SMALL,)
    if (
        not loose
        and max(ratios) * STIFFER < 1.0
        and _would_show(probes, x)
        and any(s.given_m > SHOWN * x.step_m for s in probes)
    ):
        return (Finding.ENCODER_SCALE_SMALL,)
    if all(abs(s.way_m) <= least_m for s in probes):
        return (Finding.BLOCKED,) if loose else ()
    answers = [s for s in probes if abs(s.p1_pa - s.p2_pa) > max(SILENT_PA, x.answer_pa)]
    probes = answers if loose else probes  # the rest crept
    ways = {_sign(s.way_m, least_m) for s in probes}
    forces = {_sign(s.p1_pa - s.p2_pa, SILENT_PA) for s in probes}
    table: dict[tuple[float, float], tuple[Finding, ...]] = {
        (1.0, 1.0): (),
        (-1.0, -1.0): (Finding.SWAPPED_HOSES,),
        (-1.0, 1.0): (Finding.ENCODER_INVERTED,),
        (1.0, -1.0): (Finding.EXCHANGED_PRESSURES,),
    }
    if len(ways) == len(forces) == 1:
        return table.get((ways.pop(), forces.pop()), () if not loose else (Finding.UNDECIDED,))
    return (Finding.UNDECIDED,) if loose else ()


def _hides(s: Seen, least_m: float) -> bool:
    """Whether the encoder shows less than the pressures have to."""
    return abs(s.pressed_m) > BETWEEN * (abs(s.loose_m) + least_m) + s.blur_m


def _would_show(probes: Sequence[Seen], x: Expected) -> bool:
    """Whether the encoder can show how far the bristles give."""
    return all(abs(s.force_n) > BETWEEN**2 * COUNTS * x.step_m * x.stiffness_n_m for s in probes)


def _sign(value: float, least: float) -> float:
    return math.copysign(1.0, value) if abs(value) > least else 0.0
