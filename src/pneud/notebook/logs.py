"""A log as one holds it in a notebook: its ticks as columns of any library, its motions, its summary."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneud.config.models import Config
from pneud.config.reading import parse
from pneud.loading import at_rate
from pneud.log.files.listing import length_s
from pneud.log.files.reader import LogReader, paths_of
from pneud.notebook import frames, html
from pneud.notebook.summary import Summary, summary_of
from pneud.replay.motions import Motion, motions

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    import pyarrow as pa
    import xarray as xr

    from pneud.log.files.table import Column

MOST_SHOWN_BYTES = 20_000_000  # of a log whose summary is made only to be looked at
FACTS = ("name", "bus", "rate_hz", "pneud", "seed")
SHOWN = {  # of motions, in a notebook: field, and what it is multiplied by
    "motion": ("kind", 1.0),
    "from [s]": ("begin_s", 1.0),
    "for [s]": ("duration_s", 1.0),
    "from [mm]": ("from_m", 1e3),
    "to [mm]": ("to_m", 1e3),
    "error, RMS [mm]": ("rms_error_m", 1e3),
    "at most [mm]": ("max_error_m", 1e3),
    "overshoot [mm]": ("overshoot_m", 1e3),
    "settling [s]": ("settling_s", 1.0),
    "in position after [s]": ("in_position_s", 1.0),
    "air [normal l]": ("air_anr_m3", 1e3),
    "work [J]": ("work_j", 1.0),
}


class MotionList(list[Motion]):
    """The motions of a log, one after another.

    Examples:
        >>> log.motions()[0].rms_error_m < 1e-3
        True
    """

    def to_pandas(self) -> pd.DataFrame:
        """A frame with a row for each; `attrs` has the `units`.

        Raises:
            ExtraError: pandas is missing.
        """
        frame: pd.DataFrame = frames.require("pandas").DataFrame(list(self), columns=list(Motion._fields))
        frame.attrs = {"units": frames.units(Motion._fields)}
        return frame

    def _repr_html_(self) -> str:
        rows = (
            [getattr(m, name) if by == 1.0 else by * getattr(m, name) for name, by in SHOWN.values()]
            for m in self
        )
        return html.table([*SHOWN], rows)


class Log(LogReader):
    """A log: iterate over it for its ticks, or take them as columns.

    All numbers are in SI units, as their names say; positions count from the rear end stop. Columns are the
    fields of a tick (`measurement.position_m`, `command.voltage_v`, …), and what follows from them: `t_s`,
    `error_m`, `true_error_m`, `state_name`, `fault_names`.

    Examples:
        >>> log.metadata["bus"]
        'simulated'
        >>> [tick.state_name for tick in log][-1]
        'disarmed'
        >>> next(event.message for event in log.events() if event.name == "request")
        'arm 1'
    """

    _summary: Summary | None = None

    @property
    def config(self) -> Config:
        """The configuration that the run had.

        Examples:
            >>> log.config.loop.rate_hz
            1000.0

        Raises:
            ConfigError: this version cannot use it.
        """
        return at_rate(parse(self.config_text, f"{self.path}:{self.config_name}"), self.rate_hz)

    @property
    def facts(self) -> dict[str, str]:
        """What the log says of its run, as far as it says it.

        Examples:
            >>> log.facts["name"]
            'virtual'
        """
        return {key: self.metadata[key] for key in FACTS if key in self.metadata}

    @property
    def duration_s(self) -> float:
        """From the first message to the last [s].

        Examples:
            >>> log.duration_s > 0.5
            True
        """
        return length_s(self.paths)

    def columns(self, *names: str) -> dict[str, Column]:
        """Columns of all ticks as arrays of numpy; those named, or all.

        Examples:
            >>> found = log.columns("t_s", "error_m")
            >>> float(found["t_s"][0]), len(found["t_s"]) == len(found["error_m"])
            (0.0, True)

        Raises:
            KeyError: there is no such column.
        """
        return frames.columns(self, names or None)

    def units(self) -> dict[str, str]:
        """Unit of each column that has one.

        Examples:
            >>> log.units()["estimate.force_n"], log.units()["error_m"]
            ('N', 'm')
        """
        return frames.units(frames.names(self))

    def to_pandas(self, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """The ticks as a frame of pandas; `attrs` has `units`, `descriptions` and the log's facts.

        Args:
            columns: those wanted; None for all.

        Examples:
            >>> frame = log.to_pandas(["t_s", "error_m", "state_name"])
            >>> frame.attrs["units"]
            {'t_s': 's', 'error_m': 'm'}
            >>> bool(frame[frame.state_name == "tracking"].error_m.abs().max() < 0.1)
            True

        Raises:
            ExtraError: pandas is missing.
            KeyError: there is no such column.
        """
        frames.require("pandas")
        return frames.to_pandas(frames.columns(self, columns), self.facts)

    def to_polars(self, columns: Sequence[str] | None = None) -> pl.DataFrame:
        """The ticks as a frame of polars, which keeps no units: see `units`.

        Examples:
            >>> log.to_polars(["t_s", "error_m"]).columns
            ['t_s', 'error_m']

        Raises:
            ExtraError: polars is missing.
            KeyError: there is no such column.
        """
        frames.require("polars")
        return frames.to_polars(frames.columns(self, columns))

    def to_arrow(self, columns: Sequence[str] | None = None) -> pa.Table:
        """The ticks as a table of Arrow; each field's metadata has `unit` and `description`.

        Examples:
            >>> log.to_arrow(["error_m"]).schema.field("error_m").metadata[b"unit"]
            b'm'

        Raises:
            ExtraError: pyarrow is missing.
            KeyError: there is no such column.
        """
        frames.require("pyarrow")
        return frames.to_arrow(frames.columns(self, columns), self.facts)

    def to_xarray(self, columns: Sequence[str] | None = None) -> xr.Dataset:
        """The ticks as a data set of xarray over `t_s`; variables have `units` and `long_name`.

        Examples:
            >>> log.to_xarray(["error_m"]).error_m.attrs["units"]
            'm'

        Raises:
            ExtraError: xarray is missing.
            KeyError: there is no such column.
        """
        frames.require("xarray")
        wanted = None if columns is None else [*dict.fromkeys(chain(columns, ("t_s",)))]
        return frames.to_xarray(frames.columns(self, wanted), self.facts)

    def motions(self) -> MotionList:
        """What the axis was led to do, one motion after another.

        Examples:
            >>> [motion.kind for motion in log.motions()]
            ['track', 'stop']

        Raises:
            ConfigError: this version cannot use the log's configuration.
        """
        return MotionList(motions(self))

    @property
    def summary(self) -> Summary:
        """The figures that `pneud` prints at the end of a run; `print` shows them in words.

        Examples:
            >>> log.summary["faults"]
            []
            >>> log.summary["frames"]["crc"]
            0

        Raises:
            ConfigError: this version cannot use the log's configuration.
        """
        if self._summary is None:
            self._summary = summary_of(self)
        return self._summary

    def __repr__(self) -> str:
        told = ", ".join(f"{key} {text}" for key, text in self.facts.items())
        return f"<{type(self).__name__} {self.path.name}: {told}>"

    def _repr_html_(self) -> str:
        rows: dict[str, Any] = {**self.facts, "length": f"{self.duration_s:.4g} s"}
        del rows["rate_hz"]  # beside the ticks
        small = sum(path.stat().st_size for path in self.paths) <= MOST_SHOWN_BYTES
        if small or self._summary is not None:
            rows |= self.summary.facts()
        return html.facts(self.path.name, rows)


def read_log(path: str | Path, *more: str | Path) -> Log:
    """Open a log: a file, a folder with the parts of one, or the parts themselves in any order.

    Examples:
        >>> log = pneud.read_log(path)
        >>> log.config.name
        'virtual'

    Raises:
        LogError: no such file, not a log of pneud, of another schema, or of several runs.
    """
    return Log(paths_of(path, *more))
