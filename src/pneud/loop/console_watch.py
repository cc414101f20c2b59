"""The loop's side of the console: whether an operator has engaged the axis, and the console still lives."""

from __future__ import annotations

from pneud.log.live.ring import Ring
from pneud.safety.supervisor import ENGAGES, STEERS, is_engaged
from pneud.signals import Answer, Host, RequestKind, Tick

SILENT_S = 0.5  # how long a console may be silent while the axis is engaged at its operator's request
SILENT_NS = round(SILENT_S * 1e9)
TAKEN, CONSOLE_LOST = int(Answer.TAKEN), int(Host.CONSOLE_LOST)
_COMMANDS = frozenset((*ENGAGES, *STEERS, int(RequestKind.RUN)))


class ConsoleWatch:
    """What is known of a console; `host` once a tick, then `after`.

    An axis that has armed by itself, and that no operator has steered since, goes on without a console.
    """

    __slots__ = ("_commanded", "_gone", "_ring")

    def __init__(self, ring: Ring) -> None:
        self._ring = ring
        self._commanded = False  # the axis is engaged at an operator's request
        self._gone = 0  # consoles that had died before

    def host(self, t_ns: int) -> int:
        """Bits of `signals.Host`."""
        if not self._commanded:
            return 0
        beat_ns = self._ring.console_ns
        silent = beat_ns and t_ns - beat_ns > SILENT_NS
        # the next console may have begun before a loop that was held up has seen that the last one was gone
        return CONSOLE_LOST if silent or self._ring.consoles_gone != self._gone else 0

    def after(self, tick: Tick, *, asked: bool) -> None:
        """See what has become of the axis.

        Args:
            tick: as it was decided.
            asked: its request is an operator's.
        """
        if not is_engaged(tick.state):
            self._commanded = False
        elif asked and tick.answer == TAKEN and tick.request is not None and tick.request.kind in _COMMANDS:
            if not self._commanded:
                self._gone = self._ring.consoles_gone
            self._commanded = True
