"""One reading is no fact: what physics cannot explain is held back until the next reading confirms it.

A reading that is held back counts as lost in its tick. The next one confirms it, and then both count, or does
not, and then it was odd: a glitch. Only the share of odd readings is a fault.
"""

import math
from typing import NamedTuple

from pneud.axis.state import AxisParameters, AxisState, Doubt, Gate
from pneud.control.motion import MotionState, predict
from pneud.control.step import ControllerState
from pneud.physics.cylinder import x3_of
from pneud.safety.checks import Limits, are_chambers_within, is_supply_within
from pneud.safety.faults import F
from pneud.safety.watch import Seen, pressure_jump
from pneud.signals import Defect, Measurement, Source

ENCODER, PRESSURE = int(Source.ENCODER), int(Source.PRESSURE)
ODD, CONFIRMED = int(Defect.ODD), int(Defect.CONFIRMED)
ENCODER_DOUBTFUL, PRESSURE_DOUBTFUL = 1 << F.ENCODER_DOUBTFUL, 1 << F.PRESSURE_DOUBTFUL
SPREADS = 3.0  # so many times their usual size are innovations still usual
LEAST_SHARE = 0.5  # of its size that a confirmed innovation still has a reading later
SAME_SUPPLY_PA = 1e5  # a supply pressure that is confirmed is no further from the one before
DIGESTING = 1.5  # times a confirmed innovation may the filter be off while it follows
DIGESTED = 0.9  # part of that which is left after another reading


class Heard(NamedTuple):
    """What of a measurement is believed."""

    m: Measurement  # with the last value that was believed in place of one that is held back
    doubt: Doubt
    present: int  # bits of the faults that the readings of several ticks show


def listen(state: AxisState, m: Measurement, t_ns: int, p: AxisParameters) -> Heard:
    """Hold back what a single reading says beyond physics.

    Args:
        state: after the last tick.
        m: the measurement.
        t_ns: this tick's SYNC.
        p: parameters.
    """
    m, doubt, present = hear_pressures(state.watch.seen, state.doubt, m, p.limits, p.gate)
    if state.controller is None:
        doubt = doubt._replace(innovation_m=0.0, slack_m=0.0)
    else:
        m, doubt = hear_encoder(state, state.controller, doubt, m, t_ns, p)
    if doubt.encoder_share > p.gate.share:
        present |= ENCODER_DOUBTFUL
    if doubt.pressure_share > p.gate.share:
        present |= PRESSURE_DOUBTFUL
    return Heard(m, doubt, present)


def hear_pressures(
    w: Seen, d: Doubt, m: Measurement, limits: Limits, gate: Gate
) -> tuple[Measurement, Doubt, int]:
    """The measurement, the doubts and the faults after this tick's pressures.

    Args:
        w: with the pressures that were believed last.
        d: doubts so far.
        m: the measurement.
        limits: what pressures can do in a time, and between which limits they have to lie.
        gate: what counts as a large share.
    """
    waiting = d.pressure_ns >= 0
    if not m.fresh & PRESSURE:
        return (_without_pressures(m, w, d, m.pressure_defects) if waiting else m), d, 0
    # what is held back tells nothing of how far the pressures may have gone since they were believed
    odd = is_odd_pressure(w._replace(pressure_ns=d.pressure_ns) if waiting else w, d, m, limits)
    held = w._replace(p1_pa=d.p1_pa, p2_pa=d.p2_pa, pressure_ns=d.pressure_ns)
    same = abs(m.supply_pa - d.supply_pa) <= SAME_SUPPLY_PA and not pressure_jump(held, m, limits)
    if odd and not (waiting and same):
        share = d.pressure_share
        if waiting:  # and the one before is not confirmed
            share += gate.rate * (1.0 - share)
        d = d._replace(
            p1_pa=m.p1_pa,
            p2_pa=m.p2_pa,
            supply_pa=m.supply_pa,
            pressure_ns=m.t_ns,
            pressure_share=share,
        )
        return _without_pressures(m, w, d, m.pressure_defects | ODD), d, 0
    jump = 0
    if odd:  # and so was the one before, which says the same
        before = m._replace(p1_pa=d.p1_pa, p2_pa=d.p2_pa, t_ns=d.pressure_ns)
        jump = pressure_jump(w, before, limits)
        m = m._replace(pressure_defects=m.pressure_defects | CONFIRMED)
    glitch = 1.0 if waiting and not odd else 0.0
    share = d.pressure_share + gate.rate * (glitch - d.pressure_share)
    return m, d._replace(known_supply_pa=m.supply_pa, pressure_ns=-1, pressure_share=share), jump


