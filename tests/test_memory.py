"""What the processes of a run keep over minutes."""

from __future__ import annotations

import os
import subprocess
import time
import tracemalloc
from itertools import cycle
from pathlib import Path

import pytest

from commands import PNEUD, Figures, children
from log_samples import header, noisy
from pneud.log.files.naming import create_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import Rotation
from running import patient_axis

MIB = 1 << 20


def resident_bytes(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize(
    ("begin_s", "span_s", "every_s"),
    [
        pytest.param(6, 8, 1, id="few", marks=pytest.mark.slow),
        pytest.param(60, 600, 10, id="all", marks=pytest.mark.soak),
    ],
)
def test_the_control_process_does_not_grow(
    tmp_path: Path, begin_s: int, span_s: int, every_s: int, figures: Figures
) -> None:
    command = [*PNEUD, "--virtual", "--config", str(patient_axis(tmp_path)), "--headless", "--json"]
    process = subprocess.Popen([*command, "--log", str(tmp_path)], stdout=subprocess.DEVNULL)
    found, others = [], []
    try:
        time.sleep(begin_s)
        for _ in range(span_s // every_s):
            assert process.poll() is None
            found.append(resident_bytes(process.pid))
            others.append(sum(map(resident_bytes, children(process.pid))))
            time.sleep(every_s)
    finally:
        process.terminate()
        process.wait(30.0)
    assert max(found) - min(found) <= MIB, [round(n / MIB, 2) for n in found]
    figures(
        f"{span_s} s after the first {begin_s} s: {min(found) / MIB:.2f} to {max(found) / MIB:.2f} MiB;"
        f" recorder, console and plant together {min(others) / MIB:.2f} to {max(others) / MIB:.2f} MiB"
    )


CHUNKS = 800  # of a part; a second makes ten or a few more
OF_A_CHUNK = 1024  # bytes kept until the part is closed: its line in the index
REST = 128 * 1024  # whatever the index holds


@pytest.mark.slow
def test_the_recorder_keeps_the_index_of_one_part_and_no_more(tmp_path: Path, figures: Figures) -> None:
    path = tmp_path / "run.mcap"
    log = LogWriter(create_log(path), header(), Rotation(path, CHUNKS * 10**9, 0, 0, True, 0, 0))
    records = cycle(list(noisy(100)))
    kept, left = [], []

    def fill(chunks: int) -> None:
        for _ in range(chunks):
            log.write(next(records))
            log.flush()

    fill(100)
    tracemalloc.start()
    try:
        for _ in range(3):
            fill(CHUNKS)
            kept.append(tracemalloc.get_traced_memory()[0])
            log._rotation = log._rotation._replace(part_bytes=1)  # type: ignore[union-attr]
            log.snapshot(None)
            log._rotation = log._rotation._replace(part_bytes=1 << 60)
            left.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
        log.close()
    assert len(list(tmp_path.iterdir())) == 4
    assert max(left) <= REST, "what a part's index took is given back when the part is closed"
    assert max(kept) - REST <= CHUNKS * OF_A_CHUNK
    figures(
        f"the recorder keeps {max(kept) / CHUNKS:.0f} bytes a chunk until a part is closed:"
        f" {36_000 * max(kept) / CHUNKS / MIB:.0f} MiB of a part of an hour with 10 chunks a second"
    )
