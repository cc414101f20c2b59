"""Logs as what identification needs: arrays of what was measured, in pieces without gaps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening

from pneud.config.models import Config
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.log.files.columns import blocks
from pneud.log.files.naming import LogError
from pneud.log.files.reader import LogReader
from pneud.signals import ALL_SOURCES, Source, ValveState
from pneud.study.identification.parameters import configured

Floats = NDArray[np.float64]

COLUMNS = ("position_m", "p1_pa", "p2_pa", "supply_pa", "applied_v")
FRAME_BITS, STUFFING = 111, 1.1  # of the command, on the wire
LEAST_TICKS = 200  # of a piece that is of use
LEAST_S = 2.0  # of all pieces
BRIDGED = 3  # ticks in a row in which position or pressures may be missing
GRANTED = (
    "cylinder.piston_area_1_m2", "cylinder.piston_area_2_m2", "cylinder.stroke_m",
    "cylinder.inclination_deg", "valve.u_max_v",
)  # fmt: skip  # no log tells them: those of one rig have them alike


class Piece(NamedTuple):
    """Ticks in a row, each with a complete set; stroke coordinate, SI."""

    position_m: Floats  # at SYNC
    p1_pa: Floats
    p2_pa: Floats
    supply_pa: Floats
    applied_v: Floats  # what the DAC put out at SYNC


class Table(NamedTuple):
    """What logs of one rig hold."""

    h: float  # sample time [s]
    delay_s: float  # from the sampling instant until the command of that tick acts
    pieces: tuple[Piece, ...]

    @property
    def length_s(self) -> float:
        """Of all pieces [s]."""
        return self.h * sum(len(p.position_m) for p in self.pieces)


def read(logs: Sequence[LogReader], given: Config | None = None) -> tuple[Table, Config]:
    """The ticks of logs of one rig, and the configuration of the last one.

    Args:
        logs: each once.
        given: what is to hold in place of the configurations in the logs.

    Raises:
        LogError: too little in them is of use, they are of different axes or rates, or one is there twice.
        ConfigError: the configuration in a log cannot be used, or the one given is of another cylinder.
    """
    configs = [_config(log) for log in logs]
    _check_each_once(logs)
    pieces: list[Piece] = []
    delays: list[float] = []
    for log, config in zip(logs, configs, strict=True):
        _check_same(log, config, configs[0], logs[0])
        _check_granted(log, config, given, configs[0], logs[0])
        found, delay_s = _pieces(log, config)
        pieces += found
        delays.append(delay_s)
    table = Table(1.0 / logs[0].rate_hz, float(np.median(delays)), tuple(pieces))
    if table.length_s < LEAST_S:
        names = ", ".join(log.path.name for log in logs)
        raise LogError(
            f"{names}: {table.length_s:.1f} s with complete sets and the valve listening;"
            f" at least {LEAST_S:g} s are needed"
        )
    return table, configs[-1]


def differing(logs: Sequence[LogReader]) -> list[tuple[LogReader, tuple[str, ...]]]:
    """The logs whose configuration says something else of the rig than the last one's, and by which keys."""
    said = [configured(_config(log)) for log in logs]
    last = said[-1]
    found = []
    for log, says in zip(logs, said, strict=True):
        if keys := tuple(name for name in {**last, **says} if says.get(name) != last.get(name)):
            found.append((log, keys))
    return found


def _config(log: LogReader) -> Config:
    return parse(log.config_text, f"{log.path}:{log.config_name}")


def _check_each_once(logs: Sequence[LogReader]) -> None:
    """What counts twice would seem twice as sure."""
    seen: dict[tuple[str, int], LogReader] = {}
    for log in logs:
        for part in log.parts:
            before = seen.setdefault(part, log)
            if before is not log:
                raise LogError(f"{log.path}: the same is in {before.path}; give each log once")


