"""One optimiser and one cost for the gains of every law that is compared.

python -m pneud.study.tuner [LAW …]
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

import numpy as np

from pneud.control.step import Controller
from pneud.loading import load
from pneud.study import cases
from pneud.study.cases import Bench, Case, Figures, bench_of, figures
from pneud.study.tuned import ADRC3, ADRC4, COMPOSITE, EXTENDED_TUNED, ISMC, PID_FF, setting

Gains = dict[str, float]
_CHAIN = {"k1": 64000.0, "k2": 4800.0, "k3": 120.0}  # of three integrators
_FILTER = {"bw": 316.0, "push": 600.0}
_SLIDING = {**_CHAIN, "alpha": 0.9, "eta": 20.0, "hold": 0.03, **_FILTER}
STARTS: dict[str, Gains] = {
    PID_FF: {"kp": 1600.0, "ki": 20000.0, "kd": 80.0, "kf": 150.0, "reach": 0.02, "hold": 0.03, **_FILTER},
    ADRC4: {**_CHAIN, "reach": 0.02, "hold": 0.03, "eso": 400.0},
    ADRC3: {**_CHAIN, "reach": 0.02, "hold": 0.03, **_FILTER, "rate": 580.0},
    ISMC: _SLIDING,
    COMPOSITE: {**_SLIDING, "L": 2400.0},
    EXTENDED_TUNED: {
        **{"k1": 95000.0, "k2": 6050.0, "k3": 104.0, "alpha": 0.923, "eta": 0.3, "L": 2400.0, "hold": 0.034},
        **{**_FILTER, "rate": 580.0},
    },
}
UNSTABLE = 1e3  # cost of gains that let the simulation overflow
RANDOM, REFINED = 100, 300  # evaluations
SPAN = 2.0  # random search covers each gain from 1/e² to e² times its start
RECOVERIES = ("start +400 mm", "start -400 mm", "push +500 N", "push -500 N")
OFF_MODEL = ("mass x 0.5", "mass x 1.5", "friction x 2", "hose 3 ms", "encoder 10 um")


def course(bench: Bench) -> dict[str, Case]:
    """The cases that count."""
    every = cases.sines(bench) | cases.moves(bench) | cases.loads(bench) | cases.rests(bench, 3.0)
    every |= cases.recoveries(bench) | cases.spread(bench)
    names = ("sine 0.5 Hz", "sine 2 Hz", "50 N on", "-50 N off", "move 10 mm", "move 100 mm", "rest")
    return {name: every[name] for name in (*names, *RECOVERIES, *OFF_MODEL)}


def parts(name: str, f: Figures) -> list[float]:
    """Figures of a case over what they should be."""
    mm, max_mm = f.rms_m * 1e3, f.max_m * 1e3
    if name == "sine 0.5 Hz":
        return [mm / 0.02, max_mm / 0.08, f.chatter_v / 0.05]
    if name == "sine 2 Hz":
        return [mm / 0.1, max_mm / 0.25]
    if name.startswith("move"):
        return [mm / 0.02, max_mm / 0.08]
    if name == "rest":
        return [max_mm / 0.05, f.chatter_v / 0.02]
    if "50 N" in name:
        return [max_mm / 0.6, min(f.settled_s, 1.0) / 0.3]
    if name in RECOVERIES:
        return [mm / 0.02]
    return [mm / 0.2]


def cost(bench: Bench, p: Controller, over: dict[str, Case], limit: float = math.inf) -> float:
    """Sum of log(1 + ratio²): counts what is far off, without drowning the rest in it.

    Stops where it exceeds `limit`.
    """
    total = 0.0
    for name, c in over.items():
        for ratio in parts(name, figures(bench, p, c)):
            if not math.isfinite(ratio):
                return UNSTABLE
            total += math.log1p(ratio * ratio)
        if total > limit:
            break
    return total


def tune(
    value: Callable[[Gains, float], float], begin: Gains, seed: int, random: int, refined: int
) -> tuple[Gains, float]:
    """The best gains found: a random search about `begin`, then steps of adapting size from its best.

    Args:
        value: what to minimise; may stop at anything above the limit that it is given.
        begin: gains to begin with, all positive.
        seed: of the random numbers; the same seed finds the same gains.
        random: evaluations of the search.
        refined: evaluations of the refinement.
    """
    rng = np.random.default_rng(seed)
    names = list(begin)
    best, least = dict(begin), value(begin, math.inf)
    for _ in range(random):
        trial = _moved(begin, names, SPAN * rng.uniform(-1.0, 1.0, len(names)))
        found = value(trial, least)
        if found < least:
            best, least = trial, found
    size = 0.3
    for _ in range(refined):
        trial = _moved(best, names, size * rng.normal(0.0, 1.0, len(names)))
        found = value(trial, least)
        better = found < least
        if better:
            best, least = trial, found
        size = min(0.5, max(0.01, size * (1.5 if better else 0.9)))
    return best, least


def _moved(gains: Gains, names: list[str], logs: np.ndarray) -> Gains:
    moved = {n: gains[n] * math.exp(x) for n, x in zip(names, logs, strict=True)}
    if "alpha" in moved:  # its distance from one is what is scaled
        moved["alpha"] = max(0.5, 1.0 - (1.0 - gains["alpha"]) * moved["alpha"] / gains["alpha"])
    return moved


def main(names: list[str]) -> None:
    """Tune laws and print their gains as they stand in `tuned.py`."""
    bench = bench_of(load("virtual.toml"), compiled=True)
    over = course(bench)
    for name in names or list(STARTS):

        def value(g: Gains, limit: float, name: str = name) -> float:
            return cost(bench, setting(name, bench.controller, g), over, limit)

        gains, least = tune(value, STARTS[name], 1, RANDOM, REFINED)
        print(name, {n: float(f"{x:.4g}") for n, x in gains.items()}, f"cost {least:.2f}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
