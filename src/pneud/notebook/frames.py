"""A log's ticks for the libraries of tables: columns in SI units, with unit and meaning beside each.

Each library is loaded when it is asked for, so that none has to be there for the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pneud.log.files.columns import blocks
from pneud.log.files.reader import LogReader
from pneud.log.files.table import Column, TickTable, about
from pneud.rt.extras import extra_of, lack

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    import pyarrow as pa
    import xarray as xr

WORDS = ("state_name", "fault_names")


def require(library: str) -> Any:
    """A library that pneud does not need itself.

    Raises:
        ExtraError: it is missing.
    """
    try:
        return import_module(library)
    except ImportError:
        raise lack("this", extra_of(library), [library]) from None


def columns(log: LogReader, wanted: Sequence[str] | None = None) -> dict[str, Column]:
    """Columns of all ticks by name; None for all that there are.

    Raises:
        KeyError: there is no column of a name.
    """
    made = TickTable(log)
    parts: dict[str, list[Column]] = {}
    for block in blocks(log):
        if not len(block.number):
            continue
        found = made.columns(block)
        if wanted is not None and (unknown := [name for name in wanted if name not in found]):
            raise KeyError(f"{unknown[0]} is none of the columns {', '.join(found)}")
        for name in found if wanted is None else wanted:
            parts.setdefault(name, []).append(found[name])
    return {name: np.concatenate(some) for name, some in parts.items()}


def names(log: LogReader) -> list[str]:
    """Of all columns; none where the log has no tick."""
    made = TickTable(log)
    return next(([*made.columns(block)] for block in blocks(log) if len(block.number)), [])


def units(of: Sequence[str]) -> dict[str, str]:
    """Units by name, of the columns that have one."""
    return {name: unit for name in of if (unit := about(name)["unit"])}


def descriptions(of: Sequence[str]) -> dict[str, str]:
    """Meanings by name."""
    return {name: about(name)["description"] for name in of}


def to_pandas(found: dict[str, Column], facts: dict[str, str]) -> pd.DataFrame:
    """A frame; `attrs` has `units`, `descriptions` and what the log says of its run."""
    pandas = require("pandas")
    words = {name: pandas.Categorical(found[name]) for name in WORDS if name in found}
    frame: pd.DataFrame = pandas.DataFrame({**found, **words})
    frame.attrs = {"units": units([*found]), "descriptions": descriptions([*found]), **facts}
    return frame


def to_polars(found: dict[str, Column]) -> pl.DataFrame:
    """A frame; polars keeps no units, the names of the columns do."""
    polars = require("polars")
    frame: pl.DataFrame = polars.DataFrame(
        {
            name: polars.Series(name, column.tolist(), dtype=polars.String) if name in WORDS else column
            for name, column in found.items()
        }
    )
    return frame


def to_arrow(found: dict[str, Column], facts: dict[str, str]) -> pa.Table:
    """A table; each field's metadata has `unit` and `description`, the schema's what the log says."""
    arrow = require("pyarrow")
    table: pa.Table = arrow.table(found)
    fields = [field.with_metadata(about(field.name)) for field in table.schema]
    return table.cast(arrow.schema(fields, metadata=facts))


def to_xarray(found: dict[str, Column], facts: dict[str, str]) -> xr.Dataset:
    """A data set over the coordinate `t_s`; variables have `units` and `long_name`."""
    xarray = require("xarray")
    variables = {}
    for name, column in found.items():
        told = about(name)
        attrs = {"units": told["unit"], "long_name": told["description"]}
        variables[name] = ("t_s", column, {key: text for key, text in attrs.items() if text})
    t_s = variables.pop("t_s")
    dataset: xr.Dataset = xarray.Dataset(variables, coords={"t_s": t_s}, attrs=facts)
    return dataset
