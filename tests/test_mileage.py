"""What an axis does in its life: how it is counted, where it is kept, and that no end of a run loses it."""

from __future__ import annotations

import json
import math
import os
import secrets
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from axis_rig import loaded, ready, tracking
from commands import PNEUD, Figures, children, eventually, pneud_here
from pneud.axis.mileage import LONGEST_NS, LOOK_NS, TURN_M, Odometer, count
from pneud.axis.sensing import NO_ESTIMATE
from pneud.config import conversions
from pneud.console.client import Client
from pneud.log.files.naming import mileage_file
from pneud.log.files.reader import LoggedState, read_log
from pneud.log.live.mileage import (
    WRITE_S,
    DamagedError,
    MileageFile,
    _check,
    as_text,
    from_text,
    total,
    whole_life,
)
from pneud.log.live.ring import Kept, Ring, Since
from pneud.physics.gas import signed_flow
from pneud.physics.ratings import DENSITY_ANR_KG_M3
from pneud.replay.mileage import done_before, done_by
from pneud.replay.motions import motions
from pneud.signals import Estimate, Measurement, Mileage
from pneud.view.mileage import in_words, whence
from running import serves
from test_screen_snapshots import FULL, show, text_of
from test_screen_snapshots import tracking as swinging

LAW = conversions.axis_of(loaded().config, loaded().codecs.command_lsb_v).controller
AT_REST = NO_ESTIMATE._replace(position_m=0.3, velocity_m_s=0.0, opening_v=0.0)
SUPPLIED = Measurement(0, 7, 0.3, 3e5, 4e5, 6e5, 0.0, 1, 2, *[0] * 9)


def look(o: Odometer, e: Estimate, m: Measurement = SUPPLIED, *, after_ns: int = LOOK_NS, known: bool = True,
         settled: bool = True, engaged: bool = True) -> Odometer:  # fmt: skip
    return count(o, o.looked_ns + after_ns, e, m, known, settled, engaged, LAW)


def through(*positions: float, o: Odometer | None = None) -> Odometer:
    for x in positions:
        o = look(o or Odometer(), AT_REST._replace(position_m=x))
    assert o is not None
    return o


def test_to_and_fro_are_metres_and_turns_are_strokes() -> None:
    found = through(0.1, 0.2, 0.4, 0.3, 0.1, 0.15, 0.5).done
    assert found.strokes == 2
    assert found.travel_m == pytest.approx(0.3 + 0.3 + 0.4)


@given(st.lists(st.floats(0.0, 1.0), min_size=2, max_size=40))
@settings(max_examples=50)
def test_metres_are_never_more_than_the_way_nor_less_than_what_turns_hide(positions: list[float]) -> None:
    way_m = sum(abs(b - a) for a, b in pairwise(positions))
    found = through(*positions).done
    assert way_m - TURN_M * len(positions) - 1e-9 <= found.travel_m <= way_m + 1e-9
    assert 0 <= found.strokes < len(positions)


@given(st.lists(st.floats(-0.45 * TURN_M, 0.45 * TURN_M), max_size=60))
@settings(max_examples=30)
def test_noise_makes_neither_metres_nor_strokes(noise: list[float]) -> None:
    assert through(0.3, *(0.3 + n for n in noise)).done == through(0.3, *[0.3] * len(noise)).done
    moved = through(0.2, 0.3, *(0.3 + n for n in noise)).done
    assert moved.strokes == 0
    assert moved.travel_m == pytest.approx(0.1, abs=TURN_M)


def test_where_the_load_is_not_known_it_goes_nowhere() -> None:
    o = through(0.1, 0.2)
    lost = look(o, NO_ESTIMATE, known=False)
    assert lost.done.travel_m == o.done.travel_m
    back = through(0.7, o=lost)
    assert back.done.travel_m == o.done.travel_m
    assert through(0.8, o=back).done.travel_m == pytest.approx(0.2)


