# SPDX-License-Identifier: Apache-2.0
"""Tracks as tables: CSV, TUM for `evo`, and CF-1.8 trajectories in netCDF."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from abyssnav.geometry import quaternion_xyzw
from abyssnav.outputs.export.source import HEIGHT, Exported, Table
from abyssnav.outputs.parquet import FILES
from abyssnav.tables import Column, utc_text

#: Column -> standard name of CF, where there is one.
_STANDARD_NAMES: Final = {
    "latitude_deg": "latitude",
    "longitude_deg": "longitude",
    "depth_m": "depth",
    "heading_rad": "platform_orientation",
    "roll_rad": "platform_roll_starboard_down",
    "pitch_rad": "platform_pitch_fore_up",
    "altitude_m": "height_above_sea_floor",
}
#: Column -> variable, where that is not the column without its unit; and its axis.
_COORDINATES: Final = {
    "latitude_deg": ("lat", "Y"),
    "longitude_deg": ("lon", "X"),
    "depth_m": ("depth", "Z"),
}
_UNITS: Final = {
    "latitude_deg": "degrees_north",
    "longitude_deg": "degrees_east",
    "m^2": "m2",
    "rad": "radian",
    "m/s": "m s-1",
}


def write_csv(source: Exported, folder: Path) -> list[Path]:
    """Tracks in one table, the columns of `tracks.parquet`; and a table each of what is beside."""
    path = folder / f"{source.name}_tracks.csv"
    _write_table(path, _names("tracks"), list(source.tracks.values()))
    return [path, *write_companions(source, folder)]


def write_companions(source: Exported, folder: Path) -> list[Path]:
    """What stands beside a track, as CSV: beacons, fixes, legs with the 95 % radius, reference."""
    tables: dict[str, tuple[list[str], Table]] = {
        "beacons": (_names("beacons"), source.beacons),
        "fixes": ([*_names("fixes"), "latitude_deg", "longitude_deg"], source.fixes),
        "accuracy": (_names("accuracy"), source.legs),
    }
    if source.reference is not None:
        tables["reference"] = (_names("reference"), source.reference)
    paths = []
    for kind, (names, table) in tables.items():
        paths.append(folder / f"{source.name}_{kind}.csv")
        _write_table(paths[-1], names, [table])
    return paths


def _write_table(path: Path, names: Sequence[str], parts: Sequence[Table]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(names) + "\n")
        for part in parts:
            columns = [_texts(part, name) for name in names]
            file.writelines(",".join(row) + "\n" for row in zip(*columns, strict=True))


def _names(file: str) -> list[str]:
    return [column.name for column in FILES[file].columns() if column.name != "dive"]


def _texts(table: Table, name: str) -> list[str]:
    if f"{name}_ns" in table:
        return utc_text(table[f"{name}_ns"], "ns")
    values = table[name].tolist()
    if values and isinstance(values[0], str):
        return [
            f'"{v.replace(chr(34), chr(34) * 2)}"' if set(v) & set(',"\n') else v for v in values
        ]
    return ["" if isinstance(v, float) and math.isnan(v) else repr(v) for v in values]


def write_tum(source: Exported, folder: Path) -> list[Path]:
    """One file a method, the fixes' and the reference's: `timestamp x y z qx qy qz qw`, ENU metres.

    The rotation is that of forward, port and up; what has none points east.  The format has room
    for no more: `write_companions` has the rest.
    """
    paths = []
    tracks = {**source.tracks, "fix": source.fixes}
    if source.reference is not None:
        tracks["reference"] = source.reference
    for method, track in tracks.items():
        turn = np.tile([0.0, 0.0, 0.0, 1.0], (len(track["time_ns"]), 1))
        if "heading_rad" in track:
            angles = (track["roll_rad"], track["pitch_rad"], track["heading_rad"])
            turn = quaternion_xyzw(*angles)
        enu_m = (track["east_m"], track["north_m"], -track["depth_m"])
        numbers = np.column_stack([*enu_m, turn])
        whole_s, rest_ns = np.divmod(track["time_ns"], 1_000_000_000)
        paths.append(folder / f"{source.name}_{method}.tum")
        with paths[-1].open("w", encoding="ascii") as file:
            for s, ns, row in zip(whole_s, rest_ns, numbers.tolist(), strict=True):
                file.write(f"{s}.{ns:09d} {' '.join(f'{value:.9g}' for value in row)}\n")
    return [*paths, *write_companions(source, folder)]


# --- netCDF -----------------------------------------------------------------------------------


def write_netcdf(source: Exported, folder: Path) -> list[Path]:
    """CF-1.8 trajectories, one a method and the reference's, as a contiguous ragged array."""
    from scipy.io import netcdf_file

    source.need_origin("netCDF")
    path = folder / f"{source.name}.nc"
    tracks = dict(source.tracks)
    if source.reference is not None:
        tracks["reference"] = source.reference
    with netcdf_file(path, "w", version=2) as file:
        _label(file, **_attributes(source, tracks))
        _index(file, tracks)
        for column in FILES["tracks"].columns():
            if column.kind == "number":
                _variable(file, column, tracks)
        radius = Column("uncertainty_95_m", "m", "95 % horizontal radius to rely on, by leg")
        radii = {
            name: {**track, radius.name: source.radius_95_m(track["time_ns"])}
            for name, track in tracks.items()
            if name == "smoother"
        }
        _variable(file, radius, tracks | radii)
    return [path]


