# SPDX-License-Identifier: Apache-2.0
"""Anybody's track against a log's reference: errors, consistency, coverage."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.align import reference
from abyssnav.compare import describe
from abyssnav.errors import ReadError
from abyssnav.geometry import geodetic_to_enu, interpolate
from abyssnav.profile import load_profile
from abyssnav.read import read_optional
from abyssnav.tables import Bool, Float, Int, Log, Reference, Table, in_order

#: χ² of two degrees of freedom at 95 %.
_CHI2_95 = 5.991464547107979
#: A hole in the reference or the track: so many of its usual steps, and at least so long.
_STEPS, _HOLE_S = 5.0, 5.0
#: Farther off than this on the whole, a track is in another frame.
_OTHER_FRAME_M = 1000.0
#: Units of a number of time since 1970, by the size that it has today: from, per second.
_UNITS = ((1e17, 1), (1e14, 1_000), (1e11, 1_000_000), (0.0, 1_000_000_000))
_TUM_COLUMNS = 8


@dataclass(frozen=True, eq=False)
class GivenTrack(Table):
    """A track from a file, sorted by time."""

    time_ns: Int
    position_enu_m: Float  #: (n, 2) east, north
    position_cov_m2: Float  #: (n, 2, 2); NaN where the file gives none


@dataclass(frozen=True)
class TrackScore:
    """Horizontal errors of a track, and what it claimed of them."""

    n: int  #: positions that could be compared
    mean_m: float
    std_m: float
    rms_m: float
    median_m: float
    p95_m: float
    max_m: float
    nees: float | None  #: mean of eᵀ P⁻¹ e, 2 when exact; None without a covariance
    inside_95: float | None  #: share within their own 95 % ellipse
    remarks: tuple[str, ...]  #: what was left out, and what looks odd

    def plain(self) -> dict[str, Any]:
        """The score for JSON; what there is no number for is left out."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        known = {name: value for name, value in values.items() if value is not None}
        return known | {"remarks": list(self.remarks)}


def score(log_path: Path, track_path: Path) -> TrackScore:
    """Score a track at its own instants against the log's reference, interpolated there.

    Parameters
    ----------
    track_path : CSV or Parquet with the columns of `tracks.parquet` (`time` and `east_m`,
        `north_m`, or `latitude_deg`, `longitude_deg`; a covariance where it has one), or TUM

    Raises
    ------
    ReadError
        A log without reference, a file that is no track, or one without any instant that the
        reference covers.
    """
    log = read_optional([log_path], load_profile(), ("reference", "beacons"))
    truth = reference(log)
    if truth is None:
        raise ReadError(f"{log_path.name}: no reference to score against")
    track, remarks = load_track(track_path, log)
    return _scored(track, truth, remarks, track_path.name)


def _scored(track: GivenTrack, truth: Reference, remarks: list[str], name: str) -> TrackScore:
    start_ns = int(truth.time_ns[0])
    t_s, truth_s = (track.time_ns - start_ns) / 1e9, (truth.time_ns - start_ns) / 1e9
    covered = _is_covered(t_s, truth_s)
    if not covered.any():
        ends = [np.datetime64(int(ns), "ns").astype("M8[s]") for ns in track.time_ns[[0, -1]]]
        known = [np.datetime64(int(ns), "ns").astype("M8[s]") for ns in truth.time_ns[[0, -1]]]
        raise ReadError(
            f"{name}: no position between {known[0]} and {known[1]}, where the reference is; "
            f"the track runs from {ends[0]} to {ends[1]}"
        )
    if not covered.all():
        n_outside = int(np.sum(~covered))
        remarks.append(f"{n_outside} of {len(track)} positions where no reference is: left out")
    inside = track[covered]
    true_m = interpolate(t_s[covered], truth_s, truth.position_enu_m[:, :2])
    error_m = inside.position_enu_m - true_m
    remarks += [*_holes(t_s[covered], truth_s), *_frame(error_m)]
    nees, n_without = _normalized(error_m, inside.position_cov_m2)
    if n_without:
        remarks.append(
            "no covariance" if len(nees) == 0 else f"{n_without} positions without a covariance"
        )
    return TrackScore(
        n=len(inside),
        **describe(np.hypot(*error_m.T)),
        nees=float(nees.mean()) if len(nees) else None,
        inside_95=float(np.mean(nees <= _CHI2_95)) if len(nees) else None,
        remarks=tuple(remarks),
    )


def _is_covered(t_s: Float, truth_s: Float) -> Bool:
    """Whether the reference is known at each instant: within it, and in none of its holes."""
    right = np.clip(np.searchsorted(truth_s, t_s), 1, max(len(truth_s) - 1, 1))
    if len(truth_s) == 1:
        return np.asarray(t_s == truth_s[0])
    hole = np.diff(truth_s)[right - 1] > _longest_step(truth_s)
    exact = np.isin(t_s, truth_s)
    within = (t_s >= truth_s[0]) & (t_s <= truth_s[-1])
    return np.asarray(within & (exact | ~hole))


def _longest_step(t_s: Float) -> float:
    return max(_STEPS * float(np.median(np.diff(t_s))), _HOLE_S)


def _holes(t_s: Float, truth_s: Float) -> list[str]:
    """What share of the reference's time the track covers, where it is not all of it."""
    if len(t_s) < 2:
        return []
    step_s = np.diff(t_s)
    known_s = float(np.sum(step_s[step_s <= _longest_step(t_s)]))
    share = known_s / float(truth_s[-1] - truth_s[0])
    return [] if share > 0.995 else [f"covers {100 * share:.0f} % of the reference's time"]