def test_a_stop_is_as_hard_as_its_deceleration() -> None:
    o = look(Odometer(), AT_REST._replace(velocity_m_s=-0.8))
    o = look(o, AT_REST._replace(velocity_m_s=-0.4))
    assert o.done.hardest_stop_m_s2 == pytest.approx(0.4 / (LOOK_NS * 1e-9))
    for quicker in (
        look(o, AT_REST),
        look(o, AT_REST._replace(velocity_m_s=0.4)),  # it has bounced: nothing is known of the stop
        look(o, AT_REST._replace(velocity_m_s=-2.0)),
    ):
        assert quicker.done.hardest_stop_m_s2 == pytest.approx(o.done.hardest_stop_m_s2)


@pytest.mark.parametrize(
    "how",
    [{"settled": False}, {"after_ns": LONGEST_NS + 1}, {"known": False}],
    ids=lambda how: next(iter(how)),
)
def test_a_speed_that_is_not_believed_makes_no_stop(how: dict[str, int]) -> None:
    fast = look(Odometer(), AT_REST._replace(velocity_m_s=2.0))
    assert look(fast, AT_REST, **how).done.hardest_stop_m_s2 == 0.0  # type: ignore[arg-type]


def test_only_an_engaged_axis_counts_hours_and_a_gap_counts_little() -> None:
    idle = look(Odometer(), AT_REST, engaged=False)
    assert idle.done.engaged_s == 0.0
    assert look(idle, AT_REST).done.engaged_s == pytest.approx(LOOK_NS * 1e-9)
    assert look(idle, AT_REST, after_ns=10**12).done.engaged_s == pytest.approx(LONGEST_NS * 1e-9)


@pytest.mark.parametrize(("opening_v", "filled_pa"), [(2.0, SUPPLIED.p1_pa), (-1.0, SUPPLIED.p2_pa)])
def test_air_is_what_the_open_valve_lets_in(opening_v: float, filled_pa: float) -> None:
    g, c = LAW.gas, LAW.cylinder
    flow_pa = signed_flow(SUPPLIED.supply_pa, filled_pa, g)
    m3_s = abs(opening_v) * c.c1 * flow_pa / (g.k * g.R * g.temperature_k) / DENSITY_ANR_KG_M3
    o = look(through(0.3), AT_REST._replace(opening_v=opening_v))
    assert o.done.air_m3 == pytest.approx(m3_s * LOOK_NS * 1e-9)
    assert look(o, AT_REST).done.air_m3 == o.done.air_m3
    starved = SUPPLIED._replace(supply_pa=1e5)  # air that flows back is none that was saved
    assert look(o, AT_REST._replace(opening_v=opening_v), starved).done.air_m3 == o.done.air_m3


def test_an_axis_that_tracks_has_done_what_its_reference_asked_for() -> None:
    rig = tracking()
    begun = rig.axis.mileage
    way_m, last = 0.0, rig.tick().estimate.position_m
    for tick in rig.ticks(400):
        way_m, last = way_m + abs(tick.estimate.position_m - last), tick.estimate.position_m
    done = rig.axis.mileage
    assert done.travel_m - begun.travel_m == pytest.approx(way_m, rel=0.05)
    assert done.engaged_s - begun.engaged_s == pytest.approx(0.4, abs=0.01)
    assert done.air_m3 > begun.air_m3
    assert rig.axis.state.odometer.done == done


def test_an_axis_that_only_stands_has_done_nothing() -> None:
    rig = ready()
    rig.ticks(200)
    done = rig.axis.mileage
    assert (done.strokes, done.travel_m, done.engaged_s) == (0, 0.0, 0.0)


def test_no_look_is_due_before_its_time() -> None:
    rig = ready()
    looked = {rig.axis.state.odometer.looked_ns for _ in range(160) if rig.tick()}
    assert 18 <= len(looked) <= 21  # in 160 ms


