"""No crash, no hang, no motion, one clear line: whatever frames, configurations, databases and logs say."""

from __future__ import annotations

import math
import random
import re
import signal
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import pytest

import fuzzing
from axis_rig import ARM, CLEAR, Rig, loaded
from commands import Figures, pneud_here
from pneud import resources
from pneud.bus.inbox import Inbox
from pneud.config.bus_tables import BusConfig
from pneud.safety.faults import F
from pneud.safety.supervisor import is_engaged
from pneud.signals import Frame, State

PATIENCE_S = 60
few = pytest.param(0.002, id="few")
many = pytest.param(0.05, id="many", marks=pytest.mark.slow)
all_of_them = pytest.param(1.0, id="all", marks=pytest.mark.soak)
share = pytest.mark.parametrize("part", [few, many, all_of_them])
MILLION = 1_000_000


@share
def test_frames_at_the_codecs(part: float, figures: Figures) -> None:
    codecs = loaded().codecs
    count = int(MILLION * part / 2)
    for sync in (True, False):
        inbox = Inbox(codecs, BusConfig(sync=sync))
        for n, (can_id, data) in enumerate(islice(fuzzing.frames(codecs, 1), count)):
            if n % 10 == 0:
                m = inbox.measurement(0, 0)
                inbox.begin(n * 1000)
                assert all(type(value) in (int, float) for value in m)
                # what is fresh is a value that a valid frame can carry
                assert not m.fresh or not any(math.isinf(value) for value in m[2:7])
            inbox.feed(Frame(n * 1000, can_id, data))
    figures(f"{2 * count} frames, all judged")


class Pestered(Rig):
    """A rig on whose bus someone sends what he likes, among the answers of the nodes."""

    def __init__(self, seed: int, at_once: int) -> None:
        super().__init__()
        self.sent = 0
        self._frames = fuzzing.frames(loaded().codecs, seed)
        self._at_once = at_once
        self.frame = self._among

    def _among(self, frame: Frame) -> Frame:
        for can_id, data in islice(self._frames, self._at_once):
            self.inbox.feed(Frame(frame.stamp_ns, can_id, data))
            self.sent += 1
        self.host |= self.inbox.conditions
        return frame


@share
def test_frames_at_a_disarmed_axis_move_nothing(part: float, figures: Figures) -> None:
    rig = Pestered(2, 10)
    while rig.sent < MILLION * part / 2:
        tick = rig.tick(CLEAR if rig.count % 50 == 0 else 0)
        assert not is_engaged(tick.state)
    assert rig.axis.failure is None
    figures(f"{rig.sent} frames in {rig.count} ticks, never engaged")


@share
def test_frames_at_an_armed_axis_make_it_centre(part: float, figures: Figures) -> None:
    sent = engaged = 0
    seed = 0
    while sent < MILLION * part / 2:
        rig = Pestered(seed, 0)
        rig.until(State.DISARMED)
        while rig.tick(ARM).state == State.DISARMED:
            assert rig.count < 300
        rig._at_once = 1 + seed % 5
        faults = 0
        for _ in range(40):
            tick = rig.tick()  # which checks that 0 V and Enable 0 leave where the axis is not engaged
            engaged += is_engaged(tick.state)
            assert math.isfinite(tick.command.voltage_v)
            assert faults == 0 or not is_engaged(tick.state), "what has centred stays centred"
            faults |= tick.latched if tick.state == State.FAULT else 0
        assert rig.axis.failure is None
        assert not faults >> F.INTERNAL & 1
        sent += rig.sent
        seed += 1
    assert engaged > seed
    figures(f"{sent} frames, {seed} times armed, engaged for {engaged} of {40 * seed} ticks")


def run_here(*args: object) -> int:
    """A verb on input that may be wrong: it does its work, or says in one line why not; its exit status."""
    with in_time():
        done = pneud_here(*args)
    assert done.returncode in (0, 1, 2), (done.returncode, done.stdout, done.stderr)
    if done.returncode == 2:
        assert done.stdout == ""
        assert done.stderr.count("\n") == 1, done.stderr
        assert len(done.stderr) < 1000
        assert re.match(r"pneud: \S", done.stderr), done.stderr
    return done.returncode


@contextmanager
def in_time() -> Iterator[None]:
    """What hangs fails."""

    def late(*_: object) -> None:
        raise TimeoutError(f"still at it after {PATIENCE_S} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(PATIENCE_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def in_words(codes: Counter[int]) -> str:
    return f"{codes[0] + codes[1]} done, {codes[2]} refused in one line"


@pytest.mark.parametrize(
    "count", [15, pytest.param(150, marks=pytest.mark.slow), pytest.param(5000, marks=pytest.mark.soak)]
)
def test_configurations_at_check(tmp_path: Path, count: int, figures: Figures) -> None:
    rng = random.Random(4)
    codes: Counter[int] = Counter()
    text = (resources.configs() / "virtual.toml").read_text()
    (tmp_path / "pneud.dbc").write_bytes((resources.configs() / "pneud.dbc").read_bytes())
    for n in range(count):
        file = tmp_path / f"{n}.toml"
        file.write_bytes(fuzzing.configuration(text, rng))
        codes[run_here("check", file)] += 1
        file.unlink()
    figures(f"{count} configurations: {in_words(codes)}")


@pytest.mark.parametrize(
    "count", [10, pytest.param(150, marks=pytest.mark.slow), pytest.param(5000, marks=pytest.mark.soak)]
)
def test_databases_at_check(tmp_path: Path, count: int, figures: Figures) -> None:
    rng = random.Random(5)
    codes: Counter[int] = Counter()
    text = (resources.configs() / "pneud.dbc").read_text()
    (tmp_path / "axis.toml").write_text((resources.configs() / "virtual.toml").read_text())
    for _ in range(count):
        (tmp_path / "pneud.dbc").write_bytes(fuzzing.database(text, rng))
        codes[run_here("check", tmp_path / "axis.toml")] += 1
    figures(f"{count} DBCs: {in_words(codes)}")


@pytest.fixture(scope="module")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    file = tmp_path_factory.mktemp("fuzz") / "short.mcap"
    assert pneud_here("sim", "virtual.toml", "--duration", 0.15, "-o", file).returncode in (0, 1)
    return file.read_bytes()


@pytest.mark.parametrize(
    "count", [6, pytest.param(60, marks=pytest.mark.slow), pytest.param(3000, marks=pytest.mark.soak)]
)
def test_logs_at_replay_and_recover(tmp_path: Path, short_log: bytes, count: int, figures: Figures) -> None:
    rng = random.Random(6)
    replayed, recovered, again = Counter[int](), Counter[int](), Counter[int]()
    for n in range(count):
        file, mended = tmp_path / f"{n}.mcap", tmp_path / f"{n}-mended.mcap"
        file.write_bytes(fuzzing.log(short_log, rng))
        replayed[run_here("replay", file)] += 1
        recovered[run_here("recover", file, "-o", mended)] += 1
        if mended.exists():
            again[run_here("replay", mended)] += 1
            mended.unlink()
        file.unlink()
    figures(
        f"{count} logs: replay {in_words(replayed)}; recover {in_words(recovered)};"
        f" replay of what it mended {in_words(again)}"
    )
