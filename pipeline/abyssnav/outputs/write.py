# SPDX-License-Identifier: Apache-2.0
"""Stage write: a solution as Parquet, CSV and MCAP.

The same solution gives the same bytes: rows in a fixed order, row groups of a fixed size, no wall
clock, host or path inside.  The folder is given; that it appears whole or not at all is `run`'s.
"""

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from abyssnav import __version__
from abyssnav.geometry import enu_to_geodetic
from abyssnav.outputs.columns import COLUMNS, ROWS
from abyssnav.outputs.messages import write_messages
from abyssnav.tables import (
    ARRIVALS,
    DECISIONS,
    EXPLANATIONS,
    VERDICTS,
    Comparison,
    Dive,
    Errors,
    Float,
    Int,
    Solution,
    Track,
)

if TYPE_CHECKING:
    import pyarrow as pa

_ROW_GROUP: Final = 1 << 17
#: Numbers by their first bytes, their second ..., and differences of times, pack a quarter smaller
#: and twice as fast.
_ENCODING: Final = {"number": "BYTE_STREAM_SPLIT", "time": "DELTA_BINARY_PACKED"}
#: Columns of a track that stand in the file as they are.
_STATE: Final = ("roll_rad", "pitch_rad", "forward_mps", "starboard_mps", "altitude_m")
_ErrorTables = Mapping[tuple[str, str], Errors]
#: A text column as places in a list of words.
_Words = tuple[NDArray[np.integer[Any]], Sequence[str]]
_Rows = Mapping[str, NDArray[Any] | _Words]


def write(solution: Solution, comparison: Comparison, errors: _ErrorTables, folder: Path) -> None:
    """Parquet files, `comparison.csv` and `solution.mcap`, into a folder that exists.

    Parameters
    ----------
    errors : (method, reference) -> distances over time, for `errors.parquet`
    """
    geodetic = {m: _geodetic(solution.dive, track) for m, track in solution.tracks.items()}
    tables: dict[str, Callable[[], Iterable[_Rows]]] = {
        "tracks": lambda: _tracks(solution, geodetic),
        "fixes": lambda: [_fixes(solution)],
        "innovations": lambda: [_innovations(solution)],
        "statistics": lambda: [_statistics(solution)],
        "gate": lambda: [_gate(solution)],
        "accuracy": lambda: [_accuracy(solution)],
        "comparison": lambda: [_comparison(comparison)],
        "errors": lambda: [_errors(errors, solution.dive.start_ns)],
    }
    for name, parts in tables.items():  # one in memory at a time
        _write_parquet(name, parts(), folder / f"{name}.parquet")
    _write_csv(comparison, folder / "comparison.csv")
    write_messages(solution, geodetic, folder / "solution.mcap")


# --- rows -------------------------------------------------------------------------------------


def _tracks(solution: Solution, geodetic: Mapping[str, tuple[Float, Float]]) -> Iterator[_Rows]:
    """A method after the other, each a row group of its own."""
    for method, track in sorted(solution.tracks.items()):
        latitude_deg, longitude_deg = geodetic[method]
        yield {
            "method": _repeated({method: len(track)}),
            "time": _utc_ns(solution.dive.start_ns, track.t_s),
            **_position(track.position_enu_m, track.position_cov_m2),
            "cov_east_north_m2": track.position_cov_m2[:, 0, 1],
            "heading_rad": track.heading_rad % (2 * np.pi),
            "latitude_deg": latitude_deg,
            "longitude_deg": longitude_deg,
            **{name: getattr(track, name) for name in _STATE},
        }


def _fixes(solution: Solution) -> _Rows:
    fixes = solution.fixes
    return {
        "time": _utc_ns(solution.dive.start_ns, fixes.t_s),
        "ping_id": fixes.ping_id,
        **_position(fixes.position_enu_m, fixes.position_cov_m2),
        "n_replies": fixes.n_replies,
        "rms_s": fixes.rms_s,
        "consistent": fixes.consistent,
    }


def _innovations(solution: Solution) -> _Rows:
    start_ns, by_method = solution.dive.start_ns, dict(sorted(solution.innovations.items()))

    def column(name: str) -> NDArray[Any]:
        return _joined([getattr(table, name) for table in by_method.values()])

    return {
        "method": _repeated({m: len(table) for m, table in by_method.items()}),
        "ping_id": column("ping_id"),
        "beacon_id": column("beacon_id"),
        "ping_time": _utc_ns(start_ns, column("t_ping_s")),
        "time": _utc_ns(start_ns, column("t_reply_s")),
        "travel_time_s": column("travel_time_s"),
        "predicted_s": column("predicted_s"),
        "innovation_s": column("innovation_s"),
        "innovation_sigma_s": column("innovation_sigma_s"),
        "nis": column("nis"),
        "accepted": column("decision") == DECISIONS.index("accepted"),
        "decision": (column("decision").astype(np.int32), DECISIONS),
        "arrival": (column("arrival").astype(np.int32), ARRIVALS),
        "explanation": (column("explanation").astype(np.int32), EXPLANATIONS),
    }


def _statistics(solution: Solution) -> _Rows:
    by_method = dict(sorted(solution.statistics.items()))
    names = [column.name for column in COLUMNS["statistics"][1:-1]]
    return {
        "method": _repeated({m: len(table) for m, table in by_method.items()}),
        **{name: _joined([getattr(t, name) for t in by_method.values()]) for name in names},
        "verdict": _verdicts([t.verdict for t in by_method.values()]),
    }


