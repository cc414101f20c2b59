"""Codecs: bit-exact against cantools, and plain words for a database that cannot be used."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any, NamedTuple

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneud import resources
from pneud.bus import crc8
from pneud.bus.codec import Codec, Codecs, DatabaseError, load_codecs
from pneud.config.bus_tables import BusConfig

DBC = resources.configs() / "pneud.dbc"
CODECS = load_codecs(BusConfig(), DBC)
DATABASE: Any = cantools.database.load_file(DBC)
ROLES = ("sync", "encoder", "pressure", "valve_status", "valve_command")


def frames_of(bus: BusConfig, role: str) -> Any:
    return getattr(bus.frames, role)


def test_checksum_matches_the_published_check_values() -> None:
    assert crc8.crc8(b"123456789") == 0x4B
    assert crc8.crc8(b"\x81\x01" + bytes(7)) == 0xB6
    assert CODECS.encoder.encode(0.0, 0, 0.0, counter=0) == bytes(7) + b"\xb6"


@given(st.binary(max_size=20), st.binary(max_size=20))
def test_checksum_can_be_continued(head: bytes, tail: bytes) -> None:
    assert crc8.update(tail, crc8.update(head)) == crc8.update(head + tail)


def test_identifiers_and_limits_are_those_of_the_database() -> None:
    assert [getattr(CODECS, role).can_id for role in ROLES] == [0x080, 0x181, 0x182, 0x183, 0x203]
    assert [getattr(CODECS, role).length for role in ROLES] == [1, 8, 8, 8, 8]
    assert CODECS.command_lsb_v == 0.0005
    assert (CODECS.command_min_v, CODECS.command_max_v) == (-5.0, 5.0)
    assert CODECS.older_s == 0.00255


@pytest.mark.parametrize("role", ROLES)
@given(data=st.binary(min_size=8, max_size=8))
def test_decoding_the_own_database_equals_cantools(role: str, data: bytes) -> None:
    codec: Codec = getattr(CODECS, role)
    frame = frames_of(BusConfig(), role)
    data = data[: codec.length]
    message = DATABASE.get_message_by_name(frame.message)
    truth = message.decode(data, decode_choices=False)
    assert codec.decode(data) == tuple(truth[name] for name in frame.signals.values())
    assert codec.counter(data) == truth[frame.counter]


@given(
    st.integers(-(2**31), 2**31 - 1),
    st.floats(-2147.483648, 2147.483647),
    st.integers(0, 7),
    st.integers(0, 255),
    st.integers(0, 255),
)
def test_encoding_the_own_database_equals_cantools(
    raw: int, position_m: float, status: int, age: int, counter: int
) -> None:
    message = DATABASE.get_message_by_name("ENCODER")
    for position in (position_m, raw * 1e-6):
        data = CODECS.encoder.encode(position, status, age * 1e-5, counter=counter)
        values = {
            "Position": position,
            "Status": status,
            "Age": age * 1e-5,
            "Counter": counter,
            "Crc": data[7],
        }
        assert data == message.encode(values, strict=False)
        assert CODECS.encoder.valid(data)


@given(st.integers(-10000, 10000))
def test_a_decoded_command_encodes_to_itself(raw: int) -> None:
    data = CODECS.valve_command.encode(raw * 0.0005, 1, 7, counter=3)
    assert int.from_bytes(data[:2], "little", signed=True) == raw
    assert CODECS.valve_command.encode(*CODECS.valve_command.decode(data), counter=3) == data
    assert data[4:6] == b"\0\0"


@pytest.mark.parametrize("steps", [0.5, 1.5, 2.5, -0.5, -1.5])
def test_halves_round_to_even(steps: float) -> None:
    data = CODECS.pressure.encode(1e5 + steps * 20, 0.0, 0.0, counter=0)
    assert CODECS.pressure.decode(data)[0] == 1e5 + 20 * round(steps)


@given(st.binary(min_size=8, max_size=8), st.integers(0, 63))
def test_one_flipped_bit_is_noticed(data: bytes, bit: int) -> None:
    state = crc8.identifier_state(CODECS.pressure.can_id)
    good = data[:7] + bytes((crc8.update(data[:7], state) ^ crc8.FINAL_XOR,))
    assert CODECS.pressure.valid(good)
    bad = (int.from_bytes(good, "big") ^ (1 << bit)).to_bytes(8, "big")
    assert not CODECS.pressure.valid(bad)
    assert not CODECS.encoder.valid(good), "the identifier is part of the checksum"


@given(st.binary(max_size=16))
def test_wrong_lengths_are_invalid_and_nothing_raises(data: bytes) -> None:
    for role in ROLES:
        codec: Codec = getattr(CODECS, role)
        assert not codec.valid(data) or len(data) == codec.length


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 5.0003, -5.0003, 1e300])
def test_what_the_command_cannot_carry_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match=r"VALVE_COMMAND.Voltage = .* is outside -5 … 5"):
        CODECS.valve_command.encode(value, 1, 1, counter=0)


def test_values_round_into_range_before_they_are_refused() -> None:
    assert CODECS.valve_command.encode(5.00024, 0, 1, counter=0)[:2] == (10000).to_bytes(2, "little")


@pytest.mark.parametrize(
    ("role", "values", "counter"),
    [
        ("valve_command", (0.0, 2, 1), 0),
        ("valve_command", (0.0, 1, 0), 0),
        ("valve_command", (0.0, 1, 241), 0),
        ("valve_status", (0.0, 5), 0),
        ("encoder", (0.0, 8, 0.0), 0),
        ("encoder", (0.0, 0, -0.00001), 0),
        ("sync", (), 0),
        ("sync", (), 241),
        ("pressure", (0.0, 0.0, 0.0), 256),
    ],
)
def test_declared_ranges_hold(role: str, values: tuple[float, ...], counter: int) -> None:
    with pytest.raises(ValueError, match="is outside"):
        getattr(CODECS, role).encode(*values, counter=counter)


# --- databases of others ---


class Placed(NamedTuple):
    name: str
    start: int
    length: int
    big: bool
    signed: bool
    factor: str
    offset: str
    unit: str

    def line(self) -> str:
        order, sign = "0" if self.big else "1", "-" if self.signed else "+"
        return (
            f" SG_ {self.name} : {self.start}|{self.length}@{order}{sign} "
            f'({self.factor},{self.offset}) [0|0] "{self.unit}" Vector__XXX'
        )


def place(rng: random.Random, names: list[tuple[str, int, int]], last_byte: bool) -> dict[str, Placed]:
    """Random places without overlap: (name, least, most bits) within 7 bytes, and Crc in the eighth."""
    while True:
        taken: set[tuple[int, int]] = set()
        placed = {}
        for name, least, most in names:
            length, big = rng.randint(least, most), rng.random() < 0.5
            if rng.random() < 0.4:
                length = min((8, 16, 32), key=lambda n: abs(n - length))
            at = rng.randrange(0, 56 - length + 1)
            if rng.random() < 0.5:
                at = at // 8 * 8
            if big:  # bits counted from the most significant one of byte 0
                bits = {(b // 8, 7 - b % 8) for b in range(at, at + length)}
                start = at // 8 * 8 + 7 - at % 8
            else:
                bits = {(b // 8, b % 8) for b in range(at, at + length)}
                start = at
            if bits & taken:
                break
            taken |= bits
            placed[name] = Placed(name, start, length, big, rng.random() < 0.5, "1", "0", "")
        else:
            big = rng.random() < 0.5
            if last_byte:
                placed["Crc"] = Placed("Crc", 63 if big else 56, 8, big, False, "1", "0", "")
            return placed


FACTORS = ("1", "0.5", "0.001", "1E-006", "20", "-0.25", "0.0030517578125")
UNITS = {"m": {"m": 1.0, "mm": 1e-3, "um": 1e-6}, "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6}}


def dbc_text(encoder: dict[str, Placed], length: int = 8, can_id: int = 0x181) -> str:
    """The own database with another ENCODER."""
    kept, inside = [], False
    for line in DBC.read_text(encoding="utf-8").splitlines():
        if line.startswith("BO_ "):
            inside = line.startswith("BO_ 385 ")
        if line.startswith(("CM_ SG_ 385", "CM_ BO_ 385")):
            continue
        if not inside or not line.startswith(("BO_ 385", " SG_")):
            kept.append(line)
    lines = "\n".join(p.line() for p in encoder.values())
    return "\n".join(kept) + f"\n\nBO_ {can_id} ENCODER: {length} ENCODER_NODE\n{lines}\n"


def encoder_bus(**changes: Any) -> BusConfig:
    frame = {
        "message": "ENCODER",
        "signals": {"position_m": "Position", "status": "Status", "age_s": "Age"},
    } | changes
    return BusConfig.model_validate({"frames": {"encoder": frame}})


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32), data=st.data())
def test_any_layout_equals_cantools(
    tmp_path_factory: pytest.TempPathFactory, seed: int, data: st.DataObject
) -> None:
    rng = random.Random(seed)
    crc = rng.random() < 0.7
    names = [("Position", 1, 32), ("Status", 1, 8), ("Age", 2, 12), ("Counter", 2, 8)]
    placed = place(rng, names, crc)
    placed["Counter"] = placed["Counter"]._replace(signed=False)
    for name, dimension in (("Position", "m"), ("Age", "s")):
        placed[name] = placed[name]._replace(
            factor=rng.choice(FACTORS),
            offset=rng.choice(("0", "-1.5", "100")),
            unit=rng.choice(list(UNITS[dimension])),
        )
    path = tmp_path_factory.getbasetemp() / "random.dbc"
    path.write_text(dbc_text(placed), encoding="utf-8")
    codec = load_codecs(encoder_bus(crc="Crc" if crc else None), path).encoder
    message: Any = cantools.database.load_file(path).get_message_by_name("ENCODER")  # type: ignore[union-attr]

    raw = data.draw(st.binary(min_size=8, max_size=8))
    truth = message.decode(raw, decode_choices=False)
    position_m, status, age_s = codec.decode(raw)
    position_unit, age_unit = UNITS["m"][placed["Position"].unit], UNITS["s"][placed["Age"].unit]
    assert position_m == pytest.approx(truth["Position"] * position_unit, rel=1e-12, abs=1e-15)
    assert age_s == pytest.approx(truth["Age"] * age_unit, rel=1e-12, abs=1e-15)
    if position_unit == 1.0:
        assert position_m == truth["Position"]
    assert (status, codec.counter(raw)) == (truth["Status"], truth["Counter"])
    assert isinstance(position_m, float) and isinstance(status, int)

    encoded = codec.encode(position_m, status, age_s, counter=codec.counter(raw))
    assert codec.valid(encoded)
    values = {name: truth[name] for name in ("Position", "Status", "Age", "Counter")}
    if crc:
        values["Crc"] = encoded[7]
    assert encoded == message.encode(values, strict=False), "the same bits, and reserved ones zero"


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("signed", [False, True])
def test_a_signal_may_fill_the_whole_frame(tmp_path: Path, big: bool, signed: bool) -> None:
    path = tmp_path / "whole.dbc"
    whole = Placed("Position", 7 if big else 0, 64, big, signed, "1E-006", "0", "m")
    path.write_text(dbc_text({"Position": whole}), encoding="utf-8")
    bus = encoder_bus(signals={"position_m": "Position"}, counter=None, crc=None)
    codec = load_codecs(bus, path).encoder
    for data in (bytes(8), b"\xff" * 8, b"\x80" + bytes(7), bytes(7) + b"\x80", bytes(range(8))):
        value = int.from_bytes(data, "big" if big else "little", signed=signed)
        assert codec.decode(data) == (value * 1e-6, 1, 0.0), "what a device does not tell has its default"
        assert codec.counter(data) == 0
    assert codec.counter_values == 1


def test_pressures_and_volts_may_come_in_other_units(tmp_path: Path) -> None:
    text = DBC.read_text(encoding="utf-8")
    text = text.replace('P1 : 0|16@1+ (20,0) [0|1310700] "Pa"', 'P1 : 0|16@1+ (0.0002,0) [0|0] "bar"')
    text = text.replace('P2 : 16|16@1+ (20,0) [0|1310700] "Pa"', 'P2 : 16|16@1+ (0.02,0) [0|1310.7] "kPa"')
    text = text.replace(
        'Applied : 0|16@1- (0.0005,0) [-5|5] "V"', 'Applied : 0|16@1- (0.5,0) [-5000|5000] "mV"'
    )
    path = tmp_path / "units.dbc"
    path.write_text(text, encoding="utf-8")
    codecs = load_codecs(BusConfig(), path)
    own = CODECS.pressure.encode(123_460.0, 654_320.0, 600_000.0, counter=9)
    assert codecs.pressure.encode(123_460.0, 654_320.0, 600_000.0, counter=9) == own
    assert codecs.pressure.decode(own) == (123_460.0, 654_320.0, 600_000.0)
    assert codecs.valve_status.decode(CODECS.valve_status.encode(-1.2345, 2, counter=0)) == (-1.2345, 2)


def changed(old: str, new: str) -> str:
    text = DBC.read_text(encoding="utf-8")
    assert old in text
    return text.replace(old, new)


BROKEN: dict[str, tuple[str, BusConfig, str]] = {
    "undefined": (
        DBC.read_text(encoding="utf-8")
        + '\nBA_ "SystemMessageLongSymbol" BO_ 385 "ENCODER_with_a_long_name";\n',
        BusConfig(),
        "not a usable DBC: it uses 'SystemMessageLongSymbol' and does not define it",
    ),
    "garbage": ("this is no database", BusConfig(), "not a usable DBC"),
    "empty": ('VERSION ""\n', BusConfig(), "message SYNC: not in the database"),
    "no message": (
        changed("BO_ 385 ENCODER:", "BO_ 385 OTHER:"),
        BusConfig(),
        "message ENCODER: not in the database",
    ),
    "no signal": (
        changed(' SG_ Supply : 32|16@1+ (20,0) [0|1310700] "Pa" CONTROLLER\n', ""),
        BusConfig(),
        "message PRESSURE, signal Supply: not in the message; it has: P1, P2, Counter, Crc",
    ),
    "extended": (
        changed("BO_ 386 ", "BO_ 2147484034 "),
        BusConfig(),
        "message PRESSURE: has a 29-bit identifier",
    ),
    "too long": (
        changed("BO_ 386 PRESSURE: 8", "BO_ 386 PRESSURE: 12"),
        BusConfig(),
        "PRESSURE: is 12 bytes long",
    ),
    "overlap": (changed("P2 : 16|16", "P2 : 15|16"), BusConfig(), "not a usable DBC"),
    "does not fit": (changed("BO_ 386 PRESSURE: 8", "BO_ 386 PRESSURE: 7"), BusConfig(), "not a usable DBC"),
    "multiplexed": (
        changed("SG_ State : 16|8", "SG_ State M : 16|8").replace("SG_ Applied : 0", "SG_ Applied m0 : 0"),
        BusConfig(),
        "message VALVE_STATUS: is multiplexed",
    ),
    "checksum too narrow": (
        changed("Crc : 56|8", "Crc : 56|4"),
        BusConfig(),
        "message ENCODER, signal Crc: the checksum of pneud is unsigned, with 8 bits, factor 1",
    ),
    "signed counter": (
        changed("Counter : 0|8@1+ (1,0) [1|240]", "Counter : 0|8@1- (1,0) [1|240]"),
        BusConfig(),
        "message SYNC, signal Counter: a counter is unsigned",
    ),
    "unknown unit": (
        changed('[-2147.483648|2147.483647] "m"', '[-2147.483648|2147.483647] "furlong"'),
        BusConfig(),
        "message ENCODER, signal Position: unit 'furlong'; position_m needs one of m, mm, um",
    ),
    "no unit": (
        changed('[0|1310700] "Pa"', '[0|1310700] ""'),
        BusConfig(),
        "message PRESSURE, signal P1: no unit; p1_pa needs one of Pa",
    ),
    "factor on a flag": (
        changed("Enable : 16|8@1+ (1,0)", "Enable : 16|8@1+ (2,0)"),
        BusConfig(),
        "message VALVE_COMMAND, signal Enable: enable needs factor 1 and offset 0",
    ),
    "float": (
        changed("CM_ BO_ 128", "SIG_VALTYPE_ 385 Position : 1;\nCM_ BO_ 128"),
        BusConfig(),
        "signal Position: is a floating-point signal",
    ),
    "role without signal": (
        changed("", ""),
        encoder_bus(signals={"status": "Status"}),
        "message ENCODER: no signal is named for position_m;"
        ' add signals.position_m = "NAME" under [bus.frames.encoder]',
    ),
    "unknown role": (
        changed("", ""),
        encoder_bus(signals={"position_m": "Position", "speed": "Age"}),
        "message ENCODER, signal speed: encoder has no such value; it has position_m, status, age_s",
    ),
    "one signal twice": (
        changed("", ""),
        encoder_bus(signals={"position_m": "Position", "status": "Counter"}),
        "message ENCODER, signal Counter: has two jobs",
    ),
    "two messages of one name": (
        changed("BO_ 386 PRESSURE:", "BO_ 400 ENCODER: 8 ENCODER_NODE\n\nBO_ 386 PRESSURE:"),
        BusConfig(),
        "message ENCODER: is there 2 times, as 0x181 and 0x190; give each its own name",
    ),
    "two signals of one name": (
        changed(' SG_ Status : 32|8@1+ (1,0) [0|7] ""', ' SG_ Position : 32|8@1+ (1,0) [0|7] "m"'),
        encoder_bus(signals={"position_m": "Position"}),
        "not a usable DBC",
    ),
    "a factor beyond all floats": (
        changed("Position : 0|32@1- (1E-006,0)", "Position : 0|32@1- (1E999,0)"),
        BusConfig(),
        "message ENCODER, signal Position: has a factor that cannot be meant",
    ),
    "an offset beyond all floats": (
        changed("Applied : 0|16@1- (0.0005,0)", "Applied : 0|16@1- (0.0005,-1E308)"),
        BusConfig(),
        "message VALVE_STATUS, signal Applied: has an offset that cannot be meant",
    ),
    "a factor next to nothing": (
        changed("Position : 0|32@1- (1E-006,0)", "Position : 0|32@1- (1E-320,0)"),
        BusConfig(),
        "message ENCODER, signal Position: has a factor that cannot be meant",
    ),
    "one message twice": (
        changed("", ""),
        BusConfig.model_validate(
            {"frames": {"encoder": {"message": "PRESSURE", "signals": {"position_m": "P1"}}}}
        ),
        "signal P1: unit 'Pa'; position_m needs one of",
    ),
    "two roles on one identifier": (
        changed("", ""),
        BusConfig.model_validate(
            {
                "frames": {
                    "valve_status": {
                        "message": "VALVE_COMMAND",
                        "signals": {"applied_v": "Voltage", "state": "Enable"},
                    }
                }
            }
        ),
        "0x203 is valve_status and valve_command; each needs its own",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_database_that_cannot_be_used_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    text, bus, expected = BROKEN[case]
    path = tmp_path / "broken.dbc"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DatabaseError) as caught:
        load_codecs(bus, path)
    assert expected in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


NO_RANGES = (
    "-1.79769313486232E+308|1.79769313486232E+308",  # as .NET writes the ends of a double
    "-1.7976931348623157e+308|1.7976931348623157e+308",
    "-1E999|1E999",
    "-3.4028235E+38|3.4028235E+38",
    "0|0",
    "0.0|0.0",
    "-0|0",
    "0|-0.0",
    "0.000000|0E0",
)


@pytest.mark.parametrize("range_", NO_RANGES)
@pytest.mark.parametrize("factor", ["1E-006", "-1E-006"])
def test_a_range_that_says_nothing_is_as_none(tmp_path: Path, range_: str, factor: str) -> None:
    path = tmp_path / "x.dbc"
    whole = "(1E-006,0) [-2147.483648|2147.483647]"
    path.write_text(changed(whole, f"({factor},0) [{range_}]"), encoding="utf-8")
    codec = load_codecs(BusConfig(), path).encoder
    sign = float(factor) * 1e6
    for raw in (-(2**31), 0, 2**31 - 1):
        data = codec.encode(raw * 1e-6 * sign, 1, 0.0, counter=0)
        assert data[:4] == raw.to_bytes(4, "little", signed=True)
        assert codec.decode(data)[0] == raw * float(factor)
    with pytest.raises(ValueError, match="outside"):
        codec.encode(2147.484 * sign, 1, 0.0, counter=0)


@pytest.mark.parametrize(
    ("range_", "low", "high"), [("0|1E999", 0, 2**31 - 1), ("-1E999|1", -(2**31), 10**6)]
)
def test_half_a_range_holds(tmp_path: Path, range_: str, low: int, high: int) -> None:
    path = tmp_path / "x.dbc"
    path.write_text(changed("[-2147.483648|2147.483647]", f"[{range_}]"), encoding="utf-8")
    codec = load_codecs(BusConfig(), path).encoder
    for raw in (low, high):
        assert codec.decode(codec.encode(raw * 1e-6, 1, 0.0, counter=0))[0] == raw * 1e-6
    for raw in (low - 1, high + 1):
        with pytest.raises(ValueError, match="outside"):
            codec.encode(raw * 1e-6, 1, 0.0, counter=0)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
@pytest.mark.parametrize("unit", ["µm", "um", "m"])
def test_any_encoding_that_a_dbc_may_have(tmp_path: Path, encoding: str, unit: str) -> None:
    text = changed('(1E-006,0) [-2147.483648|2147.483647] "m"', f'(1,0) [0|0] "{unit}"')
    text = text.replace("Stroke coordinate", "Größe des Hubs: Stroke coordinate")
    path = tmp_path / "x.dbc"
    path.write_bytes(text.replace("\n", "\r\n").encode(encoding))
    codec = load_codecs(BusConfig(), path).encoder
    factor = 1.0 if unit == "m" else 1e-6
    assert codec.decode(codec.encode(1000 * factor, 1, 0.0, counter=0))[0] == 1000 * factor


def test_what_two_other_messages_are_called_does_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "x.dbc"
    path.write_text(changed("BO_ 1793 HEARTBEAT_ENCODER", "BO_ 1793 EMCY_VALVE"), encoding="utf-8")
    assert load_codecs(BusConfig(), path).encoder.can_id == 0x181


def test_a_missing_database_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(DatabaseError, match=r"nowhere\.dbc: cannot be read: No such file"):
        load_codecs(BusConfig(), tmp_path / "nowhere.dbc")


def test_codecs_are_immutable() -> None:
    with pytest.raises(AttributeError):
        CODECS.command_lsb_v = 1.0  # type: ignore[misc]
    assert isinstance(CODECS, Codecs)


def test_a_device_may_have_neither_counter_nor_checksum() -> None:
    bus = BusConfig.model_validate(
        {
            "frames": {
                "encoder": {
                    "message": "ENCODER",
                    "signals": {"position_m": "Position"},
                    "counter": "",
                    "crc": "",
                }
            }
        }
    )
    codec = load_codecs(bus, DBC).encoder
    assert (codec.counter_values, codec.guard.crc) == (1, None)
    assert codec.check(bytes(8)) == 0
