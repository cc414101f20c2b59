"""Moves of several axes that begin and end together."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.control.reference import Bounds
from pneud.control.together import alike

OWN = Bounds(0.5, 5.0, 100.0)


def test_who_has_no_way_keeps_its_bounds() -> None:
    assert alike([0.0, 0.0], [OWN, OWN]) == [OWN, OWN]
    assert alike([], []) == []


@given(st.lists(st.floats(1e-3, 1.0), min_size=1, max_size=4))
def test_bounds_are_as_the_ways_and_within_everybodys_own(ways_m: list[float]) -> None:
    found = alike(ways_m, [OWN] * len(ways_m))
    for way_m, kept in zip(ways_m, found, strict=True):
        for value, own, first in zip(kept, OWN, found[0], strict=True):
            assert value <= own
            assert value / way_m == pytest.approx(first / ways_m[0])
