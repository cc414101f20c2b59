"""What every field of a tick means, and its unit: for the schemas in a log, for tables, for the document."""

from __future__ import annotations

SCHEMA = 7  # number of the fields that there are
READABLE = frozenset(
    {"2", "3", "4", "5", "6", "7"}
)  # fields that a message of one of them lacks are read as 0

MEANINGS: dict[str, str] = {
    "t_ns": "this tick's SYNC, CLOCK_MONOTONIC",
    "measurement.t_ns": "the same",
    "measurement.fresh": "bits of the sources that answered this tick's SYNC:"
    " 1 encoder, 2 pressure, 4 valve status",
    "measurement.position_m": "newest valid encoder reading, stroke coordinate, 0 at the rear end stop",
    "measurement.p1_pa": "pressure of chamber 1 (cap end), absolute",
    "measurement.p2_pa": "pressure of chamber 2 (rod end), absolute",
    "measurement.supply_pa": "supply pressure, absolute",
    "measurement.applied_v": "what the valve's DAC put out",
    "measurement.encoder_status": "bits: 1 referenced, 2 warning, 4 error",
    "measurement.valve_state": "0 boot, 1 centred, 2 enabled, 3 timed out, 4 fault",
    "measurement.encoder_age_ns": "from the sampling of the encoder's last valid value to SYNC;"
    " 0 where it is fresh",
    "measurement.pressure_age_ns": "likewise for the pressures",
    "measurement.valve_age_ns": "likewise for the valve status",
    "measurement.encoder_defects": "why newer frames were not used: 1 corrupt, 2 counter frozen, 4 late;"
    " 16 held back as odd, 32 confirmed the one before",
    "measurement.pressure_defects": "likewise",
    "measurement.valve_defects": "likewise",
    "measurement.encoder_offset_ns": "sampling instant of the position, after SYNC;"
    " what SYNC waits for the own last command is in it",
    "measurement.skipped": "ticks skipped just before this one",
    "measurement.host": "bits of what the machine has to say (`Host` in `signals.py`)",
    "estimate.position_m": "position at the instant at which it was sampled",
    "estimate.velocity_m_s": "velocity",
    "estimate.force_n": "F̂, unmatched force acting on the load",
    "estimate.x3_n": "P1 A1 − P2 A2",
    "estimate.x3_hat_n": "x̂3 of the observer",
    "estimate.d_hat_n_s": "d̂ of the observer",
    "estimate.innovation_m": "encoder minus prediction",
    "estimate.opening_v": "command that the valve's spool is believed to follow",
    "reference.position_m": "where the load should be at that instant; NaN where there is no reference",
    "reference.velocity_m_s": "its first derivative",
    "reference.acceleration_m_s2": "its second derivative",
    "reference.jerk_m_s3": "its third derivative",
    "command.voltage_v": "what left for the valve, signed about its centre",
    "command.enable": "1 where the valve may follow, else 0",
    "command.saturated": "1 where the law asked for more than the output chain let through",
    "command.law_v": "what the law asked for; NaN where it was not asked",
    "command.s": "sliding variable; in `pressing` the force that is wanted less that of the piston, N",
    "command.ustar": "u* of the law; in `pressing` the force that is wanted, on its ramp, N",
    "timing.lateness_ns": "wake-up after the ideal grid",
    "timing.set_ns": "SYNC sent to set complete, or given up",
    "timing.cycle_ns": "the cycle itself",
    "timing.send_ns": "encoding and sending the command",
    "timing.latency_ns": "kernel stamp of the newest sensor frame to command sent",
    "timing.record_ns": "handing over the record of the tick before",
    "state": "state of the axis",
    "present": "bits of the fault table that hold now; their names stand in the metadata `faults`",
    "latched": "bits of the fault table that hold the axis in fault",
    "present_more": "bits 63 and up of the fault table that hold now, from 0 on; where there are any",
    "latched_more": "likewise of those that hold the axis in fault",
    "answer": "what became of this tick's request",
    "truth_m": "true position at SYNC, where a software plant tells it, else NaN",
    "check": "CRC-32 over the doubles of estimate, reference and command (voltage, law, s, u*),"
    " little-endian",
    "in_position": "1 where the load has come to rest at the end of the reference, within the tolerances",
    "hunting": "at its target the load or the command swings: what it most likely comes from",
    "told.t_ns": "instant that the following hold for; only an axis that another one leads has them",
    "told.position_m": "where the other axis's reference was in its last tick, in its own coordinate;"
    " NaN where it had none",
    "told.velocity_m_s": "its first derivative",
    "told.acceleration_m_s2": "its second derivative",
    "told.jerk_m_s3": "its third derivative",
    "told.measured_m": "the other axis's own estimate of its position",
    "told.measured_m_s": "and velocity",
    "program.step": "record of the program, from 1: the one under way, or the last one; only an axis with a"
    " program has these",
    "program.lap": "rounds of the program that are done",
    "program.stage": "of the program: 1 stopped, 2 ended, 3 under way, 4 done and waiting for other axes,"
    " 5 the next record is due, 6 late",
    "program.outputs": "bits of what the program puts out",
    "station.inputs": "bits of the inputs that are on, as bus.inputs names them; only an axis with inputs or"
    " outputs has these",
    "station.outputs": "bits of the outputs, as bus.outputs names them",
    "station.brake": "0 there is none, 1 engaged, 2 engaged while the piston comes to bear the load,"
    " 3 releasing, 4 released, 5 engaging",
    "weighed.force_n": "what the load cell said last, outwards positive; only an axis with one has this",
    "weighed.age_ns": "from when that came to SYNC",
    "request.kind": "what was asked for; only ticks with a request have it",
    "request.values": "its numbers",
}

DERIVED_MEANINGS = {
    "t_s": "since the first tick",
    "error_m": "reference − estimate, both at the instant at which the position was sampled",
    "true_error_m": "reference − true position, both at SYNC",
    "state_name": "state of the axis in a word",
    "fault_names": "names of the bits of `present` and `latched`",
}

_UNITS = (
    ("_m_s3", "m/s³"),
    ("_m_s2", "m/s²"),
    ("_m_s", "m/s"),
    ("_n_s", "N/s"),
    ("_ns", "ns"),
    ("_pa", "Pa"),
    ("_m", "m"),
    ("_n", "N"),
    ("_v", "V"),
    ("_s", "s"),
)


def meaning_of(name: str) -> str:
    """What a field says, by its name such as `estimate.force_n`; empty for one that is none."""
    return MEANINGS.get(name) or DERIVED_MEANINGS.get(name, "")


def unit_of(name: str) -> str:
    """The unit that stands at the end of a name; empty where it has none."""
    return next((unit for end, unit in _UNITS if name.endswith(end)), "")
