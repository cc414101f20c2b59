"""Logs to other formats and back: the same ticks, the same commands."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import pneud_here
from mangled import mangle, simulated
from pneud import resources
from pneud.log.files.reader import read_log
from pneud.replay import traffic
from pneud.replay.remarks import Remarks
from pneud.replay.replaying import replay
from pneud.signals import Frame

DBC = resources.configs() / "pneud.dbc"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    simulated(path, 0.8)
    return path


@pytest.fixture(scope="module")
def candump(log: Path) -> Path:
    path = log.with_name("run.log")
    assert pneud_here("export", log, "-o", path).returncode == 0
    return path


def test_round_trip_to_the_bit(log: Path, candump: Path, tmp_path: Path) -> None:
    done = pneud_here("import", candump, "-o", tmp_path / "again.mcap")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    first, again = list(read_log(log)), list(read_log(tmp_path / "again.mcap"))
    assert [t.check for t in again] == [t.check for t in first]
    assert [t.sent[1].data for t in again] == [t.sent[1].data for t in first]
    assert [(t.t_ns, t.frames, t.before, t.state) for t in again] == [
        (t.t_ns, t.frames, t.before, t.state) for t in first
    ]
    outcome = replay(read_log(tmp_path / "again.mcap"))
    assert outcome.identical
    assert outcome.engaged_ticks > 500


def test_a_bus_that_loses_and_corrupts_frames_survives_the_trip(tmp_path: Path) -> None:
    simulated(tmp_path / "a.mcap", 0.4, mangle)
    assert pneud_here("export", tmp_path / "a.mcap", "-o", tmp_path / "a.log").returncode == 0
    assert pneud_here("import", tmp_path / "a.log", "-o", tmp_path / "b.mcap").returncode == 0
    first, again = (list(read_log(tmp_path / f"{name}.mcap")) for name in "ab")
    assert [t.check for t in again] == [t.check for t in first]


def test_without_what_was_exported_requests_are_inferred(log: Path, candump: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.log"
    bare.write_bytes(candump.read_bytes())
    output = tmp_path / "bare.mcap"
    done = pneud_here("import", bare, "--dbc", DBC, "--config", "virtual.toml", "-o", output)
    assert done.returncode == 0, done.stderr
    assert "inferred" in done.stderr
    outcome = replay(read_log(output))
    assert outcome.engaged_ticks > 500
    # the end of the run was asked for, which leaves no trace on the bus before the valve is centred
    assert outcome.first is not None
    assert outcome.first.tick >= 800
    done = pneud_here("report", output, "-o", tmp_path / "bare.html")
    assert done.returncode == 0, done.stderr


def test_only_the_channel_of_the_axis_counts(candump: Path, tmp_path: Path) -> None:
    lines = candump.read_text().splitlines()
    other = [line.replace(" can0 ", " can1 ") for line in lines if " 080#" not in line][::7]
    mixed = tmp_path / "mixed.log"
    mixed.write_text("\n".join(sorted([*lines, *other])) + "\n")
    done = pneud_here("import", mixed, "--dbc", DBC, "--config", "virtual.toml", "-o", tmp_path / "m.mcap")
    assert done.returncode == 0, done.stderr
    assert f"{len(other)} frames on other channels" in done.stderr


@pytest.mark.parametrize("suffix", ["asc", "blf", "log"])
def test_python_can_reads_what_is_exported(log: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x.{suffix}"
    assert pneud_here("export", log, "-o", path).returncode == 0
    expected = [f for t in read_log(log) for f in (t.sent[0], *t.frames, t.sent[1])]
    with can.LogReader(path) as reader:
        found = list(reader)
    assert sorted((m.arbitration_id, bytes(m.data)) for m in found) == sorted(
        (f.can_id, f.data) for f in expected
    )
    assert sum(not m.is_rx for m in found) == 2 * sum(1 for _ in read_log(log))


@pytest.mark.parametrize("suffix", ["asc", "blf"])
def test_other_formats_come_back_within_their_resolution(log: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x.{suffix}"
    assert pneud_here("export", log, "-o", path).returncode == 0
    assert pneud_here("import", path, "-o", tmp_path / "x.mcap").returncode == 0
    first, again = list(read_log(log)), list(read_log(tmp_path / "x.mcap"))
    assert [t.sent[1].data for t in again] == [t.sent[1].data for t in first]
    assert [t.state for t in again] == [t.state for t in first]
    off_ns = [a.t_ns - b.t_ns for a, b in zip(first, again, strict=True)]
    assert max(off_ns) - min(off_ns) <= 2000
    assert max(map(abs, off_ns)) < 2_000_000  # an .asc knows its date to the millisecond


def test_a_table(log: Path, tmp_path: Path) -> None:
    assert pneud_here("export", log, "-o", tmp_path / "x.csv").returncode == 0
    with (tmp_path / "x.csv").open() as file:
        rows = list(csv.DictReader(file))
    ticks = list(read_log(log))
    assert len(rows) == len(ticks)
    for row, tick in list(zip(rows, ticks, strict=True))[::97]:
        assert int(row["t_ns"]) == tick.t_ns
        assert float(row["measurement.position_m"]) == pytest.approx(tick.measurement.position_m, rel=1e-7)
        assert int(row["timing.set_ns"]) == tick.timing.set_ns
    assert sorted({row["request.kind"] for row in rows}) == ["0", "1", "4"]


@pytest.mark.slow
def test_parquet_says_the_same(log: Path, tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    for suffix in ("csv", "parquet"):
        assert pneud_here("export", log, "-o", tmp_path / f"x.{suffix}").returncode == 0
    table = pq.read_table(tmp_path / "x.parquet")
    with (tmp_path / "x.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert table.column_names == list(rows[0])
    for name in ("t_ns", "estimate.force_n", "state", "measurement.skipped"):
        assert [str(v) for v in table[name].to_pylist()] == [row[name] for row in rows]


@pytest.mark.slow
def test_cantools_decodes_the_candump_log(log: Path, candump: Path) -> None:
    with candump.open() as file:
        done = subprocess.run(
            [sys.executable, "-m", "cantools", "decode", "--single-line", DBC],
            stdin=file, capture_output=True, text=True, timeout=60, check=True,
        )  # fmt: skip
    lines = done.stdout.splitlines()
    ticks = list(read_log(log))
    for name, per_tick in (("SYNC", 1), ("ENCODER", 1), ("PRESSURE", 1), ("VALVE_COMMAND", 1)):
        assert sum(f":: {name}(" in line for line in lines) == per_tick * len(ticks)
    assert not [line for line in lines if "Unknown" in line or "Failed" in line]


@pytest.mark.slow
def test_python_cans_player_plays_it(candump: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    some = tmp_path / "some.log"
    wanted = candump.read_text().splitlines()[:400]
    some.write_text("\n".join(wanted) + "\n")
    with can.Bus(interface="unixcan", channel="played") as bus:
        subprocess.run(
            [sys.executable, "-m", "can.player", "-i", "unixcan", "-c", "played", some],
            capture_output=True, timeout=60, check=True,
        )  # fmt: skip
        heard = []
        while (message := bus.recv(0.2)) is not None:
            heard.append(f"{message.arbitration_id:03X}#{message.data.hex().upper()}")
    assert heard == [line.split()[2] for line in wanted]


_ids = st.one_of(
    st.integers(0, 0x7FF),
    st.integers(0, 0x1FFFFFFF).map(lambda n: n | 0x80000000),
    st.integers(0, 0x1FFFFFFF).map(lambda n: n | 0x20000000),
)


@settings(max_examples=40, deadline=None)
@given(
    frames=st.lists(
        st.tuples(
            st.builds(Frame, st.integers(0, 2**61), _ids, st.binary(max_size=8)),
            st.booleans(),
        )
    )
)
def test_candump_lines_keep_everything(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[Frame, bool]]
) -> None:
    path = tmp_path_factory.mktemp("c") / "x.log"
    assert traffic.write(path, frames) == len(frames)
    assert [(p.frame, p.sent) for p in traffic.read(path)] == frames


def test_candumps_own_lines(tmp_path: Path) -> None:
    path = tmp_path / "x.log"
    path.write_text("(1.000001) vcan0 123#DEADBEEF\n(2.5) vcan0 12345678#R\n\n(3.0) vcan0 123##1AA\n")
    assert list(traffic.read(path)) == [
        traffic.Passing(Frame(1_000_001_000, 0x123, b"\xde\xad\xbe\xef"), "vcan0", None),
        traffic.Passing(Frame(2_500_000_000, 0xD2345678, b""), "vcan0", None),
    ]
    path.write_text("(1.0) vcan0 123#00\nnonsense\n")
    remarks = Remarks()
    assert len(list(traffic.read(path, remarks))) == 1
    assert remarks.partial
    (said,) = remarks.lines()
    assert said.startswith("line 2: not a line of a candump log")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("export", "LOG", "-o", "TMP/x.txt"), "no such format"),
        (("export", "LOG", "-o", "TMP/none/x.log"), "no folder"),
        (("import", "TMP/x.pcap", "-o", "TMP/y.mcap"), "no such format"),
        (("import", "BARE", "-o", "TMP/y.mcap"), "--dbc"),
        (("import", "BARE", "--dbc", "TMP/none.dbc", "-o", "TMP/y.mcap"), "--dbc"),
        (("import", "BARE", "--dbc", DBC, "-o", "TMP/y.mcap"), "no SYNC"),
        (("import", "BARE", "--dbc", DBC, "-o", "TMP/y.txt"), ".mcap"),
        (("import", "TMP/none.asc", "--dbc", DBC, "-o", "TMP/y.mcap"), "none.asc"),
        (("import", "SPOILT", "-o", "TMP/y.mcap"), "not what pneud export writes"),
    ],
)
def test_what_cannot_be_done_is_said(log: Path, tmp_path: Path, args: tuple[object, ...], words: str) -> None:
    (tmp_path / "bare.log").write_text("(1.0) can0 123#00\n")
    (tmp_path / "spoilt.log").write_text("(1.0) can0 123#00\n")
    (tmp_path / "spoilt.log.json").write_text(json.dumps({"pneud": 1}))
    names = {"LOG": log, "BARE": tmp_path / "bare.log", "SPOILT": tmp_path / "spoilt.log"}
    done = pneud_here(*(names.get(str(a), str(a).replace("TMP", str(tmp_path))) for a in args))
    assert done.returncode == 2, (done.stdout, done.stderr)
    assert words in done.stderr
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "y.mcap").exists()
