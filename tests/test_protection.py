"""Rules for checksum and counter by name: published values, errors of one bit, counters that wrap."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pneud.bus.codec import Codec, Codecs, DatabaseError
from pneud.bus.inbox import Inbox
from pneud.bus.many import valid
from pneud.bus.protection import CCITT, H2F, J1850
from pneud.config.bus_tables import BusConfig
from pneud.signals import Frame
from protected import LAYOUTS, RULES, codecs_with

MS = 1_000_000


# AUTOSAR_SWS_CRCLibrary, "CRC results" of each standard
@pytest.mark.parametrize(
    ("data", "j1850", "h2f", "ccitt"),
    [
        ("00000000", 0x59, 0x12, 0x84C0),
        ("F20183", 0x37, 0xC2, 0xD374),
        ("0FAA0055", 0x79, 0xC6, 0x2023),
        ("00FF5511", 0xB8, 0x77, 0xB8F9),
        ("332255AABBCCDDEEFF", 0xCB, 0x11, 0xF53F),
        ("926B55", 0x8C, 0x33, 0x0745),
        ("FFFFFFFF", 0x74, 0x6C, 0x1D0F),
        ("313233343536373839", 0x4B, 0xDF, 0x29B1),
    ],
)
def test_checksums_are_the_published_ones(data: str, j1850: int, h2f: int, ccitt: int) -> None:
    frame = bytes.fromhex(data)
    assert (J1850(frame), H2F(frame), CCITT(frame)) == (j1850, h2f, ccitt)


# eight bytes, all data 0: AUTOSAR PRS_E2EProtocol R20-11, table 6.28, and the tests of PyPI's autosar-e2e
FRAMES = [
    ("e2e-p01", "CC 00", {}),
    ("e2e-p01", "91 01", {}),
    ("e2e-p01 alternating", "CE 00", {}),
    ("e2e-p01 alternating", "02 01", {}),
    ("e2e-p01 low", "CE 00", {}),
    ("e2e-p01 low", "93 01", {}),
    ("e2e-p01 nibble", "2A 10", {}),
    ("e2e-p01 nibble", "77 11", {}),
    ("e2e-p02", "1B 01", {}),
    ("e2e-p02", "45 01", {"data_id": (0,) * 16}),
    ("e2e-p05", "1C CA 00", {}),
    ("e2e-p05", "CF 8D 01", {}),
]


@pytest.mark.parametrize(("rule", "head", "changed"), FRAMES)
def test_frames_are_those_of_autosar(
    rule: str, head: str, changed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(LAYOUTS, "autosar", ("32|32@1-", "0|{bits}@1+", "{bits}|{counter}@1+", "12|4@1+"))
    frame = bytes.fromhex(head).ljust(8, b"\0")
    codec = codecs_with(rule, "autosar", **changed).encoder
    counter = frame[RULES[rule][0] // 8] & 0xF
    assert codec.encode(0.0, counter=counter) == frame
    assert codec.check(frame) == counter


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("rule", RULES)
def test_no_error_of_one_bit_stays_unnoticed(rule: str, layout: str) -> None:
    codec = codecs_with(rule, layout).encoder
    last = min(RULES[rule][2], RULES[rule][3].get("counter_max", 255))
    assert codec.counter_values == last + 1
    for position_m, counter in ((0.0, 0), (0.123456, 1), (-1e-6, last)):
        frame = codec.encode(position_m, counter=counter)
        assert codec.valid(frame) and codec.check(frame) == counter
        assert codec.decode(frame)[0] == pytest.approx(position_m, abs=1e-12)
        for bit in range(64):
            wrong = (int.from_bytes(frame, "little") ^ 1 << bit).to_bytes(8, "little")
            assert not codec.valid(wrong) and codec.check(wrong) == -1, bit
        assert codec.check(frame[:7]) == codec.check(frame + b"\0") == -1


@settings(max_examples=40)
@given(st.sampled_from(sorted(RULES)), st.binary(min_size=8, max_size=8), st.integers(0, 255))
def test_valid_and_check_and_report_agree(rule: str, data: bytes, counter: int) -> None:
    codec = codecs_with(rule).encoder
    for frame in (data, codec.encode(0.1, counter=counter % codec.counter_values)):
        assert codec.valid(frame) == (codec.check(frame) >= 0)
        word = np.array([int.from_bytes(frame, "little")], dtype=np.uint64)
        assert valid(codec, np.array([8]), word)[0] == codec.valid(frame)


def heard(codec: Codec, codecs: Codecs, counters: list[int]) -> Inbox:
    """An inbox that has heard these counts, one a tick."""
    inbox = Inbox(codecs, BusConfig())
    for tick, counter in enumerate(counters):
        inbox.begin(tick * MS)
        inbox.feed(Frame(tick * MS + 1000, codec.can_id, codec.encode(0.1, counter=counter)))
        inbox.measurement(0, 0)
    return inbox


@pytest.mark.parametrize("rule", ["e2e-p01", "xor8", "crc8-h2f", "e2e-p05"])
def test_a_counter_wraps_where_its_rule_says(rule: str) -> None:
    codecs = codecs_with(rule)
    codec, values = codecs.encoder, codecs.encoder.counter_values
    counts = heard(codec, codecs, [n % values for n in range(3 * values + 5)]).counts()
    assert (counts.lost, counts.late, counts.stale) == (0, 0, 0)
    missing = [n % values for n in range(3 * values) if n != values - 1]
    assert heard(codec, codecs, missing).counts().lost == 1


def test_a_count_beyond_the_last_is_corrupt() -> None:
    codec = codecs_with("e2e-p01").encoder
    with pytest.raises(ValueError, match=r"ENCODER\.Counter = 15"):
        codec.encode(0.1, counter=15)


@pytest.mark.parametrize(
    ("given_", "says"),
    [
        ({"protection": "e2e-p01"}, "takes 1 data_id, up to 65535"),
        ({"protection": "e2e-p02", "data_id": 3}, "takes 16 data_id, up to 255"),
        ({"protection": "e2e-p02", "data_id": (256,) * 16}, "takes 16 data_id, up to 255"),
        ({"data_id": 3}, "takes no data_id"),
        ({"data_id_mode": "low"}, 'is of protection = "e2e-p01"'),
        ({"protection": "e2e-p01", "data_id": 1, "data_id_mode": "nibble"}, "go together"),
        (
            {"protection": "e2e-p01", "data_id": 0x1000, "data_id_mode": "nibble", "data_id_nibble": "N"},
            "12 bits",
        ),
        ({"protection": "crc32"}, "Input should be"),
    ],
)
def test_what_a_rule_lacks_is_said(given_: dict[str, Any], says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        BusConfig.model_validate({"frames": {"encoder": {"message": "E", **given_}}})


@pytest.mark.parametrize(
    ("rule", "changed", "says"),
    [
        ("e2e-p05", {"counter": ""}, "needs a counter of 8 bits; look at bus.frames.encoder.counter"),
        ("e2e-p01", {"crc": ""}, "needs a checksum; look at bus.frames.encoder.crc"),
        ("e2e-p01", {"counter_max": 15}, "counter_max is beyond its last value, 14"),
        ("xor8", {"protection": "crc16-ccitt"}, "the checksum of crc16-ccitt is unsigned, with 16 bits"),
    ],
)
def test_a_frame_that_cannot_carry_its_rule_is_refused(rule: str, changed: dict[str, Any], says: str) -> None:
    with pytest.raises(DatabaseError, match=says):
        codecs_with(rule, **changed)
