"""What the translator makes of Python: C that does the same, or nothing at all."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from asserting import Pair, asserted, in_one_branch_alone
from pure2c import TranslationError, compile_functions
from pure2c.to_c import Translator
from pure2c.types import Many, Maybe

TABLE: tuple[float, ...] = (1.5, 2.5)


class Odd(NamedTuple):
    a: int | str | None
    b: float


class Chain(NamedTuple):
    T: float
    links: tuple[Pair, ...]
    last: Pair | None = None


class Named(NamedTuple):
    values: tuple[float, ...]
    n: int


LARGEST = Pair(3.0, 7.0)
START = Chain(0.0, (Pair(1.0, 2.0), Pair(3.0, 4.0)))
LOOSE = Chain(1.0, ())
LONG = Chain(0.0, tuple(Pair(float(i), 0.1 * i) for i in range(1000)))
WRONG = Chain(0.0, (Pair(1.0, 2.0), Pair(3, 4.0), (5.0, 6.0), None))  # type: ignore[arg-type]


# what has to come out the same


def of_none(p: Pair | None) -> float:
    return p.b  # type: ignore[union-attr]


def perhaps(x: float) -> Pair | None:
    return Pair(x, -x) if x > 0.0 else None


def alternatives(a: float, b: float) -> float:
    return a or b


def both(a: int, b: int) -> int:
    return a and b


def shifted(n: int) -> int:
    return 1 << n


def negated(n: int) -> int:
    return -n


def first_and_last(c: Chain) -> float:
    return c.links[0].a + c.links[-1].b


def summed(c: Chain) -> float:
    total = 0.0
    for link in c.links[:-1]:
        total += link.a
    for link in c.links[:]:
        total += link.b
    return total


def walked(c: Chain) -> float:
    i, total = 0, 0.0
    while i < len(c.links) - 1 and c.links[i].a < 100.0:
        total += c.links[i].b
        i += 1
    return total


def linked(c: Chain, other: Chain) -> Chain:
    return c._replace(links=other.links if len(other.links) > len(c.links) else START.links)


def without_links() -> Chain:
    return LOOSE


def changed(c: Chain, n: int) -> Chain:
    return c._replace(T=2.0, last=c.links[n])


def started() -> Chain:
    return START


def numbered(n: int) -> tuple[int, bool]:
    return n, n > 0


def numbered_first(n: int) -> tuple[bool, int]:
    return n > 0, n


def part(t: float) -> float:
    if t > 0.5:
        return sum([t])
    return 0.1


def steps(end: float) -> float:
    t = 0.0
    while t < end:
        t += part(t)
    return t


def in_a_rare_branch(n: int) -> int:
    if n > 5:
        return len(str(n))
    return n + 1


def annotated(n: int) -> float:
    x: float = 0
    y = 0.0
    for _ in range(n):
        y = x * 2
        x = x + 0.5
    return y


def retyped(n: int) -> float:
    x = 0
    y = 0.0
    for _ in range(n):
        y = x * 2.0
        x = x + 0.5  # type: ignore[assignment]
    return y


def fields(p: Pair) -> float:
    return p.a + p.b


def swapped(a: float, b: float) -> Pair:
    a, b = b, a
    return Pair(a, b)


def named_as_in_c(double: float, sin: float) -> float:
    void, failed_, int = double + 1.0, sin + 2.0, math.sin(sin)
    min_ = min(double, void, failed_)
    return min_ + int


def of_the_same_name(offset: int) -> Callable[[float], float]:
    if offset == 1:

        def same(x: float) -> float:
            return x + 1.0

    else:

        def same(x: float) -> float:
            return x + 2.0

    return same


ONE, TWO = of_the_same_name(1), of_the_same_name(2)


def both_of_one_name(x: float) -> float:
    return ONE(x) * TWO(x)


NUMBERS = ((0,), (1,), (5,), (7,), (-1,), (62,), (63,), (64,), (-(1 << 63),))


WIDE = 1 << 70 | 5
WIDE_MASKS = {1: WIDE, 5: 4, 7: ~(1 << 90)}


def masked(n: int) -> int:
    return n & WIDE | (n & ~WIDE) * 2


def with_a_bit_beyond(n: int) -> int:
    if n > 60:
        n |= WIDE
    return n


ROWS = ((1, 2.5), (4, -1.0), (1 << 62, 0.0))
TOO_WIDE = ((1, 2), (4, WIDE))


def by_rows_of_the_module(n: int) -> float:
    total = 0.0
    for bit, weight in ROWS:
        if n & bit:
            total += weight
    return total


def rows_that_c_has_not_in_a_rare_branch(n: int) -> int:
    bits = 0
    if n > 60:
        for bit, more in TOO_WIDE:
            bits |= bit & more
    return bits + n


def masked_by_a_table(n: int) -> bool:
    return n in WIDE_MASKS and not n & WIDE_MASKS[n]


def perhaps_shifted_far(n: int) -> int:
    return (n > 60) << 70


def turned(p: Pair, n: int) -> Pair:
    """Changes its own record, never the caller's."""
    while n > 0:
        p, n = Pair(p.b, p.a + n), n - 1
    return p


