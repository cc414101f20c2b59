"""A state that stays in C: the same results, and nothing that it holds is lost or kept."""

from __future__ import annotations

import gc
import math
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from pure2c import BuildError, Built, compile_functions


class Link(NamedTuple):
    length: float


class Inner(NamedTuple):
    links: tuple[Link, ...]
    sum: float


class Memory(NamedTuple):
    total: float
    steps: int
    even: bool
    inner: Inner
    perhaps: Inner | None
    name: str
    numbers: tuple[float, float, float, float]


def step(m: Memory, x: float, links: tuple[Link, ...]) -> tuple[Memory, float]:
    inner = m.inner
    if len(links) > 0:
        inner = Inner(links, m.total + links[0].length)
    total = m.total + math.sqrt(x)
    a, b, c, _ = m.numbers
    perhaps = m.perhaps
    if x > 2.0:
        perhaps = inner
    if x > 3.0:
        perhaps = None
    steps = m.steps + 1
    return Memory(total, steps, not m.even, inner, perhaps, m.name, (x, a, b, c)), total


BEGIN = Memory(0.0, 0, True, Inner((), 0.0), None, "name of its own", (0.0, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    try:
        return compile_functions([step], cache=tmp_path_factory.mktemp("holding"), holding=True)
    except BuildError as e:
        pytest.skip(str(e))


@pytest.fixture
def held(built: Built) -> tuple[Callable[..., Any], Callable[[], tuple[int, ...]]]:
    return built.functions[0], built.left


def test_it_computes_the_same(held: Any) -> None:
    f, left = held
    state, kept = BEGIN, BEGIN
    for i in range(20):
        links = tuple(Link(0.1 * k) for k in range(i % 4))
        state, one = step(state, 0.25 * i, links)
        kept, other = f(kept, 0.25 * i, links)
        assert other == one
        assert (kept.total, kept.even, kept.inner, kept.perhaps) == (
            state.total,
            state.even,
            state.inner,
            state.perhaps,
        )
        assert kept.whole() == state
        assert kept.whole() is kept.whole()
        assert kept.name is BEGIN.name
        if i % 3 == 0:
            kept = kept.whole()
    assert left() == (0,)


def test_what_c_cannot_do_is_done_with_the_record(held: Any) -> None:
    f, left = held
    kept, _ = f(BEGIN, 1.0, ())
    before = left()[0]
    with pytest.raises(ValueError, match="math domain error"):
        f(kept, -1.0, ())
    after, total = f(kept, 4, ())
    assert (after, total) == step(kept.whole(), 4, ())
    with pytest.raises(AttributeError):
        f(1.0, 1.0, ())
    with pytest.raises(TypeError):
        f()
    assert left()[0] == before + 4


def test_a_rehearsal_leaves_nothing_behind_whatever_it_is_given(built: Built) -> None:
    (f,), (rehearse,) = built.functions, built.rehearsals
    links = (Link(1.0), Link(2.0))
    kept, _ = f(BEGIN, 2.5, links)
    state, left, count = kept.whole(), built.left(), sys.getrefcount(links)
    assert rehearse(kept, 1.0, links) is rehearse(BEGIN, 1.0, links) is True
    assert not any(rehearse(*odd) for odd in ((kept, -1.0, ()), (kept, 4, ()), (1.0, 1.0, ()), ()))
    assert sys.getrefcount(links) == count
    assert built.left() == left
    assert kept.whole() is state
    assert f(kept, 1.0, links)[1] == step(state, 1.0, links)[1]


def test_it_keeps_what_it_holds_and_no_longer(held: Any) -> None:
    f, _ = held
    links = (Link(1.0), Link(2.0))
    count = sys.getrefcount(links)
    kept, _ = f(BEGIN, 2.5, links)
    assert sys.getrefcount(links) == count + 2, "inner and perhaps"
    before, kept = kept, f(kept, 1.0, ())[0]
    assert sys.getrefcount(links) == count + 4
    assert before.inner.links is links
    del before
    assert sys.getrefcount(links) in (count + 2, count + 3), "the last record is remembered"
    for _ in range(10):
        kept, _ = f(kept, 4.0, (Link(3.0),))
    del kept
    assert sys.getrefcount(links) <= count + 1


def test_no_object_is_left_behind(held: Any) -> None:
    f, _ = held
    kept = BEGIN
    for _ in range(5_000):
        kept, _ = f(kept, 1.0, ())
    gc.collect()
    before = sys.getallocatedblocks()
    for _ in range(10_000):
        kept, _ = f(kept, 1.0, ())
    gc.collect()
    assert sys.getallocatedblocks() - before < 1000


def test_it_cannot_be_made_by_hand(held: Any) -> None:
    kept, _ = held[0](BEGIN, 1.0, ())
    with pytest.raises(TypeError):
        type(kept)()
    with pytest.raises(AttributeError):
        kept.total = 1.0
