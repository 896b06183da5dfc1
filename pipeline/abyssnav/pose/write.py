# SPDX-License-Identifier: Apache-2.0
"""Poses as CSV or Parquet, and as the reference file that photogrammetry takes."""

import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np

from abyssnav.errors import ConfigError
from abyssnav.pose.instants import Instants
from abyssnav.pose.interpolate import Poses, geodetic_of
from abyssnav.tables import Geodetic, Int, stored_columns, utc_text
from abyssnav.version import __version__
from abyssnav.workers import cores

if TYPE_CHECKING:
    import pyarrow as pa

_ROWS_OF_TEXT: Final = 1 << 14


def write_poses(poses: Poses, path: Path | None) -> None:
    """The columns of `tracks.parquet` without `dive` and `method`, and `inside`.

    Radians and metres in CSV too; what does not exist is null, or empty.

    Parameters
    ----------
    path : .parquet or .csv; standard output, as CSV, if not given

    Raises
    ------
    ConfigError
        Another suffix.
    """
    if path is not None and path.suffix not in (".csv", ".parquet"):
        raise ConfigError(f"{path}: .csv or .parquet expected, not {path.suffix!r}")
    if path is not None and path.suffix == ".parquet":
        import pyarrow.parquet as pq

        pq.write_table(_arrow_table(poses), path, compression="zstd", use_dictionary=False)
        return
    _write_csv(poses, path)


def write_all(
    poses: Poses, instants: Instants, path: Path | None, photogrammetry: Path | None
) -> None:
    """Poses (`write_poses`) and, where it is asked for, the photogrammetry's reference file.

    Raises
    ------
    ConfigError
        As of the two.
    """
    if photogrammetry is not None:
        write_photogrammetry(poses, instants, photogrammetry)
    if path is not None or photogrammetry is None:
        write_poses(poses, path)


def write_photogrammetry(poses: Poses, instants: Instants, path: Path) -> int:
    """Reference file: label, place, yaw, pitch and roll in degrees, accuracies; return its rows.

    Heights are minus the depth, above the water's surface; the yaw is the heading.  Instants
    outside the track are left out.  Nothing is said of the accuracy of depth and angles, which
    no method estimates.

    Raises
    ------
    ConfigError
        The dive has no origin.
    """
    if poses.origin is None:
        raise ConfigError(f"{path}: needs latitude and longitude, and the dive has no origin")
    rows, track = poses.inside, poses.track
    latitude_deg, longitude_deg = geodetic_of(poses)
    numbers = {
        "latitude_deg": latitude_deg.round(9),
        "longitude_deg": longitude_deg.round(9),
        "height_m": track.position_enu_m[:, 2].round(4),
        "yaw_deg": np.degrees(track.heading_rad).round(5),
        "pitch_deg": np.degrees(track.pitch_rad).round(5),
        "roll_deg": np.degrees(track.roll_rad).round(5),
        "accuracy_east_m": np.sqrt(track.position_cov_m2[:, 0, 0]).round(4),
        "accuracy_north_m": np.sqrt(track.position_cov_m2[:, 1, 1]).round(4),
    }
    labels = np.array(instants.labels or utc_text(poses.time_ns, "ns"))[rows]
    table = {"label": labels, **{name: values[rows] for name, values in numbers.items()}}
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write("#" + ",".join(table) + "\n")
        columns = [values.tolist() for values in table.values()]
        file.writelines(",".join(map(str, row)) + "\n" for row in zip(*columns, strict=True))
    return int(rows.sum())


def _columns(poses: Poses) -> dict[str, tuple[Any, str]]:
    """Name -> values and unit, in the order of `tracks.parquet`."""
    tables = (poses.track, Geodetic(*geodetic_of(poses)))
    columns: dict[str, tuple[Any, str]] = {}
    for table in tables:
        for field, column in stored_columns(type(table)):
            values = getattr(table, field)
            values = values if column.value is None else column.value(values)
            columns[column.name] = (values, column.unit)
    columns["time"] = (poses.time_ns, "UTC")
    columns["inside"] = (poses.inside, "")
    return columns


def _arrow_table(poses: Poses) -> "pa.Table":
    import pyarrow as pa

    origin = poses.origin
    metadata = {
        "abyssnav_version": __version__,
        "origin": f"{origin.latitude_deg!r},{origin.longitude_deg!r}" if origin else "none",
        "frame": "ENU",
        "method": poses.method,
    }
    arrays, fields = [], []
    for name, (values, unit) in _columns(poses).items():
        array = pa.array(values, from_pandas=values.dtype.kind == "f")
        arrays.append(array.cast(pa.timestamp("ns", "UTC")) if name == "time" else array)
        fields.append(pa.field(name, arrays[-1].type, metadata={"unit": unit}))
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=metadata))


def _write_csv(poses: Poses, path: Path | None) -> None:
    import pyarrow as pa
    from pyarrow import csv

    table = _arrow_table(poses)
    table = table.set_column(0, "time", _iso_texts(poses.time_ns))

    def text(first: int) -> "pa.Buffer":
        rows, options = pa.BufferOutputStream(), csv.WriteOptions(quoting_style="none")
        options.include_header = first == 0
        csv.write_csv(table.slice(first, _ROWS_OF_TEXT), rows, options)
        return rows.getvalue()

    firsts, n = range(0, max(len(table), 1), _ROWS_OF_TEXT), cores()
    # digits take longer than all else: each core writes some, in memory for a few rows of text
    with ThreadPoolExecutor(n) as threads, _opened(path) as file:
        for begin in range(0, len(firsts), 2 * n):
            for part in threads.map(text, firsts[begin : begin + 2 * n]):
                file.write(part)


def _opened(path: Path | None) -> AbstractContextManager[IO[bytes]]:
    return nullcontext(sys.stdout.buffer) if path is None else path.open("wb")


def _iso_texts(time_ns: Int) -> "pa.Array":
    """`2013-06-05T02:00:00.123456789Z` of each instant, without a loop over them."""
    import pyarrow as pa
    import pyarrow.compute as pc

    spaced = pa.array(time_ns).cast(pa.timestamp("ns")).cast(pa.string())
    place = len("2013-06-05")
    return pc.binary_join_element_wise(
        pc.binary_replace_slice(spaced, place, place + 1, "T"), "Z", ""
    )
