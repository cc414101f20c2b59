"""A valve's opening as somebody has measured it: places of a map, its edges, and the bends between."""

from itertools import pairwise
from typing import NamedTuple

from pneud.physics.valve import Bend, Valve

Places = tuple[tuple[float, float], ...]
"""Command [V] and relative opening, −1 to 1."""

INNER = 4  # places on a side between edge and end


class Edges(NamedTuple):
    """Commands [V] between which nothing flows."""

    minus_v: float
    plus_v: float

    @property
    def centre_v(self) -> float:
        """Of both [V]."""
        return 0.5 * (self.plus_v + self.minus_v)

    @property
    def dead_zone_v(self) -> float:
        """Half of their distance [V]."""
        return 0.5 * (self.plus_v - self.minus_v)


def check_map(places: Places, u_max_v: float) -> None:
    """Whether a map can be followed and inverted.

    Raises:
        ValueError: it does not reach from end to end, falls, stands still while open, or has too many places.
    """
    if places[0] != (-u_max_v, -1.0) or places[-1] != (u_max_v, 1.0):
        raise ValueError(f"map must lead from [{-u_max_v:g}, -1] to [{u_max_v:g}, 1]")
    for (v1, y1), (v2, y2) in pairwise(places):
        if v2 <= v1 or y2 < y1 or (y1 == y2 and y1 != 0.0):
            raise ValueError(f"map must rise: not from [{v1:g}, {y1:g}] to [{v2:g}, {y2:g}]")
    for sign in (1.0, -1.0):
        if sum(0.0 < sign * y < 1.0 for _, y in places) > INNER:
            raise ValueError(f"map may have {INNER} places on a side between edge and end")


def edges_of(places: Places) -> Edges:
    """Where the opening begins; both are the same where it rises through 0."""
    shut = [v for v, y in places if y == 0.0]
    if not shut:
        (v1, y1), (v2, y2) = next((a, b) for a, b in pairwise(places) if a[1] < 0.0 < b[1])
        shut = [v1 - y1 * (v2 - v1) / (y2 - y1)]
    return Edges(shut[0], shut[-1])


def with_map(valve: Valve, places: Places) -> Valve:
    """The valve with edges, centre and bends of a map, or as it is without one."""
    if not places:
        return valve
    edges = edges_of(places)
    reach_v = valve.u_max_v - edges.dead_zone_v
    plus = [((v - edges.plus_v) / reach_v, y) for v, y in places if y > 0.0]
    minus = [((edges.minus_v - v) / reach_v, -y) for v, y in reversed(places) if y < 0.0]
    return valve._replace(
        dead_zone_v=edges.dead_zone_v,
        centre_v=edges.centre_v,
        bent=True,
        plus=_bend(plus),
        minus=_bend(minus),
    )


def _bend(side: list[tuple[float, float]]) -> Bend:
    """The places of a side, the last stretch cut into as many as it takes."""
    *inner, (end, _) = side
    x, y = inner[-1] if inner else (0.0, 0.0)
    more = INNER - len(inner)
    cuts = [(i + 1) / (more + 1) for i in range(more)]
    inner += [(x + cut * (end - x), y + cut * (1.0 - y)) for cut in cuts]
    return Bend._make([*(number for place in inner for number in place), end])
