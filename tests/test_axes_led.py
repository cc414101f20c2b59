"""Axes of which one is led by another: a scaled and shifted motion, and two cylinders that carry one load."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import pytest

from pneud import resources
from pneud.config.axes import axes_of, mirrored, own_text
from pneud.config.following import why_not_led
from pneud.config.models import FollowConfig
from pneud.config.sections import ConfigError
from pneud.loading import Together as Axes
from pneud.loading import load, load_axes
from pneud.log.files.reader import read_log
from pneud.replay.lockstep import backend_of
from pneud.replay.replaying import replay
from pneud.replay.running_together import run_together
from pneud.replay.together import Ask, Together
from pneud.safety.faults import F
from pneud.signals import Record, Request, RequestKind, State, Tick
from pneud.verbs.check import check

FOLDER = resources.configs() / "axes"
GANTRY, LED = ((FOLDER / name).read_text() for name in ("gantry.toml", "led.toml"))
KINDS = RequestKind


def changed(folder: Path, text: str, *changes: tuple[str, str]) -> Path:
    """A file of several axes, beside its DBC."""
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "axes.dbc").write_bytes((FOLDER / "axes.dbc").read_bytes())
    (folder / "a.toml").write_text(text)
    return folder / "a.toml"


def run(axes: Axes, duration_s: float, ask: Ask | None = None) -> Together:
    return Together(axes, duration_s, how=[backend_of(axis) for axis in axes], ask=ask)


def skew_mm(records: Sequence[Record]) -> float:
    return 1e3 * (records[0].truth_m - records[1].truth_m)


def test_a_gantry_stays_square_under_a_load_that_is_not(tmp_path: Path) -> None:
    most = {}
    for coupling in ("0.5", "0.0"):
        axes = load_axes(changed(tmp_path, GANTRY, ("coupling = 0.5", f"coupling = {coupling}")))
        ticks = list(run(axes, 1.5).records())
        assert {record.tick.state for record in ticks[300]} == {State.TRACKING}
        most[coupling] = max(abs(skew_mm(records)) for records in ticks[300:700])
        assert not any(record.tick.latched for records in ticks for record in records)
    assert most["0.5"] < 0.1
    assert most["0.5"] < most["0.0"]


def held(axes: Axes, from_s: float, force_n: float) -> list[tuple[Record, ...]]:
    """A run in which something holds the second load from a moment on."""
    going = run(axes, 2.0)
    found = []
    for number, records in enumerate(going.records()):
        if number == round(from_s * axes[0].config.loop.rate_hz):
            going.lanes[1].node.force_ext_n = force_n
        found.append(records)
    return found


SOFT = ("skew_m = 0.003", "skew_m = 0.0002"), ("stiffness_n_m = 2.0e5", "stiffness_n_m = 2.0e4")


def test_a_gantry_that_is_askew_stops_both_together_with_a_fault_of_its_own(tmp_path: Path) -> None:
    text = changed(
        tmp_path,
        GANTRY,
        ("skew_m = 0.003", "skew_m = 0.0002"),
        ("stiffness_n_m = 2.0e5", "stiffness_n_m = 2.0e4"),
    )
    found = held(load_axes(text), 0.9, 300.0)
    states = [tuple(record.tick.state for record in records) for records in found]
    latched = {bit for records in found for record in records for bit in (record.tick.latched,) if bit}
    assert latched == {1 << F.SKEW}
    stops = [i for i, pair in enumerate(states) if State.STOPPING in pair]
    assert stops
    assert all(pair[0] in (State.STOPPING, State.TRACKING) for pair in states[stops[0] : stops[0] + 2])
    begun = stops[0]
    over = [next(i for i in range(begun, len(states)) if states[i][n] == State.FAULT) for n in (0, 1)]
    assert abs(over[0] - over[1]) <= 1
    assert states[-1] == (State.FAULT, State.FAULT)
    stopping = found[begun : min(over)]
    speeds = [abs(records[0].tick.reference.velocity_m_s) for records in stopping]
    apart = [
        abs(a.tick.reference.position_m - b.tick.reference.position_m) for a, b in found[stops[0] : min(over)]
    ]
    assert speeds[-1] < 0.05 < speeds[0]
    assert max(apart) < 2e-3  # the shifts


def operator(*wanted: tuple[int, dict[int, Request]]) -> Ask:
    """Asks for one thing after the other, each in its tick."""
    at = dict(wanted)
    count = 0

    def ask(_: Sequence[Tick]) -> dict[int, Request]:
        nonlocal count
        count += 1
        return at.get(count, {})

    return ask


def test_the_half_that_is_led_goes_where_the_other_goes(tmp_path: Path) -> None:
    arm = {0: Request(KINDS.ARM), 1: Request(KINDS.ARM)}
    ask = operator(
        (40, arm),
        (60, {1: Request(KINDS.GOTO, (0.6,))}),
        (70, {0: Request(KINDS.GOTO, (0.5,))}),
        (420, {0: Request(KINDS.STOP), 1: Request(KINDS.STOP)}),
        (430, {0: Request(KINDS.HOLD), 1: Request(KINDS.HOLD)}),
        (520, {0: Request(KINDS.DISARM)}),
    )
    found = list(run(load_axes("gantry.toml"), 1.2, ask).records())
    answers = [(r[1].tick.request, r[1].tick.answer) for r in found if r[1].tick.request is not None]
    assert [a for q, a in answers if q.kind == KINDS.GOTO] == [2]
    states = [tuple(State(record.tick.state) for record in records) for records in found]
    assert states[65] == (State.HOLDING, State.TRACKING)
    assert states[400] == (State.HOLDING, State.TRACKING)
    at_rest = found[410]
    assert [record.truth_m for record in at_rest] == pytest.approx([0.5, 0.5], abs=1e-4)
    in_position = [[bool(records[n].tick.in_position) for records in found] for n in (0, 1)]
    assert all(any(one[250:410]) for one in in_position)
    assert [record.tick.in_position for record in found[150]] == [0, 0]  # on the way there
    assert states[500] == (State.HOLDING, State.TRACKING)
    assert states[-1] == (State.DISARMED, State.DISARMED)
    ends = [next(i for i in range(520, len(states)) if states[i][n] == State.DISARMED) for n in (0, 1)]
    assert abs(ends[0] - ends[1]) <= 1
    assert all(not record.tick.latched for records in found for record in records)


@pytest.mark.parametrize("half", [0, 1])
def test_what_centres_one_half_centres_the_other(half: int) -> None:
    ask = operator(
        (40, {0: Request(KINDS.ARM, (1.0,)), 1: Request(KINDS.ARM, (1.0,))}),
        (120, {half: Request(KINDS.CENTRE)}),
    )
    found = list(run(load_axes("gantry.toml"), 0.3, ask).records())
    assert [record.tick.state for record in found[119]] == [State.TRACKING] * 2
    assert found[120][half].tick.state == State.DISARMED
    assert [record.tick.command.enable for record in found[121]] == [0, 0]


def follows(records: Sequence[Record], scale: float, offset_m: float) -> float:
    """How far the second load is from where the first leads it [m]."""
    return records[1].truth_m - (offset_m + scale * records[0].truth_m)


def test_an_axis_follows_anothers_reference_scaled_and_shifted() -> None:
    found = list(run(load_axes("led.toml"), 2.4).records())
    apart = [abs(follows(records, -0.5, 0.7)) for records in found[900:1190]]
    assert max(apart) < 1.5e-4
    for one, other in pairwise(found):  # it joins without a jolt
        a, b = one[1].tick.reference, other[1].tick.reference
        if not math.isnan(a.position_m + b.position_m):
            assert abs(b.velocity_m_s - a.velocity_m_s) < 0.02


def test_one_that_is_led_parts_from_the_other_and_couples_again() -> None:
    arm = Request(KINDS.ARM)
    ask = operator(
        (40, {0: arm, 1: arm}),
        (50, {1: Request(KINDS.TRACK, (0.0,))}),
        (60, {0: Request(KINDS.GOTO, (0.5,))}),
        (500, {1: Request(KINDS.GOTO, (0.4,))}),
        (760, {1: Request(KINDS.TRACK, (0.0,))}),
        (1000, {0: Request(KINDS.DISARM)}),
    )
    found = list(run(load_axes("led.toml"), 2.4, ask).records())
    states = [State(records[1].tick.state) for records in found]
    assert states[45] == State.HOLDING
    assert states[450] == State.TRACKING
    assert abs(follows(found[450], -0.5, 0.7)) < 1e-4
    assert [record.tick.in_position for record in found[450]] == [1, 1]
    assert found[740][1].truth_m == pytest.approx(0.4, abs=1e-4)
    assert abs(follows(found[990], -0.5, 0.7)) < 1e-4
    assert states[1150] == State.HOLDING  # nobody leads it any more
    assert not any(record.tick.latched for records in found for record in records)


def test_an_axis_follows_where_another_one_is_moved(tmp_path: Path) -> None:
    axes = load_axes(changed(tmp_path, LED, ('of = "reference"', 'of = "position"')))
    going = run(axes, 2.0, operator((40, {1: Request(KINDS.ARM, (1.0,))})))
    found: list[tuple[Record, ...]] = []
    for records in going.records():
        if len(found) == 100:
            going.lanes[0].node.force_ext_n = -150.0  # somebody pushes
        found.append(records)
    assert found[600][0].tick.state == State.DISARMED
    assert abs(found[900][0].truth_m - found[99][0].truth_m) > 0.002
    assert abs(follows(found[900], -0.5, 0.7)) < 1e-3
    assert found[900][1].tick.state == State.TRACKING


FAR = (
    ('of = "reference"', 'of = "position"'),
    ("scale = -0.5", "scale = 1.0"),
    ("offset_m = 0.7", "offset_m = 0.6"),
)


def test_what_leads_beyond_the_own_limits_stops(tmp_path: Path) -> None:
    text = changed(
        tmp_path,
        LED,
        ('of = "reference"', 'of = "position"'),
        ("scale = -0.5", "scale = 1.0"),
        ("offset_m = 0.7", "offset_m = 0.6"),
    )
    found = list(run(load_axes(text), 2.4).records())
    assert found[-1][1].tick.latched == 1 << F.LED_BEYOND
    assert all(0.0 < records[1].truth_m < 1.0 for records in found)


@pytest.mark.parametrize("name", ["gantry.toml", "led.toml"])
def test_each_log_replays_to_the_bit_by_itself(name: str, tmp_path: Path) -> None:
    found = run_together(load_axes(name), 0.6, 3, tmp_path, lambda _: None)
    assert len(found) == 2
    for summary in found.values():
        log = read_log(summary["log"])
        assert replay(log).identical
    told = [tick.told for tick in read_log(list(found.values())[1]["log"])]
    assert told[0] is None
    assert sum(one is not None for one in told) == len(told) - 1


def test_a_gantry_is_said_once_and_known_to_both(tmp_path: Path) -> None:
    one, other = load_axes("gantry.toml")
    leads, led = one.config.reference.follow, other.config.reference.follow
    assert leads is not None
    assert led is not None
    assert (leads.axis, leads.leads, led.axis, led.leads) == ("x2", True, "x1", False)
    assert (leads.skew_m, leads.coupling) == (led.skew_m, led.coupling)
    beam = one.config.plant.beam
    assert beam is not None
    assert beam.axis == "x2"
    assert beam.load_share == pytest.approx(0.3)
    text = (FOLDER / "gantry.toml").read_text()
    for number, axis in enumerate((one, other)):
        assert own_text(axis.config.name, number, 2, mirrored(axis.config), text) == axis.text
    assert load("gantry.toml", axis="x2").config == other.config
    apart = changed(tmp_path, GANTRY, ("offset_m = 0.0 ", "offset_m = 0.2 "))
    follow = axes_of(apart)[0].config.reference.follow
    assert follow is not None
    assert follow.offset_m == -0.2


FASTER = (
    ("scale = -0.5", "scale = -2.0"),
    ("offset_m = 0.7", "offset_m = 1.7"),
    ("limits.travel_min_m = 0.2", "limits.travel_min_m = 0.4"),
)
WRONG: dict[str, tuple[str, tuple[tuple[str, str], ...]]] = {
    "is no other axis of this daemon; there is x": (LED, (('axis = "x"', 'axis = "z"'),)),
    "'y' is no other axis": (LED, (('axis = "x"', 'axis = "y"'),)),
    "x's travel leads to -99.5": (LED, (("offset_m = 0.7", "offset_m = 0.3"),)),
    "x leads with 1.2 of speed_m_s, above the own": (LED, FASTER),
    "scale must not be 0": (LED, (("scale = -0.5", "scale = 0"),)),
    "a gantry (skew_m) has scale = 1": (GANTRY, (("coupling = 0.5", 'of = "position"'),)),
}


def test_nobody_follows_one_that_follows_itself_or_is_carried_twice() -> None:
    x, y = (axis.config for axis in load_axes("led.toml"))
    z = y.model_copy(
        update={"name": "z", "reference": y.reference.model_copy(update={"follow": FollowConfig(axis="y")})}
    )
    assert why_not_led([x, y, z]) == "axis z: reference.follow.axis = 'y' follows x itself; follow that one"
    one, other = (axis.config for axis in load_axes("gantry.toml"))
    third = other.model_copy(update={"name": "x3"})
    assert "x1 is in a gantry with another axis already" in why_not_led([one, other, third])
    assert why_not_led([x, y]) == why_not_led([one, other]) == ""


@pytest.mark.parametrize("words", WRONG)
def test_what_cannot_be_followed_is_refused_in_one_line(words: str, tmp_path: Path) -> None:
    text, changes = WRONG[words]
    with pytest.raises(ConfigError) as found:
        load_axes(changed(tmp_path, text, *changes))
    assert words in str(found.value)
    assert "\n" not in str(found.value)


def test_check_says_who_is_led_by_whom(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("gantry.toml", "led.toml"):
        check(name)
    said = capsys.readouterr().out
    assert "a gantry with x2, and leads: at most 3 mm askew\n" in said
    assert "a gantry with x1, and is led: at most 3 mm askew\n" in said
    assert "follows the reference of x: -0.5 of it +700 mm\n" in said
