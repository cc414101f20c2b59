"""Mistakes put back one at a time, and which oracle says no.

`HAD` are those that this program once had; where a patch would no longer fit, because the code has moved, a
function is what it was in effect. `RULES` leave out a rule that there has been from the beginning.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from pneud.bus.link import Link
from pneud.console import handoff, programs
from pneud.console.server import Server
from pneud.log.files.saving import LogOutput
from pneud.log.files.writer import LogWriter
from pneud.log.live.ring import Ring
from pneud.loop import company, recorder_watch
from pneud.loop.answers import Answers
from pneud.loop.company import Company
from pneud.loop.conditions import Conditions
from pneud.loop.console_watch import CONSOLE_LOST, SILENT_NS, ConsoleWatch
from pneud.loop.lane import Lane
from pneud.loop.recorder_watch import RecorderWatch
from pneud.rt.notify import Service
from pneud.signals import Host, RequestKind


class Mistake(NamedTuple):
    """One of them."""

    oracles: tuple[str, ...]  # that may say no
    seed: int  # that finds it
    make: Callable[[pytest.MonkeyPatch], None]


def _begun_before_the_recorder(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(RecorderWatch, "begun", property(lambda _: True))


def _console_not_watched(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(ConsoleWatch, "host", lambda *_: 0)


def _next_console_undoes_the_end_of_the_last(patch: pytest.MonkeyPatch) -> None:
    def host(self: Any, t_ns: int) -> int:
        beat_ns = self._ring.console_ns
        return CONSOLE_LOST if self._commanded and beat_ns and t_ns - beat_ns > SILENT_NS else 0

    patch.setattr(ConsoleWatch, "host", host)


def _attended_motion_goes_on(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Server, "_unattended", lambda *_: None)


def _removed_log_is_whole(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(LogOutput, "is_removed", lambda _: False)


def _set_comes_whenever_its_stamp_says(patch: pytest.MonkeyPatch) -> None:
    def came(self: Any, arrived_ns: int, in_vain: bool) -> None:
        self.arrives_ns = arrived_ns
        self._count(in_vain)

    patch.setattr(Answers, "came", came)


def _wall_clock_is_not_followed(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Link, "watch_clock", lambda _: 0)


def _second_controller_is_no_fault(patch: pytest.MonkeyPatch) -> None:
    honest = Conditions.host

    def host(self: Conditions, early: int) -> int:
        return honest(self, early) & ~int(Host.OTHER_CONTROLLER)

    patch.setattr(Conditions, "host", host)


def _recorder_that_is_gone_is_not_missed(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(recorder_watch, "gone", lambda _: False)


def _late_requests_are_done(patch: pytest.MonkeyPatch) -> None:
    honest = handoff._unpacked

    def unpacked(data: bytes, *more: int) -> Any:
        return (*honest(data, *more)[:3], False)

    patch.setattr(handoff, "_unpacked", unpacked)


def _full_disk_is_no_fault(patch: pytest.MonkeyPatch) -> None:
    honest = Ring.status
    patch.setattr(
        recorder_watch.RecorderWatch,
        "look",
        lambda self: setattr(self, "host", 0 if honest(self.ring).heartbeat else self.host),
    )


def _written_before_the_disk_has_it(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(LogWriter, "written", property(lambda self: self._accepted))


def _a_fault_touches_no_other(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Company, "_touch", lambda *_, **__: None)


def _a_fault_touches_others_whatever_they_say(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(company, "_TOUCHES", dict.fromkeys(company._TOUCHES, company.CENTRE))


def _a_run_arms_again_what_an_operator_has_had(patch: pytest.MonkeyPatch) -> None:
    honest = Lane.over

    def over(self: Any) -> bool:
        armed, found = self._armed, honest(self)
        if self._asked or self.request is None or self.request.kind != RequestKind.ARM:
            self._armed = armed
        return found

    patch.setattr(Lane, "over", over)


def _what_a_dead_console_has_asked_is_done(patch: pytest.MonkeyPatch) -> None:
    honest = handoff._unpacked
    patch.setattr(handoff, "_unpacked", lambda data, late_ns, _: honest(data, late_ns, data[7]))


def _words_without_room_are_lost(patch: pytest.MonkeyPatch) -> None:
    honest = Service._send

    def send(self: Service, message: bytes) -> bool:
        honest(self, message)
        return True

    patch.setattr(Service, "_send", send)


def _half_a_program_begins(patch: pytest.MonkeyPatch) -> None:
    honest = programs.requests
    patch.setattr(programs, "requests", lambda *whose, **how: [programs.EMPTY, *honest(*whose, **how)[1:]])


HAD: dict[str, Mistake] = {
    "arming before the recorder has begun": Mistake(("arming",), 29, _begun_before_the_recorder),
    "a console that has died is not missed": Mistake(("console",), 8, _console_not_watched),
    "the next console undoes the end of the last": Mistake(
        ("console",), 697, _next_console_undoes_the_end_of_the_last
    ),
    "an attended motion goes on": Mistake(("attended",), 84, _attended_motion_goes_on),
    "a removed log is whole": Mistake(("summary",), 2, _removed_log_is_whole),
    "a set that comes past the deadline": Mistake(("deadline",), 48, _set_comes_whenever_its_stamp_says),
    "the wall clock is not followed": Mistake(("heard",), 1, _wall_clock_is_not_followed),
    "a second controller": Mistake(("centre",), 28, _second_controller_is_no_fault),
    "words without room are lost": Mistake(("service",), 39, _words_without_room_are_lost),
    "a run arms again what an operator has had": Mistake(
        ("arming",), 583, _a_run_arms_again_what_an_operator_has_had
    ),
    "what a dead console has asked is done": Mistake(
        ("console",), 2388, _what_a_dead_console_has_asked_is_done
    ),
    "half a program begins": Mistake(("program",), 215, _half_a_program_begins),
}
RULES: dict[str, Mistake] = {
    "a recorder that is gone": Mistake(("recorder",), 29, _recorder_that_is_gone_is_not_missed),
    "a full disk is no fault": Mistake(("recorder",), 12, _full_disk_is_no_fault),
    "late requests are done": Mistake(("late",), 1711, _late_requests_are_done),
    "a fault touches no other": Mistake(("touched",), 64, _a_fault_touches_no_other),
    "a fault touches others whatever they say": Mistake(
        ("touched",), 28, _a_fault_touches_others_whatever_they_say
    ),
    "written before the disk has it": Mistake(("log",), 29, _written_before_the_disk_has_it),
}
MISTAKES = HAD | RULES
