"""What figures depend on, and how they are spread: by ranks, so that neither units nor curves matter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pneud.campaign.rows import Floats, Rows

SHARES = (5.0, 50.0, 95.0, 99.0)
MIDDLE = SHARES.index(50.0)
FEWEST = 8  # runs from which ranks say anything


class Spread(NamedTuple):
    """How a figure is spread."""

    known: int
    none: int  # runs without it, and those whose time never comes
    least: float
    shares: tuple[float, ...]  # percentiles, of `SHARES`
    most: float


class Rank(NamedTuple):
    """How a figure goes with something that runs were given."""

    figure: str
    given: str
    correlation: float  # of ranks: 1 where both rise together, −1 where one falls as the other rises
    runs: int


def spread(values: Floats) -> Spread | None:
    """How a column is spread, infinite ones at its end; None where it has no number."""
    found = values[~np.isnan(values)]
    if not len(found):
        return None
    shares = tuple(float(x) for x in np.percentile(found, SHARES, method="inverted_cdf"))
    known = int(np.isfinite(values).sum())
    return Spread(known, len(values) - known, float(found.min()), shares, float(found.max()))


def ranks(values: Floats) -> Floats:
    """The place of each number among all, from 0; equal ones share the mean of theirs."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    means: Floats = (ends - 0.5 * (counts + 1.0))[place.ravel()]
    return means


def correlation(one: Floats, other: Floats) -> float:
    """Spearman's: that of the ranks, where both have numbers; NaN where one of them is always the same."""
    both = ~np.isnan(one) & ~np.isnan(other)
    if both.sum() < FEWEST:
        return float("nan")
    return _alike(*(ranks(values[both]) for values in (one, other)))


def _alike(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0.0 else float("nan")


def strongest(rows: Rows, figures: Sequence[str], given: Sequence[str]) -> list[Rank]:
    """Every figure with everything that is given, the strongest first; what is no number is left out."""
    columns = {name: rows.ordered(name) for name in (*figures, *given)}
    # to rank a column takes far longer than to compare two
    whole = {
        name: ranks(values)
        for name, values in columns.items()
        if len(rows) >= FEWEST and not np.isnan(values).any()
    }
    found = []
    for figure in figures:
        for name in given:
            if figure in whole and name in whole:
                value = _alike(whole[figure], whole[name])
            else:
                value = correlation(columns[figure], columns[name])
            if not np.isnan(value):
                runs = int((~np.isnan(columns[figure]) & ~np.isnan(columns[name])).sum())
                found.append(Rank(figure, name, value, runs))
    return sorted(found, key=lambda r: (-abs(r.correlation), r.figure, r.given))
