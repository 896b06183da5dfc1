# SPDX-License-Identifier: Apache-2.0
"""Tracks on the globe: GeoJSON, KMZ and GPX, WGS 84; heights are above the water's surface."""

import json
import math
import zipfile
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree as ET

import numpy as np

from abyssnav.outputs.export.source import HEIGHT, Exported, Table
from abyssnav.outputs.palette import BEACON, REFERENCE, method_colour
from abyssnav.tables import utc_text

_KML: Final = "http://www.opengis.net/kml/2.2"
_GX: Final = "http://www.google.com/kml/ext/2.2"
_GPX: Final = "http://www.topografix.com/GPX/1/1"
_ZIP_EPOCH: Final = (1980, 1, 1, 0, 0, 0)  # no wall clock inside: the same bytes each time


def write_geojson(source: Exported, folder: Path) -> list[Path]:
    """One feature collection (RFC 7946): lines of tracks, reference and legs, points of the rest.

    `kind` says what a feature is; a leg has the 95 % radius.
    """
    source.need_origin("GeoJSON")
    features = [
        _line(track, {"kind": "track", "method": method, "stroke": method_colour(method)})
        for method, track in source.tracks.items()
    ]
    if source.reference is not None:
        features.append(_line(source.reference, {"kind": "reference", "stroke": REFERENCE}))
    features += _legs(source)
    features += _points(source.beacons, "beacon", ("name", "beacon_id", "sigma_m"))
    features += _points(source.fixes, "fix", ("sigma_east_m", "sigma_north_m", "n_replies"))
    for feature in features:
        feature["properties"] |= {"dive": source.name, "height": HEIGHT}
    path = folder / f"{source.name}.geojson"
    collection = {"type": "FeatureCollection", "features": features}
    path.write_text(json.dumps(collection, allow_nan=False) + "\n", encoding="utf-8")
    return [path]


def write_kmz(source: Exported, folder: Path) -> list[Path]:
    """A zipped KML: tracks that move with the time slider; beacons, fixes, reference, legs.

    A leg of the smoother has its 95 % radius in its name and as `uncertainty_95_m`.
    """
    source.need_origin("KMZ")
    ET.register_namespace("", _KML)
    ET.register_namespace("gx", _GX)
    root = ET.Element(f"{{{_KML}}}kml")
    document = _child(root, "Document")
    _child(document, "name", source.name)
    _child(document, "description", f"abyssnav {source.version}; heights: {HEIGHT}")
    for method, track in source.tracks.items():
        _moving(document, method, track, method_colour(method))
    if source.reference is not None:
        _moving(document, "reference", source.reference, REFERENCE)
    _places(document, "beacons", source.beacons, source.beacons["name"].tolist())
    _places(document, "fixes", source.fixes, utc_text(source.fixes["time_ns"], "s"))
    _kml_legs(document, source)
    path = folder / f"{source.name}.kmz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        entry = zipfile.ZipInfo("doc.kml", _ZIP_EPOCH)
        entry.compress_type = zipfile.ZIP_DEFLATED
        archive.writestr(entry, ET.tostring(root, encoding="utf-8", xml_declaration=True))
    return [path]


def write_gpx(source: Exported, folder: Path) -> list[Path]:
    """GPX 1.1: a track a method, and the reference's; beacons and fixes as waypoints, by `type`.

    `ele` is minus the depth; the smoother's `desc` has the 95 % radius of each leg.
    """
    source.need_origin("GPX")
    root = ET.Element("gpx", xmlns=_GPX, version="1.1", creator=f"abyssnav {source.version}")
    metadata = ET.SubElement(root, "metadata")
    ET.SubElement(metadata, "desc").text = f"{source.name}; ele: {HEIGHT}"
    _waypoints(root, "beacon", source.beacons, source.beacons["name"].tolist())
    _waypoints(root, "fix", source.fixes, ["fix"] * len(source.fixes["time_ns"]))
    lines = dict(source.tracks)
    if source.reference is not None:
        lines["reference"] = source.reference
    for method, track in lines.items():
        line = ET.SubElement(root, "trk")
        ET.SubElement(line, "name").text = f"{source.name} {method}"
        if method == "smoother" and (radii := _radii(source)):
            ET.SubElement(line, "desc").text = "; ".join(radii)
        segment = ET.SubElement(line, "trkseg")
        for point, stamp in zip(lon_lat_height(track), utc_text(track["time_ns"]), strict=True):
            _gpx_point(segment, "trkpt", point, stamp)
    path = folder / f"{source.name}.gpx"
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    return [path]


def _waypoints(root: ET.Element, kind: str, table: Table, names: list[str]) -> None:
    stamps = utc_text(table["time_ns"]) if "time_ns" in table else [""] * len(names)
    for place, name, stamp in zip(lon_lat_height(table), names, stamps, strict=True):
        point = _gpx_point(root, "wpt", place, stamp)
        ET.SubElement(point, "name").text = str(name)
        ET.SubElement(point, "type").text = kind


def _gpx_point(parent: ET.Element, tag: str, place: list[float], stamp: str) -> ET.Element:
    longitude, latitude, height = map(str, place)
    point = ET.SubElement(parent, tag, lat=latitude, lon=longitude)
    ET.SubElement(point, "ele").text = height
    if stamp:
        ET.SubElement(point, "time").text = stamp
    return point


