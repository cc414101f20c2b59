"""Ten thousand damaged files for every reader: no traceback, no hang, and nothing is lost without a word.

What went in is what came out and what was named. Each reader gets files as they are found in public, made
here, with something wrong in them. Hanging is using the processor for two seconds.
"""

from __future__ import annotations

import random
import re
import signal
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType

import fuzzing
import recorded
from axis_rig import loaded
from commands import Figures, pneud_here
from log_samples import header, noisy
from mangled import simulated
from pneud import resources
from pneud.bus.codec import DatabaseError, load_codecs
from pneud.config.bus_tables import BusConfig
from pneud.config.sections import ConfigError
from pneud.loading import load
from pneud.log.files.columns import blocks
from pneud.log.files.naming import LogError, create_log
from pneud.log.files.reader import read_log
from pneud.log.files.recovery import recover
from pneud.log.files.writer import LogWriter
from pneud.replay import traffic
from pneud.replay.importing import Ticks
from pneud.replay.remarks import Remarks
from pneud.replay.surveying import survey
from pneud.replay.times import Times
from recorded import Recorded
from rewritten import rewrite

PATIENCE_S = 2.0
few, many = pytest.param(50, id="few"), pytest.param(1000, id="many", marks=pytest.mark.slow)
all_of_them = pytest.param(10_000, id="all", marks=pytest.mark.soak)
share = pytest.mark.parametrize("count", [few, many, all_of_them])
DBC = resources.configs() / "pneud.dbc"
TEXT_NOISE = ("NUL bytes", "not a date")  # remarks that are not of a line


@contextmanager
def in_time() -> Iterator[None]:
    """What hangs fails."""

    def late(*_: object) -> None:
        raise TimeoutError(f"still at it after {PATIENCE_S} s")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, PATIENCE_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("run")
    simulated(folder / "x.mcap", 0.08)
    assert pneud_here("export", folder / "x.mcap", "-o", folder / "x.log").returncode == 0
    found = [(p.frame, bool(p.sent)) for p in traffic.read(folder / "x.log")]
    return sorted(found, key=lambda pair: pair[0].stamp_ns)[:250]


def candumps(folder: Path, run: Recorded) -> list[bytes]:
    path = folder / "made.log"
    made = []
    for way in (lambda _: "", lambda _: " R", lambda sent: " T" if sent else " R"):
        recorded.candump(path, run, way)
        made.append(path.read_bytes())
    recorded.can_logger(path, run)
    stamp = b"(1700000001.200000) can0 "
    more = b"\n".join(
        stamp + text
        for text in (b"12345678#00", b"123##1AA", b"20000080#00", b"123#R4", b"7FF#0011223344556677_D")
    )
    return [*made, path.read_bytes() + more + b"\n"]


def ascs(folder: Path, run: Recorded) -> list[bytes]:
    path = folder / "made.asc"
    made = []
    for options in ({}, {"relative": True}, {"requests": True, "offset_s": -1.0}):
        recorded.vector_asc(path, run, **options)
        made.append(path.read_bytes())
    recorded.can_logger(path, run)
    head, _, rest = path.read_bytes().partition(b"\n")
    assert head.startswith(b"date ")
    return [*made, b"date Tue Nov 14 22:13:20.123 2023\n" + rest]  # not today's, so that a seed stays a seed


def blfs(folder: Path, run: Recorded) -> list[bytes]:
    path = folder / "made.blf"
    recorded.can_logger(path, run)
    objects = [recorded.blf_frame(f, run[0][0].stamp_ns) for f, _ in run]
    return [
        path.read_bytes(),
        recorded.blf(objects, count=len(objects), containers=5),
        recorded.blf(objects, count=len(objects), containers=4, level=0),
        recorded.blf(objects, containers=7),
    ]


