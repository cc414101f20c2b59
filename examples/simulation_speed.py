"""How fast simulation is here, and logs are read: in plain Python, compiled, beside other people's solvers.

Needs numba and scipy. solve_ivp gets the commands of the compiled run and integrates the plant alone, from
one change of the command to the next, with the loosest tolerance that is as accurate as the fixed step. Where
MuJoCo is there, too, it moves the same mass along the same way, without air, in the plant's own steps.
"""

import importlib.util
import platform
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from pneud import read_log
from pneud.config.conversions import axis_of, plant_of
from pneud.control.reference import rest, sine, transfer
from pneud.loading import Loaded, load
from pneud.log.files.naming import create_log
from pneud.log.files.writer import LogWriter
from pneud.physics.friction import friction_force, relaxation_rate
from pneud.physics.gas import signed_flow
from pneud.physics.plant import PlantParameters
from pneud.physics.valve import opening
from pneud.replay.lockstep import Simulation, backend_of, header_of
from pneud.replay.replaying import replay
from pneud.replay.running import through
from pneud.rig.dynamics import PlantState, advance, initial_state
from pneud.signals import Record
from pneud.study import trial
from pneud.study.cases import bench_of, case, sine_of, trace_of
from pneud.study.tuned import EXTENDED, setting

SIM_S, LONG_S, SCIPY_S = 10.0, 60.0, 0.5

Look = Callable[[int, Record], None]


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


def told(what: str, simulated_s: float, work: Callable[[], object], times: int = 3) -> None:
    """Do it some times, and say how fast it was at best."""
    took_s = []
    for _ in range(times):
        begun_s = time.process_time()
        work()
        took_s.append(time.process_time() - begun_s)
    print(f"{what + ':':52}{simulated_s / min(took_s):8.1f} times real time")


def with_frames(loaded: Loaded, folder: Path) -> None:
    """The whole axis: frames, checks, supervisor; tick by tick and by strides; then its log again."""
    rate_hz, how = loaded.config.loop.rate_hz, backend_of(loaded)

    def simulated(backend: bool, lasts_s: float, look: Look | None = None, path: Path | None = None) -> None:
        law = (how,) if backend else ()
        writer = LogWriter(create_log(path), header_of(loaded)) if path is not None else None
        through(Simulation(loaded, lasts_s, 1, *law), rate_hz, writer, look)
        if writer is not None:
            writer.close()

    def each(_: int, __: Record) -> None:
        """Who looks at each tick gets them one by one."""

    told("sim, frames and all, interpreted", SIM_S, lambda: simulated(False, SIM_S), 1)
    told(f"sim, frames and all, {how.name}, tick by tick", SIM_S, lambda: simulated(True, SIM_S, each))
    simulated(True, SIM_S)  # compile
    told(f"sim, frames and all, {how.name}, by strides", LONG_S, lambda: simulated(True, LONG_S))
    logs = iter([folder / f"{i}.mcap" for i in range(3)])
    told("the same with a log", LONG_S, lambda: simulated(True, LONG_S, None, next(logs)))
    told("replay of that log", LONG_S, lambda: replay(read_log(folder / "0.mcap")))
    told("summary of that log", LONG_S, lambda: read_log(folder / "0.mcap").summary)


def law_and_plant(loaded: Loaded) -> None:
    """What campaigns and design run: law, observer, sensors and plant as one compiled function."""
    axis, plant = axis_of(loaded.config, loaded.codecs.command_lsb_v), plant_of(loaded.config)
    p, centre_m = axis.controller, axis.reference.centre_m
    way = transfer(rest(centre_m), sine(0.0, axis.reference), axis.transfer)
    begin, errand = trial.begin(centre_m, p, plant), trial.Errand(way, axis.reference)
    run, why = trial.compiled()
    ticks = round(10.0 * SIM_S / p.h)
    step_v = trial.step_v(p, plant)
    run(begin, True, 1, 0, 1e-5, errand, p, plant, step_v)
    what = f"law and plant as one function{', interpreted' if why else ''}, with figures"
    told(what, ticks * p.h, lambda: run(begin, True, ticks, 0, 1e-5, errand, p, plant, step_v))


def by_mujoco(plant: PlantParameters) -> None:
    """A mass on a slide with damping under a force: what a general solver takes for a step."""
    if importlib.util.find_spec("mujoco") is None:
        print("MuJoCo is not there: pip install mujoco")
        return
    import mujoco  # noqa: PLC0415

    c, f = plant.cylinder, plant.friction
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep="{plant.step_s}" gravity="0 0 0"/>
      <worldbody><body><joint name="x" type="slide" axis="1 0 0" damping="{f.viscous_n_s_m}"
        frictionloss="{f.coulomb_n}" range="0 {c.stroke_m}" limited="true"/>
        <geom type="sphere" size="0.01" mass="{c.M}"/></body></worldbody>
      <actuator><motor joint="x"/></actuator></mujoco>""")
    data = mujoco.MjData(model)
    data.qpos[0], data.ctrl[0] = 0.5 * c.stroke_m, 50.0
    steps = round(SIM_S / plant.step_s)
    told("MuJoCo, the mass alone, the same steps", SIM_S, lambda: mujoco.mj_step(model, data, steps))


def main() -> None:
    """Measure and print."""
    loaded = load("virtual.toml")
    print(f"{processor()}, Python {platform.python_version()}, one core")
    h = 1.0 / loaded.config.loop.rate_hz
    with tempfile.TemporaryDirectory() as folder:
        with_frames(loaded, Path(folder))
    law_and_plant(loaded)

    for compiled, name in ((False, "interpreted"), (True, "compiled")):
        bench = bench_of(loaded, compiled)
        law = setting(EXTENDED, bench.controller)
        run = case(bench, sine_of(bench, 0.5, SIM_S), (0.0, SIM_S))
        if compiled:
            trace_of(bench, law, run)  # compile
        t = time.process_time()
        commands, _ = trace_of(bench, law, run)
        rate = SIM_S / (time.process_time() - t)
        what = f"closed loop, without frames, {'numba' if compiled else name}:"
        print(f"{what:52}{rate:8.1f} times real time")

    commands = commands[: round(SCIPY_S / h)]
    plant = bench.rig.plant._replace(initial_x1=run.start_m + bench.rig.plant.cylinder.x_e1)
    begin = initial_state(plant)
    exact = by_scipy(begin, commands, h, plant, 1e-10)
    t = time.process_time()
    ours = np.abs(fixed_step(begin, commands, h, plant) - exact).max()
    rate = SCIPY_S / (time.process_time() - t)
    what = "plant alone, fixed step, interpreted:"
    print(f"{what:52}{rate:8.1f} times real time, within {1e9 * ours:.0f} nm")
    for rtol in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        t = time.process_time()
        error = np.abs(by_scipy(begin, commands, h, plant, rtol) - exact).max()
        if error <= ours:
            rate = SCIPY_S / (time.process_time() - t)
            what = f"plant alone, solve_ivp, rtol {rtol:g}:"
            print(f"{what:52}{rate:8.1f} times real time, within {1e9 * error:.0f} nm")
            break
    by_mujoco(plant)


if __name__ == "__main__":
    main()
