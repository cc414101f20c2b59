"""Controller and plant in lock step without frames: for tuning, sweeps and tables, compiled or not.

Quantisation, noise, transport delay and the valve's step size are in force; what is left out is the bus and
the supervisor.
"""

from __future__ import annotations

import math
from typing import Any

from pneud.control.step import Controller, ControllerState, act, join, observe
from pneud.physics.gas import signed_flow
from pneud.physics.plant import PlantParameters
from pneud.physics.valve import opening
from pneud.rig.dynamics import PlantState, advance
from pneud.rig.sensors import quantised, sensed
from pneud.signals import Reference


def supply_flow_kg_s(rig: PlantState, p: PlantParameters) -> float:
    """Mass flow out of the supply."""
    u = opening(rig.y, p.valve)
    flow = max(0.0, signed_flow(p.gas.supply_pa, rig.p1 if u > 0.0 else rig.p2, p.gas))
    return p.cylinder.c1 * abs(u) * flow / (p.gas.k * p.gas.R * p.gas.temperature_k)


def run(
    state: ControllerState,
    rig: PlantState,
    controller: Controller,
    plant: PlantParameters,
    delay_s: float,
    command_step_v: float,
    references: Any,
    noise_pa: Any,
    force_n: Any,
    commands: Any,
    trace: Any,
) -> None:
    """Any law along any reference, for as many ticks as `trace` has rows.

    Args:
        state: state of the controller to begin with; the law joins with s(0) = 0.
        rig: state of the plant to begin with.
        controller: parameters of the controller, with its law.
        plant: parameters of the plant.
        delay_s: from the sampling instant until the command acts on the spool; may exceed a sample.
        command_step_v: step of the DAC, 0 for a continuous one [V].
        references: array (n, 4): position, velocity, acceleration, jerk.
        noise_pa: array (n, 3), added to P1, P2 and supply before quantisation.
        force_n: array (n,), external force on the load against positive motion.
        commands: array (n,), filled with the commands.
        trace: array (n, 4), filled with error [m], position [m], velocity [m/s], flow from supply [kg/s].
    """
    applied_v = 0.0
    h, u_max = controller.h, controller.valve.u_max_v
    whole = math.floor(delay_s / h)
    part = delay_s - whole * h
    for k in range(trace.shape[0]):
        t = k * h
        true_m = rig.x1 - plant.cylinder.x_e1
        there = sensed(rig, plant)
        p1 = quantised(there.p1_pa + noise_pa[k, 0], plant.pressure_resolution_pa)
        p2 = quantised(there.p2_pa + noise_pa[k, 1], plant.pressure_resolution_pa)
        ps = quantised(there.supply_pa + noise_pa[k, 2], plant.pressure_resolution_pa)
        position = quantised(there.position_m, plant.encoder_resolution_m)
        state, e = observe(state, position, True, p1, p2, ps, applied_v, h, controller)
        r = Reference(references[k, 0], references[k, 1], references[k, 2], references[k, 3])
        if k == 0:
            state = join(state, e, r, controller)
        state, out = act(state, e, r, controller)
        applied_v = quantised(max(-u_max, min(u_max, out.u_v)), command_step_v)
        commands[k] = applied_v
        trace[k, 0] = r.position_m - true_m
        trace[k, 1] = true_m
        trace[k, 2] = rig.v
        trace[k, 3] = supply_flow_kg_s(rig, plant)
        before = commands[k - whole - 1] if k > whole else 0.0
        after = commands[k - whole] if k >= whole else 0.0
        rig = advance(rig, before, force_n[k], t, t + part, plant)
        rig = advance(rig, after, force_n[k], t + part, t + h, plant)