def rows(data: bytes) -> list[str]:
    """The lines that say something, by another way than the reader's."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    texts = (row.strip(b"\0 \t\r").decode("cp1252", "replace") for row in re.split(rb"\r\n|\r|\n", data))
    return [said for text in texts if (said := " ".join(text.split()))]


def said(remarks: Remarks) -> int:
    """How many lines a reader has passed over and named."""
    return remarks.count() - sum(
        remarks.count(line.partition(": ")[2])
        for line in remarks.lines()
        if any(n in line for n in TEXT_NOISE)
    )


SILENT = re.compile(
    r"//|date\b|base\s+(hex|dec)(\s+timestamps\s+(absolute|relative))?$|begin\s+triggerblock\b"
    r"|(no\s+)?internal\s+events\s+logged$|end\s+triggerblock$|previous\s+log\s+file"
    r"|-?[0-9]{1,20}(\.[0-9]+)?\s+(//|start of measurement$|can \d+ status|log |comment|"
    r"[0-9]+\s+(statistic|overloadframe))",
    re.IGNORECASE,
)


def all_lines_are_accounted_for(data: bytes, found: int, remarks: Remarks, suffix: str) -> None:
    there = rows(data)
    silent = sum(1 for row in there if suffix == "asc" and SILENT.match(row))
    assert found + said(remarks) == len(there) - silent, remarks.lines()


MAKERS: dict[str, Callable[[Path, Recorded], list[bytes]]] = {"log": candumps, "asc": ascs, "blf": blfs}


@share
@pytest.mark.parametrize("suffix", MAKERS)
def test_recordings(tmp_path: Path, run: Recorded, suffix: str, count: int, figures: Figures) -> None:
    rng = random.Random(f"{suffix} {count}")
    samples = MAKERS[suffix](tmp_path, run)
    path = tmp_path / f"x.{suffix}"
    codecs = loaded().codecs
    outcomes: Counter[str] = Counter()
    for n in range(count):
        data = (fuzzing.binary if suffix == "blf" else fuzzing.lines)(rng.choice(samples), rng)
        path.write_bytes(data)
        remarks = Remarks()
        try:
            with in_time():
                found = list(traffic.read(path, remarks))
        except LogError as e:
            outcomes["refused"] += 1
            assert "\n" not in str(e)
            continue
        outcomes["partial" if remarks.partial else "whole"] += 1
        if suffix == "blf":
            assert len(found) >= len(run) or remarks.count()
        else:
            all_lines_are_accounted_for(data, len(found), remarks, suffix)
        with in_time():
            outcomes[ticks_hold_all_frames(path, codecs)] += 1
        if n % 30 == 0:
            assert_imported(path)
    figures(f"{count} recordings as .{suffix}: {dict(sorted(outcomes.items()))}")


def ticks_hold_all_frames(path: Path, codecs: Any) -> str:
    remarks = Remarks()
    try:
        what = survey(path, codecs, 1000.0)
    except LogError as e:
        assert "\n" not in str(e)
        return "no ticks"
    times = Times(what.start_ns, what.start_ns - 10**9, 1e6, remarks)
    ticks = Ticks(traffic.read(path), codecs, what, times, remarks)
    heard = list(ticks)
    frames = [f for h in heard for f in (h.sync, *h.before, *h.after, h.command) if f is not None]
    after = remarks.count("frames after the last command, which belong to no tick")
    assert len(frames) + after + ticks.elsewhere == sum(1 for _ in traffic.read(path))
    begun = [h.sync.stamp_ns for h in heard if h.sync is not None]
    assert begun == sorted(begun)
    assert all(0 <= f.stamp_ns < 1 << 62 for f in frames)
    return "ticks"


def assert_imported(path: Path) -> None:
    output = path.with_suffix(".mcap")
    output.unlink(missing_ok=True)
    with in_time():
        done = pneud_here("import", path, "--dbc", DBC, "--config", "virtual.toml", "-o", output)
    assert done.returncode in (0, 1, 2)
    if done.returncode == 2:
        assert (done.stdout, done.stderr.count("\n")) == ("", 1)
        assert not output.exists()
    else:
        assert f"{output}: {sum(1 for _ in read_log(output))} ticks" in done.stdout


WAYS: list[dict[str, Any]] = [
    {"chunked": False},
    {"chunk_bytes": 3000},
    {"compression": CompressionType.LZ4, "chunk_bytes": 3000, "head_last": True},
    {"compression": CompressionType.NONE, "chunk_bytes": 3000, "strange": True},
    {"chunk_bytes": 3000, "key": lambda topic, _: topic},
]
TICKS = 40


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    folder = tmp_path_factory.mktemp("logs")
    writer = LogWriter(create_log(folder / "own.mcap"), header())
    for n, record in enumerate(islice(noisy(TICKS), TICKS), start=1):
        writer.write(record)
        if n % 10 == 0:
            writer.snapshot({"axis": (n, 0.5)})
    writer.close()
    made = [(folder / "own.mcap").read_bytes()]
    for n, way in enumerate(WAYS):
        rewrite(folder / "own.mcap", folder / f"{n}.mcap", **way)
        made.append((folder / f"{n}.mcap").read_bytes())
    return made


@share
def test_logs(tmp_path: Path, logs: list[bytes], count: int, figures: Figures) -> None:
    rng = random.Random(f"mcap {count}")
    path, mended = tmp_path / "x.mcap", tmp_path / "mended.mcap"
    outcomes: Counter[str] = Counter()
    for _ in range(count):
        path.write_bytes(fuzzing.binary(rng.choice(logs), rng))
        try:
            with in_time():
                log = read_log(path)
                ticks = list(log)
            outcomes["damaged" if log.truncated else "read"] += 1
            assert len(ticks) == TICKS or log.damage or log.missing
            with in_time():
                assert sum(len(block.number) for block in blocks(log)) == len(ticks) or log.damage
        except LogError as e:
            outcomes["refused"] += 1
            assert "\n" not in str(e)
        try:
            with in_time():
                report = recover(path, mended)
        except LogError as e:
            outcomes["not mended"] += 1
            assert "\n" not in str(e)
            continue
        outcomes["mended"] += 1
        assert report.messages or report.damage
        with in_time():
            try:
                again = read_log(mended)
                assert len(list(again)) == TICKS or report.damage or again.damage or again.missing
            except LogError:
                assert report.damage
        mended.unlink()
    figures(f"{count} logs: {dict(sorted(outcomes.items()))}")


MORE_DBC = """
BO_ 2566844926 CCVS1: 8 Vector__XXX
 SG_ WheelBasedVehicleSpeed : 8|16@1+ (0.00390625,0) [0|250.996] "km/h"  Vector__XXX
 SG_ Mode M : 0|4@1+ (1,0) [0|15] "" Vector__XXX
 SG_ Torque m1 : 39|12@0- (0.5,-10.25) [-1034.25|1013.25] "Nm" Vector__XXX
 SG_ Temperature m2 : 39|8@0+ (1,-40) [0|0] "\N{DEGREE SIGN}C" Vector__XXX

