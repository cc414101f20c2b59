"""Whether a configuration can be that of a rig: what valve and piston give along the reference, and bounds.

Nothing is simulated. What no rig has is an error; what few have is worth a second look. Each finding names
the key that it hangs on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from pneud.axis.cycle import AxisParameters
from pneud.config import flow
from pneud.config.conversions import axis_of, friction_of, plant_of, truth_of
from pneud.config.models import Config
from pneud.config.plant import PlantConfig
from pneud.control.model import WIDEST
from pneud.control.reference import Sine, along, rest, sine, stays, transfer
from pneud.physics import ratings
from pneud.physics.cylinder import F0, F1_exhaust, F1_fill
from pneud.physics.friction import stribeck
from pneud.physics.plant import PlantParameters
from pneud.physics.valve import dead_zone_inverse
from pneud.signals import Reference

STEPS = 200  # of one period of the reference
MUCH = 0.7  # of what there is: disturbances need the rest
LIGHT_M_S2, LIGHTEST_M_S2 = 1000.0, 10_000.0  # acceleration by the piston's whole force
WIDE = 0.15  # dead zone over the greatest command
SLOW_RAD_S = 2.0  # bandwidth; disturbances would be left to themselves
LOOSE, LEAKY = 0.05, 0.05  # hysteresis over the greatest command; opening of a closed valve
RUBBING = 0.4  # friction over the piston's force
THIN_M = 1e-4  # a dead length below this is no chamber with a hose
FAR = 4.0  # times what the controller believes: rather a slip of the pen
SIZES = {
    "cylinder": ("piston_area_1_m2", "piston_area_2_m2", "stroke_m", "moving_mass_kg"),
    "gas": ("gas_constant_j_kg_k", "atmosphere_pa", "supply_pa"),
}  # of which a plant has about as much
MOVES = (0.02, 0.2, 0.9)  # of the travel
PLACES = 20  # from which the way to the reference is tried


class Doubt(NamedTuple):
    """What cannot be, or seldom is."""

    key: str  # of the configuration
    words: str
    is_error: bool


class Demand(NamedTuple):
    """What the reference asks for at most."""

    command_v: float
    pressure_share: float  # force over what the piston has with supply on one side, atmosphere on the other
    force_n: float
    speed_m_s: float
    acceleration_m_s2: float


def piston_force_n(p: PlantParameters) -> float:
    """The lesser of the forces [N] by which the piston can push and pull."""
    c, g = p.cylinder, p.gas
    push = (g.supply_pa - g.atmosphere_pa) * c.A1
    return min(push, (g.supply_pa - g.atmosphere_pa) * c.A2)


def course(r: Sine) -> list[Reference]:
    """A period of the configured sine."""
    if r.omega_rad_s <= 0.0 or r.amplitude_m <= 0.0:
        return [sine(0.0, r)]
    return [sine(2.0 * math.pi * i / (STEPS * r.omega_rad_s), r) for i in range(STEPS)]


def moves(axis: AxisParameters) -> list[Reference]:
    """Moves about the middle of the travel, as fast as they may be."""
    low_m, high_m = axis.limits.travel_min_m, axis.limits.travel_max_m
    middle_m = 0.5 * (low_m + high_m)
    ways = [
        transfer(
            rest(middle_m - 0.5 * share * (high_m - low_m)),
            rest(middle_m + 0.5 * share * (high_m - low_m)),
            axis.motion,
        )
        for share in MOVES
    ]
    return [along(i * w.T / STEPS, w) for w in ways for i in range(STEPS)]


def demand(p: PlantParameters, places: Sequence[Reference], dead_length_m: float) -> Demand:
    """What a course asks of valve and piston at most, chambers about half the supply pressure.

    x3 = M a + rod force + load + friction; u = (M ȧ − F0 v)/F1, across the dead zone. The rate of friction
    and all dynamics of the valve are left out.

    Args:
        p: the axis as the controller believes in it.
        places: the course.
        dead_length_m: of chamber 1.
    """
    c, g = p.cylinder, p.gas
    middle_pa = 0.5 * g.supply_pa
    volts = share = most_n = 0.0
    for at in places:
        v = at.velocity_m_s
        rubbing = math.copysign(stribeck(v, p.friction), v) + p.friction.viscous_n_s_m * v if v else 0.0
        force = c.M * at.acceleration_m_s2 + p.load_n + rubbing
        above = (force + c.rod_force_n - middle_pa * (c.A1 - c.A2)) / (c.A1 + c.A2)
        p1, p2 = middle_pa + above, middle_pa - above
        reach = (g.supply_pa - g.atmosphere_pa) * (c.A1 if force >= 0.0 else c.A2)
        share, most_n = max(share, abs(force) / reach), max(most_n, abs(force))
        if not g.atmosphere_pa < min(p1, p2) or not max(p1, p2) < g.supply_pa:
            continue
        x1 = at.position_m + dead_length_m
        rate = c.M * at.jerk_m_s3 - F0(x1, p1, p2, c, g) * v
        gain = F1_fill if rate >= 0.0 else F1_exhaust
        opened = rate / gain(x1, p1, p2, g.supply_pa, c, g)
        volts = max(volts, abs(dead_zone_inverse(opened, p.valve, 0.0)))
    fastest_m_s = max(abs(at.velocity_m_s) for at in places)
    return Demand(volts, share, most_n, fastest_m_s, max(abs(at.acceleration_m_s2) for at in places))


def _motion(c: Config, axis: AxisParameters, p: PlantParameters) -> Iterator[Doubt]:
    need = demand(p, course(axis.reference), c.cylinder.dead_length_1_m)
    what = f"{need.speed_m_s:.2g} m/s and {need.acceleration_m_s2:.2g} m/s²"
    u_max = c.valve.u_max_v
    if need.command_v > MUCH * u_max:
        beyond = need.command_v > u_max
        words = f"{what} take {need.command_v:.2g} V of the valve's {u_max:g} V"
        yield Doubt("reference.frequency_hz", words, beyond)
    if need.pressure_share > MUCH:
        words = f"{what} take {need.force_n:.3g} N, {100.0 * need.pressure_share:.0f} % of the piston's force"
        yield Doubt("reference.frequency_hz", words, need.pressure_share > 1.0)
    need = demand(p, moves(axis), c.cylinder.dead_length_1_m)
    if need.command_v > u_max:
        words = f"moves take up to {need.command_v:.2g} V of the valve's {u_max:g} V, and will lag behind"
        yield Doubt("limits.motion", words, False)
    if not axis.join_at_once:
        yield from _joining(axis)


def _joining(axis: AxisParameters) -> Iterator[Doubt]:
    """From where no way within the travel leads onto the reference, so that arming is refused there."""
    limits, first = axis.limits, sine(0.0, axis.reference)
    low_m, high_m = limits.travel_min_m, limits.travel_max_m
    places = [*(low_m + i * (high_m - low_m) / PLACES for i in range(PLACES)), high_m]
    shut = [x for x in places if not stays(transfer(rest(x), first, axis.transfer), low_m, high_m)]
    if not shut:
        return
    words = (
        f"the run-up to {first.velocity_m_s:.2g} m/s leaves limits.travel from {len(shut)} of {len(places)}"
        " places, where arming would be refused; take more limits.transfer.acceleration_m_s2, or a slower or"
        " smaller reference"
    )
    yield Doubt("limits.transfer", words, len(shut) == len(places))


def _rig(c: Config, p: PlantParameters, of: str = "") -> Iterator[Doubt]:
    """Of the rig as the controller believes in it, or of the plant; `of` stands before the keys."""
    force_n, mass_kg = piston_force_n(p), c.cylinder.moving_mass_kg
    light = force_n / mass_kg
    if light > LIGHT_M_S2:
        words = f"{mass_kg:g} kg on a piston of {force_n:.3g} N: {light:.0f} m/s²"
        yield Doubt(f"{of}cylinder.moving_mass_kg", words, light > LIGHTEST_M_S2)
    wide = c.valve.dead_zone_v / c.valve.u_max_v
    if wide > WIDE:
        words = f"a dead zone of {c.valve.dead_zone_v:g} of {c.valve.u_max_v:g} V"
        yield Doubt(f"{of}valve.dead_zone_v", words, wide > WIDEST)
    rubbing_n = max(p.friction.static_n, p.friction.coulomb_n)
    if rubbing_n > RUBBING * force_n:
        words = f"{rubbing_n:.3g} N of friction against {force_n:.3g} N of the piston"
        yield Doubt(f"{of or 'control.'}friction.static_n", words, rubbing_n >= force_n)
    load_n = abs(p.load_n)
    if load_n > MUCH * force_n:
        words = f"a constant load of {load_n:.3g} N against {force_n:.3g} N of the piston"
        key = "load_n" if abs(c.cylinder.load_n) > 0.5 * load_n else "inclination_deg"
        yield Doubt(f"{of}cylinder.{key}", words, load_n >= force_n)


def _chambers(c: Config, of: str = "") -> Iterator[Doubt]:
    for key in ("dead_length_1_m", "dead_length_2_m"):
        dead_m, stroke_m = getattr(c.cylinder, key), c.cylinder.stroke_m
        if not THIN_M <= dead_m <= stroke_m:
            words = f"a dead length of {dead_m:g} m on a stroke of {stroke_m:g} m"
            yield Doubt(f"{of}cylinder.{key}", words, False)


def _viscous(c: Config, p: PlantParameters) -> Iterator[Doubt]:
    """Of the plant alone: what the controller believes in is part of what the reference asks for."""
    speed_m_s = max(abs(at.velocity_m_s) for at in course(axis_of(c, 0.0).reference))
    rubbing_n, force_n = p.friction.viscous_n_s_m * speed_m_s, piston_force_n(p)
    if rubbing_n > RUBBING * force_n:
        words = f"{rubbing_n:.3g} N of friction at {speed_m_s:.2g} m/s against {force_n:.3g} N of the piston"
        yield Doubt("plant.friction.viscous_n_s_m", words, rubbing_n >= force_n)


def _homing(c: Config, p: PlantParameters) -> Iterator[Doubt]:
    if c.encoder.kind != "incremental":
        return
    pushes_n, force_n = c.encoder.homing.force_n, piston_force_n(p)
    rubbing_n = max(p.friction.static_n, p.friction.coulomb_n)
    if pushes_n <= rubbing_n:
        words = f"{pushes_n:g} N do not overcome {rubbing_n:.3g} N of friction"
        yield Doubt("encoder.homing.force_n", words, True)
    elif pushes_n > MUCH * force_n:
        words = f"{pushes_n:g} N of the piston's {force_n:.3g} N"
        yield Doubt("encoder.homing.force_n", words, pushes_n > force_n)


def _far(c: Config) -> Iterator[Doubt]:
    """What of the plant is much more or less than the controller believes."""
    true = truth_of(c)
    for table, keys in SIZES.items():
        for key in keys:
            there, believed = getattr(getattr(true, table), key), getattr(getattr(c, table), key)
            if not 1.0 / FAR <= there / believed <= FAR:
                words = f"{there:g}, where the controller believes in {believed:g}"
                yield Doubt(f"plant.{table}.{key}", words, False)
    there, believed = flow.area_of(true), flow.area_of(c)
    if not 1.0 / FAR <= there / believed <= FAR:
        words = f"a valve of {there:.3g} m², where the controller believes in {believed:.3g} m²"
        yield Doubt(f"plant.valve.{(flow.given(c.plant.valve) or ['critical_ratio'])[0]}", words, False)


def _detail(c: Config, p: PlantParameters) -> Iterator[Doubt]:
    """Of what the plant has besides the plain model; and of the controller's map."""
    v, d = c.plant.valve, p.detail
    if v.hysteresis_v > LOOSE * p.valve.u_max_v:
        words = f"{v.hysteresis_v:g} V of play in {p.valve.u_max_v:g} V"
        yield Doubt("plant.valve.hysteresis_v", words, False)
    leak = max(d.leak_in_v, d.leak_out_v) / p.valve.u_max_v
    if leak > LEAKY:
        yield Doubt("plant.valve.leakage", f"a closed valve that is open by {100.0 * leak:.2g} %", False)
    if d.receiver_pa_kg > 0.0:
        flow_kg_s = ratings.DENSITY_ANR_KG_M3 * flow.conductance_of(truth_of(c)) * p.gas.supply_pa
        least_pa = p.gas.supply_pa - MUCH * flow_kg_s / d.regulator_kg_s_pa
        if least_pa < c.limits.supply_min_pa:
            words = (
                f"the supply falls below limits.supply_min_pa where {MUCH:g} of the valve is open for long"
            )
            yield Doubt("plant.supply.regulator_l_min_bar", words, False)
    if c.valve.map and not c.control.compensate_dead_zone:
        yield Doubt("valve.map", "not inverted without control.compensate_dead_zone", False)


