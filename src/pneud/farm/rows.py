"""One log as rows: what was done in it, motion by motion, each with what the run was."""

from __future__ import annotations

import fcntl
import hashlib
import math
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

import numpy as np

from pneud.config.learnt import QUANTITIES, values_learnt
from pneud.config.models import Config
from pneud.config.reading import parse
from pneud.loading import at_rate
from pneud.log.files.columns import Block, blocks
from pneud.log.files.reader import LoggedState, LogReader
from pneud.log.format.records import names_of
from pneud.replay.learning import learnt_in
from pneud.replay.motions import Motion, Motions

SUMMARY = 1  # number of the columns that there are; logs of another are read again


class Found(NamedTuple):
    """A log that is there."""

    path: Path
    bytes: int
    changed_ns: int  # Unix, of its last change


class Row(NamedTuple):
    """A motion and its log; of a log without any, or that cannot be read, one row without `motion`.

    SI; positions in the stroke coordinate. Instants (`…_ns` of Unix time) are written as such.
    """

    log: str  # the file
    bytes: int
    changed_ns: int
    summary: int  # `SUMMARY`
    damage: str = ""  # why the log cannot be read, or not to its end
    closed: bool = True  # it has its end; one that is being written has none yet
    axis: str = ""
    run: str = ""
    part: int = 0
    bus: str = ""
    host: str = ""
    pneud: str = ""
    seed: str = ""
    rate_hz: float | None = None
    law: str = ""
    config: str = ""  # the first digits of the SHA-256 of the configuration's text
    log_begun_ns: int | None = None  # first tick
    length_s: float | None = None
    ticks: int = 0
    missing: int = 0
    skipped: int = 0
    run_faults: str = ""  # latched in the log
    motion: int | None = None  # from 1
    kind: str = ""
    begun_ns: int | None = None
    begin_s: float | None = None  # from the log's first tick, likewise the next
    duration_s: float | None = None
    from_m: float | None = None
    to_m: float | None = None
    rms_error_m: float | None = None
    max_error_m: float | None = None
    overshoot_m: float | None = None
    settling_s: float | None = None
    in_position_s: float | None = None
    peak_speed_m_s: float | None = None
    air_anr_m3: float | None = None
    air_energy_j: float | None = None
    work_j: float | None = None
    to_n: float | None = None
    at_n: float | None = None
    beyond_n: float | None = None
    mean_step_v: float | None = None
    saturated_ticks: int | None = None
    supply_min_pa: float | None = None
    ended_in: str = ""
    faults: str = ""  # that were latched in it, or as it ended
    cut: bool = False  # the log begins or ends with it
    learnt_dead_zone_positive_v: float | None = None  # by its end; nothing where it is not learnt
    learnt_dead_zone_negative_v: float | None = None
    learnt_orifice_area_m2: float | None = None
    learnt_bandwidth_hz: float | None = None
    learnt_coulomb_n: float | None = None
    learnt_bristle_stiffness_n_m: float | None = None
    learnt_load_n: float | None = None
    learnt_moving_mass_kg: float | None = None


TYPES: dict[str, Any] = get_type_hints(Row)
"""Of each column."""
_OF_MOTION = tuple(name for name in Row._fields if name in Motion._fields)
_LEARNT = {q.name: f"learnt_{q.name}" for q in QUANTITIES}


def bare(found: Found, damage: str) -> Row:
    """Of a log of which nothing is known but why."""
    return Row(str(found.path), found.bytes, found.changed_ns, SUMMARY, damage, closed=False)


def rows_of(found: Found) -> list[Row]:
    """A log's rows. What cannot be read is one row that says why; this raises nothing for it."""
    try:
        return _rows_of(found)
    except Exception as e:
        text = str(e) if hasattr(e, "exit_code") else f"cannot be summarised: {type(e).__name__}: {e}"
        return [bare(found, text.removeprefix(f"{found.path}: "))]


