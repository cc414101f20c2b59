"""The checks: which faults a tick shows. Numbers in, bits of the fault table out."""

import math
from typing import NamedTuple

from pneud.safety.faults import F
from pneud.signals import Defect, EncoderStatus, Estimate, Host, Measurement, Source, State, ValveState

SETTLING_NS = 50_000_000  # the estimates are trusted after this time
SETTLING_TICKS = 10  # and after so many ticks
MOVING_M_S = 0.01  # faster than this cannot be armed
LEAVING_TICKS = 5  # the valve node may show that it is enabled for so long after the axis has let go
OFF_CENTRE_V = 0.05

# plain numbers: an operation on a flag of the enum module costs ten times as much
_ENCODER, _PRESSURE, _VALVE = int(Source.ENCODER), int(Source.PRESSURE), int(Source.VALVE)
_CORRUPT, _FROZEN, _LATE = int(Defect.CORRUPT), int(Defect.FROZEN), int(Defect.LATE)
_REFERENCED, _ERROR = int(EncoderStatus.REFERENCED), int(EncoderStatus.ERROR)
_ENABLED, _TIMED_OUT = int(ValveState.ENABLED), int(ValveState.TIMED_OUT)
_DISABLED = (int(ValveState.BOOT), int(ValveState.CENTRED))
_OBEYING = (*_DISABLED, _ENABLED)
_HOST = (
    (int(Host.LINK_DOWN), 1 << F.LINK_DOWN),
    (int(Host.NO_REALTIME), 1 << F.NO_REALTIME),
    (int(Host.RECORDER_LOST), 1 << F.RECORDER_LOST),
    (int(Host.CLOCK_STEP), 1 << F.CLOCK_STEP),
    (int(Host.SEND_FAILED), 1 << F.SEND_FAILED),
    (int(Host.OTHER_CONTROLLER), 1 << F.OTHER_CONTROLLER),
    (int(Host.EMERGENCY), 1 << F.EMERGENCY),
    (int(Host.HEARTBEAT_LOST), 1 << F.HEARTBEAT_LOST),
    (int(Host.BUS_PASSIVE), 1 << F.BUS_PASSIVE),
    (int(Host.BUS_OFF), 1 << F.BUS_OFF),
    (int(Host.IDENTIFIER_CLASH), 1 << F.IDENTIFIER_CLASH),
    (int(Host.DISK_FULL), 1 << F.DISK_FULL),
    (int(Host.CONFIG_CHANGED), 1 << F.CONFIG_CHANGED),
    (int(Host.RECEIVE_OVERFLOW), 1 << F.RECEIVE_OVERFLOW),
    (int(Host.CONSOLE_LOST), 1 << F.CONSOLE_LOST),
    (int(Host.UNPROVEN), 1 << F.UNPROVEN),
)
_SYNC_LOST = int(Host.SYNC_LOST)


class Limits(NamedTuple):
    """What the axis may never exceed."""

    travel_min_m: float
    travel_max_m: float
    speed_m_s: float
    tracking_error_m: float
    chamber_min_pa: float
    chamber_max_pa: float
    supply_min_pa: float
    supply_max_pa: float
    sensor_timeout_ns: int
    valve_timeout_ns: int
    deadline_timeout_ns: int
    overload_ns: int
    innovation_m: float
    acceleration_m_s2: float  # the most that the pressures could give the load
    braking_m_s2: float
    disagreement_n: float
    saturation_ns: int
    still_m: float  # a reading that has not changed cannot hide so much travel
    stuck_force_n: float
    stuck_travel_m: float
    stroke_m: float
    dead_length_1_m: float
    dead_length_2_m: float
    swing_1_pa_m_s: float  # fastest change of p1 that valve and piston can make, times the chamber's length
    swing_2_pa_m_s: float
    disagreement_ns: int = 20_000_000
    supply_ns: int = 10_000_000


def lacking(m: Measurement, limits: Limits) -> int:
    """Faults of sources that have given no valid value for too long, named after what came instead."""
    bits = 0
    for age_ns, defects, first in (
        (m.encoder_age_ns, m.encoder_defects, F.ENCODER_MISSING),
        (m.pressure_age_ns, m.pressure_defects, F.PRESSURE_MISSING),
        (m.valve_age_ns, m.valve_defects, F.VALVE_MISSING),
    ):
        if age_ns > limits.sensor_timeout_ns:
            # missing, corrupt, frozen, late stand in this order in the table
            if defects & _CORRUPT:
                bits |= 1 << (first + 1)
            elif defects & _FROZEN:
                bits |= 1 << (first + 2)
            elif defects & _LATE:
                bits |= 1 << (first + 3)
            else:
                bits |= 1 << first
    return bits


def are_chambers_within(p1_pa: float, p2_pa: float, limits: Limits) -> bool:
    """Whether both chamber pressures lie within their limits; NaN does not."""
    low, high = limits.chamber_min_pa, limits.chamber_max_pa
    return low <= p1_pa <= high and low <= p2_pa <= high


