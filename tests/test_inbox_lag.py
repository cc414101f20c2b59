"""Which SYNC a frame answers: counters tell late frames, and nodes that skip are learned anew."""

from __future__ import annotations

import importlib.util
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud import resources
from pneud.bus.codec import Codec, Codecs, load_codecs
from pneud.bus.inbox import Inbox, InboxState
from pneud.bus.lag import AGREE, LATE, PROMPT, UNREAD, UNTOLD, LagState, told_by
from pneud.config.bus_tables import BusConfig
from pneud.loading import load
from pneud.log.format.snapshot import from_json, to_json
from pneud.loop.turn import Turn
from pneud.replay.lockstep import Simulation, backend_of
from pneud.signals import ALL_SOURCES, Defect, Frame, Measurement, Source

BUS = BusConfig()
CODECS: Codecs = load_codecs(BUS, resources.configs() / "pneud.dbc")
MS = 1_000_000
HIL = Path(__file__).parent.parent / "hil"


def narrowed(codec: Codec, bits: int) -> Codec:
    """A codec whose counter has fewer bits."""
    mask = (1 << bits) - 1

    def check(data: bytes) -> int:
        counter = codec.check(data)
        return counter if counter < 0 else counter & mask

    return codec._replace(counter_values=mask + 1, check=check)


def exchanged(codecs: Codecs, **roles: Codec) -> Codecs:
    """Codecs with others for some of the answers."""
    answers = (a._replace(codec=roles.get(a.name, a.codec)) for a in codecs.answers)
    return codecs._replace(answers=tuple(answers))


class Talk:
    """A bus in which the nodes do as they are told; positions tell the SYNC that they were read at."""

    def __init__(self, bits: int = 8, step_m: float = 0.0, bus: BusConfig = BUS, codecs: Codecs = CODECS):
        self.codecs = exchanged(
            codecs,
            encoder=narrowed(codecs.encoder, bits),
            pressure=narrowed(codecs.pressure, bits),
            valve_status=narrowed(codecs.valve_status, bits),
        )
        self.inbox = Inbox(self.codecs, bus)
        self.step_m = step_m
        self.syncs = 0
        self.counter = 3  # of the encoder; the other nodes do nothing
        self.waiting: list[tuple[int, int, Frame]] = []  # (SYNC at which it comes, place, frame)

    def position_m(self, sync: int) -> float:
        # at rest, one step of the encoder more with each SYNC, so that values can be told apart
        return round(1e6 * (0.2 + sync * (self.step_m or 1e-6))) * 1e-6

    def answer(self, sync: int) -> Frame:
        self.counter += 1
        c = self.codecs.encoder
        return Frame(
            0, c.can_id, c.encode(self.position_m(sync), 1, 2e-5, counter=self.counter % c.counter_values)
        )

    def tick(self, *fates: tuple[str, int]) -> Measurement:
        """One SYNC; what becomes of its answer: what is first applies to it."""
        self.syncs += 1
        k = self.syncs
        name, periods = fates[0] if fates else ("prompt", 0)
        if name != "skip":
            frame = self.answer(k)
            place = {"before": -1, "behind": 1}.get(name, 0)
            if name == "corrupt":
                frame = frame._replace(data=bytes((frame.data[0] ^ 1,)) + frame.data[1:])
            if name != "lost":
                self.waiting.append((k + periods, place, frame))
            if name == "twice":
                self.waiting.append((k + periods, 1, frame))
        t_ns = k * MS
        self.inbox.begin(t_ns)
        due = sorted((w for w in self.waiting if w[0] == k), key=lambda w: w[1])
        self.waiting = [w for w in self.waiting if w[0] > k]
        for i, (_, _, frame) in enumerate(due):
            self.inbox.feed(frame._replace(stamp_ns=t_ns + 200_000 + i))
        return self.inbox.measurement(0, 0)

    def ticks(self, count: int, *fates: tuple[str, int]) -> list[Measurement]:
        return [self.tick(*fates) for _ in range(count)]

    def right(self, m: Measurement) -> bool:
        """Fresh, and of this tick."""
        return bool(m.fresh) and m.position_m == pytest.approx(self.position_m(self.syncs), abs=1e-7)


def learned(bits: int = 8, step_m: float = 0.0, **how: Any) -> Talk:
    talk = Talk(bits, step_m, **how)
    assert all(m.fresh for m in talk.ticks(AGREE))
    return talk


