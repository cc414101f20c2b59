"""Simulation by many ticks at once: the same ticks, frames, events, states and figures, to the last bit."""

from __future__ import annotations

import itertools
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from pneud.bus.many import framed
from pneud.loading import Loaded, load
from pneud.log.files.naming import create_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import Detail
from pneud.log.format.rows import Rows
from pneud.replay import running, striding
from pneud.replay.lockstep import Simulation, backend_of, header_of
from pneud.replay.replaying import replay
from pneud.rig.sensors import Noise
from pneud.signals import Record, State
from pure2c import BuildError

NARROW = {"limits": {"tracking_error_m": 4e-5}}  # leaves it in the midst of its way
NOISY = {"plant": {"sensors": {"encoder_noise_m": 5e-7}}}


@pytest.fixture(autouse=True)
def _compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    monkeypatch.setattr(running, "WORTH_TICKS", 1)


def look(_: int, __: Record) -> None:
    """Who looks at each tick gets each tick."""


def logged(loaded: Loaded, path: Path, by_strides: bool, force_n: float, detail: Detail) -> tuple[Any, ...]:
    run = Simulation(loaded, 2.5, 1, backend_of(loaded))
    run.node.force_ext_n = force_n
    writer = LogWriter(create_log(path), header_of(loaded)._replace(detail=detail))
    tally = running.through(run, loaded.config.loop.rate_hz, writer, None if by_strides else look).tally
    assert writer.close()
    figures = tally.ticks, tally.state, tally.saturated, tally.ever_latched, tally.ever_present
    told = tally.tracking.tracking_mm(), tally.tracking.command_v(), tally.never_armed()
    return (
        *figures,
        *told,
        run.inbox.counts(),
        run.tx,
        writer.written,
        repr(run.turn.freeze()),
        run.node.truth(),
    )


def messages(path: Path) -> list[tuple[Any, ...]]:
    """All of them, as the `mcap` library reads them, with its checksums."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = reader.iter_messages(log_time_order=False)
        listed = [(c.topic, m.sequence, m.log_time, m.publish_time, m.data) for _, c, m in found]
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == len(listed)
    return listed


@pytest.mark.parametrize(
    ("config", "change", "force_n", "detail", "ends"),
    [
        ("virtual.toml", None, 0.0, "compact", State.TRACKING),
        pytest.param("virtual.toml", NOISY, 0.0, "full", State.TRACKING, marks=pytest.mark.slow),
        ("virtual.toml", NARROW, 100.0, "full", State.FAULT),
        pytest.param("paper-case2.toml", None, 0.0, "full", State.TRACKING, marks=pytest.mark.slow),
    ],
)
def test_a_log_by_strides_is_that_of_single_ticks(
    tmp_path: Path, config: str, change: dict[str, Any] | None, force_n: float, detail: Detail, ends: State
) -> None:
    loaded = load(config, None, change)
    one, other = tmp_path / "one.mcap", tmp_path / "other.mcap"
    strided = logged(loaded, one, True, force_n, detail)
    assert strided == logged(loaded, other, False, force_n, detail)
    assert strided[1] == ends
    assert [repr(tick) for tick in read_log(one)] == [repr(tick) for tick in read_log(other)]
    found, expected = messages(one), messages(other)
    for topic in {message[0] for message in expected}:
        if topic != "/can/frames":  # whose messages end where chunks do
            assert [m for m in found if m[0] == topic] == [m for m in expected if m[0] == topic]


def test_most_ticks_are_done_by_strides_and_replay(tmp_path: Path) -> None:
    loaded, path = load("virtual.toml"), tmp_path / "run.mcap"
    run = Simulation(loaded, 2.0, 1, backend_of(loaded))
    assert striding.fits(run)
    parts = list(striding.Striding(run, striding.strides(), 1000).go())
    strided = sum(len(rows.ticks) for rows in parts if isinstance(rows, Rows))
    assert strided > 0.9 * run.count
    logged(loaded, path, True, 0.0, "full")
    outcome = replay(read_log(path))
    assert outcome.identical and outcome.engaged_ticks > 1000


def test_a_stride_that_is_refused_is_not_tried_again_in_the_next_tick() -> None:
    loaded = load("virtual.toml")
    run = Simulation(loaded, 0.5, 1, backend_of(loaded))
    tried: list[int] = []

    def refusing(_: Any, __: Any, between: Any, *___: Any) -> tuple[Any, int]:
        tried.append(run.count)
        return between, 0

    parts = list(striding.Striding(run, refusing, 1000).go())
    assert len(parts) == run.count and all(isinstance(part, Record) for part in parts)
    waited = [after - before for before, after in itertools.pairwise(tried)]
    assert len(waited) >= 3
    assert all(ticks >= 2 ** (i + 1) * striding.FEWEST for i, ticks in enumerate(waited))


def test_whoever_has_a_part_in_each_tick_is_asked_in_each(tmp_path: Path) -> None:
    loaded = load("virtual.toml")
    asked = Simulation(loaded, 1.0, operator=lambda _, __: None)
    assert not striding.fits(asked)
    hooked = Simulation(loaded, 1.0)
    hooked.node.hook = lambda frame, _: (frame,)
    assert not striding.fits(hooked)
    assert striding.by_strides(hooked, 1000.0) is None


def test_without_a_compiler_each_tick_is_done_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> striding.Series:
        raise BuildError("no compiler")

    monkeypatch.setattr(striding, "strides", none)
    loaded = load("virtual.toml")
    told: list[int] = []
    run = Simulation(loaded, 0.2, 1, backend_of(loaded))
    assert running.through(run, 1000.0, None, None, told.append).tally.ticks == 200
    assert told[:3] == [0, 100, 200]


@settings(max_examples=5)
@given(st.integers(0, 2**70), st.integers(0, 700), st.integers(1, 60))
def test_many_draws_are_those_that_come_one_after_another(seed: int, before: int, count: int) -> None:
    one, other = Noise(seed), Noise(seed)
    for noise in (one, other):
        for _ in range(before):
            noise.draw()
    state = one.state()
    expected = [other.draw() for _ in range(count)]
    assert one.draw_many(count).tolist() == expected
    assert one.draw() == other.draw()
    one.restore(state)
    assert [one.draw() for _ in range(count)] == expected


@pytest.mark.parametrize("config", ["virtual.toml", "canopen.toml"])
def test_frames_by_the_thousand_are_those_that_are_encoded_singly(config: str) -> None:
    codecs, uniform = load(config).codecs, random.Random(1).randint
    for codec in (codecs.valve_command, *(answer.codec for answer in codecs.answers)):
        if not codec.fields or codec.guard.judged == "call":
            continue
        raws = [
            None if f is None else [uniform(int(f.low), int(f.high)) for _ in range(50)] for f in codec.fields
        ]
        counters = [uniform(0, 1000) for _ in range(50)]
        rows = framed(codec, [raw if raw is None else np.array(raw) for raw in raws], np.array(counters))
        for i, counter in enumerate(counters):
            values = [
                0 if f is None or raw is None else raw[i] if f.integer else f.si(raw[i])
                for f, raw in zip(codec.fields, raws, strict=True)
            ]
            single = codec.encode(*values, counter=counter % codec.counter_values)
            assert rows[i].tobytes() == single
