"""What the processes of a run keep over minutes."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

import pytest

from commands import PNEUD

BEGIN_S, SPAN_S, EVERY_S = 60, 600, 10
MIB = 1 << 20


def resident_bytes(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.soak
def test_the_control_process_does_not_grow(tmp_path: Path) -> None:
    seconds = BEGIN_S + SPAN_S + 20
    command = [*PNEUD, "--virtual", "--duration", str(seconds), "--headless", "--json"]
    process = subprocess.Popen([*command, "--log", str(tmp_path)], stdout=subprocess.DEVNULL)
    try:
        time.sleep(BEGIN_S)
        found = []
        for _ in range(SPAN_S // EVERY_S):
            found.append(resident_bytes(process.pid))
            time.sleep(EVERY_S)
    finally:
        process.terminate()
        process.wait(30.0)
    assert max(found) - min(found) <= MIB, [round(n / MIB, 2) for n in found]
