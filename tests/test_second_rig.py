"""The second rig of hil/: its frames are those of the bus, and its physics is physics."""

from __future__ import annotations

import ast
import json
import math
import random
import subprocess
import sys
from pathlib import Path

import pytest

from pneud.bus.codec import Codecs
from pneud.loading import load
from pneud.signals import EncoderStatus, ValveState

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
from hil import second_rig as rig  # noqa: E402

MS = 1_000_000
START_NS = 10 * MS
TIMEOUT_MS = 50.0


@pytest.fixture(scope="module")
def codecs() -> Codecs:
    return load("virtual.toml").codecs


@pytest.fixture
def nodes() -> rig.Nodes:
    return rig.Nodes(*rig.drawn(rig.SIZES["cyl25x200"], 1), 1, TIMEOUT_MS)


def command(codecs: Codecs, volts: float, enable: int, counter: int) -> bytes:
    return codecs.valve_command.encode(volts, enable, 1, counter=counter)


def status(nodes: rig.Nodes, codecs: Codecs, t_ns: int) -> tuple[float, ...]:
    """Applied voltage and state."""
    return codecs.valve_status.decode(nodes.hear(rig.SYNC, b"\1\0", t_ns)[2][1])


def closed(size: str, **other: float) -> rig.Physics:
    """A rig without any flow or heat."""
    physics, _ = rig.drawn(rig.SIZES[size], 1)
    return physics._replace(conductance=0.0, wall=0.0, weight=0.0, **other)


def advanced(state: list[float], u: float, seconds: float, physics: rig.Physics) -> list[float]:
    rig.advance(state, u, 1e-3, rig.STEP_S, round(seconds / rig.STEP_S), physics)
    return state


