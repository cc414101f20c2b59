"""Axes on other people's devices: each lack and oddity tracks, replays, and says what it does not notice."""

from __future__ import annotations

import math
import os
import secrets
from pathlib import Path
from typing import Any

import pytest
from hil.device_sets import device_sets

from commands import Figures, object_of, pneud, pneud_here
from pneud.config.proof import digest
from pneud.loading import devices_of, load
from pneud.log.files.naming import create_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.replay.lockstep import Simulation, backend_of, header_of
from pneud.replay.replaying import replay
from pneud.replay.running import through
from pneud.safety.faults import names
from pneud.safety.unnoticed import unnoticed
from pneud.signals import Record, State

SETS = device_sets()
RMS_M = 20e-6


def unnoticed_on(file: Path, *, wholly: bool) -> set[str]:
    loaded = load(file)
    found = unnoticed(devices_of(loaded.config, loaded.codecs))
    return {one.name for one in found if one.wholly >= wholly}


def test_what_devices_lack_is_what_cannot_be_noticed(tmp_path: Path) -> None:
    always = {"emergency", "heartbeat_lost"}  # no set has a node
    valve = {"valve_timed_out", "valve_fault", "valve_rebooted", "valve_disagrees"}
    frames = {"valve_missing", "valve_corrupt", "valve_frozen", "valve_late"}
    status = {"encoder_error", "encoder_unreferenced", "encoder_lost_reference"}
    supply = {"supply_pressure", "supply_falling"}
    expected = {
        "all-there": set(),
        "no-counter": {"encoder_frozen", "pressure_frozen", "valve_frozen"},
        "no-checksum": set(),
        "no-age-no-status": status,
        "no-supply": supply,
        "no-valve-status": valve | frames,
        "valve-on-or-off": {"valve_timed_out", "valve_disagrees"},
        "valve-voltage-only": {"valve_timed_out", "valve_fault", "valve_rebooted"},
        "free": {"pressure_late", "valve_late", "identifier_clash"},
        "bare": valve | frames | status | supply | {
            "encoder_frozen", "encoder_late", "pressure_frozen", "pressure_late", "identifier_clash",
        },
    }  # fmt: skip
    for name, faults in expected.items():
        assert unnoticed_on(SETS[name].write(tmp_path, name), wholly=True) == faults | always, name
    partly = unnoticed_on(tmp_path / "no-checksum.toml", wholly=False)
    assert {"encoder_corrupt", "pressure_corrupt", "valve_corrupt"} <= partly
    assert "valve_active" in unnoticed_on(tmp_path / "no-valve-status.toml", wholly=False)


def test_a_movement_test_is_one_of_a_mapping(tmp_path: Path) -> None:
    def of(name: str, **change: Any) -> str:
        loaded = load(SETS[name].write(tmp_path, name, **change))
        return digest(loaded.config, loaded.dbc.read_bytes())

    counts, axis = SETS["counts"], load("virtual.toml")
    turned = counts._replace(
        signals={**counts.signals, "position_m": {"signal": "ENC.Pos", "counts_per_m": 1e6}}
    )
    now = of("counts")
    assert of("counts", log={"detail": "full"}) == now
    loaded = load(turned.write(tmp_path, "turned"))
    assert digest(loaded.config, (tmp_path / "counts.dbc").read_bytes()) != now
    # one that was passed before there were mappings
    passed = "1f6bce70d7b27c4e72287b19f1462ae8aa03660ca7b38580fa72c60b05a51788"
    assert digest(axis.config, axis.dbc.read_bytes()) == passed


def test_check_says_so(tmp_path: Path) -> None:
    file = SETS["no-valve-status"].write(tmp_path, "dumb")
    found = object_of(pneud_here("check", file, "--json"))["unnoticed"]
    assert {"fault": "valve_missing", "why": "the valve sends nothing", "wholly": True} in found
    text = pneud_here("check", file).stdout
    assert "not noticed here: valve_missing, valve_corrupt, valve_frozen, valve_late (the valve sends" in text


