"""CANopen nodes: EDS, frames, words, plans, the software nodes, and what the library makes of them."""

from __future__ import annotations

import json
import re
import struct
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("canopen")

from can import CanOperationError
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_bus import Wire, canopen, network_of
from commands import pneud
from pneud import resources
from pneud.bus.codec import ROW, Codec, Codecs
from pneud.bus.unixcan import UnixCanBus
from pneud.canopen import keeper, lss, objects, words
from pneud.canopen.eds import Eds, EdsError, parse_eds, read_eds
from pneud.canopen.frames import dbc_of
from pneud.canopen.master import BusError, Master, NodeError, Patience, network_on
from pneud.canopen.objects import Command, Nmt
from pneud.canopen.plan import plans_of
from pneud.config.models import Config
from pneud.config.nodes import NodeConfig, check_nodes
from pneud.config.proof import digest
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.loading import load
from pneud.rig.slave import KINDS, Oddity, Slave, drawn
from pneud.signals import Frame, ValveState
from pneud.study.plausibility import findings

PROFILES = ("encoder406", "analog404", "analog401", "valve408")
TEXT = (resources.configs() / "canopen.toml").read_text()


@cache
def eds(profile: str) -> Eds:
    return read_eds(resources.configs() / f"{profile}.eds")


@cache
def codecs() -> Codecs:
    return load("canopen.toml").codecs


def changed(old: str, new: str) -> Config:
    assert old in TEXT
    return parse(TEXT.replace(old, new, 1), "canopen.toml")


def told(codec: Codec, data: bytes, *keys: str) -> list[float]:
    row = codec.decode(data)
    return [row[ROW.index(key)] for key in keys]


def slave(profile: str = "valve408", node: int = 3, **odd: Any) -> Slave:
    made = Slave(eds(profile), node, 77, odd=Oddity(**odd))
    made.power_up(0)
    made.poll(10_000_000_000)
    return made


def ask(node: Slave, data: bytes, can_id: int | None = None, t_ns: int = 20_000_000_000) -> list[bytes]:
    node.on_frame(Frame(t_ns, objects.SDO_REQUEST_ID + node.id if can_id is None else can_id, data))
    return [frame.data for frame in node.poll(t_ns + 1_000_000_000)]


# EDS


@pytest.mark.parametrize("profile", PROFILES)
def test_an_eds_of_ours_says_the_same_to_the_library(profile: str) -> None:
    theirs = canopen.import_od(str(resources.configs() / f"{profile}.eds"), node_id=5)
    for (index, sub), entry in eds(profile).entries.items():
        variable = theirs.get_variable(index, sub)
        assert variable is not None
        assert variable.data_type == entry.object.type.code
        assert variable.access_type == entry.access
        if entry.object.type.size:
            assert variable.default == entry.object.type.decode(entry.initial(5))


def test_an_eds_is_read_leniently() -> None:
    position = "[6004]\nDataType=0x0004\nAccessType=RO\nLowLimit=0x80000000\nHighLimit=0x7FFFFFFF\n"
    rest = "[1800sub1]\nDataType=7\nDefaultValue= $NODEID + 0x180\n[2000]\nDataType=3\nLowLimit=what?\n"
    text = f"[DeviceInfo]\nVendorNumber=001\n{position}{rest}"
    found = parse_eds(text, "x.eds").entries
    assert (found[0x6004, 0].low, found[0x6004, 0].high) == (-(1 << 31), (1 << 31) - 1)
    assert found[0x1800, 1].initial(5) == (0x185).to_bytes(4, "little")
    assert found[0x2000, 0].low is None
    assert found[0x6004, 0].access == "ro"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "x.eds: no EDS: it has no objects"),
        ("nothing", "x.eds: no EDS: "),
        ("[1000]\nDataType=0x0007\nDefaultValue=seven\n", "x.eds: section [1000]: 'seven' is no number"),
        ("[1000]\nDataType=\n", "x.eds: section [1000]: a number is lacking"),
    ],
)
def test_an_eds_that_is_none_is_told_in_one_line(text: str, said: str) -> None:
    with pytest.raises(EdsError) as e:
        parse_eds(text, "x.eds")
    assert str(e.value).startswith(said)
    assert "\n" not in str(e.value)


