"""Ten minutes of fast rotation under a small quota, in real time."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from commands import object_of, pneud
from pneud.loading import load
from pneud.log.reader import read_log

QUOTA_MB = 64.0


@pytest.mark.soak
def test_ten_minutes_in_a_small_quota_lack_no_record(tmp_path: Path) -> None:
    config, folder = tmp_path / "virtual.toml", tmp_path / "logs"
    settings = f"[log]\npart_mb = 2.0\npart_s = 10.0\nquota_mb = {QUOTA_MB}\n"
    config.write_text(load("virtual.toml").text.replace("[log]\n", settings))
    options = ("--duration", 600, "--json", "--log", folder)
    run = object_of(pneud("--virtual", "--config", config, *options, timeout=700))
    assert run["log_dropped"] == 0
    paths = sorted(folder.iterdir())
    assert len(paths) > 20
    assert sum(p.stat().st_size for p in paths) <= QUOTA_MB * 1e6
    numbers = (tick.number for tick in read_log(folder))
    assert all(after == before + 1 for before, after in pairwise(numbers))
    replayed = object_of(pneud("replay", folder, "--json", timeout=600))
    assert replayed["identical"] is True
    assert replayed["truncated"] is False
