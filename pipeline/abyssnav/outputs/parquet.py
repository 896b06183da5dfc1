# SPDX-License-Identifier: Apache-2.0
"""A solution as Parquet and CSV, by the columns that its tables say they have.

The same solution gives the same bytes: rows in a fixed order, row groups of a fixed size, no wall
clock, host or path inside.  The folder is given; that it appears whole or not at all is `run`'s.
"""

import csv
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from abyssnav.formats.columns import Ragged
from abyssnav.geometry import enu_to_geodetic
from abyssnav.tables import (
    BeaconEstimates,
    Beacons,
    Column,
    Comparison,
    Dive,
    Errors,
    ErrorTables,
    Evaluation,
    Fixes,
    Float,
    GateIntegrity,
    GateStatistics,
    Geodetic,
    Innovations,
    LegAccuracy,
    PositionInnovations,
    Reference,
    Solution,
    Table,
    Track,
    stored_columns,
    to_utc_ns,
)
from abyssnav.version import __version__

if TYPE_CHECKING:
    import pyarrow as pa

_ROW_GROUP: Final = 1 << 17
#: Numbers by their first bytes, their second ..., and differences of times, pack a quarter smaller
#: and twice as fast.
_ENCODING: Final = {"number": "BYTE_STREAM_SPLIT", "time": "DELTA_BINARY_PACKED"}
#: A text column as places in a list of words.
_Words = tuple[NDArray[np.integer[Any]], Sequence[str]]
Rows = Mapping[str, NDArray[Any] | _Words]
#: A row group: texts that are the same in all its rows, and its other columns.
_Part = tuple[Mapping[str, str], Rows]


class File(NamedTuple):
    """What a Parquet file holds: a row of it, the tables it is made of, what stands before them."""

    row: str
    tables: tuple[type[Table], ...]
    keys: tuple[Column, ...] = ()

    def columns(self) -> list[Column]:
        """All columns in order, the dive's name first."""
        return [_DIVE, *self.keys, *(c for t in self.tables for _, c in stored_columns(t))]


_DIVE: Final = Column("dive", "", "name of the dive, the same in all rows", "text")
_METHOD: Final = Column("method", "", "method that made the row", "text")
_REFERENCE: Final = Column("reference", "", "fix or truth", "text")
#: File's stem -> what is in it.  A number that does not exist is null; no column holds NaN.
FILES: Final = {
    "tracks": File(
        "one position of one method; rising time within a method", (Track, Geodetic), (_METHOD,)
    ),
    "fixes": File("one least-squares position of one cycle", (Fixes,)),
    "innovations": File(
        "one reply as one method met it; none left out", (Innovations,), (_METHOD,)
    ),
    "positions": File(
        "one position of another kind, GNSS or USBL, as one method met it",
        (PositionInnovations,),
        (_METHOD,),
    ),
    "statistics": File(
        "what one method's gate did with one beacon's replies", (GateStatistics,), (_METHOD,)
    ),
    "gate": File(
        "what one method's gate could detect of one beacon in one stretch of time",
        (GateIntegrity,),
        (_METHOD,),
    ),
    "accuracy": File(
        "how far one leg of the smoothed track can be trusted, judged without truth", (LegAccuracy,)
    ),
    "beacons": File("one beacon, as stated and as estimated", (Beacons, Geodetic, BeaconEstimates)),
    "reference": File(
        "one position of the log's reference, thinned to the output's rate", (Reference, Geodetic)
    ),
    "comparison": File(
        "horizontal distance of one method to one reference, over the dive", (Comparison,)
    ),
    "errors": File(
        "horizontal distance of one method to one reference at one instant",
        (Errors,),
        (_METHOD, _REFERENCE),
    ),
}


