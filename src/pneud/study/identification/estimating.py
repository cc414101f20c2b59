"""Parameters of a rig from a table of what was measured: the two fits, and what they say together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.config.flow import gas_of
from pneud.config.models import Config
from pneud.study.identification import chambers, forces
from pneud.study.identification import parameters as key
from pneud.study.identification.fitting import Fit, Found, Unknown, fit
from pneud.study.identification.parameters import Estimate
from pneud.study.identification.table import Table
from pneud.study.identification.windows import chamber_windows

Floats = NDArray[np.float64]
TRAVEL, TRAVEL_EXPONENT = (
    2e-3,
    0.005,
)  # errors, of the stroke and plain, where half of the stroke has been seen
FAST = 5.0  # Stribeck speeds from which on friction is Coulomb's and viscous alone
SLIDES, PRESLIDING = 2.0, 0.2  # Stribeck speeds from which on a load slides; what a tick before that counts
LEAST_PEAKS, PEAKS, PEAK_LOST = 5, (0.7, 0.9, 1.0), 1.1  # breakaways; quantiles; what smoothing takes of them
PEAKS_FROM = 0.06  # of Coulomb friction: the model does not explain how a load breaks away
FORCE_NOISE = 0.02  # of Coulomb friction, at least
LEAST_WINDOWS = 5  # with motion, where it is about that
WIDER, SHIFTS = 1.4, 2.0  # smoothing of the second fit; what it differs by counts so many times
FEW = 24  # windows, with which the fit begins
PINNED = 1e-3  # as good as known
LEAST_BY_WAY = 0.01  # share of friction by direction that is the rig's; a load explains less as well
BETTER = 0.9  # of a simpler model's misfit, from which on a further one is said to be the rig's
LOAD = forces.Slide._fields.index("load_n")
STIFFER = 3.0  # Maxwell elements are together than bristles that do as well
ALIKE = "kind of friction: bristles, and elements that slip one after another, explain about as much"
EXPLAINED = 1.5  # times the noise is what a model that explains all leaves


class Valved(NamedTuple):
    """The fit of valve and chambers."""

    fit: Fit
    windows: chambers.Windows
    rig: chambers.Rig
    structure: key.Structure
    misfit_pa: float

    @property
    def guess(self) -> chambers.Guess:
        """The parameters found."""
        return _guess(self.fit.keys, self.fit.x, self.rig)

    @property
    def seconds(self) -> float:
        """Length of a window."""
        return self.rig.h * int(self.windows.p1_pa.shape[1])


class Moved(NamedTuple):
    """The fit of the moving load."""

    fit: Fit
    windows: forces.Forces
    slips: bool  # by Maxwell elements, rather than bristles
    by_way: bool  # its friction differs by direction
    left_n: Floats  # of the force: (window, tick)
    misfit_n: float
    step_m: float = 0.0  # of the encoder
    other: Fit | None = None  # by the other kind of friction, where that explains about as much


class Identified(NamedTuple):
    """What the logs tell."""

    parameters: dict[str, Estimate]
    linked: list[tuple[str, str, float]]  # hardly told apart, by key, with their correlation
    notes: list[str]  # what cannot be told, and why
    noise_pa: float  # of the pressure sensors, as the readings show it
    valved: Valved | None
    moved: Moved | None


def identify(t: Table, c: Config) -> Identified:
    """All parameters that the table tells, with what it cannot tell."""
    config, notes = key.configured(c), list[str]()
    found: dict[str, Estimate] = {}
    linked: list[tuple[str, str, float]] = []
    noise_pa = pressure_noise_pa(t)
    valved, moved = of_valve(t, c, noise_pa), of_load(t, c, noise_pa)
    if valved is not None:
        found |= _valve_estimates(valved, c, config)
        sizes = {"flow": key.CONDUCTANCE} if valved.structure.iso else {}
        linked += _named(valved.fit, {**_CHAMBER_KEYS, **sizes})
    else:
        notes.append("valve and chambers: too few whole windows")
    if moved is not None:
        found |= _load_estimates(moved, c, config)
        _with_breakaway(found, moved, t, c)
        linked += _named(moved.fit, _SLIDE_KEYS)
        notes += [ALIKE] if moved.other is not None else []
    else:
        notes.append(f"mass, load and friction: hardly {LEAST_WINDOWS} s of motion away from the ends")
    notes += [f"{name}: {key.LACKING[name]}" for name, e in found.items() if not e.told]
    return Identified(found, linked, notes, noise_pa, valved, moved)


def pressure_noise_pa(t: Table) -> float:
    """Standard deviation of the sensors' noise, from what no smooth signal has."""
    third = np.concatenate([np.diff(p, 3) for piece in t.pieces for p in (piece.p1_pa, piece.p2_pa)])
    return max(1.0, math.sqrt(0.5 * math.pi / 20.0) * float(np.mean(np.abs(third))))


