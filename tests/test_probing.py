"""Probes: bounded openings without a loop, on the software rig in simulated time."""

from __future__ import annotations

from unittest.mock import ANY

import pytest

from axis_rig import ARM, CLEAR, DISARM, SHUTDOWN, H, Rig, ready
from pneud.axis.cycle import Axis
from pneud.control.probe import NO_PROBE, Probe, Progress, coast_m, is_allowed, opening_v, proceed
from pneud.safety.faults import F, names
from pneud.signals import Answer, Estimate, Host, Measurement, RequestKind, State, Tick

PROBE, STOP, GOTO = RequestKind.PROBE, RequestKind.STOP, RequestKind.GOTO
ASKED = (1.0, 0.2, 2e-3, 0.05, 150.0, 5000.0)
P = Probe(-1.0, 0.2, 2e-3, 0.05, 150.0, 100)


def asked(**values: float) -> tuple[float, ...]:
    """The usual probe, but for some values."""
    names_ = ("goal_v", "rate_v_s", "travel_m", "speed_m_s", "force_n", "lease")
    return tuple(values.get(name, value) for name, value in zip(names_, ASKED, strict=True))


def probing(ticks: int = 300) -> Rig:
    rig = ready()
    first = rig.tick(PROBE, *ASKED)
    assert (first.answer, first.state) == (Answer.TAKEN, State.PROBING)
    assert rig.ticks(ticks)[-1].state == State.PROBING
    return rig


def ended(rig: Rig, limit: int = 9000) -> Tick:
    """The first tick after it; the valve is centred."""
    for _ in range(limit):
        tick = rig.tick()
        if tick.state != State.PROBING:
            return tick
    raise AssertionError("it goes on")


def test_the_opening_grows_to_its_bound_and_has_a_sign() -> None:
    begun = P._replace(since_ns=1_000_000_000)
    assert opening_v(begun, 1_000_000_000) == 0.0
    assert opening_v(begun, 2_000_000_000) == pytest.approx(-0.2)
    assert opening_v(begun, 60_000_000_000) == -1.0


@pytest.mark.parametrize(
    "beyond",
    [
        {"goal_v": 0.0},
        {"goal_v": 6.0},
        {"rate_v_s": 0.0},
        {"travel_m": 6e-3},
        {"travel_m": 0.0},
        {"speed_m_s": 0.2},
        {"speed_m_s": -0.1},
        {"force_n": 0.0},
    ],
)
def test_what_no_probe_may_do_is_refused(beyond: dict[str, float]) -> None:
    assert is_allowed(P, 5.0)
    assert not is_allowed(P._replace(**beyond), 5.0)  # type: ignore[arg-type]
    rig = ready()
    tick = rig.tick(PROBE, *asked(**beyond))
    assert (tick.answer, tick.state) == (Answer.BEYOND_LIMITS, State.DISARMED)


@pytest.mark.parametrize(
    ("now_ns", "position_m", "velocity_m_s", "x3_n", "lease", "over"),
    [
        (0, 0.5, 0.0, 0.0, 0, False),
        (0, 0.5, 0.0, 0.0, -1, True),
        (21_000_000_000, 0.5, 0.0, 0.0, 0, True),
        (5_100_000_000, 0.5, 0.0, 0.0, 0, True),
        (0, 0.5, 0.0, -151.0, 0, True),
    ],
)
def test_it_is_over_at_every_bound(
    now_ns: int, position_m: float, velocity_m_s: float, x3_n: float, lease: int, over: bool
) -> None:
    law = ready().axis.state.law
    e = Estimate(position_m, velocity_m_s, 0.0, x3_n, x3_n, 0.0, 0.0, 0.0)
    m = ready().tick().measurement
    p = P._replace(from_m=0.5, lease=lease)
    found = proceed(p, e, m, now_ns, H, law.cylinder, law.gas)
    assert found.over is over
    assert found.probe.braked_ns == 0


def going_on(p: Probe, now_ns: int, position_m: float, velocity_m_s: float, x3_n: float) -> Progress:
    law, e = ready().axis.state.law, Estimate(position_m, velocity_m_s, 0.0, x3_n, x3_n, 0.0, 0.0, 0.0)
    return proceed(p, e, ready().tick().measurement, now_ns, H, law.cylinder, law.gas)


@pytest.mark.parametrize(
    ("position_m", "velocity_m_s"), [(0.5, -0.06), (0.4979, 0.0), (0.501, 0.02)]
)  # fmt: skip
def test_what_moves_is_braked_until_it_is_slow(position_m: float, velocity_m_s: float) -> None:
    begun = going_on(P._replace(from_m=0.5), 1_000_000_000, position_m, velocity_m_s, 0.0)
    assert not begun.over
    assert begun.probe.braked_ns == 1_000_000_000
    fast = begun.probe._replace(most_n=50.0, fastest_m_s=0.06)
    assert opening_v(fast, 1_010_000_000) > 0.2 > 0.0 > opening_v(P, 1_000_000_000)
    assert opening_v(fast, 2_000_000_000) == 1.0
    assert not going_on(fast, 1_010_000_000, position_m, 0.05, 0.0).over
    for now_ns, speed_m_s, x3_n, lease in (
        (1_010_000_000, 0.03, 0.0, 0),  # slow
        (1_160_000_000, 0.05, 0.0, 0),  # late
        (1_010_000_000, 0.05, -36.0, 0),  # its force undone
        (1_010_000_000, 0.05, 36.0, 0),
        (1_010_000_000, 0.05, 0.0, -1),  # its operator lost
    ):
        assert going_on(fast._replace(lease=lease), now_ns, position_m, speed_m_s, x3_n).over
    lost = going_on(P._replace(from_m=0.5, lease=-1), 1_000_000_000, position_m, velocity_m_s, 0.0)
    assert lost.over
    assert lost.probe.braked_ns == 0


