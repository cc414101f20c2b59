"""How far long work is: a bar on a terminal, a line a second for programs, or nothing."""

from __future__ import annotations

import json
import os
import pty
import select
import time
from pathlib import Path

import pytest

from commands import object_of, pneud_here
from pneud.log.files.reader import read_log
from pneud.view import progress as module
from pneud.view.progress import Seen, each, in_words, progress, silent

GOLDEN = Path(__file__).with_name("golden") / "composite.mcap"


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """All that is told is drawn."""
    for name in ("SHORT_S", "REDRAW_S", "LINE_S"):
        monkeypatch.setattr(module, name, 0.0)


def terminal(monkeypatch: pytest.MonkeyPatch) -> tuple[int, int]:
    """A terminal as standard error: our end, and a copy of what was there."""
    ours, theirs = pty.openpty()
    before = os.dup(2)
    os.dup2(theirs, 2)
    os.close(theirs)
    monkeypatch.setattr("sys.stderr", os.fdopen(os.dup(2), "w", encoding="utf-8"))
    return ours, before


def test_on_a_terminal_a_bar_is_drawn_and_wiped(hasty: None, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, before = terminal(monkeypatch)
    try:
        with progress("auto") as report:
            for n in range(4):
                report("counting", n, 4, "turns")
            report("looking", 1, 0, "MB")
    finally:
        os.dup2(before, 2)
    drawn = ""
    while select.select([ours], [], [], 0.1)[0]:
        drawn += os.read(ours, 65536).decode()
    assert "counting" in drawn
    assert "3/4 turns" in drawn
    assert "looking" in drawn
    assert drawn.rstrip().endswith("\x1b[2K")


def test_off_a_terminal_there_is_nothing(hasty: None, capfd: pytest.CaptureFixture[str]) -> None:
    for how in ("auto", "off"):
        with progress(how) as report:
            assert report is silent
            report("counting", 1, 2, "turns")
    assert capfd.readouterr().err == ""


def test_for_programs_a_line_says_how_much_and_how_long(
    hasty: None, capsys: pytest.CaptureFixture[str]
) -> None:
    with progress("json") as report:
        assert list(each("abcd", report, "letters", 4, "letters")) == list("abcd")
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [line["progress"] for line in lines] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert lines[-1]["left_s"] == 0.0
    assert {line["what"] for line in lines} == {"letters"}


def test_a_line_comes_once_a_second(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    with progress("json") as report:
        for n in range(31):
            now_s = 100.0 + 0.1 * n
            report("reading", n, 60, "MB")
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [line["done"] for line in lines] == [10, 20, 30]
    assert [line["left_s"] for line in lines] == pytest.approx([5.0, 4.0, 3.0])


def test_what_nobody_knows_is_not_said() -> None:
    assert Seen("x", 1.0, None, "MB", 1.0).left_s is None
    assert in_words(Seen("x", 12.0, 45.0, "MB", 3.0)) == "12/45 MB, 3 MB/s, 11 s left"
    assert in_words(Seen("x", 12.0, None, "MB", 3.0)) == "12 MB, 3 MB/s"


def test_a_log_tells_how_far_it_is_read() -> None:
    log = read_log(GOLDEN)
    seen: list[tuple[int, int]] = []
    log.watch = lambda read, size: seen.append((read, size))
    assert sum(1 for _ in log) > 0
    assert {size for _, size in seen} == {GOLDEN.stat().st_size}
    shares = [read / size for read, size in seen]
    assert shares == sorted(shares)
    assert shares[-1] > 0.9


@pytest.mark.parametrize(
    "words", [("replay", GOLDEN), ("export", GOLDEN, "-o", "x.csv"), ("sim", "--duration", "0.2")]
)
def test_verbs_that_take_long_tell_it(
    words: tuple[object, ...], hasty: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = pneud_here(*words, "--progress", "json")
    assert done.returncode == 0, done
    assert json.loads(done.stderr.splitlines()[-1])["progress"] > 0.3
    assert pneud_here(*words, "--progress", "off").stderr == ""


def test_progress_stays_out_of_the_result(hasty: None) -> None:
    assert object_of(pneud_here("replay", GOLDEN, "--json", "--progress", "json"))["identical"]


def test_what_makes_a_log_tells_it_too(hasty: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    told = ("--progress", "json")
    assert pneud_here("export", GOLDEN, "-o", "x.log").returncode == 0
    for words, unit in ((("recover", GOLDEN), "MB"), (("import", "x.log"), "frames")):
        done = pneud_here(*words, *told)
        assert done.returncode == 0, done
        lines = [json.loads(line) for line in done.stderr.splitlines() if line.startswith("{")]
        assert lines[-1]["unit"] == unit
        assert lines[-1]["done"] > lines[0]["done"]