def test_it_knows_nothing_of_pneud() -> None:
    tree = ast.parse((ROOT / "hil" / "second_rig.py").read_text())
    imported = {
        name.partition(".")[0]
        for node in ast.walk(tree)
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [str(node.module)]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert not imported & {"pneud", "pure2c", "hil"}


def test_the_checksum_is_the_one_of_the_bus() -> None:
    assert rig.crc8(0x3231, b"3456789") == 0x4B
    assert rig.crc8(0x181, bytes(7)) == 0xB6


def test_answers_decode(nodes: rig.Nodes, codecs: Codecs) -> None:
    for n in range(300):  # counters wrap
        answers = dict(nodes.hear(rig.SYNC, bytes((n % 240 + 1,)), START_NS + n * MS))
        assert list(answers) == [0x181, 0x182, 0x183]
        for codec in (codecs.encoder, codecs.pressure, codecs.valve_status):
            data = answers[codec.can_id]
            assert len(data) == 8
            assert codec.valid(data)
            assert codec.counter(data) == (n + 1) % 256
    position, flags, _ = codecs.encoder.decode(answers[0x181])
    assert position == pytest.approx(nodes.state[rig.X], abs=3 * nodes.sensors.step_m)
    assert flags == EncoderStatus.REFERENCED
    p1, p2, supply = codecs.pressure.decode(answers[0x182])
    assert (p1, p2) == pytest.approx((nodes.state[rig.P1], nodes.state[rig.P2]), abs=4000.0)
    assert supply == pytest.approx(nodes.p.supply, abs=4000.0)
    assert codecs.valve_status.decode(answers[0x183]) == (0.0, ValveState.CENTRED)


def test_bytes_are_those_of_the_document(nodes: rig.Nodes) -> None:
    (_, encoder), (_, pressure), (_, valve) = nodes.hear(rig.SYNC, b"\1", START_NS)
    um = int.from_bytes(encoder[:4], "little", signed=True)
    assert um * 1e-6 == pytest.approx(nodes.state[rig.X], abs=3 * nodes.sensors.step_m)
    assert encoder[4] == 1
    assert encoder[5] == 255  # its clock is long past that stamp
    assert int.from_bytes(pressure[4:6], "little") * 20.0 == pytest.approx(nodes.p.supply, abs=4000.0)
    assert valve[:6] == bytes((0, 0, 1, 0, 0, 0))


def test_a_command_is_applied(nodes: rig.Nodes, codecs: Codecs) -> None:
    nodes.hear(rig.COMMAND, command(codecs, 1.25, 1, 7), START_NS)
    assert nodes.valve == ValveState.ENABLED
    applied, state = status(nodes, codecs, START_NS + MS)
    assert applied == pytest.approx(1.25, abs=5e-3)
    assert state == ValveState.ENABLED
    assert (
        nodes.hear(rig.COMMAND, command(codecs, 2.0, 1, 7), START_NS + MS) == []
    )  # its counter stands still
    corrupt = bytearray(command(codecs, 2.0, 1, 8))
    corrupt[0] ^= 1
    nodes.hear(rig.COMMAND, bytes(corrupt), START_NS + MS)
    assert status(nodes, codecs, START_NS + 2 * MS)[0] == pytest.approx(1.25, abs=5e-3)


def test_a_valve_without_commands_closes_until_it_is_disabled(nodes: rig.Nodes, codecs: Codecs) -> None:
    nodes.hear(rig.COMMAND, command(codecs, 1.0, 1, 1), START_NS)
    assert status(nodes, codecs, START_NS + 49 * MS)[1] == ValveState.ENABLED
    assert status(nodes, codecs, START_NS + 51 * MS) == (0.0, ValveState.TIMED_OUT)
    nodes.hear(rig.COMMAND, command(codecs, 1.0, 1, 2), START_NS + 52 * MS)
    assert status(nodes, codecs, START_NS + 53 * MS) == (0.0, ValveState.TIMED_OUT)
    nodes.hear(rig.COMMAND, command(codecs, 0.0, 0, 3), START_NS + 54 * MS)
    nodes.hear(rig.COMMAND, command(codecs, 1.0, 1, 4), START_NS + 55 * MS)
    assert status(nodes, codecs, START_NS + 56 * MS)[1] == ValveState.ENABLED


def test_truth_is_told_at_every_sync(nodes: rig.Nodes) -> None:
    nodes.offset_ns = 3
    for n in range(3):
        nodes.hear(rig.SYNC, b"\1", START_NS + n * MS)
    assert nodes.truth[0::2].tolist() == [START_NS + n * MS - 3 for n in range(3)]
    assert nodes.truth[-1] == nodes.state[rig.X]


@pytest.mark.parametrize("size", rig.SIZES)
def test_it_rests_where_it_is_with_little_leakage(size: str) -> None:
    physics, _ = rig.drawn(rig.SIZES[size], 1)
    state = advanced(rig.at_rest(physics, 0.4 * physics.stroke), 0.0, 0.2, physics)
    assert abs(state[rig.X] - 0.4 * physics.stroke) < 3e-6
    assert abs(state[rig.V]) < 1e-4


def test_it_rests_without_air() -> None:
    physics, _ = rig.drawn(rig.SIZES["cyl25x200"], 1)
    physics = physics._replace(supply=rig.ROOM_PA)
    state = advanced(rig.at_rest(physics, 0.05, rig.ROOM_PA), 5.0, 0.3, physics)
    assert state[rig.X] == pytest.approx(0.05, abs=1e-9)
    assert state[rig.P1] == pytest.approx(rig.ROOM_PA, abs=1.0)


def test_mass_stays_where_nothing_flows() -> None:
    physics = closed("cyl25x200", piston_seep=0.0)
    state = rig.at_rest(physics, 0.1)
    masses = state[rig.M1], state[rig.M2]
    state[rig.V] = 0.5
    advanced(state, 5.0, 0.1, physics)
    assert (state[rig.M1], state[rig.M2]) == masses


def test_what_leaks_over_the_piston_is_not_lost() -> None:
    physics = closed("cyl25x200")._replace(conductance=1e-8, seep=0.0, soft=1e-6, piston_seep=0.1)
    state = rig.at_rest(physics, 0.1)
    before = state[rig.M1], state[rig.M2]
    assert state[rig.P2] > 1.05 * state[rig.P1]
    advanced(state, 0.0, 0.1, physics)
    assert state[rig.M1] > 1.001 * before[0]
    assert state[rig.M1] + state[rig.M2] == pytest.approx(sum(before), rel=1e-9)


def test_energy_stays_but_for_friction() -> None:
    physics = closed("cyl63x600", piston_seep=0.0)
    area = physics.area1 - physics.area2

    def energy(s: list[float]) -> float:
        moving = 0.5 * physics.mass * s[rig.V] ** 2 + rig.ROOM_PA * area * s[rig.X]
        return float(s[rig.U1] + s[rig.U2] + moving + s[rig.LOST])

    state = rig.at_rest(physics, 0.3)
    state[rig.V] = 1.0
    before = energy(state)
    advanced(state, 0.0, 0.5, physics)
    assert state[rig.LOST] > 1.0
    assert energy(state) == pytest.approx(before, abs=0.02 * 0.5 * physics.mass)


def test_friction_takes_energy_on_every_closed_way() -> None:
    physics, _ = rig.drawn(rig.SIZES["cyl16x100"], 1)
    chance = random.Random(1)
    for reach in (2e-6, 2e-5, 2e-4, 2e-3):
        state, taken, h = [0.0] * rig.STATE, 0.0, 1e-4
        for n in range(4000):  # ends where it began; the first two rounds bring the elements into it
            state[rig.V] = 2.0 * math.pi * reach * 5.0 * math.cos(2.0 * math.pi * 5.0 * n * h)
            force = rig.friction(state, 3e5 + chance.uniform(-1e3, 1e3), h, physics)
            taken += force * state[rig.V] * h if n >= 2000 else 0.0
        assert taken > 0.0


def test_flow_is_choked_then_falls_and_has_a_sign() -> None:
    def at(p_b: float) -> float:
        return rig.flow(6e5, rig.ROOM_K, p_b, rig.ROOM_K, 1e-8, 0.3)

    assert at(1e5) == at(1.7e5) == pytest.approx(1e-8 * 1.185 * 6e5)
    assert at(1.7e5) > at(3e5) > at(5e5) > at(5.99e5) > at(6e5) == 0.0
    assert rig.flow(1e5, 300.0, 2e5, 300.0, 1e-8, 0.3) == -rig.flow(2e5, 300.0, 1e5, 300.0, 1e-8, 0.3)


def test_air_cools_as_it_leaves_and_the_wall_warms_it() -> None:
    physics, _ = rig.drawn(rig.SIZES["virtual"], 1)
    state = advanced(rig.at_rest(physics, 0.02), -5.0, 0.05, physics)
    assert state[rig.U1] / state[rig.M1] / rig.CV < 280.0
    still = closed("virtual", mass=1e9, piston_seep=0.0)._replace(wall=60.0)
    state = rig.at_rest(still, 0.02)
    state[rig.U1] *= 0.9
    advanced(state, 0.0, 0.5, still)
    assert 0.95 * rig.ROOM_K < state[rig.U1] / state[rig.M1] / rig.CV < rig.ROOM_K


def test_a_seed_is_a_rig() -> None:
    size = rig.SIZES["virtual"]
    assert rig.drawn(size, 3) == rig.drawn(size, 3) != rig.drawn(size, 4)
    for seed in range(50):
        physics, _ = rig.drawn(size, seed)
        assert abs(physics.mass / size.mass_kg - 1.0) <= 0.1
        assert all(0.075 <= edge <= 0.125 for edge in physics.edges)


@pytest.mark.slow
@pytest.mark.realtime
def test_the_axis_is_judged_on_it() -> None:
    asked = ["--plant", "second", "--seconds", "1", "--moves", "1", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "hil.strange", *asked], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 1), done.stderr
    report = json.loads(done.stdout)
    (case,) = report["cases"]
    assert report["met"] == case["met"] == (done.returncode == 0)
    assert not case["faults"]
    assert not case["trouble"]
    assert case["against"] == "truth"
    assert case["sine_after"]["rms_mm"] < 1.0
    assert [move["move"] for move in case["moves"]] == ["+1 mm"]
    assert case["moves"][0].keys() == {"move", "max_error_mm", "overshoot_mm", "settled_s"}
    assert len(case["creep"]) == 2
    for creep in case["creep"]:
        assert creep.keys() == {"peak_to_peak_mm", "with_breakaway_mm", "swing_hz", "standing"}
        assert None not in creep.values()
    assert case["rest"].keys() == {"error_mm", "mean_step_v"}
    assert {goal["what"] for goal in case["goals"]} == {"moves", "overshoot", "rest", "creep"}
    assert case["host"]["ticks"] > 10_000
