"""Logs that another program has written anew say the same, and what is damaged in them is damage in words."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, Writer

from commands import pneud_here
from log_samples import bits, header, noisy
from mangled import simulated
from pneud.log.files.columns import blocks
from pneud.log.files.naming import create_log
from pneud.log.files.reader import LoggedState, read_log
from pneud.log.files.recovery import recover
from pneud.log.files.writer import LogWriter
from pneud.log.format.schema import EVENTS, FRAMES, TICK
from pneud.replay.replaying import replay
from rewritten import rewrite

RECORDS = list(noisy(180))
WAYS: list[dict[str, Any]] = [
    {"chunked": False},
    {"chunked": False, "head_last": True, "strange": True, "seed": 1},
    {"chunked": False, "index": False, "seed": 2},
    {"compression": CompressionType.LZ4},
    {"compression": CompressionType.NONE, "chunk_bytes": 1000, "head_last": True, "seed": 3},
    {"strange": True, "head_last": True, "index": False, "seed": 4},
    {"chunk_bytes": 10_000_000, "strange": True, "seed": 5},
]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("own") / "x.mcap"
    writer = LogWriter(create_log(path), header())
    writer.note({"scheduler": "fifo"})
    for n, record in enumerate(RECORDS, start=1):
        writer.write(record)
        if n % 30 == 0:
            writer.snapshot({"axis": (n, 0.5)})
    writer.close()
    return path


@pytest.mark.parametrize("way", WAYS, ids=str)
def test_it_says_the_same(log: Path, tmp_path: Path, way: dict[str, Any]) -> None:
    other, mended = tmp_path / "other.mcap", tmp_path / "mended.mcap"
    rewrite(log, other, **way)
    own = read_log(log)
    wanted = [bits(item) for item in own.items()]
    from_ns = own.start_ns() + 100_000_000
    later = [bits(item) for item in own.items(from_ns)]
    report = recover(other, mended)
    assert (report.damage, report.damaged_chunks) == ("", 0)
    for path in (other, mended):
        found = read_log(path)
        assert [bits(item) for item in found.items()] == wanted
        assert (found.truncated, found.damage, found.missing) == (False, "", 0)
        assert (found.metadata, found.setup) == (own.metadata, own.setup)
        assert (found.config_text, found.dbc) == (own.config_text, own.dbc)
        assert found.start_ns() == own.start_ns()
        assert len(list(found.events())) == len(list(own.events()))
        # from the middle: from the same snapshot where it can be found, else from the start
        some = [bits(item) for item in found.items(from_ns)]
        assert some == wanted[-len(some) :]
        assert len(some) >= len(later)
    if not way.get("chunked", True):
        first = next(iter(read_log(other).items(from_ns)))
        assert isinstance(first, LoggedState) and len(later) == len(list(read_log(other).items(from_ns)))


def test_all_messages_of_a_file_without_chunks_are_saved(log: Path, tmp_path: Path) -> None:
    rewrite(log, tmp_path / "u.mcap", chunked=False)
    done = pneud_here("recover", tmp_path / "u.mcap", "-o", tmp_path / "m.mcap")
    assert done.returncode == 0
    report = recover(tmp_path / "u.mcap", tmp_path / "again.mcap")
    assert report.messages > len(RECORDS)
    assert f"m.mcap: {report.messages} messages\n" in done.stdout


def test_a_replay_of_it_is_identical(tmp_path: Path) -> None:
    simulated(tmp_path / "x.mcap", 0.4)
    for n, way in enumerate(WAYS):
        rewrite(tmp_path / "x.mcap", tmp_path / f"{n}.mcap", **way)
        outcome = replay(read_log(tmp_path / f"{n}.mcap"))
        assert outcome.identical and outcome.engaged_ticks and not outcome.truncated


@pytest.mark.parametrize("way", WAYS, ids=str)
def test_cut_or_damaged_it_is_read_as_far_as_it_goes_and_said(
    log: Path, tmp_path: Path, way: dict[str, Any]
) -> None:
    whole, bad, mended = (tmp_path / f"{name}.mcap" for name in ("whole", "bad", "mended"))
    rewrite(log, whole, **(way | {"head_last": False}))
    wanted = [bits(t) for t in read_log(whole)]
    data = whole.read_bytes()
    begin = data.index(b"another program") + 6000  # behind the head, which has its own tests
    rng = random.Random(7)
    for n in range(12):
        changed = bytearray(data)
        if n % 2:
            del changed[rng.randrange(begin, len(data)) :]
        else:
            at = rng.randrange(begin, len(data))
            changed[at : at + 4] = rng.randbytes(4)
        bad.write_bytes(changed)
        reader = read_log(bad)
        found = [bits(t) for t in reader]
        unchecked = not way.get("chunked", True)  # messages by themselves have no checksum
        assert unchecked or found == wanted[: len(found)] or reader.missing
        assert len(found) == len(wanted) or reader.damage or reader.missing
        report = recover(bad, mended)
        assert report.messages or report.damage
        after = read_log(mended)
        assert (
            len(list(after)) == len(wanted) or report.damage or report.parted or (unchecked and after.damage)
        )
        mended.unlink()


@pytest.mark.parametrize("chunked", [True, False])
def test_what_is_recovered_of_it_is_whole(log: Path, tmp_path: Path, chunked: bool) -> None:
    """Chunks of others end between ticks and their frames: what has lost its other half is left out."""
    rewrite(log, tmp_path / "other.mcap", chunked=chunked, chunk_bytes=3000, compression=CompressionType.LZ4)
    whole = (tmp_path / "other.mcap").read_bytes()
    wanted = {item.number: bits(item) for item in read_log(log)}
    rng, parted, behind = random.Random(1), 0, 0
    for n in range(8):
        data, at = bytearray(whole), rng.randrange(len(whole) // 4, len(whole) * 3 // 4)
        data[at : at + 30] = rng.randbytes(30)
        (tmp_path / "bad.mcap").write_bytes(data if n % 2 and chunked else data[:at])
        (tmp_path / "mended.mcap").unlink(missing_ok=True)
        parted += recover(tmp_path / "bad.mcap", tmp_path / "mended.mcap").parted
        mended = read_log(tmp_path / "mended.mcap")
        before, found = list(read_log(tmp_path / "bad.mcap")), list(mended)
        assert not mended.truncated, mended.damage
        assert all(bits(item) == wanted[item.number] for item in found)
        assert {item.number for item in before} <= {item.number for item in found}
        behind += len(found) > len(before)
    assert parted
    assert bool(behind) == chunked


@pytest.mark.parametrize("by_topic", [False, True])
def test_it_may_be_sorted_by_time_or_by_topic(log: Path, tmp_path: Path, by_topic: bool) -> None:
    def order(topic: str, message: Any) -> Any:
        return (
            ([TICK, FRAMES].index(topic) if topic in (TICK, FRAMES) else 2) if by_topic else message.log_time
        )

    rewrite(log, tmp_path / "sorted.mcap", key=order)
    report = recover(tmp_path / "sorted.mcap", tmp_path / "mended.mcap")
    assert (report.ticks, report.parted, report.damage) == (len(RECORDS), 0, "")
    wanted = [bits(item) for item in read_log(log)]
    for name in ("sorted", "mended"):
        found = read_log(tmp_path / f"{name}.mcap")
        assert [bits(item) for item in found] == wanted
        assert (found.damage, found.missing) == ("", 0)
        assert sum(len(block.number) for block in blocks(found)) == len(RECORDS)


def test_frames_before_their_ticks_are_damage_in_words(log: Path, tmp_path: Path) -> None:
    rewrite(log, tmp_path / "x.mcap", key=lambda topic, _: topic != FRAMES)
    reader = read_log(tmp_path / "x.mcap")
    for read in (list, lambda log: list(blocks(log))):
        assert read(reader) == []
        assert reader.damage == "damaged in record 1: frames without their ticks"
    done = pneud_here("recover", tmp_path / "x.mcap", "-o", tmp_path / "m.mcap")
    assert done.returncode == 1
    assert "messages of ticks that are not whole" in done.stdout


@pytest.mark.parametrize("by_topic", [False, True])
def test_a_tick_that_is_not_there_is_damage_in_words(log: Path, tmp_path: Path, by_topic: bool) -> None:
    def order(topic: str, m: Any) -> Any:
        late = topic == TICK and m.sequence == 100
        return 1 if late else 2 * by_topic * (topic != TICK)

    rewrite(log, tmp_path / "x.mcap", key=order)  # it comes last, or behind the other ticks
    reader, wanted = read_log(tmp_path / "x.mcap"), [bits(item) for item in read_log(log)]
    found = [bits(item) for item in reader]
    if by_topic:
        assert (found, reader.damage) == (wanted, "")
        return
    assert 0 < len(found) < 100
    assert found == wanted[: len(found)]
    assert "frames without their ticks" in reader.damage
    assert sum(len(block.number) for block in blocks(reader)) == len(found)
    assert "frames without their ticks" in reader.damage


def test_a_damaged_lz4_chunk_is_damage_in_words(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    rewrite(log, path, compression=CompressionType.LZ4, chunk_bytes=4000)
    data = bytearray(path.read_bytes())
    chunks = [at for at in range(len(data)) if data[at] == 6 and data[at + 37 : at + 44] == b"\3\0\0\0lz4"]
    data[chunks[-3] + 90 : chunks[-3] + 110] = bytes(20)
    path.write_bytes(data)
    reader = read_log(path)
    assert 0 < len(list(reader)) < len(RECORDS)
    assert "damaged at byte" in reader.damage
    report = recover(path, tmp_path / "mended.mcap")
    assert report.damaged_chunks == 1
    assert report.messages > 120


def test_a_damaged_length_costs_no_chunk_behind_it_whatever_the_compression(
    log: Path, tmp_path: Path
) -> None:
    for name, kind in (("lz4", CompressionType.LZ4), ("zstd", CompressionType.ZSTD)):
        path = tmp_path / f"{name}.mcap"
        rewrite(log, path, compression=kind, chunk_bytes=4000)
        data = bytearray(path.read_bytes())
        word = name.encode()
        second = data.index(word, data.index(word) + 1) - 37 - 4
        assert data[second] == 6
        data[second + 2] ^= 0x40
        path.write_bytes(data)
        report = recover(path, tmp_path / f"{name}-mended.mcap")
        assert report.damage
        ticks = {t.number for t in read_log(tmp_path / f"{name}-mended.mcap")}
        assert len(ticks) > 100 and len(RECORDS) in ticks


def test_a_message_of_no_known_channel_is_said(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        writer.add_message(5, 1, b"", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    report = recover(path, tmp_path / "mended.mcap")
    assert (report.messages, report.damage) == (0, "1 messages are of channels that are nowhere defined")
    done = pneud_here("recover", path, "-o", tmp_path / "again.mcap")
    assert done.returncode == 1
    assert "nowhere defined" in done.stdout


@pytest.mark.parametrize("topic", [TICK, FRAMES, EVENTS])
def test_a_time_that_no_clock_shows_is_damage_there(log: Path, tmp_path: Path, topic: str) -> None:
    other, messages = tmp_path / "other.mcap", 0

    def late(of: str, message: Any) -> int:
        nonlocal messages
        messages += of == topic
        if of == topic and (messages == 90 or topic != TICK):
            message.log_time = 1 << 63
        return 0  # as they were

    rewrite(log, other, key=late)
    read = read_log(other)
    ticks = list(read)
    assert read.truncated
    assert read.damage == f"damaged in a message of {topic}: its time lies behind the year 2262"
    assert len(ticks) < len(RECORDS)
    again = read_log(other)
    assert sum(len(block.number) for block in blocks(again)) == len(ticks)
    assert again.damage == read.damage
    for verb in (("report", other, "-o", tmp_path / "x.html"), ("export", other, "-o", tmp_path / "x.csv")):
        done = pneud_here(*verb)
        assert done.returncode in (1, 2)
        assert "Traceback" not in done.stderr
