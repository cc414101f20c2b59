"""Values filled from signals: bit-exact against cantools, and plain words for what cannot be mapped."""

from __future__ import annotations

import math
import random
import struct
from pathlib import Path
from typing import Any, NamedTuple

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneud import resources
from pneud.bus.codec import ROW, Answer, Codecs, DatabaseError, codecs_from
from pneud.bus.mapped_inbox import MappedInbox, inbox_of
from pneud.bus.wire import CAN_EFF_FLAG, wire_time_ns
from pneud.config.bus_tables import BusConfig
from pneud.config.models import GasConfig
from pneud.config.toml import changed_text, tables_of
from pneud.loading import devices_of, load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.safety.unnoticed import unnoticed
from pneud.signals import Defect, EncoderStatus, Frame, Source, ValveState

GAS = GasConfig(supply_pa=600_000.0)
HEAD = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A\n'
OUT = 'BO_ 512 OUT: 4 A\n SG_ Volt : 0|16@1- (0.001,0) [0|0] "V" A\n SG_ On : 16|8@1+ (1,0) [0|1] "" A\n'
OWN = {"voltage_v": "OUT.Volt", "enable": "OUT.On"}


def bus_of(signals: dict[str, Any], messages: dict[str, Any] | None = None, **more: Any) -> BusConfig:
    return BusConfig.model_validate({"signals": OWN | signals, "messages": messages or {}, **more})


def codecs_of(text: str, signals: dict[str, Any], messages: dict[str, Any] | None = None) -> Codecs:
    return codecs_from(bus_of(signals, messages), Path("x.dbc"), (HEAD + text + OUT).encode(), GAS)


class Placed(NamedTuple):
    name: str
    start: int
    length: int
    big: bool
    signed: bool
    floating: bool
    factor: str
    offset: str
    kind: str = ""  # "M ", "m0 ", …

    def line(self) -> str:
        order, sign = "0" if self.big else "1", "-" if self.signed or self.floating else "+"
        return (
            f" SG_ {self.name} {self.kind}: {self.start}|{self.length}@{order}{sign} "
            f'({self.factor},{self.offset}) [0|0] "" A\n'
        )