@given(st.text(max_size=200))
def test_any_text_is_an_eds_or_none(text: str) -> None:
    try:
        parse_eds(text, "x.eds")
    except EdsError as e:
        assert "\n" not in str(e)


# frames and words


def test_the_frames_are_those_that_the_nodes_are_configured_to() -> None:
    found = codecs()
    assert found.sync.length == 0
    assert found.sync.encode(counter=7) == b""
    assert (found.encoder.can_id, found.pressure.can_id) == (0x281, 0x182)
    assert (found.valve_status.can_id, found.valve_command.can_id) == (0x183, 0x203)
    assert told(found.encoder, struct.pack("<i", 123_456), "position_m") == pytest.approx([0.123456])
    pressures = struct.pack("<3h", 1000, 2000, 6000)
    assert told(found.pressure, pressures, "p1_pa", "p2_pa", "supply_pa") == [1e5, 2e5, 6e5]


@given(st.floats(-5.0, 5.0), st.booleans())
def test_a_command_is_a_control_word_and_a_setpoint(voltage_v: float, enable: bool) -> None:
    control, setpoint = struct.unpack(
        "<Hh", codecs().valve_command.encode(voltage_v, int(enable), 9, counter=3)
    )
    assert control == (7 if enable else 3)
    assert setpoint == round(voltage_v / 5.0 * 16384)
    assert codecs().valve_command.decode(struct.pack("<Hh", control, setpoint))[:2] == (
        setpoint * 5.0 / 16384,
        enable,
    )


def test_a_status_word_is_a_state_whatever_stands_in_its_other_bits() -> None:
    for bits in range(1 << 16):
        data = struct.pack("<Hh", bits, 0)
        (state,) = told(codecs().valve_status, data, "state")
        if bits & 16:
            assert state == ValveState.FAULT  # local
        elif bits & 15 in (11, 15):
            assert state == (ValveState.CENTRED, ValveState.ENABLED)[bits & 15 == 15]
        else:
            assert state in (ValveState.BOOT, ValveState.TIMED_OUT, ValveState.FAULT)


def test_a_disabled_valve_is_no_centred_one() -> None:
    assert words.valve_state(words.Status.DISABLED) == ValveState.FAULT
    for state in ValveState:
        assert words.valve_state(words.status_of(state)) == state


def test_the_dbc_is_the_same_for_the_same_nodes_and_another_for_others() -> None:
    config = load("canopen.toml").config
    assert dbc_of(config) == dbc_of(parse(TEXT, "x"))
    assert dbc_of(config) != dbc_of(changed("step_m = 1e-6", "step_m = 5e-6"))


def test_inputs_of_an_io_module_have_the_range_that_is_given() -> None:
    config = changed('profile = "analog404"', 'profile = "analog401"\nrange_pa = [-1e5, 1e6]')
    text = dbc_of(config)
    assert "BO_ 642 NODE2_TPDO2: 6 NODE2" in text
    assert f"({1.1e6 / 32767!r},-100000.0)" in text


# configurations


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("id = 2", "id = 1", "node 1 is there twice"),
        ('roles = ["p1", "p2", "supply"]', 'roles = ["p1", "supply"]', "the role p2 is filled by no node"),
        ("sync = true", "sync = false", "nodes are configured to answer SYNC"),
        ('roles = ["p1", "p2", "supply"]', 'roles = ["p1", "p1", "supply"]', "the role p1 is filled 2 times"),
        ('roles = ["p1", "p2", "supply"]', 'roles = ["position"]', "analog404 has no position"),
        ("id = 3", "id = 200", "less than or equal to 127"),
        ('dead_band = "off"', 'dead_band = "valve"', "the dead band is made up for twice"),
        ("step_m = 1e-6", "pdo = 1", "pdo 1 of an encoder"),
    ],
)
def test_nodes_that_cannot_be_are_told_in_one_line(old: str, new: str, said: str) -> None:
    with pytest.raises(ConfigError) as e:
        changed(old, new)
    assert said in str(e.value)
    assert "\n" not in str(e.value)


