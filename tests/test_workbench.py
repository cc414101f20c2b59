"""Replay as a workbench: from the middle, over parts, what if, one log against another, frames on a bus."""

from __future__ import annotations

import json
import math
import os
import threading
import time
from collections.abc import Iterator
from itertools import dropwhile
from pathlib import Path

import pytest

from axis_rig import quick
from commands import object_of
from commands import pneud_here as pneud
from log_samples import noisy, write_log
from pneud.bus.link import open_link
from pneud.config.reading import parse, with_settings
from pneud.config.sections import ConfigError
from pneud.loading import load
from pneud.log.files.naming import LogError, create_log
from pneud.log.files.reader import LoggedState, LogReader, read_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import LogHeader, Rotation
from pneud.replay import feeding, replaying
from pneud.replay.differences import POINTS, Differences, compare
from pneud.replay.feeding import Fed
from pneud.replay.lockstep import Simulation
from pneud.replay.playing import play
from pneud.safety.faults import FAULT_NAMES
from pneud.signals import Frame

SNAPSHOT = 250


def simulated(path: Path, seed: int = 3, duration_s: float = 1.2) -> None:
    """A simulated run in parts, with full detail."""
    loaded = load("virtual.toml")
    run = Simulation(loaded, duration_s, seed, quick())
    header = LogHeader(
        "virtual", "simulated", 1000.0, "full", loaded.path.name, loaded.text, loaded.dbc.name,
        loaded.dbc.read_bytes(), FAULT_NAMES, 0, {},
    )  # fmt: skip
    writer = LogWriter(create_log(path), header, Rotation(path, 60_000, 0, 0, True, 0, 0))
    for n, record in enumerate(run.records(), start=1):
        writer.write(record)
        if n % SNAPSHOT == 0:
            writer.snapshot({"axis": run.axis.freeze(), "inbox": run.inbox.freeze()})
    writer.close()


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parts")
    simulated(folder / "x.mcap")
    assert len(list(folder.iterdir())) >= 4
    return folder


def test_a_folder_with_parts_replays_as_one_log(parts: Path) -> None:
    done = pneud("replay", parts, "--json")
    assert done.returncode == 0
    s = object_of(done)
    assert (s["identical"], s["truncated"]) == (True, False)
    assert s["ticks"] == s["commands"] > 1200
    by_name = object_of(pneud("replay", *sorted(parts.iterdir()), "--json"))
    assert by_name == s


def test_each_part_replays_alone_to_the_bit(parts: Path) -> None:
    total = 0
    for path in sorted(parts.iterdir()):
        outcome = replaying.replay(read_log(path))
        assert outcome.identical, outcome.first
        assert not outcome.truncated
        total += outcome.ticks
    assert total == sum(1 for _ in read_log(parts))


def test_from_the_middle_it_begins_at_a_snapshot_and_stays_identical(parts: Path) -> None:
    whole = sum(1 for _ in read_log(parts))
    for from_s in (0.1, 0.25, 0.777, 1.1):
        outcome = replaying.replay(read_log(parts), from_s=from_s)
        assert outcome.identical, outcome.first
        assert outcome.ticks == whole - round(from_s * 1000)
    s = object_of(pneud("replay", parts, "--from", "0.5", "--json"))
    assert (s["identical"], s["ticks"]) == (True, whole - 500)


def test_behind_a_part_that_is_gone_it_goes_on_at_the_next_snapshot(parts: Path, tmp_path: Path) -> None:
    paths = sorted(parts.iterdir())
    outcome = replaying.replay(read_log(paths[0], *paths[2:]))
    assert outcome.identical
    assert outcome.truncated
    assert "missing" in outcome.damage
    gone = sum(1 for _ in read_log(paths[1]))
    assert outcome.ticks == sum(1 for _ in read_log(parts)) - gone


