from __future__ import annotations

import random
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from log_samples import OFFSET_NS, bits, header, noisy, tick_at, write_log
from pneud.log.files import part
from pneud.log.files.naming import LogError
from pneud.log.files.reader import LogReader, read_log
from pneud.log.files.recovery import recover
from pneud.log.format.header import Detail
from pneud.log.format.meanings import SCHEMA
from pneud.log.format.records import COARSE_ERROR, FLOAT_ERROR, crc_of
from pneud.signals import Answer, Host, Record, Request, RequestKind, State, Timing

COUNT = 120
RECORDS = list(noisy(COUNT))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.mcap"
    write_log(path, RECORDS, per_chunk=20)
    return path


def test_full_detail_reads_back_to_the_bit(log: Path) -> None:
    reader = read_log(log)
    ticks = list(reader)
    assert [bits(t.record) for t in ticks] == [bits(r) for r in RECORDS]
    assert [t.number for t in ticks] == list(range(1, COUNT + 1))
    assert all(t.log_time_ns == t.t_ns + OFFSET_NS for t in ticks)
    assert (reader.truncated, reader.damage, reader.missing) == (False, "", 0)
    assert len(list(reader)) == COUNT  # an iteration begins anew


def test_compact_detail_keeps_frames_times_and_checks_exact(tmp_path: Path) -> None:
    write_log(tmp_path / "c.mcap", RECORDS, "compact")
    for tick, record in zip(read_log(tmp_path / "c.mcap"), RECORDS, strict=True):
        assert (tick.frames, tick.before, tick.sent, tick.timing) == (
            record.frames,
            record.before,
            record.sent,
            record.timing,
        )
        assert tick.check == crc_of(record.tick)
        assert tick.t_ns == record.tick.t_ns
        assert tuple(tick.estimate) == pytest.approx(tuple(record.tick.estimate), rel=COARSE_ERROR)
        assert tick.estimate.position_m == pytest.approx(record.tick.estimate.position_m, rel=FLOAT_ERROR)
        assert tick.estimate != record.tick.estimate


def test_requests_states_faults_and_truth_come_back(tmp_path: Path) -> None:
    tick = tick_at(5)._replace(
        request=Request(int(RequestKind.GOTO), (0.1, 0.0, -2.5)),
        present=1 << 63,
        latched=5,
        state=int(State.FAULT),
        answer=int(Answer.BLOCKED),
    )
    tick = tick._replace(measurement=tick.measurement._replace(skipped=3, host=int(Host.CLOCK_STEP)))
    record = Record(tick, Timing(1, -1, 3, 4, 5, 6), (), 0, (), float("nan"))
    write_log(tmp_path / "x.mcap", [record])
    (logged,) = read_log(tmp_path / "x.mcap")
    assert bits(logged.record) == bits(record)
    assert (logged.skipped, logged.host, logged.state) == (3, Host.CLOCK_STEP, State.FAULT)


def test_the_head_carries_configuration_dbc_and_metadata(log: Path) -> None:
    reader = read_log(log)
    h = header()
    assert (reader.config_name, reader.config_text) == (h.config_name, h.config_text)
    assert (reader.dbc_name, reader.dbc) == (h.dbc_name, h.dbc)
    assert (reader.rate_hz, reader.fault_names) == (h.rate_hz, h.fault_names)
    assert reader.metadata["seed"] == "7"
    expected = {"schema", "pneud", "python", "libc", "fingerprint", "host", "bus", "detail"}
    assert expected <= set(reader.metadata)


@pytest.mark.parametrize("detail", ["compact", "full"])
def test_mcap_and_protobuf_alone_can_decode_it(tmp_path: Path, detail: Detail) -> None:
    path = tmp_path / "log.mcap"
    write_log(path, RECORDS[:50], detail)
    program = """
import sys
sys.modules["pneud"] = None
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
counts, last = {}, {}
with open(sys.argv[1], "rb") as f:
    reader = make_reader(f, validate_crcs=True)
    classes = {}
    for schema, channel, message in reader.iter_messages():
        if schema.id not in classes:
            pool = descriptor_pool.DescriptorPool()
            for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(file)
            classes[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
        counts[channel.topic] = counts.get(channel.topic, 0) + 1
        last[channel.topic] = classes[schema.id].FromString(message.data)
    names = sorted(a.name for a in reader.iter_attachments())
tick, frames = last["/axis/tick"], last["/can/frames"].columns
state = tick.DESCRIPTOR.fields_by_name["state"].enum_type.values_by_number[tick.state].name
print(sorted(counts.items()), names, state, sorted(c.can_id for c in frames), tick.timing.latency_ns)
data = next(c.data for c in frames if c.can_id == 0x181)
print(repr(tick.measurement.p1_pa), tick.t_ns, data[49::50].hex(), last["/events"].message)
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    record = RECORDS[49]
    counts = [("/axis/tick", 50), ("/can/frames", 1), ("/events", 1)]
    ids = [0x080, 0x181, 0x182, 0x183, 0x203]
    assert done.stdout.splitlines() == [
        f"{counts} ['pneud.dbc', 'virtual.toml'] STATE_TRACKING {ids} {record.timing.latency_ns}",
        f"{record.tick.measurement.p1_pa!r} {record.tick.t_ns} {record.frames[0].data.hex()} tracking",
    ]


def read_as_far_as_it_goes(path: Path) -> tuple[LogReader, list[int]] | None:
    """The reader and the ticks' times; None where the head already is missing (said in one line)."""
    try:
        reader = read_log(path)
    except LogError as e:
        assert "\n" not in str(e)
        assert str(path) in str(e)
        return None
    return reader, [t.t_ns for t in reader]


