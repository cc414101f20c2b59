"""The beat of a sensor that runs free, found through frames that come late by chance."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from pathlib import Path

import pytest
from hil.device_sets import device_sets
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import pneud_here
from pneud.bus.cadence import Cadence, CadenceState, heard
from pneud.loading import load
from pneud.loop.phase import BEHIND, MOST, Phase
from pneud.replay.lockstep import Simulation, backend_of

MS = 1_000_000


def late(
    seed: int, period_ns: float, mean_ns: float, samples: int, lost: float = 0.0
) -> Iterator[tuple[int, int]]:
    """Instants of samples, and when they come; one that is overtaken by the next is never sent."""
    chance = random.Random(seed)
    for n in range(samples):
        sampled_ns = 7_000_000_000 + round(n * period_ns)
        delay_ns = min(0.8 * period_ns, chance.expovariate(1.0 / mean_ns)) if mean_ns else 0.0
        if chance.random() >= lost:
            yield sampled_ns, sampled_ns + round(delay_ns)


@given(
    st.integers(0, 1 << 32),
    st.floats(0.999, 1.001),
    st.floats(0.0, 0.1),
    st.sampled_from([0.0, 0.1]),
)
@settings(max_examples=15)
def test_the_beat_is_found_within_a_small_part_of_the_delay(
    seed: int, part: float, share: float, lost: float
) -> None:
    beat, errors = Cadence(5.0 * MS), list[int]()
    for n, (sampled_ns, came_ns) in enumerate(late(seed, part * 5.0 * MS, share * 5.0 * MS, 1500, lost)):
        found_ns = beat.instant(came_ns)
        if n > 900:
            errors.append(found_ns - sampled_ns)
    assert max(map(abs, errors)) < 20_000 + 0.25 * share * 5.0 * MS
    assert abs(sum(errors)) / len(errors) < 5_000 + 0.05 * share * 5.0 * MS


@given(st.lists(st.integers(0, 400 * MS), max_size=60), st.integers(0, 1 << 40))
@settings(max_examples=40)
def test_no_sample_is_later_than_its_frame_and_none_is_out_of_all_proportion(
    apart: list[int], start_ns: int
) -> None:
    state, came_ns = CadenceState(), start_ns
    for step_ns in apart:
        came_ns += step_ns
        state = heard(state, came_ns, 1.0 * MS)
        assert came_ns - MS <= state.beat_ns <= came_ns
        assert 0.998 * MS <= state.period_ns <= 1.002 * MS


def test_without_delay_the_stamp_is_the_instant() -> None:
    beat = Cadence(2.0 * MS)
    assert all(beat.instant(came) == came for _, came in late(1, 2.0 * MS, 0.0, 300))


def test_after_a_silence_or_a_step_of_the_clock_it_begins_anew() -> None:
    beat = Cadence(1.0 * MS)
    for came_ns in (0, MS, 2 * MS, 400 * MS + 17, 400 * MS - 3 * MS):
        assert beat.instant(came_ns) == came_ns


def jitter(folder: Path, name: str, *, told: bool) -> float:
    """True error of a run of free sensors whose frames leave late, as RMS [µm]."""
    one = device_sets()[name]
    guards = {m: {**one.guards.get(m, {}), **({"period_us": 5000.0} if told else {})} for m in one.messages}
    file = one._replace(guards=guards).write(
        folder,
        name,
        loop={"rate_hz": 200.0},
        plant={"free_jitter_us": 700.0},
        reference={"frequency_hz": 0.25},
    )
    loaded = load(file)
    run = Simulation(loaded, 5.0, how=backend_of(loaded))
    errors = [record.true_error_m for record in run.records()][400:1000]
    return 1e6 * math.sqrt(sum(e * e for e in errors) / len(errors))


@pytest.mark.parametrize("first_ns", [-2_400_000, 0, 1_300_000, 4_900_000])
def test_ticks_are_led_to_just_before_the_frames(first_ns: int) -> None:
    phase, begun_ns, came_ns = Phase(5 * MS), 0, first_ns
    behind = []
    for _ in range(1500):
        behind.append(came_ns - begun_ns)
        moved_ns = phase.shift_ns(came_ns - begun_ns)
        assert abs(moved_ns) <= MOST * 5 * MS
        begun_ns, came_ns = begun_ns + 5 * MS + moved_ns, came_ns + 4_997_000  # a clock that is 0.06 % off
    off = [b % (5 * MS) - BEHIND * 5 * MS for b in behind[-20:]]
    assert max(map(abs, off)) < 0.05 * 5 * MS


def test_a_clock_that_cannot_be_followed_moves_the_ticks_to_and_fro() -> None:
    phase, begun_ns, came_ns = Phase(MS), 0, 0
    for _ in range(10_000):
        begun_ns += MS + phase.shift_ns(came_ns - begun_ns)
        came_ns += 930_000
    assert begun_ns == pytest.approx(10_000 * MS, rel=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["free", "bare"])
def test_an_axis_whose_sensors_frames_are_late_tracks_by_their_beat(name: str, tmp_path: Path) -> None:
    blind, told = (jitter(tmp_path, name, told=told) for told in (False, True))
    assert told < 20.0
    assert told < 0.6 * blind


def test_a_period_is_of_devices_that_run_free(tmp_path: Path) -> None:
    one = device_sets()["all-there"]
    file = one._replace(guards={**one.guards, "ENC": {"period_us": 1000.0}}).write(tmp_path, "x")
    done = pneud_here("check", file)
    assert done.returncode == 2
    assert "period_us is of devices that sample by themselves, and sync has these answer it" in done.stderr
