"""The force on the piston under the measured motion: mass, load and friction, for many guesses at once.

Pressures are known better than accelerations, so the force is what is predicted. Motion and force are
smoothed alike; friction is computed from hardly smoothed motion and smoothed afterwards, since it is no
linear function of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.physics.slip import K1, K2, K3, K4
from pneud.study.identification.table import Piece, Table
from pneud.study.identification.windows import chosen, smoothed

Floats = NDArray[np.float64]
WINDOW_S, WARM_S = 1.0, 0.15
MOST = 80  # windows
LIGHT_S = 0.002  # standard deviation of the smoothing before friction is computed
LEAST_S, MOST_S = 0.004, 0.01  # of that of force and acceleration: encoders of large steps need more
PEAK_S = 0.003  # of that where a peak is looked for
STANDS_M_S, LEAVES_M_S = 1e-3, 1e-2  # a load stands below, and slides beyond
BEFORE_S, STOOD_S, LEAVES_S = 0.3, 0.05, 0.03  # it stood for so long, so short before it slid for so long
SHARES = (K1, K2, K3, K4)  # of the stiffness
ENDS = 0.015  # of the stroke, where cushions may be


class Balance(NamedTuple):
    """What makes forces of pressures, and what else acts on the load."""

    area1_m2: float
    area2_m2: float
    rod_n: float  # of the atmosphere on the rod
    stroke_m: float
    mass_kg: float = 0.0
    load_n: float = 0.0


class Forces(NamedTuple):
    """Windows of a log as (window, tick), in the middle of each tick."""

    v_m_s: Floats  # hardly smoothed, with ticks before and behind those that count
    a_m_s2: Floats
    force_n: Floats  # P1 A1 − P2 A2 less the atmosphere's on the rod
    mean_pa: Floats  # of both chambers
    start_a_m_s2: Floats  # before the first tick
    start_n: Floats
    margin: int  # ticks before and behind
    more: float  # smoothing of friction still to come, in ticks
    h: float

    @property
    def sliding_m_s(self) -> Floats:
        """Speed in the ticks that count."""
        return self.v_m_s[:, self.margin : self.v_m_s.shape[1] - self.margin]


class Slide(NamedTuple):
    """Guesses, each a column."""

    mass_kg: Floats
    load_n: Floats  # with the weight's part, against positive motion
    coulomb_n: Floats
    static: Floats  # how much more, relative
    stribeck_m_s: Floats
    viscous_n_s_m: Floats
    stiffness_n_m: Floats
    damping_n_s_m: Floats  # of the bristles
    forward: Floats  # share of friction that is more on the way out, and less on the way back


def encoder_step_m(t: Table) -> float:
    """The step of the encoder, as readings show it."""
    steps = np.abs(np.concatenate([np.diff(p.position_m) for p in t.pieces]))
    steps = steps[steps > 1e-8]
    return float(np.quantile(steps, 0.02)) if len(steps) else 0.0


def windows(t: Table, rig: Balance, wider: float = 1.0) -> Forces:
    """Those away from the ends in which most happens; none where there is nothing but rest.

    Args:
        t: the table.
        rig: what is known of the cylinder.
        wider: how much more all is smoothed than need be.
    """
    light = max(0.5, wider * LIGHT_S / t.h)
    width = max(light, wider * min(MOST_S, LEAST_S + 400.0 * encoder_step_m(t)) / t.h)
    margin = math.ceil(max(WARM_S / t.h, 4.0 * width))
    length = max(50, round(WINDOW_S / t.h))
    rows: list[tuple[Floats, ...]] = []
    told: list[float] = []
    for piece in t.pieces:
        v, a, force = _quantities(piece, light, width, t.h, rig)
        for begin in range(0, len(v) - length - 2 * margin, length):
            wide = slice(begin, begin + length + 2 * margin)
            count = slice(begin + margin, begin + margin + length)
            x = piece.position_m[wide]
            if ENDS * rig.stroke_m < x.min() and x.max() < (1.0 - ENDS) * rig.stroke_m:
                mean = 0.5 * (piece.p1_pa[count] + piece.p2_pa[count])
                rows.append((v[wide], a[count], force[count], mean, a[begin], force[begin]))
                told.append(float(np.ptp(v[count]) + 0.2 * np.mean(np.abs(v[count]))))
    kept = [rows[i] for i in chosen(told, MOST)]
    columns = [np.array(column) for column in zip(*kept, strict=True)] if kept else [np.zeros((0, 0))] * 6
    return Forces._make([*columns, margin, math.sqrt(max(0.0, width**2 - light**2)), t.h])


def _quantities(
    p: Piece, light: float, width: float, h: float, rig: Balance
) -> tuple[Floats, Floats, Floats]:
    """Speed, acceleration and force in the middle of each tick."""
    v = np.diff(smoothed(p.position_m, light)) / h
    x = smoothed(p.position_m, width)
    a = np.zeros_like(x)
    a[1:-1] = (x[2:] - 2.0 * x[1:-1] + x[:-2]) / (h * h)
    force = smoothed(p.p1_pa * rig.area1_m2 - p.p2_pa * rig.area2_m2 - rig.rod_n, width)
    return v, 0.5 * (a[1:] + a[:-1]), 0.5 * (force[1:] + force[:-1])


def friction(w: Forces, g: Slide, slips: bool) -> Floats:
    """Friction in the ticks that count: (guess, window, tick) [N].

    Args:
        w: the motion.
        g: the guesses.
        slips: by Maxwell elements that slip one after another; otherwise by LuGre's bristles.
    """
    c = Slide._make(np.asarray(value, dtype=float)[:, None, None] for value in g)
    v = w.v_m_s[None]
    way = 1.0 + c.forward * np.where(v > 0.0, 1.0, -1.0)
    dry = way * c.coulomb_n * (1.0 + c.static * np.exp(-((v / c.stribeck_m_s) ** 2)))
    viscous_n = way * c.viscous_n_s_m * v
    first = Slide._make(part[:, :, 0] for part in c)
    held = w.start_n - first.mass_kg * w.start_a_m_s2 - first.load_n - viscous_n[:, :, 0]
    held = np.clip(held, -dry[:, :, 0], dry[:, :, 0])
    force = (_elements if slips else _bristles)(v, dry, held, c, w.h) + viscous_n
    found: Floats = smoothed(force, w.more)[:, :, w.margin : force.shape[2] - w.margin]
    return found


def _bristles(v: Floats, dry: Floats, held: Floats, c: Slide, h: float) -> Floats:
    """Dry friction of LuGre's model; `held` is what it bears at first."""
    a = c.stiffness_n_m * np.abs(v) / dry
    ah = np.maximum(a * h, 1e-9)
    decay = -np.expm1(-ah) / ah
    kept, gained = np.exp(-ah), h * decay * v
    z = np.empty((v.shape[2] + 1, *dry.shape[:2]))
    z[0] = held / c.stiffness_n_m[:, :, 0]
    for k in range(v.shape[2]):
        z[k + 1] = kept[:, :, k] * z[k] + gained[:, :, k]
    begin = np.moveaxis(z[:-1], 0, 2)
    mean = decay * begin + (1.0 - decay) / np.maximum(a, 1e-9 / h) * v
    force: Floats = c.stiffness_n_m * mean + c.damping_n_s_m * decay * (v - a * begin)
    return force