def is_odd_pressure(w: Seen, d: Doubt, m: Measurement, p: Limits) -> bool:
    """Whether pressures have jumped, or crossed a limit, since they were last believed.

    The first ones are taken as they are, and so is what is not finite, which is another fault.
    """
    if not math.isfinite(m.p1_pa + m.p2_pa + m.supply_pa + w.p1_pa + w.p2_pa + d.known_supply_pa):
        return False
    if pressure_jump(w, m, p):
        return True
    inside = _is_within(w.p1_pa, w.p2_pa, d.known_supply_pa, p)
    return inside and not _is_within(m.p1_pa, m.p2_pa, m.supply_pa, p)


def _is_within(p1_pa: float, p2_pa: float, supply_pa: float, p: Limits) -> bool:
    return are_chambers_within(p1_pa, p2_pa, p) and is_supply_within(supply_pa, p)


def _without_pressures(m: Measurement, w: Seen, d: Doubt, defects: int) -> Measurement:
    """The measurement as if its pressures had been lost."""
    return m._replace(
        fresh=m.fresh & ~PRESSURE,
        p1_pa=w.p1_pa,
        p2_pa=w.p2_pa,
        supply_pa=d.known_supply_pa,
        pressure_age_ns=max(0, m.t_ns - w.pressure_ns),
        pressure_defects=defects,
    )


def hear_encoder(
    state: AxisState, controller: ControllerState, d: Doubt, m: Measurement, t_ns: int, p: AxisParameters
) -> tuple[Measurement, Doubt]:
    """The measurement and the doubts after this tick's encoder reading.

    Args:
        state: after the last tick.
        controller: of it, which knows where the load should be.
        d: doubts so far.
        m: the measurement, with pressures that are believed.
        t_ns: this tick's SYNC.
        p: parameters.
    """
    gate, last_m = p.gate, state.watch.seen.position_m
    if not m.fresh & ENCODER:
        return (m._replace(position_m=controller.motion.x) if d.innovation_m != 0.0 else m), d
    now_ns = t_ns + m.encoder_offset_ns
    motion = predicted(controller, m, now_ns - state.sampled_ns, state)
    innovation_m = m.position_m - motion.x
    held = d.innovation_m != 0.0
    # what is held back tells nothing of how far the load may have gone since a reading was believed
    unread_s = (now_ns - d.encoder_ns) * 1e-9 if held else motion.unread_s
    usual_m = gate.noise_m + 0.5 * gate.acceleration_m_s2 * unread_s * unread_s
    size_m, gate_m = abs(innovation_m), usual_m + SPREADS * d.spread_m + d.slack_m
    spread_m = d.spread_m + gate.rate * (min(size_m, gate.noise_m) - d.spread_m)
    slack_m, defects, held_m, held_ns = DIGESTED * d.slack_m, m.encoder_defects, 0.0, 0
    glitch = 1.0 if held else 0.0
    counted = True
    if not math.isfinite(size_m):
        spread_m = d.spread_m  # which is another fault
    elif size_m > gate_m:
        if is_confirmed(d, innovation_m, gate_m + gate.speed_m_s * (now_ns - d.encoder_ns) * 1e-9):
            slack_m, glitch, defects = DIGESTING * size_m, 0.0, defects | CONFIRMED
        else:
            held_m, held_ns, defects = innovation_m, now_ns, defects | ODD
            # whether it is odd, the next one tells
            counted = held
            repeated = m.position_m == last_m
            m = m._replace(
                fresh=m.fresh if repeated else m.fresh & ~ENCODER,
                position_m=last_m if repeated else controller.motion.x,
                encoder_age_ns=max(0, t_ns - state.read_ns),
            )
    share = d.encoder_share
    if counted:
        share += gate.rate * (glitch - share)
    d = d._replace(
        innovation_m=held_m,
        encoder_ns=held_ns,
        slack_m=slack_m,
        spread_m=spread_m,
        encoder_share=share,
    )
    return m._replace(encoder_defects=defects), d


def is_confirmed(d: Doubt, innovation_m: float, more_m: float) -> bool:
    """Whether an innovation goes on where the one that is held back began: a load that is moved stays so.

    Args:
        d: doubts so far.
        innovation_m: of this reading [m].
        more_m: the most that it may differ from the one before [m].
    """
    before_m = d.innovation_m
    same_side = innovation_m * before_m > 0.0 and abs(innovation_m) >= LEAST_SHARE * abs(before_m)
    return same_side and abs(innovation_m - before_m) <= more_m


def predicted(s: ControllerState, m: Measurement, elapsed_ns: int, state: AxisState) -> MotionState:
    """Where the load should be, some time after the last estimate."""
    c = state.law.cylinder
    dt = elapsed_ns * 1e-9 if elapsed_ns > 0 else state.law.h
    return predict(s.motion, x3_of(m.p1_pa, m.p2_pa, c), s.force_step_n, c.rod_force_n, c.M, dt)