def of_valve(t: Table, c: Config, noise_pa: float) -> Valved | None:
    """The fit of valve and chambers, with the flow that explains more."""
    k = c.cylinder
    w = chamber_windows(t, c, (k.dead_length_1_m, k.dead_length_2_m))
    if len(w.x_m) < LEAST_WINDOWS:
        return None
    found = _first_fit(w, t, c, noise_pa)
    known = _values(found)
    if found.structure.heat:
        w = chamber_windows(t, c, (known["dead1_m"], known["dead2_m"]))
    found = _fit_valve(w, t, c, noise_pa, found.structure, known, True)
    if found.structure.iso and found.misfit_pa > EXPLAINED * noise_pa:
        apart = found.structure._replace(apart=True)
        other = _fit_valve(w, t, c, noise_pa, apart, _values(found), True)
        found = other if other.misfit_pa < BETTER * found.misfit_pa else found
    return found


def _first_fit(w: chambers.Windows, t: Table, c: Config, noise_pa: float) -> Valved:
    """Of a few windows, with the structure that explains them."""
    few = chambers.some(w, FEW)
    plain = key.Structure(c.valve.flow == "iso6358", False)
    found = _fit_valve(few, t, c, noise_pa, plain, {}, False)
    for structure in (plain._replace(heat=True), plain._replace(iso=True), key.Structure(True, True)):
        if found.misfit_pa > EXPLAINED * noise_pa and structure not in (plain, found.structure):
            other = _fit_valve(few, t, c, noise_pa, structure, _values(found), False)
            found = other if other.misfit_pa < BETTER * found.misfit_pa else found
    return found


def _values(valved: Valved) -> dict[str, float]:
    return valved.fit.by_key


def _guess(keys: Sequence[str], columns: Floats, rig: chambers.Rig) -> chambers.Guess:
    """Guesses from columns of some parameters; the others are as where there is nothing of the kind."""
    others = {"exponent": rig.gas.k, "critical": 0.0, "wall_1_s": 0.0}
    given = {name: np.full_like(columns[0], x) for name, x in others.items()}
    given |= dict(zip(keys, columns, strict=True))
    return chambers.Guess(**{"critical_out": given["critical"], **given})


def _fit_valve(
    w: chambers.Windows, t: Table, c: Config, noise_pa: float, structure: key.Structure,
    first: dict[str, float], whole: bool,
) -> Valved:  # fmt: skip
    k, v = c.cylinder, c.valve
    rig = chambers.Rig(
        k.piston_area_1_m2, k.piston_area_2_m2, k.stroke_m, v.u_max_v, v.damping, gas_of(c), t.h
    )
    measured = np.array([w.p1_pa, w.p2_pa])
    unknowns = key.chamber_unknowns(c, t.delay_s, first, structure)
    if not whole:  # with edges of several sizes an orifice could pass for what it is not
        unknowns = [
            u._replace(low=u.prior - PINNED, high=u.prior + PINNED) if u.key == "exhaust" else u
            for u in unknowns
        ]
    keys = [u.key for u in unknowns]

    def predict(guesses: Floats) -> Floats:
        off = (chambers.simulate(w, _guess(keys, guesses.T, rig), rig, structure.iso) - measured) / noise_pa
        return np.concatenate([off[:, 0], off[:, 1]], axis=2)

    done = fit(predict, unknowns)
    return Valved(done, w, rig, structure, noise_pa * _usual(done.residuals))


