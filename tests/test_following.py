"""Two controllers, one SYNC: one makes it, the other follows, and is told when it ends."""

from __future__ import annotations

import json
import os
import secrets
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from commands import PNEUD, eventually, object_of, pneud, pneud_here
from pneud import resources
from pneud.bus.mapped_inbox import inbox_of
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.config.toml import changed_text
from pneud.loading import load
from pneud.log.files.reader import read_log
from pneud.loop.following import Following
from pneud.replay.lockstep import Simulation, backend_of
from pneud.replay.running import through
from pneud.safety.cause import first_cause
from pneud.scenario.verdict import blind_spots
from pneud.signals import Frame, State
from running import serves

MS = 1_000_000
AXES = ("encoder", "pressure", "valve_status", "valve_command")


def axis(folder: Path, name: str, number: int, **bus: Any) -> Path:
    """The axis of virtual.toml with the frames of one of several."""
    own: dict[str, dict[str, Any]] = {
        "encoder": {"message": f"ENCODER_{number}", "node": 3 * number - 2},
        "pressure": {"message": f"PRESSURE_{number}", "node": 3 * number - 1},
        "valve_status": {"message": f"VALVE_STATUS_{number}", "node": 3 * number},
        "valve_command": {"message": f"VALVE_COMMAND_{number}"},
    }
    told = {
        "encoder": {"position_m": "Position", "status": "Status", "age_s": "Age"},
        "pressure": {"p1_pa": "P1", "p2_pa": "P2", "supply_pa": "Supply"},
        "valve_status": {"applied_v": "Applied", "state": "State"},
        "valve_command": {"voltage_v": "Voltage", "enable": "Enable", "sequence": "Sequence"},
    }
    frames = {role: own[role] | {"signals": told[role]} for role in AXES} if number > 1 else {}
    patient = {f"{who}_timeout_ms": 200.0 for who in ("sensor", "valve", "deadline")}
    text = (resources.configs() / "virtual.toml").read_text()
    limits = {"tracking_error_m": 0.1}  # else that is noticed first where SYNC ends
    bus = {"dbc": "axes.dbc", "frames": frames, **patient, **bus}
    file = folder / f"{name}.toml"
    file.write_text(
        changed_text(text, {"name": name, "bus": bus, "loop": {"rate_hz": 500.0}, "limits": limits})
    )
    return file


class Way:
    """A bus that brings what it is told to, each at its time."""

    down = False

    def __init__(self, *frames: Frame) -> None:
        self.frames = list(frames)
        self.now_ns = 1000 * MS

    def clock(self) -> int:
        self.now_ns += 1000
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)

    def drain(self, into: list[Frame], wait_ns: int = 0) -> int:
        due = [f for f in self.frames if f.stamp_ns <= self.now_ns]
        if not due and wait_ns:
            first = min((f.stamp_ns for f in self.frames), default=1 << 62)
            self.now_ns = min(first, self.now_ns + wait_ns)
            due = [f for f in self.frames if f.stamp_ns <= self.now_ns]
        self.frames = [f for f in self.frames if f not in due]
        into += due
        return len(due)


def following(way: Way, patience_ms: int = 5) -> Following:
    sync = load("virtual.toml").codecs.sync
    return Following(way, sync, MS, patience_ms * MS, way.clock, way.sleep)


def sync(at_ms: float, counter: int = 1) -> Frame:
    return Frame(1000 * MS + round(at_ms * MS), 0x080, bytes((counter,)))


def other(at_ms: float) -> Frame:
    return Frame(1000 * MS + round(at_ms * MS), 0x181, bytes(8))


def test_a_tick_begins_with_sync_and_what_comes_behind_it_is_of_the_tick() -> None:
    way = Way(other(0.1), sync(0.5, 7), other(0.5), sync(1.5, 8))
    beats, came = following(way), list[Frame]()
    beat = beats.next(came)
    assert (beat.t_ns, beat.skipped, beat.sequence, beat.lost) == (sync(0.5).stamp_ns, 0, 7, False)
    assert came == [other(0.1), sync(0.5, 7)]
    assert beats.rest == [other(0.5)]
    beats.rest.clear()
    assert beats.next(came).sequence == 8


def test_ticks_that_come_too_late_are_skipped_and_counted() -> None:
    way = Way(sync(0.1, 1), sync(1.1, 2), sync(2.1, 3), other(2.2), sync(3.1, 4))
    beats = following(way)
    beats.next([])
    way.now_ns += round(2.5 * MS)
    came: list[Frame] = []
    beat = beats.next(came)
    assert (beat.t_ns, beat.skipped, beat.sequence) == (sync(2.1).stamp_ns, 1, 3)
    assert len(came) == 2 and beat.late_ns > 0.4 * MS


