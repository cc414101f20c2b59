"""The rows of a campaign by their columns: a million of them are megabytes by the hundred, not gigabytes."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pneud.campaign.parts import ARRIVES, SETTLES
from pneud.campaign.unit import ERROR, Cell, Row

Floats = NDArray[np.float64]
TIMES = (SETTLES, ARRIVES)  # ends of the columns of times that may never come


class Rows:
    """All rows in the order of their numbers, once they are put into their places.

    Args:
        columns: and the kind of value in each.
        total: how many there are.
    """

    def __init__(self, columns: Mapping[str, type], total: int) -> None:
        self.columns = dict(columns)
        self._cells: dict[str, Any] = {
            name: np.full(total, np.nan) if kind is float else [None] * total
            for name, kind in columns.items()
        }
        self._there = np.zeros(total, dtype=bool)

    def __len__(self) -> int:
        return len(self._there)

    @property
    def missing(self) -> int:
        """How many have not been put."""
        return int((~self._there).sum())

    def put(self, number: int, cells: Sequence[Cell]) -> None:
        """One row, its cells in the order of the columns."""
        self._there[number] = True
        for (name, column), cell in zip(self._cells.items(), cells, strict=True):
            if cell is not None:
                # few texts, many times
                column[number] = sys.intern(cell) if isinstance(cell, str) else self.columns[name](cell)

    def column(self, name: str) -> Any:
        """The values of a column: an array where they are floats, NaN where there is none; else a list."""
        return self._cells[name]

    def numbers(self, name: str) -> Floats:
        """A column as numbers, NaN where there is none."""
        column = self._cells.get(name)
        if column is None:
            return np.full(len(self), np.nan)
        if isinstance(column, np.ndarray):
            return column
        return np.array([float(x) if isinstance(x, int | float) else np.nan for x in column])

    def ordered(self, name: str) -> Floats:
        """As `numbers`; a time that never comes, in a run that was done, is infinite."""
        values = self.numbers(name)
        if not name.endswith(TIMES):
            return values
        done = np.array([not text for text in self.column(ERROR)], dtype=bool)
        return np.where(np.isnan(values) & done, np.inf, values)

    def row(self, number: int) -> Row:
        """One row; None where a value is none."""
        return {name: self._cell(column[number]) for name, column in self._cells.items()}

    def __iter__(self) -> Iterator[Row]:
        return map(self.row, range(len(self)))

    @staticmethod
    def _cell(value: Any) -> Cell:
        if isinstance(value, np.floating):
            return None if np.isnan(value) else float(value)
        found: Cell = value
        return found

    def where(self, name: str) -> list[int]:
        """The numbers of rows in which a text is not empty."""
        column = self._cells.get(name)
        return [number for number, text in enumerate(column) if text] if column is not None else []

    def greatest(self, name: str, count: int) -> list[int]:
        """The numbers of the rows with the greatest figures, the greatest first; of equal ones the first."""
        values = self.ordered(name)
        order = np.argsort(-values, kind="stable")  # what is no number comes last
        return [int(i) for i in order[:count] if not np.isnan(values[i])]
