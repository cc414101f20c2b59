"""Does a controller come back from a large error, and what does it do afterwards?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pneud.axis.state import AxisParameters
from pneud.control.reference import sine
from pneud.control.step import start
from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import initial_state
from pneud.study.closed_loop import run
from pneud.study.jit import jitted

SETTLE_S, JUDGE_S = 5.0, 2.0


class Pushed(NamedTuple):
    """A run's last seconds."""

    rms_m: float
    max_m: float
    chatter_v: float  # mean |Δu|
    saturated: float  # part of the samples at the greatest command

    def recovered(self, undisturbed: Pushed) -> bool:
        """Whether this is as good as an undisturbed run, within what one run differs from the next."""
        return self.rms_m < 1.5 * undisturbed.rms_m + 1e-5 and self.saturated <= undisturbed.saturated + 0.01


def service(
    axis: AxisParameters, plant: PlantParameters, start_error_m: float, seed: int = 0, compiled: bool = True
) -> Pushed:
    """Track the reference for seven seconds from a start error; judge the last two.

    Args:
        axis: controller, reference and limits.
        plant: the plant.
        start_error_m: from the reference's centre, kept within the travel [m].
        seed: of the pressures' noise.
        compiled: by numba; otherwise interpreted, the same to the last bit.

    Raises:
        JitError: numba is missing.
    """
    p, limits = axis.controller, axis.limits
    x = axis.reference.centre_m + start_error_m
    x = max(limits.travel_min_m, min(limits.travel_max_m, x))
    rig = initial_state(plant._replace(initial_x1=x + plant.cylinder.x_e1))
    state = start(x, rig.p1, rig.p2, plant.gas.supply_pa, p)
    ticks, judged = round((SETTLE_S + JUDGE_S) / p.h), round(JUDGE_S / p.h)
    references = np.array([sine(k * p.h, axis.reference) for k in range(ticks)])
    noise = np.random.default_rng(seed).normal(0.0, plant.pressure_noise_pa, (ticks, 3))
    commands, trace = np.zeros(ticks), np.zeros((ticks, 4))
    step = 2.0 * p.valve.u_max_v / 2**plant.dac_bits if plant.dac_bits else 0.0
    (jitted(run) if compiled else run)(
        state, rig, p, plant, p.delay_s, step, references, noise, np.zeros(ticks), commands, trace
    )
    error, u = trace[-judged:, 0], commands[-judged:]
    return Pushed(
        float(np.sqrt(np.mean(error**2))),
        float(np.max(np.abs(error))),
        float(np.mean(np.abs(np.diff(u)))),
        float(np.mean(np.abs(u) >= 0.999 * p.valve.u_max_v)),
    )