def write_parquet(evaluation: Evaluation, folder: Path, files: Collection[str]) -> None:
    """Those Parquet files that are in `files`, into a folder that exists.

    `positions.parquet` and `reference.parquet` are made where the dive has what is in them.
    """
    solution, reference = evaluation.solution, evaluation.reference
    dive, start_ns = solution.dive, solution.dive.start_ns
    tables: dict[str, Callable[[], Iterable[_Part]]] = {
        "tracks": lambda: _tracks(solution),
        "fixes": lambda: [({}, rows_of(start_ns, solution.fixes))],
        "innovations": lambda: _by_method(start_ns, solution.innovations),
        "statistics": lambda: _by_method(start_ns, solution.statistics),
        "gate": lambda: _by_method(start_ns, solution.watch),
        "accuracy": lambda: [
            ({}, rows_of(start_ns, legs)) for legs in (solution.accuracy,) if legs is not None
        ],
        "beacons": lambda: [({}, beacon_rows(solution))],
        "comparison": lambda: [({}, rows_of(start_ns, evaluation.comparison))],
        "errors": lambda: _errors(evaluation.errors, start_ns),
    }
    if solution.positions:
        tables["positions"] = lambda: _by_method(start_ns, solution.positions)
    if reference is not None:
        tables["reference"] = lambda: [({}, _reference(solution, reference))]
    for name, parts in tables.items():  # one in memory at a time
        if f"{name}.parquet" in files:
            _write(name, parts(), dive, folder / f"{name}.parquet")


def write_csv(comparison: Comparison, dive: Dive, path: Path) -> None:
    """`comparison.csv`, the rows of `comparison.parquet`."""
    rows = rows_of(dive.start_ns, comparison)
    columns = [
        [values[1][place] for place in values[0]] if isinstance(values, tuple) else values.tolist()
        for values in rows.values()
    ]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["dive", *rows])
        writer.writerows([dive.name, *row] for row in zip(*columns, strict=True))


# --- rows -------------------------------------------------------------------------------------


def rows_of(start_ns: int, *tables: Table) -> Rows:
    """Columns of files from tables of as many rows, by what their fields say."""
    rows: dict[str, NDArray[Any] | _Words] = {}
    for table in tables:
        for field, column in stored_columns(type(table)):
            values = getattr(table, field)
            if column.value is not None:
                values = column.value(values)
            if column.words:
                rows[column.name] = (values.astype(np.int64), column.words)
            elif column.kind == "text":
                rows[column.name] = (np.arange(len(values)), values.tolist())
            elif column.kind == "time" and values.dtype.kind == "f":
                rows[column.name] = to_utc_ns(start_ns, values)
            else:
                rows[column.name] = values
    return rows


def geodetic(dive: Dive, position_enu_m: Float) -> Geodetic:
    """Latitude and longitude of places (n, 3) m, ENU; NaN without an origin."""
    if dive.origin is None:
        unknown = np.full(len(position_enu_m), np.nan)
        return Geodetic(unknown, unknown)
    origin = dive.origin
    place = enu_to_geodetic(origin.latitude_deg, origin.longitude_deg, position_enu_m)
    return Geodetic(*place[:2])


def beacon_rows(solution: Solution) -> Rows:
    """The dive's beacons with what the smoother made of them; NaN without it."""
    beacons, estimates = solution.dive.beacons, solution.beacons
    if estimates is None:
        unknown = np.full(len(beacons), np.nan)
        nowhere = np.full((len(beacons), 3), np.nan)
        estimates = BeaconEstimates(beacons.id, nowhere, nowhere, unknown, unknown)
    place = geodetic(solution.dive, beacons.position_enu_m)
    return rows_of(solution.dive.start_ns, beacons, place, estimates)


def _tracks(solution: Solution) -> Iterator[_Part]:
    """A method after the other, each a row group of its own."""
    dive = solution.dive
    for method, track in sorted(solution.tracks.items()):
        place = geodetic(dive, track.position_enu_m)
        yield {"method": method}, rows_of(dive.start_ns, track, place)


def _by_method(start_ns: int, tables: Mapping[str, Table]) -> Iterator[_Part]:
    for method, table in sorted(tables.items()):
        yield {"method": method}, rows_of(start_ns, table)


