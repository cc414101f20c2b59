"""What is found on a bus: who answers, what counts and checks, what moves; and the table made of it."""

from __future__ import annotations

import json
import math
import random
import shutil
import threading
import tomllib
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest

from commands import pneud_here as pneud
from pneud.bus.transport import Party
from pneud.loading import load
from pneud.replay import traffic
from pneud.replay.lockstep import Simulation
from pneud.signals import Frame
from pneud.study.mapping.decoding import Decoder
from pneud.study.mapping.found import Found, look
from pneud.study.mapping.watching import Watch
from protected import LAYOUTS, RULES, codecs_with

MS = 1_000_000
GOLDEN = Path(__file__).parent / "golden"
DBC = Path(__file__).parent.parent / "configs" / "pneud.dbc"
FOREIGN = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 421 LVDT: 4 A
 SG_ Way : 7|32@0- (0.001,0) [0|0] "mm" A
BO_ 2566853157 PT_A: 3 A
 SG_ Value : 0|16@1- (0.01,0) [0|0] "bar" A
 SG_ Count : 16|4@1+ (1,0) [0|0] "" A
BO_ 513 PT_B: 4 A
 SG_ Value : 0|16@1- (0.01,0) [0|0] "bar" A
 SG_ Line : 16|16@1- (0.01,0) [0|0] "bar" A
BO_ 769 DRIVE: 2 A
 SG_ Setpoint : 0|16@1- (1,0) [0|0] "mV" A
