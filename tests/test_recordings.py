"""Recordings that others made, whole or not: all up to the trouble is read, and the trouble is said."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import recorded
from commands import pneud_here
from mangled import simulated
from pneud import resources
from pneud.log.files.reader import read_log
from pneud.log.format.records import LoggedTick
from pneud.replay import traffic
from pneud.replay.remarks import Remarks
from pneud.replay.replaying import replay
from pneud.signals import Frame
from recorded import Recorded

DBC = resources.configs() / "pneud.dbc"
SUFFIXES = ("log", "asc", "blf")
INFERRED = "requests were inferred from Enable: nothing tells what else was asked of the axis"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """The frames of a short run, in the order in which they were on the bus."""
    folder = tmp_path_factory.mktemp("run")
    simulated(folder / "x.mcap", 0.3)
    assert pneud_here("export", folder / "x.mcap", "-o", folder / "x.log").returncode == 0
    found = [(p.frame, bool(p.sent)) for p in traffic.read(folder / "x.log")]
    return sorted(found, key=lambda pair: pair[0].stamp_ns)


class Imported(NamedTuple):
    """What an import came to."""

    status: int
    ticks: list[LoggedTick]
    said: list[str]  # apart from what is always said
    path: Path

    def commands(self) -> list[bytes]:
        return [frame.data for tick in self.ticks for frame in tick.sent[1:]]


def imported(recording: Path) -> Imported:
    """Import a recording; what is counted is what is in the log."""
    output = recording.with_name(f"{recording.name}.mcap")
    output.unlink(missing_ok=True)
    done = pneud_here("import", recording, "--dbc", DBC, "--config", "virtual.toml", "-o", output)
    lines = [line for line in done.stderr.splitlines() if line != INFERRED]
    lines = [line for line in lines if "have no valid command" not in line and "computes" not in line]
    if done.returncode == 2:
        assert done.stdout == ""
        assert len(lines) == 1, lines
        assert not output.exists()
        return Imported(2, [], lines, output)
    log = read_log(output)
    ticks = list(log)
    assert not log.truncated
    found = re.match(rf"{re.escape(str(output))}: (\d+) ticks from channel ", done.stdout)
    assert found is not None, done.stdout
    assert int(found[1]) == len(ticks)
    assert [t.t_ns for t in ticks] == sorted(t.t_ns for t in ticks)
    return Imported(done.returncode, ticks, lines, output)


def syncs(frames: Recorded) -> list[Frame]:
    return [f for f, _ in frames if f.can_id == 0x080]


def commands(frames: Recorded) -> list[bytes]:
    return [f.data for f, _ in frames if f.can_id == 0x203]


# Direction


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_a_listening_can_logger_writes_is_read(run: Recorded, tmp_path: Path, suffix: str) -> None:
    recorded.can_logger(tmp_path / f"x.{suffix}", run)
    found = imported(tmp_path / f"x.{suffix}")
    assert (found.status, found.said) == (0, [])
    assert [t.sent[0].data for t in found.ticks] == [f.data for f in syncs(run)]
    assert found.commands() == commands(run)
    outcome = replay(read_log(found.path))
    assert outcome.commands == len(found.ticks) and outcome.engaged_ticks > 300


@pytest.mark.parametrize(
    "way", [lambda _: "", lambda _: " R", lambda _: " T", lambda sent: " T" if sent else " R"]
)
def test_any_direction_of_a_lone_controller_gives_the_same(
    run: Recorded, tmp_path: Path, way: Callable[[bool], str]
) -> None:
    recorded.candump(tmp_path / "x.log", run, way)
    found = imported(tmp_path / "x.log")
    assert (found.status, found.said) == (0, [])
    assert found.commands() == commands(run)


def test_where_the_recorder_was_the_controller_another_one_is_heard(run: Recorded, tmp_path: Path) -> None:
    another = [
        (f._replace(stamp_ns=f.stamp_ns + 400_000), False) for f, _ in run if f.can_id in (0x080, 0x203)
    ]
    both = sorted([*another[:200], *run], key=lambda pair: pair[0].stamp_ns)
    recorded.candump(tmp_path / "x.log", both, lambda sent: " T" if sent else " R")
    found = imported(tmp_path / "x.log")
    assert len(found.ticks) == len(syncs(run))
    assert found.commands() == commands(run)
    heard = [f for tick in found.ticks for f in tick.frames if f.can_id in (0x080, 0x203)]
    assert len(heard) == 200
    # a listener cannot tell them apart
    recorded.candump(tmp_path / "y.log", both, lambda _: " R")
    assert len(imported(tmp_path / "y.log").ticks) == len(syncs(both))


def test_a_recorder_that_sends_something_else_is_no_controller(run: Recorded, tmp_path: Path) -> None:
    console = [(Frame(f.stamp_ns + 50_000, 0x600, bytes(8)), True) for f in syncs(run)[::50]]
    frames = sorted([*((f, False) for f, _ in run), *console], key=lambda pair: pair[0].stamp_ns)
    recorded.candump(tmp_path / "x.log", frames, lambda sent: " T" if sent else " R")
    found = imported(tmp_path / "x.log")
    assert (found.status, len(found.ticks), found.commands()) == (0, len(syncs(run)), commands(run))


# Time


@pytest.mark.parametrize("by_s", [50 * 86_400, 1_700_000_000, -3600, -0.5, -1_600_000_000])
@pytest.mark.parametrize("at_a_sync", [True, False])
def test_a_clock_that_was_set_in_between_is_said_and_goes_on(
    run: Recorded, tmp_path: Path, by_s: float, at_a_sync: bool
) -> None:
    places = [n for n, (f, _) in enumerate(run) if (f.can_id == 0x080) is at_a_sync]
    place = places[len(places) // 2]
    by_ns = round(by_s * 1e9)
    frames = [(f._replace(stamp_ns=f.stamp_ns + by_ns * (n >= place)), s) for n, (f, s) in enumerate(run)]
    recorded.candump(tmp_path / "x.log", frames)
    found = imported(tmp_path / "x.log")
    assert found.status == 1
    assert len(found.said) == 1
    assert "the clock was set; what follows goes on from there (by " in found.said[0]
    assert len(found.ticks) == len(syncs(run))
    assert found.commands() == commands(run)
    steps = [b.t_ns - a.t_ns for a, b in zip(found.ticks, found.ticks[1:], strict=False)]
    assert min(steps) > 0 and max(steps) < 10_000_000
    replay(read_log(found.path))
    done = pneud_here("export", found.path, "-o", tmp_path / "again.log")
    assert "left out" not in done.stdout
    assert sum(" 080#" in line for line in (tmp_path / "again.log").read_text().splitlines()) == len(
        found.ticks
    )


def test_a_long_pause_is_a_pause(run: Recorded, tmp_path: Path) -> None:
    half = len(run) // 2
    pause_ns = 86_400 * 10**9
    frames = [(f._replace(stamp_ns=f.stamp_ns + pause_ns * (n >= half)), s) for n, (f, s) in enumerate(run)]
    recorded.candump(tmp_path / "x.log", frames)
    found = imported(tmp_path / "x.log")
    assert (found.status, found.said) == (0, [])
    assert max(t.skipped for t in found.ticks) == pytest.approx(86_400_000, abs=2)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (10**3, "milliseconds"),
        (10**6, "microseconds"),
        (10**9, "nanoseconds"),
        (0, "its stamps do not go on"),
    ],
)
@pytest.mark.parametrize("suffix", ["log", "asc"])
def test_stamps_in_other_units_are_refused_with_the_reason(
    run: Recorded, tmp_path: Path, factor: int, words: str, suffix: str
) -> None:
    path = tmp_path / f"x.{suffix}"
    if suffix == "log":
        recorded.candump(path, [(f._replace(stamp_ns=f.stamp_ns * factor), sent) for f, sent in run])
    else:
        recorded.vector_asc(path, run)
        path.write_text(re.sub(r"(?m)^ +([\d.]+)", lambda m: f"{float(m[1]) * factor:.6f}", path.read_text()))
    found = imported(path)
    assert found.status == 2
    assert words in found.said[0]


def test_another_rate_is_refused_with_the_reason(run: Recorded, tmp_path: Path) -> None:
    recorded.candump(tmp_path / "x.log", [(f._replace(stamp_ns=f.stamp_ns * 40), s) for f, s in run])
    found = imported(tmp_path / "x.log")
    assert found.status == 2
    assert "are 0.04 s apart, where 1000 Hz make 0.001 s; is loop.rate_hz" in found.said[0]


@pytest.mark.parametrize(
    "options", [{}, {"relative": True}, {"requests": True}, {"relative": True, "requests": True}]
)
def test_all_that_vectors_text_may_say_of_time_and_direction(
    run: Recorded, tmp_path: Path, options: dict[str, Any]
) -> None:
    recorded.vector_asc(tmp_path / "x.asc", run, **options)
    found = imported(tmp_path / "x.asc")
    assert found.status == 0
    asked = sum(sent for _, sent in run) if options.get("requests") else 0
    wanted = [f"{asked - 1} more: a request to send (TxRq), which is no frame yet"] if asked else []
    assert [line.partition(" and ")[2] for line in found.said] == wanted
    assert found.commands() == commands(run)
    off_ns = [t.t_ns - f.stamp_ns for t, f in zip(found.ticks, syncs(run), strict=True)]
    assert max(off_ns) - min(off_ns) <= 2000


def test_negative_stamps_are_times_like_others(run: Recorded, tmp_path: Path) -> None:
    recorded.vector_asc(tmp_path / "x.asc", run, offset_s=-1.25)
    assert "-0.2" in (tmp_path / "x.asc").read_text()
    found = imported(tmp_path / "x.asc")
    assert (found.status, found.said, found.commands()) == (0, [], commands(run))
    start_ns = run[0][0].stamp_ns
    recorded.candump(tmp_path / "x.log", run)
    text = (tmp_path / "x.log").read_text()

    def earlier(match: re.Match[str]) -> str:
        us = int(match[1]) * 10**6 + int(match[2]) - start_ns // 1000 - 250_000
        return f"({'-' * (us < 0)}{abs(us) // 10**6}.{abs(us) % 10**6:06})"

    (tmp_path / "x.log").write_text(re.sub(r"\((\d+)\.(\d+)\)", earlier, text))
    found = imported(tmp_path / "x.log")
    assert (found.status, found.commands()) == (0, commands(run))
    assert found.said == ["at its start: its times are no Unix times; the log's begin in 1970"]
    assert found.ticks[0].log_time_ns >= 0


def test_times_that_are_not_those_of_the_export_beside_do_not_matter(tmp_path: Path) -> None:
    simulated(tmp_path / "x.mcap", 0.3)
    assert pneud_here("export", tmp_path / "x.mcap", "-o", tmp_path / "x.log").returncode == 0
    text = (tmp_path / "x.log").read_text()
    (tmp_path / "x.log").write_text(re.sub(r"\(\d+", lambda m: f"({int(m[0][1:]) - 1_650_000_000}", text))
    done = pneud_here("import", tmp_path / "x.log", "-o", tmp_path / "y.mcap")
    assert done.returncode == 0
    assert done.stderr == "at its start: its times are not those of the log that was exported\n"
    assert [t.check for t in read_log(tmp_path / "y.mcap")] != []


@pytest.mark.parametrize(
    ("text", "us"),
    [
        ("Tue Nov 14 22:13:20.123 2023", 123_000),
        ("Tue Nov 14 10:13:20.123 pm 2023", 123_000),
        ("Die Nov 14 22:13:20.123 2023", 123_000),
        ("Tue Nov 14 22:13:20.5 2023", 5_000),  # python-can's five milliseconds
        ("Tue Nov 14 22:13:20.123456 2023", 123_456),
        ("Tue Nov 14 22:13:20 2023", 0),
    ],
)
def test_dates_of_an_asc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, us: int) -> None:
    monkeypatch.setenv("TZ", "UTC")
    path = tmp_path / "x.asc"
    path.write_text(f"date {text}\nbase hex timestamps absolute\n 1.5 1 80 Rx d 1 01\n")
    (found,) = traffic.read(path)
    assert found.frame.stamp_ns == 1_700_000_000_000_000_000 + us * 1000 + 1_500_000_000


def test_blocks_of_an_asc_count_from_their_date_where_they_begin_anew(tmp_path: Path) -> None:
    path = tmp_path / "x.asc"
    block = "Begin Triggerblock Tue Nov 14 22:13:{:02}.000 2023\n {}.0 1 80 Rx d 1 01\nEnd TriggerBlock\n"
    head = "date Tue Nov 14 22:13:00.000 2023\nbase hex timestamps absolute\n"
    for stamps, seconds in (((0, 0), (20, 30)), ((5, 15), (25, 35)), ((15, 5), (35, 35))):
        path.write_text(head + block.format(20, stamps[0]) + block.format(30, stamps[1]))
        first, second = (p.frame.stamp_ns // 10**9 % 60 for p in traffic.read(path))
        start = first - seconds[0]
        assert (first - start, second - start) == seconds


# Cut and odd files


def test_a_candump_that_was_killed_in_its_last_line(run: Recorded, tmp_path: Path) -> None:
    recorded.candump(tmp_path / "x.log", run)
    data = (tmp_path / "x.log").read_bytes()
    begin = data.rindex(b"(")
    whole = imported(tmp_path / "x.log").ticks
    for cut in (begin + 1, begin + 10, data.rindex(b"can0") + 2, data.rindex(b"#"), data.rindex(b"#") + 2):
        (tmp_path / "x.log").write_bytes(data[:cut])
        found = imported(tmp_path / "x.log")
        assert found.status == 1
        assert found.said == [f"line {len(run)}: cut short where the file ends, passed over"]
        assert len(found.ticks) == len(whole)
    # what is cut within its data is a frame of the wrong length, unless nobody can tell
    (tmp_path / "x.log").write_bytes(data[: data.rindex(b"#") + 3])
    (said,) = imported(tmp_path / "x.log").said
    assert "valve_command (0x203) with 1 bytes, where the database has 8" in said


def test_an_asc_that_was_killed_in_its_last_line(run: Recorded, tmp_path: Path) -> None:
    recorded.can_logger(tmp_path / "x.asc", run[:500])
    text = (tmp_path / "x.asc").read_text().removesuffix("End TriggerBlock\n")
    begin = text.rindex("\n", 0, len(text) - 1) + 1
    for cut in range(begin + 2, len(text) - 1):
        (tmp_path / "x.asc").write_text(text[:cut])
        remarks = Remarks()
        found = list(traffic.read(tmp_path / "x.asc", remarks))
        assert len(found) == 499
        assert remarks.lines() == [f"line {text.count(chr(10))}: cut short where the file ends, passed over"]


def test_half_a_blf_says_so(run: Recorded, tmp_path: Path) -> None:
    recorded.can_logger(tmp_path / "x.blf", run)
    data = (tmp_path / "x.blf").read_bytes()
    (tmp_path / "x.blf").write_bytes(data[: len(data) // 2])
    found = imported(tmp_path / "x.blf")
    assert found.status == 1
    assert 0.3 * len(syncs(run)) < len(found.ticks) < 0.7 * len(syncs(run))
    cut, missing = found.said
    assert cut.endswith("cut short where the file ends")
    assert re.search(rf"objects that the head tells of are not there: \d+ of {len(run)}$", missing)


def test_a_blf_whose_recorder_was_killed_says_so(run: Recorded, tmp_path: Path) -> None:
    (tmp_path / "x.blf").write_bytes(recorded.blf(recorded.blf_frame(f, run[0][0].stamp_ns) for f, _ in run))
    found = imported(tmp_path / "x.blf")
    assert (found.status, found.commands()) == (1, commands(run))
    assert found.said == [
        "byte 0: the head is not complete: the recorder was stopped short, and what it still held is lost"
    ]


@pytest.mark.parametrize("size", [0, 1, 15, 31, 49, 5000, 2**31, 2**32 - 1])
def test_an_object_of_an_impossible_size_costs_itself_only(run: Recorded, tmp_path: Path, size: int) -> None:
    objects = [recorded.blf_frame(f, run[0][0].stamp_ns) for f, _ in run]
    place = next(n for n, (f, _) in enumerate(run) if n > 600 and f.can_id == 0x182)
    objects[place] = recorded.blf_frame(run[place][0], run[0][0].stamp_ns, size)
    (tmp_path / "x.blf").write_bytes(recorded.blf(objects, count=len(objects)))
    found = imported(tmp_path / "x.blf")
    assert (found.status, found.commands()) == (1, commands(run))
    assert sum(len(t.frames) + len(t.sent) for t in found.ticks) == len(run) - 1
    assert any("an object whose size cannot be, passed over" in line for line in found.said)


@pytest.mark.parametrize("level", [0, 6])
def test_a_container_of_an_impossible_size_is_read_all_the_same(
    run: Recorded, tmp_path: Path, level: int
) -> None:
    objects = [recorded.blf_frame(f, run[0][0].stamp_ns) for f, _ in run]
    data = bytearray(recorded.blf(objects, count=len(objects), level=level))
    for size in (0, 2**31):
        data[152:156] = struct.pack("<L", size)
        (tmp_path / "x.blf").write_bytes(data)
        remarks = Remarks()
        found = list(traffic.read(tmp_path / "x.blf", remarks))
        assert remarks.partial
        assert len(found) == len(run) if level else len(found) > len(run) // 2


def test_a_damaged_container_costs_itself_and_what_reaches_into_it(run: Recorded, tmp_path: Path) -> None:
    objects = [recorded.blf_frame(f, run[0][0].stamp_ns) for f, _ in run]
    data = bytearray(recorded.blf(objects, count=len(objects), containers=5))
    second = data.index(b"LOBJ", data.index(b"LOBJ") + 1)
    data[second + 60] ^= 0xFF
    (tmp_path / "x.blf").write_bytes(data)
    found = imported(tmp_path / "x.blf")
    assert found.status == 1
    assert 0.7 * len(syncs(run)) < len(found.ticks) < 0.9 * len(syncs(run))
    assert any("a container that cannot be decompressed" in line for line in found.said)
    assert any("are not there" in line for line in found.said)


def test_classic_frames_of_a_bus_that_carries_can_fd(run: Recorded, tmp_path: Path) -> None:
    objects, lines = [], [recorded.ASC_HEAD.format("absolute")]
    for n, (f, sent) in enumerate(run):
        stamp_ns, flags = f.stamp_ns - run[0][0].stamp_ns, 0x1000 if f.can_id == 0x181 else 0
        if n % 2:
            content = struct.pack(
                "<BBBBLLLLLLLHBBL",
                1,
                len(f.data),
                len(f.data),
                0,
                f.can_id,
                0,
                flags,
                0,
                0,
                0,
                0,
                0,
                sent,
                0,
                0,
            )
            objects.append(recorded.blf_object(101, content + f.data, stamp_ns))
        else:
            content = struct.pack(
                "<HBBLLBBB5x64s", 1, sent, len(f.data), f.can_id, 0, 0, bool(flags), len(f.data), f.data
            )
            objects.append(recorded.blf_object(100, content, stamp_ns))
        name = "" if n % 3 else "Name_of_it "
        lines.append(
            f"{stamp_ns / 1e9:.6f} CANFD 1 {'Tx' if sent else 'Rx'} {f.can_id:X} {name}0 0 {len(f.data):x}"
            f" {len(f.data)} {f.data.hex(' ')} 0 0 {flags:X} 0 0 0 0 0\n"
        )
    (tmp_path / "x.blf").write_bytes(recorded.blf(objects, count=len(objects)))
    (tmp_path / "x.asc").write_text("".join(lines))
    for suffix in ("blf", "asc"):
        found = imported(tmp_path / f"x.{suffix}")
        assert (found.status, found.commands()) == (1, commands(run))
        (said,) = found.said
        passed_over = sum(f.can_id == 0x181 for f, _ in run)
        assert said.endswith(f" and {passed_over - 1} more: a frame of CAN FD, passed over")
        assert sum(len(t.frames) + len(t.sent) for t in found.ticks) == len(run) - passed_over


def test_lines_of_candump_that_are_not_of_this_bus_are_passed_over(run: Recorded, tmp_path: Path) -> None:
    recorded.candump(tmp_path / "x.log", run)
    lines = (tmp_path / "x.log").read_text().splitlines()
    stamp = lines[100].split()[0]
    lines[100:100] = [
        f"{stamp} can0 123#1122334455667788_B",  # a DLC above 8, still 8 bytes
        f"{stamp} can0 123##1AABBCC",
        f"{stamp} can0 45123#81:00:12345678#11223344.556677",
        f"{stamp} can0 123#R8",
        f"{stamp} can0 123#R8_F R",
        "# a comment",
        "nonsense",
        f"{stamp} can0 123#1",
    ]
    (tmp_path / "x.log").write_text("\n".join(lines) + "\n")
    found = imported(tmp_path / "x.log")
    assert (found.status, found.commands()) == (1, commands(run))
    assert found.said == [
        "line 102: a frame of CAN FD, passed over",
        "line 103: a frame of CAN XL, passed over",
        "line 106: a comment",
        "line 107 and 1 more: not a line of a candump log (candump -l, candump -L), passed over",
    ]
    assert sum(len(t.frames) + len(t.sent) for t in found.ticks) == len(run) + 3


@pytest.mark.parametrize("suffix", ["log", "asc"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: b"\xef\xbb\xbf" + data, []),
        (lambda data: data.replace(b"\n", b"\r\n"), []),
        (lambda data: data.replace(b"\n", b"\r"), []),
        (lambda data: data.replace(b" can0 ", b" M\xe4rz\xb5 ").replace(b"Tue Nov", b"Die M\xe4r"), []),
        (lambda data: data.replace(b" can0 ", " Kanal-µ ".encode()), []),
        (lambda data: data + bytes(100_000), ["NUL bytes, as a loss of power leaves them, passed over"]),
        (
            lambda data: data.replace(b"\n", b"\n" + bytes(70_000), 1),
            ["NUL bytes, as a loss of power leaves them, passed over"],
        ),
    ],
)
def test_text_of_any_kind(
    run: Recorded, tmp_path: Path, suffix: str, change: Callable[[bytes], bytes], words: list[str]
) -> None:
    path = tmp_path / f"x.{suffix}"
    if suffix == "log":
        recorded.candump(path, run)
    else:
        recorded.vector_asc(path, run)
    path.write_bytes(change(path.read_bytes()))
    found = imported(path)
    assert (found.status, found.commands()) == (bool(words), commands(run))
    assert [line.partition(": ")[2] for line in found.said] == words


def test_events_beside_the_frames_of_an_asc_are_no_loss(run: Recorded, tmp_path: Path) -> None:
    """Lines as CANoe writes them; a message of J1939's transport is made of frames that stand there too."""
    path = tmp_path / "x.asc"
    recorded.vector_asc(path, run)
    path.write_text(
        path.read_text().replace("internal events", 'previous log file: "a.asc"\ninternal events')
        + "   3.297743 1  J1939TP FEE3p        6    0  0   -   Rx   d 10 A0 0F A6 60 3B D1 40 1F DE 80\n"
        + "   4.200804 0 16777215 0 1 GMGroup: Marker Group GMMarker: [1] GMDescription: description\n"
        + "   5.0 LIN 1 Event\n"
    )
    found = imported(path)
    assert (found.status, found.commands()) == (0, commands(run))
    (said,) = found.said
    assert said.endswith("and 2 more: an event that is no frame of a CAN bus")


