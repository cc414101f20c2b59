"""All that makes plain numbers of a configuration: for the plant, the controller, safety and the axis."""

from __future__ import annotations

import math
from typing import Any

from pneud.axis.standing import Expected
from pneud.axis.state import AxisParameters, Gate
from pneud.config import flow
from pneud.config.bus_tables import BusConfig
from pneud.config.detail import detail_of
from pneud.config.learnt import adaptation_of, start_of
from pneud.config.measured import edges_of, with_map
from pneud.config.models import Config, ControlConfig, CylinderConfig, RealtimeConfig, ValveConfig
from pneud.config.plant import FrictionConfig, PlantConfig, PlantValveConfig, PlantWiringConfig
from pneud.config.sections import GRAVITY_M_S2
from pneud.config.station import board_of, brake_of, roles_of
from pneud.control import model
from pneud.control.disturbance import EXPLICIT, IMPLICIT, MATCHED, Observer
from pneud.control.feedforward import Creep
from pneud.control.force import Pressing
from pneud.control.homing import HomingParameters
from pneud.control.homogeneous import Feedback, feedback
from pneud.control.laws.sliding import Sliding
from pneud.control.laws.slot import IN_SLOT, SLIDING, Slot
from pneud.control.leading import GANTRY, LEADS, POSITION, REFERENCE, Leading
from pneud.control.model import Model
from pneud.control.motion import MotionFilter, kalman
from pneud.control.reference import Bounds, Shunned, Sine
from pneud.control.standstill import Standstill
from pneud.control.step import Controller
from pneud.control.times import over_ns
from pneud.physics import cylinder as cyl
from pneud.physics.friction import Friction
from pneud.physics.plant import BeamParameters, PlantParameters, Wiring
from pneud.physics.valve import Valve, spool_transition
from pneud.safety.checks import Limits
from pneud.safety.output import OutputLimits

COMPUTING_S = 80e-6  # from the last sensor frame to the command's place on the wire
FRAME_BITS, STUFFING = 47, 1.1
LONGEST_SHARE, LONGEST_S = 2.0, 10.0  # a stroke of homing may take so much longer than at its speed
LEAST_STILL_M, STILL_STEPS = 5e-5, 10.0  # travel that a reading cannot hide: at least, and in encoder steps
NOISES, LEAST_STEPS = 4.0, 4.0  # within so many standard deviations, and steps, nearly all readings lie
UNKNOWN_SHARE = 0.1  # of the piston's greatest force that nobody may know of without being doubted
DOUBT_S, DOUBT_SHARE = 0.04, 0.3  # more odd readings in such a time are a fault
LEAST_TOLERANCE_M, TOLERANCE_STEPS = 2e-5, 2.0  # error in position: at least, and in encoder steps
LEAST_REST_M_S, REST_STEPS_S = 2e-3, 50.0  # speed in position likewise, in steps a second
SWING = 1.5  # times the tolerance does the error of a hunting load go to and fro
MEAN_STEP_S = 0.3  # in which the mean step of the command is taken
FAST = 16.0  # times the lead: a loop that swings faster is as fast as the valve
FAST_S = 0.01  # where there is no lead
SHUNNED = (0.35, 1.6)  # times v_s, between which friction falls steeply
JERK_SHARE = 0.15  # of what the open valve does to the force, that the jerk of a short move may take
BLOCKED_KG = 1e9  # nothing moves that
FORCE_SHARE = 0.9  # of the piston's greatest force that may be asked for
FREE_SHARE = 0.15  # of it: what opposes a load that is pressed against nothing is less, its weight apart
APART_SHARE = 0.1  # of the piston's force: a load cell may differ by so much
RAMP_S, RAMP_SHARE = 0.05, 1.5  # in which that force comes, or the part of the valve's flow that it takes
LEAST_FORCE_N, FORCE_TOLERANCE = 2.0, 0.01  # tolerance of a force: at least, and as a part of it
BLEND_S = 0.1  # in which one set of gains gives way to another


def cylinder_of(c: Config) -> cyl.Cylinder:
    """The cylinder as plain numbers."""
    k = c.cylinder
    return cyl.cylinder(
        A1=k.piston_area_1_m2,
        A2=k.piston_area_2_m2,
        M=k.moving_mass_kg,
        stroke_m=k.stroke_m,
        x_e1=k.dead_length_1_m,
        x_e2=k.dead_length_2_m,
        orifice_m2=flow.area_of(c),
        u_max_v=c.valve.u_max_v,
        g=flow.gas_of(c),
        vent=flow.vent_of(c),
        exhaust=c.valve.exhaust_ratio,
    )