BO_ 1024 FdThing: 64 ENCODER_NODE
 SG_ Big : 0|64@1+ (1E-3,0) [-1.79769313486232E+308|1.79769313486232E+308] "\N{MICRO SIGN}m" CONTROLLER

CM_ "A comment on
two lines, with \\"quotes\\"";
BA_DEF_ BO_  "GenMsgCycleTime" INT 0 65535;
BA_DEF_ SG_  "GenSigStartValue" FLOAT -1.5E9 1.5E9;
BA_DEF_DEF_  "GenMsgCycleTime" 0;
BA_DEF_DEF_  "GenSigStartValue" 0;
BA_ "GenMsgCycleTime" BO_ 385 1;
BA_ "GenSigStartValue" SG_ 385 Position 0;
SIG_GROUP_ 385 Group 1 : Position Status;
"""


@share
def test_databases(tmp_path: Path, count: int, figures: Figures) -> None:
    rng = random.Random(f"dbc {count}")
    text = DBC.read_text().replace("\nCM_ BO_ 128", MORE_DBC + "\nCM_ BO_ 128", 1)
    samples = [text.encode(), text.encode("utf-8-sig"), text.replace("\n", "\r\n").encode("cp1252")]
    path = tmp_path / "x.dbc"
    outcomes: Counter[str] = Counter()
    for sample in samples:
        path.write_bytes(sample)
        load_codecs(BusConfig(), path)
    for _ in range(count):
        if rng.random() < 0.5:
            path.write_bytes(fuzzing.lines(rng.choice(samples), rng))
        else:
            path.write_bytes(fuzzing.database(text, rng))
        try:
            with in_time():
                load_codecs(BusConfig(), path)
            outcomes["taken"] += 1
        except DatabaseError as e:
            outcomes["refused"] += 1
            assert "\n" not in str(e)
            assert str(e).startswith(f"{path}: ")
    figures(f"{count} DBCs: {dict(outcomes)}")


@share
def test_configurations(tmp_path: Path, count: int, figures: Figures) -> None:
    rng = random.Random(f"toml {count}")
    text = (resources.configs() / "virtual.toml").read_text()
    samples = [text.encode(), text.encode("utf-8-sig"), text.replace("\n", "\r\n").encode()]
    (tmp_path / "pneud.dbc").write_bytes(DBC.read_bytes())
    path = tmp_path / "x.toml"
    outcomes: Counter[str] = Counter()
    for _ in range(count):
        if rng.random() < 0.5:
            path.write_bytes(fuzzing.lines(rng.choice(samples), rng))
        else:
            path.write_bytes(fuzzing.configuration(text, rng))
        try:
            with in_time():
                load(path)
            outcomes["taken"] += 1
        except (ConfigError, DatabaseError) as e:
            outcomes["refused"] += 1
            assert "\n" not in str(e)
    figures(f"{count} configurations: {dict(outcomes)}")
