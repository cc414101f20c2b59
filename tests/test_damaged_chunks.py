"""Logs with damaged compressed chunks, through every verb that reads one: a line, a status, all before it."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType

from commands import pneud_here
from mangled import simulated
from pneud.log.files.reader import read_log
from rewritten import rewrite

MAGIC = b"\x89MCAP0\r\n"
KINDS = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}
COUNT = 2
MORE = pytest.param(30, marks=pytest.mark.slow, id="many")
VERBS = {
    "replay": "replay {}",
    "replay from": "replay {} --from 0.1",
    "what if": "replay {} --set control.k1=90000",
    "against": "replay LOG --against {}",
    "report": "report {} -o OUT.html",
    "compared": "report LOG {} -o OUT.html",
    "table": "export {} -o OUT.csv",
    "frames": "export {} -o OUT.log",
    "recover": "recover {} -o OUT.mcap",
}
TOOLS = ("report", "compared", "table", "frames")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    simulated(path, 0.3)
    return path


def chunks(data: bytes, kind: str) -> list[tuple[int, int]]:
    """Where the chunks' compressed data begin, and how long they are."""
    at, found, before = len(MAGIC), [], 32 + len(kind)  # of the data in a chunk's record
    while data[at : at + 1] not in (b"", MAGIC[:1]):
        length = int.from_bytes(data[at + 1 : at + 9], "little")
        if data[at] == Opcode.CHUNK:
            begin = at + 9 + before + 8
            found.append((begin, at + 9 + length - begin))
        at += 9 + length
    return found


@pytest.mark.parametrize("count", [COUNT, MORE])
@pytest.mark.parametrize("kind", KINDS)
def test_all_verbs_read_up_to_the_damage(kind: str, count: int, log: Path, tmp_path: Path) -> None:
    rewrite(log, tmp_path / "whole.mcap", compression=KINDS[kind], chunk_bytes=4000)
    whole = (tmp_path / "whole.mcap").read_bytes()
    begins = chunks(whole, kind)
    assert len(begins) > 5
    rng, bad = random.Random(f"{kind} {count}"), tmp_path / "bad.mcap"
    for _ in range(count):
        data = bytearray(whole)
        begin, length = rng.choice(begins[len(begins) // 2 :])
        size = rng.choice((1, 4, 40))
        at = begin + rng.randrange(max(1, min(200, length - size)))
        data[at : at + size] = rng.randbytes(size)
        bad.write_bytes(data)
        reader = read_log(bad)
        ticks = len(list(reader))
        for name, words in VERBS.items():
            for old in tmp_path.glob("out*"):
                old.unlink()
            line = words
            for key, value in {"{}": bad, "LOG": log, "OUT": tmp_path / "out"}.items():
                line = line.replace(key, str(value))
            done = pneud_here(*line.split())
            said = done.stdout + done.stderr
            assert done.returncode in (0, 1, 2), (name, done)
            assert (reader.damage or "cannot be read") in said or not reader.truncated, (name, done)
            if done.returncode == 2:
                assert (done.stdout, done.stderr.count("\n")) == ("", 1), (name, done)
            elif name in TOOLS:
                assert done.returncode == int(reader.truncated), (name, done)
                assert done.stderr.count("\n") == int(reader.truncated), (name, done)
            if name == "table" and done.returncode != 2:
                assert (tmp_path / "out.csv").read_text().count("\n") == ticks + 1, done
            elif name == "recover" and done.returncode != 2:
                assert f"left out: {int(reader.truncated)} damaged" in said or not reader.truncated, done


@pytest.mark.parametrize("name", TOOLS)
def test_the_status_tells_whether_all_was_read(name: str, log: Path, tmp_path: Path) -> None:
    """Of a log that is whole, one that ends in the middle, and what is recovered of that."""
    (tmp_path / "cut.mcap").write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    assert pneud_here("recover", tmp_path / "cut.mcap", "-o", tmp_path / "mended.mcap").returncode == 0
    for path, status in ((log, 0), (tmp_path / "cut.mcap", 1), (tmp_path / "mended.mcap", 0)):
        line = VERBS[name].replace("{}", str(path)).replace("LOG", str(log))
        done = pneud_here(*line.replace("OUT", str(tmp_path / "out")).split())
        assert done.returncode == status, (path, done)
        assert ("cut.mcap: not whole: cut short at byte" in done.stderr) == bool(status), done
