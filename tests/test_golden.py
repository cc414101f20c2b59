"""The logs in tests/golden replay to the bit, and the smallest change of the law does not go unnoticed."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from pneud.axis import cycle, sensing
from pneud.config.reading import with_settings
from pneud.log.files.reader import read_log
from pneud.log.format.fingerprint import numeric_fingerprint
from pneud.replay import replaying
from pneud.safety.faults import FAULT_NAMES
from pneud.signals import State

GOLDEN = Path(__file__).parent / "golden"
LOGS = sorted(GOLDEN.glob("*.mcap"))


@pytest.fixture(scope="module")
def refresh() -> ModuleType:
    spec = importlib.util.spec_from_file_location("refresh", GOLDEN / "refresh.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", LOGS, ids=lambda p: p.stem)
def test_a_golden_log_replays(path: Path) -> None:
    log = read_log(path)
    assert log.metadata["detail"] == "full"
    outcome = replaying.replay(log)
    assert not outcome.truncated
    assert outcome.engaged_ticks > 100
    if log.metadata["fingerprint"] == numeric_fingerprint():
        assert outcome.identical, outcome.first
    else:
        assert outcome.equivalent, outcome.first


def test_they_are_all_there_and_hold_what_they_are_for(refresh: ModuleType) -> None:
    assert {p.stem for p in LOGS} == {*refresh.LOGS, refresh.VIRTUAL}
    assert sum(p.stat().st_size for p in LOGS) < 3_000_000
    for name in ("composite", "ismc", "paper-case1", "frames-lost", "virtual"):
        assert State.TRACKING in {t.state for t in read_log(GOLDEN / f"{name}.mcap")}
    for name, fault in (
        ("encoder-missing", "encoder_missing"),
        ("valve-stuck-open", "tracking_error"),
        ("supply-lost", "supply_pressure"),
    ):
        assert any(t.latched >> FAULT_NAMES.index(fault) & 1 for t in read_log(GOLDEN / f"{name}.mcap"))
    requests = {t.request.kind: t.answer for t in read_log(GOLDEN / "requests.mcap") if t.request is not None}
    assert len(requests) >= 7


def test_a_simulated_one_is_written_the_same_again(refresh: ModuleType, tmp_path: Path) -> None:
    log = read_log(GOLDEN / "paper-case1.mcap")
    if log.metadata["fingerprint"] != numeric_fingerprint():
        pytest.skip("another machine's mathematics wrote it")
    refresh.simulated("paper-case1", tmp_path / "again.mcap")
    assert [repr(t) for t in read_log(tmp_path / "again.mcap")] == [repr(t) for t in log]


@pytest.mark.parametrize("name", ["composite", "requests"])
def test_one_ulp_in_the_law_is_told_with_tick_variable_and_both_values(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = read_log(GOLDEN / f"{name}.mcap")
    interpreted = with_settings(log.config_text, log.config_name, ["loop.compiled=off"])
    if log.metadata["fingerprint"] != numeric_fingerprint():
        pytest.skip("another machine's mathematics wrote it")
    calls = 0
    act = vars(sensing)["act"]

    def nudged(*arguments: Any) -> Any:
        nonlocal calls
        calls += 1
        controller, answer = act(*arguments)
        if calls == 50:
            answer = answer._replace(u_v=math.nextafter(answer.u_v, math.inf))
        return controller, answer

    monkeypatch.setattr(sensing, "act", nudged)
    outcome = replaying.replay(log, interpreted)
    assert not outcome.good
    assert outcome.first is not None
    engaged = [t for t in log if not math.isnan(t.command.law_v)]
    tick = engaged[49]
    assert outcome.first.tick == tick.number - 1
    assert outcome.first.variable == "command.law_v"
    was, now = float(outcome.first.logged), float(outcome.first.replayed)
    assert was == tick.command.law_v
    assert now == math.nextafter(was, math.inf)
    assert str(outcome.first) == f"tick {tick.number - 1}: command.law_v logged {was!r}, replayed {now!r}"


def test_how_the_load_stands_is_replayed_from_the_start_and_from_a_snapshot(
    refresh: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    golden = refresh.LOGS["requests"]
    monkeypatch.setitem(refresh.LOGS, "requests", golden._replace(duration_s=1.0, requests={60: refresh.ARM}))
    refresh.simulated("requests", tmp_path / "holding.mcap")
    log = read_log(tmp_path / "holding.mcap")
    assert {t.state for t in log if t.in_position} == {State.HOLDING}
    assert sum(t.in_position for t in log) > 250
    for from_s in (0.0, 0.6):
        assert replaying.replay(log, from_s=from_s).identical
    interpreted = with_settings(log.config_text, log.config_name, ["loop.compiled=off"])
    judge = vars(cycle)["judge"]
    monkeypatch.setattr(cycle, "judge", lambda *seen: judge(*seen)._replace(hunting=2))
    outcome = replaying.replay(log, interpreted, from_s=0.6)
    assert not outcome.good
    assert outcome.first is not None
    assert str(outcome.first).endswith("hunting logged 0, replayed 2")
