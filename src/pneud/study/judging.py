"""What people do with an axis, on rigs unlike its model, and what it may come to: sine, rest, steps, a push.

A session is one run without a break, as on a machine: what is learnt along the sine is there in the steps.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from pneud.axis.state import AxisParameters
from pneud.config.conversions import axis_of, plant_of
from pneud.config.models import Config
from pneud.control.reference import Sine, move, rest, sine, still, transfer, unhurried
from pneud.physics.plant import PlantParameters
from pneud.study import trial
from pneud.study.gains import LARGE_ERROR
from pneud.study.going import Going
from pneud.study.push import service
from pneud.study.trial import Verdict

NOMINAL = "as configured"
WITHIN_M = 5e-5  # RMS error along the sine
STEPS_M = (1e-3, 1e-3, -1e-3, 1e-2, -1e-2, -1e-2, 1e-3, -1e-3)
LONG_M = 5e-3  # a longer step is a long one
ROOM_M = 0.025  # travel to each side that the long ones need
AFTER_S, SETTLING_S = 1.5, 3.0  # after a step; at rest, before it is judged
PUSH_SHARE = 0.08  # of the greatest force of the supply
SLACK = 2.0  # of all limits but those of the sine, where the model errs
WORST_RATIO = 10.0  # what never comes to an end, among others
# limits: of the largest error along the sine and under a push, by the RMS allowed; of mean |Δu|; of times
PEAK, PUSHED = 5.0, 12.0
MOVING_V, RESTING_V = 0.15, 0.02
ARRIVED_S, BACK_S = 0.4, 1.0
BRISTLES_N_M = (0.5e5, 1e5, 5e5, 20e5)
SHORT = (NOMINAL, "dead zone x0", "dead zone x2")  # where nothing is compiled


class Lengths(NamedTuple):
    """How long a session is [s]."""

    learn_s: float  # along the sine, before it is judged
    sine_s: float  # judged
    rest_s: float


WHOLE = Lengths(20.0, 4.0, 60.0)
BRIEF = Lengths(10.0, 2.0, 12.0)  # for a first look, and where nothing is compiled


class Tolerances(NamedTuple):
    """What an encoder's step allows for [m]."""

    still_m: float  # at rest
    position_m: float  # what counts as in position
    over_m: float  # overshoot


def tolerances(step_m: float) -> Tolerances:
    """Those of an encoder with this step [m]."""
    return Tolerances(max(15e-6, 2.0 * step_m), max(20e-6, 2.0 * step_m), max(50e-6, 3.0 * step_m))


class Course(NamedTuple):
    """What a session does, and what it may come to on the plant as configured."""

    lengths: Lengths
    steps_m: tuple[float, ...]
    force_n: float  # of the push
    far_m: float  # a large error
    within_m: float  # RMS along the sine
    still_m: float  # at rest
    position_m: float  # what counts as in position
    over_m: float  # overshoot


class Figure(NamedTuple):
    """What came out of a part of a session."""

    part: str  # sine, rest, 1 mm, 10 mm, push, return
    what: str  # with its unit at the end
    value: float
    limit: float

    @property
    def ratio(self) -> float:
        """How much of the limit is taken; more than 1 does not hold."""
        return min(self.value / self.limit, WORST_RATIO)


class Judged(NamedTuple):
    """A session on one plant."""

    case: str
    figures: tuple[Figure, ...]

    @property
    def worst(self) -> Figure:
        """The figure that takes most of its limit."""
        return max(self.figures, key=lambda f: f.ratio)

    @property
    def excess(self) -> float:
        """How far all that does not hold is beyond its limits, the logarithms of the ratios together."""
        return sum(math.log(f.ratio) for f in self.missed)

    @property
    def missed(self) -> tuple[Figure, ...]:
        """What does not hold."""
        return tuple(f for f in self.figures if f.ratio > 1.0)


class Task(NamedTuple):
    """A session to be run."""

    case: str
    axis: AxisParameters
    plant: PlantParameters
    course: Course