def _law(c: Config, p: PlantParameters, bandwidth_rad_s: float) -> Iterator[Doubt]:
    if bandwidth_rad_s < SLOW_RAD_S:
        words = f"{bandwidth_rad_s:.2g} rad/s: the load would take seconds to come back from a push"
        yield Doubt("control.k1", words, False)
    standing_n = abs(p.load_n) + max(p.friction.static_n, p.friction.coulomb_n)
    if p.load_n and standing_n > c.limits.disagreement_n:
        words = f"{c.limits.disagreement_n:g} N are less than load and friction, {standing_n:.3g} N"
        yield Doubt("limits.disagreement_n", words, False)


def _nodes(c: Config) -> Iterator[Doubt]:
    """CANopen nodes that leave something to nobody."""
    for number, node in enumerate(c.bus.nodes):
        key = f"bus.nodes.{number}"
        if node.profile == "valve408" and not node.deadline:
            words = f"the valve, node {node.id}, does not watch that commands come: it needs another watch"
            yield Doubt(f"{key}.deadline", words, False)
        nobody = node.dead_band == "off" and not c.control.compensate_dead_zone
        if node.profile == "valve408" and nobody and c.valve.dead_zone_v > 0.0:
            words = "nobody makes up for the valve's dead band: neither it nor control.compensate_dead_zone"
            yield Doubt(f"{key}.dead_band", words, False)
        if node.identity.serial is None and c.bus.channel != "auto":  # which is for software rigs
            words = f"node {node.id} may be any device: pneud nodes keep takes down which one it is"
            yield Doubt(key, words, False)


