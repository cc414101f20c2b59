"""A log for rerun: curves, states, events and a table of faults, with the blueprint that arranges them.

The panels are those of the layout for Foxglove and Lichtblick, so that both show the same. Needs rerun-sdk.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pneud import resources
from pneud.log.files.columns import Block, blocks
from pneud.log.files.naming import LogError
from pneud.log.files.reader import LogReader
from pneud.log.files.table import Column, TickTable
from pneud.log.format.record_layout import WORD_BITS
from pneud.log.format.records import names_of
from pneud.log.format.schema import Level
from pneud.rt.outputs import replacing
from pneud.safety.faults import TABLE

TICK = "/axis/tick."
LEVELS = {Level.WARNING: "WARN"}  # others are called alike
CURES = {fault.name: fault.cure for fault in TABLE}
FACTS = ("name", "bus", "rate_hz", "config", "pneud")


class Panel(NamedTuple):
    """Some columns over time."""

    title: str
    columns: dict[str, str]  # label by column

    @property
    def place(self) -> str:
        """Where its curves are: its title without unit and spaces."""
        return "/" + "_".join(re.findall(r"[a-z]+", self.title.partition("[")[0].lower()))


def layout() -> Path:
    """The layout for Foxglove and Lichtblick."""
    return resources.configs() / "viewers" / "foxglove.json"


def panels() -> list[Panel]:
    """The plots of that layout."""
    found = json.loads(layout().read_text(encoding="utf-8"))["configById"]
    plots = [config for name, config in found.items() if name.startswith("Plot!")]
    return [
        Panel(plot["title"], {p["value"].removeprefix(TICK): p["label"] for p in plot["paths"]})
        for plot in plots
    ]


def _whole(columns: dict[str, Column], name: str) -> Column:
    """All bits of a word of faults; Python's integers where they need them."""
    more = columns[f"{name}_more"]
    if not more.any():
        return columns[name]
    whole: Column = columns[name].astype(object) | more.astype(object) << WORD_BITS
    return whole