def test_cut_anywhere_it_reads_as_far_as_it_goes(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    times = [r.tick.t_ns for r in RECORDS]
    cut = tmp_path / "cut.mcap"
    rng = random.Random(3)
    most = 0
    end = len(data)
    positions = [*range(60), *(rng.randrange(end) for _ in range(100)), *range(end - 60, end)]
    for position in sorted(positions):
        cut.write_bytes(data[:position])
        got = read_as_far_as_it_goes(cut)
        if got is None:
            assert position < 5000
            continue
        reader, read = got
        assert read == times[: len(read)]
        assert reader.truncated
        assert str(position) in reader.damage
        assert len(read) >= most  # more bytes, no fewer ticks
        most = len(read)
    assert most == COUNT


def test_a_flipped_bit_never_passes_for_a_tick(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    times = [r.tick.t_ns for r in RECORDS]
    whole = [bits(r) for r in RECORDS]
    bad = tmp_path / "bad.mcap"
    rng = random.Random(4)
    damaged = 0
    for _ in range(80):
        position = rng.randrange(len(data))
        flipped = bytearray(data)
        flipped[position] ^= 1 << rng.randrange(8)
        bad.write_bytes(flipped)
        got = read_as_far_as_it_goes(bad)
        if got is None:
            continue
        reader, read = got
        if reader.truncated:
            damaged += 1
            assert reader.damage.startswith(("damaged at byte", "cut short at byte"))
            assert read == times[: len(read)]
        assert read == times or reader.truncated or reader.missing
        assert [bits(t.record) for t in reader] == whole[: len(read)]
    assert damaged > 40


def test_a_flipped_bit_in_the_attached_configuration_is_noticed(log: Path) -> None:
    data = log.read_bytes()
    log.write_bytes(data.replace(b'name = "virtual"', b'name = "virtuam"', 1))
    with pytest.raises(LogError, match="checksum of an attachment"):
        read_log(log)


def test_absurd_lengths_take_no_memory(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    first_chunk = data.index(b"zstd") - 4 - 4 - 8 - 16 - 9
    assert data[first_chunk] == 6
    size_at = first_chunk + 9 + 16
    for at, value in ((first_chunk + 1, 2**63), (first_chunk + 1, 2**40), (size_at, 2**62)):
        bad = tmp_path / "bad.mcap"
        bad.write_bytes(data[:at] + struct.pack("<Q", value) + data[at + 8 :])
        got = read_as_far_as_it_goes(bad)
        assert got is not None and got[0].truncated and got[1] == []


def test_foreign_files_are_refused_in_one_line(tmp_path: Path) -> None:
    text = tmp_path / "x.toml"
    text.write_text("name = 1\n")
    empty = tmp_path / "empty.mcap"
    empty.touch()
    foreign = tmp_path / "foreign.mcap"
    with foreign.open("wb") as f:
        writer = Writer(f)
        writer.start()
        schema = writer.register_schema("x", "json", b"{}")
        writer.add_message(writer.register_channel("/x", "json", schema), 1, b"{}", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    (tmp_path / "folder").mkdir()
    newer = tmp_path / "newer.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(part, "SCHEMA", 9)
        write_log(newer, [])
    for path, words in (
        (tmp_path / "none.mcap", "cannot be read: No such file"),
        (tmp_path / "folder", "holds no log"),
        (text, "not an MCAP file"),
        (empty, "is empty"),
        (foreign, "no log of pneud"),
        (newer, f"has log schema 9, this pneud reads {SCHEMA}; use the version that wrote it .[0-9]"),
    ):
        with pytest.raises(LogError, match=words) as caught:
            read_log(path)
        assert "\n" not in str(caught.value)
        assert caught.value.exit_code == 2


def test_a_cut_log_is_mended(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    cut, mended = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    cut.write_bytes(data[: len(data) * 3 // 5])
    before = read_log(cut)
    expected = [bits(t) for t in before]
    assert before.truncated and 0 < len(expected) < COUNT
    report = recover(cut, mended)
    assert report.damage == before.damage
    after = read_log(mended)
    assert [bits(t) for t in after] == expected
    assert (after.truncated, after.config_text, after.dbc) == (False, before.config_text, before.dbc)
    assert after.metadata == before.metadata
    with mended.open("rb") as f:
        summary = make_reader(f).get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == report.messages


def test_a_damaged_chunk_is_left_out_and_those_behind_it_are_kept(log: Path, tmp_path: Path) -> None:
    data = bytearray(log.read_bytes())
    second = data.index(b"zstd", data.index(b"zstd") + 4)
    data[second + 200] ^= 1
    log.write_bytes(data)
    report = recover(log, tmp_path / "mended.mcap")
    assert report.damaged_chunks == 1
    after = read_log(tmp_path / "mended.mcap")
    numbers = [t.number for t in after]
    assert numbers[0] == 1 and numbers[-1] == COUNT and not after.truncated
    assert after.missing == COUNT - len(numbers) > 0


def test_mending_overwrites_nothing(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    with pytest.raises(LogError, match="never overwritten"):
        recover(log, log)
    assert log.read_bytes() == data
    with pytest.raises(LogError, match="not an MCAP file"):
        recover(Path(__file__), tmp_path / "x.mcap")
    assert not (tmp_path / "x.mcap").exists()