def test_a_snapshot_of_another_axis_is_refused_with_the_version(
    parts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard = feeding.fed

    def from_a_snapshot(log: LogReader, from_ns: int = 0) -> Iterator[Fed | LoggedState]:
        for item in dropwhile(lambda item: not isinstance(item, LoggedState), heard(log, from_ns)):
            if isinstance(item, LoggedState):
                yield item._replace(data=item.data.replace(b'"last_v"', b'"other"'))
            else:
                yield item

    monkeypatch.setattr(replaying, "fed", from_a_snapshot)
    with pytest.raises(LogError, match="of another version's axis: axis: has not the fields of AxisState"):
        replaying.replay(read_log(parts))


def test_what_if_tells_what_differs_and_since_when(parts: Path, tmp_path: Path) -> None:
    picture = tmp_path / "what-if.png"
    done = pneud("replay", parts, "--set", "control.k3=70.0", "--json", "-o", picture)
    assert done.returncode == 1
    s = object_of(done)
    d = s["differences"]
    assert isinstance(d, dict)
    assert next(iter(d)).startswith("command.")
    first = d["command.law_v"]
    assert first["ticks"] > 100
    assert min(v["first_tick"] for v in d.values()) == s["first_mismatch_tick"]
    assert 0.0 < first["rms"] < first["max"]
    assert first["first_tick"] <= first["max_tick"]
    assert "estimate.x3_n" not in d  # what is measured does not depend on the gains
    assert picture.read_bytes().startswith(b"\x89PNG")
    words = pneud("replay", parts, "--set", "control.k3=70.0").stdout
    assert "command.law_v" in words
    assert "first at tick" in words


def test_what_if_takes_the_names_of_tune_and_warns_as_check_does(parts: Path) -> None:
    by_name = pneud("replay", parts, "--set", "k3=1e6", "--set", "law=ismc-explicit", "--json")
    keys = ("control.k3=1e6", "control.law=ismc", "control.discretisation=explicit")
    by_key = pneud("replay", parts, *(word for key in keys for word in ("--set", key)), "--json")
    assert object_of(by_name) == object_of(by_key)
    assert by_name.stderr == by_key.stderr
    assert "pneud: warning: " in by_name.stderr
    unstable = pneud("replay", parts, "--set", "k2=1")
    assert (unstable.returncode, unstable.stdout) == (2, "")
    assert "not Hurwitz" in unstable.stderr


def test_what_if_with_nothing_changed_is_identical(parts: Path) -> None:
    for option in (("--set", "log.detail=compact"), ("--config", "virtual.toml")):
        s = object_of(pneud("replay", parts, *option, "--json"))
        assert (s["identical"], s["differences"]) == (True, {})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--set", "control.k9=1"), "control.k9: unknown key"),
        (("--set", "control.k1"), "give key=value"),
        (("--set", "name.k1=1"), "name is no table"),
        (("--set", "control.k1=-1"), "control.k1"),
        (("--from", "-1"), "--from"),
        (("--speed", "0"), "--speed"),
        (("-o", "x.txt"), "ends in .png"),
        (("-o", "/nowhere/x.png"), "there is no folder"),
        (("--against", "x.mcap", "--set", "control.k1=1"), "--set does not go with it"),
        (("--bus", "unixcan:x", "-o", "x.png"), "-o does not go with it"),
        (("--bus", "auto:"), "none of"),
        (("--against", "/nowhere.mcap"), "cannot be read"),
    ],
)
def test_wrong_options_are_one_line_and_exit_2(parts: Path, options: tuple[str, ...], words: str) -> None:
    done = pneud("replay", parts, *options)
    assert (done.returncode, done.stdout) == (2, "")
    assert words in done.stderr
    assert done.stderr.count("\n") == 1


def test_settings_are_parsed_as_toml() -> None:
    text = load("virtual.toml").text
    c = with_settings(
        text, "x", ["control.k1=2e3", "log.detail = 'full'", "bus.channel=unixcan:y", "bus.sync=true"]
    )
    assert (c.control.k1, c.log.detail, c.bus.channel, c.bus.sync) == (2e3, "full", "unixcan:y", True)
    assert with_settings(text, "x", []) == parse(text, "x")
    with pytest.raises(ConfigError, match="not valid TOML"):
        with_settings("=", "x", [])


def test_two_logs_are_compared_from_their_engaging(parts: Path, tmp_path: Path) -> None:
    same = pneud("replay", parts, "--against", parts, "--json")
    assert same.returncode == 0
    s = object_of(same)
    assert (s["identical"], s["shift_ticks"], s["differences"]) == (True, 0, {})
    assert pneud("replay", parts, "--against", parts).stdout.startswith("the same in ")
    (tmp_path / "other").mkdir()
    simulated(tmp_path / "other" / "x.mcap", seed=4, duration_s=0.6)
    other = pneud("replay", parts, "--against", tmp_path / "other", "--json")
    assert other.returncode == 1
    s = object_of(other)
    assert s["identical"] is False
    assert isinstance(s["ticks"], int)
    assert 500 < s["ticks"] < 1200
    assert "estimate.position_m" in s["differences"]  # another seed: other noise


