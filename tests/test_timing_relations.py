"""What must hold between the times in a log of a real run, whatever the machine's speed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from commands import pneud
from pneud.bus.inbox import NEVER_NS
from pneud.loading import codecs_of, load
from pneud.log.files.columns import AFTER, BEFORE, SENT, Block, blocks
from pneud.log.files.reader import read_log
from pneud.report.gather import gather
from pneud.signals import ALL_SOURCES

pytestmark = [pytest.mark.slow, pytest.mark.realtime]

PERIOD_NS = 1_000_000
CLOCKS_NS = 100_000  # kernel stamps and the loop's clock agree to so much


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    log = tmp_path_factory.mktemp("logs") / "run.mcap"
    done = pneud("--virtual", "--headless", "--json", "--duration", 4, "--log", log)
    assert log.exists(), done.stderr
    return log


@pytest.fixture(scope="module")
def run(path: Path) -> Block:
    (block,) = blocks(read_log(path), 100_000)
    return block


def test_one_sync_and_one_command_a_tick(run: Block) -> None:
    codecs = load("virtual.toml").codecs
    sent = run.frames.part == SENT
    for can_id in (codecs.sync.can_id, codecs.valve_command.can_id):
        ticks = run.frames.tick[sent & (run.frames.can_id == can_id)]
        assert np.array_equal(ticks, np.arange(len(run.number)))
    assert np.array_equal(run.number, np.arange(1, len(run.number) + 1))


def test_a_command_answers_this_ticks_sync(path: Path) -> None:
    log = read_log(path)
    codecs = codecs_of(load("virtual.toml").config.bus, log.dbc_name, log.dbc)
    for tick in log:
        sync, command = tick.sent
        assert codecs.valve_command.decode(command.data)[2] == codecs.sync.counter(sync.data)
        assert tick.t_ns <= sync.stamp_ns <= command.stamp_ns


def test_ages_are_bounded_by_the_tick(run: Block) -> None:
    """A fresh value was sampled within this tick: after its SYNC, and it came before the set was taken."""
    ticks = run.ticks
    taken_ns = run.ticks["timing.set_ns"]
    fresh = ticks["measurement.fresh"]
    for bit, name in ((1, "encoder"), (2, "pressure"), (4, "valve")):
        age = ticks[f"measurement.{name}_age_ns"]
        is_fresh = fresh & bit != 0
        assert (age[is_fresh] == 0).all()
        assert (age[~is_fresh] > 0).all()
        known = ~is_fresh & (age < NEVER_NS)
        # what is not fresh is at least as old as this tick's distance to the last one
        since = np.diff(ticks["t_ns"], prepend=ticks["t_ns"][0])
        assert (age[known] >= since[known] - taken_ns[np.maximum(np.flatnonzero(known) - 1, 0)]).all()
    frames = run.frames
    after = frames.part == AFTER
    behind = frames.stamp_ns[after] - ticks["t_ns"][frames.tick[after]]
    assert (behind <= taken_ns[frames.tick[after]] + CLOCKS_NS).all()
    before = frames.part == BEFORE
    assert (frames.stamp_ns[before] <= ticks["t_ns"][frames.tick[before]] + CLOCKS_NS).all()


def test_the_phase_is_kept_across_skips(run: Block) -> None:
    """Wake-ups minus their lateness lie on one grid, also behind ticks that were skipped."""
    skipped = run.ticks["measurement.skipped"].astype(np.int64)
    lateness = run.ticks["timing.lateness_ns"]
    grid = np.cumsum(1 + skipped) - 1 - skipped[0]
    # the tick begins somewhat after the wake-up, for which SYNC stands
    off = run.ticks["t_ns"] - (lateness - skipped * PERIOD_NS) - grid * PERIOD_NS
    # what comes between wake-up and SYNC takes time, and never takes the grid along
    assert off.min() >= off[0] - PERIOD_NS
    assert np.median(np.abs(off - np.median(off))) < 0.5 * PERIOD_NS
    first, last = np.median(off[: len(off) // 4]), np.median(off[-len(off) // 4 :])
    assert abs(last - first) < 0.1 * PERIOD_NS


def test_figures_of_a_report_agree_with_each_other(path: Path, run: Block) -> None:
    seen = gather(read_log(path))
    complete = int((run.ticks["measurement.fresh"] == ALL_SOURCES).sum())
    latency = seen.timing["latency_ns"]
    assert complete <= latency.count <= seen.ticks
    for source in seen.health.sources:
        assert source.answer.count <= source.frames
        # the answer comes before the command that it leads to
        assert source.answer.percentile_ns(50) < seen.timing["set_ns"].percentile_ns(99.9)
        assert source.age.percentile_ns(50) >= latency.percentile_ns(0)
    jitter = seen.health.sync_jitter
    assert jitter.count == seen.ticks - 1
    assert jitter.percentile_ns(50) < 0.5 * PERIOD_NS


def test_a_replay_tells_the_timing_of_its_run(path: Path) -> None:
    done = pneud("replay", path)
    assert done.returncode == 0, done.stderr
    assert "wake-up lateness" in done.stdout
    assert "jitter of SYNC" in done.stdout
    assert "age of frames" in done.stdout
