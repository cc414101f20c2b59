"""Fast rotation under a small quota, in real time."""

from __future__ import annotations

import json
import subprocess
import time
from itertools import pairwise
from pathlib import Path

import pytest

from commands import PNEUD, Figures, object_of, pneud
from pneud.log.files.reader import read_log
from running import patient_axis

pytestmark = pytest.mark.realtime

BETWEEN_MB = 0.5  # what a part may have beyond its size: as much as comes between two snapshots


@pytest.mark.parametrize(
    ("duration_s", "quota_mb", "part_mb"),
    [
        pytest.param(16, 1.6, 0.4, id="few", marks=pytest.mark.slow),
        pytest.param(600, 64.0, 2.0, id="all", marks=pytest.mark.soak),
    ],
)
def test_parts_that_remain_of_a_run_in_a_small_quota_lack_no_record(
    tmp_path: Path, duration_s: int, quota_mb: float, part_mb: float, figures: Figures
) -> None:
    config, folder = patient_axis(tmp_path), tmp_path / "logs"
    settings = f"[log]\npart_mb = {part_mb}\npart_s = 10.0\nquota_mb = {quota_mb}\n"
    config.write_text(config.read_text().replace("[log]\n", settings))
    options = ["--duration", str(duration_s), "--headless", "--json", "--log", str(folder)]
    command = [*PNEUD, "--virtual", "--config", str(config), *options]
    daemon = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    most_mb = 0.0
    while daemon.poll() is None:
        most_mb = max(most_mb, size_mb(folder))
        time.sleep(0.1)
    out, err = daemon.communicate()
    assert daemon.returncode == 0, err
    run = json.loads(out)
    log = read_log(folder)
    numbers = [tick.number for tick in log]
    assert (log.missing, log.truncated, run["log_dropped"]) == (0, False, 0), (log.missing, log.damage, err)
    assert all(after == before + 1 for before, after in pairwise(numbers))
    assert numbers[-1] >= run["ticks"]
    assert numbers[0] > 1, "nothing had to go"
    assert max(most_mb, size_mb(folder)) <= quota_mb + BETWEEN_MB
    replayed = object_of(pneud("replay", folder, "--json", timeout=900))
    assert (replayed["identical"], replayed["truncated"], replayed["ticks"]) == (True, False, len(numbers))
    figures(
        f"{run['ticks']} ticks in {duration_s} s; {len(log.paths)} parts of {part_mb} MB remain,"
        f" never more than {most_mb:.1f} MB in {quota_mb} MB;"
        f" records {numbers[0]} to {numbers[-1]}, none missing;"
        f" replay identical in {replayed['ticks']} ticks"
    )


def size_mb(folder: Path) -> float:
    total = 0
    for path in folder.glob("*"):
        try:
            total += path.stat().st_size
        except FileNotFoundError:  # it had to go just now
            continue
    return total * 1e-6
