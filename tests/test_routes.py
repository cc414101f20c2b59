"""Which axis hears a frame."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from pneud.loop.routes import Routes
from pneud.signals import Frame


class Heard:
    """An exchange that keeps what it is given."""

    def __init__(self) -> None:
        self.came: list[Frame] = []

    def open(self, frames: Sequence[Frame]) -> None:
        self.came += frames

    feed = open


FRAMES = [Frame(n, can_id, b"") for n, can_id in enumerate((0x181, 0x191, 0x7FF, 0x181, 0x80))]


@pytest.mark.parametrize("way", ["open", "feed"])
def test_each_hears_what_is_its_own_and_all_hear_what_is_nobodys(way: str) -> None:
    one, other = Heard(), Heard()
    hearers: list[Any] = [
        SimpleNamespace(turn=one, identifiers=(0x181, 0x80)),
        SimpleNamespace(turn=other, identifiers=(0x191, 0x80)),
    ]
    came = list(FRAMES)
    getattr(Routes(hearers), way)(came)
    assert not came
    assert [frame.can_id for frame in one.came] == [0x181, 0x7FF, 0x181, 0x80]
    assert [frame.can_id for frame in other.came] == [0x191, 0x7FF, 0x80]


@pytest.mark.parametrize("way", ["open", "feed"])
def test_an_axis_alone_hears_everything(way: str) -> None:
    alone, came = Heard(), list(FRAMES)
    hearers: list[Any] = [SimpleNamespace(turn=alone, identifiers=(0x181,))]
    getattr(Routes(hearers), way)(came)
    assert not came
    assert alone.came == FRAMES
