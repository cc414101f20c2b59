"""The law and its output chain without supervision: what the reference loops compute in every tick."""

from __future__ import annotations

import math

from pneud.axis import AxisParameters
from pneud.bus.codec import Codecs
from pneud.control.step import ControllerState, act, join, observe, start
from pneud.safety.output import emit
from pneud.signals import Reference


class Law:
    """Moves the load to and fro, from where it stands at the first call and back, as far as configured."""

    def __init__(self, parameters: AxisParameters) -> None:
        self._p = parameters
        self._state: ControllerState | None = None
        self._start_m = 0.0
        self._last_v = 0.0

    def command_v(
        self, position_m: float, p1_pa: float, p2_pa: float, supply_pa: float, applied_v: float, t_s: float
    ) -> float:
        """The command for one complete set of measurements, one nominal period after the last.

        Args:
            position_m: encoder, stroke coordinate.
            p1_pa: pressure of chamber 1, absolute.
            p2_pa: pressure of chamber 2, absolute.
            supply_pa: supply pressure, absolute.
            applied_v: command acting when the sample was taken.
            t_s: time of the reference.
        """
        c = self._p.controller
        state, fresh = self._state, self._state is None
        if state is None:
            state = start(position_m, p1_pa, p2_pa, supply_pa, c)
            self._start_m = position_m
        state, estimate = observe(state, position_m, True, p1_pa, p2_pa, supply_pa, applied_v, c.h, c)
        reference = self._at(t_s)
        if fresh:
            state = join(state, estimate, reference, c)
        self._state, answer = act(state, estimate, reference, c)
        self._last_v = emit(answer.u_v, self._last_v, c.h, self._p.output).voltage_v
        return self._last_v

    def _at(self, t_s: float) -> Reference:
        """A sine about start + amplitude, from its lowest point: it begins at rest and needs no transfer."""
        a, w = self._p.reference.amplitude_m, self._p.reference.omega_rad_s
        s, c = math.sin(w * t_s), math.cos(w * t_s)
        return Reference(self._start_m + a * (1.0 - c), a * w * s, a * w * w * c, -a * w * w * w * s)


def constants(p: AxisParameters, codecs: Codecs) -> dict[str, float]:
    """The numbers that hil/bench/loop.c needs to compute the same, by their names there."""
    c, s, o = p.controller, p.controller.sliding, p.controller.observer
    g, k, v = s.gains, c.cylinder, c.valve
    return {
        "h": c.h,
        "delay_s": min(c.delay_s, c.h),
        **{f"before_{name}": value for name, value in c.spool_before._asdict().items()},
        "gas_k": c.gas.k,
        "atmosphere_pa": c.gas.atmosphere_pa,
        "critical_ratio": c.gas.critical_ratio,
        "gamma_choked": c.gas.gamma_choked,
        "gamma_linear": c.gas.gamma_linear,
        "A1": k.A1,
        "A2": k.A2,
        "M": k.M,
        "x_e1": k.x_e1,
        "L": k.L,
        "c1": k.c1,
        "F1_nominal": k.F1_nominal,
        "rod_force_n": k.rod_force_n,
        "u_max_v": v.u_max_v,
        "omega_rad_s": v.omega_rad_s,
        "zeta": v.zeta,
        "dead_zone_v": v.dead_zone_v,
        "alpha": c.motion.alpha,
        "beta": c.motion.beta,
        "gamma": c.motion.gamma,
        "lambda0": o.lambda0,
        "lambda1": o.lambda1,
        "observer_L": o.L,
        "observer_form": o.form,
        "k1": g.k1,
        "k2": g.k2,
        "k3": g.k3,
        "a1": g.a1,
        "a2": g.a2,
        "a3": g.a3,
        "eta": s.eta,
        "implicit": s.implicit,
        "compensate_d": s.compensate_d,
        "invert_dead_zone": s.invert_dead_zone,
        "dead_zone_band_v": s.dead_zone_band_v,
        "use_force": c.use_force,
        "use_force_rate": c.use_force_rate,
        "amplitude_m": p.reference.amplitude_m,
        "omega_reference_rad_s": p.reference.omega_rad_s,
        "out_u_max_v": p.output.u_max_v,
        "slew_v_s": p.output.slew_v_s,
        "lsb_v": p.output.lsb_v,
        "command_lsb_v": codecs.command_lsb_v,
    }