def _brake(c: Config) -> Iterator[Doubt]:
    """What a brake, or want of one, leaves to chance."""
    if c.brake is not None and c.brake.power == "holds":
        words = "the load is free wherever the brake gets no power: with the daemon gone, or the bus cut"
        yield Doubt("brake.power", words, is_error=False)


def findings(c: Config, command_lsb_v: float, bandwidth_rad_s: float) -> list[Doubt]:
    """All that is implausible, errors first.

    Args:
        c: the configuration.
        command_lsb_v: step of the command on the wire [V].
        bandwidth_rad_s: of the law, as predicted.
    """
    axis = axis_of(c, command_lsb_v)
    knowing = c.model_copy(update={"plant": PlantConfig(rod_force=c.plant.rod_force)})
    believed = plant_of(knowing)._replace(
        friction=friction_of(c.control.friction), valve=axis.controller.valve
    )
    found = [*_rig(c, believed), *_chambers(c), *_homing(c, believed), *_nodes(c), *_brake(c)]
    found += [*_law(c, believed, bandwidth_rad_s), *_motion(c, axis, believed)]
    said = {finding.words for finding in found}
    true, there = truth_of(c), plant_of(c)
    of_plant = [
        *_rig(true, there, "plant."),
        *_chambers(true, "plant."),
        *_viscous(c, there),
        *_far(c),
        *_detail(c, there),
    ]
    found += [finding for finding in of_plant if finding.words not in said]
    return sorted(found, key=lambda finding: not finding.is_error)
