# SPDX-License-Identifier: Apache-2.0
"""Files of other people: tracks by their suffix, and what became of each reply."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.geometry import geodetic_to_enu
from abyssnav.results import chosen_methods
from abyssnav.tables import Bool, Float, Int, Log, Table, in_order

#: Units of a number of time since 1970, by the size that it has today: from, per second.
_UNITS = ((1e17, 1), (1e14, 1_000), (1e11, 1_000_000), (0.0, 1_000_000_000))
_TUM_COLUMNS = 8
#: Files that hold a track.
TRACK_SUFFIXES = (".parquet", ".csv", ".tum", ".txt")


@dataclass(frozen=True, eq=False)
class GivenTrack(Table):
    """A track from a file, sorted by time."""

    time_ns: Int
    position_enu_m: Float  #: (n, 2) east, north
    position_cov_m2: Float  #: (n, 2, 2); NaN where the file gives none


@dataclass(frozen=True, eq=False)
class Decisions(Table):
    """Whether each reply moved the estimate."""

    ping_id: Int
    beacon_id: Int
    travel_time_s: Float
    accepted: Bool


def load_track(
    path: Path, log: Log, method: str | None = None
) -> tuple[GivenTrack, list[str], str | None]:
    """Track of a file by its suffix, what was left out of it, and whose of several it is.

    Parameters
    ----------
    log : whose origin places a track of latitudes and longitudes
    method : which of a file that holds several; not given: the smoother's, or the last

    Raises
    ------
    ReadError
        A file that is no track: no table, no times, no position, not of that method.
    """
    columns, remarks, method = _columns(path, method)
    if "time" not in columns:
        raise ReadError(f"{path.name}: no column 'time'; columns: {', '.join(columns) or 'none'}")
    time_ns, timed = _nanoseconds(columns["time"], path)
    position_m = _placed(columns, log, path)
    whole = timed & np.isfinite(position_m).all(axis=1)
    if not timed.all():
        remarks.append(f"{int(np.sum(~timed))} rows without a time: left out")
    if not whole.any():
        raise ReadError(f"{path.name}: no row holds a position")
    if np.any(timed & ~whole):
        remarks.append(f"{int(np.sum(timed & ~whole))} rows without a position: left out")
    rows = np.flatnonzero(whole)[np.argsort(time_ns[whole], kind="stable")]
    if np.any(np.diff(rows) < 0):
        remarks.append("rows out of order: sorted by time")
    return GivenTrack(time_ns[rows], position_m[rows], _covariance(columns)[rows]), remarks, method


def load_decisions(track_path: Path, method: str | None) -> Decisions | None:
    """What became of each reply, from a file beside the track; None where there is none.

    That is `innovations.parquet` beside `tracks.parquet`, else `<track>.decisions.csv` or
    `.parquet`, with the columns `ping_id`, `beacon_id`, `travel_time_s` and `accepted`.  Replies
    before the start (`decision` says `before_start`) met no gate and are left out.

    Raises
    ------
    ReadError
        The file is no such table.
    """
    names = [f"{track_path.stem}.decisions{suffix}" for suffix in (".parquet", ".csv")]
    if track_path.name == "tracks.parquet":
        names.append("innovations.parquet")
    path = next((p for name in names if (p := track_path.with_name(name)).is_file()), None)
    if path is None:
        return None
    columns, _, _ = _columns(path, method)
    known = ("ping_id", "beacon_id", "travel_time_s", "accepted")
    missing = [name for name in known if name not in columns]
    if missing:
        raise ReadError(f"{path.name}: no column '{missing[0]}'; columns: {', '.join(columns)}")
    decision = columns.get("decision", np.zeros(len(columns["accepted"]))).astype(str)
    met = decision != "before_start"
    try:
        ping_id, beacon_id = (columns[name][met].astype(np.int64) for name in known[:2])
        accepted = columns["accepted"][met].astype(bool)
    except (TypeError, ValueError) as error:
        raise ReadError(f"{path.name}: {error}") from None
    return Decisions(ping_id, beacon_id, _numbers(columns["travel_time_s"])[met], accepted)


def _columns(
    path: Path, method: str | None
) -> tuple[dict[str, NDArray[Any]], list[str], str | None]:
    """Columns of the file, one method's rows; remarks; that method where it says one."""
    if not path.is_file():
        raise ReadError(f"{path}: no such file")
    if path.suffix in (".tum", ".txt"):
        return _tum(path), [], None
    import pyarrow as pa
    import pyarrow.csv as pa_csv
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path) if path.suffix == ".parquet" else pa_csv.read_csv(path)
    except (OSError, pa.ArrowException) as error:
        raise ReadError(f"{path.name}: no table: {str(error).splitlines()[0]}") from None
    columns = {name: _values(table[name]) for name in table.column_names}
    methods = columns.get("method", np.zeros(0)).astype(str)
    names = in_order(set(methods.tolist()))
    if not names and method is None:
        return columns, [], None
    (taken,) = chosen_methods(names, [method] if method else [], path.name)
    chosen = method is None and len(names) > 1
    remarks = [f"of its methods {', '.join(names)}, {taken} is scored"] if chosen else []
    kept = methods == taken
    return {name: column[kept] for name, column in columns.items()}, remarks, taken


