"""Waiting for a set: asleep until shortly before it comes, a short look, and none where it is in vain."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from pneud.rt.answers import LOOK_NS, MARGIN_NS, REST_TICKS, STEP_NS, VAIN, Answers


def test_nothing_is_waited_for_asleep_until_a_set_has_come() -> None:
    answers = Answers()
    for _ in range(2):
        assert answers.doze_ns(0) <= 0
        assert answers.look_ns() == 0
        answers.came(500_000, in_vain=False)
        assert answers.doze_ns(0) == 500_000 - MARGIN_NS
        assert answers.look_ns() == LOOK_NS
        answers.missing()


@given(st.lists(st.integers(100_000, 900_000), min_size=1, max_size=300))
def test_the_sleep_ends_before_every_set_but_one_that_comes_much_sooner_than_the_last(
    arrivals: list[int],
) -> None:
    answers = Answers()
    known = 0
    for arrived in arrivals:
        assert answers.doze_ns(30_000) == known - MARGIN_NS - 30_000
        answers.came(arrived, in_vain=False)
        assert answers.arrives_ns <= arrived
        assert answers.arrives_ns == (min(arrived, known + STEP_NS) if known else arrived)
        known = answers.arrives_ns


def test_sets_that_always_come_at_the_same_time_find_a_short_look() -> None:
    answers = Answers()
    for _ in range(1000):
        answers.came(500_000, in_vain=False)
        assert answers.look_ns() == LOOK_NS > MARGIN_NS
    assert answers.doze_ns(20_000) == 500_000 - MARGIN_NS - 20_000


def test_looks_in_vain_are_left_off_for_a_while() -> None:
    """As where one processor serves the loop and those that answer: they answer when the look is over."""
    answers = Answers()
    answers.came(500_000, in_vain=False)
    looks = []
    for _ in range(3 * (VAIN + REST_TICKS)):
        look_ns = answers.look_ns()
        looks.append(look_ns)
        answers.came(500_000 + look_ns, in_vain=look_ns > 0)
    assert looks == ([LOOK_NS] * VAIN + [0] * REST_TICKS) * 3
    assert answers.arrives_ns <= 500_000 + LOOK_NS


@given(st.lists(st.booleans(), max_size=100))
def test_only_looks_in_vain_one_after_the_other_count(vain: list[bool]) -> None:
    answers = Answers()
    answers.came(500_000, in_vain=False)
    row = 0
    for one in vain:
        if answers.look_ns() == 0:
            assert row == VAIN
            return
        row = row + 1 if one else 0
        answers.came(500_000, in_vain=one)
