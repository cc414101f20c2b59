"""Pressing with a force: how exact, how fast and how softly, against springs; a table, worst first.

    python -m hil.force                                  # virtual.toml
    python -m hil.force cyl25x200.toml cyl63x600.toml    # these
    python -m hil.force --springs 10 --shares 0.8 --friction 1 --json
    python -m hil.force --turns 100                      # position, force, position: no step of the force

Simulated time, compiled where that can be had; the same table every time. In each run a load that touches
a spring is held, then asked to press with a part of the piston's greatest force. The force is that of the
true pressures, the contact's that of the true travel. Where spring and force need more travel than there is,
the case is left out and counted. What the flow allows is what the plant does from the same state with its
valve wide open.

Bounds: error at the end within max(2 N, 1 %); 63 % of the way within 60 ms, or within 1.5 times what the flow
takes where that is more than 40 ms, or 1.1 times what a load takes that has to go so far and can always be
braked within its travel; the contact's force no more than 10 % above its end, or that
tolerance. With --turns: in no
5 ms does the force change by more than its ramp, or the jerk of ways times the mass, and 1 % of the piston's
force, or 2 N. Exit status: 0 where every run keeps them, 1 else.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

from pneud.axis.stops import soft_limits
from pneud.compiled.backend import Backend
from pneud.config.conversions import axis_of, plant_of
from pneud.control.force import GUARD, GUARD_RAD_S, Aim, allowed_m_s, braked_after_s, tolerance_n
from pneud.loading import Loaded, load
from pneud.physics.cylinder import x3_of
from pneud.physics.plant import PlantParameters
from pneud.replay.lockstep import Simulation, backend_of
from pneud.rig.dynamics import PlantState
from pneud.safety.faults import BLOCKS_ARM, names
from pneud.signals import Request, RequestKind, State

RIG = "virtual.toml"
SHARES = (0.1, 0.4, 0.8, -0.1, -0.4, -0.8)  # of the piston's greatest force; inwards where negative
SPRINGS_N_MM = (1.0, 3.0, 10.0, 30.0, 100.0)
FRICTION = (0.5, 1.0, 2.0)
HELD_S, PRESSED_S, LOOKED_S = 0.3, 2.0, 0.4  # before, meanwhile; and of that at its end
SPEED = 0.9  # of limits.speed_m_s
LSB_V = 1e-3
ROOM, MARGIN_M = 1.1, 0.005  # of travel
T63, T63_MS, OPEN_MS, SLOWER, BRAKED = 0.63, 60.0, 40.0, 1.5, 1.1
OVER = 0.1
STEPS = 100  # of a way
TURN_S, TURN_RAMP_S, WINDOW_S = 0.25, 0.3, 0.005  # each; of the whole force; in which none may step
STEP_SHARE, LEAST_STEP_N = 0.01, 2.0
TURN_SHARES = (0.3, 0.5, 0.2)


class Case(NamedTuple):
    """What is tried."""

    rig: str
    friction: float  # of the plant's, as configured
    spring_n_mm: float
    share: float  # of the piston's force; negative inwards


class Found(NamedTuple):
    """What came of it."""

    case: Case
    asked_n: float
    error_n: float  # greatest at the end, by the true pressures
    allowed_n: float
    t63_ms: float  # from the request
    flow_ms: float  # with the valve wide open
    braked_ms: float  # of a load that can always be braked; 0 where that does not hold it back
    contact_n: float  # at the end
    over: float  # beyond it, at most, as a part of it
    faults: str

    @property
    def misses(self) -> list[str]:
        """The bounds that are not kept."""
        flow_ms = SLOWER * self.flow_ms if self.flow_ms > OPEN_MS else 0.0
        most_ms = max(T63_MS, flow_ms, BRAKED * self.braked_ms)
        beyond_n = self.over * abs(self.contact_n)
        return [
            *(["fault"] if self.faults else []),
            *(["error"] if not self.error_n <= self.allowed_n else []),
            *(["slow"] if not self.t63_ms <= most_ms else []),
            *(["over"] if self.over > OVER and beyond_n > self.allowed_n else []),
        ]


class Asked:
    """An operator: arms, holds, asks for one thing after the other, and ends."""

    def __init__(self, rate_hz: float, wanted: Sequence[tuple[Request, float]]) -> None:
        """What to ask for, each with the time [s] that follows."""
        self._rate_hz = rate_hz
        self._wanted = list(wanted)
        self._left, self._armed = 0, False

    def ask(self, state: int, present: int) -> Request | None:
        """What is asked for in this tick."""
        if not self._armed:
            if state != State.DISARMED or present & BLOCKS_ARM:
                return None
            self._armed, self._left = True, round(HELD_S * self._rate_hz)
            return Request(RequestKind.ARM)
        self._left -= 1
        if self._left > 0 and state != State.FAULT:
            return None
        if not self._wanted or state == State.FAULT:
            return Request(RequestKind.SHUTDOWN)
        request, time_s = self._wanted.pop(0)
        self._left = round(time_s * self._rate_hz)
        return request


def greatest_n(loaded: Loaded, share: float) -> float:
    """A part of the piston's greatest force, signed."""
    c = loaded.config
    area_m2 = c.cylinder.piston_area_1_m2 if share > 0.0 else c.cylinder.piston_area_2_m2
    return share * (c.gas.supply_pa - c.gas.atmosphere_pa) * area_m2


