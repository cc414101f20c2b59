"""What the processes of a run keep over minutes."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

import pytest

from commands import PNEUD, Figures, children
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