def place(rng: random.Random, name: str, free: set[int], kind: str, size: int) -> Placed | None:
    """A signal in bits that are free, counted from the first of byte 0 in the order that it has itself."""
    floating, big = rng.random() < 0.3, rng.random() < 0.5
    length = rng.choice((32, 64)) if floating else rng.choice((*range(1, 33), 8, 16, 32, 64))
    at = rng.randrange(0, 8 * size + 1 - length)
    at = at // 8 * 8 if rng.random() < 0.5 else at
    bits = {b // 8 * 8 + (7 - b % 8 if big else b % 8) for b in range(at, at + length)}
    if not bits <= free:
        return None
    free -= bits
    start = at // 8 * 8 + 7 - at % 8 if big else at
    factor = rng.choice(("1", "0.5", "-0.001", "1E-006", "-20"))
    return Placed(
        name, start, length, big, rng.random() < 0.5, floating, factor, rng.choice(("0", "-1.5")), kind
    )


def layout(rng: random.Random, size: int) -> tuple[list[Placed], bool]:
    """One message with position and pressures, or as many of them as find a place; multiplexed or not."""
    multiplexed = rng.random() < 0.4
    whole = set(range(8 * size))
    placed = []
    if multiplexed:
        selector = Placed("Mux", 0, 8, False, False, False, "1", "0", "M ")
        placed.append(selector)
        whole -= set(range(8))
    for i, name in enumerate(("Pos", "P1", "P2")):
        free = set(whole) if multiplexed else whole
        for _ in range(30):
            found = place(rng, name, free, f"m{i} " if multiplexed else "", size)
            if found is not None:
                placed.append(found)
                break
    return placed, multiplexed


def dbc_of(placed: list[Placed], extended: bool, size: int) -> str:
    number = 0x18FF1234 | CAN_EFF_FLAG if extended else 0x123
    here = {p.name for p in placed}
    text = f"BO_ {number} X: {size} A\n" + "".join(p.line() for p in placed)
    rest = [name for name in ("Pos", "P1", "P2") if name not in here]
    if rest:
        text += "BO_ 300 REST: 6 A\n" + "".join(
            f' SG_ {name} : {16 * i}|16@1- (1,0) [0|0] "" A\n' for i, name in enumerate(rest)
        )
    kinds = "".join(
        f"SIG_VALTYPE_ {number} {p.name} : {1 if p.length == 32 else 2};\n" for p in placed if p.floating
    )
    return text + "\n" + kinds


KEYS = {"Pos": "position_m", "P1": "p1_pa", "P2": "p2_pa"}


@settings(max_examples=120, deadline=None)
@given(seed=st.integers(0, 2**32), data=st.binary(min_size=64, max_size=64))
def test_any_layout_equals_cantools(seed: int, data: bytes) -> None:
    rng = random.Random(seed)
    size = rng.choice((8, 8, 12, 24, 48, 64))  # more than 8 bytes are of CAN FD
    placed, multiplexed = layout(rng, size)
    extended, data = rng.random() < 0.5, data[:size]
    text, here = dbc_of(placed, extended, size), {p.name for p in placed}
    signals = {
        key: {"signal": f"{'X' if name in here else 'REST'}.{name}", "unit": "m" if name == "Pos" else "Pa"}
        for name, key in KEYS.items()
    }
    bus = bus_of(signals, fd=size > 8)
    codecs = codecs_from(bus, Path("x.dbc"), (HEAD + OUT + text).encode(), GAS)
    database: Any = cantools.database.load_string(HEAD + OUT + text)
    message = database.get_message_by_name("X")
    for answer in codecs.answers:
        if answer.name != "X":
            continue
        assert answer.codec.can_id == (0x18FF1234 | CAN_EFF_FLAG if extended else 0x123)
        frame = bytes((answer.kind or 0,)) + data[1:] if multiplexed else data
        truth = message.decode(frame, decode_choices=False)
        found = dict(zip(ROW, answer.codec.decode(frame), strict=True))
        again = {name: value for name, value in truth.items() if name in KEYS}
        for name, value in again.items():
            assert found[KEYS[name]] == pytest.approx(value, rel=1e-12, abs=1e-15, nan_ok=True)
        _check_encoding(answer, placed, message, truth, found)


def _check_encoding(answer: Answer, placed: list[Placed], message: Any, truth: Any, found: Any) -> None:
    floats = [KEYS[p.name] for p in placed if p.floating and p.name in KEYS and KEYS[p.name] in answer.filled]
    if any(not math.isfinite(found[key]) for key in floats):
        with pytest.raises(ValueError, match="outside"):
            answer.codec.encode(*found.values(), counter=0)
        return
    data = answer.codec.encode(*found.values(), counter=0)
    for name, value in message.decode(data, decode_choices=False).items():
        width = next(p.length for p in placed if p.name == name)
        assert value == pytest.approx(truth[name], rel=1e-6 if width == 32 else 2e-12, abs=1e-12), name


def test_a_double_is_itself_to_the_bit() -> None:
    text = 'BO_ 300 X: 8 A\n SG_ Pos : 7|64@0- (1,0) [0|0] "m" A\n'
    text += 'BO_ 301 Y: 8 A\n SG_ P1 : 0|32@1- (1,0) [0|0] "bar" A\n SG_ P2 : 32|32@1- (1,0) [0|0] "bar" A\n'
    text += "SIG_VALTYPE_ 300 Pos : 2;\nSIG_VALTYPE_ 301 P1 : 1;\nSIG_VALTYPE_ 301 P2 : 1;\n"
    codecs = codecs_from(
        bus_of({"position_m": "X.Pos", "p1_pa": "Y.P1", "p2_pa": "Y.P2"}),
        Path("x"),
        (HEAD + OUT + text).encode(),
        GAS,
    )
    row = (math.pi, 1, 0.0, 0.0, 3e5, 2e5, 0.0, 0.0, 0.0, 0)
    encoder, pressure = codecs.answers
    assert encoder.codec.encode(*row, counter=0) == struct.pack(">d", math.pi)
    assert pressure.codec.encode(*row, counter=0) == struct.pack("<ff", 3.0, 2.0)
    assert pressure.codec.decode(struct.pack("<ff", 3.0, 2.0))[4:6] == (3e5, 2e5)
    for wrong in (math.nan, math.inf):
        with pytest.raises(ValueError, match=r"X\.Pos = .* is outside"):
            encoder.codec.encode(wrong, *row[1:], counter=0)


# --- what signals are for the axis ---

PLAIN = (
    'BO_ 300 ENC: 8 A\n SG_ Pos : 0|32@1- (1,0) [0|0] "" A\n SG_ Word : 32|16@1+ (1,0) [0|0] "" A\n'
    ' SG_ Cnt : 48|8@1+ (1,0) [0|0] "" A\n SG_ Age : 56|8@1+ (0.1,0) [0|0] "ms" A\n'
    'BO_ 2566848512 PA: 2 A\n SG_ P : 0|16@1+ (0.001,0) [0|0] "bar" A\n'
    'BO_ 302 PB: 2 A\n SG_ P : 7|16@0- (0.001,0) [0|0] "bar" A\n'
)
ROLES = {
    "position_m": {"signal": "ENC.Pos", "counts_per_m": -1_000_000, "offset": 0.3},
    "p1_pa": {"signal": "PA.P", "gauge": True},
    "p2_pa": "PB.P",
}
T0, MS = 1_000_000_000, 1_000_000


def test_counts_gauge_pressures_and_constants() -> None:
    codecs = codecs_of(PLAIN, ROLES)
    enc, pa, pb = codecs.answers
    row = dict(
        zip(ROW, enc.codec.decode((100_000).to_bytes(4, "little", signed=True) + bytes(4)), strict=True)
    )
    assert row["position_m"] == pytest.approx(0.2, abs=1e-12)
    assert (row["status"], row["supply_pa"]) == (1, 600_000.0)
    assert pa.codec.can_id == 0x18FF0000 | CAN_EFF_FLAG
    assert pa.codec.decode((5000).to_bytes(2, "little"))[ROW.index("p1_pa")] == pytest.approx(601_000.0)
    assert pb.codec.decode((5000).to_bytes(2, "big"))[ROW.index("p2_pa")] == pytest.approx(500_000.0)
    assert codecs.sync.can_id == 0x080
    assert codecs.sync.encode(counter=7) == b""


def test_words_of_other_devices() -> None:
    roles = ROLES | {
        "status": {"signal": "ENC.Word", "mask": 0x000F, "values": {"1": 1, "3": 3, "8": 5}},
        "enable": {"signal": "OUT.On", "values": {"3": 0, "7": 1}},
    }
    text = OUT.replace("[0|1]", "[0|0]")
    codecs = codecs_from(bus_of(roles), Path("x"), (HEAD + PLAIN + text).encode(), GAS)
    for word, status in ((0xFFF1, 1), (0x0003, 3), (0x0008, 5), (0x0000, 4)):
        data = bytes(4) + word.to_bytes(2, "little") + bytes(2)
        assert codecs.encoder.decode(data)[1] == status
    assert codecs.encoder.decode(codecs.encoder.encode(0.1, 5, *[0.0] * 8, counter=0))[1] == 5
    assert [codecs.valve_command.encode(0.0, on, 0, counter=0)[2] for on in (0, 1)] == [3, 7]
    assert codecs.valve_command.decode(codecs.valve_command.encode(1.0, 1, 0, counter=0))[:2] == (1.0, 1)


class Talk:
    """Frames for a mapped inbox."""

    def __init__(
        self, text: str, roles: dict[str, Any], messages: dict[str, Any] | None = None, **more: Any
    ) -> None:
        bus = bus_of(roles, messages, **more)
        self.codecs = codecs_from(bus, Path("x.dbc"), (HEAD + text + OUT).encode(), GAS)
        inbox = inbox_of(self.codecs, bus)
        assert isinstance(inbox, MappedInbox)
        self.inbox = inbox
        self.counter = 0
        self.complete: list[bool] = []
        self.t_ns = T0

    def tick(self, *which: int, **values: float) -> Any:
        """One tick in which these of the answers come."""
        row = dict(zip(ROW, (0.2, 1, 0.0, 0.2, 3e5, 2e5, 1e5, 6e5, 0.0, 1), strict=True)) | values
        self.t_ns += MS
        self.counter += 1
        self.inbox.begin(self.t_ns)
        for i in which:
            codec = self.codecs.answers[i].codec
            count = self.counter % codec.counter_values
            data = codec.encode(*row.values(), counter=count)
            self.inbox.feed(Frame(self.t_ns + 200_000 + i, codec.can_id, data))
        self.complete.append(self.inbox.complete)
        found = self.inbox.measurement(0, 0)
        self.inbox.commanded_ns = self.t_ns + 400_000
        return found


def test_a_source_is_fresh_when_all_of_it_has_come() -> None:
    talk = Talk(PLAIN, ROLES)
    m = talk.tick(0, 1, 2)
    assert m.fresh == 7
    assert (m.position_m, m.p1_pa, m.p2_pa) == (pytest.approx(0.2), pytest.approx(3e5), 2e5)
    m = talk.tick(0, 1)
    assert talk.complete == [True, False]
    assert m.fresh == Source.ENCODER | Source.VALVE
    assert m.pressure_age_ns == MS - 200_002
    m = talk.tick(0, 2, p2_pa=2.5e5)  # what came in the last tick is not of this one
    assert m.fresh == Source.ENCODER | Source.VALVE
    assert m.p2_pa == 2.5e5
    assert talk.tick(1, 2).fresh == Source.PRESSURE | Source.VALVE


def test_what_the_valve_does_not_tell_is_what_it_was_told() -> None:
    talk = Talk(PLAIN, ROLES)
    m = talk.tick(0, 1, 2)
    assert (m.applied_v, m.valve_state, m.valve_age_ns) == (0.0, ValveState.CENTRED, 0)
    talk.inbox.echo = (1.5, 1)
    m = talk.tick(0)
    assert (m.applied_v, m.valve_state, m.fresh & Source.VALVE) == (1.5, ValveState.ENABLED, Source.VALVE)


@pytest.mark.parametrize("lacking", ["p1_pa", "p2_pa"])
def test_one_pressure_by_the_difference(lacking: str) -> None:
    roles = {k: v for k, v in ROLES.items() if k != lacking}
    talk = Talk(
        PLAIN + 'BO_ 303 DP: 2 A\n SG_ P : 0|16@1- (0.1,0) [0|0] "kPa" A\n', roles | {"difference_pa": "DP.P"}
    )
    m = talk.tick(0, 1, 2)
    assert (m.p1_pa, m.p2_pa) == (pytest.approx(3e5), pytest.approx(2e5))


def test_an_age_may_be_a_constant() -> None:
    talk = Talk(PLAIN, ROLES | {"age_s": 0.0003}, sync=False)
    talk.tick(0, 1, 2)
    m = talk.tick(1, 2)
    assert m.encoder_age_ns == MS - 200_000 + 300_000
    answering = Talk(PLAIN, ROLES | {"age_s": 0.0003})  # what was sampled before SYNC does not answer it
    assert answering.tick(0, 1, 2).encoder_defects == Defect.LATE


def test_two_encoders_have_to_agree() -> None:
    text = PLAIN + 'BO_ 304 ENC2: 4 A\n SG_ Pos : 0|32@1- (1,0) [0|0] "um" A\n'
    talk = Talk(text, ROLES | {"second_position_m": "ENC2.Pos"}, encoders_apart_m=2e-3)
    i = [a.name for a in talk.codecs.answers].index("ENC2")
    others = [k for k in range(4) if k != i]
    assert talk.tick(*range(4)).encoder_status == EncoderStatus.REFERENCED
    m = talk.tick(*range(4), second_position_m=0.2021)
    assert m.encoder_status == EncoderStatus.REFERENCED | EncoderStatus.ERROR
    assert m.fresh == 7
    assert talk.tick(*others).fresh == Source.PRESSURE | Source.VALVE


def test_a_counter_of_one_message_says_what_it_says_of_any() -> None:
    messages = {"ENC": {"counter": "Cnt"}}
    talk = Talk(PLAIN, ROLES | {"age_s": "ENC.Age"}, messages)
    assert talk.tick(0, 1, 2).fresh == 7
    talk.counter -= 1
    m = talk.tick(0, 1, 2)
    assert m.encoder_defects == Defect.FROZEN
    assert m.fresh == Source.PRESSURE | Source.VALVE
    talk.counter += 3
    assert talk.tick(0, 1, 2).fresh == 7
    assert talk.inbox.counts().lost == 3
    again = inbox_of(talk.codecs, bus_of(ROLES | {"age_s": "ENC.Age"}, messages))
    again.thaw(talk.inbox.freeze())
    assert again.freeze() == talk.inbox.freeze()


MUXED = (
    'BO_ 300 ENC: 4 A\n SG_ Pos : 0|32@1- (1,0) [0|0] "" A\n'
    'BO_ 301 AIR: 4 A\n SG_ Which M : 0|8@1+ (1,0) [0|0] "" A\n SG_ A m0 : 8|16@1+ (20,0) [0|0] "Pa" A\n'
    ' SG_ B m1 : 8|16@1+ (20,0) [0|0] "Pa" A\n SG_ Cnt : 24|8@1+ (1,0) [0|0] "" A\n'
)
MUX_ROLES = ROLES | {"p1_pa": "AIR.A", "p2_pa": "AIR.B"}


@pytest.mark.parametrize("counter", [None, "Cnt"])
def test_a_multiplexed_message_fills_a_source_over_several_ticks(counter: str | None) -> None:
    talk = Talk(MUXED, MUX_ROLES, {"AIR": {"counter": counter}} if counter else None)
    assert talk.tick(0, 1).fresh == Source.ENCODER | Source.VALVE
    m = talk.tick(0, 2)
    assert m.fresh == 7
    assert (m.p1_pa, m.p2_pa) == (3e5, 2e5)
    assert talk.tick(0, 1, p1_pa=4e5).fresh == Source.ENCODER | Source.VALVE
    assert talk.inbox.freeze().awaited == 2
    assert talk.tick(0, 2).p1_pa == 4e5
    if counter:
        talk.counter -= 1
        assert talk.tick(0, 1).pressure_defects & Defect.FROZEN


def test_free_sensors_need_no_sync() -> None:
    talk = Talk(PLAIN, ROLES, sync=False)
    talk.inbox.feed(Frame(T0 + 1, 300, bytes(8)))
    talk.inbox.begin(T0 + MS)
    m = talk.inbox.measurement(0, 0)
    assert m.fresh == Source.ENCODER | Source.VALVE
    assert m.encoder_offset_ns == 1 - MS - wire_time_ns(8, 1e6)


# --- the page ---


def test_the_example_of_the_documentation_is_a_rig(tmp_path: Path) -> None:
    page = (Path(__file__).parent.parent / "docs" / "mapping.md").read_text(encoding="utf-8")
    dbc, toml = (
        page.partition(f"```{kind}")[2].partition("\n")[2].partition("```")[0] for kind in ("text", "toml")
    )
    (tmp_path / "four.dbc").write_text(dbc)
    text = changed_text((resources.configs() / "virtual.toml").read_text(), tables_of(toml))
    (tmp_path / "four.toml").write_text(text)
    loaded = load(tmp_path / "four.toml")
    run = Simulation(loaded, 0.5, how=backend_of(loaded))
    assert {record.tick.latched for record in run.records()} == {0}
    assert run.inbox.counts().rx > 3 * 500
    blind = {one.name for one in unnoticed(devices_of(loaded.config, loaded.codecs)) if one.wholly}
    assert {"valve_missing", "supply_pressure", "encoder_frozen"} <= blind
    assert "encoder_error" not in blind


# --- what is wrong ---

WRONG: dict[str, tuple[str, dict[str, Any], dict[str, Any], str]] = {
    "no message": (PLAIN, ROLES | {"p1_pa": "NO.P"}, {}, "message NO: not in the database; [bus.signals]"),
    "no signal": (
        PLAIN,
        ROLES | {"p1_pa": "PA.Q"},
        {},
        "message PA, signal Q: not in the message; it has: P",
    ),
    "two jobs": (PLAIN, ROLES | {"p2_pa": "PA.P"}, {}, "signal P: is p1_pa and p2_pa; each needs its own"),
    "counter twice": (PLAIN, ROLES, {"ENC": {"counter": "Pos"}}, "is position_m and the counter; each needs"),
    "no value left": (
        PLAIN.replace(
            "PB: 2 A\n SG_ P : 7|16@0- (0.001,0) [0|0]", "PB: 2 A\n SG_ P : 7|16@0- (0.001,0) [90|99]"
        ),
        ROLES,
        {},
        "message PB, signal P: its minimum and maximum leave no value; mend them",
    ),
    "counter of SYNC twice": (
        PLAIN + 'BO_ 128 S: 2 A\n SG_ One : 0|8@1+ (1,0) [0|0] "" A\n SG_ Two : 8|8@1+ (1,0) [0|0] "" A\n',
        ROLES | {"sync": "S.One"},
        {"S": {"counter": "Two"}},
        "message S, signal One: and Two both count it; leave one out",
    ),
    "no unit": (
        PLAIN,
        ROLES | {"position_m": "ENC.Pos"},
        {},
        "no unit; position_m needs one: give unit, one of m",
    ),
    "wrong unit": (
        PLAIN,
        ROLES | {"p2_pa": {"signal": "PB.P", "unit": "psi"}},
        {},
        "unit 'psi'; p2_pa needs one",
    ),
    "age apart": (
        PLAIN + 'BO_ 310 AGE: 1 A\n SG_ Ms : 0|8@1+ (1,0) [0|0] "ms" A\n',
        ROLES | {"age_s": "AGE.Ms"},
        {},
        "age_s has to be in the frame of position_m",
    ),
    "too wide": (
        PLAIN,
        ROLES | {"enable": {"signal": "OUT.On", "values": {"0": 0, "300": 1}}},
        {},
        "300 is too wide for 8 bits",
    ),
    "no such state": (
        PLAIN,
        ROLES | {"state": {"signal": "ENC.Word", "values": {"0": 9}}},
        {},
        "state: 9 is none of 0 … 4",
    ),
    "half an enable": (
        PLAIN,
        ROLES | {"enable": {"signal": "OUT.On", "values": {"7": 1}}},
        {},
        "has to tell what 0 and what 1 are",
    ),
    "a mux that is never sent": (
        MUXED.replace("0|8@1+ (1,0)", "0|4@1+ (1,0)").replace("B m1", "B m17"),
        MUX_ROLES,
        {},
        "message AIR, signal Which: is never 17 in 4 bits",
    ),
    "two messages in one place": (
        PLAIN.replace("BO_ 302", "BO_ 512"),
        ROLES,
        {},
        "both are 0x200; each message needs its own",
    ),
    "the command in two": (
        PLAIN + 'BO_ 310 ON: 1 A\n SG_ On : 0|8@1+ (1,0) [0|0] "" A\n',
        ROLES | {"enable": "ON.On"},
        {},
        "the command is in OUT; all its values have to be in one message",
    ),
    "told of nothing": (PLAIN, ROLES, {"PX": {"counter": "C"}}, "message PX: fills no value"),
    "CAN FD": (
        PLAIN.replace("PB: 2 A", "PB: 12 A"),
        ROLES,
        {},
        "is 12 bytes long; classic CAN carries at most 8, CAN FD 64: see bus.fd",
    ),
    "a factor and no dimension": (
        PLAIN.replace("16@1+ (1,0)", "16@1+ (2,0)"),
        ROLES | {"status": "ENC.Word"},
        {},
        "has to be an integer",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_mapped_is_said_in_one_line(case: str) -> None:
    text, roles, messages, expected = WRONG[case]
    with pytest.raises(DatabaseError) as caught:
        codecs_of(text, roles, messages)
    assert expected in str(caught.value)
    assert str(caught.value).startswith("x.dbc: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("signals", "expected"),
    [
        ({"position_m": "ENC.Pos", "p1_pa": "PA.P"}, "give two of p1_pa, p2_pa and difference_pa"),
        (ROLES | {"p1_pa": 3e5}, "p1_pa: a signal has to tell it"),
        (ROLES | {"p1_pa": "PA"}, 'give "MESSAGE.SIGNAL"'),
        (ROLES | {"p1_pa": {"signal": "PA.P", "counts_per_m": 5}}, "counts are of position_m"),
        (ROLES | {"position_m": {"signal": "ENC.Pos", "gauge": True}}, "gauge is of p1_pa"),
        (ROLES | {"p1_pa": {"signal": "PA.P", "values": {"1": 1}}}, "mask and values are of"),
        (
            ROLES | {"position_m": {"signal": "A.B", "unit": "m", "m_per_count": 1}},
            "give one of unit, m_per_count",
        ),
        (ROLES | {"applied_volt": "A.B"}, "Extra inputs"),
    ],
)
def test_what_no_mapping_is(signals: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=expected.replace(".", r"\.")):
        bus_of(signals)


def test_frames_and_signals_exclude_each_other() -> None:
    frames = {"encoder": {"message": "ENC", "signals": {"position_m": "Pos"}}}
    with pytest.raises(ValueError, match="give either frames or signals"):
        bus_of(ROLES, frames=frames)
    with pytest.raises(ValueError, match="messages goes with signals"):
        BusConfig.model_validate({"messages": {"ENC": {"counter": "C"}}})


@pytest.mark.parametrize("none", ["none", "", False])
def test_a_frame_may_say_that_it_has_neither_counter_nor_checksum(none: Any) -> None:
    frames = {"encoder": {"message": "E", "counter": none, "crc": none}}
    encoder = BusConfig.model_validate({"frames": frames}).frames.encoder
    assert (encoder.counter, encoder.crc) == (None, None)
