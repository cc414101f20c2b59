"""An hour at 1 kHz: its report is one page of modest size, made in modest memory, with every peak in it."""

from __future__ import annotations

import base64
import json
import re
import resource
from pathlib import Path

import numpy as np
import pytest

from commands import pneud
from mangled import header_of
from pneud.log.files.naming import create_log
from pneud.log.files.writer import LogWriter
from pneud.replay.lockstep import simulate

pytestmark = pytest.mark.soak

TICKS = 3_600_000
PEAK_AT, PEAK_N = 2_000_123, 777.0


@pytest.fixture(scope="module")
def hour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of tracking, again and again."""
    path = tmp_path_factory.mktemp("logs") / "hour.mcap"
    some = list(simulate("virtual.toml", 23.0, 1))[3000:23000]
    writer = LogWriter(create_log(path), header_of("virtual.toml"))
    for n in range(TICKS):
        record = some[n % len(some)]
        late_ns = n // len(some) * len(some) * 1_000_000
        tick = record.tick
        estimate = tick.estimate._replace(force_n=PEAK_N) if n == PEAK_AT else tick.estimate
        moved = tick._replace(
            t_ns=tick.t_ns + late_ns,
            measurement=tick.measurement._replace(t_ns=tick.t_ns + late_ns),
            estimate=estimate,
        )
        frames, sent = (
            tuple(f._replace(stamp_ns=f.stamp_ns + late_ns) for f in group)
            for group in (record.frames, record.sent)
        )
        writer.write(record._replace(tick=moved, frames=frames, sent=sent))
    assert writer.close()
    return path


def test_an_hour(hour: Path) -> None:
    page = hour.with_suffix(".html")
    done = pneud("report", hour, "-o", page, timeout=900)
    assert done.returncode == 0, done.stderr
    assert page.stat().st_size <= 5_000_000
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < 500_000  # KiB
    (found,) = re.findall(r'id="data">(.*?)</script>', page.read_text(), re.DOTALL)
    (run,) = json.loads(found)["runs"]
    force = np.frombuffer(base64.b64decode(run["columns"]["force_n"]), dtype="<f4")
    t = np.frombuffer(base64.b64decode(run["t"]), dtype="<f8")
    (at,) = np.flatnonzero(force == PEAK_N)
    assert abs(t[at] - PEAK_AT * 1e-3) < 0.6
    assert len(t) > 8000
