"""A function done many times in C: what is given comes from a buffer, and what comes of it goes into one."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from pure2c import compile_functions
from pure2c.types import columns


class Load(NamedTuple):
    place: float
    speed: float
    ticks: int


class Push(NamedTuple):
    force: float
    times: int


class Seen(NamedTuple):
    before: Load
    root: float


def pushed(load: Load, push: Push, h: float) -> tuple[Load, Seen]:
    """One push; Python raises where the place is negative."""
    speed = load.speed + h * push.force * push.times
    return Load(load.place + h * speed, speed, load.ticks + 1), Seen(load, math.sqrt(load.place))


@pytest.fixture(scope="module")
def series(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    cache: Path = tmp_path_factory.mktemp("cache")
    cache.chmod(0o700)
    found = compile_functions([pushed], cache=cache).series[0]
    assert found is not None
    return found


GIVEN = np.zeros(9, dtype=columns(Push))
GIVEN["force"], GIVEN["times"] = np.linspace(1.0, -7.0, 9), 3


def test_it_is_what_python_does_one_after_another(series: Callable[..., Any]) -> None:
    rows = np.zeros(9, dtype=columns(Seen))
    load, done = series(GIVEN, rows, Load(10.0, 0.0, 0), 0.1)
    expected, seen = Load(10.0, 0.0, 0), []
    for force, times in GIVEN.tolist():
        expected, row = pushed(expected, Push(force, times), 0.1)
        seen.append((*row.before, row.root))
    assert (load, done) == (expected, 9)
    assert rows.tolist() == seen
    assert rows.dtype.names == ("before.place", "before.speed", "before.ticks", "root")


def test_it_ends_before_what_is_left_to_python(series: Callable[..., Any]) -> None:
    rows = np.zeros(9, dtype=columns(Seen))
    load, done = series(GIVEN, rows, Load(0.01, -1.0, 0), 0.1)
    assert 0 < done < 9
    assert load.place < 0.0  # of which there is no root
    assert load.ticks == done
    assert not rows["root"][done:].any()


def test_other_arguments_are_refused(series: Callable[..., Any]) -> None:
    rows, load = np.zeros(9, dtype=columns(Seen)), Load(1.0, 0.0, 0)
    for others in ((load,), (load, 1), (load, 0.1, 0.1), ("load", 0.1)):
        with pytest.raises(TypeError, match="not these arguments"):
            series(GIVEN, rows, *others)
    with pytest.raises(ValueError, match="too few rows"):
        series(GIVEN, rows[:8], load, 0.1)
    with pytest.raises(BufferError):
        series(GIVEN, rows.tobytes(), load, 0.1)
