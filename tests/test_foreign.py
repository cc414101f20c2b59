"""The foreign node: its frames are those of its DBC, and an axis tracks on it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from foreign import Piped, axis, built
from pneud.bus.codec import Codecs
from pneud.loading import load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.signals import Frame, State, ValveState

MS = 1_000_000
SYNC = 0x080


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("foreign"))


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return axis(tmp_path_factory.mktemp("axis"), "virtual.toml")


@pytest.fixture(scope="module")
def codecs(config: Path) -> Codecs:
    return load(config).codecs


@pytest.fixture
def piped(node: Path) -> Iterator[Piped]:
    with Piped(node) as found:
        yield found


def told(piped: Piped, codecs: Codecs, t_ns: int, volts: float, enable: int, counter: int) -> None:
    command = codecs.valve_command
    data = command.encode(volts, enable, 1, counter=counter % command.counter_values)
    piped.tell(Frame(t_ns, command.can_id, data))


def test_its_answers_are_those_of_the_dbc(piped: Piped, codecs: Codecs) -> None:
    three = (codecs.encoder, codecs.pressure, codecs.valve_status)
    for n in range(300):  # counters wrap
        answers = piped.tell(Frame((n + 1) * MS, SYNC, b""), 3)
        assert [frame.can_id for frame in answers] == [codec.can_id for codec in three]
        for codec, frame in zip(three, answers, strict=True):
            assert codec.check(frame.data) == n % codec.counter_values
    position_m, status, _ = codecs.encoder.decode(answers[0].data)
    assert (position_m, status) == (pytest.approx(0.45, abs=0.01), 1)
    p1_pa, _, supply_pa = codecs.pressure.decode(answers[1].data)
    assert supply_pa == pytest.approx(6e5) and 1e5 < p1_pa < 6e5
    assert codecs.valve_status.decode(answers[2].data) == (0.0, ValveState.CENTRED)


def test_setpoints_move_it_and_its_valve_closes_without_them(piped: Piped, codecs: Codecs) -> None:
    def state(t_ms: int) -> tuple[float, float, int]:
        answers = piped.tell(Frame(t_ms * MS, SYNC, b""), 3)
        applied_v, mode = codecs.valve_status.decode(answers[2].data)
        return codecs.encoder.decode(answers[0].data)[0], applied_v, mode

    state(1)
    told(piped, codecs, 2 * MS, 0.0, 0, 0)
    begin, _, _ = state(3)
    for n in range(1, 100):
        told(piped, codecs, (3 + n) * MS, 1.5, 1, n)
    moved, applied_v, mode = state(103)
    assert (applied_v, mode) == (1.5, ValveState.ENABLED) and moved > begin + 0.005
    wrong = bytearray(codecs.valve_command.encode(-1.5, 1, 1, counter=9))
    wrong[4] ^= 1
    piped.tell(Frame(104 * MS, codecs.valve_command.can_id, bytes(wrong)))
    assert state(105)[1] == 1.5, "one wrong bit changes nothing"
    assert state(200)[1:] == (0.0, ValveState.TIMED_OUT)
    told(piped, codecs, 201 * MS, 1.5, 1, 10)
    assert state(202)[2] == ValveState.TIMED_OUT, "enable alone does not help"
    told(piped, codecs, 203 * MS, 0.0, 0, 11)
    assert state(204)[2] == ValveState.CENTRED


class At(NamedTuple):
    """Where the load is, as a simulation asks for it."""

    position_m: float


class Node:
    """The node in the place of a simulation's plant: an answer is there 300 µs after its SYNC."""

    def __init__(self, piped: Piped, codecs: Codecs) -> None:
        self._piped, self._codecs, self._answers = piped, codecs, list[Frame]()
        self._at = At(0.0)

    def on_frame(self, frame: Frame) -> None:
        answers = self._piped.tell(frame, 3 if frame.can_id == SYNC else 0)
        self._answers += [answer._replace(stamp_ns=frame.stamp_ns + 300_000) for answer in answers]
        if answers:
            self._at = At(self._codecs.encoder.decode(answers[0].data)[0])

    def poll(self, t_ns: int) -> list[Frame]:
        due = [frame for frame in self._answers if frame.stamp_ns <= t_ns]
        self._answers = self._answers[len(due) :]
        return due

    def truth(self) -> At:
        return self._at


@pytest.mark.slow
def test_an_axis_arms_and_tracks_on_it(piped: Piped, config: Path) -> None:
    loaded = load(config)
    simulation = Simulation(loaded, 9.0, how=backend_of(loaded))
    simulation.node = Node(piped, loaded.codecs)  # type: ignore[assignment]
    records = list(simulation.records())
    assert not any(record.tick.latched for record in records)
    tracked = [r for r in records if r.tick.state == State.TRACKING][-4000:]
    off_mm = [1e3 * (r.tick.reference.position_m - r.truth_m) for r in tracked]
    rms_mm = math.sqrt(sum(e * e for e in off_mm) / len(off_mm))
    print(f"{rms_mm:.4f} mm RMS, {max(map(abs, off_mm)):.4f} mm at most")
    assert rms_mm < 0.1
    counts = simulation.inbox.counts()
    assert (counts.lost, counts.crc, counts.stale, counts.late) == (0, 0, 0, 0)
