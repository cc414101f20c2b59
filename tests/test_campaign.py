"""The campaign's script: what it plays where, its slow scenarios, its page."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from pneud import resources
from pneud.scenario.files import load_axis, load_scenario

HIL = Path(__file__).parent.parent / "hil"


@pytest.fixture(scope="module")
def campaign() -> ModuleType:
    spec = importlib.util.spec_from_file_location("campaign", HIL / "campaign.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["campaign"] = module
    spec.loader.exec_module(module)
    return module


def test_the_core_can_be_played(campaign: ModuleType) -> None:
    there = {path.stem for path in resources.scenarios().glob("*.toml")}
    assert set(campaign.CORE) | set(campaign.CORE_VM) <= there
    assert not [name for name in campaign.CORE if campaign.playable(name, "unixcan")]
    assert not [name for name in campaign.CORE_VM if campaign.playable(name, "vcan0")]
    assert there >= campaign.TAKES_FAST_TICKS | campaign.VALVE_DEAF


def test_what_changes_the_machine_stays_in_the_virtual_one(campaign: ModuleType) -> None:
    for name in ("link-down", "link-deleted", "queue-full-for-long", "clock-step"):
        assert campaign.playable(name, "unixcan")
        assert not campaign.playable(name, "vcan0")
    assert campaign.playable("recorder-killed", "sim")
    assert not campaign.playable("recorder-killed", "unixcan")


def test_slowed_scenarios_are_scenarios_of_the_slow_axis(campaign: ModuleType, tmp_path: Path) -> None:
    names = [path.stem for path in resources.scenarios().glob("*.toml")]
    for name in names:
        load_axis(campaign.SLOW, None, load_scenario(campaign.slowed(name, tmp_path)))
    for name in campaign.CORE_VM:
        scenario = load_scenario(campaign.slowed(name, tmp_path))
        axis = load_axis(campaign.SLOW, None, scenario).config
        peak_m_s = 6.2832 * axis.reference.frequency_hz * axis.reference.amplitude_m
        when = scenario.fault[0].when
        assert when.velocity_above_m_s is not None and when.velocity_below_m_s is not None
        assert when.velocity_above_m_s < peak_m_s < when.velocity_below_m_s


def test_the_page_shows_every_case_and_stands_alone(campaign: ModuleType) -> None:
    case: dict[str, Any] = {
        "name": "a<b", "description": "x", "reaction": "centre", "faults": ["encoder_missing"], "met": False,
        "problems": ["too late"], "centred_ms": 1.25, "ticks": 3, "travel_mm": 4.0, "peak_bar": 5.0,
    }  # fmt: skip
    page = campaign.page(
        "unixcan", [case, case | {"name": "good", "met": True, "problems": []}], {"c": "why"}, 9
    )
    assert "a&lt;b" in page
    assert "too late" in page
    assert "1 of 2 came as expected" in page
    assert "<li>c: why</li>" in page
    assert "http" not in page.replace("http-equiv", "")


def test_every_case_that_is_played_is_in_the_matrix(
    campaign: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def play(name: str, *_: object) -> dict[str, object]:
        return {"name": name, "met": name != "emcy", "problems": [], "expected": [], "faults": []}

    monkeypatch.setattr(campaign, "play", play)
    monkeypatch.setattr(campaign, "page", lambda *_: "")
    monkeypatch.setattr(campaign, "say", lambda _: None)
    words = ["campaign", "--bus", "unixcan", "--only", "babble,emcy", "-o", str(tmp_path)]
    monkeypatch.setattr("sys.argv", words)
    assert campaign.main() == 1
    cases = json.loads((tmp_path / "matrix.json").read_text())["cases"]
    assert [(case["name"], case["met"], "again" in case) for case in cases] == [
        ("babble", True, False),
        ("emcy", False, True),
    ]