def fates(most: int) -> st.SearchStrategy[tuple[str, int]]:
    late = st.tuples(st.sampled_from(["before", "behind"]), st.integers(1, most))
    return late | st.sampled_from([("lost", 0), ("corrupt", 0), ("twice", 0), ("prompt", 0)])


@st.composite
def courses(draw: st.DrawFn) -> tuple[int, list[tuple[str, int]]]:
    """Bits of a counter; what becomes of answers, a prompt one among any seven.

    Nor does the counter come round between two prompt ones: a node silent for so long looks frozen.
    """
    bits = draw(st.integers(2, 8))
    most = min(AGREE - 2, (1 << bits) - 2)
    bursts = draw(st.lists(st.lists(fates(min(8, (1 << bits) - 1 >> 1)), max_size=most), max_size=8))
    return bits, [fate for burst in bursts for fate in (*burst, ("prompt", 0))]


@pytest.mark.parametrize("step_m", [0.0, 2e-4], ids=["at rest", "moving"])
@given(course=courses())
def test_a_frame_is_fresh_only_in_the_tick_whose_sync_it_answers(
    step_m: float, course: tuple[int, list[tuple[str, int]]]
) -> None:
    bits, fates_of = course
    talk = learned(bits, step_m)
    for fate in fates_of:
        m = talk.tick(fate)
        assert not m.fresh or talk.right(m)
        if fate[0] in ("prompt", "twice") and bits == 8:
            assert m.fresh, "what answers this SYNC counts"
    talk.ticks(9)  # what is still under way comes
    assert talk.right(talk.tick())


@given(
    bits=st.integers(2, 8),
    course=st.lists(fates(1) | st.tuples(st.just("skip"), st.just(0)), max_size=60),
)
def test_a_node_that_skips_what_it_likes_is_learned_anew(bits: int, course: list[tuple[str, int]]) -> None:
    talk = learned(bits)
    for fate in course:
        talk.tick(fate)
    after = talk.ticks(AGREE + 2)
    assert after[-1].fresh
    assert talk.right(after[-1])


@pytest.mark.parametrize("bits", [4, 8])
@pytest.mark.parametrize("place", ["before", "behind"])
@pytest.mark.parametrize("periods", [1, 2, 3, 7])
def test_one_late_frame_is_late_whatever_its_stamp(bits: int, place: str, periods: int) -> None:
    talk = learned(bits)
    late = talk.tick((place, periods))
    assert (late.fresh, late.encoder_defects) == (0, 0)
    for _ in range(periods):
        assert talk.right(talk.tick())
    counts = talk.inbox.counts()
    assert (counts.late, counts.lost) == (1, 0), "found again"
    assert talk.right(talk.tick())


def test_a_late_frame_alone_in_its_tick_says_so() -> None:
    talk = learned()
    talk.tick(("before", 1))
    m = talk.tick(("lost", 0))
    assert (m.fresh, m.encoder_defects, m.encoder_age_ns) == (0, Defect.LATE, 2 * MS - 180_000)


def test_a_frame_behind_a_newer_one_that_was_counted_as_lost_is_found() -> None:
    talk = learned()
    talk.tick(("behind", 2))
    talk.tick()
    assert talk.inbox.counts().lost == 1
    talk.tick()
    assert talk.inbox.counts()._replace(rx=0) == (0, 0, 0, 0, 1, 0, 0, ())
    talk.inbox.feed(
        talk.answer(0)._replace(data=CODECS.encoder.encode(0.2, 1, 0.0, counter=talk.counter - 4))
    )
    assert talk.inbox.counts().lost == 0, "and no further than that"


def test_a_node_that_skipped_a_sync_is_believed_once_its_values_tell() -> None:
    talk = learned(step_m=1.5e-4)
    assert [m.fresh for m in (talk.tick(("skip", 0)), *talk.ticks(3))] == [0, 0, 1, 1]
    assert talk.right(talk.tick())


def test_a_node_that_skipped_a_sync_at_rest_is_believed_after_some_frames() -> None:
    talk = learned()
    found = [m.fresh for m in (talk.tick(("skip", 0)), *talk.ticks(AGREE + 1))]
    assert found == [0] * AGREE + [1, 1]
    assert talk.inbox.counts().late == AGREE - 1
    assert talk.right(talk.tick())


def test_a_source_that_may_not_be_silent_for_long_is_believed_sooner() -> None:
    talk = learned(bus=BusConfig(sensor_timeout_ms=5.0))
    found = [m.fresh for m in (talk.tick(("skip", 0)), *talk.ticks(4))]
    assert found == [0, 0, 0, 1, 1], "before its time-out"