def _rows_of(found: Found) -> list[Row]:
    log = LogReader([found.path])
    m = log.metadata
    head = Row(
        str(found.path),
        found.bytes,
        found.changed_ns,
        SUMMARY,
        axis=m.get("name", ""),
        run=m.get("run", ""),
        part=int(m.get("part", "1")),
        bus=m.get("bus", ""),
        host=m.get("host", ""),
        pneud=m.get("pneud", ""),
        seed=m.get("seed", ""),
        rate_hz=log.rate_hz,
        config=hashlib.sha256(log.config_text.encode()).hexdigest()[:12],
    )
    try:
        config = at_rate(_parsed(log.config_text, log.config_name), log.rate_hz)
    except Exception as e:  # of another version: what the log is, and no motions
        return [head._replace(damage=f"its configuration cannot be used: {e}")]
    passed = _Passed(log, config)
    for block in blocks(log, frames=False):
        passed.add(block)
    written = log.truncated and _is_being_written(found.path)
    head = head._replace(
        law=config.control.law,
        damage="" if written else log.damage,
        closed=not log.truncated,
        missing=log.missing,
        **passed.facts(),
    )
    return [head._replace(**motion) for motion in passed.motions()] or [head]


@lru_cache(maxsize=8)
def _parsed(text: str, name: str) -> Config:
    """A configuration; many logs have the same."""
    return parse(text, name)


def _is_being_written(path: Path) -> bool:
    """Whether its writer holds it locked."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
    return False


class _Passed:
    """What has passed of a log."""

    def __init__(self, log: LogReader, config: Config) -> None:
        self._log, self._config = log, config
        self._motions = Motions(config)
        self._first_ns: int | None = None
        self._begun_ns: int | None = None  # Unix
        self._last_s = 0.0
        self._ticks = self._skipped = 0
        self._latched = self._ever = 0
        self._latches: list[tuple[float, int]] = []  # when, and which bits
        self._learnt: list[tuple[float, dict[str, float]]] = []

    def add(self, block: Block) -> None:
        if len(block.number):
            t_ns: Any = block.ticks["t_ns"]
            if self._first_ns is None:
                self._first_ns, self._begun_ns = int(t_ns[0]), int(block.log_time_ns[0])
            t_s = (t_ns - self._first_ns) * 1e-9
            self._motions.add(block, t_s)
            self._ticks += len(t_s)
            self._skipped += int(block.ticks["measurement.skipped"].sum())
            self._last_s = float(t_s[-1])
            self._note_latches(block, t_s)
        for state in block.states:
            self._note_learnt(state)

    def _note_latches(self, block: Block, t_s: Any) -> None:
        words = block.faults("latched")
        places = {i for _, column in words for i in np.flatnonzero(np.diff(column)).tolist()}
        for i in sorted({0, *(place + 1 for place in places)}):
            latched = sum(int(column[i]) << first for first, column in words)
            if latched & ~self._latched:
                self._latches.append((float(t_s[i]), latched & ~self._latched))
            self._latched = latched
            self._ever |= latched

    def _note_learnt(self, state: LoggedState) -> None:
        learnt = learnt_in(state)
        if learnt is not None and self._begun_ns is not None:
            values = {_LEARNT[name]: v["value"] for name, v in values_learnt(learnt, self._config).items()}
            self._learnt.append(((state.log_time_ns - self._begun_ns) * 1e-9, values))

    def facts(self) -> dict[str, Any]:
        """What is to be said of the log."""
        return {
            "log_begun_ns": self._begun_ns,
            "length_s": self._last_s if self._ticks else None,
            "ticks": self._ticks,
            "skipped": self._skipped,
            "run_faults": self._names(self._ever),
        }

    def _names(self, bits: int) -> str:
        return " ".join(names_of(bits, self._log.fault_names))

    def motions(self) -> list[dict[str, Any]]:
        """Each, with what happened meanwhile."""
        found, period_s = self._motions.finish(), 1.0 / self._log.rate_hz
        rows, at, learnt = [], 0, dict[str, float]()
        for number, m in enumerate(found, 1):
            while at < len(self._learnt) and self._learnt[at][0] <= m.end_s + period_s:
                learnt = self._learnt[at][1]
                at += 1
            bits = 0
            for t_s, some in self._latches:
                if m.begin_s <= t_s <= m.end_s + period_s:
                    bits |= some
            row = {name: _known(getattr(m, name)) for name in _OF_MOTION}
            row |= {
                "motion": number,
                "begun_ns": None if self._begun_ns is None else self._begun_ns + round(m.begin_s * 1e9),
                "duration_s": m.duration_s,
                "faults": self._names(bits),
                "cut": m.begin_s == 0.0 or not m.ended_in,
            }
            rows.append(row | learnt)
        return rows


def _known(value: Any) -> Any:
    """Nothing in the place of a number that is none."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