def test_without_nodes_nothing_is_different() -> None:
    config = load("virtual.toml").config
    assert config.bus.nodes == ()
    assert config.bus.dbc == "pneud.dbc"


def test_a_value_of_ones_own_has_the_type_of_the_eds_or_is_given_one() -> None:
    def steps(write: str) -> list[tuple[str, str, int]]:
        plan = plans_of(changed("step_m = 1e-6", f"write = [{write}]"))[0]
        return [(s.object.address, s.object.type.name, s.value) for s in plan.steps][-1:]

    assert steps("{index = 0x6003, value = -5}") == [("0x6003:00", "i32", -5)]
    assert steps('{index = 0x2100, sub = 3, value = 5, type = "u16"}') == [("0x2100:03", "u16", 5)]
    with pytest.raises(EdsError, match=r"0x2100:03: .*encoder406\.eds has no such object; give its type"):
        steps("{index = 0x2100, sub = 3, value = 5}")
    with pytest.raises(EdsError, match="70000 does not fit its type u16"):
        steps("{index = 0x6000, value = 70000}")


def test_an_encoder_sends_with_sync_and_not_when_it_moves() -> None:
    steps = plans_of(load("canopen.toml").config)[0].steps
    assert {s.object.address: s.value for s in steps}["0x1801:02"] == 1
    assert {s.object.address: s.value for s in steps}["0x1800:01"] == 0x8000_0181


# software nodes


def test_a_node_boots_beats_and_obeys() -> None:
    node = Slave(eds("encoder406"), 1, 77, odd=Oddity(boot_ms=100.0))
    node.power_up(0)
    assert node.poll(99_000_000) == []
    assert node.poll(100_000_000) == [Frame(100_000_000, 0x701, b"\0")]
    assert ask(node, struct.pack("<BHBI", 0x2B, 0x1017, 0, 50), t_ns=200_000_000)[0][0] == 0x60
    node.poll(300_000_000)
    node.on_frame(Frame(310_000_000, 0, bytes((Command.START, 0))))
    assert {f.data for f in node.poll(10_500_000_000)} == {bytes((Nmt.OPERATIONAL,))}
    node.on_frame(Frame(400_000_000, 0, bytes((Command.RESET, 2))))
    assert int(node.state) == Nmt.OPERATIONAL
    node.on_frame(Frame(400_000_000, 0, bytes((Command.RESET, 1))))
    assert int(node.state) == Nmt.BOOT
    assert node.get(0x1017, 0) == 0  # which was not stored


@settings(max_examples=40)
@given(st.lists(st.tuples(st.sampled_from((0x603, 0x000, 0x7E5, 0x080)), st.binary(max_size=8)), max_size=30))
def test_whatever_comes_is_answered_by_eight_bytes_or_not_at_all(frames: list[tuple[int, bytes]]) -> None:
    node, t_ns = slave(), 20_000_000_000
    for can_id, data in frames:
        t_ns += 1_000_000
        node.on_frame(Frame(t_ns, can_id, data))
        for frame in node.poll(t_ns + 900_000):
            assert frame.can_id in (0x583, 0x7E4, 0x703, 0x7E4) or frame.can_id - 0x580 in range(256)
            assert len(frame.data) == (1 if frame.can_id & 0x780 == 0x700 and frame.can_id != 0x7E4 else 8)


WRITABLE = [
    (o.index, o.sub, o.type)
    for key, entry in eds("encoder406").entries.items()
    if (o := entry.object).type.size and entry.access == "rw" and o.index >= 0x6000
]


