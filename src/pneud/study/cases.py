"""What the laws are put through: references, loads, pushes, plants other than the model; and the figures."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from pneud.config.conversions import axis_of, plant_of
from pneud.control.adaptation import Adaptation
from pneud.control.feedforward import Creep
from pneud.control.reference import Sine, at, rest, septic, sine
from pneud.control.standstill import Standstill
from pneud.control.step import Controller, start
from pneud.loading import Loaded
from pneud.physics.plant import PlantParameters
from pneud.rig.damage import scaled
from pneud.rig.dynamics import initial_state
from pneud.study.closed_loop import run

Array = NDArray[np.float64]
Model = TypeVar("Model")
BEFORE_S = 0.2  # at rest before a move
AFTER_S = 1.5  # after its end
BAND_M = 1e-4
DAC_RANGE_V = 10.0
NORMAL_KG_PER_L = 1.2045e-3  # air at 20 °C and 1.01325 bar
LEAST_STROKE_M, MOST_STROKE_M = 0.02, 0.98


class CaseRig(NamedTuple):
    """A plant and what lies between it and the controller."""

    plant: PlantParameters
    delay_s: float
    command_step_v: float


class Case(NamedTuple):
    """One run."""

    references: Array  # (n, 4)
    rig: CaseRig
    force_n: Array  # (n,)
    start_m: float
    judged: tuple[float, float]  # seconds whose errors count


class Figures(NamedTuple):
    """What a run came to."""

    rms_m: float
    max_m: float
    chatter_v: float  # mean |Δu|
    air_nl: float  # normal litres from the supply in the time judged
    settled_s: float  # from the beginning of that time until the error stays within 0.1 mm; inf: it does not


class Bench(NamedTuple):
    """A configured axis ready for cases."""

    loaded: Loaded
    controller: Controller
    rig: CaseRig
    centre_m: float
    compiled: Callable[..., None]


def bench_of(loaded: Loaded, compiled: bool) -> Bench:
    """The bench of an axis; `compiled` needs numba.

    Laws are compared as such: nothing is learnt, no law gives way at rest, none is helped in creeping.
    """
    from pneud.study.jit import jitted  # noqa: PLC0415  (only where it is wanted)

    axis = axis_of(loaded.config, loaded.codecs.command_lsb_v)
    law = axis.controller
    controller = law._replace(
        standstill=Standstill(),
        creep=Creep(),
        adaptation=Adaptation(),
        sliding=law.sliding._replace(hold_v=loaded.config.control.dead_zone_hold_v),
    )
    rig = CaseRig(plant_of(loaded.config), controller.delay_s, step_of(loaded.config.plant.valve.dac_bits))
    return Bench(loaded, controller, rig, axis.reference.centre_m, jitted(run) if compiled else run)


def step_of(bits: int) -> float:
    """Step of the DAC [V], 0 for none."""
    return DAC_RANGE_V / 2**bits if bits > 0 else 0.0


def sine_of(bench: Bench, frequency_hz: float, duration_s: float) -> Array:
    """A sine of 50 mm about the configuration's centre."""
    s = Sine(bench.centre_m, 0.05, 2.0 * math.pi * frequency_hz)
    h = bench.controller.h
    return np.array([sine(k * h, s) for k in range(round(duration_s / h))])


def move_of(bench: Bench, length_m: float, time_s: float, after_s: float) -> Array:
    """A move of degree seven about the centre, with rest before and after."""
    h, middle = bench.controller.h, bench.centre_m
    way = septic(time_s, rest(middle - 0.5 * length_m), rest(middle + 0.5 * length_m))
    n = round((BEFORE_S + time_s + after_s) / h)
    return np.array([at(k * h - BEFORE_S, way) for k in range(n)])


def case(
    bench: Bench,
    references: Array,
    judged: tuple[float, float],
    rig: CaseRig | None = None,
    push: tuple[float, float, float] = (0.0, 0.0, 0.0),
    start_error_m: float = 0.0,
) -> Case:
    """A case; `push` is a force [N] against positive motion from one time to another [s]."""
    h = bench.controller.h
    force = np.zeros(len(references))
    force[round(push[0] / h) : round(push[1] / h)] = push[2]
    begin = min(MOST_STROKE_M, max(LEAST_STROKE_M, references[0, 0] + start_error_m))
    return Case(references, rig or bench.rig, force, begin, judged)


def tracking(bench: Bench) -> Case:
    """The sine of 0.5 Hz."""
    return case(bench, sine_of(bench, 0.5, 8.0), (4.0, 8.0))


def sines(bench: Bench) -> dict[str, Case]:
    """Sines of 50 mm, and the paper's reference from the paper's start."""
    return {
        "sine 0.5 Hz": tracking(bench),
        "sine 1 Hz": case(bench, sine_of(bench, 1.0, 6.0), (4.0, 6.0)),
        "sine 2 Hz": case(bench, sine_of(bench, 2.0, 5.0), (4.0, 5.0)),
        "the paper's": case(bench, sine_of(bench, 0.5, 12.0), (8.0, 12.0), start_error_m=-0.05),
    }


MOVES = {
    "move 1 mm": (1e-3, 0.15),
    "move 10 mm": (0.01, 0.3),
    "move 100 mm": (0.1, 0.6),
    "move 400 mm": (0.4, 1.2),
}


