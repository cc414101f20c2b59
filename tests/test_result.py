"""What a run says of itself, and its exit status, where its log is not whole."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from commands import pneud_here
from log_samples import header, noisy
from pneud import resources
from pneud.bus.inbox import Counts
from pneud.daemon.result import tell
from pneud.log.files.naming import create_log
from pneud.log.files.writer import LogWriter
from pneud.log.live.ring import RECORDER_FAILED, RecorderStatus, Ring
from pneud.loop.tally import Tally
from pneud.safety.faults import F
from pneud.signals import State

WHOLE = RecorderStatus(9, 10, 0, 0, 0, 0, 1, 5000)
ENOSPC = 28


def told(
    log: Path,
    status: RecorderStatus,
    *,
    recorded: bool = True,
    expects: tuple[str, ...] | None = None,
    latched: int = 0,
    virtual: bool = True,
    arm: bool = False,
    struck: int = 0,
) -> int:
    """The exit status of a run of ten ticks that tracked to its end."""
    ring = Ring.create(slots=64)
    for record in list(noisy(10)):
        ring.put(record)
    ring.set_status(status)
    scenario = None if expects is None else SimpleNamespace(expect=SimpleNamespace(faults=expects))
    ready = SimpleNamespace(
        options=SimpleNamespace(json=False, virtual=virtual, arm=arm),
        scenario=scenario,
        struck=struck,
        link=SimpleNamespace(name="unixcan:x", tx=20, rx_dropped=0),
    )
    axis = SimpleNamespace(
        config=SimpleNamespace(name="x", loop=SimpleNamespace(rate_hz=1000.0)),
        ready=SimpleNamespace(log_file=log),
        ring=ring,
        recorded=recorded,
    )
    session = SimpleNamespace(
        ready=ready, axes=[axis, SimpleNamespace(**vars(axis))][: 1 + struck], reports=[], effects=None
    )
    tally = Tally(truth=False, timed=True)
    tally.state = int(State.FAULT if latched else State.TRACKING)
    tally.ever_latched = latched
    turn = SimpleNamespace(
        inbox=SimpleNamespace(counts=lambda: cast(Any, Counts)(*([0] * len(Counts._fields)))),
        axis=SimpleNamespace(failure=None),
    )
    lane = SimpleNamespace(tally=tally, turn=turn, operated=False)
    return tell(cast(Any, session), [cast(Any, lane)] * (1 + struck))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"something")
    return path


def test_a_log_that_is_whole_is_not_spoken_of(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(log, WHOLE) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("status", "says"),
    [
        (RecorderStatus(0, 0, 0, 0, 0, 0, 0, 0), "lacks 10 records: the recorder never began"),
        (
            RecorderStatus(0, 0, 0, 0, RECORDER_FAILED, 1, 0, 0),
            "lacks 10 records: the recorder failed",
        ),
        (WHOLE._replace(written=7, finished=0), "lacks 3 records: the recorder was lost"),
        (
            WHOLE._replace(written=7, error=RECORDER_FAILED, failing=1, finished=0),
            "lacks 3 records: the recorder failed",
        ),
        (
            WHOLE._replace(written=7, unwritten=3, error=ENOSPC, failing=1, finished=0),
            "lacks 3 records: No space left on device",
        ),
        (WHOLE._replace(finished=0), "x.mcap is not whole: the recorder was lost"),
    ],
)
def test_a_log_that_was_lost_is_named_and_is_no_success(
    log: Path, status: RecorderStatus, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told(log, status) == 1
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("status", "says"),
    [
        (WHOLE._replace(written=7, dropped=3), "lacks 3 records: the recorder could not keep up"),
        (WHOLE._replace(written=7, unwritten=3, error=ENOSPC), "lacks 3 records: No space left on device"),
    ],
)
def test_a_gap_in_a_log_that_was_finished_is_named(
    log: Path, status: RecorderStatus, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told(log, status) == 0
    assert says in capsys.readouterr().err


def test_an_empty_file_is_no_log_whatever_the_recorder_says(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log.write_bytes(b"")
    assert told(log, WHOLE) == 1
    assert "x.mcap is not whole: the file is empty" in capsys.readouterr().err


def test_a_first_part_that_retention_has_taken_is_not_missed(log: Path) -> None:
    log.unlink()
    assert told(log, WHOLE) == 0


def test_a_log_that_is_still_being_written_is_no_success(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told(log, WHOLE._replace(written=7, finished=0), recorded=False) == 1
    assert "x.mcap is not whole: it is still being written" in capsys.readouterr().err


def test_a_scenario_that_takes_the_log_away_is_judged_by_its_verdict(log: Path) -> None:
    lost = WHOLE._replace(written=7, finished=0)
    assert told(log, lost, expects=("recorder_lost",)) == 0
    assert told(log, lost, expects=("encoder_missing",)) == 1


def test_a_scenario_of_another_axis_excuses_nothing(log: Path) -> None:
    lost = WHOLE._replace(written=7, finished=0)
    assert told(log, lost, expects=("recorder_lost",), struck=1) == 1


@pytest.mark.parametrize(
    ("virtual", "arm", "status", "says"),
    [(True, False, 1, "stopped by"), (False, True, 1, "stopped by"), (False, False, 0, "there was a fault:")],
)
def test_a_fault_is_a_failure_of_a_run_that_it_ends(
    log: Path, virtual: bool, arm: bool, status: int, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told(log, WHOLE, latched=1 << F.TRAVEL, virtual=virtual, arm=arm) == status
    assert capsys.readouterr().err == f"pneud: {says} travel\n"


def test_what_reads_a_log_without_a_tick_says_so(tmp_path: Path) -> None:
    log = tmp_path / "empty.mcap"
    folder = resources.configs()
    text, dbc = (folder / "virtual.toml").read_text(), (folder / "pneud.dbc").read_bytes()
    writer = LogWriter(create_log(log), header()._replace(config_text=text, dbc=dbc))
    assert writer.close()
    for words in (
        ("export", log, "-o", tmp_path / "x.log"),
        ("export", log, "-o", tmp_path / "x.csv"),
        ("report", log, "-o", tmp_path / "x.html"),
    ):
        done = pneud_here(*words)
        assert (done.returncode, done.stdout) == (2, ""), words
        assert done.stderr == f"pneud: {log}: no tick in it\n"
    done = pneud_here("replay", log, "--against", log)
    assert (done.returncode, done.stderr) == (1, "")
    assert "no tick that both have" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["empty.mcap"], "nothing is left behind"
