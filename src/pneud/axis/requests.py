"""What becomes of a request: the answer, and the way that the reference will go.

Pure: what the axis is and what is asked in, what is to change out. A request that is refused changes nothing.
"""

import math
from itertools import zip_longest
from operator import gt, lt
from typing import NamedTuple

from pneud.axis.state import AxisParameters
from pneud.axis.stops import soft_limits, way_inside
from pneud.control import force, model
from pneud.control.force import LEAST_RATE_N_S, Aim, Press
from pneud.control.leading import GANTRY, POSITION, REFERENCE
from pneud.control.model import Model
from pneud.control.plan import COMING_TO_REST, FOLLOWING, GOING, JOINING, LED, Plan, halting, resting
from pneud.control.probe import Probe, is_allowed
from pneud.control.profile import (
    LONGEST_S,
    MOST_PIECES,
    SHORTEST_S,
    Profile,
    ends_at_rest,
    extent,
    is_inside,
    is_within,
    meet,
)
from pneud.control.program import Program, Run
from pneud.control.reference import (
    MOST_OMEGA_RAD_S,
    Bounds,
    Septic,
    Sine,
    Way,
    at,
    move,
    rest,
    sine,
    stays,
    still,
    stop,
    transfer,
    unhurried,
    way,
)
from pneud.control.step import Controller
from pneud.control.tunables import LAWS, is_sound, is_stable, names_of, parted, tuned
from pneud.safety.faults import BLOCKS_ARM, CENTRES, STOPS, F
from pneud.safety.supervisor import BLOCKS, Supervisor, is_engaged
from pneud.signals import Answer, Estimate, Reference, Request, RequestKind, State

TAKEN, WRONG_STATE, BLOCKED = int(Answer.TAKEN), int(Answer.WRONG_STATE), int(Answer.BLOCKED)
OUT_OF_TRAVEL, BEYOND_LIMITS = int(Answer.OUT_OF_TRAVEL), int(Answer.BEYOND_LIMITS)
NOT_REFERENCED, NO_PROFILE = int(Answer.NOT_REFERENCED), int(Answer.NO_PROFILE)
MALFORMED, CLOSING, UNSTABLE = int(Answer.MALFORMED), int(Answer.CLOSING), int(Answer.UNSTABLE)
ARM, DISARM, CLEAR = int(RequestKind.ARM), int(RequestKind.DISARM), int(RequestKind.CLEAR)
SHUTDOWN, MARK, STOP = int(RequestKind.SHUTDOWN), int(RequestKind.MARK), int(RequestKind.STOP)
HOLD, GOTO, JOG = int(RequestKind.HOLD), int(RequestKind.GOTO), int(RequestKind.JOG)
HOME, PROBE, RESTART = int(RequestKind.HOME), int(RequestKind.PROBE), int(RequestKind.RESTART)
CENTRE, FORCE = int(RequestKind.CENTRE), int(RequestKind.FORCE)
TRACK, PIECE, GAINS = int(RequestKind.TRACK), int(RequestKind.PIECE), int(RequestKind.GAINS)
STEERING = (HOLD, GOTO, JOG, TRACK)
PRESSING = int(State.PRESSING)
# may be asked to go elsewhere
STEERED = (int(State.TRACKING), int(State.MOVING), int(State.HOLDING), PRESSING)

CONFIGURED, UPLOADED = 0.0, 1.0  # what TRACK asks for
ARRIVED_M = 1e-9  # no way is shorter
LONGEST_LEASE = 1e9  # ticks
HARDENINGS = 3
SLOWEST = Bounds(1e-6, 1e-6, 1e-6)  # m/s, m/s², m/s³: with less, a way would take hours, or overflow
UNREFERENCED = 1 << F.ENCODER_UNREFERENCED

MOTION, MODEL = len(Sine._fields), len(Model._fields)  # values behind gains