def _errors(errors: ErrorTables, start_ns: int) -> Iterator[_Part]:
    for (method, reference), table in sorted(errors.items()):
        yield {"method": method, "reference": reference}, rows_of(start_ns, table)


def _reference(solution: Solution, reference: Reference) -> Rows:
    """Every k-th position, about as many as a track has."""
    n_rows = max((len(track) for track in solution.tracks.values()), default=len(reference))
    thin = reference[:: max(1, round(len(reference) / max(n_rows, 1)))]
    return rows_of(solution.dive.start_ns, thin, geodetic(solution.dive, thin.position_enu_m))


# --- files ------------------------------------------------------------------------------------


def _write(name: str, parts: Iterable[_Part], dive: Dive, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = _schema(name, dive)
    columns = FILES[name].columns()
    with pq.ParquetWriter(
        path,
        schema,
        compression="zstd",
        use_dictionary=[c.name for c in columns if c.kind == "text"],
        column_encoding={c.name: _ENCODING[c.kind] for c in columns if c.kind in _ENCODING},
    ) as writer:
        for texts, rows in parts:
            arrays = {name: _arrow(rows[name], schema.field(name).type) for name in rows}
            length = len(next(iter(arrays.values())))
            constants = {"dive": dive.name, **texts}
            arrays |= {name: _constant(text, length) for name, text in constants.items()}
            writer.write_table(pa.table(arrays, schema=schema), _ROW_GROUP)


def _schema(name: str, dive: Dive) -> "pa.Schema":
    """Fields with unit and meaning; who made the file, and in which frame its places are."""
    import pyarrow as pa

    kinds = {
        "text": pa.string(),
        "time": pa.timestamp("ns", tz="UTC"),
        "integer": pa.int64(),
        "number": pa.float64(),
        "flag": pa.bool_(),
    }
    origin = dive.origin
    metadata = {
        "abyssnav_version": __version__,
        "origin": f"{origin.latitude_deg!r},{origin.longitude_deg!r}" if origin else "none",
        "frame": "ENU",
        "table": name,
        "row": FILES[name].row,
    }
    described = [
        pa.field(c.name, kinds[c.kind], metadata={"unit": c.unit, "meaning": c.meaning})
        for c in FILES[name].columns()
    ]
    return pa.schema(described, metadata=metadata)


def _constant(text: str, length: int) -> "pa.Array":
    """The same text in each row; not `pa.repeat`, which imports pandas as `pa.array` does."""
    import pyarrow as pa

    letters = text.encode()
    ends = len(letters) * np.arange(length + 1, dtype=np.int32)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(letters * length)]
    return pa.Array.from_buffers(pa.string(), length, buffers)


def _arrow(column: NDArray[Any] | _Words, kind: "pa.DataType") -> "pa.Array":
    """Arrow array over a NumPy column's memory, NaN as null.

    Not `pa.array`, which imports pandas when it is installed: over a second; nor Arrow's decoding
    of a dictionary, which imports all of Arrow's functions.
    """
    import pyarrow as pa

    if isinstance(column, tuple):
        places, words = column
        text = Ragged.from_bytes([word.encode() for word in words])[places]
        ends, letters = text.offsets.astype(np.int32), np.ascontiguousarray(text.content)
        buffers = [None, pa.py_buffer(ends), pa.py_buffer(letters)]
        return pa.Array.from_buffers(kind, len(places), buffers)
    if pa.types.is_boolean(kind):
        bits = pa.py_buffer(np.packbits(column, bitorder="little"))
        return pa.Array.from_buffers(kind, len(column), [None, bits])
    stored = np.ascontiguousarray(column, np.float64 if pa.types.is_floating(kind) else np.int64)
    known = ~np.isnan(stored) if pa.types.is_floating(kind) else np.ones(0, bool)
    valid = None if known.all() else pa.py_buffer(np.packbits(known, bitorder="little"))
    return pa.Array.from_buffers(kind, len(stored), [valid, pa.py_buffer(stored)])
