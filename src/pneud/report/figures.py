"""Which figures a report has and what is in them; the page and the pictures draw the same ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.report.colours import BLACK, BLUE, GREEN, ORANGE, RED
from pneud.report.gather import LoggedRun


class Curve(NamedTuple):
    """One line."""

    column: str  # of `gather.COLUMNS`
    label: str
    colour: str


class Figure(NamedTuple):
    """One figure over time. Where logs are compared, only its first line is drawn at first."""

    name: str
    title: str
    unit: str
    series: tuple[Curve, ...]
    note: str = ""


FIGURES = (
    Figure("tracking", "Position", "mm", (
        Curve("position_mm", "encoder", BLUE), Curve("reference_mm", "reference", BLACK),
        Curve("truth_mm", "true position", GREEN),
    )),
    Figure("error", "Tracking error", "mm", (Curve("error_mm", "reference − position", BLUE),),
        "against the true position where a software plant tells it, else against the encoder"),
    Figure("velocity", "Velocity", "mm/s", (
        Curve("velocity_mm_s", "estimate", BLUE), Curve("reference_mm_s", "reference", BLACK),
    )),
    Figure("pressures", "Pressures", "bar", (
        Curve("p1_bar", "chamber 1", BLUE), Curve("p2_bar", "chamber 2", RED),
        Curve("supply_bar", "supply", BLACK),
    ), "absolute"),
    Figure("command", "Valve command", "V", (
        Curve("voltage_v", "sent", BLUE), Curve("law_v", "asked for by the law", ORANGE),
        Curve("applied_v", "applied", GREEN),
    )),
    Figure("force", "Unmatched force F̂", "N", (Curve("force_n", "F̂", BLUE),)),
    Figure("force-innovation", "Innovation behind F̂", "µm",
        (Curve("innovation_um", "encoder − prediction", BLUE),)),
    Figure("disturbance", "Matched disturbance d̂", "N/s", (Curve("d_hat_n_s", "d̂", BLUE),)),
    Figure("disturbance-innovation", "Innovation behind d̂", "N",
        (Curve("x3_innovation_n", "x3 − x̂3", BLUE),)),
    Figure("timing", "Timing", "µs", (
        Curve("lateness_us", "wake-up lateness", BLUE), Curve("latency_us", "sensor to command", ORANGE),
        Curve("sync_jitter_us", "jitter of SYNC", GREEN),
    )),
    Figure("ages", "Age of the newest valid values at SYNC", "ms", (
        Curve("encoder_age_ms", "encoder", BLUE), Curve("pressure_age_ms", "pressure", RED),
        Curve("valve_age_ms", "valve status", GREEN),
    ), "0 where a frame answered this tick's SYNC"),
)  # fmt: skip


def offsets_s(runs: Sequence[LoggedRun]) -> list[float]:
    """What to take from each run's times: several runs begin where they were first engaged."""
    if len(runs) < 2 or any(math.isnan(run.first_engaged_s) for run in runs):
        return [0.0] * len(runs)
    return [run.first_engaged_s for run in runs]


TIMED = frozenset({"lateness_us", "latency_us", "sync_jitter_us"})
"""Columns that nobody has measured where time is simulated."""


def line(run: LoggedRun, column: str) -> NDArray[np.float64] | None:
    """Values of a line at `run.series.t_s`; None where there is nothing to draw or nothing was measured."""
    if run.simulated and column in TIMED:
        return None
    values = run.series.values[:, run.columns[column]]
    return values if np.isfinite(values).any() else None