@given(st.sampled_from(WRITABLE), st.integers(0, (1 << 32) - 1), st.booleans())
def test_what_is_written_is_read_in_one_piece_and_in_segments(
    at: tuple[int, int, objects.Type], value: int, segmented: bool
) -> None:
    index, sub, kind = at
    node, data = slave("encoder406", 1), (value & ((1 << 8 * kind.size) - 1)).to_bytes(kind.size, "little")
    if segmented:
        assert ask(node, struct.pack("<BHBI", 0x21, index, sub, kind.size))[0][0] == 0x60
        answer = ask(node, bytes(((7 - kind.size) << 1 | 1,)) + data.ljust(7, b"\0"))
        assert answer[0][0] == 0x20
    else:
        head = struct.pack("<BHB", 0x23 | (4 - kind.size) << 2, index, sub)
        assert ask(node, head + data.ljust(4, b"\0"))[0][0] == 0x60
    answer = ask(node, struct.pack("<BHBI", 0x40, index, sub, 0))
    assert answer[0][4 : 4 + kind.size] == data


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (struct.pack("<BHBI", 0x40, 0x5000, 0, 0), 0x06020000),
        (struct.pack("<BHBI", 0x40, 0x1018, 9, 0), 0x06090011),
        (struct.pack("<BHBI", 0x23, 0x1000, 0, 1), 0x06010002),
        (struct.pack("<BHBI", 0x23, 0x1017, 0, 1), 0x06070010),
        (struct.pack("<BHBI", 0x2F, 0x1A00, 0, 0), 0x08000022),  # mapping of a PDO that is in use
        (struct.pack("<BHBI", 0x2F, 0x1400, 2, 245), 0x06090030),
        (struct.pack("<BHBI", 0xE0, 0x1000, 0, 0), 0x05040001),
    ],
)
def test_a_node_refuses_by_the_standards_codes(request_: bytes, code: int) -> None:
    (answer,) = ask(slave(), request_)
    assert answer[0] == 0x80
    assert answer[1:4] == request_[1:4]
    assert int.from_bytes(answer[4:], "little") == code
    assert objects.abort_text(code).endswith(f"(abort 0x{code:08X})")


def test_each_kind_of_oddity_is_drawn_and_the_same_seed_draws_the_same() -> None:
    found = [drawn(seed, [(0x1017, 0)]) for seed in range(2 * len(KINDS))]
    assert [kind for kind, _ in found] == [*KINDS, *KINDS]
    assert found == [drawn(seed, [(0x1017, 0)]) for seed in range(2 * len(KINDS))]


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (0x8250, "a PDO with commands has not come in time"),
        (0x3210, "voltage"),
        (0x0000, "no error any more"),
    ],
)
def test_emergencies_are_said_in_words(code: int, said: str) -> None:
    assert objects.emergency_words(code) == said


# the library, in simulated time


def test_exchanged_hardware_is_refused_until_it_is_kept() -> None:
    line = failure(changed("step_m = 1e-6", "step_m = 1e-6\nidentity = {serial = 4711}"), serial=4712)
    assert line == (
        "node 1 (encoder406), 0x1018:04 serial: is 0x1268 and not 0x1267; "
        "the hardware was exchanged: pneud nodes keep takes it, then make the movement test"
    )


def test_a_valve_under_local_control_is_refused() -> None:
    config = load("canopen.toml").config
    line = failure(config, local=1)
    assert line.startswith("node 3 (valve408), 0x604F:00 local: is 1 and not 0; end local control")


def failure(config: Config, *, serial: int | None = None, local: int = 0) -> str:
    plans = plans_of(config)
    slaves = [Slave(plan.eds, plan.node.id, serial or 1) for plan in plans]
    wire = Wire(*slaves)
    slaves[2].set(0x604F, 0, local)
    with network_of(wire) as network, pytest.raises(NodeError) as e:
        Master(network, Patience(boot_s=1.0), pause=wire.pause, clock=wire.clock).configure(plans)
    return str(e.value)


