"""Rows as a file: Parquet, or CSV where pyarrow is missing."""

from __future__ import annotations

import csv
from pathlib import Path

from pneud.campaign.rows import Rows
from pneud.rt.extras import cure, missing
from pneud.rt.outputs import replacing

NAME = "rows"
LACKS = f"rows are written as CSV; for Parquet: {cure('parquet')}"


def parquet() -> bool:
    """Whether Parquet can be written here."""
    return not missing("parquet")


def write(folder: Path, rows: Rows) -> Path:
    """Write the rows; the same rows, the same bytes.

    Args:
        folder: where to.
        rows: all of them.

    Returns:
        The file.

    Raises:
        OSError: it cannot be written.
    """
    path = folder / f"{NAME}.{'parquet' if parquet() else 'csv'}"
    with replacing(path) as beside:
        (_parquet if path.suffix == ".parquet" else _csv)(beside, rows)
    return path


def _csv(path: Path, rows: Rows) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(rows.columns)
        writer.writerows(row.values() for row in rows)


def _parquet(path: Path, rows: Rows) -> None:
    import pyarrow as pa  # noqa: PLC0415 - an extra
    import pyarrow.parquet as pq  # noqa: PLC0415

    kinds = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in rows.columns.items()])
    cells = [pa.array(rows.column(field.name), field.type, from_pandas=True) for field in schema]
    pq.write_table(pa.Table.from_arrays(cells, schema=schema), path, compression="zstd")
