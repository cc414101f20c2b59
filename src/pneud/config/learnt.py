"""What is learnt, in the terms of a configuration: each value beside the key that it stands for.

The law knows differences and factors. People, files and logs know the values themselves, which mean the same
whatever becomes of the key beside them.
"""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from pneud.config.flow import area_of
from pneud.control.adaptation import Adaptation, Learnt, Rate, within
from pneud.control.model import most_edge_v, stiffest

if TYPE_CHECKING:
    from pneud.config.models import Config

SLACK = 1e-5  # of a bound, which a rounded value may be beyond

Values: TypeAlias = dict[str, dict[str, Any]]
"""By name: `value`, `configured`, `least`, `most`; `check`: what to look at where it stands at its bound."""


class Quantity(NamedTuple):
    """Something that is learnt."""

    name: str  # in `[control.adaptation.start]`
    of: str  # field of `Learnt`
    rate: str  # field of `Adaptation`
    key: str  # of the configuration
    check: str  # what may be wrong where it stands at its bound


QUANTITIES = (
    Quantity("dead_zone_positive_v", "edge_plus_v", "edges", "valve.dead_zone_v", "the valve's centre"),
    Quantity("dead_zone_negative_v", "edge_minus_v", "edges", "valve.dead_zone_v", "the valve's centre"),
    Quantity("orifice_area_m2", "flow", "flow", "valve.orifice_area_m2", "gas.supply_pa, throttles"),
    Quantity("bandwidth_hz", "lag", "lag", "valve.bandwidth_hz", "hoses"),
    Quantity("coulomb_n", "friction", "friction", "control.friction.coulomb_n", "the guide"),
    Quantity(
        "bristle_stiffness_n_m",
        "stiffness",
        "stiffness",
        "control.friction.bristle_stiffness_n_m",
        "control.adaptation.stiffness",
    ),
    Quantity("load_n", "load_n", "load", "cylinder.load_n", "what pushes the load"),
    Quantity("moving_mass_kg", "mass", "mass", "cylinder.moving_mass_kg", "the load"),
)
ADDED = ("edge_plus_v", "edge_minus_v", "load_n")  # all others are factors


def adaptation_of(c: Config) -> Adaptation:
    """What is learnt, how fast, and within which bounds."""
    a, u_max_v, dead_zone_v = c.control.adaptation, c.valve.u_max_v, c.valve.dead_zone_v
    force, f, step_m = c.control.estimate_force, c.control.friction, c.control.motion.encoder_resolution_m
    most_stiff = stiffest(f.coulomb_n, f.bristle_stiffness_n_m, step_m)
    load_n = (c.gas.supply_pa - c.gas.atmosphere_pa) * c.cylinder.piston_area_1_m2
    return Adaptation(
        enabled=a.enabled,
        edges=Rate(1.0 * a.dead_zone, 0.0, most_edge_v(dead_zone_v, u_max_v)),
        flow=Rate(1.0 * a.flow, 0.5, 2.0),
        lag=Rate(20.0 * a.lag, 1.0, 4.0),
        friction=Rate(3.0 * (a.friction and force), 0.3, 3.0),
        stiffness=Rate(150.0 * (a.stiffness and force), 1.0, most_stiff),
        load=Rate(1.0 * (a.load and force), -load_n, load_n),
        mass=Rate(3.0 * a.mass, 0.4, 2.5),
    )


def start_of(c: Config) -> Learnt:
    """Where adaptation starts: at what `[control.adaptation.start]` says, else at what is configured.

    Raises:
        ValueError: it is of another axis, or a value lies beyond what may be learnt on this one.
    """
    start, p = c.control.adaptation.start, adaptation_of(c)
    given = {q: value for q in QUANTITIES if (value := getattr(start, q.name)) is not None}
    if given and start.axis != c.name:
        raise ValueError(
            f"control.adaptation.start.axis = {start.axis!r}: learnt on another axis than {c.name!r}"
        )
    found: dict[str, Any] = {"load_n": within(c.cylinder.resistance_n, p.load)}
    for q, value in given.items():
        configured, r = _configured(q, c), getattr(p, q.rate)
        if not configured and q.of not in ADDED:
            raise ValueError(f"control.adaptation.start.{q.name} = {value:g}: {q.key} is 0")
        least, most = _bounds(q, configured, r)
        if not least - SLACK * abs(least) <= value <= most + SLACK * abs(most):
            raise ValueError(
                f"control.adaptation.start.{q.name} = {value:g}: beyond what is learnt, {least:g} … {most:g}"
            )
        found[q.of] = _relative(q, configured, max(least, min(most, value)))
    return Learnt(**found)


def values_learnt(learnt: Learnt, c: Config) -> Values:
    """What has been learnt with a configuration; nothing where adaptation is off.

    Args:
        learnt: on an axis with this configuration.
        c: the configuration.
    """
    p, found = adaptation_of(c), Values()
    for q in QUANTITIES if p.enabled else ():
        configured, relative, r = _configured(q, c), getattr(learnt, q.of), getattr(p, q.rate)
        if not configured and q.of not in ADDED:
            continue
        value = _value(q, configured, relative)
        least, most = _bounds(q, configured, r)
        differs = abs(value - configured) > SLACK * max(abs(configured), abs(most))
        if not r.per_s and not differs:
            continue
        room = SLACK * (most - least)
        at_bound = differs and not least + room < value < most - room
        numbers = {"value": value, "configured": configured, "least": least, "most": most}
        check = f"{q.key}, {q.check}" if at_bound else None
        found[q.name] = {name: float(f"{x:.6g}") for name, x in numbers.items()} | {"check": check}
    return found


def _configured(q: Quantity, c: Config) -> float:
    if q.of == "flow":
        return area_of(c)
    return c.cylinder.resistance_n if q.of == "load_n" else float(attrgetter(q.key)(c))


def _value(q: Quantity, configured: float, relative: float) -> float:
    """What a difference or a factor stands for; the lag's is that of a time, the load itself."""
    if q.of == "load_n":
        return relative
    if q.of in ADDED:
        return configured + relative
    return configured / relative if q.of == "lag" else configured * relative


def _relative(q: Quantity, configured: float, value: float) -> float:
    """The difference or factor, as the law knows it."""
    if q.of == "load_n":
        return value
    if q.of in ADDED:
        return value - configured
    return configured / value if q.of == "lag" else value / configured


def _bounds(q: Quantity, configured: float, r: Rate) -> tuple[float, float]:
    """Of the value."""
    if q.of in ADDED:
        return r.least, r.most
    if q.of == "lag":
        return configured / r.most, configured / r.least
    return configured * r.least, configured * r.most