def test_one_late_frame_behind_a_long_silence_is_late() -> None:
    talk = learned()
    talk.ticks(40, ("lost", 0))
    talk.tick(("before", 1))
    assert talk.tick(("lost", 0)).fresh == 0
    assert talk.right(talk.tick())


def test_a_source_that_falls_behind_in_motion_stays_late_until_it_is_a_fault() -> None:
    talk = learned(step_m=1.5e-4)
    found = [m.fresh for m in talk.ticks(120, ("before", 1))]
    assert not any(found[: round(BUS.sensor_timeout_ms) + 2])
    assert found[-1] == 1, "a node that is so for good is taken as it is, once that has been named"
    assert found.index(1) == pytest.approx(2 * BUS.sensor_timeout_ms, abs=2)


def test_one_that_was_found_late_and_catches_up_is_fresh_at_once() -> None:
    talk = learned(step_m=1.5e-4)
    talk.ticks(20, ("before", 1))
    assert talk.right(talk.tick())


def test_at_rest_a_source_that_falls_behind_is_noticed_and_learned() -> None:
    talk = learned()
    found = [m.fresh for m in talk.ticks(AGREE + 3, ("before", 1))]
    assert found == [0] * AGREE + [1] * 3
    assert talk.inbox.counts().late == AGREE - 1


def test_a_lag_that_changes_is_judged_from_the_start() -> None:
    talk = learned()
    talk.tick(("skip", 0))
    talk.ticks(AGREE - 2)
    talk.tick(("skip", 0))
    assert [m.fresh for m in talk.ticks(AGREE + 1)] == [0] * (AGREE - 1) + [1, 1]


@pytest.mark.parametrize("ahead", [1, 9, 100, 200])
def test_a_counter_that_is_ahead_is_never_late(ahead: int) -> None:
    talk = learned()
    talk.counter += ahead
    assert all(m.fresh for m in talk.ticks(AGREE))
    assert talk.tick(("before", 1)).fresh == 0, "and learned by now"
    assert talk.right(talk.tick())
    assert talk.inbox.counts().late == 1


def test_a_node_that_counts_otherwise_counts_by_stamp() -> None:
    talk = learned()
    for _ in range(600):
        talk.counter += 1
        assert talk.tick().fresh
    assert talk.inbox.counts().late == 0


def test_before_it_is_learned_the_stamp_tells() -> None:
    talk = Talk()
    talk.ticks(AGREE - 2)
    talk.tick(("before", 1))
    assert talk.tick(("lost", 0)).fresh, "as it came"


def test_what_comes_between_two_ticks_says_nothing_of_a_lag() -> None:
    talk = learned()
    talk.tick(("skip", 0))
    for _ in range(3 * AGREE):
        talk.tick(("lost", 0))
        talk.inbox.feed(talk.answer(talk.syncs)._replace(stamp_ns=talk.syncs * MS + 900_000))
    found = [m.fresh for m in talk.ticks(3)]
    assert found[0] or found[1] or found[2], "its time-out has long been running"


def test_other_sources_have_counters_only() -> None:
    talk = learned(step_m=1.5e-4)
    c = talk.codecs.pressure

    def pressure(k: int, counter: int) -> int:
        talk.inbox.begin(k * MS)
        data = c.encode(3e5, 2e5, 6e5, counter=counter & 255)
        talk.inbox.feed(Frame(k * MS + 300_000, c.can_id, data))
        return talk.inbox.measurement(0, 0).fresh

    assert all(pressure(100 + k, k) for k in range(AGREE))
    talk.inbox.begin((100 + AGREE) * MS)
    found = [pressure(100 + k, k - 1) for k in range(AGREE + 1, 3 * AGREE)]
    assert found == [0] * (AGREE - 1) + [Source.PRESSURE] * AGREE


def test_without_sync_counters_tell_nothing() -> None:
    bus = BusConfig(sync=False)
    talk = Talk(bus=bus)
    talk.ticks(20)
    talk.tick(("before", 1))
    assert talk.tick(("lost", 0)).fresh
    assert talk.inbox.freeze().encoder.lag == LagState()
    again = Inbox(CODECS, bus)
    again.thaw(talk.inbox.freeze())
    assert again.freeze() == talk.inbox.freeze()