def test_a_force_that_falls_has_let_a_load_go_whatever_the_encoder_shows() -> None:
    built = going_on(P._replace(from_m=0.5), 1_000_000_000, 0.5, 0.0, 40.0).probe
    assert (built.most_n, built.most_ns) == (40.0, 1_000_000_000)
    assert 0.0 < built.usual_n < 1.0
    assert going_on(built, 1_100_000_000, 0.5, 0.0, 20.0).probe.braked_ns == 1_100_000_000
    assert going_on(built, 1_100_000_000, 0.5, 0.0, 35.0).probe.braked_ns == 0
    assert going_on(built, 1_200_000_000, 0.5, 0.0, 20.0) == (built._replace(usual_n=ANY), False)
    assert going_on(built, 1_300_000_000, 0.5, 0.0, 20.0) == (built._replace(usual_n=ANY), True)
    little = built._replace(most_n=14.0)
    assert going_on(little, 1_300_000_000, 0.5, 0.0, 2.0) == (little._replace(usual_n=ANY), False)


def test_without_a_motion_nothing_coasts() -> None:
    law, m = ready().axis.state.law, ready().tick().measurement
    still = Estimate(0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert coast_m(still, m, law.cylinder, law.gas) == 0.0
    assert coast_m(still._replace(velocity_m_s=-0.1), m, law.cylinder, law.gas) > 1e-3


def test_it_ends_by_itself_with_the_valve_centred_and_can_be_done_again() -> None:
    rig = ready()
    for goal_v in (1.0, -1.0):
        before_m = rig.node.truth().position_m
        assert rig.tick(PROBE, *asked(goal_v=goal_v)).state == State.PROBING
        tick = ended(rig)
        assert (tick.state, tick.latched) == (State.DISARMED, 0)
        way_m = [goal_v * (rig.tick() and rig.node.truth().position_m - before_m) for _ in range(400)]
        assert 0.5e-3 < max(way_m) <= 5e-3
    assert rig.tick(ARM).state == State.HOLDING


def test_it_is_refused_where_it_makes_no_sense() -> None:
    rig = probing()
    assert rig.tick(PROBE, *asked(goal_v=-1.0)).answer == Answer.WRONG_STATE
    for kind, values in ((ARM, ()), (GOTO, (0.5,)), (PROBE, ASKED[:5])):
        assert rig.tick(kind, *values).answer in (Answer.WRONG_STATE, Answer.MALFORMED)
    assert rig.tick(PROBE, *asked(lease=0.0)).answer == Answer.MALFORMED
    assert rig.tick(STOP).state == State.DISARMED
    rig.tick(ARM)
    assert rig.tick(PROBE, *ASKED).answer == Answer.WRONG_STATE
    other = ready()
    other.host = int(Host.LINK_DOWN)
    assert other.tick(PROBE, *ASKED).answer == Answer.BLOCKED
    third = ready()
    third.tick(SHUTDOWN)
    assert third.tick(PROBE, *ASKED).answer == Answer.CLOSING


@pytest.mark.parametrize("kind", [STOP, DISARM, SHUTDOWN])
def test_stopped_the_valve_is_centred_at_once(kind: RequestKind) -> None:
    rig = probing()
    tick = rig.tick(kind)
    assert (tick.answer, tick.state, tick.command.enable) == (Answer.TAKEN, State.DISARMED, 0)


@pytest.mark.parametrize("host", [Host.CONSOLE_LOST, Host.LINK_DOWN])
def test_a_fault_centres_and_latches(host: Host) -> None:
    rig = probing()
    rig.host = int(host)
    tick = rig.tick()
    assert (tick.state, names(tick.latched)) == (State.FAULT, [host.name.lower()])  # type: ignore[union-attr]
    rig.host = 0
    rig.ticks(5)
    assert rig.tick(CLEAR).state == State.DISARMED


def test_without_its_operator_it_ends_and_renewed_it_goes_on() -> None:
    rig = ready()
    short = asked(lease=20.0)
    rig.tick(PROBE, *short)
    assert rig.ticks(15)[-1].state == State.PROBING
    begun_ns = rig.axis.state.probe.since_ns
    assert rig.tick(PROBE, *short).answer == Answer.TAKEN
    assert rig.ticks(15)[-1].state == State.PROBING
    assert rig.axis.state.probe.since_ns == begun_ns, "the ramp goes on"
    tick = ended(rig, 10)
    assert tick.state == State.DISARMED
    assert tick.present & 1 << F.OPERATOR_LOST


def test_frozen_in_a_probe_it_thaws_to_the_same_ticks() -> None:
    rig = probing(200)
    frozen = rig.axis.freeze()
    assert frozen.probe != NO_PROBE
    raw: list[Measurement] = []
    rig.measurement = lambda m: raw.append(m) or m  # type: ignore[func-returns-value]
    ticks = rig.ticks(300)
    other = Axis(rig.axis.parameters)
    other.thaw(frozen)
    assert [repr(other.cycle(m, None, m.t_ns)) for m in raw] == [repr(t) for t in ticks]
