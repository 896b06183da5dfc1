# SPDX-License-Identifier: Apache-2.0
"""A plan as files: Parquet, GeoJSON, a page and a recording."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from abyssnav.atomic import atomic_file
from abyssnav.geometry import enu_to_geodetic
from abyssnav.outputs.palette import BEACON, sequential
from abyssnav.outputs.rerun import has_viewer
from abyssnav.plan.expect import Plan
from abyssnav.plan.page import page
from abyssnav.plan.recording import write_recording
from abyssnav.tables import Float
from abyssnav.version import __version__

#: Column -> unit and meaning, of either table.
_MEANING = {
    "time_s": ("s", "since the beginning of the planned track"),
    "east_m": ("m", "east of the origin"),
    "north_m": ("m", "north of the origin"),
    "depth_m": ("m", "below the surface, positive down"),
    "latitude_deg": ("deg", "WGS 84; null without an origin"),
    "longitude_deg": ("deg", "WGS 84; null without an origin"),
    "radius_95_m": ("m", "95 % radius to expect of the final track"),
    "filter_radius_95_m": ("m", "95 % radius to expect in real time"),
    "two_beacons_95_m": ("m", "of the final track with the two nearest beacons only"),
    "one_beacon_95_m": ("m", "of the final track with the nearest beacon only"),
}


def write_plan(plan: Plan, folder: Path, name: str) -> list[Path]:
    """Write `plan.parquet` (the map), `track.parquet`, `plan.geojson`, `plan.html`, `plan.rrd`.

    The recording is made where the viewer is installed.

    Raises
    ------
    PipelineError
        A file cannot be written.
    """
    writers: dict[str, Callable[[Path], object]] = {
        "plan.parquet": lambda path: _write_parquet(_map_columns(plan), plan, path),
        "track.parquet": lambda path: _write_parquet(_track_columns(plan), plan, path),
        "plan.geojson": lambda path: _write_geojson(plan, path),
        "plan.html": lambda path: path.write_text(page(plan, name), encoding="utf-8"),
    }
    if has_viewer():
        writers["plan.rrd"] = lambda path: write_recording(plan, name, path)
    folder.mkdir(parents=True, exist_ok=True)
    for file, write in writers.items():
        with atomic_file(folder / file) as fresh:
            write(fresh)
    return [folder / file for file in writers]


def _map_columns(plan: Plan) -> Mapping[str, Float]:
    cells = plan.cells
    up_m = np.full(len(cells), -plan.layout.track.depth_m)
    return {
        "east_m": cells.east_m,
        "north_m": cells.north_m,
        **_on_earth(plan, np.column_stack([cells.east_m, cells.north_m, up_m])),
        "radius_95_m": cells.radius_95_m,
        "filter_radius_95_m": cells.filter_radius_95_m,
    }


def _track_columns(plan: Plan) -> Mapping[str, Float]:
    track = plan.track
    return {
        "time_s": track.t_s,
        "east_m": track.position_enu_m[:, 0],
        "north_m": track.position_enu_m[:, 1],
        "depth_m": -track.position_enu_m[:, 2],
        **_on_earth(plan, track.position_enu_m),
        "radius_95_m": track.radius_95_m,
        "filter_radius_95_m": track.filter_radius_95_m,
        "two_beacons_95_m": track.two_beacons_95_m,
        "one_beacon_95_m": track.one_beacon_95_m,
    }


def _on_earth(plan: Plan, position_enu_m: Float) -> Mapping[str, Float]:
    """Latitude and longitude, NaN without an origin."""
    if plan.origin is None:
        unknown = np.full(len(position_enu_m), np.nan)
        return {"latitude_deg": unknown, "longitude_deg": unknown}
    origin = plan.origin
    latitude_deg, longitude_deg, _ = enu_to_geodetic(
        origin.latitude_deg, origin.longitude_deg, position_enu_m
    )
    return {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}


def _write_parquet(columns: Mapping[str, Float], plan: Plan, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    origin = plan.origin
    place = f"{origin.latitude_deg},{origin.longitude_deg}" if origin else "none"
    fields = [
        pa.field(
            name,
            pa.float64(),
            metadata=dict(zip(("unit", "meaning"), _MEANING[name], strict=True)),
        )
        for name in columns
    ]
    described = {"abyssnav_version": __version__, "origin": place, "frame": "ENU"}
    arrays = [pa.array(values, from_pandas=True) for values in columns.values()]
    table = pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=described))
    pq.write_table(table, path, compression="zstd")


def _write_geojson(plan: Plan, path: Path) -> None:
    """Cells, track and beacons (RFC 7946); local metres, and said so, where there is no origin."""
    features = [*_cell_features(plan), _track_feature(plan), *_beacon_features(plan)]
    collection: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    if plan.origin is None:
        collection["coordinates"] = "metres east and north: the layout has no origin on earth"
    path.write_text(json.dumps(collection, allow_nan=False) + "\n", encoding="utf-8")


def _coordinates(plan: Plan, position_enu_m: Float) -> list[list[float]]:
    if plan.origin is None:
        return np.round(position_enu_m[:, :2], 2).tolist()  # type: ignore[no-any-return]
    place = _on_earth(plan, position_enu_m)
    return np.round(  # type: ignore[no-any-return]
        np.column_stack([place["longitude_deg"], place["latitude_deg"]]), 8
    ).tolist()


def _cell_features(plan: Plan) -> list[dict[str, Any]]:
    cells, half = plan.cells, 0.5 * plan.side_m
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    middle = np.column_stack([cells.east_m, cells.north_m])
    ring = np.concatenate(
        [
            middle[:, None, :] + corners,
            np.full((len(cells), len(corners), 1), -plan.layout.track.depth_m),
        ],
        axis=-1,
    )
    places = _coordinates(plan, ring.reshape(-1, 3))
    largest_m = float(cells.radius_95_m.max())
    return [
        {
            "type": "Feature",
            "properties": {
                "kind": "cell",
                "radius_95_m": round(float(cells.radius_95_m[row]), 3),
                "filter_radius_95_m": round(float(cells.filter_radius_95_m[row]), 3),
                "fill": sequential(float(cells.radius_95_m[row]) / largest_m),
            },
            "geometry": {
                "type": "Polygon",
                "coordinates": [places[row * len(corners) : (row + 1) * len(corners)]],
            },
        }
        for row in range(len(cells))
    ]


def _track_feature(plan: Plan) -> dict[str, Any]:
    track = plan.track
    return {
        "type": "Feature",
        "properties": {
            "kind": "track",
            "radius_95_m": np.round(track.radius_95_m, 3).tolist(),
            "changes": {change.what: round(change.radius_95_m, 3) for change in plan.changes},
        },
        "geometry": {
            "type": "LineString",
            "coordinates": _coordinates(plan, track.position_enu_m),
        },
    }


def _beacon_features(plan: Plan) -> list[dict[str, Any]]:
    beacons = plan.beacons
    return [
        {
            "type": "Feature",
            "properties": {
                "kind": "beacon",
                "id": int(beacons.id[row]),
                "name": str(beacons.name[row]),
                "sigma_m": float(beacons.sigma_m[row]),
                "marker-color": BEACON,
            },
            "geometry": {"type": "Point", "coordinates": place},
        }
        for row, place in enumerate(_coordinates(plan, beacons.position_enu_m))
    ]