def moves(bench: Bench) -> dict[str, Case]:
    """Point-to-point moves; judged from the start of the motion."""
    return {
        name: case(bench, move_of(bench, length, t, AFTER_S), (BEFORE_S, BEFORE_S + t + AFTER_S))
        for name, (length, t) in MOVES.items()
    }


def loads(bench: Bench) -> dict[str, Case]:
    """50 N on and off again at peak speed of the sine of 0.5 Hz."""
    track = sine_of(bench, 0.5, 7.0)
    return {
        "50 N on": case(bench, track, (4.0, 5.0), push=(4.0, 5.0, 50.0)),
        "50 N off": case(bench, track, (5.0, 6.0), push=(4.0, 5.0, 50.0)),
        "-50 N on": case(bench, track, (4.0, 5.0), push=(4.0, 5.0, -50.0)),
        "-50 N off": case(bench, track, (5.0, 6.0), push=(4.0, 5.0, -50.0)),
    }


def rests(bench: Bench, duration_s: float) -> dict[str, Case]:
    """At rest after a move of 100 mm."""
    begin = BEFORE_S + 0.6 + 0.7
    return {"rest": case(bench, move_of(bench, 0.1, 0.6, 0.7 + duration_s), (begin, begin + duration_s))}


def recoveries(bench: Bench) -> dict[str, Case]:
    """Large errors at the start, and pushes of a second; judged a good while later."""
    track = sine_of(bench, 0.5, 7.0)
    found = {
        f"start {mm:+d} mm": case(bench, track, (5.0, 7.0), start_error_m=mm * 1e-3) for mm in (400, -400)
    }
    for newton in (500, -500):
        found[f"push {newton:+d} N"] = case(bench, track, (5.0, 7.0), push=(2.3, 3.3, float(newton)))
    return found


def spread(bench: Bench) -> dict[str, Case]:
    """The sine of 0.5 Hz on plants that differ from the model by one parameter each."""
    c, track = bench.loaded.config, sine_of(bench, 0.5, 8.0)

    def on(plant: PlantParameters) -> Case:
        return case(bench, track, (4.0, 8.0), bench.rig._replace(plant=plant))

    plant = bench.rig.plant
    found = {
        f"mass x {m:g}": on(plant._replace(cylinder=plant.cylinder._replace(M=plant.cylinder.M * m)))
        for m in (0.5, 1.5)
    }
    found |= {f"friction x {f:g}": on(plant._replace(friction=scaled(plant.friction, f))) for f in (0.5, 2.0)}
    for bar in (5.0, 7.0):
        found[f"supply {bar:g} bar"] = on(plant_of(with_(c, gas=with_(c.gas, supply_pa=bar * 1e5))))
    for celsius in (5.0, 40.0):
        found[f"gas {celsius:g} C"] = on(plant_of(with_(c, gas=with_(c.gas, temperature_k=celsius + 273.15))))
    for ms in (1.0, 3.0):
        rig = bench.rig._replace(delay_s=bench.rig.delay_s + ms * 1e-3)
        found[f"hose {ms:g} ms"] = case(bench, track, (4.0, 8.0), rig)
    for bits in (10, 16):
        found[f"DAC {bits} bit"] = case(
            bench, track, (4.0, 8.0), bench.rig._replace(command_step_v=step_of(bits))
        )
    for um in (5.0, 10.0):
        found[f"encoder {um:g} um"] = on(plant._replace(encoder_resolution_m=um * 1e-6))
    return found


def with_(model: Model, **changes: Any) -> Model:
    """A part of the configuration with some values changed."""
    copied: Model = model.model_copy(update=changes)  # type: ignore[attr-defined]
    return copied


def trace_of(bench: Bench, p: Controller, c: Case, seed: int = 0) -> tuple[Array, Array]:
    """Commands (n,) and trace (n, 4) of a run, as `closed_loop.run` fills them."""
    n = len(c.references)
    plant = c.rig.plant._replace(initial_x1=c.start_m + c.rig.plant.cylinder.x_e1)
    begin = initial_state(plant)
    state = start(c.start_m, begin.p1, begin.p2, plant.gas.supply_pa, p)
    noise = np.random.default_rng(seed).normal(0.0, plant.pressure_noise_pa, (n, 3))
    commands, trace = np.zeros(n), np.zeros((n, 4))
    bench.compiled(
        state, begin, p, plant, c.rig.delay_s, c.rig.command_step_v, c.references,
        noise, c.force_n, commands, trace,
    )  # fmt: skip
    return commands, trace


def figures(bench: Bench, p: Controller, c: Case, seed: int = 0) -> Figures:
    """What a run came to."""
    commands, trace = trace_of(bench, p, c, seed)
    h = bench.controller.h
    a, b = round(c.judged[0] / h), round(c.judged[1] / h)
    error = trace[a:b, 0]
    outside = np.nonzero(np.abs(error) > BAND_M)[0]
    settled = 0.0 if len(outside) == 0 else (math.inf if outside[-1] == b - a - 1 else (outside[-1] + 1) * h)
    return Figures(
        float(np.sqrt(np.mean(error**2))),
        float(np.abs(error).max()),
        float(np.abs(np.diff(commands[a:b])).mean()),
        float(trace[a:b, 3].sum() * h / NORMAL_KG_PER_L),
        float(settled),
    )