def valve_of(c: Config) -> Valve:
    """The valve the controller believes in, as plain numbers."""
    v = c.valve
    plain = Valve(v.u_max_v, 2.0 * math.pi * v.bandwidth_hz, v.damping, v.dead_zone_v, v.centre_v)
    return with_map(plain, v.map)


def friction_of(f: FrictionConfig) -> Friction:
    """A friction as plain numbers."""
    return Friction(
        coulomb_n=f.coulomb_n,
        static_n=f.static_n,
        stribeck_m_s=f.stribeck_speed_m_s,
        viscous_n_s_m=f.viscous_n_s_m,
        sigma0_n_m=f.bristle_stiffness_n_m,
        sigma1_n_s_m=f.bristle_damping_n_s_m,
    )


def truth_of(c: Config) -> Config:
    """The configuration of somebody who knows the plant's cylinder, gas and valve (the dead zone's mean)."""
    p = c.plant
    v = p.valve
    plus, minus = edges_v(v)
    valve: dict[str, Any] = dict.fromkeys(flow.RATINGS) if flow.given(v) else {}
    valve |= v.model_dump(include=set(ValveConfig.model_fields), exclude_none=True)
    valve["dead_zone_v"] = 0.5 * (plus + minus)
    return c.model_copy(
        update={
            "cylinder": _with_hoses(
                c.cylinder.model_copy(update=p.cylinder.model_dump(exclude_none=True)), p
            ),
            "gas": c.gas.model_copy(update=p.gas.model_dump(exclude_none=True)),
            "valve": c.valve.model_copy(update=valve),
        }
    )


def _with_hoses(k: CylinderConfig, p: PlantConfig) -> CylinderConfig:
    return k.model_copy(
        update={
            "dead_length_1_m": k.dead_length_1_m + p.hoses.volume_1_m3 / k.piston_area_1_m2,
            "dead_length_2_m": k.dead_length_2_m + p.hoses.volume_2_m3 / k.piston_area_2_m2,
        }
    )


def edges_v(v: PlantValveConfig) -> tuple[float, float]:
    """The edges of the true dead zone for u > 0 and u < 0, as distances from its centre [V]."""
    if v.map:
        return edges_of(v.map).dead_zone_v, edges_of(v.map).dead_zone_v
    plus, minus = v.dead_zone_positive_v, v.dead_zone_negative_v
    return v.dead_zone_v if plus is None else plus, v.dead_zone_v if minus is None else minus


def plant_of(c: Config) -> PlantParameters:
    """The true plant as plain numbers."""
    p, true = c.plant, truth_of(c)
    v, (plus, minus) = p.valve, edges_v(p.valve)
    valve = valve_of(true)
    if not valve.bent:
        valve = valve._replace(centre_v=v.centre_v + 0.5 * (plus - minus))
    incremental = (p.sensors.encoder_kind or c.encoder.kind) == "incremental"
    cylinder, gas = cylinder_of(true), flow.gas_of(true)
    if not p.rod_force:
        cylinder = cylinder._replace(rod_force_n=0.0)
    if p.wiring.blocked:
        cylinder = cylinder._replace(M=BLOCKED_KG)
    if p.wiring.supply_shut:
        gas = gas._replace(supply_pa=gas.atmosphere_pa)
    beam_kg = p.beam.load_kg * p.beam.load_share if p.beam is not None else 0.0
    if beam_kg:
        cylinder = cylinder._replace(M=cylinder.M + beam_kg)
    start_m = p.initial_x1_m + (cylinder.x_e1 - c.cylinder.dead_length_1_m)
    return PlantParameters(
        gas=gas,
        cylinder=cylinder,
        valve=valve,
        friction=friction_of(p.friction),
        polytropic_exponent=p.polytropic_exponent or gas.k,
        reverse_flow=p.reverse_flow,
        step_s=p.step_us * 1e-6,
        initial_x1=start_m,
        initial_p2_pa=p.initial_p2_pa,
        disturbance=("none", "case1", "case2").index(p.disturbance),
        dac_bits=v.dac_bits,
        valve_timeout_s=(v.timeout_ms or c.bus.valve_timeout_ms) * 1e-3,
        encoder_resolution_m=p.sensors.encoder_resolution_m,
        pressure_resolution_pa=p.sensors.pressure_step_pa,
        pressure_noise_pa=p.sensors.pressure_noise_pa,
        encoder_zero_m=start_m - cylinder.x_e1 if incremental else 0.0,
        encoder_referenced=not incremental,
        bitrate_bit_s=p.bitrate_bit_s,
        node_delay_s=p.node_delay_us * 1e-6,
        free_s=0.0 if c.bus.sync else p.free_period_us * 1e-6 if p.free_period_us else 1.0 / c.loop.rate_hz,
        load_n=true.cylinder.resistance_n + beam_kg * uphill_m_s2(true.cylinder),
        detail=detail_of(c, valve.u_max_v, gas.R, gas.temperature_k),
        wiring=wiring_of(p.wiring),
        free_jitter_s=p.free_jitter_us * 1e-6,
        board=board_of(c),
    )