@pytest.mark.slow
def test_a_log_and_its_report_tell_what_was_done(tmp_path: Path) -> None:
    log, page = tmp_path / "run.mcap", tmp_path / "run.html"
    assert pneud_here("sim", "virtual.toml", "--duration", 6, "-o", log).returncode == 0
    (*_, last) = (found for raw in read_log(log).raw() if isinstance(raw, LoggedState)
                  and (found := done_by(raw)) is not None)  # fmt: skip
    told = sum(m.air_anr_m3 for m in motions(read_log(log)))
    assert last.air_m3 == pytest.approx(told, rel=0.05)
    assert last.strokes > 3
    assert done_before(read_log(log)) is None
    assert pneud_here("report", log, "-o", page).returncode == 0
    assert f"strokes {last.strokes}, travel {last.travel_m:.1f} m" in page.read_text()


# the file


counters = st.builds(
    Mileage,
    st.integers(0, 2**53),
    *[st.floats(0.0, 1e12) for _ in range(4)],
)  # fmt: skip


@given(counters, st.integers(1, 2**32))
@settings(max_examples=30)
def test_what_is_kept_comes_back_to_the_bit(done: Mileage, since_s: int) -> None:
    assert from_text(as_text("press", done, since_s)) == (done, float(since_s))


@given(counters, counters, counters)
@settings(max_examples=20)
def test_runs_add_up_in_any_order_but_for_rounding(a: Mileage, b: Mileage, c: Mileage) -> None:
    assert total(total(a, b), c) == pytest.approx(total(a, total(b, c)))
    assert total(Mileage(), a) == a


@given(st.data())
@settings(max_examples=60)
def test_a_file_with_another_character_is_damaged(data: st.DataObject) -> None:
    text = as_text("press", Mileage(12, 3.5, 0.25, 60.0, 1.5), 1_700_000_000)
    at = data.draw(st.integers(0, len(text) - 2))
    other = data.draw(st.characters(codec="ascii").filter(lambda c: c != text[at]))
    try:
        found = from_text(text[:at] + other + text[at + 1 :])
    except DamagedError:
        return
    assert found == from_text(text), "white space does not matter"


@pytest.mark.parametrize("text", ["", "[]", "{", "\ufffd", '{"schema": 2}', '{"schema": 1}', "[" * 100_000])
def test_what_is_no_file_of_counters_is_damaged(text: str) -> None:
    with pytest.raises(DamagedError):
        from_text(text)


@pytest.mark.parametrize(
    "field", [{"strokes": -1}, {"travel_m": True}, {"air_m3": "1"}, {"since": "x"}, {"engaged_s": math.inf}]
)
def test_numbers_that_cannot_be_are_damaged_whatever_their_checksum(field: dict[str, object]) -> None:
    fields = json.loads(as_text("press", Mileage(), 1))
    del fields["check"]
    fields |= field
    with pytest.raises(DamagedError):
        from_text(json.dumps({**fields, "check": _check(fields)}))


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class Keeper:
    """A file with a clock of its own, and what it has said."""

    def __init__(self, path: Path) -> None:
        self.clock = Clock()
        self.said: list[str] = []
        self.path = path
        self.file = MileageFile(path, "press", self.said.append, self.clock)

    def attend(self, done: Mileage, after_s: float = WRITE_S + 0.1) -> None:
        self.clock.now_s += after_s
        self.file.attend(done)
        if self.file._writing is not None:
            self.file._writing.join()

    @property
    def kept(self) -> Kept:
        return Kept(self.file.since.kept)

    def read(self) -> Mileage:
        return from_text(self.path.read_text())[0]


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "state" / "press.mileage.json"


FIRST, SECOND = Mileage(10, 2.0, 0.01, 30.0, 9.0), Mileage(5, 1.0, 0.02, 10.0, 4.0)


def test_counting_goes_on_from_run_to_run(place: Path) -> None:
    first = Keeper(place)
    assert first.file.since.before == Mileage()
    first.file.close(FIRST)
    second = Keeper(place)
    assert (second.file.since.before, second.kept) == (FIRST, Kept.KEPT)
    second.file.close(SECOND)
    assert second.read() == total(FIRST, SECOND) == Mileage(15, 3.0, 0.03, 40.0, 9.0)
    assert Keeper(place).file.since.since_s == first.file.since.since_s
    assert not [*first.said, *second.said]