def plants(plant: PlantParameters) -> dict[str, PlantParameters]:
    """The plant as it is configured, and as it might be instead: one thing wrong at a time."""
    found = {NOMINAL: plant}
    for by in (0.0, 2.0):
        zone = by * plant.valve.dead_zone_v
        found[f"dead zone x{by:g}"] = plant._replace(valve=plant.valve._replace(dead_zone_v=zone))
    for by in (0.5, 2.0):
        f = plant.friction
        found[f"friction x{by:g}"] = plant._replace(
            friction=f._replace(
                coulomb_n=by * f.coulomb_n, static_n=by * f.static_n, viscous_n_s_m=by * f.viscous_n_s_m
            )
        )
    for by in (0.7, 1.3):
        found[f"flow x{by:g}"] = plant._replace(cylinder=plant.cylinder._replace(c1=by * plant.cylinder.c1))
    for by in (0.5, 2.0):
        found[f"mass x{by:g}"] = plant._replace(cylinder=plant.cylinder._replace(M=by * plant.cylinder.M))
    slow = plant.valve._replace(omega_rad_s=0.5 * plant.valve.omega_rad_s)
    found["valve x0.5"] = plant._replace(valve=slow)
    for stiffness in BRISTLES_N_M if plant.friction.coulomb_n > 0.0 else ():
        bristles = plant.friction._replace(sigma0_n_m=stiffness)
        found[f"bristles {1e-5 * stiffness:g}e5 N/m"] = plant._replace(friction=bristles)
    return {name: p for name, p in found.items() if name == NOMINAL or p != plant}


def course_of(c: Config, lengths: Lengths, within_m: float = WITHIN_M) -> Course:
    """What the axis of a configuration is put through."""
    limits, step_m = c.limits, c.plant.sensors.encoder_resolution_m
    centre_m = c.reference.effective_centre_m - c.cylinder.dead_length_1_m
    room_m = min(centre_m - limits.travel_min_m, limits.travel_max_m - centre_m)
    return Course(
        lengths,
        tuple(d for d in STEPS_M if abs(d) < LONG_M or room_m > ROOM_M),
        PUSH_SHARE * (c.gas.supply_pa - c.gas.atmosphere_pa) * c.cylinder.piston_area_1_m2,
        LARGE_ERROR * c.cylinder.stroke_m,
        within_m,
        *tolerances(step_m),
    )


def tasks(
    c: Config,
    command_lsb_v: float,
    course: Course,
    cases: Iterable[str] = (),
    among: Mapping[str, PlantParameters] | None = None,
) -> list[Task]:
    """The sessions of a configuration, on all plants or on those named.

    Where the configured reference stands still, the sine is one of 5 % of the stroke.

    Args:
        c: the configuration.
        command_lsb_v: of the bus.
        course: from `course_of`.
        cases: names of plants.
        among: the plants; else those of `plants`.
    """
    axis, found = axis_of(c, command_lsb_v), among or plants(plant_of(c))
    s = axis.reference
    if s.amplitude_m == 0.0 or s.omega_rad_s == 0.0:
        axis = axis._replace(reference=Sine(s.centre_m, 0.05 * c.cylinder.stroke_m, math.pi))
    return [Task(name, axis, found[name], course) for name in (cases or found) if name in found]


