"""The table of all rows in its file: Parquet, or CSV, both read by whatever reads tables.

What is in it already stays as it is: rows of a log are taken out as a whole, and new ones come behind the
rest.
"""

from __future__ import annotations

import csv
import datetime
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pneud.farm.rows import TYPES, Row
from pneud.log.files.naming import LogError
from pneud.log.format.meanings import unit_of
from pneud.rt.extras import cure
from pneud.rt.outputs import replacing

SUFFIXES = (".parquet", ".csv")


class Known(NamedTuple):
    """A log that has rows."""

    bytes: int
    changed_ns: int
    summary: int
    run: str
    part: int
    ticks: int


_KNOWN = ("log", *Known._fields)


def column_of(name: str) -> str:
    """What a field is called in the table, where instants are instants."""
    return name.removesuffix("_ns") if name in INSTANTS else name


INSTANTS = ("log_begun_ns", "begun_ns")
COLUMNS = tuple(map(column_of, Row._fields))


class ParquetStore:
    """A Parquet file, by pyarrow."""

    def __init__(self, path: Path) -> None:
        """A file that need not be there yet.

        Raises:
            LogError: it is no summary of logs.
            ImportError: pyarrow is missing.
        """
        import pyarrow as pa  # noqa: PLC0415  (an extra)
        import pyarrow.parquet as pq  # noqa: PLC0415

        self.path, self._pa, self._pq = path, pa, pq
        fields = [
            pa.field(column_of(name), self._type(name), metadata={"unit": unit_of(name)})
            for name in Row._fields
        ]
        self._schema = pa.schema(fields)
        self._table = self._schema.empty_table()
        if path.exists():
            self._table = self._read()

    def _type(self, name: str) -> Any:
        pa, of = self._pa, TYPES[name]
        if name in INSTANTS:
            return pa.timestamp("us", tz="UTC")
        kinds = ((bool, pa.bool_()), (int, pa.int64()), (float, pa.float64()), (str, pa.string()))
        return next(found for kind, found in kinds if of in (kind, kind | None))

    def _read(self) -> Any:
        pa, path = self._pa, self.path
        try:
            table = self._pq.read_table(path)
        except (pa.ArrowInvalid, OSError) as e:
            raise LogError(f"{path}: cannot be read as Parquet: {str(e).splitlines()[0]}") from None
        _check(path, table.column_names)
        missing = [field for field in self._schema if field.name not in table.column_names]
        for field in missing:
            table = table.append_column(field, pa.nulls(len(table), field.type))
        return table.select(self._schema.names).cast(self._schema)

    def known(self) -> dict[str, Known]:
        """The logs that are in it."""
        import pyarrow.compute as pc  # noqa: PLC0415

        motion = self._table.column("motion")  # each log has a first one, or none
        firsts = self._table.filter(pc.or_(pc.is_null(motion), pc.equal(pc.fill_null(motion, 0), 1)))
        rows = zip(*(firsts.column(name).to_pylist() for name in _KNOWN), strict=True)
        return {log: Known(*rest) for log, *rest in rows}

    def change(self, without: Iterable[str], rows: Sequence[Row]) -> None:
        """Take the rows of some logs out and put new ones behind the rest."""
        import pyarrow.compute as pc  # noqa: PLC0415

        pa, table = self._pa, self._table
        gone = pc.is_in(table.column("log"), value_set=pa.array(sorted(without), pa.string()))
        columns = (
            pa.array(_instants(name, column), field.type)
            for name, column, field in zip(Row._fields, zip(*rows, strict=True), self._schema, strict=False)
        )
        new = pa.table(list(columns), schema=self._schema) if rows else self._schema.empty_table()
        self._table = pa.concat_tables([table.filter(pc.invert(gone)), new])

    def save(self) -> int:
        """Write it, whole or not at all.

        Returns:
            How many motions are in it.

        Raises:
            OSError: it cannot be written.
        """
        with replacing(self.path) as beside:
            self._pq.write_table(self._table, beside, compression="zstd")
        return self.motions()

    def motions(self) -> int:
        """How many are in it."""
        return len(self._table) - int(self._table.column("motion").null_count)


def _instants(name: str, column: Sequence[Any]) -> Sequence[Any]:
    return [None if ns is None else ns // 1000 for ns in column] if name in INSTANTS else column


class CsvStore:
    """A CSV file."""

    def __init__(self, path: Path) -> None:
        """A file that need not be there yet.

        Raises:
            LogError: it is no summary of logs.
        """
        self.path = path
        self._rows: list[list[str]] = []
        if not path.exists():
            return
        with path.open(encoding="utf-8", newline="") as file:
            lines = csv.reader(file)
            try:
                names = next(lines, [])
                _check(path, names)
                places = {name: names.index(name) for name in COLUMNS if name in names}
                self._rows = [
                    [line[places[name]] if name in places else "" for name in COLUMNS] for line in lines
                ]
            except (csv.Error, UnicodeDecodeError, IndexError) as e:
                raise LogError(f"{path}: cannot be read as CSV: {e}") from None

    def known(self) -> dict[str, Known]:
        """As of `ParquetStore`.

        Raises:
            LogError: a line is none of a summary.
        """
        places = [COLUMNS.index(name) for name in _KNOWN]
        found = {}
        for row in self._rows:
            log, size, changed, summary, run, part, ticks = (row[place] for place in places)
            try:
                found[log] = Known(int(size), int(changed), int(summary), run, int(part), int(ticks))
            except ValueError as e:
                raise LogError(f"{self.path}: a line of {log} is none of a summary: {e}") from None
        return found

    def change(self, without: Iterable[str], rows: Sequence[Row]) -> None:
        """As of `ParquetStore`."""
        gone, place = set(without), COLUMNS.index("log")
        self._rows = [row for row in self._rows if row[place] not in gone]
        self._rows += [list(map(_text, Row._fields, row)) for row in rows]

    def save(self) -> int:
        """As of `ParquetStore`."""
        with replacing(self.path) as beside, beside.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows(self._rows)
        return self.motions()

    def motions(self) -> int:
        """As of `ParquetStore`."""
        place = COLUMNS.index("motion")
        return sum(row[place] != "" for row in self._rows)


def _text(name: str, value: Any) -> str:
    if value is None:
        return ""
    if name in INSTANTS:
        seconds, ns = divmod(value, 10**9)
        when = datetime.datetime.fromtimestamp(seconds, datetime.UTC).replace(microsecond=ns // 1000)
        return when.isoformat(timespec="microseconds").replace("+00:00", "Z")
    return str(value).lower() if isinstance(value, bool) else str(value)


def _check(path: Path, names: Sequence[str]) -> None:
    if lacking := [name for name in _KNOWN if name not in names]:
        raise LogError(
            f"{path}: is there, and no summary of logs (no column {lacking[0]}); name another file"
        )


def store_of(path: Path) -> tuple[ParquetStore | CsvStore, str]:
    """The store for a file, and why it is another one than was asked for.

    Raises:
        LogError: what is there is no summary of logs.
    """
    if path.suffix == ".csv":
        return CsvStore(path), ""
    try:
        return ParquetStore(path), ""
    except ImportError:
        other = path.with_suffix(".csv")
        return CsvStore(other), (
            f"{path} needs pyarrow, which is missing: written as {other}; {cure('parquet')}"
        )
