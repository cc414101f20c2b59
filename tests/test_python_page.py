"""Every example of the page on Python runs, in its order: with a daemon where it says so."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import pneud
from commands import background, eventually
from running import serves

PAGE = Path(__file__).parent.parent / "docs" / "python.md"


def blocks(kind: str) -> list[str]:
    """The examples of a kind, `py` with a daemon, with as many lines before each as on the page."""
    text = PAGE.read_text(encoding="utf-8")
    found = re.finditer(r"^```(py|python)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return ["\n" * (text[: m.start(2)].count("\n")) + m[2] for m in found if m[1] == kind]


def play(kind: str, before: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """What the examples leave behind."""
    names: dict[str, Any] = {}
    for text in blocks(kind):
        before()
        exec(compile(text, str(PAGE), "exec"), names)
    return names


@pytest.mark.slow
def test_examples_with_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(blocks("python")) >= 6
    names = play("python")
    assert names["lost"].summary["faults"] == ["encoder_missing"]
    assert names["tracking"].true_error_m.abs().max() < 1e-3


@pytest.mark.slow
@pytest.mark.realtime
def test_examples_with_a_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "console.sock")
    monkeypatch.setenv("PNEUD_SOCKET", path)
    with background("--virtual", "--headless", "--duration", 60, "--log", tmp_path / "x.mcap"):
        eventually(lambda: serves(path))

        def still() -> None:
            with pneud.Client() as looking:
                eventually(lambda: looking.status()["state"] in ("tracking", "holding"))

        play("py", still)
    told = capsys.readouterr().out
    assert "the nearest allowed is 979 mm" in told
    assert "goto 300 mm: replaced by stop" in told


def test_every_example_is_of_a_kind_that_is_played() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert len(re.findall(r"^```py", text, re.MULTILINE)) == len(blocks("python")) + len(blocks("py"))