def _index(file: Any, tracks: dict[str, Table]) -> None:
    """Which rows are whose, and when."""
    names, lengths = list(tracks), [len(track["time_ns"]) for track in tracks.values()]
    width = max(map(len, names))
    file.createDimension("trajectory", len(names))
    file.createDimension("obs", sum(lengths))
    file.createDimension("name_strlen", width)
    labels = file.createVariable("trajectory", "c", ("trajectory", "name_strlen"))
    labels[:] = np.array([list(name.ljust(width, "\0")) for name in names], "S1")
    _label(labels, cf_role="trajectory_id", long_name="method of navigation, or the reference")
    size = file.createVariable("row_size", "i4", ("trajectory",))
    size[:] = lengths
    _label(size, long_name="points of the trajectory", sample_dimension="obs")
    first_ns = min(int(track["time_ns"][0]) for track in tracks.values()) // 10**9 * 10**9
    origin = utc_text(np.array([first_ns]), "s")[0].replace("T", " ").removesuffix("Z")
    time = file.createVariable("time", "f8", ("obs",))
    time[:] = np.concatenate([(track["time_ns"] - first_ns) / 1e9 for track in tracks.values()])
    units = f"seconds since {origin} UTC"
    _label(time, standard_name="time", long_name="instant of the point", units=units)
    _label(time, calendar="standard", axis="T")


def _variable(file: Any, column: Column, tracks: dict[str, Table]) -> None:
    """One column of all trajectories, NaN where one has none."""
    name, axis = _COORDINATES.get(column.name, (column.name.rsplit("_", 1)[0], ""))
    variable = file.createVariable(name, "f8", ("obs",))
    unknown = {method: np.full(len(track["time_ns"]), np.nan) for method, track in tracks.items()}
    variable[:] = np.concatenate([t.get(column.name, unknown[m]) for m, t in tracks.items()])
    units = _UNITS.get(column.name, _UNITS.get(column.unit, column.unit))
    _label(variable, units=units, long_name=column.meaning.split("; null")[0])
    _label(variable, coverage_content_type=_content(column.name, axis))
    if column.name in _STANDARD_NAMES:
        _label(variable, standard_name=_STANDARD_NAMES[column.name])
    if axis:
        _label(variable, axis=axis)
    else:
        _label(variable, coordinates="time lat lon depth")
        variable._FillValue = np.float64(np.nan)
    if column.name == "depth_m":
        _label(variable, positive="down")


def _content(name: str, axis: str) -> str:
    """What ACDD calls the content of a column."""
    if axis:
        return "coordinate"
    is_quality = name.startswith(("sigma_", "cov_", "uncertainty_"))
    return "qualityInformation" if is_quality else "modelResult"


def _attributes(source: Exported, tracks: dict[str, Table]) -> dict[str, Any]:
    """Global attributes of CF and of ACDD-1.3, as far as a dive and its settings know them."""
    return {
        "Conventions": "CF-1.8, ACDD-1.3",
        "featureType": "trajectory",
        "cdm_data_type": "Trajectory",
        "title": f"Navigation of dive {source.name}",
        "summary": "Track of an autonomous underwater vehicle from acoustic travel times to "
        "beacons, Doppler log, compass and depth, with standard deviations and a 95 % radius",
        "keywords": "underwater navigation, AUV, long baseline, acoustic positioning, trajectory",
        "id": source.name,
        "source": "LBL travel times, DVL, compass and depth",
        "platform": "autonomous underwater vehicle",
        "instrument": "acoustic transponder interrogator, Doppler velocity log, compass, depth",
        "processing_level": "navigated; see the trajectory's name for the method",
        "product_version": source.version,
        "history": f"abyssnav {source.version}",
        "references": "Deep Sea AUV Navigation Using Multiple Acoustic Beacons",
        "comment": f"heights would be {HEIGHT}",
        "standard_name_vocabulary": "CF Standard Name Table v79",
        **_coverage(list(tracks.values())),
        **source.attribution,
    }


def _coverage(tracks: Sequence[Table]) -> dict[str, Any]:
    """Where and when, of ACDD-1.3."""
    times = np.concatenate([track["time_ns"][[0, -1]] for track in tracks])
    begin, end = utc_text(np.array([times.min(), times.max()]), "s")
    steps_ns = [np.diff(track["time_ns"]) for track in tracks if len(track["time_ns"]) > 1]
    step_s = float(np.median(np.concatenate(steps_ns))) / 1e9 if steps_ns else 0.0

    def ends(name: str) -> list[np.float64]:
        values = np.concatenate([track[name] for track in tracks])
        return [np.float64(values.min()), np.float64(values.max())]

    (south, north), (west, east) = ends("latitude_deg"), ends("longitude_deg")
    top, bottom = ends("depth_m")
    return {
        "time_coverage_start": begin,
        "time_coverage_end": end,
        "time_coverage_duration": f"PT{int(times.max() - times.min()) // 1_000_000_000}S",
        "time_coverage_resolution": f"PT{step_s:g}S",
        "geospatial_lat_min": south,
        "geospatial_lat_max": north,
        "geospatial_lat_units": "degrees_north",
        "geospatial_lon_min": west,
        "geospatial_lon_max": east,
        "geospatial_lon_units": "degrees_east",
        "geospatial_vertical_min": top,
        "geospatial_vertical_max": bottom,
        "geospatial_vertical_units": "m",
        "geospatial_vertical_positive": "down",
        "geospatial_bounds": f"POLYGON (({south} {west}, {north} {west}, {north} {east}, "
        f"{south} {east}, {south} {west}))",
        "geospatial_bounds_crs": "EPSG:4326",
        "geospatial_bounds_vertical_crs": "EPSG:5831",  # depth below the water's surface as it was
    }


def _label(holder: Any, **attributes: Any) -> None:
    """Attributes of a file or variable; texts in UTF-8, for of strings SciPy takes ASCII alone."""
    for name, value in attributes.items():
        setattr(holder, name, value.encode() if isinstance(value, str) else value)
