"""The paper's two cases run again: composite law against ISMC, every sample time, discretisation and orifice.

Table 1, the gains and the reference come from the configurations `paper-case1.toml` and `paper-case2.toml`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from pneud.config.conversions import axis_of, plant_of
from pneud.control.disturbance import EXPLICIT, IMPLICIT, MATCHED
from pneud.control.homogeneous import feedback
from pneud.loading import load
from pneud.rig.dynamics import initial_state
from pneud.rt.extras import missing
from pneud.study.ideal import COLUMNS, E3, ED, P2, SQUARE, WORST, IdealLoop, U, run_ideal
from pneud.study.jit import jitted

Trace = npt.NDArray[np.float64]
F = TypeVar("F", bound=Callable[..., Any])

DURATION_S = 30.0
STEADY_FROM_S = 10.0  # the steady window lasts from here to the end: ten periods of the reference
PLANT_STEP_S = 1e-4  # longest step of the plant's integration
COARSE_M, FINE_M = 1e-4, 1e-6  # converged: the error enters this band in the first half of a run and stays
OBSERVER_N, OBSERVER_N_S = 1.0, 5.0  # the same for e3 and e_d; |d| is 40 N/s in Case 1, up to 184 in Case 2

CASES = (1, 2)
SAMPLE_TIMES_S = (0.01, 0.001)
COMPOSITE, ISMC = "composite", "ismc"
NAMES = {COMPOSITE: "composite", ISMC: "ISMC"}
ISMC_GAINS = feedback(200.0, 500.0, 400.0, 0.9)  # l1, l2, l3 of Section 5; β3 = 9/10
OBSERVERS = {"explicit": EXPLICIT, "implicit": IMPLICIT, "matched": MATCHED}
FORMS = (
    ("explicit", "explicit"),
    ("implicit", "explicit"),
    ("implicit", "implicit"),
    ("implicit", "matched"),
)


class Setting(NamedTuple):
    """What one run is about."""

    case: int
    law: str  # whose gains: COMPOSITE or ISMC
    compensated: bool  # d̂ in the law; the paper has it in the composite law only
    h_s: float
    form: str  # of the law: explicit or implicit
    observer: str  # its form: explicit, implicit or matched
    reverse_flow: bool  # of the plant's orifice
    reverse_model: bool  # of the orifice the law believes in


class PaperRow(NamedTuple):
    """What came out of it; steady: over the steady window; None: never."""

    setting: Setting
    coarse_s: float | None  # convergence to 0.1 mm
    fine_s: float | None  # to 1 µm
    rms_m: float  # steady
    max_m: float
    observer_s: float | None  # convergence of e3 and e_d to their bands
    e_d_rms_n_s: float  # steady, as all that follows
    effort_v: float  # mean |u|
    chatter_v: float  # mean |Δu| from sample to sample
    saturated: float  # part of the samples at ±u_max
    p2_max_pa: float  # over the whole run


class PaperRun(NamedTuple):
    """A row and the trace it was made of."""

    row: PaperRow
    trace: Trace


def fast(function: F) -> F:
    """The function compiled where numba is there, else as it is: the results are the same."""
    return function if missing("sim") else jitted(function)


def paper_loop(case: int) -> IdealLoop:
    """The loop of a case as the paper's sample time and the implicit forms make it."""
    loaded = load(f"paper-case{case}.toml")
    axis = axis_of(loaded.config, loaded.codecs.command_lsb_v)
    plant = plant_of(loaded.config)._replace(step_s=PLANT_STEP_S)
    return IdealLoop(
        plant=plant,
        sliding=axis.controller.sliding,
        observer=axis.controller.observer,
        h=axis.controller.h,
        reference=axis.reference._replace(centre_m=axis.reference.centre_m + plant.cylinder.x_e1),
        reverse_model=plant.reverse_flow,
    )


