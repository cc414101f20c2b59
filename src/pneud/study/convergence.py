"""Whether convergence is finite-time, and what the law does with what (8) leaves out.

On the chain (13) the feedback makes the vector field homogeneous: with the weights `r3 = 1/(1−α)`,
`r2 = r3 + 1`, `r1 = r3 + 2` a start scaled to `(ε^r1 w1, ε^r2 w2, ε^r3 w3)` settles in ε times the time. So
the settling time grows as `|w1(0)|^((1−α)/(3−2α))`, where an exponential law (α = 1) needs the same time for
the same number of decades from anywhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from pneud.control.homogeneous import Feedback, feedback
from pneud.rig.dynamics import initial_state
from pneud.study.ideal import COLUMNS, W1, WORST, IdealLoop, V, run_chain, run_ideal
from pneud.study.reproduction import (
    CASES,
    FINE_M,
    ISMC_GAINS,
    SAMPLE_TIMES_S,
    Trace,
    fast,
    paper_loop,
    settled,
)
from pneud.view.progress import Report, each, silent

PART = 1e-3  # "settled" on this page: |w1| below this part of what it began with
CHAIN_H_S, CHAIN_S = 1e-4, 24.0
CHAIN_STARTS_M = (1e-4, 1e-3, 1e-2, 5e-2, 1e-1, 1.0)
LOOP_H_S, LOOP_S = 1e-3, 12.0
LOOP_STARTS_M = (1e-3, 5e-3, 2e-2, 5e-2, 1e-1, 2e-1)
VANISHED = 1e-2  # of the homogeneous norm; what then remains takes about this part of the time so far
STARTS_M = (0.02, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 0.95, 1.0)
STARTS_S = 20.0
FORCES_N = (0.1, 1.0)
FORCE_S = 90.0
AT_STOP_M = 1e-6


class Settling(NamedTuple):
    """Settling time against initial error, of the chain or of the closed loop."""

    what: str
    alpha: float
    h_s: float
    starts_m: tuple[float, ...]
    times_s: tuple[float, ...]  # to PART of the start; NaN: never
    to_zero_s: tuple[float, ...]  # chain only: until the homogeneous norm has vanished
    exponent: float  # fitted p of time ∝ start^p
    predicted: float


class LimitCycle(NamedTuple):
    """Amplitude of w3 on the chain under explicit u*."""

    k3: float
    alpha: float
    h_s: float
    amplitude_m_s2: float
    predicted_m_s2: float
    implicit_m_s2: float  # what the implicit form leaves in its place


class Start(NamedTuple):
    """Case 1 from somewhere else in the cylinder, implicit, 1 ms."""

    x1_m: float
    fine_s: float | None


class Unmatched(NamedTuple):
    """What a constant force on the load leaves at rest, implicit."""

    force_n: float
    h_s: float
    error_m: float
    predicted_m: float
    at_stop: bool
    speed_m_s: float


class Convergence(NamedTuple):
    """Everything on this subject."""

    settling: tuple[Settling, ...]
    limit_cycles: tuple[LimitCycle, ...]
    starts: tuple[Start, ...]
    unmatched: tuple[Unmatched, ...]
    decay: tuple[tuple[float, Trace], ...]  # (α, |w1| on the chain from 50 mm), every CHAIN_H_S


def chain(start: tuple[float, float, float], h_s: float, span_s: float, g: Feedback, implicit: bool) -> Trace:
    """States of the chain (13) at the samples."""
    trace = np.zeros((round(span_s / h_s), 3))
    fast(run_chain)(*start, h_s, g, implicit, trace)
    return trace


def exponent_of(starts_m: tuple[float, ...], times_s: tuple[float, ...]) -> float:
    """The p of time ∝ start^p, by least squares in the logarithms."""
    return float(np.polyfit(np.log(starts_m), np.log(times_s), 1)[0])


def predicted_exponent(alpha: float) -> float:
    """(1−α)/(3−2α), the inverse of w1's weight; 0 for the linear law."""
    return (1.0 - alpha) / (3.0 - 2.0 * alpha)


def chain_settling(g: Feedback) -> Settling:
    """Settling of the chain from (w1, 0, 0)."""
    times, to_zero = [], []
    for start in CHAIN_STARTS_M:
        trace = chain((start, 0.0, 0.0), CHAIN_H_S, CHAIN_S, g, True)
        times.append(_or_nan(settled(trace[:, 0], PART * start, CHAIN_H_S)))
        if g.a3 < 1.0:
            norm = homogeneous_norm(trace, g.a3)
            to_zero.append(_or_nan(settled(norm, VANISHED * float(norm[0]), CHAIN_H_S)))
    return _settling("chain (13)", g.a3, CHAIN_H_S, CHAIN_STARTS_M, times, to_zero)


