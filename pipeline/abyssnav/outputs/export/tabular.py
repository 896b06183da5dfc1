# SPDX-License-Identifier: Apache-2.0
"""Tracks as tables: CSV, TUM for `evo`, and CF-1.8 trajectories in netCDF."""

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from abyssnav.outputs.export.source import Exported
from abyssnav.outputs.parquet import FILES

#: Variable -> column, units, standard name (empty: there is none), long name.
_VARIABLES: Final = {
    "lat": ("latitude_deg", "degrees_north", "latitude", "latitude, WGS 84"),
    "lon": ("longitude_deg", "degrees_east", "longitude", "longitude, WGS 84"),
    "depth": ("depth_m", "m", "depth", "depth below the surface"),
    "east": ("east_m", "m", "", "east of the dive's origin"),
    "north": ("north_m", "m", "", "north of the dive's origin"),
    "sigma_east": ("sigma_east_m", "m", "", "standard deviation of east"),
    "sigma_north": ("sigma_north_m", "m", "", "standard deviation of north"),
    "cov_east_north": ("cov_east_north_m2", "m2", "", "covariance of east and north"),
    "heading": ("heading_rad", "radian", "", "heading, clockwise from true north"),
}


def write_csv(source: Exported, folder: Path) -> list[Path]:
    """All tracks in one table: the columns of `tracks.parquet`, time as ISO 8601."""
    path = folder / f"{source.name}_tracks.csv"
    names = [c.name for c in FILES["tracks"].columns() if c.name != "dive"]
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(names) + "\n")
        for method, track in source.tracks.items():
            stamps = np.datetime_as_string(track["time_ns"].view("M8[ns]"))
            columns = [track[name].tolist() for name in names[2:]]
            for stamp, *row in zip(stamps, *columns, strict=True):
                cells = ("" if math.isnan(value) else repr(value) for value in row)
                file.write(f"{method},{stamp}Z,{','.join(cells)}\n")
    return [path]


def write_tum(source: Exported, folder: Path) -> list[Path]:
    """One file a method: `timestamp x y z qx qy qz qw`, ENU metres, yaw = π/2 - heading."""
    paths = []
    for method, track in source.tracks.items():
        half_yaw_rad = 0.5 * (0.5 * np.pi - track["heading_rad"])
        flat = np.zeros(len(half_yaw_rad))
        numbers = np.column_stack(
            [
                track["east_m"],
                track["north_m"],
                -track["depth_m"],
                flat,
                flat,
                np.sin(half_yaw_rad),
                np.cos(half_yaw_rad),
            ]
        )
        whole_s, rest_ns = np.divmod(track["time_ns"], 1_000_000_000)
        paths.append(folder / f"{source.name}_{method}.tum")
        with paths[-1].open("w", encoding="ascii") as file:
            for s, ns, row in zip(whole_s, rest_ns, numbers.tolist(), strict=True):
                file.write(f"{s}.{ns:09d} {' '.join(f'{value:.9g}' for value in row)}\n")
    return paths


def write_netcdf(source: Exported, folder: Path) -> list[Path]:
    """CF-1.8 discrete sampling geometry: a trajectory a method, as a contiguous ragged array."""
    from scipy.io import netcdf_file

    source.on_earth("netCDF")
    path = folder / f"{source.name}.nc"
    methods, tracks = list(source.tracks), list(source.tracks.values())
    first_ns = min(int(track["time_ns"][0]) for track in tracks) // 1_000_000_000 * 1_000_000_000
    origin = str(np.datetime64(first_ns, "ns").astype("M8[s]")).replace("T", " ")
    with netcdf_file(path, "w", version=2) as file:
        _describe(file, source)
        width = max(map(len, methods))
        file.createDimension("trajectory", len(methods))
        file.createDimension("obs", sum(len(track["time_ns"]) for track in tracks))
        file.createDimension("name_strlen", width)
        names = file.createVariable("trajectory", "c", ("trajectory", "name_strlen"))
        names[:] = np.array([list(method.ljust(width, "\0")) for method in methods], "S1")
        _label(names, cf_role="trajectory_id", long_name="method of navigation")
        size = file.createVariable("row_size", "i4", ("trajectory",))
        size[:] = [len(track["time_ns"]) for track in tracks]
        _label(size, long_name="points of the trajectory", sample_dimension="obs")
        time = file.createVariable("time", "f8", ("obs",))
        time[:] = np.concatenate([(track["time_ns"] - first_ns) / 1e9 for track in tracks])
        units = f"seconds since {origin} UTC"
        _label(time, standard_name="time", units=units, calendar="standard", axis="T")
        for name, (column, unit, standard, long) in _VARIABLES.items():
            variable = file.createVariable(name, "f8", ("obs",))
            variable[:] = np.concatenate([track[column] for track in tracks])
            _label(variable, units=unit, long_name=long)
            if standard:
                _label(variable, standard_name=standard)
            if name not in ("lat", "lon", "depth"):
                _label(variable, coordinates="time lat lon depth")
        for name, axis in (("lat", "Y"), ("lon", "X"), ("depth", "Z")):
            _label(file.variables[name], axis=axis)
        _label(file.variables["depth"], positive="down")
    return [path]


def _describe(file: Any, source: Exported) -> None:
    _label(
        file,
        Conventions="CF-1.8",
        featureType="trajectory",
        title=f"Navigation of dive {source.name}",
        institution="unknown",
        source="LBL travel times, DVL, compass and depth",
        history=f"abyssnav {source.version}",
        references="Deep Sea AUV Navigation Using Multiple Acoustic Beacons",
    )


def _label(holder: Any, **attributes: str) -> None:
    for name, value in attributes.items():
        setattr(holder, name, value)
