"""Logs cut anywhere, with any bit flipped: every whole chunk is saved, for our reader and @mcap/core."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
from mcap.opcode import Opcode
from mcap.writer import Writer

from log_samples import bits, header, noisy
from pneud.log.files.naming import LogError, create_log
from pneud.log.files.part import checked
from pneud.log.files.reader import read_log
from pneud.log.files.recovery import recover
from pneud.log.files.writer import LogWriter
from pneud.log.format.framing import MAGIC, open_mcap, pieces
from pneud.log.format.schema import COPY

PER_CHUNK, CHUNKS = 15, 24
RECORDS = list(noisy(PER_CHUNK * CHUNKS))
WHOLE = [bits(r) for r in RECORDS]
NODE = Path(__file__).parent / "node"


class Source(NamedTuple):
    """A log, and where the head ends and its chunks lie."""

    data: bytes
    head: int
    chunks: list[tuple[int, int]]

    def numbers(self, spared: list[bool]) -> set[int]:
        """Of the records in some chunks."""
        return {
            chunk * PER_CHUNK + i + 1
            for chunk, is_spared in enumerate(spared)
            if is_spared
            for i in range(PER_CHUNK)
        }


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    path = tmp_path_factory.mktemp("source") / "x.mcap"
    writer = LogWriter(create_log(path), header())
    for n, record in enumerate(RECORDS, start=1):
        writer.write(record)
        if n % PER_CHUNK == 0:
            writer.snapshot({"axis": (n, 0.5)}) if n % (5 * PER_CHUNK) == 0 else writer.flush()
    writer.close()
    with open_mcap(path) as file:
        found = list(pieces(file, skip_chunks=True))
    places = [(p, after.offset) for p, after in pairwise(found)]
    chunks = [(p.offset, end) for p, end in places if p.opcode == Opcode.CHUNK]
    chunks = chunks[:CHUNKS]  # behind them lies one with the last snapshot alone
    return Source(path.read_bytes(), chunks[0][0], chunks)


def saved(folder: Path, data: bytes, name: str) -> tuple[Path | None, set[int]]:
    """The mended log, and the numbers of what our reader reads of it; none where the head is gone."""
    damaged, mended = folder / "damaged.mcap", folder / f"{name}.mcap"
    damaged.write_bytes(data)
    try:
        recover(damaged, mended)
    except LogError as e:
        assert "\n" not in str(e)
        return None, set()
    try:
        log = read_log(mended)
    except LogError as e:
        assert "\n" not in str(e)
        return mended, set()
    ticks = list(log)
    assert not log.truncated, log.damage
    assert [bits(t.record) for t in ticks] == [WHOLE[t.number - 1] for t in ticks]
    return mended, {t.number for t in ticks}


def cut_anywhere(source: Source, folder: Path, count: int) -> list[Path]:
    rng = random.Random(5)
    mended = []
    for i in range(count):
        position = rng.randrange(len(source.data))
        path, numbers = saved(folder, source.data[:position], f"cut{i}")
        spared = [end <= position for _, end in source.chunks]
        assert numbers == source.numbers(spared), position
        assert path is not None or position < len(MAGIC)
        mended += [path] if path is not None else []
    return mended


def flipped_anywhere(source: Source, folder: Path, count: int) -> list[Path]:
    rng = random.Random(6)
    mended = []
    for i in range(count):
        # the head and the index are small: they get their share
        high = (source.head, len(source.data), len(source.data))[i % 3]
        low = (0, 0, source.chunks[-1][1])[i % 3]
        position = rng.randrange(low, high)
        data = bytearray(source.data)
        data[position] ^= 1 << rng.randrange(8)
        path, numbers = saved(folder, bytes(data), f"flip{i}")
        spared = [not start <= position < end for start, end in source.chunks]
        assert numbers >= source.numbers(spared), position
        assert path is not None
        mended.append(path)
    return mended


def test_cut_or_flipped_somewhere_every_whole_chunk_is_saved(source: Source, tmp_path: Path) -> None:
    cut_anywhere(source, tmp_path, 12)
    flipped_anywhere(source, tmp_path, 18)


@pytest.mark.parametrize("place", ["head", "first chunk", "magic"])
def test_what_stands_in_one_place_only_is_known_from_elsewhere(
    source: Source, tmp_path: Path, place: str
) -> None:
    data = bytearray(source.data)
    start, end = source.chunks[0]
    if place == "head":
        data[len(MAGIC) + 40 : start] = bytes(start - len(MAGIC) - 40)
    elif place == "first chunk":
        data[start:end] = bytes(end - start)
    else:
        data[1:4] = b"PCM"
    _, numbers = saved(tmp_path, bytes(data), "mended")
    assert numbers == source.numbers([place != "first chunk" or i > 0 for i in range(CHUNKS)])
    log = read_log(tmp_path / "mended.mcap")
    assert (log.config_text, log.dbc) == (header().config_text, header().dbc)
    assert log.metadata["seed"] == "7"


@pytest.mark.parametrize("lost", ["config_text", "dbc_base64", "dbc"])
def test_metadata_without_its_checksum_is_damaged(source: Source, tmp_path: Path, lost: str) -> None:
    data = bytearray(source.data)
    for key in ("crc32", lost):
        data[source.data.index(key.encode(), source.chunks[-1][1])] ^= 1
    _, numbers = saved(tmp_path, bytes(data), "mended")
    assert numbers == source.numbers([True] * CHUNKS)
    # and where the copy is the only one
    data[len(MAGIC) + 40 : source.head] = bytes(source.head - len(MAGIC) - 40)
    _, numbers = saved(tmp_path, bytes(data), "mended")
    assert numbers == set()


def test_a_copy_of_the_head_that_lacks_something_is_damage_in_words(tmp_path: Path) -> None:
    path = tmp_path / "crafted.mcap"
    with path.open("wb") as f:
        writer = Writer(f)
        writer.start()
        writer.add_metadata(COPY, checked({"config": "x.toml", "dbc": "x.dbc"}))
        writer.finish()  # type: ignore[no-untyped-call]
    assert recover(path, tmp_path / "mended.mcap").damage == "the copy of the head is incomplete"


def test_many_damages_cost_their_own_chunks_only(source: Source, tmp_path: Path) -> None:
    data = bytearray(source.data)
    hit = {3, 4, 11, 20}
    for chunk in hit:
        start, end = source.chunks[chunk]
        data[start + 1] ^= 0x40  # the length
        data[(start + end) // 2] ^= 1
    _, numbers = saved(tmp_path, bytes(data), "mended")
    assert numbers == source.numbers([i not in hit for i in range(CHUNKS)])


def test_a_log_in_which_nothing_is_whole_ends_in_words(tmp_path: Path) -> None:
    for data in (MAGIC, MAGIC + bytes(5000), MAGIC + b"\x06" + b"\xff" * 3000, MAGIC * 700):
        path, numbers = saved(tmp_path, data, "x")
        assert numbers == set()
        if path is not None:
            path.unlink()
    rng = random.Random(7)
    for i in range(50):
        saved(tmp_path, MAGIC + rng.randbytes(2000), f"random{i}")


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the check and what it needs."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("NOT CHECKED with @mcap/core: this machine has no node and npm; install nodejs and npm")
    folder = tmp_path_factory.mktemp("node")
    for name in ("package.json", "check.mjs"):
        shutil.copy(NODE / name, folder)
    done = subprocess.run(
        [npm, "install", "--no-audit", "--no-fund", "--ignore-scripts"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


def counted(node: Path, paths: list[Path]) -> list[dict[str, int]]:
    """Messages by topic of each log, as @mcap/core reads it with its index and as a stream."""
    done = subprocess.run(
        ["node", "check.mjs", *map(str, paths)],
        cwd=node,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) == len(paths)
    for one in found:
        assert sum(one["counts"].values()) == one["streamed"]
    return [one["counts"] for one in found]


@pytest.mark.slow
def test_cut_or_flipped_200_times_what_is_mended_passes_mcap_core(
    source: Source, tmp_path: Path, node: Path
) -> None:
    mended = cut_anywhere(source, tmp_path, 200) + flipped_anywhere(source, tmp_path, 200)
    for path, counts in zip(mended, counted(node, mended), strict=True):
        try:
            ticks = sum(1 for _ in read_log(path))
        except LogError:
            ticks = 0
        assert counts.get("/axis/tick", 0) >= ticks


@pytest.mark.slow
def test_logs_as_written_pass_mcap_core(tmp_path: Path, node: Path) -> None:
    golden = sorted((Path(__file__).parent / "golden").glob("*.mcap"))
    for path, counts in zip(golden, counted(node, golden), strict=True):
        assert counts["/axis/tick"] == sum(1 for _ in read_log(path))