def run(file: Path, log: Path, seconds: float) -> list[Record]:
    """The records of a run that has to end as it should, and to replay to the bit."""
    loaded = load(file)
    records: list[Record] = []
    writer = LogWriter(create_log(log), header_of(loaded))
    ran = through(
        Simulation(loaded, seconds, how=backend_of(loaded)),
        loaded.config.loop.rate_hz,
        writer,
        lambda _, record: records.append(record),
    )
    assert writer.close()
    assert not ran.tally.ever_latched, names(ran.seen.latched)
    assert ran.seen.state == State.TRACKING
    again = replay(read_log(log))
    assert again.identical
    assert again.commands == again.ticks
    return records


@pytest.mark.parametrize("name", ["multiplexed-counted", "words", "bare"])
def test_odd_devices_track_and_replay_to_the_bit(name: str, tmp_path: Path) -> None:
    records = run(SETS[name].write(tmp_path, name), tmp_path / "x.mcap", 0.7)
    sent = {len(record.sent) for record in records}
    assert sent == ({1} if name == "bare" else {2})  # no SYNC where sensors run free


def test_a_replay_may_begin_in_the_middle(tmp_path: Path) -> None:
    run(SETS["multiplexed-counted"].write(tmp_path, "x"), tmp_path / "x.mcap", 1.3)
    assert replay(read_log(tmp_path / "x.mcap"), from_s=1.1).identical


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_every_device_set_tracks(name: str, tmp_path: Path, figures: Figures) -> None:
    records = run(SETS[name].write(tmp_path, name), tmp_path / "x.mcap", 4.0)
    settled = [r.true_error_m for r in records[2000:4000]]
    rms_m = math.sqrt(sum(e * e for e in settled) / len(settled))
    figures(
        f"devices {name}: true error {1e3 * rms_m:.4f} mm rms, {1e3 * max(map(abs, settled)):.4f} mm at most"
    )
    assert rms_m <= RMS_M


@pytest.mark.slow
@pytest.mark.parametrize(("part", "most_m"), [(0.5, RMS_M), (0.93, 1.5 * RMS_M), (1.07, RMS_M)])
def test_sensors_run_free_at_a_rate_of_their_own(
    part: float, most_m: float, tmp_path: Path, figures: Figures
) -> None:
    file = SETS["free"].write(tmp_path, "free", plant={"free_period_us": 1000.0 * part})
    records = run(file, tmp_path / "x.mcap", 4.0)
    settled = [r.true_error_m for r in records[2000:4000]]
    rms_m = math.sqrt(sum(e * e for e in settled) / len(settled))
    figures(f"free sensors, every {part:g} ms: true error {1e3 * rms_m:.4f} mm rms")
    assert rms_m <= most_m


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("name", ["extended", "multiplexed", "words", "bare"])
def test_device_sets_in_real_time(name: str, tmp_path: Path, figures: Figures) -> None:
    patient = {f"{key}_timeout_ms": 250.0 for key in ("sensor", "valve", "deadline")}
    file = SETS[name].write(tmp_path, name, bus={"dbc": f"{name}.dbc", **_bus_of(name), **patient})
    bus = f"unixcan:devices-{os.getpid()}-{secrets.token_hex(3)}"
    log = tmp_path / "run.mcap"
    done = pneud(
        "--virtual", "--config", file, "--bus", bus, "--duration", 8, "--headless", "--json", "--log", log
    )
    assert done.returncode == 0, done.stderr
    s = object_of(done)
    assert (s["state"], s["faults"]) == ("tracking", [])
    assert s["frames"]["crc"] == s["frames"]["stale"] == 0
    figures(f"devices {name} in real time: {s['tracking_mm']['rms']:.4f} mm rms")
    assert s["tracking_mm"]["rms"] <= 0.5
    assert object_of(pneud_here("replay", log, "--json"))["identical"] is True


def _bus_of(name: str) -> dict[str, object]:
    one = SETS[name]
    return {"signals": one.signals, "messages": dict(one.guards), **one.more}