def test_a_keeper_that_is_killed_loses_what_came_behind_the_last_writing(place: Path) -> None:
    keeper = Keeper(place)
    keeper.attend(FIRST)
    keeper.attend(SECOND, after_s=0.5 * WRITE_S)
    assert keeper.read() == FIRST
    keeper.attend(SECOND)
    assert keeper.read() == SECOND


def test_nothing_is_written_where_nothing_has_been_done(place: Path) -> None:
    keeper = Keeper(place)
    keeper.attend(Mileage())
    keeper.file.close(Mileage())
    assert not place.exists()


def test_a_damaged_file_is_put_aside_and_told_of_in_one_line(place: Path) -> None:
    Keeper(place).file.close(FIRST)
    for number in (1, 2):
        place.write_bytes(place.read_bytes().replace(b"10", b"99", 1) if number == 1 else b"\xff\0")
        bad = place.read_bytes()
        keeper = Keeper(place)
        assert keeper.file.since.before == Mileage()
        (line,) = keeper.said
        assert f"{place.name}.damaged{number}" in line
        assert "\n" not in line
        assert place.with_name(f"{place.name}.damaged{number}").read_bytes() == bad
        keeper.file.close(SECOND)
        assert keeper.read() == SECOND


def test_of_two_daemons_one_counts_on_and_the_other_when_that_has_gone(place: Path) -> None:
    one, other = Keeper(place), Keeper(place)
    assert (one.kept, other.kept) == (Kept.KEPT, Kept.ELSEWHERE)
    other.attend(SECOND)
    assert not place.exists()
    one.file.close(FIRST)
    other.attend(SECOND)
    assert (other.kept, other.file.since.before) == (Kept.KEPT, FIRST)
    other.file.close(SECOND)
    assert other.read() == total(FIRST, SECOND)


def test_a_disk_that_takes_nothing_is_told_of_once_and_tried_again(place: Path) -> None:
    keeper = Keeper(place)
    keeper.attend(FIRST)
    aside = place.parent.with_name("gone")
    place.parent.rename(aside)
    for _ in range(3):
        keeper.attend(SECOND)
    assert keeper.kept == Kept.FAILING
    assert len(keeper.said) == 1
    aside.rename(place.parent)
    keeper.attend(SECOND)
    keeper.attend(SECOND)
    assert (keeper.kept, keeper.read(), len(keeper.said)) == (Kept.KEPT, SECOND, 2)


