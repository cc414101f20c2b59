"""Every tick of a log, as far as a page has room for it: in stretches, those first where something happens.

A stretch is a block of the log: each column as whole numbers of its step, the differences from tick to tick,
zigzag, their bytes in planes (all lowest ones first), and all of that deflated. A page's script decodes what
is looked at.
"""

from __future__ import annotations

import math
import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

NONE = -(2**31)  # in place of what is not finite
_MOST = 2**31 - 1
TIME_S = 1e-6  # step of the time
STEPS = {
    "_mm_s": 1e-2, "_n_s": 1.0, "_mm": 1e-4, "_bar": 2e-4, "_um": 0.02, "_us": 0.1, "_ms": 1e-3, "_n": 0.02,
    "_v": 5e-4,
}  # fmt: skip
"""Steps by the end of a name: what nobody can see, and most of them below the sensors' own."""


def step_of(name: str) -> float:
    """The step of a column."""
    return next(step for end, step in STEPS.items() if name.endswith(end))


class Stretch(NamedTuple):
    """Ticks in a row."""

    begin_s: float
    end_s: float  # of the last tick
    ticks: int
    interest: tuple[bool, float]
    data: bytes


class Closeup:
    """Keeps the most interesting stretches within a budget."""

    def __init__(self, names: tuple[str, ...], budget: int) -> None:
        """Nothing yet.

        Args:
            names: of the columns.
            budget: bytes of all stretches together; where it is 0, nothing is kept.
        """
        self._steps = np.array([TIME_S, *(step_of(name) for name in names)])
        self._budget, self._size = budget, 0
        self.stretches: list[Stretch] = []
        self.ticks = 0  # of all that came

    def add(self, t_s: Floats, values: Floats, happens: bool, error: float) -> None:
        """Take a stretch.

        Args:
            t_s: its times.
            values: (tick, column).
            happens: whether something happens in it, such as a request or a fault.
            error: the greatest one in it.
        """
        self.ticks += len(t_s)
        interest = (happens, 0.0 if math.isnan(error) else error)
        full = self._size >= self._budget
        if not len(t_s) or (full and (not self.stretches or interest <= self._least.interest)):
            return
        table = np.column_stack((t_s - t_s[0], values))
        found = Stretch(float(t_s[0]), float(t_s[-1]), len(t_s), interest, encoded(table, self._steps))
        self.stretches.append(found)
        self._size += len(found.data)
        while self._size > self._budget:
            least = self._least
            self.stretches.remove(least)
            self._size -= len(least.data)

    @property
    def _least(self) -> Stretch:
        return min(reversed(self.stretches), key=lambda s: s.interest)

    @property
    def kept(self) -> int:
        """Ticks that are kept."""
        return sum(s.ticks for s in self.stretches)


def encoded(table: Floats, steps: Floats) -> bytes:
    """The numbers of a table (tick, column), packed."""
    with np.errstate(invalid="ignore"):
        scaled = np.clip(np.rint(table / steps), -_MOST, _MOST)
    numbers = np.where(np.isfinite(table), np.nan_to_num(scaled), NONE).astype(np.int64).T
    change = np.diff(numbers, axis=1, prepend=0).astype(np.int32)  # wraps, and comes back
    zigzag = ((change << 1) ^ (change >> 31)).astype(np.uint32)
    planes = np.ascontiguousarray(zigzag).view(np.uint8).reshape(*zigzag.shape, 4).transpose(0, 2, 1)
    return zlib.compress(np.ascontiguousarray(planes).tobytes(), 6)


def decoded(data: bytes, count: int, steps: Floats) -> Floats:
    """The table again, within half a step; what the script of a page does."""
    planes = np.frombuffer(zlib.decompress(data), np.uint8).reshape(len(steps), 4, count)
    zigzag = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<u4")[..., 0]
    change = (zigzag >> np.uint32(1)).astype(np.int32) ^ -(zigzag & np.uint32(1)).astype(np.int32)
    numbers = np.cumsum(change, axis=1, dtype=np.int32)
    found: Floats = np.where(numbers == NONE, np.nan, numbers * steps[:, None]).T
    return found