def _values(column: Any) -> NDArray[Any]:
    """Values of a column: stamps as UTC nanoseconds, none as the smallest of them."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if pa.types.is_timestamp(column.type):
        stamps = column.cast(pa.timestamp("ns"), safe=False).cast(pa.int64())
        return np.asarray(pc.fill_null(stamps, np.iinfo(np.int64).min).to_numpy())
    return np.asarray(column.to_numpy())


def _numbers(column: NDArray[Any]) -> Float:
    """A column as numbers; NaN where it holds none."""
    if column.dtype.kind in "biuf":
        return column.astype(np.float64)
    import pandas as pd

    return np.asarray(pd.to_numeric(pd.Series(column), errors="coerce"), dtype=np.float64)


def _tum(path: Path) -> dict[str, NDArray[Any]]:
    """`timestamp x y z qx qy qz qw`, x to the east and y to the north."""
    try:
        lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
    except UnicodeDecodeError:
        raise ReadError(f"{path.name}: not TUM: no text") from None
    rows = [line for line in lines if line and not line[0].startswith("#")]
    if not rows or any(len(row) != _TUM_COLUMNS for row in rows):
        raise ReadError(f"{path.name}: not TUM: rows of {_TUM_COLUMNS} numbers")
    try:
        numbers = np.array([row[1:3] for row in rows], dtype=float)
        seconds = [row[0].partition(".") for row in rows]
        # whole and broken seconds apart: a float of them all steps by a quarter microsecond
        time_ns = [int(s) * 1_000_000_000 + int(f"{ns:0<9}"[:9]) for s, _, ns in seconds]
    except ValueError as error:
        raise ReadError(f"{path.name}: not TUM: {error}") from None
    return {"time": np.array(time_ns), "east_m": numbers[:, 0], "north_m": numbers[:, 1]}


def _nanoseconds(time: NDArray[Any], path: Path) -> tuple[Int, Bool]:
    """Times as UTC nanoseconds, and which rows have one.

    Stamps, or numbers of s, ms, µs or ns since 1970 by their size.
    """
    if time.dtype.kind not in "if" or not len(time):
        raise ReadError(f"{path.name}: column 'time' holds no times")
    timed = np.isfinite(time) & (time != np.iinfo(np.int64).min)
    if not timed.any():
        raise ReadError(f"{path.name}: column 'time' holds no times")
    size = float(np.median(np.abs(time[timed])))
    per_unit = next(ns for least, ns in _UNITS if size >= least)
    if time.dtype.kind == "i":
        return np.where(timed, time, 0) * per_unit, timed
    return np.round(np.where(timed, time, 0.0) * per_unit).astype(np.int64), timed


def _placed(columns: Mapping[str, NDArray[Any]], log: Log, path: Path) -> Float:
    """Positions (n, 2) east, north; NaN where a row holds none."""
    if {"east_m", "north_m"} <= columns.keys():
        return np.column_stack([_numbers(columns["east_m"]), _numbers(columns["north_m"])])
    if not {"latitude_deg", "longitude_deg"} <= columns.keys():
        raise ReadError(
            f"{path.name}: neither east_m and north_m nor latitude_deg and longitude_deg; "
            f"columns: {', '.join(columns)}"
        )
    beacons = log.roles.get("beacons", {})
    origin_deg = [
        float(beacons[f"origin_{axis}_deg"][0]) if beacons else np.nan
        for axis in ("latitude", "longitude")
    ]
    if not np.isfinite(origin_deg).all():
        raise ReadError(f"{path.name}: by latitude and longitude, and {log.name} has no origin")
    latitude_deg = _numbers(columns["latitude_deg"])
    longitude_deg = _numbers(columns["longitude_deg"])
    depth_m = _numbers(columns.get("depth_m", np.zeros(len(latitude_deg))))
    place = geodetic_to_enu(
        origin_deg[0], origin_deg[1], latitude_deg, longitude_deg, -np.nan_to_num(depth_m)
    )
    return place[:, :2]


def _covariance(columns: Mapping[str, NDArray[Any]]) -> Float:
    """Covariances (n, 2, 2) of east and north; NaN where the file gives none."""
    unknown = np.full(len(columns["time"]), np.nan)
    sigma_m = [_numbers(columns.get(f"sigma_{axis}_m", unknown)) for axis in ("east", "north")]
    mixed = _numbers(columns.get("cov_east_north_m2", np.zeros(len(unknown))))
    rows = [sigma_m[0] ** 2, mixed, mixed, sigma_m[1] ** 2]
    return np.column_stack(rows).reshape(-1, 2, 2)