def start_of(loaded: Loaded, force_n: float, spring_n_mm: float) -> float:
    """Where a load has to stand for a force to fit into the travel; NaN where it does nowhere."""
    c = loaded.config
    low_m, high_m = soft_limits(axis_of(c, LSB_V))
    usual_m = c.plant.initial_x1_m - c.cylinder.dead_length_1_m
    way_m = math.copysign(ROOM * abs(force_n) / (1e3 * spring_n_mm) + MARGIN_M, force_n)
    least_m, most_m = low_m + MARGIN_M, high_m - MARGIN_M
    starts_m = (x for x in (usual_m, least_m, most_m) if low_m <= x <= high_m)
    return next((x for x in starts_m if low_m <= x + way_m <= high_m), math.nan)


def changed(case: Case, start_m: float) -> Loaded:
    """The rig with another friction of its plant, touching a spring."""
    c = load(case.rig).config
    f = c.plant.friction
    friction = {name: case.friction * getattr(f, name) for name in ("coulomb_n", "static_n", "viscous_n_s_m")}
    side = "front" if case.share >= 0.0 else "rear"
    contact = {"position_m": start_m, "stiffness_n_m": 1e3 * case.spring_n_mm, "side": side}
    x1_m = start_m + c.cylinder.dead_length_1_m
    return load(case.rig, change={"plant": {"friction": friction, "contact": contact, "initial_x1_m": x1_m}})


def piston_n(s: PlantState, p: PlantParameters) -> float:
    """True force of the piston on the load."""
    return x3_of(s.p1, s.p2, p.cylinder) - p.cylinder.rod_force_n


def contact_n(s: PlantState, p: PlantParameters) -> float:
    """True force of the spring."""
    d = p.detail
    return max(0.0, d.contact_side * d.contact_n_m * (s.x1 - d.contact_m))


def open_ms(s: PlantState, p: PlantParameters, how: Backend, to_n: float) -> float:
    """How long the plant takes for 63 % of the way to a force with its valve wide open."""
    from_n = piston_n(s, p)
    full_v = math.copysign(p.valve.u_max_v, to_n - from_n)
    for ms in range(1, 1000):
        s = how.advance(s, full_v, 0.0, 0.0, 1e-3, p)
        if (piston_n(s, p) - from_n) / (to_n - from_n) >= T63:
            return float(ms)
    return math.inf


