"""Controller and plant in lock step along a sine, in spans that go on from each other; compiled or not."""

from __future__ import annotations

from typing import Any, NamedTuple

from pneud.control.reference import Sine, sine
from pneud.control.step import Controller, ControllerState, act, join, observe
from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import PlantState, advance
from pneud.rig.sensors import quantised


class LoopOutcome(NamedTuple):
    """State at the end of a span, to go on from."""

    controller: ControllerState
    plant: PlantState
    last_v: float  # command on its way or acting


def run_sine(
    begin: LoopOutcome,
    controller: Controller,
    plant: PlantParameters,
    reference: Sine,
    t0_s: float,
    command_step_v: float,
    noise_pa: Any,
    force_n: Any,
    trace: Any,
) -> LoopOutcome:
    """Track a sine for as many ticks as `trace` has rows.

    Args:
        begin: where to go on from; the law joins with s(0) = 0.
        controller: parameters of the controller.
        plant: parameters of the plant.
        reference: what to track.
        t0_s: time of the first tick on the reference's own clock.
        command_step_v: step of the DAC, 0 for a continuous one [V].
        noise_pa: array (n, 3), added to P1, P2 and supply before quantisation.
        force_n: array (n,), external force on the load against positive motion.
        trace: array (n, 8), filled with error [m], command [V], position [m], velocity [m/s], P1, P2 [Pa],
        F̂ [N], d̂ [N/s].
    """
    state, rig, last_v = begin
    applied_v = last_v
    h, delay = controller.h, controller.delay_s
    u_max = controller.valve.u_max_v
    for k in range(trace.shape[0]):
        t = t0_s + k * h
        true_m = rig.x1 - plant.cylinder.x_e1
        p1 = quantised(rig.p1 + noise_pa[k, 0], plant.pressure_resolution_pa)
        p2 = quantised(rig.p2 + noise_pa[k, 1], plant.pressure_resolution_pa)
        ps = quantised(plant.gas.supply_pa + noise_pa[k, 2], plant.pressure_resolution_pa)
        position = quantised(true_m, plant.encoder_resolution_m)
        state, e = observe(state, position, True, p1, p2, ps, applied_v, h, controller)
        r = sine(t, reference)
        if k == 0:
            state = join(state, e, r, controller)
        state, out = act(state, e, r, controller)
        u = quantised(max(-u_max, min(u_max, out.u_v)), command_step_v)
        trace[k, 0] = r.position_m - true_m
        trace[k, 1] = u
        trace[k, 2] = true_m
        trace[k, 3] = rig.v
        trace[k, 4] = rig.p1
        trace[k, 5] = rig.p2
        trace[k, 6] = e.force_n
        trace[k, 7] = e.d_hat_n_s
        rig = advance(rig, last_v, force_n[k], t, t + delay, plant)
        rig = advance(rig, u, force_n[k], t + delay, t + h, plant)
        last_v = u
        applied_v = u
    return LoopOutcome(state, rig, last_v)