def loop_of(s: Setting) -> IdealLoop:
    """The loop that a setting asks for."""
    loop = paper_loop(s.case)
    return loop._replace(
        plant=loop.plant._replace(reverse_flow=s.reverse_flow),
        sliding=loop.sliding._replace(
            gains=loop.sliding.gains if s.law == COMPOSITE else ISMC_GAINS,
            implicit=s.form == "implicit",
            compensate_d=s.compensated,
        ),
        observer=loop.observer._replace(form=OBSERVERS[s.observer]),
        h=s.h_s,
        reverse_model=s.reverse_model,
    )


def run(s: Setting, duration_s: float = DURATION_S) -> PaperRun:
    """One run from x1(0) of the configuration, at rest and in balance."""
    loop = loop_of(s)
    trace = np.zeros((round(duration_s / s.h_s), COLUMNS))
    fast(run_ideal)(initial_state(loop.plant), loop, 0.0, trace)
    return PaperRun(measured(s, trace, loop.plant.valve.u_max_v), trace)


def measured(s: Setting, trace: Trace, u_max_v: float) -> PaperRow:
    """The figures of a run; its steady window is the last two thirds."""
    half_s = 0.5 * len(trace) * s.h_s
    window = trace[round(len(trace) * STEADY_FROM_S / DURATION_S) :]
    worst_of_observer = np.maximum(np.abs(trace[:, E3]) / OBSERVER_N, np.abs(trace[:, ED]) / OBSERVER_N_S)
    return PaperRow(
        setting=s,
        coarse_s=settled(trace[:, WORST], COARSE_M, s.h_s, half_s),
        fine_s=settled(trace[:, WORST], FINE_M, s.h_s, half_s),
        rms_m=float(np.sqrt(window[:, SQUARE].mean())),
        max_m=float(window[:, WORST].max()),
        observer_s=settled(worst_of_observer, 1.0, s.h_s, half_s),
        e_d_rms_n_s=float(np.sqrt((window[:, ED] ** 2).mean())),
        effort_v=float(np.abs(window[:, U]).mean()),
        chatter_v=float(np.abs(np.diff(window[:, U])).mean()),
        saturated=float((np.abs(window[:, U]) >= u_max_v).mean()),
        p2_max_pa=float(trace[:, P2].max()),
    )


def settled(values: Trace, band: float, h_s: float, latest_s: float = math.inf) -> float | None:
    """Time from which |values| stay within a band to the end; None where they do not.

    Args:
        values: one a sample.
        band: NaN lies in no band.
        h_s: sample time.
        latest_s: settled later than this is not settled, since too little of the run is left to tell.
    """
    outside = np.nonzero(~(np.abs(values) <= band))[0]
    if len(outside) == 0:
        return 0.0
    time_s = round(float((outside[-1] + 1) * h_s), 9)
    return time_s if outside[-1] < len(values) - 1 and time_s <= latest_s else None


def main_settings() -> list[Setting]:
    """Case × law × sample time × forms × reverse flow, the law's orifice like the plant's.

    The ISMC has no use for the observer, so that its form does not matter.
    """
    return [
        Setting(case, law, law == COMPOSITE, h, form, observer, reverse, reverse)
        for case, reverse, h, (form, observer), law in itertools.product(
            CASES, (False, True), SAMPLE_TIMES_S, FORMS, (COMPOSITE, ISMC)
        )
        if law == COMPOSITE or form == observer
    ]


def ablation_settings() -> list[Setting]:
    """Each law's gains with and without d̂: what is the observer's merit, and what the gains'."""
    return [
        Setting(case, law, compensated, h, form, form, False, False)
        for case, h, form, law, compensated in itertools.product(
            CASES, SAMPLE_TIMES_S, ("implicit", "explicit"), (COMPOSITE, ISMC), (True, False)
        )
    ]


def orifice_settings() -> list[Setting]:
    """The implicit composite law with each orifice in the plant and in the law."""
    return [
        Setting(case, COMPOSITE, True, h, "implicit", "implicit", plant, model)
        for case, h, plant, model in itertools.product(CASES, SAMPLE_TIMES_S, (False, True), (False, True))
    ]