def test_without_a_counter_the_stamp_tells() -> None:
    def uncounted(codec: Codec) -> Codec:
        return codec._replace(counter_values=1)

    talk = Talk()
    talk.inbox = Inbox(exchanged(CODECS, encoder=uncounted(CODECS.encoder)), BUS)
    talk.ticks(20)
    talk.tick(("before", 1))
    assert talk.tick(("lost", 0)).fresh
    talk.inbox.thaw(talk.inbox.freeze())


# --- the encoder's evidence -------------------------------------------------------------------------------

STEADY = ((1 * MS, 0.1), (2 * MS, 0.1001), (3 * MS, 0.1002))


@pytest.mark.parametrize(
    ("readings", "position_m", "t_ms", "says"),
    [
        (STEADY, 0.1004, 5, PROMPT),
        (STEADY, 0.1003, 5, LATE),
        (STEADY, 0.1002, 5, LATE),
        (STEADY, 0.10035, 5, UNTOLD),
        (STEADY, 0.1010, 5, UNTOLD),
        (STEADY, 0.1012, 13, UNTOLD),  # too long ago
        (STEADY, 0.1003, 3, UNTOLD),
        (UNREAD, 0.1, 5, UNTOLD),
        (((1 * MS, 0.1), (2 * MS, 0.1), (3 * MS, 0.10002)), 0.10002, 5, UNTOLD),  # noise
        (((1 * MS, 0.1), (2 * MS, 0.1001), (3 * MS, 0.1001)), 0.1001, 5, UNTOLD),  # it has stopped
        (((1 * MS, 0.1), (2 * MS, 0.1001), (3 * MS, 0.1000)), 0.1001, 5, UNTOLD),  # a reading was odd
        (((1 * MS, 0.3), (2 * MS, 0.2999), (3 * MS, 0.2998)), 0.2996, 5, PROMPT),
        (((1 * MS, 0.3), (2 * MS, 0.2999), (3 * MS, 0.2998)), 0.2997, 5, LATE),
        (((1 * MS, 0.1), (1 * MS, 0.1001), (3 * MS, 0.1002)), 0.1, 5, UNTOLD),
        (STEADY, math.nan, 5, UNTOLD),
    ],
)
def test_a_position_tells_when_it_was_read(readings: Any, position_m: float, t_ms: int, says: int) -> None:
    assert told_by(readings, position_m, t_ms * MS, (t_ms - 1) * MS) == says


# --- state ------------------------------------------------------------------------------------------------


@given(course=courses(), cut=st.integers(0, 40), step_m=st.sampled_from([0.0, 2e-4]))
def test_a_snapshot_goes_on_as_the_run_did(
    course: tuple[int, list[tuple[str, int]]], cut: int, step_m: float
) -> None:
    bits, fates_of = course
    talk = learned(bits, step_m)
    again = Inbox(talk.codecs, BUS)
    fed: list[Frame] = []
    feed = talk.inbox.feed

    def both(frame: Frame) -> None:
        feed(frame)
        fed.append(frame)

    talk.inbox.feed = both  # type: ignore[method-assign]
    for i, fate in enumerate((*fates_of, ("skip", 0), *[("prompt", 0)] * 40)):
        if i == cut:
            again.thaw(from_json(InboxState, to_json(talk.inbox.freeze())))
        fed.clear()
        m = talk.tick(fate)
        if i >= cut:
            again.begin(talk.syncs * MS)
            for frame in fed:
                again.feed(frame)
            assert repr(again.measurement(0, 0)) == repr(m)
    assert repr(again.freeze()) == repr(talk.inbox.freeze())


def test_a_snapshot_without_lags_can_be_read() -> None:
    talk = learned()
    tree = json.loads(to_json(talk.inbox.freeze()))
    for name in ("syncs", "t_ns", "readings"):
        del tree[name]
    for name in ("encoder", "pressure", "valve"):
        del tree[name]["lag"]
    state = from_json(InboxState, json.dumps(tree))
    assert (state.syncs, state.t_ns, state.encoder.lag) == (0, 0, LagState())
    talk.inbox.thaw(state)
    assert all(m.fresh for m in talk.ticks(AGREE))
    assert talk.tick(("before", 1)).fresh == 0
    assert talk.right(talk.tick())


