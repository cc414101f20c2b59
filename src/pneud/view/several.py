"""The screen of several axes: a strip for each, and one of them drawn large, which keys are for."""

from __future__ import annotations

from collections.abc import Sequence

from rich.segment import Segment

from pneud.signals import State
from pneud.view.banner import faults_of
from pneud.view.hands import Hands
from pneud.view.history import History
from pneud.view.palette import Palette, palette
from pneud.view.screen import ScreenState, standing
from pneud.view.show import Show
from pneud.view.text import BOLD, DIM, PLAIN, Rows, clean, length, name_of, number

NEXT = "tab"
MOST = 9  # axes that a figure chooses
_NAME_WIDTH, _STATE_WIDTH = 12, 24


class Choosing:
    """Keys: a figure or the tabulator choose an axis, all others are for the one that is chosen."""

    def __init__(self, shows: Sequence[Show], chosen: int) -> None:
        self._shows = shows
        self.chosen = chosen

    @property
    def _hands(self) -> Hands:
        return self._shows[self.chosen].hands

    @property
    def over(self) -> bool:
        """`q` has been pressed."""
        return any(show.hands.over for show in self._shows)

    def press(self, key: str) -> None:
        """Act on a key."""
        hands, most = self._hands, min(len(self._shows), MOST)
        if key == NEXT and not hands.prompt:
            self._choose((self.chosen + 1) % len(self._shows))
        elif key.isdecimal() and 1 <= int(key) <= most and not hands.prompt:
            self._choose(int(key) - 1)
        else:
            hands.press(key)

    def _choose(self, number: int) -> None:
        light = self._hands.light
        self._hands.help = False
        self.chosen = number
        self._hands.light = light


class Several:
    """Shows of all axes of a daemon as one.

    Attributes:
        hands: what has been typed.
    """

    def __init__(self, shows: Sequence[Show], chosen: int = 0) -> None:
        """Begin.

        Args:
            shows: one for each axis, in order.
            chosen: the place of the one that is drawn large at first.
        """
        self._shows = shows
        self.hands = Choosing(shows, chosen)

    @property
    def _shown(self) -> Show:
        return self._shows[self.hands.chosen]

    @property
    def snapshot(self) -> ScreenState:
        """Of the axis that is chosen."""
        return self._shown.snapshot

    @property
    def history(self) -> History:
        """Likewise."""
        return self._shown.history

    def attend(self) -> bool:
        """As of one show; all of them go on, whichever is looked at."""
        going = [show.attend() for show in self._shows]
        return all(going)

    def picture(self, size: tuple[int, int], ascii_only: bool) -> list[list[Segment]]:
        """The strips, and below them the page of the axis that is chosen, as rows of exactly this size."""
        width, height = max(size[0], 1), max(size[1], 1)
        strips = Rows(width, ascii_only)
        look = palette(self.snapshot.typed.light)
        for number_, show in enumerate(self._shows):
            strip(strips, number_ + 1, show.snapshot, look, chosen=number_ == self.hands.chosen)
        above = strips.filled(strips.count)[: max(height - 1, 0)]
        return above + self._shown.picture((width, height - len(above)), ascii_only)


def strip(rows: Rows, number_: int, state: ScreenState, look: Palette, *, chosen: bool) -> None:
    """An axis in one row: what chooses it, name, state, where it is, how far off, what leaves, faults."""
    info, record = state.info, state.record
    rows.row()
    rows.put("▌" if chosen else " ", look.good)
    rows.put(f"{number_} " if number_ <= MOST else "  ", look.key if not chosen else BOLD)
    rows.put(f" {clean(info.name)}", BOLD if chosen else PLAIN, _NAME_WIDTH)
    if record is None:
        rows.put(" waiting for its first tick", DIM)
        return
    tick = record.tick
    badge = f" {name_of(State, tick.state)}{standing(record)} "
    rows.put(badge, look.hunting if tick.hunting else look.badge(tick.state))
    rows.put(" " * max(_STATE_WIDTH - len(badge), 1))
    rows.put(number(1e3 * tick.measurement.position_m, "9.3f", "mm"))
    rows.put("  ")
    faults = faults_of(record, info)
    if not faults:
        rows.put("error ", DIM)
        rows.put(length(tick.error_m) if tick.error_m == tick.error_m else "-", PLAIN, 12)
        rows.put("command ", DIM)
        rows.put(number(tick.command.voltage_v, "+.2f", "V"), PLAIN, 9)
    for name, level in faults:
        if len(name) + 3 > rows.room:
            rows.put("…")
            break
        rows.put(f"{name} ", look.of(level))