def test_a_line_that_has_swallowed_the_next_one_is_named(tmp_path: Path) -> None:
    frame = "1.0 1 80 Rx d 1 01"
    for line in ("base hex timestamps absolute", "internal events logged", "0.0 Start of measurement"):
        (tmp_path / "x.asc").write_text(f"{line} {frame}\n{frame}\n")
        remarks = Remarks()
        assert len(list(traffic.read(tmp_path / "x.asc", remarks))) == 1
        assert remarks.lines()[0].startswith("line 1: ")


def test_heads_of_forty_bytes_in_either_version(run: Recorded, tmp_path: Path) -> None:
    """Objects of other buses have them, which are not damaged for that."""
    start_ns = run[0][0].stamp_ns
    objects = [recorded.blf_frame(f, start_ns) for f, _ in run]
    for version in (1, 2):
        other = b"LOBJ" + struct.pack("<HHLL", 40, version, 75, 85) + bytes(59)
        (tmp_path / "x.blf").write_bytes(recorded.blf([*objects[:40], other, *objects[40:]], count=1))
        remarks = Remarks()
        assert len(list(traffic.read(tmp_path / "x.blf", remarks))) == len(run)
        assert (remarks.lines(), remarks.partial) == (
            ["byte 144: an object that is not a frame of CAN"],
            False,
        )