def test_a_folder_that_cannot_be_made_is_told_of(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    keeper = Keeper(tmp_path / "file" / "press.mileage.json")
    keeper.attend(FIRST)
    keeper.attend(FIRST)
    assert keeper.kept == Kept.FAILING
    assert len(keeper.said) == 1
    keeper.file.close(FIRST)


def test_it_is_kept_where_logs_are_by_default(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    assert mileage_file("/elsewhere", "my press", airless=False) == tmp_path / "my-press.mileage.json"
    assert mileage_file(None, "press", airless=True) == tmp_path / "press.airless.mileage.json"
    assert mileage_file("/elsewhere", "press", airless=True) is None


def test_the_ring_carries_it_from_the_loop_and_from_the_recorder() -> None:
    ring = Ring.create(slots=16)
    assert (ring.mileage, ring.since()) == (Mileage(), Since(Mileage(), 0.0, Kept.NO))
    ring.set_mileage(SECOND)
    ring.set_since(Since(FIRST, 1_700_000_000.0, Kept.KEPT))
    assert (ring.mileage, ring.since().before) == (SECOND, FIRST)
    assert whole_life(ring.mileage, ring.since()) == {
        "strokes": 15,
        "travel_m": 3.0,
        "air_normal_l": 30.0,
        "engaged_h": pytest.approx(40.0 / 3600.0, abs=1e-6),
        "hardest_stop_m_s2": 9.0,
        "since": "2023-11-14T22:13:20Z",
        "kept": "kept",
    }


# daemons


@contextmanager
def counting(folder: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A virtual run that keeps what it does in a folder, and its socket."""
    socket = Path(f"/tmp/pneud-mileage-{os.getpid()}-{secrets.token_hex(3)}.sock")
    environment = {**os.environ, "STATE_DIRECTORY": str(folder)}
    command = [*PNEUD, "--virtual", "--headless", "--json", "--socket", str(socket), *options]
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        eventually(lambda: serves(str(socket)))
        yield process, str(socket)
    finally:
        process.kill()
        process.communicate()
        for file in (socket, socket.with_name(f"{socket.name}.lock")):
            file.unlink(missing_ok=True)


def told(socket: str) -> dict[str, Any]:
    with Client(socket) as client:
        found: dict[str, Any] = client.ask("status")["mileage"]
        return found


def kept(folder: Path) -> Mileage:
    return from_text((folder / "virtual.airless.mileage.json").read_text())[0]


@pytest.mark.slow
@pytest.mark.realtime
def test_neither_an_end_nor_a_kill_loses_what_an_axis_has_done(tmp_path: Path, figures: Figures) -> None:
    with counting(tmp_path) as (process, socket):
        eventually(lambda: told(socket)["travel_m"] > 0.2)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)
    first = kept(tmp_path)
    assert first.travel_m > 0.2
    with counting(tmp_path) as (process, socket):
        eventually(lambda: told(socket)["travel_m"] > first.travel_m + 0.2)
        before = told(socket)
        assert before["kept"] == "kept"
        process.kill()  # the loop alone: the recorder has what it had said half a second before, at most
        eventually(lambda: kept(tmp_path).travel_m >= before["travel_m"] - 5e-4)  # which is rounded
    second = kept(tmp_path)
    with counting(tmp_path) as (process, socket):
        eventually(lambda: kept(tmp_path).engaged_s > second.engaged_s)
        (recorder, *_) = children(process.pid)
        seen = told(socket)
        for pid in (recorder, process.pid):
            os.kill(pid, signal.SIGKILL)
    third, lost_s = kept(tmp_path), seen["engaged_h"] * 3600.0 - kept(tmp_path).engaged_s
    figures(f"a kill of loop and recorder at once has lost {lost_s:.1f} s")
    assert second.engaged_s < third.engaged_s
    assert lost_s < WRITE_S + 3.0
    (log, *_) = sorted(tmp_path.glob("*.mcap"))[1:]
    (before_it, since) = done_before(read_log(log)) or (None, "")
    assert before_it == first
    assert since.startswith("20")


# in words


def test_a_person_reads_it_in_units_that_suit_it() -> None:
    little = whole_life(Mileage(7, 12.34, 0.0056, 90.0, 1.2345), Since(Mileage(), 0.0, Kept.NO))
    much = whole_life(Mileage(), Since(Mileage(1_234_567, 4.56e6, 789.0, 3.6e6, 61.0), 1e9, Kept.KEPT))
    assert in_words(little) == "strokes 7, travel 12.3 m, air 5.6 l, engaged 1.5 min, hardest stop 1.23 m/s²"
    assert in_words(much) == (
        "strokes 1,234,567, travel 4,560.0 km, air 789.0 m³, engaged 1,000.0 h, hardest stop 61 m/s²"
    )
    assert [whence(little), whence(much)] == ["in this run", "since 2001-09-09"]
    assert "not kept" in whence({**much, "kept": "failing"})
    assert "another daemon" in whence({**much, "kept": "elsewhere"})


@pytest.mark.parametrize(("strokes", "words"), [(1234, "1,234 strokes, 4.6 km"), (10**9, " 4.6 km")])
def test_the_screen_has_a_row_of_it_and_a_few_words_where_there_is_little_room(
    strokes: int, words: str
) -> None:
    done = whole_life(Mileage(strokes, 4567.0, 0.5, 7200.0, 9.0), Since(Mileage(), 0.0, Kept.KEPT))
    shown = show(swinging(), FULL._replace(mileage=done))
    assert any(line.endswith(words) for line in text_of(shown, (80, 24)).splitlines())
    row = next(line for line in text_of(shown, (120, 40)).splitlines() if line.startswith("done"))
    assert f"strokes {strokes:,}  travel 4.6 km  air 500.0 l  engaged 2.0 h  hardest stop 9 m/s²" in row