def test_a_shifted_log_is_paired_by_its_engaging(tmp_path: Path) -> None:
    records = list(noisy(60))
    idle = [r._replace(tick=r.tick._replace(state=2)) for r in records]
    write_log(tmp_path / "a.mcap", idle[:10] + records[10:])
    write_log(tmp_path / "b.mcap", idle[3:10] + records[10:])
    c = compare(read_log(tmp_path / "a.mcap"), read_log(tmp_path / "b.mcap"))
    assert c.shift_ticks == -3
    assert (c.differences.ticks, c.differences.spreads(), c.engaged_ticks) == (57, {}, 50)


def test_a_picture_takes_no_more_memory_for_a_longer_log(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", list(noisy(20)))
    ticks = list(read_log(tmp_path / "a.mcap"))
    d = Differences(exact=True)
    for n in range(3 * POINTS):
        d.add(ticks[n % 20], ticks[n % 20])
    assert POINTS // 2 <= len(d.points) <= POINTS
    assert d.spreads() == {}


def test_what_is_no_number_has_no_size(tmp_path: Path) -> None:
    records = list(noisy(2))
    write_log(tmp_path / "a.mcap", records)
    a, b = read_log(tmp_path / "a.mcap")
    d = Differences(exact=True)
    d.add(a, a._replace(state=2, command=a.command._replace(s=math.nan)))
    d.add(b, b)
    spreads = d.spreads()
    assert math.isnan(spreads["state"].max) and math.isnan(spreads["command.s"].max)
    assert (spreads["state"].ticks, d.ticks, d.differing) == (1, 2, 1)


def test_frames_are_played_in_order_at_their_distances(tmp_path: Path) -> None:
    records = list(noisy(150))
    write_log(tmp_path / "a.mcap", records)
    expected = [f for r in records for f in r.frames]
    name = f"unixcan:replay-{os.getpid()}"
    with open_link(name) as listener, open_link(name) as link:
        got: list[Frame] = []
        done = threading.Event()

        def listen() -> None:
            while not done.is_set() or listener.wait(0.05):
                listener.wait(0.01)
                listener.drain(got)

        thread = threading.Thread(target=listen)
        thread.start()
        began = time.monotonic()
        played = play(read_log(tmp_path / "a.mcap"), link, speed=0.5)
        took = time.monotonic() - began
        done.set()
        thread.join()
    assert (played.frames, played.failed) == (len(expected), 0)
    assert [(f.can_id, f.data) for f in got] == [(f.can_id, f.data) for f in expected]
    span_s = (expected[-1].stamp_ns - expected[0].stamp_ns) * 1e-9
    assert took >= 2.0 * span_s
    # never early: what was sent after another frame of the log comes no sooner after the first one
    assert all((g.stamp_ns - got[0].stamp_ns) >= 2 * (e.stamp_ns - expected[0].stamp_ns) - 20_000_000
               for g, e in zip(got, expected, strict=True))  # fmt: skip


def test_playing_begins_where_it_is_told_and_stops_when_it_is_told(tmp_path: Path) -> None:
    records = list(noisy(100))
    write_log(tmp_path / "a.mcap", records)
    with open_link(f"unixcan:replay2-{os.getpid()}") as link:
        assert play(read_log(tmp_path / "a.mcap"), link, 1000.0, from_s=0.05).frames in range(145, 154)
        assert play(read_log(tmp_path / "a.mcap"), link, stop=lambda: True).frames == 0


def test_the_verb_plays_on_a_bus_of_its_own_and_never_on_a_rig(parts: Path) -> None:
    done = pneud(
        "replay",
        sorted(parts.iterdir())[0],
        "--bus",
        f"unixcan:alone-{os.getpid()}",
        "--speed",
        "20",
        "--json",
    )
    assert done.returncode == 0
    s = json.loads(done.stdout)
    assert s["frames"] > 500
    assert s["failed"] == 0
    refused = pneud("replay", parts, "--bus", "nosuchcan0")
    assert refused.returncode == 3
    assert refused.stdout == ""
