"""What an axis has done so far, counted from what is believed of its load: strokes, metres, air, hours.

It is looked at every few milliseconds, not in every tick: a load does not turn, and a chamber does not fill,
any faster. What stands between two looks is the time over which a deceleration counts.
"""

from typing import NamedTuple

from pneud.control.step import Controller
from pneud.physics.gas import signed_flow
from pneud.physics.ratings import DENSITY_ANR_KG_M3
from pneud.signals import Estimate, Measurement, Mileage

LOOK_NS = 8_000_000
LONGEST_NS = 100_000_000  # of what lies between two looks nothing beyond that counts
SETTLED_NS = 200_000_000  # speeds are not believed sooner after the estimates have begun
TURN_M = 1e-3  # a load that goes back by less has not turned: noise makes no metres


class Odometer(NamedTuple):
    """The counters of a run, and what the next look compares with."""

    done: Mileage = Mileage()
    looked_ns: int = 0
    known: int = 0  # 1 where the last look knew where the load was
    farthest_m: float = 0.0  # since the load has turned
    heading: int = 0  # the way that it goes, 1 or −1; 0 as long as it has not gone any
    speed_m_s: float = 0.0


def count(
    o: Odometer,
    t_ns: int,
    e: Estimate,
    m: Measurement,
    known: bool,
    settled: bool,
    engaged: bool,
    law: Controller,
) -> Odometer:
    """The counters after one more look.

    Args:
        o: at the last look.
        t_ns: of this one.
        e: the estimate.
        m: the measurement.
        known: the estimate is one, and positions count from where they did.
        settled: its speed can be believed.
        engaged: the axis is.
        law: with its valve and gas.
    """
    done, c, g = o.done, law.cylinder, law.gas
    passed_s = min(t_ns - o.looked_ns, LONGEST_NS) * 1e-9
    engaged_s = done.engaged_s + passed_s if engaged else done.engaged_s
    x, speed = e.position_m, abs(e.velocity_m_s)
    strokes, travel_m, hardest, air_m3 = done.strokes, done.travel_m, done.hardest_stop_m_s2, done.air_m3
    farthest_m, heading = o.farthest_m, o.heading
    if not known or o.known == 0:
        farthest_m, heading = x, 0
    else:
        way_m = x - farthest_m
        if heading == 0:
            if abs(way_m) > TURN_M:
                travel_m, farthest_m, heading = travel_m + abs(way_m), x, 1 if way_m > 0.0 else -1
        elif way_m * heading >= 0.0:
            travel_m, farthest_m = travel_m + abs(way_m), x
        elif abs(way_m) > TURN_M:
            strokes, travel_m, farthest_m, heading = strokes + 1, travel_m + abs(way_m), x, -heading
        if settled and t_ns - o.looked_ns <= LONGEST_NS:
            hardest = max(hardest, (o.speed_m_s - speed) / passed_s)
        flow_pa = signed_flow(m.supply_pa, m.p1_pa if e.opening_v > 0.0 else m.p2_pa, g)
        if flow_pa > 0.0:
            kg_s = abs(e.opening_v) * c.c1 * flow_pa / (g.k * g.R * g.temperature_k)
            air_m3 += kg_s * passed_s / DENSITY_ANR_KG_M3
    counted = Mileage(strokes, travel_m, air_m3, engaged_s, hardest)
    return Odometer(counted, t_ns, 1 if known else 0, farthest_m, heading, speed)