# how many values each request has
COUNTS = {
    ARM: (0, 1),
    DISARM: (0,),
    CLEAR: (0,),
    SHUTDOWN: (0,),
    STOP: (0,),
    HOLD: (0,),
    GOTO: (1, 2, 3, 4),
    JOG: (2,),
    TRACK: (1,),
    PIECE: (0, 9),
    GAINS: tuple({len(names_of(law)) + more for law in LAWS for more in (0, MOTION, MODEL, MOTION + MODEL)}),
    HOME: (0,),
    PROBE: (6,),
    RESTART: (0,),
    CENTRE: (0,),
    FORCE: (6,),
}


class Asked(NamedTuple):
    """What becomes of a request."""

    answer: int
    kind: int = 0  # what the supervisor is asked; 0 for nothing
    plan: Plan | None = None  # what the reference does from now on
    profile: Profile | None = None  # the uploaded one from now on
    law: Controller | None = None  # with its gains from now on
    reference: Sine | None = None  # the configured one from now on
    faults: int = 0  # that showed only now
    probe: Probe | None = None  # from now on
    program: Program | None = None  # from now on
    run: Run | None = None  # how far it is
    press: Press | None = None  # from now on


NOTHING = Asked(int(Answer.NONE))


def ask(
    request: Request,
    s: Supervisor,
    present: int,
    plan: Plan,
    profile: Profile,
    now: Reference,
    e: Estimate,
    now_ns: int,
    law: Controller,
    configured: Sine,
    probed: Probe,
    pressed: Press,
    p: AxisParameters,
) -> Asked:
    """What becomes of a request in this tick.

    Args:
        request: of the operator.
        s: the supervisor after the last tick.
        present: bits of the faults that hold now.
        plan: what the reference is doing.
        profile: the uploaded one.
        now: the reference; not looked at where the axis is not engaged.
        e: the estimate.
        now_ns: the instant that both belong to.
        law: with its present gains.
        configured: the present reference.
        probed: the last probe, perhaps under way.
        pressed: likewise the last pressing.
        p: parameters.
    """
    kind, values = request
    if kind == MARK:
        return Asked(TAKEN)
    if len(values) not in COUNTS.get(kind, ()) or not all(map(math.isfinite, values)):
        return Asked(MALFORMED)
    if kind == SHUTDOWN:
        return Asked(TAKEN, SHUTDOWN)
    if kind == RESTART:
        return Asked(WRONG_STATE) if is_engaged(s.state) else Asked(TAKEN, SHUTDOWN)
    if kind == ARM:
        return _arm(values == (1.0,), s, present, e, now_ns, configured, p)
    if kind == HOME:
        return _home(s, present, p)
    if kind == PROBE:
        return _probe(values, s, present, e, now_ns, probed, p)
    if kind == CLEAR:
        if s.state != State.FAULT:
            return Asked(WRONG_STATE)
        return Asked(BLOCKED) if present & (CENTRES | STOPS) else Asked(TAKEN, CLEAR)
    if kind in (DISARM, STOP, CENTRE):
        if not is_engaged(s.state):
            return Asked(WRONG_STATE)
        if p.leading.how == GANTRY and kind == STOP:
            return Asked(TAKEN)  # the other half stops, and carries it
        return Asked(TAKEN, DISARM if p.stop_centres and kind == STOP else kind)
    if p.leading.how == GANTRY and kind in STEERING:
        return Asked(WRONG_STATE if kind != HOLD else TAKEN)  # the other half is asked, and carries it
    if kind == GAINS:
        return _tune(values, plan, now, now_ns, law, p)
    if kind == PIECE:
        return _piece(values, plan, profile, p)
    if s.state not in STEERED:
        unknown = s.state == State.DISARMED and present & UNREFERENCED
        return Asked(NOT_REFERENCED if unknown else WRONG_STATE)
    if present & (CENTRES | STOPS):
        return Asked(BLOCKED)
    if kind == FORCE and p.leading.how >= GANTRY:
        return Asked(WRONG_STATE)  # one half of a gantry would press the other askew
    if kind == FORCE:
        return _press(values, s, e, now_ns, law, pressed, p)
    if kind == GOTO:
        return _goto(values, now, now_ns, p)
    if kind == JOG and values[0] != 0.0:
        return _jog(values[0], values[1], plan, now, now_ns, p)
    if kind == TRACK:
        return _track(values[0], profile, now, now_ns, configured, p)
    if s.state == State.HOLDING or plan.phase == COMING_TO_REST:
        return Asked(TAKEN)
    limits = p.limits
    return Asked(TAKEN, HOLD, halting(plan, now, now_ns, p.motion, limits.travel_min_m, limits.travel_max_m))


