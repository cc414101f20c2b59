"""How fast simulation is here: in plain Python, compiled, and with scipy's solve_ivp on the same plant.

Needs numba and scipy. solve_ivp gets the commands of the compiled run and integrates the plant alone, from
one change of the command to the next, with the loosest tolerance that is as accurate as the fixed step.
"""

import platform
import time
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from pneud.loading import load
from pneud.physics.friction import friction_force, relaxation_rate
from pneud.physics.gas import signed_flow
from pneud.physics.plant import PlantParameters
from pneud.physics.valve import opening
from pneud.replay.lockstep import Simulation
from pneud.rig.dynamics import PlantState, advance, initial_state
from pneud.study.cases import bench_of, case, sine_of, trace_of
from pneud.study.tuned import EXTENDED, setting

SIM_S, SCIPY_S = 10.0, 0.5


def rates(_t: float, s: np.ndarray, u: float, p: PlantParameters) -> list[float]:
    """The rig's equations as they stand."""
    x, v, p1, p2, z, y, ydot = s
    c, g, f, n, w = p.cylinder, p.gas, p.friction, p.polytropic_exponent, p.valve.omega_rad_s
    open_v = opening(y, p.valve)
    if open_v > 0.0:
        into1, into2 = signed_flow(g.supply_pa, p1, g), -signed_flow(p2, g.atmosphere_pa, g)
    else:
        into1, into2 = -signed_flow(p1, g.atmosphere_pa, g), signed_flow(g.supply_pa, p2, g)
    rate = n / g.k * c.c1 * abs(open_v)
    force = p1 * c.A1 - p2 * c.A2 - c.rod_force_n - friction_force(v, z, f)
    return [
        v,
        force / c.M,
        -n * p1 * v / x + rate * into1 / (c.A1 * x),
        n * p2 * v / (c.L - x) + rate * into2 / (c.A2 * (c.L - x)),
        v - relaxation_rate(v, f) * z,
        ydot,
        w * w * (u - y) - 2.0 * p.valve.zeta * w * ydot,
    ]


def by_scipy(
    begin: PlantState, commands: np.ndarray, h: float, p: PlantParameters, rtol: float
) -> np.ndarray:
    """Positions after each command."""
    scale = np.array([1e-2, 1e-2, 1e5, 1e5, 1e-4, 1.0, 100.0])
    s, out = np.array(begin[:7]), []
    for u in commands:
        found = solve_ivp(rates, (0.0, h), s, method="LSODA", args=(u, p), rtol=rtol, atol=rtol * scale)
        s = found.y[:, -1]
        out.append(s[0])
    return np.array(out)


def fixed_step(begin: PlantState, commands: np.ndarray, h: float, p: PlantParameters) -> np.ndarray:
    """Positions after each command, in the plant's own steps."""
    s, out = begin, []
    for u in commands:
        s = advance(s, u, 0.0, 0.0, h, p)
        out.append(s.x1)
    return np.array(out)


def processor() -> str:
    """What the machine calls its processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), platform.processor())


def main() -> None:
    """Measure and print."""
    loaded = load("virtual.toml")
    print(f"{processor()}, Python {platform.python_version()}, one core")

    t = time.process_time()
    ticks = sum(1 for _ in Simulation(loaded, SIM_S).records())
    h = 1.0 / loaded.config.loop.rate_hz
    rate = ticks * h / (time.process_time() - t)
    print(f"sim, frames and all, interpreted:     {rate:8.1f} times real time")

    for compiled, name in ((False, "interpreted"), (True, "compiled")):
        bench = bench_of(loaded, compiled)
        law = setting(EXTENDED, bench.controller)
        run = case(bench, sine_of(bench, 0.5, SIM_S), (0.0, SIM_S))
        if compiled:
            trace_of(bench, law, run)  # compile
        t = time.process_time()
        commands, _ = trace_of(bench, law, run)
        rate = SIM_S / (time.process_time() - t)
        print(f"closed loop, without frames, {name + ':':13}{rate:7.1f} times real time")

    commands = commands[: round(SCIPY_S / h)]
    plant = bench.rig.plant._replace(initial_x1=run.start_m + bench.rig.plant.cylinder.x_e1)
    begin = initial_state(plant)
    exact = by_scipy(begin, commands, h, plant, 1e-10)
    t = time.process_time()
    ours = np.abs(fixed_step(begin, commands, h, plant) - exact).max()
    rate = SCIPY_S / (time.process_time() - t)
    print(f"plant alone, fixed step, interpreted: {rate:8.1f} times real time, within {1e9 * ours:.0f} nm")
    for rtol in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        t = time.process_time()
        error = np.abs(by_scipy(begin, commands, h, plant, rtol) - exact).max()
        if error <= ours:
            rate = SCIPY_S / (time.process_time() - t)
            print(
                f"plant alone, solve_ivp, rtol {rtol:g}:     "
                f"{rate:8.1f} times real time, within {1e9 * error:.0f} nm"
            )
            break


if __name__ == "__main__":
    main()
