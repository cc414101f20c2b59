"""Functions with assertions for `pure2c`: those of a module of tests are not what stands in its file."""

from __future__ import annotations

from typing import NamedTuple


class Pair(NamedTuple):
    a: float
    b: float


def asserted(p: Pair | None) -> float:
    assert p is not None
    return p.b


def in_one_branch_alone(p: Pair, n: int) -> float:
    assert n >= 0
    if n == 0:
        q = Pair(p.b, p.a)
    if n > 0:
        q = p
    return q.a