def _arm(
    track: bool, s: Supervisor, present: int, e: Estimate, now_ns: int, configured: Sine, p: AxisParameters
) -> Asked:
    if s.state != State.DISARMED:
        return Asked(WRONG_STATE)
    if s.closing:
        return Asked(CLOSING)
    if present & BLOCKS_ARM:
        alone = present & BLOCKS_ARM == UNREFERENCED
        return Asked(NOT_REFERENCED if alone else BLOCKED)
    here = rest(e.position_m)
    if p.leading.how == GANTRY or (track and p.leading.how in (REFERENCE, POSITION)):
        return Asked(TAKEN, TRACK, Plan(LED, now_ns, still(e.position_m)))
    if not track:
        return Asked(TAKEN, ARM, resting(e.position_m, now_ns))
    first = sine(0.0, configured)
    plan = _join(first, here, now_ns, p)
    if p.join_at_once:
        near = abs(first.position_m - e.position_m) <= p.limits.tracking_error_m
        plan = Plan(FOLLOWING, now_ns, still(first.position_m)) if near else None
    return Asked(TAKEN, TRACK, plan) if plan is not None else Asked(BLOCKED, faults=1 << F.UNREACHABLE)


def _home(s: Supervisor, present: int, p: AxisParameters) -> Asked:
    if not p.homing.incremental or s.state not in (State.DISARMED, State.HOLDING):
        return Asked(WRONG_STATE)
    if s.closing:
        return Asked(CLOSING)
    return Asked(BLOCKED) if present & BLOCKS[HOME] else Asked(TAKEN, HOME)


def _probe(
    values: tuple[float, ...],
    s: Supervisor,
    present: int,
    e: Estimate,
    now_ns: int,
    old: Probe,
    p: AxisParameters,
) -> Asked:
    """A bounded opening from rest; the same again, while it is under way, renews its lease."""
    goal_v, rate_v_s, travel_m, speed_m_s, force_n, lease = values
    if not 1.0 <= lease <= LONGEST_LEASE:
        return Asked(MALFORMED)
    asked = Probe(goal_v, rate_v_s, travel_m, speed_m_s, force_n, int(lease))
    wanted = asked._replace(since_ns=now_ns, from_m=e.position_m, from_n=e.x3_n, usual_n=e.x3_n)
    if not is_allowed(wanted, p.output.u_max_v):
        return Asked(BEYOND_LIMITS)
    if s.state == State.PROBING and wanted[:5] == old[:5]:
        return Asked(TAKEN, probe=old._replace(lease=wanted.lease))
    if s.state != State.DISARMED:
        return Asked(WRONG_STATE)
    if s.closing:
        return Asked(CLOSING)
    return Asked(BLOCKED) if present & BLOCKS[PROBE] else Asked(TAKEN, PROBE, probe=wanted)