def _radii(source: Exported) -> list[str]:
    """The 95 % radius of each leg, in words."""
    begins, ends = (utc_text(source.legs[f"{edge}_time_ns"], "s") for edge in ("begin", "end"))
    radii_m = source.legs["uncertainty_95_m"].tolist()
    return [
        f"{begin} to {end}: 95 % within {radius_m:.1f} m"
        for begin, end, radius_m in zip(begins, ends, radii_m, strict=True)
        if math.isfinite(radius_m)
    ]


def lon_lat_height(table: Table) -> list[list[float]]:
    """Longitude, latitude (to 0.1 mm) and height (to 1 mm) of each point."""
    degrees = np.column_stack([table["longitude_deg"], table["latitude_deg"]]).round(9)
    height_m = -table["depth_m"].round(3)
    return [[x, y, z] for (x, y), z in zip(degrees.tolist(), height_m.tolist(), strict=True)]


# --- GeoJSON ----------------------------------------------------------------------------------


def _line(table: Table, properties: dict[str, Any]) -> dict[str, Any]:
    begins, ends = utc_text(table["time_ns"][[0, -1]])
    properties |= {"begins": begins, "ends": ends, "points": len(table["time_ns"])}
    return _feature("LineString", lon_lat_height(table), properties)


def _legs(source: Exported) -> list[dict[str, Any]]:
    """The smoother's legs with their 95 % radius."""
    track, legs = source.tracks.get("smoother"), source.legs
    if track is None:
        return []
    begins, ends = legs["begin_time_ns"], legs["end_time_ns"]
    first = np.searchsorted(track["time_ns"], begins)
    last = np.searchsorted(track["time_ns"], ends, side="right")
    features = []
    for low, high, radius_m in zip(first, last, legs["uncertainty_95_m"].tolist(), strict=True):
        if high - low > 1:
            rows = {name: column[low:high] for name, column in track.items()}
            features.append(_line(rows, {"kind": "leg", "uncertainty_95_m": _known(radius_m)}))
    return features


def _points(table: Table, kind: str, names: tuple[str, ...]) -> list[dict[str, Any]]:
    columns = {name: table[name].tolist() for name in names}
    if "time_ns" in table:
        columns["time"] = utc_text(table["time_ns"])
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    return [
        _feature("Point", place, {"kind": kind, **{k: _known(v) for k, v in row.items()}})
        for place, row in zip(lon_lat_height(table), rows, strict=True)
    ]


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


# --- KML --------------------------------------------------------------------------------------


def _child(parent: ET.Element, name: str, text: str | None = None) -> ET.Element:
    child = ET.SubElement(parent, f"{{{_KML}}}{name}")
    child.text = text
    return child


def _moving(document: ET.Element, name: str, table: Table, colour: str) -> None:
    """A line with the instant of each point."""
    mark = _child(document, "Placemark")
    _child(mark, "name", name)
    _style(mark, colour)
    track = ET.SubElement(mark, f"{{{_GX}}}Track")
    _child(track, "altitudeMode", "absolute")
    for stamp in utc_text(table["time_ns"]):
        _child(track, "when", stamp)
    for x, y, z in lon_lat_height(table):
        ET.SubElement(track, f"{{{_GX}}}coord").text = f"{x} {y} {z}"


def _places(document: ET.Element, name: str, table: Table, names: list[str]) -> None:
    folder = _child(document, "Folder")
    _child(folder, "name", name)
    _child(folder, "visibility", "1" if name == "beacons" else "0")
    stamps = utc_text(table["time_ns"]) if "time_ns" in table else [None] * len(names)
    for place, text, stamp in zip(lon_lat_height(table), names, stamps, strict=True):
        mark = _child(folder, "Placemark")
        _child(mark, "name", str(text))
        if stamp is not None:
            _child(_child(mark, "TimeStamp"), "when", stamp)
        _style(mark, BEACON if stamp is None else method_colour("fix"))
        point = _child(mark, "Point")
        _child(point, "altitudeMode", "absolute")
        _child(point, "coordinates", ",".join(map(str, place)))


def _kml_legs(document: ET.Element, source: Exported) -> None:
    folder = _child(document, "Folder")
    _child(folder, "name", "legs with the 95 % radius")
    _child(folder, "visibility", "0")
    for leg in _legs(source):
        radius_m = leg["properties"]["uncertainty_95_m"]
        mark = _child(folder, "Placemark")
        _child(mark, "name", "no radius" if radius_m is None else f"95 % within {radius_m:.1f} m")
        span = _child(mark, "TimeSpan")
        _child(span, "begin", leg["properties"]["begins"])
        _child(span, "end", leg["properties"]["ends"])
        _style(mark, method_colour("smoother"))
        if radius_m is not None:
            datum = _child(_child(mark, "ExtendedData"), "Data")
            datum.set("name", "uncertainty_95_m")
            _child(datum, "value", str(radius_m))
        line = _child(mark, "LineString")
        _child(line, "altitudeMode", "absolute")
        places = leg["geometry"]["coordinates"]
        _child(line, "coordinates", " ".join(",".join(map(str, place)) for place in places))


def _style(mark: ET.Element, colour: str) -> None:
    # KML writes alpha, blue, green, red
    written = f"ff{colour[5:7]}{colour[3:5]}{colour[1:3]}"
    style = _child(mark, "Style")
    icon = _child(style, "IconStyle")
    _child(icon, "color", written)
    line = _child(style, "LineStyle")
    _child(line, "color", written)
    _child(line, "width", "2")
