"""A valve's opening as measured: its map, the edges in it, and its inverse in the law."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pneud.config.conversions import controller_of, plant_of, valve_of
from pneud.config.measured import Places, check_map, edges_of, with_map
from pneud.config.models import Config
from pneud.config.reading import load_config
from pneud.control.adaptation import Learnt, valve_learnt
from pneud.physics.valve import Valve, dead_zone_inverse, opening
from pneud.study.plausibility import findings

KNOWN = load_config("virtual.toml")
VALVE = Valve(5.0, 628.0, 0.7, 0.0)
MAP: Places = ((-5.0, -1.0), (-2.0, -0.3), (-0.15, 0.0), (0.05, 0.0), (1.0, 0.1), (3.0, 0.8), (5.0, 1.0))
sides = st.lists(
    st.tuples(st.floats(0.02, 0.98), st.floats(0.02, 0.98)), max_size=4, unique_by=(lambda p: p[0])
)


@st.composite
def maps(draw: Any) -> Places:
    """Rising from end to end, with edges about the centre."""
    minus_v, plus_v = draw(st.floats(-0.8, 0.0)), draw(st.floats(0.0, 0.8))
    found = [(minus_v, 0.0), (plus_v, 0.0)] if plus_v > minus_v else [(0.0, 0.0)]
    for edge_v, sign in ((plus_v, 1.0), (minus_v, -1.0)):
        places = draw(sides)
        xs, ys = sorted(x for x, _ in places), sorted(y for _, y in places)
        side = [*zip(xs, ys, strict=True), (1.0, 1.0)]
        assume(all(b[0] - a[0] > 0.01 and b[1] - a[1] > 0.01 for a, b in pairwise([(0.0, 0.0), *side])))
        found += [(edge_v + (5.0 * sign - edge_v) * x, sign * y) for x, y in side]
    return tuple(sorted(found))


@given(maps())
def test_the_opening_is_as_measured(places: Places) -> None:
    check_map(places, 5.0)
    v = with_map(VALVE, places)
    for at_v, relative in places:
        assert opening(at_v, v) == pytest.approx(5.0 * relative, abs=1e-9)
    for (v1, y1), (v2, y2) in pairwise(places):
        assert opening(0.5 * (v1 + v2), v) == pytest.approx(2.5 * (y1 + y2), abs=1e-9)
    assert (opening(-7.0, v), opening(7.0, v)) == (-5.0, 5.0)


@given(maps(), st.floats(-5.0, 5.0))
def test_the_law_inverts_it(places: Places, u: float) -> None:
    v = with_map(VALVE, places)
    assert opening(dead_zone_inverse(u, v, 0.0), v) == pytest.approx(u, abs=1e-9)
    assert dead_zone_inverse(u + 0.01, v, 0.0) > dead_zone_inverse(u, v, 0.0)


@given(maps(), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_it_never_falls(places: Places, one_v: float, other_v: float) -> None:
    v = with_map(VALVE, places)
    low, high = sorted((one_v, other_v))
    assert opening(low, v) <= opening(high, v)


@pytest.mark.parametrize(
    ("places", "says"),
    [
        (((-5.0, -1.0), (4.0, 1.0)), "must lead"),
        (((-5.0, -1.0), (1.0, 0.5), (1.0, 0.6), (5.0, 1.0)), "must rise"),
        (((-5.0, -1.0), (1.0, 0.5), (2.0, 0.4), (5.0, 1.0)), "must rise"),
        (((-5.0, -1.0), (1.0, 0.5), (2.0, 0.5), (5.0, 1.0)), "must rise"),
        (((-5.0, -1.0), *((0.5 * i, 0.1 * i) for i in range(1, 6)), (5.0, 1.0)), "4 places"),
    ],
)
def test_a_map_that_cannot_be_followed_is_refused(places: Places, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        check_map(places, 5.0)


def test_an_opening_without_a_dead_zone_begins_where_it_crosses_zero() -> None:
    assert edges_of(((-5.0, -1.0), (-0.1, -0.01), (0.3, 0.03), (5.0, 1.0))) == pytest.approx((0.0, 0.0))


def with_maps(believed: Places, true: Places, dead_zone_v: float) -> Config:
    data = KNOWN.model_dump(by_alias=True)
    data["valve"] |= {"map": believed, "dead_zone_v": dead_zone_v}
    data["plant"]["valve"] |= {"map": true, "dead_zone_v": 0.0}
    return Config.model_validate(data)


def test_law_and_plant_have_maps_of_their_own() -> None:
    c = with_maps(MAP, MAP, 0.1)
    assert valve_of(c)[3:] == plant_of(c).valve[3:] == with_map(VALVE, MAP)[3:]
    assert plant_of(c).valve.centre_v == pytest.approx(-0.05)
    assert not plant_of(with_maps(MAP, (), 0.1)).valve.bent
    assert controller_of(with_maps((), MAP, 0.1)).valve == controller_of(KNOWN).valve
    with pytest.raises(ValueError, match=r"dead_zone_v must be that of map, 0\.1"):
        with_maps(MAP, (), 0.2)


def test_a_map_that_the_law_does_not_invert_is_a_warning() -> None:
    data = with_maps(MAP, MAP, 0.1).model_dump(by_alias=True)
    data["control"]["compensate_dead_zone"] = False
    assert ("valve.map", False) in [
        (f.key, f.is_error) for f in findings(Config.model_validate(data), 0.001, 40.0)
    ]
    assert not [f for f in findings(with_maps(MAP, MAP, 0.1), 0.001, 40.0) if f.key == "valve.map"]


def test_edges_that_are_learnt_move_a_map() -> None:
    v = with_map(VALVE, MAP)
    assert valve_learnt(v, Learnt()) == v
    moved = valve_learnt(v, Learnt(edge_plus_v=0.05))
    assert opening(0.09, moved) == 0.0
    assert opening(0.11, moved) > 0.0
    assert opening(-0.16, moved) < 0.0 == opening(-0.14, moved)


def test_a_centre_without_a_map_is_the_laws_and_not_the_plants() -> None:
    text = KNOWN.model_dump(by_alias=True)
    text["valve"] |= {"dead_zone_v": 0.2, "centre_v": -0.05}
    c = Config.model_validate(text)
    v = valve_of(c)
    assert (v.centre_v, v.dead_zone_v, v.bent) == (-0.05, 0.2, False)
    assert plant_of(c).valve.centre_v == 0.0
    text["valve"] |= {"map": MAP, "dead_zone_v": 0.1}
    with pytest.raises(ValueError, match="leave out centre_v"):
        Config.model_validate(text)
