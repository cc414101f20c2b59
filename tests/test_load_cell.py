"""A load cell by role: what it says, what pressing makes of it, and where it is silent or disagrees."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hil.force import Asked, contact_n

from axis_rig import H, quick
from commands import eventually, pneud
from log_samples import tick_at
from pneud.bus.codec import DatabaseError
from pneud.bus.load_cell import Weighing
from pneud.config.conversions import axis_of, plant_of
from pneud.config.sections import ConfigError
from pneud.console.client import Client
from pneud.console.status_reply import StatusWatch
from pneud.control import force
from pneud.control.force import Aim, proceed
from pneud.loading import Loaded, load
from pneud.log.files.reader import read_log
from pneud.log.live.ring import Ring
from pneud.replay.lockstep import Simulation
from pneud.rig.node import PlantNode
from pneud.safety.faults import names
from pneud.signals import Estimate, Frame, Record, Request, RequestKind, State, Timing, Weighed
from running import patient_axis
from test_goto_wait import daemon

CELL: dict[str, Any] = {
    "dbc": "load-cell.dbc",
    "load_cell": "LOAD_CELL.Force",
    "messages": {"LOAD_CELL": {"counter": "Counter", "crc": "Crc"}},
}
CONTACT = {"position_m": 0.437, "stiffness_n_m": 1e4, "damping_n_s_m": 20.0, "side": "front"}
MS = 1_000_000
PRESS = Request(RequestKind.FORCE, (150.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def rig(**bus: Any) -> Loaded:
    return load("virtual.toml", change={"bus": CELL | bus, "plant": {"contact": CONTACT}})


def pressed(happens: Callable[[PlantNode], None] = lambda _: None) -> tuple[list[Record], float]:
    """The ticks of a load that is pressed for a second, and the contact's true force at their end."""
    loaded = rig()
    asked = Asked(1000.0, [(PRESS, 0.7)])
    run = Simulation(loaded, 3.0, 0, quick(), operator=asked.ask)
    records: list[Record] = []
    end_n = math.nan
    for record in run.records():
        records.append(record)
        if record.tick.state == State.PRESSING:
            end_n = contact_n(run.node.truth().state, plant_of(loaded.config))
            happens(run.node)
    return records, end_n


def test_what_is_asked_for_arrives_where_the_load_presses() -> None:
    records, end_n = pressed()
    ticks = [r.tick for r in records if r.tick.state == State.PRESSING]
    assert abs(end_n - 150.0) <= 3.0
    last = ticks[-1]
    assert last.in_position
    assert last.weighed is not None
    assert last.weighed.force_n == pytest.approx(end_n, abs=0.5)
    assert last.weighed.age_ns < 2 * MS
    assert not any(t.present for t in ticks)


def silent(node: PlantNode) -> None:
    node.cell_silent = True


def wrong(node: PlantNode) -> None:
    node.cell_zero_n = 400.0


@pytest.mark.parametrize(("happens", "fault"), [(silent, "load_missing"), (wrong, "load_disagrees")])
def test_a_cell_that_is_silent_or_disagrees_stops_the_axis(
    happens: Callable[[PlantNode], None], fault: str
) -> None:
    records, _ = pressed(happens)
    latched = 0
    for record in records:
        latched |= record.tick.latched
    assert names(latched) == [fault]
    assert State.STOPPING in {r.tick.state for r in records}


def test_without_a_cell_that_was_heard_nothing_is_armed() -> None:
    run = Simulation(rig(), 0.3, 0, quick())
    run.node.cell_silent = True
    ticks = [record.tick for record in run.records()]
    assert {t.state for t in ticks} <= {State.STARTING, State.WAITING, State.DISARMED}
    assert names(ticks[-1].present) == ["load_missing"]
    assert ticks[-1].weighed is None


def test_the_cell_leads_the_piston_beyond_friction() -> None:
    loaded = rig()
    axis = axis_of(loaded.config, loaded.codecs.command_lsb_v)
    law, p = axis.controller, axis.pressing
    rod_n = law.cylinder.rod_force_n
    e = Estimate(0.5, 0.0, 100.0, 100.0 + rod_n, 100.0 + rod_n, 0.0, 0.0, 0.0)
    aim = Aim(150.0, 1e5, 0.1, 0.9, 0.2, 5.0)
    begun = force.begin(aim, force.NO_PRESS, False, e, 0, law)
    led, alone = begun, begun
    for tick in range(1, 600):
        led = proceed(led, e, tick * MS, H, law, p, 60.0).press
        alone = proceed(alone, e, tick * MS, H, law, p).press
    assert led.bias_n == pytest.approx(40.0, abs=0.1)
    assert led.wanted_n == pytest.approx(190.0, abs=0.2)
    assert led.slow_n == pytest.approx(90.0, abs=0.1)
    assert alone.bias_n == 0.0
    assert alone.wanted_n == pytest.approx(150.0, abs=0.2)
    far, ended = led, force.FINE
    for tick in range(600, 701):
        far, ended = proceed(far, e, tick * MS, H, law, p, 100.0 + 1.01 * p.apart_n)
        assert ended == (force.APART if tick >= 700 else force.FINE)
    assert abs(far.bias_n) <= p.apart_n
    fast = e._replace(velocity_m_s=0.1)
    assert proceed(led, fast, 600 * MS, H, law, p, -1e4).press.apart_ns == -1