def test_what_is_stored_is_there_after_a_reset_and_nothing_else_is() -> None:
    plans = plans_of(load("canopen.toml").config)
    for save in (False, True):
        slaves = [Slave(plan.eds, plan.node.id, 1) for plan in plans]
        wire = Wire(*slaves)
        with network_of(wire) as network:
            master = Master(network, pause=wire.pause, clock=wire.clock)
            assert len(master.compare(plans[0])) == 3
            master.configure(plans, save=save, start=False)
            assert master.compare(plans[0]) == []
            assert all(s.state == Nmt.PRE_OPERATIONAL for s in slaves)
            master.command(1, Command.RESET)
            wire.pause(1.0)
            assert len(master.compare(plans[0])) == (0 if save else 3)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_nodes_without_an_identifier_are_found_and_given_one(count: int) -> None:
    slaves = [Slave(eds("analog404"), 255, 0x5000_0000 + 7 * n) for n in range(count)]
    wire = Wire(*slaves, Slave(eds("encoder406"), 1, 5))
    with network_of(wire) as network:
        wire.pause(0.1)
        found = lss.scan(network)
        assert sorted(identity[3] for identity in found) == [0x5000_0000 + 7 * n for n in range(count)]
        for number, identity in enumerate(found):
            lss.give(network, identity, 20 + number)
        wire.pause(0.1)
        assert sorted(s.id for s in slaves) == list(range(20, 20 + count))
        assert lss.scan(network) == []


def test_two_sensors_with_one_identifier_are_told_apart_by_their_serial_numbers() -> None:
    slaves = [Slave(eds("analog404"), 2, serial) for serial in (100, 200)]
    wire = Wire(*slaves)
    with network_of(wire) as network:
        wire.pause(0.1)
        lss.give(network, (0xFFFFFFFE, 0x404, 0x10001, 200), 4, before=2)
        wire.pause(0.1)
        assert [s.id for s in slaves] == [2, 4]
        with pytest.raises(lss.LssError, match=r"no node with .* answers; see what stands on it"):
            lss.give(network, (0xFFFFFFFE, 0x404, 0x10001, 300), 5)


ONE_MORE = (
    '\n[[bus.nodes]]\nid = 4\nprofile = "analog401"\nroles = ["none", "supply"]\nrange_pa = [0.0, 1.6e6]\n'
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('unit = "mbar"', 'unit = "mbar"'),
        ('unit = "mbar"', 'unit = "Pa"\nbits = 32'),  # two PDOs
        ('roles = ["p1", "p2", "supply"]', 'roles = ["p2", "p1"]'),  # nobody tells the supply
        ("\n[[bus.nodes]]\nid = 3\n", f"{ONE_MORE}\n[[bus.nodes]]\nid = 3\n"),
        ('profile = "analog404"', 'profile = "analog401"'),
        ("step_m = 1e-6", "step_m = 2e-6"),
    ],
)
def test_other_nodes_lead_to_the_same_motion(old: str, new: str, tmp_path: Path) -> None:
    text = TEXT
    if ONE_MORE in new:  # it tells the supply
        text = text.replace('roles = ["p1", "p2", "supply"]', 'roles = ["p1", "p2"]', 1)
    assert old in text
    (tmp_path / "axis.toml").write_text(text.replace(old, new, 1))
    done = pneud("sim", tmp_path / "axis.toml", "--json", "--duration", 8, "-o", tmp_path / "run.mcap")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert (summary["state"], summary["faults"]) == ("tracking", [])
    assert summary["tracking_mm"]["rms"] < 0.02
    replayed = json.loads(pneud("replay", tmp_path / "run.mcap", "--json").stdout)
    assert replayed["identical"]