def test_stamps_that_go_back_are_refused_with_the_reason(run: Recorded, tmp_path: Path) -> None:
    recorded.candump(tmp_path / "x.log", run[::-1])
    found = imported(tmp_path / "x.log")
    assert found.status == 2
    assert found.said[0].endswith("its stamps go back from SYNC to SYNC; was it sorted the other way round?")


# Frames that are none, and refusals


def test_frames_of_the_wrong_length_are_named(run: Recorded, tmp_path: Path) -> None:
    frames = [
        (f._replace(data=f.data[:6]) if f.can_id == 0x182 and n > len(run) - 20 else f, sent)
        for n, (f, sent) in enumerate(run)
    ]
    count = sum(f.can_id == 0x182 and len(f.data) == 6 for f, _ in frames)
    recorded.candump(tmp_path / "x.log", frames)
    found = imported(tmp_path / "x.log")
    assert found.status == 0
    (said,) = found.said
    assert said.endswith(f"and {count - 1} more: pressure (0x182) with 6 bytes, where the database has 8")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (r" 00000181#\1", "encoder (0x181) with a 29-bit identifier"),
        (" 181#R8", "encoder (0x181) as a request for it (RTR)"),
    ],
)
def test_frames_of_another_kind_are_named(run: Recorded, tmp_path: Path, name: str, words: str) -> None:
    recorded.candump(tmp_path / "x.log", run)
    text = (tmp_path / "x.log").read_text()
    (tmp_path / "x.log").write_text(re.sub(r" 181#(\w+)", name, text))
    found = imported(tmp_path / "x.log")
    assert (found.status, found.commands()) == (0, commands(run))
    (said,) = found.said
    assert said.endswith(f" and {text.count(' 181#') - 1} more: {words}")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("(1.0) can0 123#00\n", "there is no SYNC (0x080) in it, so it has no ticks"),
        ("(1.0) can0 080#\n" * 5, "SYNC (0x080) is there 5 times, but with 0 bytes where the database has 1"),
        ("(1.0) can0 080#0100\n", "SYNC (0x080) is there 1 times, but with 2 bytes where the database has 1"),
        ("(1.0) can0 00000080#01\n", "SYNC (0x080) is there 1 times, but with a 29-bit identifier, so"),
        ("(1.0) can0 080#R\n" * 3, "SYNC (0x080) is there 3 times, but as a request for it (RTR), so"),
        ("(1.0) can0 20000080#0000000000000000\n", "there is no SYNC (0x080) in it"),
        ("nonsense\n(1.0) can0 123#00\n", "so it has no ticks; line 1: not a line of a candump log"),
        ("\n", "there is no frame in it"),
        ("x\ny\n", "there is no frame in it; line 1 and 1 more: not a line of a candump log"),
        ("(1.0) can0 080##101\n", "there is no frame in it; line 1: a frame of CAN FD, passed over"),
    ],
)
def test_what_has_no_ticks_is_refused_with_the_reason(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "x.log").write_text(text)
    found = imported(tmp_path / "x.log")
    assert found.status == 2
    assert words in found.said[0]


