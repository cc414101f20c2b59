"""What a run of a program is judged by: records in their turn, and in position by the truth."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from pneud.control.program import FAST, GOTO, Step
from pneud.replay.programming import Passing
from pneud.signals import Stage

STEPS = (Step(GOTO, 0.1, ends=FAST, tolerance_m=1e-4), Step(GOTO, 0.2, ends=FAST, tolerance_m=1e-4))


def tick(number: int, stage: Stage, step: int, truth_m: float, lap: int = 0) -> Any:
    """One of a program, with what is looked at."""
    progress = SimpleNamespace(stage=int(stage), step=step, lap=lap)
    reference = SimpleNamespace(position_m=0.0)
    inner = SimpleNamespace(t_ns=number * 1_000_000, progress=progress, reference=reference)
    return SimpleNamespace(tick=inner, truth_m=truth_m, true_error_m=0.0)


def judged(*ticks: tuple[Stage, int, float]) -> Passing:
    passing = Passing(STEPS, 0.0)
    for number, (stage, step, truth_m) in enumerate(ticks):
        passing.see(tick(number, stage, step, truth_m))
    passing.see(tick(len(ticks), Stage.ENDED, 0, math.nan, lap=1))
    return passing


def test_a_program_whose_records_come_in_their_turn_is_right() -> None:
    passing = judged(
        (Stage.UNDER_WAY, 1, 0.0), (Stage.DUE, 1, 0.1), (Stage.UNDER_WAY, 2, 0.1), (Stage.DUE, 2, 0.2)
    )
    assert passing.wrong == []
    assert [one.off_m for one in passing.passed] == [0.0, 0.0]


@pytest.mark.parametrize(
    ("before_m", "then_m", "words"),
    [
        (0.1, math.nan, None),  # as it was known to be
        (0.0999, 0.1002, "and -0.2000 mm off"),
        (0.09, math.nan, "and +10.0000 mm off"),
        (math.nan, math.nan, "and its truth is unknown"),
    ],
)
def test_who_is_in_position_is_so_by_the_truth_that_is_known(
    before_m: float, then_m: float, words: str | None
) -> None:
    passing = judged(
        (Stage.UNDER_WAY, 1, before_m), (Stage.DUE, 1, then_m), (Stage.UNDER_WAY, 2, 0.2), (Stage.DUE, 2, 0.2)
    )
    assert passing.wrong == ([] if words is None else [f"round 1, record 1: in position, {words}"])


def test_a_record_that_is_left_out_or_before_it_is_done_is_wrong() -> None:
    assert judged((Stage.UNDER_WAY, 1, 0.1), (Stage.DUE, 1, 0.1)).wrong == [
        "round 1, record 1: the end came behind it"
    ]
    assert judged((Stage.UNDER_WAY, 1, 0.0), (Stage.UNDER_WAY, 2, 0.2), (Stage.DUE, 2, 0.2)).wrong == [
        "round 1, record 1: left before it was done"
    ]