def _frame(error_m: Float) -> list[str]:
    east_m, north_m = np.median(error_m, axis=0).tolist()
    if np.hypot(east_m, north_m) < _OTHER_FRAME_M:
        return []
    return [
        f"{east_m:+,.0f} m east and {north_m:+,.0f} m north of the reference on the whole: "
        "another frame or origin?"
    ]


def _normalized(error_m: Float, cov_m2: Float) -> tuple[Float, int]:
    """Error squared over its covariance where there is one, and how many have none."""
    variance = np.diagonal(cov_m2, axis1=1, axis2=2)
    determinant = variance[:, 0] * variance[:, 1] - cov_m2[:, 0, 1] ** 2
    with np.errstate(invalid="ignore"):
        usable = np.all(variance > 0, axis=1) & (determinant > 0)
    weighted = np.linalg.solve(cov_m2[usable], error_m[usable, :, None])[..., 0]
    return np.sum(error_m[usable] * weighted, axis=1), int(np.sum(~usable))


# --- the track's file ---------------------------------------------------------------------------


def load_track(path: Path, log: Log) -> tuple[GivenTrack, list[str]]:
    """Track of a file by its suffix, and what was left out of it.

    Parameters
    ----------
    log : whose origin places a track of latitudes and longitudes

    Raises
    ------
    ReadError
        As of `score`.
    """
    columns, remarks = _columns(path)
    if "time" not in columns:
        raise ReadError(f"{path.name}: no column 'time'; columns: {', '.join(columns) or 'none'}")
    time_ns = _nanoseconds(columns["time"], path)
    position_m = _placed(columns, log, path)
    whole = np.isfinite(position_m).all(axis=1)
    if not whole.any():
        raise ReadError(f"{path.name}: no row holds a position")
    if not whole.all():
        remarks.append(f"{int(np.sum(~whole))} rows without a position: left out")
    rows = np.flatnonzero(whole)[np.argsort(time_ns[whole], kind="stable")]
    if np.any(np.diff(rows) < 0):
        remarks.append("rows out of order: sorted by time")
    return GivenTrack(time_ns[rows], position_m[rows], _covariance(columns)[rows]), remarks


def _columns(path: Path) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Columns of the file, one method's rows; remarks."""
    if not path.is_file():
        raise ReadError(f"{path}: no such file")
    if path.suffix in (".tum", ".txt"):
        return _tum(path), []
    import pyarrow as pa
    import pyarrow.csv as pa_csv
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path) if path.suffix == ".parquet" else pa_csv.read_csv(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise ReadError(f"{path.name}: no table: {str(error).splitlines()[0]}") from None
    columns = {name: _values(table[name]) for name in table.column_names}
    methods = columns.get("method", np.zeros(0))
    names = in_order({str(name) for name in methods})
    if len(names) < 2:
        return columns, []
    taken = "smoother" if "smoother" in names else names[-1]
    kept = methods.astype(str) == taken
    remarks = [f"of its methods {', '.join(names)}, {taken} is scored"]
    return {name: column[kept] for name, column in columns.items()}, remarks


def _values(column: Any) -> NDArray[Any]:
    import pyarrow as pa

    if pa.types.is_timestamp(column.type):
        return np.asarray(column.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy())
    return np.asarray(column.to_numpy())


def _tum(path: Path) -> dict[str, NDArray[Any]]:
    """`timestamp x y z qx qy qz qw`, x to the east and y to the north."""
    lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
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


def _nanoseconds(time: NDArray[Any], path: Path) -> Int:
    """Times as UTC nanoseconds: stamps, or numbers of s, ms, µs or ns since 1970 by their size."""
    if time.dtype.kind not in "if" or not len(time):
        raise ReadError(f"{path.name}: column 'time' holds no times")
    per_unit = next(ns for least, ns in _UNITS if np.nanmedian(np.abs(time)) >= least)
    if time.dtype.kind == "i":
        return np.asarray(time * per_unit, dtype=np.int64)
    if not np.isfinite(time).all():
        raise ReadError(f"{path.name}: column 'time' has rows without a time")
    return np.round(time * per_unit).astype(np.int64)


def _placed(columns: Mapping[str, NDArray[Any]], log: Log, path: Path) -> Float:
    """Positions (n, 2) east, north."""
    if {"east_m", "north_m"} <= columns.keys():
        return np.column_stack([columns["east_m"], columns["north_m"]]).astype(float)
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
    latitude_deg, longitude_deg = columns["latitude_deg"], columns["longitude_deg"]
    height_m = -columns.get("depth_m", np.zeros(len(latitude_deg)))
    place = geodetic_to_enu(origin_deg[0], origin_deg[1], latitude_deg, longitude_deg, height_m)
    return place[:, :2]


def _covariance(columns: Mapping[str, NDArray[Any]]) -> Float:
    """Covariances (n, 2, 2) of east and north; NaN where the file gives none."""
    unknown = np.full(len(columns["time"]), np.nan)
    sigma_m = [columns.get(f"sigma_{axis}_m", unknown) for axis in ("east", "north")]
    mixed = columns.get("cov_east_north_m2", np.zeros(len(unknown)))
    rows = [sigma_m[0] ** 2, mixed, mixed, sigma_m[1] ** 2]
    return np.column_stack(rows).astype(float).reshape(-1, 2, 2)