"""


def foreign(seconds: float = 2.0) -> Iterator[Frame]:
    """A rig of other makers: the way and one pressure answer SYNC, the other pressure runs free, slowly."""
    chance = random.Random(1)
    frames = []
    for n in range(round(200 * seconds)):
        t_ns, t_s = 5 * MS * n, 0.005 * n
        way = round(100_000 + 20_000 * math.sin(2.0 * t_s))
        frames.append(Frame(t_ns, 0x080, b""))
        frames.append(
            Frame(t_ns + 400_000 + chance.randrange(20_000), 421, way.to_bytes(4, "big", signed=True))
        )
        value = round(300 + 50 * math.sin(2.0 * t_s) + chance.gauss(0, 1))
        count = (n % 15).to_bytes(1, "little")
        frames.append(Frame(t_ns + 500_000, 0x98FF_1225, value.to_bytes(2, "little") + count))
        drive = round(1000 * math.sin(50 * t_s + chance.random()))
        frames.append(Frame(t_ns + 900_000, 769, drive.to_bytes(2, "little", signed=True)))
    for n in range(round(130 * seconds)):
        t_s = n / 130
        slow = round(320 - 40 * math.sin(2.0 * (t_s - t_s % 0.1)))  # a new value ten times a second
        data = slow.to_bytes(2, "little") + (700 + chance.randrange(2)).to_bytes(2, "little")
        frames.append(Frame(round(t_s * 1e9), 513, data))
    return iter(sorted(frames))


@pytest.fixture
def decoder(tmp_path: Path) -> Decoder:
    path = tmp_path / "foreign.dbc"
    path.write_text(FOREIGN)
    return Decoder(path)


@pytest.fixture
def found(decoder: Decoder) -> Found:
    watch = Watch()
    watch.add(foreign())
    return look(watch, decoder, {})


def test_who_answers_sync_and_how_often(found: Found) -> None:
    seen = {m.can_id: m for m in found.messages}
    assert [m.shown for m in found.messages] == ["080", "1A5", "201", "301", "18FF1225"]
    assert seen[421].timing == "answers SYNC" and seen[421].delay_s == pytest.approx(410e-6, abs=5e-6)
    assert seen[0x98FF_1225].timing == "answers SYNC"
    assert seen[513].timing == "periodic" and seen[513].rate_hz == pytest.approx(130, rel=0.01)
    assert seen[421].rate_hz == pytest.approx(200, rel=0.01) and seen[421].jitter_s < 20e-6
    assert seen[421].changing == (2, 3)
    counter = seen[0x98FF_1225].counter
    assert counter is not None and (counter.place.start, counter.last, counter.wrapped) == (16, 14, True)
    assert found.sync


def test_what_moves_and_how_often_it_is_new(found: Found) -> None:
    by_name = {c.name: c for c in found.courses}
    assert by_name["LVDT.Way"].moving > 20
    assert by_name["PT_B.Line"].moving < 1 and by_name["PT_A.Count"].moving < 3
    assert by_name["PT_B.Value"].distinct_per_s == pytest.approx(10, abs=1)
    assert by_name["LVDT.Way"].distinct_per_s > 150
    assert by_name["PT_A.Value"].along(by_name["LVDT.Way"]) > 0.9
    assert by_name["PT_B.Value"].along(by_name["LVDT.Way"]) < -0.9


def test_the_guess_is_by_units_names_and_motion(found: Found, decoder: Decoder) -> None:
    filled = found.guess.filled
    assert filled == {
        "position_m": "LVDT.Way",
        "p1_pa": "PT_A.Value",
        "p2_pa": "PT_B.Value",
        "supply_pa": "PT_B.Line",
        "voltage_v": "DRIVE.Setpoint",
    }
    assert found.extras == {"PT_A": {"counter": "Count", "counter_max": 14}}
    watch = Watch()
    watch.add(foreign())
    steered = look(watch, decoder, {"p1_pa": "PT_B.Value", "supply_pa": "none"}).guess
    assert steered.filled["p1_pa"] == "PT_B.Value" and "supply_pa" not in steered.filled
    assert steered.filled["p2_pa"] == "PT_A.Value"


@pytest.mark.parametrize("layout", ["in front", "behind", "big-endian"])
@pytest.mark.parametrize("rule", RULES)
def test_every_rule_is_recognised_by_its_frames(rule: str, layout: str, tmp_path: Path) -> None:
    assert layout in LAYOUTS
    codec = codecs_with(rule, layout).encoder
    watch = Watch()
    data = [codec.encode(0.1 + 0.001 * math.sin(n), counter=n % codec.counter_values) for n in range(300)]
    watch.add(Frame(n * MS, codec.can_id, frame) for n, frame in enumerate(data))
    seen = watch.seen(codec.can_id)
    assert codec.counter_field is not None and seen.counter is not None and seen.check is not None
    assert seen.counter.last == codec.counter_values - 1
    name = rule.partition(" ")[0]
    if name == "xor8" or name == "sum8":  # any byte of them fits
        assert seen.check.rule == name
        return
    assert seen.check.rule == name
    # and by what was recognised, the same frames are right
    changed: dict[str, Any] = {"counter_max": codec.counter_values - 1, "protection": name}
    if seen.check.data_id is not None:
        changed |= {"data_id": seen.check.data_id, "data_id_mode": seen.check.data_id_mode}
        changed |= {"data_id_nibble": None}
    again = codecs_with(rule, layout, **changed).encoder
    assert all(again.valid(frame) for frame in data)


def test_noise_has_neither_counter_nor_checksum() -> None:
    chance, watch = random.Random(3), Watch()
    watch.add(Frame(n * MS, 0x181, chance.randbytes(8)) for n in range(300))
    seen = watch.seen(0x181)
    assert (seen.counter, seen.check, seen.timing) == (None, None, "periodic")


def candump(path: Path, seconds: float = 2.0) -> Path:
    traffic.write(path, ((frame, False) for frame in foreign(seconds)))
    return path


def test_a_recording_becomes_a_table(tmp_path: Path, decoder: Decoder) -> None:
    log = candump(tmp_path / "bus.log")
    done = pneud("map", log, "--dbc", decoder.path, "-o", tmp_path / "map.toml", "--p2", "PT_B.Value")
    assert done.returncode == 0, done.stderr
    assert "SYNC + 4" in done.stdout and "18FF1225" in done.stdout
    again = pneud("map", log, "--dbc", decoder.path, "-o", tmp_path / "map.toml", "--yes")
    assert again.returncode == 0, again.stderr
    bus = tomllib.loads((tmp_path / "map.toml").read_text())["bus"]
    assert bus["dbc"] == "foreign.dbc" and bus["sync"] is True
    assert bus["signals"]["position_m"] == "LVDT.Way"
    assert bus["messages"] == {"PT_A": {"counter": "Count", "counter_max": 14}}


def test_json_has_all_of_it(tmp_path: Path, decoder: Decoder) -> None:
    done = pneud("map", candump(tmp_path / "bus.asc"), "--dbc", decoder.path, "--json")
    said = json.loads(done.stdout)
    assert (said["schema"], len(said["messages"]), said["mapping"]["signals"]["position_m"]) == (
        1,
        5,
        "LVDT.Way",
    )
    assert {s["name"]: s["distinct_per_s"] for s in said["signals"]}["PT_B.Value"] == pytest.approx(10, abs=1)


def test_a_log_of_pneud_is_a_recording() -> None:
    done = pneud("map", GOLDEN / "composite.mcap", "--dbc", DBC)
    assert done.returncode == 0, done.stderr
    assert 'position_m = "ENCODER.Position"' in done.stdout
    assert done.stdout.count("byte 7: pneud") == 4 and done.stdout.count("byte 6: 0…255") == 4


def test_a_configuration_gets_the_table_and_runs(tmp_path: Path) -> None:
    for name in ("virtual.toml", "pneud.dbc"):
        shutil.copy(DBC.with_name(name), tmp_path)
    config = tmp_path / "virtual.toml"
    before = config.read_text()
    done = pneud("map", GOLDEN / "composite.mcap", "--dbc", tmp_path / "pneud.dbc", "-o", config, "--yes")
    assert done.returncode == 0, done.stderr
    loaded = load(config)
    assert loaded.config.bus.signals is not None
    assert config.read_text().startswith(before.partition("[bus]")[0]), "all else stays as it was"
    records = list(Simulation(loaded, 0.2).records())
    assert records[-1].tick.measurement.position_m == pytest.approx(0.486, abs=0.1)
    assert not any(record.tick.latched for record in records)
    again = pneud("map", GOLDEN / "composite.mcap", "--config", config, "-o", config, "--yes")
    assert again.returncode == 0, again.stderr


def test_without_a_dbc_there_are_messages_only(tmp_path: Path) -> None:
    done = pneud("map", candump(tmp_path / "bus.log"))
    assert done.returncode == 0 and "1A5" in done.stdout and "[bus" not in done.stdout


def refused(done: CompletedProcess[str], code: int, *words: str) -> None:
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr.count("\n") == 1 and all(word in done.stderr for word in words), done.stderr


def test_what_cannot_be_is_one_line(tmp_path: Path, decoder: Decoder) -> None:
    log = candump(tmp_path / "bus.log", 0.5)
    refused(pneud("map"), 2, "name a recording, or a bus")
    refused(pneud("map", tmp_path / "bus.txt"), 2, "no such format")
    refused(pneud("map", tmp_path / "none.log"), 2, "none.log", "cannot be read")
    refused(
        pneud("map", log, "--dbc", decoder.path, "--position", "LVDT.Nothing"),
        2,
        "LVDT.Nothing",
        "foreign.dbc",
    )
    refused(pneud("map", log, "--position", "LVDT.Way"), 2, "no DBC", "--dbc")
    refused(pneud("map", log, "--fill", "speed=A.B"), 2, "KEY one of")
    refused(pneud("map", log, "-o", tmp_path / "m.toml"), 2, "nothing to write without a DBC")
    refused(pneud("map", "--bus", "auto"), 2, "--bus auto")
    (tmp_path / "m.toml").write_text("name = 1")
    refused(
        pneud("map", log, "--dbc", decoder.path, "-o", tmp_path / "m.toml"), 2, "nobody is there", "--yes"
    )
    (tmp_path / "empty.log").write_text("")
    done = pneud("map", tmp_path / "empty.log")
    assert (done.returncode, done.stdout) == (1, "") and "nothing was heard" in done.stderr
    done = pneud("map", tmp_path / "empty.log", "--json")
    assert (done.returncode, json.loads(done.stdout)["messages"]) == (1, [])


def test_a_bus_is_listened_to_and_nothing_is_sent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    party, going = Party("rig", answers=True), threading.Event()
    frames: list[Frame] = []

    def talk() -> None:
        n = 0
        while not going.wait(0.002):
            n += 1
            party.drain(0, frames)  # lets others join
            party.send(0x181, n.to_bytes(4, "little") + bytes(4))

    talker = threading.Thread(target=talk)
    talker.start()
    try:
        done = pneud("map", "--bus", "unixcan:rig", "--seconds", "0.5")
    finally:
        going.set()
        talker.join()
        party.close()
    assert done.returncode == 0, done.stderr
    assert "181" in done.stdout and "moving: nothing" in done.stderr
    assert frames == [], "it only listened"