def of_load(t: Table, c: Config, noise_pa: float) -> Moved | None:
    """The fit of the moving load, with the friction that explains more.

    What depends on how much is smoothed is less sure.
    """
    k, f = c.cylinder, c.control.friction
    w = forces.windows(t, balance(c))
    if int((np.abs(w.sliding_m_s) > forces.LEAVES_M_S).any(axis=1).sum()) < LEAST_WINDOWS:
        return None
    known = (k.moving_mass_kg, k.resistance_n, f.coulomb_n, f.viscous_n_s_m)
    first = forces.at_once(w, FAST * f.stribeck_speed_m_s) or known
    noise_n = max(noise_pa * k.piston_area_1_m2, FORCE_NOISE * abs(first[2]))
    fast_m_s = SLIDES * f.stribeck_speed_m_s
    unknowns = key.slide_unknowns(c, first)
    moved, less = _by_either(w, unknowns, noise_n, fast_m_s)
    alike = moved.misfit_n > BETTER * less.misfit_n
    by_way = key.by_way(_from(moved.fit, unknowns))
    directed = _fit_load(w, by_way, noise_n, fast_m_s, moved.slips)
    beside_n = 0.0
    differs = abs(float(directed.fit.found(forward=1.0).value)) > LEAST_BY_WAY
    if differs and directed.misfit_n < BETTER * moved.misfit_n:
        unknowns, moved = by_way, directed._replace(by_way=True)
    else:  # what friction may differ by all the same is load
        beside_n = float(directed.fit.x[LOAD] - moved.fit.x[LOAD])
    wider = forces.windows(t, balance(c), WIDER)
    again = _fit_load(wider, _from(moved.fit, unknowns), noise_n, fast_m_s, moved.slips)
    step_m = forces.encoder_step_m(t)
    beside = np.zeros(len(moved.fit.x)) if not alike else less.fit.x - moved.fit.x
    beside[LOAD] = math.hypot(beside[LOAD], beside_n)
    beside = np.hypot(beside, _by_step(moved.fit, step_m))
    shift = SHIFTS * (again.fit.x - moved.fit.x)
    shift = np.copysign(np.hypot(shift, beside), shift)
    other = less.fit if alike else None
    return moved._replace(fit=moved.fit._replace(shift=shift), step_m=step_m, other=other)


def _by_either(
    w: forces.Forces, unknowns: Sequence[Unknown], noise_n: float, fast_m_s: float
) -> tuple[Moved, Moved]:
    """By bristles and by Maxwell elements, which have as many parameters: what explains more comes first."""
    bristles = _fit_load(w, unknowns, noise_n, fast_m_s, False)
    elements = _fit_load(w, _from(bristles.fit, unknowns, STIFFER), noise_n, fast_m_s, True)
    return (elements, bristles) if elements.misfit_n < bristles.misfit_n else (bristles, elements)


def _by_step(found: Fit, step_m: float) -> Floats:
    """How far the encoder's step may put the bristles off, by its share of the way that they give.

    That share of their stiffness, and of the damping with which the load would swing no more on them.
    """
    x = found.by_key
    share = step_m / (x["coulomb"] * (1.0 + x["static"]) / x["stiffness"])
    off = {"stiffness": share * x["stiffness"], "damping": share * math.sqrt(x["stiffness"] * x["mass"])}
    return np.array([off.get(key, 0.0) for key in found.keys])


def _from(found: Fit, unknowns: Sequence[Unknown], stiffer: float = 1.0) -> list[Unknown]:
    """The unknowns, to be sought from what has been found."""
    starts = zip(unknowns, found.x.tolist(), strict=True)
    return [u._replace(start=x * (stiffer if u.key == "stiffness" else 1.0)) for u, x in starts]


def _fit_load(
    w: forces.Forces, unknowns: Sequence[Unknown], noise_n: float, fast_m_s: float, slips: bool
) -> Moved:
    # what a load does before it slides is the hardest to explain, and has to spoil neither mass nor friction
    counts = np.where(np.abs(w.sliding_m_s) > fast_m_s, 1.0, PRESLIDING) / noise_n

    def predict(guesses: Floats) -> Floats:
        return (forces.predicted(w, forces.Slide(*guesses.T), slips) - w.force_n) * counts

    done = fit(predict, unknowns)
    left_n = -done.residuals / counts
    return Moved(done, w, slips, False, left_n, _usual(left_n))


def balance(c: Config) -> forces.Balance:
    """What the configuration says of areas and atmosphere."""
    k = c.cylinder
    area1, area2 = k.piston_area_1_m2, k.piston_area_2_m2
    return forces.Balance(area1, area2, c.gas.atmosphere_pa * (area1 - area2), k.stroke_m)


def _with_breakaway(found: dict[str, Estimate], moved: Moved, t: Table, c: Config) -> None:
    """Put the peaks before motion in place of a static friction that the model does not tell."""
    e = found[key.STATIC]
    if e.told and moved.misfit_n < PEAKS_FROM * found[key.COULOMB].value:
        return
    rig = balance(c)._replace(mass_kg=float(moved.fit.x[0]), load_n=float(moved.fit.x[1]))
    peaks = np.concatenate([forces.breakaways(p, rig, t.h) for p in t.pieces])
    if len(peaks) < LEAST_PEAKS:
        return
    low, value, high = np.quantile(peaks, PEAKS).tolist()
    found[key.STATIC] = Estimate(value, low, max(high, value) * PEAK_LOST, e.configured, True)


def _usual(residuals: Floats) -> float:
    """RMS of what is left, in the usual window."""
    return float(np.median(np.sqrt((residuals**2).mean(axis=1))))