def test_the_nodes_of_the_page_are_those_of_an_axis() -> None:
    page = (Path(__file__).parent.parent / "docs" / "canopen.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    nodes = tuple(NodeConfig.model_validate(node) for node in tomllib.loads(block)["bus"]["nodes"])
    check_nodes(nodes)
    assert [(n.id, n.profile, n.filled) for n in nodes] == [
        (n.id, n.profile, n.filled) for n in load("canopen.toml").config.bus.nodes
    ]


def test_nodes_without_a_heartbeat_are_asked_for_their_state() -> None:
    text = TEXT
    for node in (1, 2, 3):
        text = text.replace(f"\nid = {node}\n", f"\nid = {node}\nguard = true\n", 1)
    config = parse(text, "x")
    assert all(message.heartbeat_timeout_ms is None for message in config.bus.messages.values())
    plans = plans_of(config)
    slaves = [Slave(plan.eds, plan.node.id, 1) for plan in plans]
    wire = Wire(*slaves)
    with network_of(wire) as network:
        Master(network, pause=wire.pause, clock=wire.clock).configure(plans)
    assert all(s.state == Nmt.OPERATIONAL for s in slaves)
    assert all(s.get(0x100C, 0) == 100 and s.get(0x1017, 0) == 0 for s in slaves)
    told = [frame.data[0] for frame in wire.heard if frame.can_id == 0x701][1:]
    assert {data & 0x7F for data in told} == {Nmt.OPERATIONAL}


def test_nodes_are_ready_for_the_axis_whose_they_are() -> None:
    readiness = keeper.Readiness([{1, 2}, {11}, set()])

    def ready() -> list[bool]:
        return [readiness.is_ready(axis) for axis in range(3)]

    readiness.tell({1, 2, 11})
    assert (readiness.ready, ready()) == (False, [False, False, True])
    readiness.tell({11})
    assert (readiness.ready, ready()) == (False, [True, False, True])
    readiness.tell(set())
    assert (readiness.ready, ready()) == (True, [True] * 3)
    readiness.lost = True
    assert (readiness.ready, ready()) == (False, [False, False, True])
    alone = keeper.Readiness()
    assert not alone.is_ready(0)
    alone.tell(set())
    assert alone.ready
    assert alone.is_ready(0)
    alone.lost = True
    assert not alone.is_ready(0)


def test_a_bus_that_fails_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise CanOperationError("Failed to transmit: [Errno 105]\nNo buffer space available")

    monkeypatch.setattr(UnixCanBus, "send", fail)
    with pytest.raises(BusError) as e, network_on("unixcan:fails") as network:
        Master(network).command(1, Command.START)
    assert str(e.value).startswith("unixcan:fails: Failed to transmit: [Errno 105] No buffer space available")


def test_check_says_what_is_left_to_nobody() -> None:
    def said(config: Config) -> str:
        return "; ".join(doubt.words for doubt in findings(config, 1e-3, 50.0))

    assert "may be any device" not in said(parse(TEXT, "x"))
    rig = TEXT.replace('channel = "auto"', 'channel = "socketcan:can0"', 1)
    assert "node 1 may be any device: pneud nodes keep" in said(parse(rig, "x"))
    assert "node 1 may" not in said(parse(rig.replace("step_m = 1e-6", "identity = {serial = 1}", 1), "x"))
    assert "does not watch that commands come" in said(changed('dead_band = "off"', "deadline = false"))
    alone = changed("compensate_dead_zone = true", "compensate_dead_zone = false")
    assert "nobody makes up for the valve's dead band" in said(alone)


def test_another_device_needs_another_movement_test() -> None:
    dbc = dbc_of(load("canopen.toml").config).encode()

    def of(config: Config) -> str:
        return digest(config, dbc)

    kept = changed("step_m = 1e-6", "step_m = 1e-6\nidentity = {serial = 4711}")
    assert of(kept) != of(parse(TEXT, "x"))
    assert of(kept) != of(changed("step_m = 1e-6", "step_m = 1e-6\nidentity = {serial = 4712}"))