def beam_of(c: Config) -> BeamParameters | None:
    """The beam to another axis's piston, if there is one."""
    b = c.plant.beam
    return None if b is None else BeamParameters(b.axis, b.stiffness_n_m, b.damping_n_s_m)


def uphill_m_s2(c: CylinderConfig) -> float:
    """What gravity does against the way out."""
    return GRAVITY_M_S2 * math.sin(math.radians(c.inclination_deg))


def wiring_of(w: PlantWiringConfig) -> Wiring:
    """How the software rig is put together."""
    return Wiring(
        swapped_hoses=w.swapped_hoses,
        exchanged_pressures=w.exchanged_pressures,
        encoder_scale=-w.encoder_scale if w.encoder_inverted else w.encoder_scale,
        dead_pressure=("none", "a", "b").index(w.dead_pressure),
        valve_unplugged=w.valve_unplugged,
    )


def command_delay_s(bus: BusConfig) -> float:
    """Time from the sampling instant until the command of that sample acts [s].

    The answers, three without `[bus.signals]`, of eight bytes each, the computation, and the command of
    eight bytes, one after the other on the wire.
    """
    if bus.command_delay_us is not None:
        return bus.command_delay_us * 1e-6
    count = 3 if bus.signals is None else len(bus.signals.messages)
    return (count + 1) * (FRAME_BITS + 64) * STUFFING / bus.bitrate_bit_s + COMPUTING_S


def lead_s(delay_s: float, valve: Valve) -> float:
    """Time from the sampling instant until the command of that sample has its effect [s].

    A spool of second order delays by 2ζ/ω what passes slowly.
    """
    lag_s = 2.0 * valve.zeta / valve.omega_rad_s if valve.omega_rad_s > 0.0 else 0.0
    return delay_s + lag_s


def model_of(c: Config) -> Model:
    """What may be changed of a configuration while the axis runs, beside laws and gains."""
    v, law, m = c.valve, c.control, c.control.motion
    valve = valve_of(c)
    return Model(
        valve.dead_zone_v if v.map else v.dead_zone_v,
        valve.centre_v,
        law.dead_zone_hold_v,
        *friction_of(law.friction),
        motion_rad_s=m.bandwidth_rad_s or 0.0,
        push_rad_s=m.push_bandwidth_rad_s or 0.0,
        push_beyond_m=m.push_beyond_m,
        force_rate_rad_s=law.force_rate_bandwidth_rad_s,
        standstill=float(law.standstill),
        creep=float(law.creep),
    )


def motion_of(c: Config) -> MotionFilter:
    """The motion filter's gains."""
    m, h = c.control.motion, 1.0 / c.loop.rate_hz
    if m.bandwidth_rad_s is not None:
        return model.motion_filter(model_of(c), h, m.encoder_resolution_m)
    assert m.encoder_noise_m is not None and m.force_walk_n_rs is not None
    mass_kg, blind_m = c.cylinder.moving_mass_kg, 0.5 * m.encoder_resolution_m
    return kalman(m.encoder_noise_m, m.force_walk_n_rs, mass_kg, h, blind_m)


def gains_of(c: Config) -> Feedback:
    """The gains of the feedback."""
    return feedback(c.control.k1, c.control.k2, c.control.k3, c.control.alpha)