def braked_ms(aim: Aim, from_m: float, way_m: float, swing_rad_s: float) -> float:
    """How long a load takes that can always be braked; 0 where that does not hold it back.

    Args:
        aim: that it is led by.
        from_m: where it begins.
        way_m: for 63 % of the force, signed.
        swing_rad_s: of the load on its spring.
    """
    room_m = aim.high_m - from_m if way_m > 0.0 else from_m - aim.low_m
    late_s = braked_after_s(swing_rad_s)
    if allowed_m_s(aim, room_m - abs(way_m), late_s) >= aim.speed_m_s:
        return 0.0
    step_m = abs(way_m) / STEPS
    rooms_m = (room_m - (i + 0.5) * step_m for i in range(STEPS))
    ride_s = sum(step_m / (GUARD * allowed_m_s(aim, room, late_s)) for room in rooms_m)
    return 1e3 * (ride_s + 1.0 / GUARD_RAD_S)


def tried(case: Case) -> Found | None:
    """One run; None where it does not fit into the travel."""
    plain = load(case.rig)
    force_n = greatest_n(plain, case.share)
    start_m = start_of(plain, force_n, case.spring_n_mm)
    if math.isnan(start_m):
        return None
    loaded = changed(case, start_m)
    axis, rate_hz = axis_of(loaded.config, LSB_V), loaded.config.loop.rate_hz
    request = Request(RequestKind.FORCE, (force_n, 0.0, 0.0, 0.0, SPEED * axis.limits.speed_m_s, 0.0))
    how, p = backend_of(loaded), plant_of(loaded.config)
    low_m, high_m = soft_limits(axis)
    asked = Asked(rate_hz, [(request, PRESSED_S)])
    run = Simulation(loaded, HELD_S + PRESSED_S + 2.0, 0, how, operator=asked.ask)
    forces: list[float] = []
    contacts: list[float] = []
    flow_ms, ride_ms, faults, before = math.inf, 0.0, 0, run.node.state
    for record in run.records():
        state = run.node.truth().state
        faults |= record.tick.latched
        if record.tick.state == State.PRESSING:
            if not forces:
                way_m = T63 * force_n / (1e3 * case.spring_n_mm)
                aim = Aim(force_n, 1.0, low_m, high_m, request.values[4], 1.0, axis.limits.braking_m_s2)
                swing_rad_s = math.sqrt(1e3 * case.spring_n_mm / loaded.config.cylinder.moving_mass_kg)
                flow_ms = open_ms(before, p, how, force_n)
                ride_ms = braked_ms(aim, start_m, way_m, swing_rad_s)
            forces.append(piston_n(state, p))
            contacts.append(contact_n(state, p))
        before = state
    allowed_n = tolerance_n(Aim(force_n, 1.0, 0.0, 0.0, 1.0, 1.0), axis.pressing)
    if not forces:
        return Found(case, force_n, math.inf, allowed_n, math.inf, flow_ms, 0.0, 0.0, 0.0, "never pressed")
    last = round(LOOKED_S * rate_hz)
    way_n = force_n - forces[0]
    there = (1e3 * i / rate_hz for i, f in enumerate(forces) if (f - forces[0]) / way_n >= T63)
    end_n = sum(contacts[-last:]) / len(contacts[-last:])
    over = (max(contacts) - end_n) / end_n if end_n > 0.0 else 0.0
    error_n = max(abs(f - force_n) for f in forces[-last:])
    t63_ms = next(there, math.inf)
    shown = " ".join(names(faults))
    return Found(case, force_n, error_n, allowed_n, t63_ms, flow_ms, ride_ms, end_n, over, shown)


