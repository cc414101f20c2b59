"""Waiting for a set: asleep until shortly before it comes, a short look, and none where it is in vain."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from pneud.loop.answers import LOOK_NS, MARGIN_NS, REST_TICKS, STEP_NS, VAIN, Answers

DEADLINE_NS = 800_000


def test_nothing_is_waited_for_asleep_until_a_set_has_come() -> None:
    answers = Answers(DEADLINE_NS)
    for _ in range(2):
        assert answers.doze_ns(0) <= 0
        assert answers.look_ns() == 0
        answers.came(500_000, in_vain=True)
        assert answers.doze_ns(0) == 500_000 - MARGIN_NS
        assert answers.look_ns() == LOOK_NS
        answers.missing()


@given(st.lists(st.integers(100_000, DEADLINE_NS), min_size=1, max_size=300))
def test_the_sleep_ends_before_a_set_that_comes_no_sooner_than_the_last(arrivals: list[int]) -> None:
    answers = Answers(DEADLINE_NS)
    last = 0
    for arrived in arrivals:
        answers.look_ns()
        wake = 30_000 + answers.doze_ns(30_000)
        if arrived >= last:
            assert wake <= arrived - MARGIN_NS + STEP_NS
        assert wake <= DEADLINE_NS
        answers.came(arrived, in_vain=False)
        last = arrived


@given(st.lists(st.integers(-(10**15), 10**15), max_size=50))
def test_whatever_the_stamps_say_the_sleep_ends_before_the_deadline(arrivals: list[int]) -> None:
    answers = Answers(DEADLINE_NS)
    for arrived in arrivals:
        answers.look_ns()
        answers.came(arrived, in_vain=False)
        assert answers.doze_ns(0) <= DEADLINE_NS - MARGIN_NS


def test_sets_that_always_come_at_the_same_time_find_a_short_look() -> None:
    answers = Answers(DEADLINE_NS)
    for _ in range(1000):
        answers.came(500_000, in_vain=False)
        assert answers.look_ns() == LOOK_NS > MARGIN_NS
    assert answers.doze_ns(20_000) == 500_000 - MARGIN_NS - 20_000


def test_looks_in_vain_are_left_off_for_a_while() -> None:
    """As where one processor serves the loop and those that answer: they answer when the look is over."""
    answers = Answers(DEADLINE_NS)
    answers.came(500_000, in_vain=False)
    looks = []
    for _ in range(3 * (VAIN + REST_TICKS)):
        look_ns = answers.look_ns()
        looks.append(look_ns)
        answers.came(500_000 + look_ns, in_vain=True)
    assert looks == ([LOOK_NS] * VAIN + [0] * REST_TICKS) * 3
    assert answers.arrives_ns <= 500_000 + LOOK_NS


def test_looks_that_cost_the_set_are_left_off_too() -> None:
    """Every tick that looks has no set, every other one has."""
    answers = Answers(DEADLINE_NS)
    looks = 0
    for _ in range(2 * VAIN + REST_TICKS):
        if answers.look_ns():
            looks += 1
            answers.missing()
        else:
            answers.came(140_000, in_vain=True)
    assert looks == VAIN


@given(st.lists(st.booleans(), max_size=100))
def test_only_looks_in_vain_one_after_the_other_count(vain: list[bool]) -> None:
    answers = Answers(DEADLINE_NS)
    answers.came(500_000, in_vain=False)
    row = 0
    for one in vain:
        assert (answers.look_ns() == 0) == (row == VAIN)
        if row == VAIN:
            return
        row = row + 1 if one else 0
        answers.came(500_000, in_vain=one)
