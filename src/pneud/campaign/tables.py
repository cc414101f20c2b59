"""Rows as a file: Parquet, or CSV where pyarrow is missing."""

from __future__ import annotations

import csv
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path

from pneud.campaign.unit import Row
from pneud.rt.outputs import replacing

NAME = "rows"
LACKS = "rows are written as CSV; for Parquet: pip install 'pneud[parquet]'"


def parquet() -> bool:
    """Whether Parquet can be written here."""
    return importlib.util.find_spec("pyarrow") is not None


def write(folder: Path, columns: Mapping[str, type], rows: Sequence[Row]) -> Path:
    """Write the rows; the same rows, the same bytes.

    Args:
        folder: where to.
        columns: and the kind of value in each.
        rows: in their order.

    Returns:
        The file.

    Raises:
        OSError: it cannot be written.
    """
    path = folder / f"{NAME}.{'parquet' if parquet() else 'csv'}"
    with replacing(path) as beside:
        (_parquet if path.suffix == ".parquet" else _csv)(beside, columns, rows)
    return path


def _csv(path: Path, columns: Mapping[str, type], rows: Sequence[Row]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([row[name] for name in columns] for row in rows)


def _parquet(path: Path, columns: Mapping[str, type], rows: Sequence[Row]) -> None:
    import pyarrow as pa  # noqa: PLC0415 - an extra
    import pyarrow.parquet as pq  # noqa: PLC0415

    kinds = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in columns.items()])
    cells = {name: [_as(kind, row[name]) for row in rows] for name, kind in columns.items()}
    pq.write_table(pa.table(cells, schema), path, compression="zstd")


def _as(kind: type, value: object) -> object:
    return value if value is None else kind(value)
