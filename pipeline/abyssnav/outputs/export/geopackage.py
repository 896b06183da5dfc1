# SPDX-License-Identifier: Apache-2.0
"""GeoPackage (OGC 12-128r18): layers of tracks, legs, beacons, fixes and the reference.

SQLite alone writes it; the same dive gives the same bytes.
"""

import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from abyssnav.outputs.export.source import HEIGHT, Exported, Table
from abyssnav.tables import Float, utc_text

_WGS84: Final = 4326
_DEFINITION: Final = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,'
    'AUTHORITY["EPSG","7030"]],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,'
    'AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],'
    'AUTHORITY["EPSG","4326"]]'
)
_TABLES: Final = """
PRAGMA application_id = 0x47504B47;
PRAGMA user_version = 10300;
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
  description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
  identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL,
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""
_TRACK_COLUMNS: Final = (
    "sigma_east_m", "sigma_north_m", "depth_m", "heading_rad", "roll_rad", "pitch_rad",
    "forward_mps", "starboard_mps", "altitude_m",
)  # fmt: skip
_BEACON_COLUMNS: Final = ("name", "beacon_id", "depth_m", "sigma_m", "turn_around_s")
_FIX_COLUMNS: Final = ("sigma_east_m", "sigma_north_m", "n_replies", "rms_s")
_SYSTEMS: Final = (
    ("Undefined cartesian SRS", -1, "NONE", -1, "undefined", None),
    ("Undefined geographic SRS", 0, "NONE", 0, "undefined", None),
    ("WGS 84 geodetic", _WGS84, "EPSG", _WGS84, _DEFINITION, "longitude, latitude"),
)


def write_gpkg(source: Exported, folder: Path) -> list[Path]:
    """One GeoPackage; heights are minus the depth, as each layer says."""
    source.need_origin("GeoPackage")
    path = folder / f"{source.name}.gpkg"
    path.unlink(missing_ok=True)
    changed = utc_text(next(iter(source.tracks.values()))["time_ns"][-1:])[0]  # no wall clock
    database = sqlite3.connect(path)
    try:
        database.executescript(_TABLES)
        database.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?,?,?,?,?,?)", _SYSTEMS)
        for layer in _layers(source):
            _write_layer(database, layer, changed)
        database.commit()
    finally:
        database.close()
    return [path]


_Layer = tuple[str, str, dict[str, Sequence[Any]], list[Float]]


def _layers(source: Exported) -> list[_Layer]:
    """Name, geometry, columns and places (n, 3) of each row, of all layers that are not empty."""
    tracks = list(source.tracks.items())
    spans = [utc_text(track["time_ns"][[0, -1]]) for _, track in tracks]
    columns: dict[str, Sequence[Any]] = {
        "method": [method for method, _ in tracks],
        "begin_time": [begin for begin, _ in spans],
        "end_time": [end for _, end in spans],
    }
    layers: list[_Layer] = [
        ("tracks", "LINESTRING", columns, [_places(track) for _, track in tracks])
    ]
    for method, track in tracks:
        layers.append(_points(f"{method}_points", track, _TRACK_COLUMNS))
    if "smoother" in source.tracks:
        layers.append(_legs(source))
    layers.append(_points("beacons", source.beacons, _BEACON_COLUMNS))
    layers.append(_points("fixes", source.fixes, _FIX_COLUMNS))
    if source.reference is not None:
        layers.append(("reference", "LINESTRING", {}, [_places(source.reference)]))
    return [layer for layer in layers if layer[3]]


def _points(name: str, table: Table, names: Sequence[str]) -> _Layer:
    columns: dict[str, Sequence[Any]] = {n: table[n].tolist() for n in names}
    if "time_ns" in table:
        columns["time"] = utc_text(table["time_ns"])
    return name, "POINT", columns, list(_places(table)[:, None])


def _legs(source: Exported) -> _Layer:
    track, legs = source.tracks["smoother"], source.legs
    first = np.searchsorted(track["time_ns"], legs["begin_time_ns"])
    last = np.searchsorted(track["time_ns"], legs["end_time_ns"], side="right")
    rows = np.flatnonzero(last - first > 1)
    places = _places(track)
    columns: dict[str, Sequence[Any]] = {
        "begin_time": utc_text(legs["begin_time_ns"][rows]),
        "end_time": utc_text(legs["end_time_ns"][rows]),
        "uncertainty_95_m": legs["uncertainty_95_m"][rows].tolist(),
    }
    return "legs", "LINESTRING", columns, [places[first[k] : last[k]] for k in rows]


def _places(table: Table) -> Float:
    return np.column_stack([table["longitude_deg"], table["latitude_deg"], -table["depth_m"]])


def _write_layer(database: sqlite3.Connection, layer: _Layer, changed: str) -> None:
    name, kind, columns, places = layer
    low, high = np.concatenate(places).min(axis=0), np.concatenate(places).max(axis=0)
    content = (name, "features", name, f"heights: {HEIGHT}", changed, *low[:2], *high[:2], _WGS84)
    database.execute("INSERT INTO gpkg_contents VALUES (?,?,?,?,?,?,?,?,?,?)", content)
    geometry = (name, "geom", kind, _WGS84, 1, 0)
    database.execute("INSERT INTO gpkg_geometry_columns VALUES (?,?,?,?,?,?)", geometry)
    described = "".join(f', "{c}" {_sql_type(c, values)}' for c, values in columns.items())
    database.execute(
        f'CREATE TABLE "{name}" (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, '
        f"geom {kind}{described})"
    )
    marks = ",".join("?" * (len(columns) + 2))
    rows = zip(range(1, len(places) + 1), map(_geometry, places), *columns.values(), strict=True)
    database.executemany(f'INSERT INTO "{name}" VALUES ({marks})', rows)


def _sql_type(name: str, values: Sequence[Any]) -> str:
    if name == "time" or name.endswith("_time"):
        return "DATETIME"
    if isinstance(values[0], str):
        return "TEXT"
    return "INTEGER" if isinstance(values[0], int) else "DOUBLE"


def _geometry(places: Float) -> bytes:
    """GeoPackage header with an envelope, and the well-known binary of a line or a point."""
    low, high = places.min(axis=0), places.max(axis=0)
    envelope = struct.pack("<4d", low[0], high[0], low[1], high[1])
    head = b"GP" + struct.pack("<BBi", 0, 0b0000_0011, _WGS84) + envelope
    content = np.ascontiguousarray(places, "<f8").tobytes()
    if len(places) == 1:
        return head + struct.pack("<BI", 1, 1001) + content
    return head + struct.pack("<BII", 1, 1002, len(places)) + content