def looked_at(p: Pair, q: Pair, c: Chain) -> float:
    return p.a - 2.0 * q.a + 3.0 * c.T


def by_reference(p: Pair, c: Chain) -> tuple[Pair, Pair, float]:
    q = turned(p, 3)
    q = turned(q, 1)
    p, q = turned(q, 2), turned(p, 0)
    c = c._replace(T=looked_at(q, turned(p, 1), c))
    return p, q, looked_at(c.links[0], Pair(c.T, 1.0), c)


# records that are the same for a while: whatever is done to one must not show in the other


def kept_from_before(p: Pair) -> tuple[Pair, Pair]:
    before, p = p, p._replace(a=p.a + 1.0)
    if p.a > 2.0:
        p = p._replace(b=before.a)
    return before, p


def exchanged(p: Pair, q: Pair) -> tuple[Pair, Pair]:
    p, q = q, p
    p = p._replace(a=10.0 * q.a)
    return p, q


def exchanged_in_turn(p: Pair, q: Pair, n: int) -> tuple[Pair, Pair]:
    for _ in range(n):
        p, q = q._replace(b=p.a), p
    return p, q


def the_last_but_one(p: Pair, n: int) -> Pair:
    before = p
    for _ in range(n):
        before = p
        p = Pair(p.b, p.a + p.b)
    return before


def greater(p: Pair, q: Pair) -> Pair:
    if p.a > q.a:
        return p
    return q


def greater_in_a_loop(p: Pair, n: int) -> tuple[Pair, Pair]:
    best = p
    for _ in range(n):
        p = Pair(p.b, p.a * 0.5 + 1.0)
        best = greater(best, p)
    q = greater(p, best)
    p = Pair(7.0, 7.0)
    return q, best


def lent(p: Pair, c: Chain) -> tuple[float, Pair]:
    q = greater(greater(p, Pair(1.5, 9.0)), greater(LARGEST if c.T > 0.0 else p, Pair(c.T, 8.0)))
    return q.a, q


def replaced_and_given(p: Pair) -> tuple[float, Pair]:
    q = p._replace(a=p.b)
    return q.a, q


def of_its_own(p: Pair) -> tuple[Pair, Pair]:
    q = greater(p, Pair(0.0, 5.0))
    r = Pair(q.a + 1.0, q.b)
    q = Pair(r.b, q.a)
    return q, r


def given_early(p: Pair, n: int) -> tuple[Pair, Pair]:
    q = Pair(p.b, p.a)
    if n > 0:
        return Pair(q.b + 1.0, q.a), q
    q = Pair(q.b, q.b)
    return q, q


def perhaps_changed(c: Chain, t: float) -> Chain:
    last = c.last
    if t > 0.0:
        last = Pair(t, t)
    elif t < 0.0:
        last = None
    c = c._replace(T=t)
    return Chain(c.T, c.links, last if last is not None else greater(Pair(t, 1.0), Pair(0.0, 2.0)))


