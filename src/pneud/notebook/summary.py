"""What a log's run came to, in the figures that `pneud` prints at its end."""

from __future__ import annotations

from typing import Any

from pneud.config.reading import parse
from pneud.loading import at_rate, codecs_of
from pneud.log.files.columns import blocks
from pneud.log.files.reader import LogReader
from pneud.loop.summary import in_words, summarise
from pneud.loop.tracking import in_words as tracking_in_words
from pneud.notebook import html
from pneud.replay.heard import Heard
from pneud.replay.tallied import Tallied

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
    bus = log.metadata.get("bus", "")
    heard = Heard(codecs, config.bus)
    tallied = Tallied(timed=bus != SIMULATED, sync=heard.inbox.sync)
    for block in blocks(log):
        heard.add(block)
        tallied.add(block)
    found = summarise(
        tallied.tally,
        bus=bus,
        rate_hz=log.rate_hz,
        counts=heard.inbox.counts(),
        tx=heard.sent,
        rx_dropped=0,
        log=str(log.path),
        log_dropped=log.missing,
    )
    return Summary(found)
