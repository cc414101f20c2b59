"""The screen of several axes: a strip for each, keys for the one that is drawn large."""

from __future__ import annotations

from typing import Any

import pytest

from pneud.safety.faults import F
from pneud.signals import State
from pneud.view.several import NEXT, Several
from pneud.view.show import Show
from test_screen_snapshots import FULL, ended, show, text_of, tracking

SIZE = (100, 32)


def screen(chosen: int = 0) -> Several:
    lost = ended(State.FAULT, latched=1 << F.VALVE_MISSING)
    shows = [show(tracking(50), FULL._replace(name="x")), show(lost, FULL._replace(name="y"))]
    return Several(shows, chosen)


def lines(several: Several, size: tuple[int, int] = SIZE) -> list[str]:
    found: Any = several
    return text_of(found, size).split("\n")


def test_each_axis_has_a_strip_and_one_is_drawn_large() -> None:
    several = screen()
    x, y, head, *rest = lines(several)
    assert x.startswith("▌1  x")
    assert "tracking" in x
    assert "mm" in x
    assert y.startswith(" 2  y")
    assert "fault" in y
    assert "valve_missing" in y
    assert head.startswith("pneud · x")
    assert len(rest) == SIZE[1] - 3
    assert all(len(line) == SIZE[0] for line in (x, y, head, *rest))


@pytest.mark.parametrize(
    ("keys", "chosen"), [("2", 1), ("9", 0), ("0", 0), ([NEXT], 1), ([NEXT, NEXT], 0), ("21", 0)]
)
def test_keys_choose_the_axis(keys: list[str], chosen: int) -> None:
    several = screen()
    for key in keys:
        several.hands.press(key)
    assert several.hands.chosen == chosen
    assert several.snapshot.info.name == "xy"[chosen]
    assert lines(several)[2].startswith(f"pneud · {'xy'[chosen]}")
    assert several.history is several._shows[chosen].history


def test_figures_of_a_position_choose_nothing() -> None:
    several = screen(1)
    for key in "g2" + "1":
        several.hands.press(key)
    several.hands.press(NEXT)
    assert several.hands.chosen == 1
    assert several._shows[1].hands.prompt.startswith("Go to: 21")
    assert several._shows[0].hands.prompt == ""


def test_it_is_over_when_it_is_for_one_and_has_whatever_size_is_asked_for() -> None:
    several = screen()
    assert several.attend()
    assert [several.hands.over] == [False]
    for size in ((1, 1), (20, 2), (80, 24)):
        rows = lines(several, size)
        assert len(rows) == size[1]
        assert all(len(row) == size[0] for row in rows)
    several.hands.press("q")
    assert several.hands.over
    assert not several.attend()


def test_an_axis_that_has_not_begun_says_so() -> None:
    several = Several([Show(list, FULL, lambda: False), show(tracking(5))])
    assert "waiting for its first tick" in lines(several)[0]