class _Session:
    """A run that goes on from part to part."""

    def __init__(self, task: Task) -> None:
        self.task, self.at_m = task, task.axis.reference.centre_m
        self.slack = 1.0 if task.case == NOMINAL else SLACK
        tolerance_m = self.slack * task.course.position_m
        self.go = Going(self.at_m, task.axis.controller, task.plant, tolerance_m).go
        self.figures: list[Figure] = []

    def seconds(self, *runs: Verdict) -> float:
        """The longest time until the load is in position for good."""
        h = self.task.axis.controller.h
        return max(v.outside * h if v.outside >= 0 else math.inf for v in runs)

    def note(self, part: str, what: str, value: float, limit: float) -> None:
        self.figures.append(Figure(part, what, value, limit if part == "sine" else self.slack * limit))

    def follow(self) -> None:
        """The sine is joined, followed, and left for its centre, where the load stands for long."""
        axis, c, n = self.task.axis, self.task.course, self.task.course.lengths
        s, whole_s = axis.reference, n.learn_s + n.sine_s
        v = self.go(transfer(rest(self.at_m), sine(0.0, s), axis.transfer), whole_s, n.learn_s, s)
        self.note("sine", "rms_m", v.rms_m, c.within_m)
        self.note("sine", "max_m", v.max_m, PEAK * c.within_m)
        self.note("sine", "mean_step_v", v.step_v, MOVING_V)
        v = self.go(move(sine(whole_s, s), self.at_m, axis.motion), n.rest_s, SETTLING_S)
        self.note("rest", "max_m", v.max_m, c.still_m)
        self.note("rest", "mean_step_v", v.step_v, RESTING_V)

    def step(self) -> None:
        """Short ways, one after the other."""
        c = self.task.course
        over: dict[str, float] = {}
        runs: dict[str, list[Verdict]] = {}
        for by_m in c.steps_m:
            bounds = unhurried(self.task.axis.motion, abs(by_m), self.task.axis.shunned)
            way = move(rest(self.at_m), self.at_m + by_m, bounds)
            self.at_m += by_m
            v = self.go(way, AFTER_S)
            part = f"{1e3 * abs(by_m):g} mm"
            beyond_m = v.high_m - self.at_m if by_m > 0.0 else self.at_m - v.low_m
            over[part] = max(over.get(part, 0.0), beyond_m)
            runs.setdefault(part, []).append(v)
        for part, beyond_m in over.items():
            self.note(part, "overshoot_m", beyond_m, c.over_m)
            self.note(part, "in_position_s", self.seconds(*runs[part]), ARRIVED_S)

    def push(self) -> None:
        """A force that comes and goes while the load stands."""
        c = self.task.course
        on = self.go(still(self.at_m), AFTER_S, force_n=c.force_n)
        off = self.go(still(self.at_m), AFTER_S)
        self.note("push", "max_m", max(on.max_m, off.max_m), PUSHED * c.within_m)
        self.note("push", "in_position_s", self.seconds(on, off), BACK_S)


def session(task: Task) -> Judged:
    """What people do, on one plant; on the one as configured also from a large error."""
    s = _Session(task)
    s.follow()
    s.step()
    s.push()
    if task.case == NOMINAL:
        near, far = (service(task.axis, task.plant, error_m) for error_m in (0.0, task.course.far_m))
        back_m = max(near.rms_m, far.rms_m) if far.recovered(near) else math.inf
        s.note("return", "rms_m", back_m, 2.0 * s.figures[0].value + 2e-5)
    return Judged(task.case, tuple(s.figures))


def ordered(judged: Sequence[Judged]) -> list[Judged]:
    """Worst first."""
    return sorted(judged, key=lambda j: (-j.excess, -j.worst.ratio, j.case))


def as_json(judged: Sequence[Judged]) -> list[dict[str, Any]]:
    """All figures, worst rig first."""
    return [
        {"case": j.case, "figures": [{**f._asdict(), "holds": f.ratio <= 1.0} for f in j.figures]}
        for j in ordered(judged)
    ]


Judge = Callable[[list[Task]], Iterator[Judged]]


@contextmanager
def judges(processes: int | None = None) -> Iterator[Judge]:
    """Sessions on all cores, in whatever order they end.

    Args:
        processes: how many at once; by default as many as there are cores for this process.
    """
    trial.compiled()  # before there are processes, so that each has it
    count = processes or len(os.sched_getaffinity(0))
    if count == 1:
        yield lambda many: map(session, many)
        return
    forked = multiprocessing.get_context("fork")
    with forked.Pool(count, _led) as pool:
        yield lambda many: pool.imap_unordered(session, many)


def _led() -> None:
    """Leave it to whoever has forked this process to end it, whatever he does on a signal himself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