def test_files_that_are_no_recordings_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x.log").write_text("(1.0) can0 080#01\n", encoding="utf-16")
    assert "is UTF-16; save it as UTF-8" in imported(tmp_path / "x.log").said[0]
    for data, words in (
        (b"", "is empty"),
        (b"LOGX" * 99, "not a BLF file"),
        (b"LOGG\0", "cut short in its head"),
    ):
        (tmp_path / "x.blf").write_bytes(data)
        assert words in imported(tmp_path / "x.blf").said[0]
    (tmp_path / "y.asc").mkdir()
    assert "cannot be read" in imported(tmp_path / "y.asc").said[0]


def test_a_suffix_may_be_in_capitals(run: Recorded, tmp_path: Path) -> None:
    recorded.vector_asc(tmp_path / "X.ASC", run[:200])
    assert imported(tmp_path / "X.ASC").status == 0


@pytest.mark.parametrize("text", ["[[5, 1e999]]", "[" * 100_000, "[[5, null]]", "[[[], 5]]"])
def test_what_is_beside_may_be_spoilt(tmp_path: Path, text: str) -> None:
    simulated(tmp_path / "x.mcap", 0.1)
    assert pneud_here("export", tmp_path / "x.mcap", "-o", tmp_path / "x.log").returncode == 0
    beside = tmp_path / "x.log.json"
    beside.write_text(beside.read_text().replace('"skipped": []', f'"skipped": {text}'))
    done = pneud_here("import", tmp_path / "x.log", "-o", tmp_path / "y.mcap")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"pneud: {beside}: not what pneud export writes beside frames; move it away\n"