_CHAMBER_KEYS = {
    "flow": key.AREA, "plus_v": key.PLUS, "minus_v": key.MINUS, "bandwidth_hz": key.BANDWIDTH,
    "delay_s": key.DELAY, "dead1_m": key.DEAD1, "dead2_m": key.DEAD2, "exponent": key.EXPONENT,
    "seep": key.SEEP, "seep_out": key.SEEP_OUT, "play_v": key.PLAY, "exhaust": key.EXHAUST,
    "critical": key.CRITICAL, "critical_out": key.CRITICAL_OUT, "wall_1_s": key.WALL,
}  # fmt: skip
_SLIDE_KEYS = {
    "mass": key.MASS, "load": key.LOAD, "coulomb": key.COULOMB, "static": key.STATIC,
    "stribeck": key.STRIBECK, "viscous": key.VISCOUS, "stiffness": key.STIFFNESS,
    "damping": key.DAMPING, "forward": key.FORWARD,
}  # fmt: skip


def _named(f: Fit, names: dict[str, str]) -> list[tuple[str, str, float]]:
    told = {name for name, told in zip(f.keys, f.told, strict=True) if told}
    return [(names[one], names[other], r) for one, other, r in f.linked() if {one, other} <= told]


def _valve_estimates(valved: Valved, c: Config, config: dict[str, float]) -> dict[str, Estimate]:
    f, g = valved.fit, gas_of(c)
    if valved.structure.iso:
        flows = {
            key.CONDUCTANCE: f.found(flow=1.0 / key.flow_of_conductance(1.0, g)),
            key.CRITICAL: f.found(critical=1.0),
        }
    else:
        flows = {key.AREA: f.found(flow=1.0 / key.flow_of_area(1.0, g))}
    if valved.structure.apart:
        flows[key.CRITICAL_OUT] = f.found(critical_out=1.0)
    found = {
        **flows,
        key.PLUS: f.found(plus_v=1.0),
        key.MINUS: f.found(minus_v=-1.0),
        key.HALF: f.found(plus_v=0.5, minus_v=-0.5),
        key.CENTRE: f.found(plus_v=0.5, minus_v=0.5),
        key.BANDWIDTH: f.found(bandwidth_hz=1.0),
        key.DELAY: f.found(delay_s=1e6),
        key.SEEP: f.found(seep=1.0),
        key.SEEP_OUT: f.found(seep_out=1.0),
        key.PLAY: f.found(play_v=2.0),
        key.EXHAUST: f.found(exhaust=1.0),
        key.DEAD1: f.found(dead1_m=1.0),
        key.DEAD2: f.found(dead2_m=1.0),
        **_heat_estimates(valved),
    }
    span = float(np.ptp(valved.windows.x_m)) / c.cylinder.stroke_m
    return {name: key.estimate(name, one, config, _by_travel(name, span, c)) for name, one in found.items()}


def _heat_estimates(valved: Valved) -> dict[str, Found]:
    if not valved.structure.heat:
        return {key.EXPONENT: valved.fit.found(exponent=1.0)}
    rate = float(valved.guess.wall_1_s)
    # a reciprocal, by its differential
    return {key.WALL: valved.fit.found(wall_1_s=-1.0 / rate**2).moved(2.0 / rate)}


def _by_travel(name: str, span: float, c: Config) -> float:
    """How much less sure a dead length [m], or the exponent, is where not all of the stroke was seen."""
    unseen = max(0.0, 1.0 / max(span, 1e-3) - 1.0)
    if name in (key.DEAD1, key.DEAD2):
        return TRAVEL * c.cylinder.stroke_m * unseen
    return TRAVEL_EXPONENT * unseen if name == key.EXPONENT else 0.0


def _load_estimates(moved: Moved, c: Config, config: dict[str, float]) -> dict[str, Estimate]:
    f = moved.fit
    coulomb, static = (float(f.x[f.keys.index(name)]) for name in ("coulomb", "static"))
    found = {
        key.MASS: f.found(mass=1.0),
        key.LOAD: f.found(load=1.0, mass=-key.weight_share(c)),
        key.COULOMB: f.found(coulomb=1.0),
        # a product, by its differential
        key.STATIC: f.found(coulomb=1.0 + static, static=coulomb).moved(-coulomb * static),
        key.STRIBECK: f.found(stribeck=1.0),
        key.VISCOUS: f.found(viscous=1.0),
        key.STIFFNESS: f.found(stiffness=1.0),
        key.DAMPING: f.found(damping=1.0),
    }
    if moved.by_way:
        found[key.FORWARD] = f.found(forward=1.0)
    return {name: key.estimate(name, one, config) for name, one in found.items()}