def controller_of(c: Config) -> Controller:
    """The controller's parameters."""
    h = 1.0 / c.loop.rate_hz
    law = c.control
    valve = valve_of(c)
    delay_s = min(command_delay_s(c.bus), h)
    ahead_s = lead_s(delay_s, valve) if law.predict else 0.0
    cylinder = cylinder_of(c) if law.rod_force else cylinder_of(c)._replace(rod_force_n=0.0)
    return Controller(
        h=h,
        delay_s=delay_s,
        spool_before=spool_transition(delay_s, valve),
        lead_s=ahead_s,
        spool_ahead=spool_transition(0.5 * ahead_s, valve),
        gas=flow.gas_of(c),
        cylinder=cylinder._replace(reverse_flow=law.reverse_flow),
        valve=valve,
        friction=friction_of(law.friction),
        motion=motion_of(c),
        observer=Observer(
            law.observer.lambda0,
            law.observer.lambda1,
            law.observer.gain_n_s2,
            {"explicit": EXPLICIT, "implicit": IMPLICIT, "matched": MATCHED}[law.observer.discretisation],
        ),
        sliding=Sliding(
            gains=gains_of(c),
            eta=law.eta_m_s3,
            implicit=law.discretisation == "implicit",
            horizon_s=ahead_s,  # feedback any faster would fight its own dead time
            compensate_d=law.law == "composite",
            M=c.cylinder.moving_mass_kg,
            invert_dead_zone=law.compensate_dead_zone,
            hold_v=hold_v(c, cylinder),
        ),
        use_x3_hat=law.smooth_x3,
        use_force=law.estimate_force,
        force_rate_gain=model.force_rate_gain(law.force_rate_bandwidth_rad_s, h),
        blend_kept=math.exp(-h / BLEND_S),
        slot=slot_of(law, h),
        standstill=standstill_of(c),
        adaptation=adaptation_of(c),
        creep=creep_of(c),
    )


def behind_of(c: Config) -> float:
    """How far the motion filter lags behind friction that falls with speed."""
    mass_kg, h = c.cylinder.moving_mass_kg, 1.0 / c.loop.rate_hz
    return model.behind(friction_of(c.control.friction), motion_of(c), mass_kg, h)


def shunned_of(c: Config) -> Shunned:
    """Jerks that ask too much of the valve; speeds where friction's pole is faster than the motion filter."""
    v_s, k = c.control.friction.stribeck_speed_m_s, cylinder_of(c)
    jerk = JERK_SHARE * k.F1_nominal * c.valve.u_max_v / k.M
    low, high = SHUNNED if behind_of(c) > 1.0 else (0.0, 0.0)
    return Shunned(low * v_s, high * v_s, jerk)


def creep_of(c: Config) -> Creep:
    """Where the load's own speed is fed forward."""
    return model.creeping(model_of(c), behind_of(c))


def hold_v(c: Config, k: cyl.Cylinder) -> float:
    """Opening [V] that is not worth a way across the dead zone."""
    step_m = c.control.motion.encoder_resolution_m
    return model.hold_v(c.control.dead_zone_hold_v, k.M * c.control.k1, step_m, k.F1_nominal)


def standstill_of(c: Config) -> Standstill:
    """When a load counts as standing still."""
    step_m, h = c.control.motion.encoder_resolution_m, 1.0 / c.loop.rate_hz
    return model.standing(model_of(c), motion_of(c), c.cylinder.moving_mass_kg, step_m, h, c.valve.u_max_v)