def test_without_sync_ticks_go_on_and_say_so_in_the_end() -> None:
    way = Way(sync(0.2), other(2.0), sync(20.2))
    beats = following(way)
    beats.next([])
    found = [beats.next([]) for _ in range(12)]
    lost = [beat.lost for beat in found]
    assert lost == sorted(lost) and not lost[0] and lost[-1]
    assert sum(not one for one in lost) in (4, 5)
    steps = [b.t_ns - a.t_ns for a, b in pairwise(found[1:])]
    assert all(0.9 * MS <= step <= 1.1 * MS for step in steps)
    while beats.next([]).lost:
        pass
    assert way.now_ns >= 1020 * MS


def test_the_next_sync_that_comes_while_a_tick_waits_is_kept_for_the_next_one() -> None:
    way = Way(sync(0.2, 1))
    beats, came = following(way), [other(0.9), sync(1.2, 2), other(1.3)]
    beats.next([])
    assert beats.keep(came) and came == [other(0.9)]
    assert not beats.keep(came)
    way.now_ns += MS
    assert beats.next(came).sequence == 2
    assert beats.rest == [other(1.3)]


def test_a_dead_interface_is_slept_through() -> None:
    way = Way()
    way.down = True
    beats = following(way)
    assert beats.next([]).sequence == 0
    assert way.now_ns >= 1001 * MS


def test_an_axis_that_follows_tracks_and_replays_in_simulated_time(tmp_path: Path) -> None:
    loaded = load(axis(tmp_path, "y", 2, sync="follow"))
    run = Simulation(loaded, 1.2, how=backend_of(loaded))
    errors: list[float] = []
    ran = through(run, loaded.config.loop.rate_hz, look=lambda _, r: errors.append(abs(r.true_error_m)))
    assert ran.seen.state == State.TRACKING and not ran.seen.latched
    assert max(errors[-50:]) < 0.2e-3
    assert not inbox_of(loaded.codecs, loaded.config.bus).makes_sync
    assert [one.name for one in blind_spots(loaded) if "follow" in one.why] == ["other_controller"]


def test_an_export_of_it_comes_back_to_the_bit(tmp_path: Path) -> None:
    file = axis(tmp_path, "y", 2, sync="follow")
    assert pneud_here("sim", file, "-o", tmp_path / "run.mcap", "--duration", 0.8).returncode == 0
    assert object_of(pneud_here("replay", tmp_path / "run.mcap", "--json"))["identical"]
    assert pneud_here("export", tmp_path / "run.mcap", "-o", tmp_path / "run.log").returncode == 0
    done = pneud_here("import", tmp_path / "run.log", "-o", tmp_path / "again.mcap")
    assert (done.returncode, done.stderr) == (0, "")
    assert object_of(pneud_here("replay", tmp_path / "again.mcap", "--json"))["identical"]


def test_what_does_not_go_with_it_is_said() -> None:
    text = (resources.configs() / "canopen.toml").read_text()
    with pytest.raises(ConfigError, match="sync has to be true"):
        parse(changed_text(text, {"bus": {"sync": "follow"}}), "x.toml")
    cause = first_cause(["sync_lost", "encoder_missing", "pressure_missing", "valve_missing"])
    assert cause is not None and "SYNC" in cause.words and "encoder_missing" in cause.faults


@pytest.mark.slow
@pytest.mark.realtime
def test_two_daemons_share_one_sync_and_the_follower_stops_with_it(tmp_path: Path) -> None:
    bus = f"unixcan:two-{os.getpid()}-{secrets.token_hex(2)}"
    first, second = axis(tmp_path, "x", 1), axis(tmp_path, "y", 2, sync="follow")
    socket = f"/tmp/pneud-two-{os.getpid()}-{secrets.token_hex(2)}.sock"
    common = ["--bus", bus, "--headless", "--json"]
    words = ["--virtual", "--config", second, *common, "--socket", socket, "--log", tmp_path / "y.mcap"]
    follower = subprocess.Popen(
        [*PNEUD, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        eventually(lambda: serves(socket))
        maker = pneud("--virtual", "--config", first, *common, "--duration", 9, "--log", tmp_path / "x.mcap")
        out, err = follower.communicate(timeout=30)
    finally:
        follower.kill()
        Path(socket).unlink(missing_ok=True)
    assert maker.returncode == 0, maker.stderr
    x, y = object_of(maker), json.loads(out)
    assert (x["state"], x["faults"]) == ("tracking", [])
    assert x["tracking_mm"]["rms"] < 0.05
    assert "sync_lost" in y["faults"], err
    assert y["state"] == "fault"
    assert y["frames"]["crc"] == y["frames"]["stale"] == 0
    shared = {f.data for tick in read_log(tmp_path / "y.mcap") for f in tick.frames if f.can_id == 0x080}
    assert len(shared) == 240
    tracked = sum(tick.state == State.TRACKING for tick in read_log(tmp_path / "y.mcap"))
    assert tracked > 5 * 500
    assert object_of(pneud_here("replay", tmp_path / "y.mcap", "--json"))["identical"]
