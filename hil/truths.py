"""Rigs that are not as their configurations say, commissioned in simulated time: a table of what came of it.

    python -m hil.truths                            # the twelve
    python -m hil.truths small:4 upright:7 large:10
    python -m hil.truths virtual:31 --keep build/truths --json

Each is commissioned as `pneud commission --virtual --seed` does it, with nothing set by hand. It says how
far the estimates are from the truth, as a share of what they may be off by, whether their intervals hold it,
what the axis is worth afterwards, and how long all took. Exit status 1 where a bound does not hold.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from os import times
from pathlib import Path
from typing import Any, NamedTuple

from pneud.config.conversions import plant_of
from pneud.config.flow import L_S_BAR, conductance_of
from pneud.config.models import Config
from pneud.loading import load
from pneud.physics.gas import flow_factor
from pneud.physics.plant import PlantParameters
from pneud.physics.valve import opening
from pneud.study.commissioning import estimated
from pneud.study.commissioning.bench import Simulated
from pneud.study.commissioning.page import tried
from pneud.study.commissioning.procedure import Outcome, Wishes, commission
from pneud.study.commissioning.truths import RIGS, TWELVE, Truth, drawn, rig_text
from pneud.study.identification import parameters as key
from pneud.study.identification.parameters import Estimate

FLOW = "flow"  # over opening and pressure ratio; no parameter of its own
OPENINGS_V, RATIOS = (0.3, 0.6, 1.2, 2.5, 4.5), (0.0, 0.3, 0.5, 0.7, 0.8, 0.9)  # beyond an edge; downstream
WITHIN_FLOW, EDGE_V = 0.05, 0.015
AXIS_S, COMPUTING_S = 300.0, 240.0  # of a commissioning: motion; two minutes of two processors
COVERED = 0.85  # share of the intervals that have to hold the truth, at least
UNKNOWN = {key.AREA, key.DELAY, key.EXHAUST, key.FORWARD, key.CRITICAL_OUT}  # no truth says otherwise of them


class Off(NamedTuple):
    """An estimate beside the truth."""

    key: str
    true: float
    found: float
    low: float
    high: float
    bound: float | None  # how far it may be off
    told: bool

    @property
    def holds(self) -> bool:
        """Near enough, where that is asked."""
        return self.bound is None or abs(self.found - self.true) <= self.bound

    @property
    def covered(self) -> bool:
        """The interval holds the truth."""
        return self.low <= self.true <= self.high


class Case(NamedTuple):
    """What came of one truth."""

    truth: Truth
    outcome: Outcome
    offs: tuple[Off, ...]
    axis_s: float
    computing_s: float  # of all processors together

    @property
    def missed(self) -> list[str]:
        """What does not hold."""
        o = self.outcome
        found = [] if o.after is None else [f"{f.part} {f.what}" for f in o.after.missed]
        found += [off.key for off in self.offs if not off.holds]
        found += [f"{o.verdict}: {o.failure or ', '.join(o.faults)}"] if o.after is None or o.failure else []
        found += ["unexplained"] if o.found is not None and o.found.unexplained else []
        found += ["axis time"] if self.axis_s > AXIS_S else []
        return found + (["computing time"] if self.computing_s > COMPUTING_S else [])


def true_values(c: Config) -> dict[str, tuple[float, float | None]]:
    """What estimates should say of a rig whose plant is the truth, and how far they may be off."""
    p, v, stroke_m = plant_of(c), c.plant.valve, c.cylinder.stroke_m
    centre_v, half_v = p.valve.centre_v, p.valve.dead_zone_v
    size = v.sonic_conductance_l_s_bar or conductance_of(c) / L_S_BAR
    bandwidth_hz = p.valve.omega_rad_s / (2.0 * math.pi)
    dead2_m = p.cylinder.L - p.cylinder.x_e1 - stroke_m
    f = p.friction
    found: dict[str, tuple[float, float | None]] = {
        key.CONDUCTANCE: (size, None),
        key.PLUS: (centre_v + half_v, EDGE_V),
        key.MINUS: (half_v - centre_v, EDGE_V),
        key.CENTRE: (centre_v, EDGE_V),
        key.HALF: (half_v, EDGE_V),
        key.BANDWIDTH: (bandwidth_hz, 0.2 * bandwidth_hz),
        key.DEAD1: (p.cylinder.x_e1, max(0.1 * p.cylinder.x_e1, 0.01 * stroke_m)),
        key.DEAD2: (dead2_m, max(0.1 * dead2_m, 0.01 * stroke_m)),
        key.MASS: (p.cylinder.M, 0.05 * p.cylinder.M),
        key.LOAD: (p.load_n - key.weight_share(c) * p.cylinder.M, 3.0),
        key.COULOMB: (f.coulomb_n, 0.1 * f.coulomb_n),
        key.STATIC: (f.static_n, 0.2 * f.static_n),
        key.STRIBECK: (f.stribeck_m_s, None),
        key.VISCOUS: (f.viscous_n_s_m, None),
        key.STIFFNESS: (f.sigma0_n_m, None),
        key.DAMPING: (f.sigma1_n_s_m, None),
        key.SEEP: (v.leakage, None),
        key.SEEP_OUT: (v.leakage if v.leakage_exhaust is None else v.leakage_exhaust, None),
        key.PLAY: (v.hysteresis_v, None),
    }
    if p.gas.exponent > 0.0:
        found[key.CRITICAL] = (p.gas.critical_ratio, None)
    if p.detail.wall_s > 0.0:
        found[key.WALL] = (p.detail.wall_s, None)
    else:
        found[key.EXPONENT] = (c.plant.polytropic_exponent or c.gas.heat_capacity_ratio, None)
    return found


def beside(c: Config, found: Mapping[str, Estimate]) -> list[Off]:
    """Each estimate beside the truth; one without an interval is left out."""
    true = true_values(c)
    offs = [
        Off(name, true[name][0], e.value, e.low, e.high, true[name][1], e.told)
        for name, e in found.items()
        if name in true and name not in UNKNOWN
    ]
    return sorted(offs, key=lambda off: (off.bound is None, off.key))


def flows(p: PlantParameters) -> list[float]:
    """What an edge lets through at some openings and pressure ratios [m²/s · √… per V · V]."""
    found = []
    for way in (1.0, -1.0):
        for beyond_v in OPENINGS_V:
            u = opening(p.valve.centre_v + way * (p.valve.dead_zone_v + beyond_v), p.valve)
            for g in (p.gas, p.cylinder.vent):
                found += [p.cylinder.c1 * abs(u) * flow_factor(ratio, g) for ratio in RATIOS]
    return found


def flow_off(truth: Config, found: Config) -> Off:
    """The largest difference of flow, as a share of it."""
    pairs = zip(flows(plant_of(truth)), flows(plant_of(found)), strict=True)
    worst = max((other / true - 1.0 for true, other in pairs), key=abs)
    return Off(FLOW, 0.0, worst, -math.inf, math.inf, WITHIN_FLOW, True)


class _Agreeing:
    """Somebody who agrees."""

    def say(self, words: str) -> None:
        print(f"  {words}", file=sys.stderr, flush=True)

    def agreed(self, _changes: object) -> bool:
        return True


def case(truth: Truth, keep: Path | None = None) -> Case:
    """Commission one; `keep`: a folder for configuration and logs."""
    with tempfile.TemporaryDirectory(prefix="truth-") as temporary:
        folder = Path(temporary)
        path = folder / f"{truth.rig}.toml"
        path.write_text(rig_text(truth.rig), encoding="utf-8")
        loaded = load(path)
        tables = drawn(loaded.config, truth.seed)
        rig = Simulated(loaded, tables, truth.seed, folder)
        before = _computed_s()
        outcome = commission(rig, Wishes(), _Agreeing())
        computing_s = _computed_s() - before
        offs: list[Off] = []
        if outcome.found is not None:
            real = load(path, None, tables).config
            as_found = estimated.changed(loaded.config, outcome.found.values)
            offs = [flow_off(real, as_found), *beside(real, outcome.found.identified.parameters)]
        if keep is not None:
            shutil.copytree(folder, keep / f"{truth.rig}-{truth.seed}", dirs_exist_ok=True)
    return Case(truth, outcome, tuple(offs), rig.axis_s, computing_s)


def _computed_s() -> float:
    """By this process and those that it has waited for [s]."""
    return sum(times()[:4])


def coverage(cases: Iterable[Case]) -> dict[str, tuple[int, int]]:
    """By parameter, and of all: how many intervals of what is told hold the truth, and how many there are."""
    inside, told = Counter[str](), Counter[str]()
    for off in (off for c in cases for off in c.offs if off.told and off.key != FLOW):
        for name in (off.key, ""):
            told[name] += 1
            inside[name] += off.covered
    return {name: (inside[name], count) for name, count in told.items()}


def in_words(c: Case) -> list[str]:
    """Some lines for each case."""
    o, took = c.outcome, f"{c.axis_s:.0f} s of motion, {c.computing_s:.0f} s of computing"
    head = f"{c.truth.rig} {c.truth.seed}: {o.verdict}; {took}"
    lines = [head, f"  missed: {', '.join(c.missed) or 'nothing'}"]
    for off in c.offs:
        share = "" if off.bound is None else f"{abs(off.found - off.true) / off.bound:6.2f}"
        mark = ("" if off.holds else " *") + ("" if off.covered else " not covered")
        mark += "" if off.told else " (not told)"
        lines.append(
            f"  {off.key:42} {off.true:11.5g} {off.found:11.5g} {off.low:11.5g} … {off.high:11.5g}"
            f" {share}{mark}"
        )
    for name, seen in (("before", o.before), ("after", o.after)):
        if seen is not None:
            figures = [f"{f.part} {f.what} {f.value:.4g}{'*' if f.ratio > 1.0 else ''}" for f in seen.figures]
            lines.append(f"  {name}: {'; '.join(figures)}{seen.failure and ' | ' + seen.words}")
    if o.found is not None:
        gains = o.found.chosen
        lines += [f"  {line}" for line in tried(o.tried)]
        lines += [f"  gains: {'those of before' if gains is None else gains.as_json()}"]
        lines += [f"  unexplained: {text}" for text in o.found.unexplained]
    return lines


def as_json(c: Case) -> dict[str, Any]:
    """For scripts."""
    o, offs = c.outcome, [off for off in c.offs if off.key != FLOW]
    return {
        "rig": c.truth.rig, "seed": c.truth.seed, "verdict": o.verdict, "missed": c.missed,
        "flow_off": next((off.found for off in c.offs if off.key == FLOW), None),
        "parameters": [{**off._asdict(), "holds": off.holds, "covered": off.covered} for off in offs],
        "before": None if o.before is None else o.before.as_json(),
        "after": None if o.after is None else o.after.as_json(),
        "axis_s": c.axis_s, "computing_s": c.computing_s,
    }  # fmt: skip


def truth_named(text: str) -> Truth:
    """RIG:SEED.

    Raises:
        ValueError: it is none.
    """
    rig, _, seed = text.partition(":")
    if rig not in ("virtual", *RIGS):
        raise ValueError(text)
    return Truth(rig, int(seed))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    rigs = f"RIG:SEED, of {', '.join(('virtual', *RIGS))}; the twelve without any"
    parser.add_argument("truths", nargs="*", type=truth_named, metavar="RIG:SEED", help=rigs)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for configurations and logs")
    parser.add_argument("--json", action="store_true", help="one object, at the end")
    given = parser.parse_args(arguments)
    cases = []
    for truth in given.truths or TWELVE:
        began = time.monotonic()
        cases.append(case(truth, given.keep))
        if not given.json:
            print("\n".join(in_words(cases[-1])), flush=True)
        print(f"{truth.rig} {truth.seed}: {time.monotonic() - began:.0f} s", file=sys.stderr)
    counts = coverage(cases)
    inside, told = counts.pop("", (0, 0))
    if given.json:
        print(json.dumps({"schema": 1, "cases": [as_json(c) for c in cases], "intervals": counts}))
    else:
        print(f"\nintervals that hold the truth: {inside} of {told}")
        print("\n".join(f"  {name:42} {a:3d} of {b}" for name, (a, b) in sorted(counts.items()) if a < b))
    return 0 if not any(c.missed for c in cases) and inside >= COVERED * told else 1


if __name__ == "__main__":
    sys.exit(main())