def turned(case: Case, turns: int) -> tuple[float, str]:
    """The most by which the force changes in 5 ms beyond its ramp, position and force in turn; and faults."""
    plain = load(case.rig)
    loaded = changed(case, plain.config.plant.initial_x1_m - plain.config.cylinder.dead_length_1_m)
    ramp_n_s, speed_m_s = greatest_n(plain, 1.0) / TURN_RAMP_S, SPEED * plain.config.limits.speed_m_s
    wanted = []
    for turn in range(turns):
        force_n = greatest_n(plain, TURN_SHARES[turn % len(TURN_SHARES)])
        wanted.append((Request(RequestKind.FORCE, (force_n, ramp_n_s, 0.0, 0.0, speed_m_s, 0.0)), TURN_S))
        wanted.append((Request(RequestKind.HOLD), TURN_S))
    p, asked = plant_of(loaded.config), Asked(loaded.config.loop.rate_hz, wanted)
    run = Simulation(loaded, 2.0 * turns * TURN_S + 5.0, 0, backend_of(loaded), operator=asked.ask)
    forces, faults = [], 0
    for record in run.records():
        faults |= record.tick.latched
        if not run.shut and record.tick.state != State.DISARMED:
            forces.append(piston_n(run.node.truth().state, p))
    span = round(WINDOW_S * loaded.config.loop.rate_hz)
    changes = (abs(b - a) for a, b in zip(forces, forces[span:], strict=False))
    # a way to rest has a ramp of its own: the jerk that the configuration allows, times the mass
    jerk_n_s = plain.config.limits.motion.jerk_m_s3 * plain.config.cylinder.moving_mass_kg
    return max(changes) - WINDOW_S * max(ramp_n_s, jerk_n_s), " ".join(names(faults))


def line_of(f: Found) -> str:
    """A run for people."""
    c = f.case
    what = f"{c.rig.rpartition('/')[2]:16} x{c.friction:<4g} {c.spring_n_mm:4g} N/mm {f.asked_n:8.1f} N"
    takes = f"flow {f.flow_ms:.0f}" + (f", braked {f.braked_ms:.0f}" if f.braked_ms else "")
    how = f"error {f.error_n:5.2f} of {f.allowed_n:5.2f} N, 63 % {f.t63_ms:4.0f} ms ({takes})"
    return f"{what}: {how}, over {1e2 * f.over:4.1f} %  {' '.join(f.misses)} {f.faults}".rstrip()


def cases_of(o: argparse.Namespace) -> Iterator[Case]:
    """All that is to be tried."""
    yield from map(Case._make, product(o.rigs, o.friction, o.springs, o.shares))


def main(arguments: Sequence[str] | None = None) -> int:
    """Try all and print the table."""
    parser = argparse.ArgumentParser(prog="python -m hil.force", description=__doc__.partition("\n")[0])
    parser.add_argument("rigs", nargs="*", default=[RIG])
    parser.add_argument("--springs", type=float, nargs="+", default=SPRINGS_N_MM, metavar="N_MM")
    parser.add_argument("--shares", type=float, nargs="+", default=SHARES, metavar="SHARE")
    parser.add_argument("--friction", type=float, nargs="+", default=FRICTION, metavar="FACTOR")
    parser.add_argument("--turns", type=int, default=0, metavar="N")
    parser.add_argument("--json", action="store_true")
    o = parser.parse_args(arguments)
    if o.turns:
        good = True
        for rig in o.rigs:
            beyond_n, faults = turned(Case(rig, 1.0, 10.0, TURN_SHARES[0]), o.turns)
            good = (
                good and beyond_n <= max(LEAST_STEP_N, STEP_SHARE * greatest_n(load(rig), 1.0)) and not faults
            )
            print(f"{rig}: {o.turns} turns, {beyond_n:+.1f} N beyond the ramp {faults}".rstrip(), flush=True)
        return 0 if good else 1
    found = [tried(case) for case in cases_of(o)]
    done = sorted((f for f in found if f is not None), key=lambda f: len(f.misses), reverse=True)
    missed = sum(bool(f.misses) for f in done)
    if o.json:
        print(json.dumps([f._asdict() | f.case._asdict() | {"misses": f.misses} for f in done]))
    else:
        print("\n".join(map(line_of, done)))
        print(f"{len(done)} runs, {missed} miss, {len(found) - len(done)} need more travel than there is")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