def _press(
    values: tuple[float, ...],
    s: Supervisor,
    e: Estimate,
    now_ns: int,
    law: Controller,
    before: Press,
    p: AxisParameters,
) -> Asked:
    """A force of the piston; where one is asked for already, the ramp goes on from there."""
    force_n, rate_n_s, low_m, high_m, speed_m_s, time_s = values
    least_m, most_m = soft_limits(p)
    if low_m == 0.0 == high_m:
        low_m, high_m = least_m, most_m
    elif not least_m <= low_m < high_m <= most_m:
        return Asked(OUT_OF_TRAVEL)
    if not low_m <= e.position_m <= high_m:
        return Asked(OUT_OF_TRAVEL)
    k = p.pressing
    usual_n_s = force.usual_rate_n_s(force_n, e, k, law)
    aim = Aim(
        force_n,
        rate_n_s or usual_n_s,
        low_m,
        high_m,
        speed_m_s or k.speed_m_s,
        time_s or k.time_s,
        p.limits.braking_m_s2,
    )
    if aim.rate_n_s < LEAST_RATE_N_S or aim.speed_m_s < SLOWEST.speed_m_s or aim.time_s <= 0.0:
        return Asked(MALFORMED)
    if not -k.in_n <= force_n <= k.out_n or aim.speed_m_s > p.limits.speed_m_s:
        return Asked(BEYOND_LIMITS)
    goes_on = s.state == PRESSING
    return Asked(TAKEN, FORCE, press=force.begin(aim, before, goes_on, e, now_ns, law))


def _tune(
    values: tuple[float, ...], plan: Plan, now: Reference, now_ns: int, law: Controller, p: AxisParameters
) -> Asked:
    """Another law or other gains, perhaps another configured reference or another model: all or nothing."""
    gains, more = parted(values) or ((), ())
    if not gains or len(more) not in (0, MOTION, MODEL, MOTION + MODEL) or not is_sound(gains):
        return Asked(MALFORMED)
    if not is_stable(gains, law):
        return Asked(UNSTABLE)
    rest = len(more) % MODEL
    motion, believed, after = more[:rest], more[rest:], tuned(gains, law)
    if believed:
        wanted = Model(*believed)
        if not model.is_sound(wanted, law):
            return Asked(MALFORMED)
        if not model.is_bearable(wanted, law):
            return Asked(UNSTABLE)
        after = model.remodelled(wanted, after)
    asked = _configure(Sine(*motion), plan, now, now_ns, p) if motion else Asked(TAKEN)
    return asked._replace(law=after) if asked.answer == TAKEN else asked


def _configure(wanted: Sine, plan: Plan, now: Reference, now_ns: int, p: AxisParameters) -> Asked:
    """Another configured reference; an axis that follows the present one goes over to it."""
    limits = p.limits
    centre_m, amplitude_m, omega_rad_s = wanted
    if amplitude_m < 0.0 or not 0.0 <= omega_rad_s <= MOST_OMEGA_RAD_S:
        return Asked(MALFORMED)
    if centre_m - amplitude_m < limits.travel_min_m or centre_m + amplitude_m > limits.travel_max_m:
        return Asked(OUT_OF_TRAVEL)
    if omega_rad_s * amplitude_m > limits.speed_m_s:
        return Asked(BEYOND_LIMITS)
    if plan.phase not in (JOINING, FOLLOWING) or plan.uploaded:
        return Asked(TAKEN, reference=wanted)
    joining = _join(sine(0.0, wanted), now, now_ns, p)
    return Asked(TAKEN, plan=joining, reference=wanted) if joining is not None else Asked(OUT_OF_TRAVEL)


def _bounds(wanted: tuple[float, ...], most: Bounds) -> Bounds | int:
    """Bounds of a way: those asked for, the configured ones for 0; or why not."""
    chosen = [value or bound for value, bound in zip_longest(wanted, most, fillvalue=0.0)]
    bounds = Bounds(*chosen)
    if any(map(lt, bounds, SLOWEST)):
        return MALFORMED
    return BEYOND_LIMITS if any(map(gt, bounds, most)) else bounds


def _within(bounds: Bounds, now: Reference, end_m: float, p: AxisParameters) -> Way | None:
    """The way to a position, braked harder where it would leave the travel; None if that is not enough."""
    low_m, high_m = p.limits.travel_min_m, p.limits.travel_max_m
    first, now = way_inside(now, p)
    for _ in range(HARDENINGS):
        path = move(now, end_m, bounds, p.motion)
        if stays(way(*path.pieces[:2]), low_m, high_m):  # beyond these it does not turn
            return way(*first, *path.pieces)
        bounds = Bounds(bounds.speed_m_s, 2.0 * bounds.acceleration_m_s2, 4.0 * bounds.jerk_m_s3)
    return None