def _check_same(log: LogReader, config: Config, first: Config, first_log: LogReader) -> None:
    if log.rate_hz != first_log.rate_hz:
        raise LogError(f"{log.path}: has {log.rate_hz:g} Hz, {first_log.path.name} {first_log.rate_hz:g} Hz")
    if config.name != first.name:
        raise ConfigError(f"{log.path}: is of axis {config.name}, {first_log.path.name} of {first.name}")


def _check_granted(
    log: LogReader, config: Config, given: Config | None, first: Config, first_log: LogReader
) -> None:
    """What is given may be right where the logs' own was not, but for the stroke that the axis moved in."""
    if given is not None:
        if given.cylinder.stroke_m != config.cylinder.stroke_m:
            own, other = config.cylinder.stroke_m, given.cylinder.stroke_m
            raise ConfigError(
                f"--config: is of another cylinder than {log.path}: its cylinder.stroke_m is {other:g},"
                f" and {own:g} in the log"
            )
        return
    for name in GRANTED:
        section, key = name.split(".")
        own, other = getattr(getattr(config, section), key), getattr(getattr(first, section), key)
        if own != other:
            raise ConfigError(
                f"{log.path}: has {name} = {own:g}, {first_log.path.name} {other:g}: are they of one rig?"
                " If so, --config says which holds"
            )


def _pieces(log: LogReader, config: Config) -> tuple[list[Piece], float]:
    """Pieces of one log, and the delay of its commands [s]."""
    period_ns = round(1e9 / log.rate_hz)
    columns: list[list[Floats]] = [[] for _ in COLUMNS]
    fresh, listens, t_ns, spent_ns = [], [], [], []
    for block in blocks(log):
        for column, name in zip(columns, COLUMNS, strict=True):
            column.append(block.real(f"measurement.{name}"))
        state = block.ticks["measurement.valve_state"]
        fresh.append(block.ticks["measurement.fresh"])
        listens.append((state == ValveState.ENABLED) | (state == ValveState.CENTRED))
        t_ns.append(block.ticks["t_ns"].astype(np.int64))
        # all nodes sample when SYNC has arrived, as the encoder says
        spent = sum(block.real(f"timing.{n}") for n in ("set_ns", "cycle_ns", "send_ns"))
        spent_ns.append(spent - block.real("measurement.encoder_offset_ns"))
    if not t_ns:
        return [], 0.0
    whole = [np.concatenate(column) for column in columns]
    sources = np.concatenate(fresh)
    complete = (sources == ALL_SOURCES) & np.isfinite(whole).all(axis=0)
    whole = _bridged(whole, complete)
    sound = complete | (_short(~complete) & (sources & Source.VALVE != 0))
    sound &= np.concatenate(listens)
    follows = np.diff(np.concatenate(t_ns)) < 3 * period_ns // 2
    frame_s = FRAME_BITS * STUFFING / config.bus.bitrate_bit_s
    if math.isinf(config.bus.bitrate_bit_s):
        frame_s = 0.0
    delay_s = float(np.median(np.concatenate(spent_ns))) * 1e-9 + frame_s
    cuts = [0, *(np.flatnonzero(~(follows & sound[1:] & sound[:-1])) + 1).tolist(), len(sound)]
    found = [
        Piece(*(column[begin:end] for column in whole))
        for begin, end in pairwise(cuts)
        if end - begin >= LEAST_TICKS and sound[begin]
    ]
    return found, min(max(delay_s, 0.0), 1e-9 * period_ns)


def _short(missing: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where a few ticks in a row at most are missing."""
    whole = np.ones(BRIDGED + 1, dtype=bool)
    long: NDArray[np.bool_] = binary_opening(missing, whole)
    return missing & ~long


def _bridged(columns: list[Floats], complete: NDArray[np.bool_]) -> list[Floats]:
    """The columns with what is missing put in between; the valve's output, the last, is as it is."""
    there, missing = np.flatnonzero(complete), np.flatnonzero(~complete)
    if not len(there):
        return columns
    for column in columns[:-1]:
        column[missing] = np.interp(missing, there, column[there])
    return columns
