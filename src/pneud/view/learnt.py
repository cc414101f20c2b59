"""What has been learnt, in a few words: as an operator wants to see it at a glance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

_ZONE = ("dead_zone_positive_v", "dead_zone_negative_v")
_PARTS = {
    "orifice_area_m2": "flow",
    "bandwidth_hz": "valve",
    "coulomb_n": "dry",
    "bristle_stiffness_n_m": "bristles",
    "moving_mass_kg": "mass",
}


class Word(NamedTuple):
    """One thing that has been learnt."""

    label: str
    text: str
    at_bound: bool


def in_brief(learnt: Mapping[str, Mapping[str, Any]]) -> Iterator[Word]:
    """The values of a status: both edges of the dead zone, the load, and by how much others differ."""
    if edges := [learnt[name] for name in _ZONE if name in learnt]:
        text = "/".join(f"{1e3 * v['value']:.0f}" for v in edges)
        yield Word("zone", f"{text} mV", any(v["check"] for v in edges))
    for name, label in _PARTS.items():
        if (v := learnt.get(name)) is not None:
            yield Word(label, f"{round(100.0 * (v['value'] / v['configured'] - 1.0)):+d}%", bool(v["check"]))
    if (v := learnt.get("load_n")) is not None:
        yield Word("load", f"{round(v['value']):+d} N", bool(v["check"]))