def is_supply_within(supply_pa: float, limits: Limits) -> bool:
    """Whether the supply pressure lies within its limits; NaN does not."""
    return limits.supply_min_pa <= supply_pa <= limits.supply_max_pa


def measured(m: Measurement, limits: Limits) -> int:
    """Faults that a single measurement shows. A value that was never seen is NaN and within no limits."""
    bits = 0
    if m.encoder_status & _ERROR:
        bits |= 1 << F.ENCODER_ERROR
    if not m.encoder_status & _REFERENCED:
        bits |= 1 << F.ENCODER_UNREFERENCED
    if not limits.travel_min_m <= m.position_m <= limits.travel_max_m:
        bits |= 1 << F.TRAVEL
    if not are_chambers_within(m.p1_pa, m.p2_pa, limits):
        bits |= 1 << F.CHAMBER_PRESSURE
    if not is_supply_within(m.supply_pa, limits):
        bits |= 1 << F.SUPPLY_PRESSURE
    if m.valve_state == _TIMED_OUT:
        bits |= 1 << F.VALVE_TIMED_OUT
    elif m.valve_state not in _OBEYING:
        bits |= 1 << F.VALVE_FAULT
    if (
        (m.fresh & _ENCODER and not math.isfinite(m.position_m))
        or (m.fresh & _PRESSURE and not math.isfinite(m.p1_pa + m.p2_pa + m.supply_pa))
        or (m.fresh & _VALVE and not math.isfinite(m.applied_v))
    ):
        bits |= 1 << F.NOT_FINITE
    return bits


def of_host(host: int) -> int:
    """Faults of the machine."""
    bits = 0
    if host:
        for flag, fault in _HOST:
            if host & flag:
                bits |= fault
        if host & _SYNC_LOST:  # apart: C's integers do not have this one's bit
            bits |= 1 << F.SYNC_LOST
    return bits


def believed(e: Estimate, reading_interval_s: float, limits: Limits) -> int:
    """Faults that the estimate shows.

    Args:
        e: the estimate.
        reading_interval_s: time from the last encoder reading to this one; over a longer one the load may
            have gone further from the prediction.
        limits: what it is compared with.
    """
    if not math.isfinite(
        e.position_m + e.velocity_m_s + e.force_n + e.x3_hat_n + e.d_hat_n_s + e.innovation_m + e.opening_v
    ):
        return 1 << F.NOT_FINITE
    bits = 0
    if abs(e.velocity_m_s) > limits.speed_m_s:
        bits |= 1 << F.OVERSPEED
    strayed_m = 0.5 * limits.acceleration_m_s2 * reading_interval_s * reading_interval_s
    if abs(e.innovation_m) > limits.innovation_m + strayed_m:
        bits |= 1 << F.ENCODER_JUMP
    return bits


def engaged(m: Measurement, e: Estimate, state: int, ticks: int, h: float, limits: Limits) -> int:
    """Faults that mean something only while the valve is enabled.

    Args:
        m: the measurement.
        e: the estimate.
        state: of the last tick, an engaged one.
        ticks: in that state.
        h: sample time [s].
        limits: what it is compared with.
    """
    bits = 0
    if m.skipped * h * 1e9 >= limits.deadline_timeout_ns:
        bits |= 1 << F.DEADLINE
    if ticks * h * 1e9 > limits.valve_timeout_ns and m.valve_state in _DISABLED:
        bits |= 1 << F.VALVE_REBOOTED
    if state != State.HOMING:
        if not m.encoder_status & _REFERENCED:
            bits |= 1 << F.ENCODER_LOST_REFERENCE
        v = e.velocity_m_s
        braking_m = 0.5 * v * v / limits.braking_m_s2
        if (v > 0.0 and e.position_m + braking_m > limits.travel_max_m) or (
            v < 0.0 and e.position_m - braking_m < limits.travel_min_m
        ):
            bits |= 1 << F.BRAKING_DISTANCE
    return bits


def disengaged(m: Measurement, ticks: int, arming: bool) -> int:
    """Faults that mean something only while the valve has to be centred.

    Args:
        m: the measurement.
        ticks: in the state of the last tick, not an engaged one.
        arming: the axis is asked to arm.
    """
    active = m.valve_state == _ENABLED or abs(m.applied_v) > OFF_CENTRE_V
    known = arming or (ticks >= LEAVING_TICKS and m.fresh & _VALVE)
    return 1 << F.VALVE_ACTIVE if active and known else 0


def unready(e: Estimate, settled_ns: int, h: float) -> int:
    """Faults of an estimate to arm on.

    Args:
        e: the estimate.
        settled_ns: for how long there have been estimates.
        h: sample time [s].
    """
    bits = 0
    if settled_ns < max(SETTLING_NS, SETTLING_TICKS * h * 1e9):
        bits |= 1 << F.UNSETTLED
    if abs(e.velocity_m_s) > MOVING_M_S:
        bits |= 1 << F.MOVING
    return bits