def _elements(v: Floats, dry: Floats, held: Floats, c: Slide, h: float) -> Floats:
    """Dry friction of the elements of `pneud.physics.slip`; `held` is what they bear at first."""
    most = np.moveaxis(0.25 * dry, 2, 0)[:, None]
    moved = np.moveaxis(h * c.stiffness_n_m * v, 2, 0)[:, None] * np.array(SHARES)[:, None, None]
    bears = np.empty((v.shape[2] + 1, len(SHARES), *dry.shape[:2]))
    bears[0] = 0.25 * held
    for k in range(v.shape[2]):
        np.clip(bears[k] + moved[k], -most[k], most[k], out=bears[k + 1])
    sticks = np.moveaxis((np.abs(bears[:-1] + 0.5 * moved) < most).mean(axis=1), 0, 2)
    mean = np.moveaxis(0.5 * (bears[:-1] + bears[1:]).sum(axis=1), 0, 2)
    force: Floats = mean + c.damping_n_s_m * sticks * v
    return force


def predicted(w: Forces, g: Slide, slips: bool) -> Floats:
    """The force on the piston: (guess, window, tick) [N]."""
    mass, load = (np.asarray(value, dtype=float)[:, None, None] for value in (g.mass_kg, g.load_n))
    found: Floats = mass * w.a_m_s2 + load + friction(w, g, slips)
    return found


def breakaways(p: Piece, rig: Balance, h: float) -> Floats:
    """The greatest friction each time before a load that stood begins to slide [N]; needs no model of it."""
    light = max(0.5, LIGHT_S / h)
    v, a, force = _quantities(p, light, max(0.5, PEAK_S / h), h, rig)
    friction_n = force - rig.mass_kg * a - rig.load_n
    calm = smoothed(v, max(0.5, PEAK_S / h))
    still, fast = np.abs(calm) < STANDS_M_S, np.abs(calm) > LEAVES_M_S
    before, stood, leaves = (max(1, round(s / h)) for s in (BEFORE_S, STOOD_S, LEAVES_S))
    found = []
    for begin in (np.flatnonzero(fast[1:] & ~fast[:-1]) + 1).tolist():
        rest = np.flatnonzero(still[max(0, begin - before) : begin])
        if len(rest) >= stood and fast[begin : begin + leaves].all():
            last = max(0, begin - before) + int(rest[-1])
            found.append(float((friction_n[max(0, last - leaves) : begin + 1] * np.sign(v[begin])).max()))
    return np.array(found)


def at_once(w: Forces, fast_m_s: float) -> tuple[float, float, float, float] | None:
    """Mass, load, Coulomb and viscous friction by least squares where the load slides; None without any."""
    v = w.sliding_m_s
    slides = np.abs(v) > fast_m_s
    if slides.sum() < 200:
        return None
    v, a = v[slides], w.a_m_s2[slides]
    columns = np.stack([a, np.ones_like(a), np.sign(v), v], axis=1)
    mass, load, coulomb, viscous = np.linalg.lstsq(columns, w.force_n[slides], rcond=None)[0].tolist()
    return mass, load, coulomb, viscous