class FaultTable:
    """When each fault was there, in seconds from the first tick."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._bits = 0
        self._last_s = 0.0
        self.spans: list[tuple[str, float, float | None, bool]] = []  # name, from, until, latched
        self._open: dict[int, int] = {}

    def add(self, columns: dict[str, Column]) -> None:
        """The ticks of a block."""
        present, latched, t_s = _whole(columns, "present"), _whole(columns, "latched"), columns["t_s"]
        bits = present | latched
        for at in np.flatnonzero(np.diff(bits, prepend=self._bits)).tolist():
            now = int(bits[at])
            for bit in range(2 * WORD_BITS):
                if (now & ~self._bits) >> bit & 1:
                    self._open[bit] = len(self.spans)
                    (name,) = names_of(1 << bit, self._names)
                    self.spans.append((name, float(t_s[at]), None, False))
                elif (self._bits & ~now) >> bit & 1:
                    place = self._open.pop(bit)
                    name, begun_s, _, was_latched = self.spans[place]
                    self.spans[place] = (name, begun_s, float(t_s[at]), was_latched)
            self._bits = now
        for bit, place in self._open.items():
            name, begun_s, until_s, was_latched = self.spans[place]
            was_latched = was_latched or bool((latched >> bit & 1).any())
            self.spans[place] = (name, begun_s, until_s, was_latched)

    def markdown(self) -> str:
        """The table for people."""
        if not self.spans:
            return "no faults"
        rows = ["| fault | from [s] | until [s] | latched | what to look at |", "|---|---|---|---|---|"]
        for name, begun_s, until_s, latched in self.spans:
            until = "the end" if until_s is None else f"{until_s:.3f}"
            rows.append(
                f"| {name} | {begun_s:.3f} | {until} | {'yes' if latched else 'no'} | {CURES.get(name, '')} |"
            )
        return "\n".join(rows)


def write(log: LogReader, path: Path) -> int:
    """Write a recording for rerun, with its blueprint.

    Returns:
        How many ticks are in it.

    Raises:
        LogError: rerun-sdk is missing, or of a version without states.
        OSError: the file cannot be written.
    """
    try:
        import rerun as rr  # noqa: PLC0415  (none of pneud's own)
        import rerun.blueprint as rrb  # noqa: PLC0415

        _ = rr.StateChange, rrb.StateTimelineView
    except (ImportError, AttributeError):
        raise LogError("rerun's recordings need rerun-sdk 0.41; pip install rerun-sdk") from None
    with replacing(path) as beside:
        recording = rr.RecordingStream("pneud", recording_id=log.metadata.get("run") or log.path.name)
        recording.save(beside, default_blueprint=_blueprint(rrb))
        rows = _Writer(log, rr, recording).write()
        recording.disconnect()
    return rows


def _blueprint(rrb: Any) -> Any:
    """States, curves and words, as in the layout."""
    plots = [
        rrb.TimeSeriesView(origin=panel.place, name=panel.title, contents=f"{panel.place}/**")
        for panel in panels()
    ]
    states = rrb.StateTimelineView(origin="/states", name="State and faults", contents="/states/**")
    half = len(plots) // 2
    words = rrb.Tabs(
        rrb.TextDocumentView(origin="/faults", name="Faults"),
        rrb.TextLogView(origin="/events", name="Events", contents="/events/**"),
        rrb.TextDocumentView(origin="/about", name="About"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(states, *plots[:half], row_shares=[1.3, *(1 for _ in plots[:half])]),
            rrb.Vertical(words, *plots[half:], row_shares=[2, *(1 for _ in plots[half:])]),
        ),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="t"),
    )


class _Writer:
    def __init__(self, log: LogReader, rr: Any, recording: Any) -> None:
        self._log, self._rr, self._recording = log, rr, recording
        self._table, self._faults = TickTable(log), FaultTable(log.fault_names)
        self._state = ""
        self._started_ns = 0

    def write(self) -> int:
        rows = 0
        for panel in panels():
            for column, label in panel.columns.items():
                self._log_static(_entity(panel, column), self._rr.SeriesLines(names=label))
        for block in blocks(self._log):
            if len(block.number):
                self._started_ns = self._started_ns or int(block.log_time_ns[0])
                self._ticks(block)
            self._events(block)
            rows += len(block.number)
        self._spans()
        facts = "\n".join(f"* {key}: {self._log.metadata.get(key, '')}" for key in FACTS)
        for place, text in (("/about", facts), ("/faults", self._faults.markdown())):
            self._log_static(place, self._rr.TextDocument(text, media_type="text/markdown"))
        return rows

    def _log_static(self, entity: str, what: Any) -> None:
        self._recording.log(entity, what, static=True)

    def _send(self, entity: str, t_s: Any, columns: Any) -> None:
        stamps = self._started_ns + np.round(np.asarray(t_s) * 1e9).astype(np.int64)
        indexes = [
            self._rr.TimeColumn("t", duration=t_s),
            self._rr.TimeColumn("log_time", timestamp=stamps.astype("datetime64[ns]")),
        ]
        self._rr.send_columns(entity, indexes=indexes, columns=columns, recording=self._recording)

    def _ticks(self, block: Block) -> None:
        columns = self._table.columns(block)
        self._faults.add(columns)
        for panel in panels():
            for column in panel.columns:
                scalars = self._rr.Scalars.columns(scalars=columns[column].astype(np.float64))
                self._send(_entity(panel, column), columns["t_s"], scalars)
        words = columns["state_name"].tolist()
        before = [self._state, *words]
        changes = [i for i, word in enumerate(words) if word != before[i]]
        self._state = words[-1]
        if changes:
            states = self._rr.StateChange.columns(state=[words[i] for i in changes])
            self._send("/states/axis", columns["t_s"][changes], states)

    def _spans(self) -> None:
        """A lane for each fault."""
        for name in dict.fromkeys(span[0] for span in self._faults.spans):
            changes: list[tuple[float, str]] = []
            for _, begun_s, until_s, latched in (s for s in self._faults.spans if s[0] == name):
                changes.append((begun_s, "latched" if latched else "present"))
                changes += [(until_s, "gone")] if until_s is not None else []
            states = self._rr.StateChange.columns(state=[state for _, state in changes])
            self._send(f"/states/{name}", [t_s for t_s, _ in changes], states)

    def _events(self, block: Block) -> None:
        if not block.events or not self._started_ns:
            return
        t_s = [(event.log_time_ns - self._started_ns) * 1e-9 for event in block.events]
        texts = self._rr.TextLog.columns(
            text=[f"{event.name}: {event.message}" for event in block.events],
            level=[LEVELS.get(event.level, event.level.name) for event in block.events],
        )
        self._send("/events", t_s, texts)


def _entity(panel: Panel, column: str) -> str:
    return f"{panel.place}/{column}"