def limits_of(c: Config) -> Limits:
    """What the axis may never exceed, and for how long what may last."""
    k, limits, bus = c.cylinder, c.limits, c.bus
    swing_1_pa_m_s, swing_2_pa_m_s = _swings_pa_m_s(c)
    return Limits(
        travel_min_m=limits.travel_min_m,
        travel_max_m=limits.travel_max_m,
        speed_m_s=limits.speed_m_s,
        tracking_error_m=limits.tracking_error_m,
        chamber_min_pa=limits.chamber_min_pa,
        chamber_max_pa=limits.chamber_max_pa,
        supply_min_pa=limits.supply_min_pa,
        supply_max_pa=limits.supply_max_pa,
        sensor_timeout_ns=round(bus.sensor_timeout_ms * 1e6),
        valve_timeout_ns=round(bus.valve_timeout_ms * 1e6),
        deadline_timeout_ns=round(bus.deadline_timeout_ms * 1e6),
        overload_ns=round(bus.overload_timeout_ms * 1e6),
        innovation_m=limits.innovation_m,
        acceleration_m_s2=limits.chamber_max_pa * k.piston_area_1_m2 / k.moving_mass_kg,
        braking_m_s2=limits.braking_m_s2,
        disagreement_n=limits.disagreement_n,
        saturation_ns=round(limits.saturation_s * 1e9),
        still_m=max(LEAST_STILL_M, STILL_STEPS * c.control.motion.encoder_resolution_m),
        stuck_force_n=limits.stuck_force_n,
        stuck_travel_m=limits.stuck_travel_m,
        stroke_m=k.stroke_m,
        dead_length_1_m=k.dead_length_1_m,
        dead_length_2_m=k.dead_length_2_m,
        swing_1_pa_m_s=swing_1_pa_m_s,
        swing_2_pa_m_s=swing_2_pa_m_s,
    )


def gate_of(c: Config) -> Gate:
    """How far readings may lie from what was expected, and how many of them may."""
    m, h = c.control.motion, 1.0 / c.loop.rate_hz
    quiet_m = NOISES * m.encoder_noise_m if m.encoder_noise_m is not None else m.push_beyond_m
    return Gate(
        noise_m=max(m.encoder_resolution_m + quiet_m, LEAST_STEPS * m.encoder_resolution_m),
        acceleration_m_s2=UNKNOWN_SHARE
        * (c.gas.supply_pa * c.cylinder.piston_area_1_m2 / c.cylinder.moving_mass_kg),
        speed_m_s=c.limits.speed_m_s,
        rate=1.0 - math.exp(-h / DOUBT_S),
        share=DOUBT_SHARE,
    )


def expected_of(c: Config) -> Expected:
    """What counts as in position, and what as hunting."""
    step_m, h = c.control.motion.encoder_resolution_m, 1.0 / c.loop.rate_hz
    i, hunting, period_ns = c.in_position, c.hunting, round(1e9 * h)
    tolerance_m = i.tolerance_m or max(LEAST_TOLERANCE_M, TOLERANCE_STEPS * step_m)
    return Expected(
        tolerance_m=tolerance_m,
        velocity_m_s=i.velocity_m_s or LEAST_REST_M_S + REST_STEPS_S * step_m,
        time_ns=over_ns(i.time_s, period_ns),
        swing_m=hunting.swing_m or SWING * tolerance_m,
        longest_ns=round(0.5e9 * hunting.longest_period_s),
        step_v=hunting.command_step_v,
        share=1.0 - math.exp(-h / MEAN_STEP_S),
        fast_ns=round(1e9 * max(FAST_S, FAST * lead_s(min(command_delay_s(c.bus), h), valve_of(c)))),
        period_ns=period_ns,
    )


def _swings_pa_m_s(c: Config) -> tuple[float, float]:
    """Fastest change of each chamber's pressure by valve and piston together, times the chamber's length."""
    g, k = flow.gas_of(c), cylinder_of(c)
    upstream_pa = max(c.limits.supply_max_pa, c.limits.chamber_max_pa)
    filled = k.c1 * max(1.0, k.exhaust) * c.valve.u_max_v * g.gamma_choked * upstream_pa
    moved = g.k * c.limits.chamber_max_pa * c.limits.speed_m_s
    return filled / k.A1 + moved, filled / k.A2 + moved


def homing_of(c: Config) -> HomingParameters:
    """How the axis finds its zero."""
    h = c.encoder.homing
    rear = h.stop == "rear"
    return HomingParameters(
        incremental=c.encoder.kind == "incremental",
        side=-1.0 if rear else 1.0,
        stop_m=0.0 if rear else c.cylinder.stroke_m,
        speed_m_s=h.speed_m_s,
        force_n=h.force_n,
        back_off_m=h.back_off_m,
        longest_ns=round((LONGEST_SHARE * c.cylinder.stroke_m / h.speed_m_s + LONGEST_S) * 1e9),
    )