def loop_settling() -> Settling:
    """Settling of Case 1 (implicit, 1 ms) started on the moving reference but for w1."""
    times = []
    loop = paper_loop(1)._replace(h=LOOP_H_S)
    for start in LOOP_STARTS_M:
        plant = loop.plant._replace(initial_x1=loop.reference.centre_m - start)
        speed = loop.reference.amplitude_m * loop.reference.omega_rad_s
        trace = np.zeros((round(LOOP_S / LOOP_H_S), COLUMNS))
        fast(run_ideal)(initial_state(plant)._replace(v=speed), loop, 0.0, trace)
        times.append(_or_nan(settled(trace[:, W1], PART * start, LOOP_H_S)))
    return _settling(
        "closed loop, Case 1, implicit", loop.sliding.gains.a3, LOOP_H_S, LOOP_STARTS_M, times, []
    )


def homogeneous_norm(trace: Trace, alpha: float) -> Trace:
    """Greatest |w_i|^(1/r_i): by homogeneity it falls to zero at a rate that does not slow down."""
    r3 = 1.0 / (1.0 - alpha)
    weights = np.array([r3 + 2.0, r3 + 1.0, r3])
    norm: Trace = np.max(np.abs(trace) ** (1.0 / weights), axis=1)
    return norm


def limit_cycle(g: Feedback, h_s: float) -> LimitCycle:
    """The chain left to itself for a minute, from the paper's initial errors."""
    found = []
    for implicit in (False, True):
        trace = chain((0.05, 0.157, 0.0), h_s, 60.0, g, implicit)
        found.append(float(np.abs(trace[len(trace) // 2 :, 2]).max()))
    predicted = float((0.5 * h_s * g.k3) ** (1.0 / (1.0 - g.a3)))
    return LimitCycle(g.k3, g.a3, h_s, found[0], predicted, found[1])


def start_from(x1_m: float) -> Start:
    """Case 1 from rest anywhere."""
    loop = paper_loop(1)._replace(h=LOOP_H_S)
    trace = np.zeros((round(STARTS_S / LOOP_H_S), COLUMNS))
    fast(run_ideal)(initial_state(loop.plant._replace(initial_x1=x1_m)), loop, 0.0, trace)
    return Start(x1_m, settled(trace[:, WORST], FINE_M, LOOP_H_S, 0.5 * STARTS_S))


def unmatched(force_n: float, h_s: float) -> Unmatched:
    """A standing reference, no d(t), and a force that (7) does not know."""
    loop: IdealLoop = paper_loop(1)
    centre = loop.reference.centre_m
    loop = loop._replace(
        h=h_s,
        reference=loop.reference._replace(amplitude_m=0.0),
        plant=loop.plant._replace(disturbance=0, initial_x1=centre),
    )
    trace = np.zeros((round(FORCE_S / h_s), COLUMNS))
    end = fast(run_ideal)(initial_state(loop.plant), loop, force_n, trace)
    c, g = loop.plant.cylinder, loop.sliding.gains
    a = abs(force_n) / c.M
    return Unmatched(
        force_n,
        h_s,
        float(abs(trace[-1, W1])),
        float((g.k3 / g.k1 * a**g.a3 + g.k2 / g.k1 * (h_s * a) ** g.a2) ** (1.0 / g.a1)),
        min(end.x1 - c.x_e1, c.x_e1 + c.stroke_m - end.x1) < AT_STOP_M,
        float(abs(trace[-1, V])),
    )


def converge(report: Report = silent) -> Convergence:
    """All of it.

    Args:
        report: told how many runs are done.
    """

    def told(what: str, *sets: Iterable[Any]) -> Iterator[Any]:
        many = list(product(*sets))
        return each(many, report, what, len(many), "runs")

    composite = tuple(paper_loop(case).sliding.gains for case in CASES)
    first = composite[0]
    linear = feedback(first.k1, first.k2, first.k3, 1.0)
    plant = paper_loop(1).plant
    rod_n = plant.gas.atmosphere_pa * (plant.cylinder.A1 - plant.cylinder.A2)
    return Convergence(
        settling=(chain_settling(first), chain_settling(ISMC_GAINS), chain_settling(linear), loop_settling()),
        limit_cycles=tuple(
            limit_cycle(g, h) for g, h in told("limit cycles", (*composite, ISMC_GAINS), SAMPLE_TIMES_S)
        ),
        starts=tuple(start_from(x1) for (x1,) in told("starts", STARTS_M)),
        unmatched=tuple(unmatched(f, h) for f, h in told("forces", (*FORCES_N, rod_n), SAMPLE_TIMES_S)),
        decay=tuple(
            (g.a3, np.abs(chain((0.05, 0.0, 0.0), CHAIN_H_S, 15.0, g, True)[:, 0]))
            for g in (first, ISMC_GAINS, linear)
        ),
    )


def _settling(
    what: str, alpha: float, h_s: float, starts: tuple[float, ...], times: list[float], to_zero: list[float]
) -> Settling:
    return Settling(
        what,
        alpha,
        h_s,
        starts,
        tuple(times),
        tuple(to_zero),
        exponent_of(starts, tuple(times)),
        predicted_exponent(alpha),
    )


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value
