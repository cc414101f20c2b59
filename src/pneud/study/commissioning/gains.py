"""Gains for a rig as it has been found: the fastest that hold over the spread of what is known of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from pneud.config.conversions import plant_of
from pneud.config.models import Config
from pneud.config.toml import flat
from pneud.control.tunables import in_slot
from pneud.physics.plant import PlantParameters
from pneud.study import fastest, judging, linear, trial
from pneud.study import gains as rules
from pneud.study.commissioning.estimated import Values
from pneud.study.commissioning.verification import AMPLITUDE, FREQUENCY_HZ, PEAK_M
from pneud.study.identification import parameters as key
from pneud.study.identification.estimating import Moved
from pneud.study.identification.parameters import Estimate
from pneud.study.judging import NOMINAL, WHOLE, Judged, Lengths
from pneud.study.proposing import Proposal, propose

WITHIN_M = PEAK_M / judging.PEAK  # so that the largest error, too, has the limit of the verification
MOST = 4.0  # times a value, up or down, that is tried where next to nothing is known of it
ALL_LOW, ALL_HIGH, OTHERWISE = "all low", "all high", "other friction"
FIRST = (NOMINAL, ALL_LOW, ALL_HIGH, OTHERWISE)  # plants of the brief sessions, among which the search goes

Scaled = Callable[[PlantParameters, float], PlantParameters]


class Spread(NamedTuple):
    """A parameter, and the plant with so many times of it."""

    name: str
    keys: tuple[str, ...]  # the first one that there is an estimate of counts
    scaled: Scaled


def _dead_zone(p: PlantParameters, by: float) -> PlantParameters:
    return p._replace(valve=p.valve._replace(dead_zone_v=by * p.valve.dead_zone_v))


def _bandwidth(p: PlantParameters, by: float) -> PlantParameters:
    return p._replace(valve=p.valve._replace(omega_rad_s=by * p.valve.omega_rad_s))


def _flow(p: PlantParameters, by: float) -> PlantParameters:
    return p._replace(cylinder=p.cylinder._replace(c1=by * p.cylinder.c1))


def _mass(p: PlantParameters, by: float) -> PlantParameters:
    return p._replace(cylinder=p.cylinder._replace(M=by * p.cylinder.M))


def _friction(p: PlantParameters, by: float) -> PlantParameters:
    f = p.friction
    return p._replace(friction=f._replace(coulomb_n=by * f.coulomb_n, static_n=by * f.static_n))


def _bristles(p: PlantParameters, by: float) -> PlantParameters:
    return p._replace(friction=p.friction._replace(sigma0_n_m=by * p.friction.sigma0_n_m))


def _damping(p: PlantParameters, by: float) -> PlantParameters:
    return p._replace(friction=p.friction._replace(sigma1_n_s_m=by * p.friction.sigma1_n_s_m))


SPREADS = (
    Spread("dead zone", (key.HALF,), _dead_zone),
    Spread("valve", (key.BANDWIDTH,), _bandwidth),
    Spread("flow", (key.CONDUCTANCE, key.AREA), _flow),
    Spread("mass", (key.MASS,), _mass),
    Spread("friction", (key.COULOMB,), _friction),
    Spread("bristles", (key.STIFFNESS,), _bristles),
    Spread("bristles' damping", (key.DAMPING,), _damping),
)


class Chosen(NamedTuple):
    """Gains, and what they were judged by."""

    config: Config
    bandwidth_rad_s: float | None  # None: those that were there
    judged: tuple[Judged, ...]
    doubts: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """They were tried, and all that was judged is within its limits."""
        return bool(self.judged) and not any(j.missed for j in self.judged)

    @property
    def toml(self) -> str:
        """The [control] tables, as `pneud design` prints them."""
        return rules.toml(self.config)

    def values(self, before: Config) -> Values:
        """What has to be written into a configuration, by dotted key; None takes a key out."""
        was, now = (flat(c.control.model_dump(), "control") for c in (before, self.config))
        return {name: value for name, value in now.items() if value != was.get(name)}

    def as_json(self) -> dict[str, Any]:
        """For scripts."""
        return {
            "bandwidth_rad_s": self.bandwidth_rad_s,
            "holds": self.holds if self.judged else None,
            "doubts": list(self.doubts),
            "missed": sorted({f"{j.case}: {f.part} {f.what}" for j in self.judged for f in j.missed}),
        }


def spread(
    plant: PlantParameters, found: Mapping[str, Estimate], otherwise: PlantParameters | None = None
) -> dict[str, PlantParameters]:
    """The plant as estimated, and at both ends of each interval; at all of them together, and `otherwise`."""
    plants = {NOMINAL: plant}
    all_low = all_high = plant
    for s in SPREADS:
        e = next((found[name] for name in s.keys if name in found), None)
        if e is None or e.value <= 0.0:
            continue
        low, high = max(e.low / e.value, 1.0 / MOST), min(e.high / e.value, MOST)
        plants |= {f"{s.name} x{by:.3g}": s.scaled(plant, by) for by in (low, high)}
        all_low, all_high = s.scaled(all_low, low), s.scaled(all_high, high)
    plants |= {ALL_LOW: all_low, ALL_HIGH: all_high}
    return plants if otherwise is None else plants | {OTHERWISE: otherwise}


def otherwise(plant: PlantParameters, moved: Moved | None) -> PlantParameters | None:
    """The plant with the other kind of friction, where that explains about as much; None where not."""
    if moved is None or moved.other is None:
        return None
    x = moved.other.by_key
    friction = plant.friction._replace(
        static_n=x["coulomb"] * (1.0 + x["static"]),
        coulomb_n=x["coulomb"],
        stribeck_m_s=x["stribeck"],
        sigma0_n_m=x["stiffness"],
        sigma1_n_s_m=x["damping"],
    )
    return plant._replace(friction=friction, detail=plant.detail._replace(slips=not moved.slips))


def choose(
    c: Config,
    found: Mapping[str, Estimate],
    command_lsb_v: float,
    processes: int | None = None,
    moved: Moved | None = None,
) -> Chosen:
    """The fastest gains that hold over the spread; those that are there where they miss less.

    Where nothing can be compiled those that are there stay, and nothing is tried.

    Args:
        c: with what the controller believes, and the rig as it has been found as its plant.
        found: estimates, whose intervals are the spread.
        command_lsb_v: of the bus.
        processes: at once; by default as many as there are cores.
        moved: how friction was found.
    """
    if why := trial.compiled()[1]:
        return Chosen(c, None, (), (f"nothing can be tried in a reasonable time: {why}",))
    plant = plant_of(c)
    c, plants, before = with_sine(c), spread(plant, found, otherwise(plant, moved)), c
    error_m, law, alpha = rules.error_scale_m(c), c.control.law, c.control.alpha
    with judging.judges(processes) as judge:

        def judged(p: Proposal, lengths: Lengths) -> tuple[Judged, ...]:
            course = judging.course_of(c, lengths, WITHIN_M)
            cases = () if lengths == WHOLE else FIRST
            return tuple(judge(judging.tasks(p.config, command_lsb_v, course, cases, plants)))

        def proposed(omega_rad_s: float) -> Proposal:
            return propose(c, law, omega_rad_s, error_m, alpha)

        best, _ = fastest.fastest(proposed, judged, 1.0 / c.loop.rate_hz)
        if best.missed:
            prediction, doubts = best.proposal.prediction, best.proposal.doubts
            there = Proposal(c, prediction, doubts, True)
            kept = fastest.Tried(best.bandwidth_rad_s, there, judged(there, WHOLE))
            if kept.rank < best.rank:
                return Chosen(before, None, kept.judged, ())
    control = best.proposal.config.control
    config = before.model_copy(update={"control": control})
    return Chosen(config, best.bandwidth_rad_s, best.judged, tuple(best.proposal.doubts))


def slower(c: Config, chosen: Chosen) -> Chosen | None:
    """The next slower gains, by rule alone, for a rig that is not as it was found; None: there are none.

    Args:
        c: as for `choose`.
        chosen: what has turned out too fast.
    """
    law, error_m = c.control.law, rules.error_scale_m(c)
    entry = in_slot(law)
    omega_rad_s = chosen.bandwidth_rad_s
    if omega_rad_s is None:
        there = chosen.config
        p = rules.predict(there, error_m) if entry is None else linear.predict(there, entry)
        omega_rad_s = p.bandwidth_rad_s
    omega_rad_s = fastest.rounded(omega_rad_s / fastest.RATIO)
    if omega_rad_s < fastest.SLOWEST_RAD_S:
        return None
    found = propose(with_sine(c), law, omega_rad_s, error_m, c.control.alpha)
    if not found.sound:
        return None
    config = c.model_copy(update={"control": found.config.control})
    return Chosen(config, omega_rad_s, (), tuple(found.doubts))


def with_sine(c: Config) -> Config:
    """The configuration with the sine of the verification as its reference, unless its own is quicker."""
    r, limits = c.reference, c.limits
    middle_m = 0.5 * (limits.travel_min_m + limits.travel_max_m)
    amplitude_m = min(AMPLITUDE * c.cylinder.stroke_m, 0.45 * (limits.travel_max_m - limits.travel_min_m))
    if r.amplitude_m * r.frequency_hz**3 >= amplitude_m * FREQUENCY_HZ**3:
        return c
    sine = {
        "effective_centre_m": middle_m + c.cylinder.dead_length_1_m,
        "amplitude_m": amplitude_m,
        "frequency_hz": FREQUENCY_HZ,
    }
    return c.model_copy(update={"reference": r.model_copy(update=sine)})
