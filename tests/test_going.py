"""Waiting for the end of a program: what it says of one that does not come there."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from pneud.console.client import RefusedError
from pneud.console.going import Sharing, go_through

ORDER = 7
THERE = {"record": 2, "of": 3, "label": "", "words": "wait", "stage": "under way"}
ENDED, STOPPED = {**THERE, "stage": "ended"}, {**THERE, "stage": "stopped"}
LATCHED = {"name": "travel", "latched": True, "cure": "drive it back"}


def status(program: dict[str, Any] | None, order: int = ORDER, **more: Any) -> dict[str, Any]:
    last = {"number": order, "words": "goto 300 mm"}
    return {"silent_s": 0.0, "program": program, "order": last, "faults": [], "state": "holding", **more}


class Console:
    """Says one status after the other."""

    def __init__(self, *said: dict[str, Any]) -> None:
        self._said: Iterator[dict[str, Any]] = iter(said)

    def ask(self, _: str) -> dict[str, Any]:
        return next(self._said)


def gone_through(*said: dict[str, Any]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    told: list[dict[str, Any]] = []
    return go_through(Console(*said), ORDER, "press", told.append, lambda _: None), told  # type: ignore[arg-type]


def test_it_tells_how_far_the_program_is_until_its_end() -> None:
    assert gone_through(status(THERE), status(THERE), status(ENDED)) == (status(ENDED), [THERE, THERE])


@pytest.mark.parametrize(
    ("said", "kind", "text"),
    [
        (
            status(THERE, faults=[LATCHED]),
            "fault",
            "press: record 2 of 3 (wait): fault travel: drive it back",
        ),
        (status(None, faults=[LATCHED]), "fault", "press: fault travel: drive it back"),
        (status(THERE, order=8), "replaced", "press: record 2 of 3 (wait): replaced by goto 300 mm"),
        ({**status(THERE), "order": None}, "replaced", "replaced by another command"),
        (status(STOPPED), "stopped", "press: record 2 of 3 (wait): stopped; the axis is holding"),
        (status(None), "stopped", "press: stopped; the axis is holding"),
        (status(THERE, silent_s=9.0), "gone", "press: the loop has been silent for 9.0 s"),
    ],
)
def test_it_says_why_a_program_does_not_come_to_its_end(said: dict[str, Any], kind: str, text: str) -> None:
    with pytest.raises(RefusedError) as caught:
        gone_through(status(THERE), said)
    assert caught.value.kind == kind
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("x", "y", "whose"),
    [
        (status(THERE), status(STOPPED), "y"),
        (status(STOPPED, faults=[LATCHED]), status(STOPPED), "x"),
        (status(STOPPED), status(THERE, faults=[LATCHED]), "y"),
        (status(THERE), status(None), "x"),
    ],
)
def test_of_axes_that_share_a_program_the_one_that_matters_is_looked_at(
    x: dict[str, Any], y: dict[str, Any], whose: str
) -> None:
    shared = Sharing(Console({"axes": {"x": x, "y": y}}), ["x", "y"])  # type: ignore[arg-type]
    assert shared.ask("status")["axis"] == whose