def test_ticks_that_no_log_can_hold_are_not_counted(run: Recorded, tmp_path: Path) -> None:
    """A sidecar that someone has edited claims more skipped ticks than a record can say."""
    simulated(tmp_path / "x.mcap", 0.2)
    assert pneud_here("export", tmp_path / "x.mcap", "-o", tmp_path / "x.log").returncode == 0
    beside = tmp_path / "x.log.json"
    beside.write_text(beside.read_text().replace('"skipped": []', '"skipped": [[5, 99999999999]]'))
    done = pneud_here("import", tmp_path / "x.log", "-o", tmp_path / "y.mcap")
    assert done.returncode == 1
    count = sum(1 for _ in read_log(tmp_path / "y.mcap"))
    assert f"y.mcap: {count} ticks" in done.stdout
    assert "y.mcap: ticks that no log can hold, left out" in done.stderr


@pytest.mark.slow
def test_a_recording_of_moves_tells_what_the_rig_is_like(tmp_path: Path) -> None:
    """Frames say all that is needed: what was asked of the axis, and what it thought, does not matter."""
    known = resources.find("virtual.toml").read_text()
    (tmp_path / "rig.toml").write_text(known + "\n[plant.cylinder]\nmoving_mass_kg = 19.0\n")
    moves = ("--goto", "100@500,900@400,300,850@100,800@10,150", "-o", tmp_path / "run.mcap")
    assert pneud_here("sim", tmp_path / "rig.toml", *moves).returncode == 0
    assert pneud_here("export", tmp_path / "run.mcap", "-o", tmp_path / "run.log").returncode == 0
    (tmp_path / "run.log.json").unlink()
    bus = ("--dbc", DBC, "--config", tmp_path / "rig.toml", "-o", tmp_path / "heard.mcap")
    done = pneud_here("import", tmp_path / "run.log", *bus)
    assert done.returncode == 0
    assert "commands are not what this configuration computes" in done.stderr
    done = pneud_here("identify", tmp_path / "heard.mcap", "--json")
    found = json.loads(done.stdout)["parameters"]
    for key, true, within in (
        *(("cylinder.moving_mass_kg", 19.0, 0.5), ("valve.orifice_area_m2", 2.8274e-5, 0.5e-6)),
        *(("valve.dead_zone_positive_v", 0.1, 0.01), ("valve.dead_zone_negative_v", 0.1, 0.01)),
        *(("control.friction.coulomb_n", 40.0, 4.0), ("cylinder.dead_length_1_m", 0.0132, 0.002)),
    ):
        assert found[key]["value"] == pytest.approx(true, abs=within), key
