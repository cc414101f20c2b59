"""What a log's run came to, in the figures that `pneud` prints at its end."""

from __future__ import annotations

import math
from typing import Any

from pneud.bus.mapped_inbox import inbox_of
from pneud.config.reading import parse
from pneud.loading import at_rate, codecs_of
from pneud.log.files.reader import LogReader
from pneud.loop.summary import in_words, summarise
from pneud.loop.tally import Tally
from pneud.loop.tracking import in_words as tracking_in_words
from pneud.notebook import html
from pneud.signals import Answer, RequestKind

SIMULATED = "simulated"


class Summary(dict[str, Any]):
    """The object that `--json` prints, which `print` shows in words."""

    def __str__(self) -> str:
        return in_words(self)

    def _repr_html_(self) -> str:
        return html.facts("summary", self.facts())

    def facts(self) -> dict[str, Any]:
        """The figures that one looks at first, in words."""
        command, faults = self["command_v"], self["faults"]
        return {
            "state": self["state"],
            "ticks": f"{self['ticks']} at {self['rate_hz']:g} Hz, {self['skipped']} skipped",
            "error": tracking_in_words(self["tracking_mm"]).removeprefix("tracking error "),
            "command": f"{command['max']:.2f} V at most" if command else None,
            "saturated": f"{self['saturated_ticks']} ticks",
            "faults": ", ".join(faults) or "none",
        }


def summary_of(log: LogReader) -> Summary:
    """The summary of a log, whose frames are judged anew.

    What nobody could record is not in it: frames that the machine dropped, records that the log lacks.

    Raises:
        ConfigError: the configuration in the log cannot be used by this version.
        DatabaseError: nor its DBC.
    """
    config = at_rate(parse(log.config_text, f"{log.path}:{log.config_name}"), log.rate_hz)
    codecs = codecs_of(config.bus, log.dbc_name, log.dbc, config.gas)
    inbox, bus = inbox_of(codecs, config.bus), log.metadata.get("bus", "")
    tally = Tally(truth=False, timed=bus != SIMULATED, sync=inbox.sync)
    command_id = codecs.valve_command.can_id
    tx, ending, leaving = 0, False, False
    for logged in log:
        for frame in logged.frames[: logged.before]:
            inbox.feed(frame)
        inbox.begin(logged.t_ns)
        for frame in logged.frames[logged.before :]:
            inbox.feed(frame)
        inbox.measurement(logged.skipped, logged.host)
        inbox.commanded_ns = next((f.stamp_ns for f in logged.sent if f.can_id == command_id), -1)
        tx += sum(f.stamp_ns >= 0 for f in logged.sent)
        request = logged.request
        ending = leaving or ending or (request is not None and request.kind == RequestKind.SHUTDOWN)
        if request is not None and request.kind == RequestKind.RESTART:
            leaving = leaving or logged.answer == Answer.TAKEN  # from the next tick on
        if math.isfinite(logged.truth_m):
            tally.tracking.has_truth = True
        tally.add(logged.record, ending=ending)
    found = summarise(
        tally,
        bus=bus,
        rate_hz=log.rate_hz,
        counts=inbox.counts(),
        tx=tx,
        rx_dropped=0,
        log=str(log.path),
        log_dropped=log.missing,
    )
    return Summary(found)