def _gate(solution: Solution) -> _Rows:
    start_ns, by_method = solution.dive.start_ns, dict(sorted(solution.watch.items()))
    names = [column.name for column in COLUMNS["gate"][1:-1] if column.kind != "time"]
    return {
        "method": _repeated({m: len(table) for m, table in by_method.items()}),
        "begin": _utc_ns(start_ns, _joined([t.t_begin_s for t in by_method.values()])),
        "end": _utc_ns(start_ns, _joined([t.t_end_s for t in by_method.values()])),
        **{name: _joined([getattr(t, name) for t in by_method.values()]) for name in names},
        "verdict": _verdicts([t.verdict for t in by_method.values()]),
    }


def _verdicts(parts: Sequence[Int]) -> _Words:
    return _joined(parts).astype(np.int64), VERDICTS


def _accuracy(solution: Solution) -> _Rows:
    legs = solution.accuracy
    if legs is None:
        return {column.name: np.zeros(0) for column in COLUMNS["accuracy"]}
    return {
        **legs.columns(),
        "begin": _utc_ns(solution.dive.start_ns, legs.t_begin_s),
        "end": _utc_ns(solution.dive.start_ns, legs.t_end_s),
        "course_deg": np.degrees(legs.course_rad),
    }


def _comparison(comparison: Comparison) -> _Rows:
    columns: dict[str, NDArray[Any] | _Words] = dict(comparison.columns())
    for name in ("method", "reference"):
        words = comparison.columns()[name].tolist()
        columns[name] = (np.arange(len(words)), words)
    return columns


def _errors(errors: _ErrorTables, start_ns: int) -> _Rows:
    ordered = dict(sorted(errors.items()))
    lengths = [len(table) for table in ordered.values()]
    place = np.repeat(np.arange(len(ordered)), lengths)
    return {
        "method": (place, [method for method, _ in ordered]),
        "reference": (place, [reference for _, reference in ordered]),
        "time": _utc_ns(start_ns, _joined([table.t_s for table in ordered.values()])),
        "distance_m": _joined([table.distance_m for table in ordered.values()]),
    }


def _position(enu_m: Float, cov_m2: Float) -> dict[str, Float]:
    return {
        "east_m": enu_m[:, 0],
        "north_m": enu_m[:, 1],
        "depth_m": -enu_m[:, 2],
        "sigma_east_m": np.sqrt(cov_m2[:, 0, 0]),
        "sigma_north_m": np.sqrt(cov_m2[:, 1, 1]),
    }


def _geodetic(dive: Dive, track: Track) -> tuple[Float, Float]:
    """Latitude and longitude in degrees; NaN without an origin."""
    if dive.origin is None:
        return np.full(len(track), np.nan), np.full(len(track), np.nan)
    origin = dive.origin
    return enu_to_geodetic(origin.latitude_deg, origin.longitude_deg, track.position_enu_m)[:2]


def _joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    return np.concatenate([np.empty(0, parts[0].dtype if parts else float), *parts])


def _repeated(lengths: Mapping[str, int]) -> _Words:
    return np.repeat(np.arange(len(lengths)), list(lengths.values())), list(lengths)


def _utc_ns(start_ns: int, t_s: Float) -> Int:
    return start_ns + np.rint(np.asarray(t_s) * 1e9).astype(np.int64)


# --- files ------------------------------------------------------------------------------------


def _write_parquet(name: str, parts: Iterable[_Rows], path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {
        "text": pa.string(),
        "time": pa.timestamp("ns", tz="UTC"),
        "integer": pa.int64(),
        "number": pa.float64(),
        "flag": pa.bool_(),
    }
    described = {"abyssnav_version": __version__, "table": name, "row": ROWS[name]}
    schema = pa.schema(
        [
            pa.field(c.name, kinds[c.kind], metadata={"unit": c.unit, "meaning": c.meaning})
            for c in COLUMNS[name]
        ],
        metadata=described,
    )
    with pq.ParquetWriter(
        path,
        schema,
        compression="zstd",
        use_dictionary=[c.name for c in COLUMNS[name] if c.kind == "text"],
        column_encoding={c.name: _ENCODING[c.kind] for c in COLUMNS[name] if c.kind in _ENCODING},
    ) as writer:
        for columns in parts:
            arrays = [_arrow(columns[field.name], field.type) for field in schema]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema), _ROW_GROUP)


def _arrow(column: NDArray[Any] | _Words, kind: "pa.DataType") -> "pa.Array":
    """Arrow array over a NumPy column's memory, NaN as null.

    Not `pa.array`, which imports pandas when it is installed: over a second.
    """
    import pyarrow as pa

    if isinstance(column, tuple):
        places, words = column
        where = _arrow(places, pa.int64())
        return pa.DictionaryArray.from_arrays(where, _text(words)).dictionary_decode()
    if pa.types.is_boolean(kind):
        bits = pa.py_buffer(np.packbits(column, bitorder="little"))
        return pa.Array.from_buffers(kind, len(column), [None, bits])
    stored = np.ascontiguousarray(column, np.float64 if pa.types.is_floating(kind) else np.int64)
    known = ~np.isnan(stored) if pa.types.is_floating(kind) else np.ones(0, bool)
    valid = None if known.all() else pa.py_buffer(np.packbits(known, bitorder="little"))
    return pa.Array.from_buffers(kind, len(stored), [valid, pa.py_buffer(stored)])


def _text(words: Sequence[str]) -> "pa.Array":
    import pyarrow as pa

    encoded = [word.encode() for word in words]
    ends = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(b"".join(encoded))]
    return pa.Array.from_buffers(pa.string(), len(words), buffers)


def _write_csv(comparison: Comparison, path: Path) -> None:
    columns = comparison.columns()
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(columns)
        rows.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