# --- in simulated time ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def information() -> ModuleType:
    spec = importlib.util.spec_from_file_location("information", HIL / "information.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["information"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("moving", [True, False], ids=["moving", "holding"])
@pytest.mark.parametrize(
    "row",
    [
        "late set, whole, 1 period, 1x", "late set, behind the next", "late set, together with the next",
        "late set, whole, encoder tells its age", "late encoder only", "late pressure only",
        "late valve status only", "late set 5x in a row", "late by 3 periods, 1x", "duplicated set",
        "set swapped with the next one", "order within the set reversed", "lost set 1x",
        "SYNC skipped by all nodes", "SYNC skipped by encoder", "3 SYNCs skipped by all nodes",
        "slip pressure only", "slip valve status only", "2 ticks skipped",
    ],
)  # fmt: skip
def test_bad_information_does_little(information: ModuleType, row: str, moving: bool) -> None:
    one = information.outcome(information.Case("virtual.toml", moving, row, 3))
    assert one.faults == ()
    assert one.change_v <= 0.5
    assert one.dev_m <= 3e-5


@pytest.mark.parametrize("row", ["slip: one period late for ever", "slip encoder only"])
def test_a_source_that_falls_behind_for_good_is_named_or_harmless(information: ModuleType, row: str) -> None:
    moving, holding = (
        information.outcome(information.Case("virtual.toml", how, row, 0)) for how in (True, False)
    )
    assert (moving.faults, moving.state) == (("encoder_late",), "fault")
    assert moving.dev_m <= 5e-5, "until then"
    assert (holding.faults, holding.state) == ((), "holding")
    assert holding.change_v <= 0.5


def test_a_run_with_late_frames_replays_from_any_snapshot(information: ModuleType) -> None:
    loaded = load("virtual.toml")
    how = backend_of(loaded)
    run = Simulation(loaded, 1.6, 0, how)

    def act(s: Any, i: int, role: str, frame: Frame) -> Any:
        if i % 50 in (7, 8):
            return information.late(s, 0, role, frame, at=information.SOON)
        return information.skipped(s, 0, role, frame, roles=information.ALL) if i % 50 == 30 else (frame,)

    run.node.hook = information.Stream(run, loaded, act, 700)
    again = Turn(how.axis(run.turn.axis.parameters), Inbox(loaded.codecs, loaded.config.bus), loaded.codecs)
    followed = 0
    for number, record in enumerate(run.records()):
        if number >= 900:
            again.open(record.frames[: record.before])
            again.begin(record.tick.t_ns)
            again.feed(record.frames[record.before :])
            m = record.tick.measurement
            assert repr(again.decide(m.skipped, m.host, record.tick.request)) == repr(record.tick)
            again.command(1, number)
            again.sent(record.sent[1].stamp_ns)
            followed += 1
        if (number >= 899 and number % 61 == 0) or number == 899:
            state = run.turn.freeze()
            again.thaw(
                from_json(type(state["axis"]), to_json(state["axis"])),
                from_json(InboxState, to_json(state["inbox"])),
            )
    assert followed > 600
    assert run.inbox.counts().late > 50


def test_the_simulation_leaves_over_what_comes_behind_the_set() -> None:
    loaded = load("virtual.toml")

    run = Simulation(loaded, 0.02, 0, requests={})

    def hook(frame: Frame, outgoing: bool) -> Sequence[Frame]:
        behind = Frame(frame.stamp_ns + 50_000, 0x123, b"")
        return (frame, behind) if outgoing and frame.can_id == loaded.codecs.valve_status.can_id else (frame,)

    run.node.hook = hook
    ticks = list(run.records())
    assert all(record.tick.measurement.fresh == ALL_SOURCES for record in ticks)
    assert all(record.frames[-1].can_id != 0x123 for record in ticks)
    assert all(record.frames[0].can_id == 0x123 and record.before == 1 for record in ticks[1:])


def test_the_table_is_printed(information: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert information.main(["--rows", "late encoder only", "--phases", "2", "--processes", "1"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("Moving:\ndisturbance")
    assert text.count("late encoder only") == 2
    assert information.main(["--rows", "encoder error bit 1x", "--phases", "1", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["moving"]
    assert (row["faults"], row["states"]) == ({"encoder_error": 1}, {"fault": 1})
    assert "encoder_error:1 → fault:1" in information.in_words(row)


@pytest.mark.slow
def test_every_row_of_the_table_can_be_played(information: ModuleType) -> None:
    rows = list(information.table("virtual.toml", "*", 1, 2))
    assert [part for part, _ in rows].count("moving") == len(information.ROWS)
    assert all(math.isfinite(row["err_um"]) for _, row in rows)