def test_frames_are_judged_and_their_age_is_told() -> None:
    cell = rig().codecs.load_cell
    assert cell is not None
    weighing, encode = Weighing(cell), cell.codec.encode
    assert math.isnan(weighing.force_n)
    assert weighing.age_ns(5) > 1 << 60
    weighing.take(Frame(100, weighing.can_id, encode(12.34, counter=7)))
    weighing.take(Frame(200, weighing.can_id, encode(99.0, counter=7)))  # the counter stands still
    weighing.take(Frame(300, weighing.can_id, b"\x00"))
    assert weighing.force_n == pytest.approx(12.34)
    assert (weighing.age_ns(350), weighing.stale, weighing.crc) == (250, 1, 1)
    again = Weighing(cell)
    again.thaw(weighing.freeze())
    assert (again.force_n, again.age_ns(350)) == (weighing.force_n, 250)


@pytest.mark.parametrize(
    ("told", "says"),
    [
        ("LOAD_CELL.Nothing", "not in the message; it has: Force"),
        ("CELL.Force", "[bus] load_cell can name"),
        ("ENCODER.Position", "unit 'm'; a force needs one: unit, one of N, kN, mN"),
        ({"signal": "VALVE_STATUS.Applied", "unit": "N"}, "is valve_status, too"),
        (5.0, 'load_cell: give "MESSAGE.SIGNAL"'),
        ({"signal": "LOAD_CELL.Force", "gauge": True}, "is a force; it takes signal, unit and offset"),
    ],
)
def test_what_is_no_load_cell_is_refused_in_one_line(told: Any, says: str) -> None:
    with pytest.raises((DatabaseError, ConfigError)) as e:
        rig(load_cell=told, messages={})
    assert says in str(e.value)


def press_toml(folder: Path) -> Path:
    """The virtual axis with a load cell, and something to press against."""
    text = patient_axis(folder).read_text()
    text = text.replace('dbc = "pneud.dbc"', 'dbc = "load-cell.dbc"\nload_cell = "LOAD_CELL.Force"')
    text += '[bus.messages.LOAD_CELL]\ncounter = "Counter"\ncrc = "Crc"\n'
    text += "[plant.contact]\nposition_m = 0.5\nstiffness_n_m = 10_000.0\ndamping_n_s_m = 20.0\n"
    (folder / "press.toml").write_text(text)
    return folder / "press.toml"


@pytest.mark.slow
def test_what_it_said_is_in_the_log_and_a_replay_is_identical(tmp_path: Path) -> None:
    log = tmp_path / "press.mcap"
    assert pneud("sim", press_toml(tmp_path), "--goto", "495,100N", "-o", log).returncode == 0
    assert json.loads(pneud("replay", log, "--json").stdout)["identical"]
    last = [t for t in read_log(log) if t.state == State.PRESSING][-1]
    assert last.weighed is not None
    assert last.weighed.force_n == pytest.approx(100.0, abs=2.0)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_cell_on_a_real_bus_leads_the_force_and_is_in_the_log(tmp_path: Path) -> None:
    with daemon(tmp_path, press_toml(tmp_path)) as (process, path, log):
        at = ("--socket", path)
        with Client(path) as client:
            eventually(lambda: client.ask("status")["state"] == "tracking")
            assert pneud("goto", 490, "--wait", *at).returncode == 0
            assert pneud("force", 120, "--wait", *at).returncode == 0
            told = client.ask("status")
            assert (told["state"], told["in_position"]) == ("pressing", True)
            assert told["load_cell_n"] == pytest.approx(120.0, abs=4.0)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)
    assert json.loads(pneud("replay", str(log), "--json").stdout)["identical"]


@pytest.mark.parametrize(("says_n", "told"), [(math.nan, None), (12.346, 12.35)])
def test_status_has_what_the_load_presses_with_once_a_cell_has_said_it(
    says_n: float, told: float | None
) -> None:
    ring = Ring.create(slots=16)
    tick = tick_at(1_000_000_000)._replace(weighed=Weighed(says_n, 0))
    for _ in range(2):
        ring.put(Record(tick, Timing(21_000, 1, 1, 1, 84_000, 1), (), 0, (), 0.0))
    watch = StatusWatch(ring)
    for _ in range(2):
        watch.poll()
    assert watch.fields().get("load_cell_n") == told