def _goto(values: tuple[float, ...], now: Reference, now_ns: int, p: AxisParameters) -> Asked:
    bounds = _bounds(values[1:], p.motion)
    if isinstance(bounds, int):
        return Asked(bounds)
    low_m, high_m = soft_limits(p)
    if not low_m <= values[0] <= high_m:
        return Asked(OUT_OF_TRAVEL)
    if bounds == p.motion and now == rest(now.position_m):
        bounds = unhurried(bounds, abs(values[0] - now.position_m), p.shunned)
    path = _within(bounds, now, values[0], p)
    return Asked(TAKEN, GOTO, Plan(GOING, now_ns, path)) if path is not None else Asked(OUT_OF_TRAVEL)


def _jog(velocity: float, lease: float, plan: Plan, now: Reference, now_ns: int, p: AxisParameters) -> Asked:
    """A jog is a way to the end of the travel at its speed: it brakes in time by itself."""
    if not 1.0 <= lease <= LONGEST_LEASE:
        return Asked(MALFORMED)
    if abs(velocity) < SLOWEST.speed_m_s:
        return Asked(MALFORMED)
    if plan.jog_m_s == velocity:
        return Asked(TAKEN, JOG, plan._replace(lease=int(lease)))
    if abs(velocity) > p.motion.speed_m_s:
        return Asked(BEYOND_LIMITS)
    end_m = soft_limits(p)[velocity > 0.0]
    ahead_m = end_m - now.position_m if velocity > 0.0 else now.position_m - end_m
    path = _within(p.motion._replace(speed_m_s=abs(velocity)), now, end_m, p) if ahead_m > ARRIVED_M else None
    if path is None:
        return Asked(OUT_OF_TRAVEL)
    return Asked(TAKEN, JOG, Plan(GOING, now_ns, path, jog_m_s=velocity, lease=int(lease)))


def _track(
    what: float, profile: Profile, now: Reference, now_ns: int, configured: Sine, p: AxisParameters
) -> Asked:
    if what not in (CONFIGURED, UPLOADED):
        return Asked(MALFORMED)
    if what == UPLOADED and not ends_at_rest(profile):
        return Asked(NO_PROFILE)
    if what == CONFIGURED and p.leading.how in (REFERENCE, POSITION):
        path = stop(now, p.motion, p.limits.travel_min_m, p.limits.travel_max_m)
        return Asked(TAKEN, TRACK, Plan(LED, now_ns, path))
    first = at(0.0, profile[0]) if what == UPLOADED else sine(0.0, configured)
    joining = _join(first, now, now_ns, p)
    if joining is None:
        return Asked(OUT_OF_TRAVEL)
    return Asked(TAKEN, TRACK, joining._replace(uploaded=what == UPLOADED))


def _join(first: Reference, now: Reference, now_ns: int, p: AxisParameters) -> Plan | None:
    """The way in motion to where a reference begins; None where it would leave the travel."""
    before, now = way_inside(now, p)
    path = transfer(now, first, p.transfer)
    if not stays(path, p.limits.travel_min_m, p.limits.travel_max_m):
        return None
    return Plan(JOINING, now_ns, way(*before, *path.pieces))


def _piece(values: tuple[float, ...], plan: Plan, profile: Profile, p: AxisParameters) -> Asked:
    if plan.uploaded:
        return Asked(WRONG_STATE)
    if not values:
        return Asked(TAKEN, profile=())
    piece = Septic(*values)
    if not SHORTEST_S <= piece.T <= LONGEST_S or len(profile) >= MOST_PIECES:
        return Asked(MALFORMED)
    if profile and not meet(profile[-1], piece):
        return Asked(MALFORMED)
    reach = extent(piece)
    if not is_inside(reach, *soft_limits(p)):
        return Asked(OUT_OF_TRAVEL)
    if not is_within(reach, p.motion):
        return Asked(BEYOND_LIMITS)
    return Asked(TAKEN, profile=(*profile, piece))