SAME: dict[Callable[..., Any], tuple[tuple[Any, ...], ...]] = {
    asserted: ((Pair(1.0, 2.0),), (None,)),
    of_none: ((Pair(1.0, 2.0),), (None,)),
    perhaps: ((1.0,), (-1.0,)),
    alternatives: ((0.0, 2.5), (3.0, 1.0), (math.nan, 1.0)),
    both: ((0, 2), (3, 4)),
    shifted: NUMBERS,
    negated: NUMBERS,
    masked: NUMBERS,
    with_a_bit_beyond: NUMBERS,
    by_rows_of_the_module: (*NUMBERS, (5,), (1 << 62,)),
    rows_that_c_has_not_in_a_rare_branch: (*NUMBERS, (61,)),
    masked_by_a_table: NUMBERS,
    perhaps_shifted_far: NUMBERS,
    first_and_last: ((START,), (LOOSE,), (LONG,), (WRONG,)),
    summed: ((START,), (LOOSE,), (LONG,), (WRONG,), (Chain(0.0, [Pair(1.0, 2.0)]),)),  # type: ignore[arg-type]
    walked: ((START,), (LOOSE,), (LONG,), (WRONG,)),
    linked: ((START, START), (LOOSE, START), (LONG, START), (START, LONG), (LOOSE, LOOSE), (LOOSE, WRONG)),
    without_links: ((),),
    changed: ((START, 0), (START, 1), (START, 2), (START, -1), (LONG, 999), (LONG, 1000), (WRONG, 1)),
    started: ((),),
    numbered: NUMBERS,
    numbered_first: NUMBERS,
    steps: ((0.3,), (1.0,)),
    in_a_rare_branch: NUMBERS,
    annotated: ((0,), (2,), (3,)),
    retyped: ((0,), (2,), (3,)),
    fields: ((Pair(1.0, 2.0),), ((1.0, 2.0),), (None,)),
    swapped: ((1.0, 2.0),),
    named_as_in_c: ((1.0, 2.0), (-3.0, 0.5)),
    both_of_one_name: ((1.0,), (2.5,)),
    by_reference: ((Pair(1.0, 2.0), START), (Pair(-0.0, 0.5), START._replace(T=0.25))),
    kept_from_before: ((Pair(1.0, 2.0),), (Pair(3.0, 4.0),)),
    exchanged: ((Pair(1.0, 2.0), Pair(3.0, 4.0)),),
    exchanged_in_turn: tuple((Pair(1.0, 2.0), Pair(3.0, 4.0), n) for n in range(4)),
    the_last_but_one: tuple((Pair(1.0, 2.0), n) for n in range(4)),
    greater_in_a_loop: tuple((Pair(1.0, 2.0), n) for n in range(4)),
    lent: ((Pair(1.0, 2.0), START), (Pair(2.0, 3.0), LOOSE), (Pair(5.0, 6.0), START)),
    replaced_and_given: ((Pair(1.0, 2.0),),),
    of_its_own: ((Pair(1.0, 2.0),), (Pair(-1.0, 2.0),)),
    given_early: ((Pair(1.0, 2.0), 0), (Pair(1.0, 2.0), 1)),
    in_one_branch_alone: ((Pair(1.0, 2.0), 0), (Pair(1.0, 2.0), 1), (Pair(1.0, 2.0), -1)),
    perhaps_changed: tuple(
        (c, t) for c in (START, LONG._replace(last=Pair(1.0, 2.0))) for t in (-1.0, 0.0, 1.0)
    ),
}


# what C would do in another way, so that it has to be refused


def twice(n: int) -> int:
    i = n
    i = j = i + 1
    return 10 * i + j


def shrinking(n: int) -> int:
    k = 0
    for _ in range(n):
        n = n - 1
        k = k + 1
    return k


def keyed(a: float, b: float) -> float:
    return max(a, b, key=abs)


def rounded(a: float) -> float:
    return round(a, ndigits=2)


def identical(a: Named, b: Named) -> bool:
    return a.values == b.values


def large(n: int) -> bool:
    return n < 1 << 70


def squared(n: int) -> int:
    return n**2


def compared_with_none(n: int) -> bool:
    return n == None  # noqa: E711


def chained(a: Pair | None, n: int) -> bool:
    return a is None == n


def nothing_in_an_objects_place(x: float) -> Odd:
    return Odd(None, x)


def from_a_mapping(a: float, d: Pair) -> Pair:
    return Pair(a, **{"b": d.b})


def unpacked(c: Chain) -> float:
    first, second = c.links
    return first.a + second.a


def beyond_the_table(n: float) -> float:
    return n + TABLE[5]


def shadowed(n: int) -> int:
    for TABLE in [n]:
        n += TABLE
    return TABLE


REFUSED = (
    *(twice, shrinking, keyed, rounded, identical, large, squared, compared_with_none, chained),
    *(nothing_in_an_objects_place, from_a_mapping, unpacked, beyond_the_table, shadowed),
)


def outcome(function: Callable[..., Any], arguments: tuple[Any, ...]) -> str:
    try:
        return repr(function(*arguments))
    except Exception as e:
        return repr(e)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[Callable[..., Any], Callable[..., Any]]:
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    built = compile_functions(tuple(SAME), cache=tmp_path_factory.mktemp("made") / "cache")
    return dict(zip(SAME, built.functions, strict=True))


@pytest.mark.parametrize("function", SAME, ids=lambda f: f.__name__)
def test_c_does_what_python_does(
    function: Callable[..., Any], made: dict[Callable[..., Any], Callable[..., Any]]
) -> None:
    for arguments in SAME[function]:
        for _ in range(2):  # the second time with what is remembered
            assert outcome(made[function], arguments) == outcome(function, arguments), arguments


@pytest.mark.parametrize("function", REFUSED, ids=lambda f: f.__name__)
def test_what_c_would_do_in_another_way_is_refused(function: Callable[..., Any]) -> None:
    with pytest.raises(TranslationError):
        Translator().function(function)


def test_types_that_hold_the_same_are_not_the_same() -> None:
    assert len({Maybe(Pair), Many(Pair), (Pair,)}) == 3


def test_helpers_come_with_the_package() -> None:
    assert "_Static_assert" in Translator().text()