def pressing_of(c: Config) -> Pressing:
    """What may be asked for of the piston's force, and what counts as reached."""
    asked, k, g = c.limits.force, cylinder_of(c), flow.gas_of(c)
    gauge_pa = g.supply_pa - g.atmosphere_pa
    out_n, in_n = gauge_pa * k.A1, gauge_pa * k.A2
    most_n = asked.most_n or math.inf
    return Pressing(
        out_n=min(most_n, FORCE_SHARE * out_n),
        in_n=min(most_n, FORCE_SHARE * in_n),
        rate_n_s=asked.rate_n_s or max(out_n, in_n) / RAMP_S,
        speed_m_s=min(asked.speed_m_s, c.limits.speed_m_s),
        time_s=asked.time_s,
        tolerance_n=asked.tolerance_n or LEAST_FORCE_N,
        share=0.0 if asked.tolerance_n else FORCE_TOLERANCE,
        settled_ns=over_ns(c.in_position.time_s, round(1e9 / c.loop.rate_hz)),
        cell=c.bus.load_cell is not None,
        cell_ns=round(c.bus.sensor_timeout_ms * 1e6),
        apart_n=asked.apart_n or APART_SHARE * max(out_n, in_n) + 2.0 * c.control.friction.static_n,
        free_n=min(FREE_SHARE * max(out_n, in_n), 0.5 * c.limits.disagreement_n),
        valve_n_s=math.inf if asked.rate_n_s else RAMP_SHARE * k.F1_nominal * c.valve.u_max_v,
    )


def slot_of(law: ControlConfig, h: float) -> Slot:
    """The laws beside the sliding one for a sample time [s], and whether one of them runs."""
    kind = next((entry.kind for entry in IN_SLOT if entry.name == law.law), SLIDING)
    tables = ((entry, getattr(law, entry.name)) for entry in IN_SLOT)
    return Slot(
        kind,
        **{e.name: e.made(tuple(getattr(table, name) for name in e.tunable), h) for e, table in tables},
    )


def reference_of(c: Config) -> Sine:
    """The configured reference, in the stroke coordinate."""
    r = c.reference
    return Sine(
        r.effective_centre_m - c.cylinder.dead_length_1_m, r.amplitude_m, 2.0 * math.pi * r.frequency_hz
    )


def axis_of(c: Config, command_lsb_v: float) -> AxisParameters:
    """Everything `Axis` needs.

    Args:
        c: the configuration.
        command_lsb_v: step of the command on the wire, from the DBC [V].
    """
    limits = c.limits
    return AxisParameters(
        controller=controller_of(c),
        output=OutputLimits(c.valve.u_max_v, limits.slew_v_s, command_lsb_v),
        limits=limits_of(c),
        gate=gate_of(c),
        expected=expected_of(c),
        reference=reference_of(c),
        transfer=Bounds(
            limits.transfer.speed_m_s, limits.transfer.acceleration_m_s2, limits.transfer.jerk_m_s3
        ),
        motion=Bounds(
            min(limits.motion.speed_m_s, limits.speed_m_s),
            limits.motion.acceleration_m_s2,
            limits.motion.jerk_m_s3,
        ),
        travel_margin_m=limits.motion.margin_m,
        homing=homing_of(c),
        stop_centres=limits.stop_then == "centre",
        join_at_once=c.reference.join == "at_once",
        learnt=start_of(c),
        shunned=shunned_of(c),
        leading=leading_of(c),
        pressing=pressing_of(c),
        roles=roles_of(c),
        brake=brake_of(c),
    )


def leading_of(c: Config) -> Leading:
    """How the axis is led by another one."""
    f, limits = c.reference.follow, c.limits
    if f is None:
        return Leading()
    how = REFERENCE if f.of == "reference" else POSITION
    if f.skew_m is not None:
        how = LEADS if f.leads else GANTRY
    return Leading(
        how=how,
        scale=f.scale,
        offset_m=f.offset_m,
        bandwidth_rad_s=2.0 * math.pi * f.bandwidth_hz,
        skew_m=f.skew_m or 0.0,
        coupling=f.coupling,
        low_m=max(limits.travel_min_m, 0.0),
        high_m=min(limits.travel_max_m, c.cylinder.stroke_m),
        speed_m_s=min(limits.motion.speed_m_s + limits.transfer.speed_m_s, limits.speed_m_s),
    )


def plant_priority(c: RealtimeConfig) -> int:
    """The software plant's: below the loop's, since on a rig nobody competes with the loop."""
    return max(0, c.priority - 10) if c.plant_priority is None else c.plant_priority
