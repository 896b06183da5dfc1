# SPDX-License-Identifier: Apache-2.0
"""Tracks on the globe: GeoJSON, KMZ and GPX, WGS 84, heights in metres above the surface."""

import json
import zipfile
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from abyssnav.outputs.export.source import Exported, Table
from abyssnav.outputs.palette import method_colour
from abyssnav.tables import Int

_KML = "http://www.opengis.net/kml/2.2"
_GPX = "http://www.topografix.com/GPX/1/1"
_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)  # no wall clock inside: the same track gives the same bytes


def write_geojson(source: Exported, folder: Path) -> list[Path]:
    """One feature collection (RFC 7946): a line a method, with the colour of its plots."""
    source.on_earth("GeoJSON")
    features = [
        {
            "type": "Feature",
            "properties": {
                "dive": source.name,
                "method": method,
                "begins": _utc(track["time_ns"][:1])[0],
                "ends": _utc(track["time_ns"][-1:])[0],
                "points": len(track["time_ns"]),
                "stroke": method_colour(method),
            },
            "geometry": {"type": "LineString", "coordinates": _lon_lat_height(track)},
        }
        for method, track in source.tracks.items()
    ]
    path = folder / f"{source.name}.geojson"
    collection = {"type": "FeatureCollection", "features": features}
    path.write_text(json.dumps(collection, allow_nan=False) + "\n", encoding="utf-8")
    return [path]


def write_kmz(source: Exported, folder: Path) -> list[Path]:
    """A zipped KML: a line a method, at its depth below the sea's surface."""
    source.on_earth("KMZ")
    root = ET.Element("kml", xmlns=_KML)
    document = ET.SubElement(root, "Document")
    ET.SubElement(document, "name").text = source.name
    for method, track in source.tracks.items():
        colour = method_colour(method)
        mark = ET.SubElement(document, "Placemark")
        ET.SubElement(mark, "name").text = method
        span = ET.SubElement(mark, "TimeSpan")
        ET.SubElement(span, "begin").text = _utc(track["time_ns"][:1])[0]
        ET.SubElement(span, "end").text = _utc(track["time_ns"][-1:])[0]
        style = ET.SubElement(ET.SubElement(mark, "Style"), "LineStyle")
        # KML writes alpha, blue, green, red
        ET.SubElement(style, "color").text = f"ff{colour[5:7]}{colour[3:5]}{colour[1:3]}"
        ET.SubElement(style, "width").text = "2"
        line = ET.SubElement(mark, "LineString")
        ET.SubElement(line, "altitudeMode").text = "absolute"
        places = _lon_lat_height(track)
        ET.SubElement(line, "coordinates").text = " ".join(f"{x},{y},{z}" for x, y, z in places)
    path = folder / f"{source.name}.kmz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        entry = zipfile.ZipInfo("doc.kml", _ZIP_EPOCH)
        entry.compress_type = zipfile.ZIP_DEFLATED
        archive.writestr(entry, ET.tostring(root, encoding="utf-8", xml_declaration=True))
    return [path]


def write_gpx(source: Exported, folder: Path) -> list[Path]:
    """GPX 1.1: a track a method; `ele` is minus the depth."""
    source.on_earth("GPX")
    root = ET.Element("gpx", xmlns=_GPX, version="1.1", creator=f"abyssnav {source.version}")
    for method, track in source.tracks.items():
        line = ET.SubElement(root, "trk")
        ET.SubElement(line, "name").text = f"{source.name} {method}"
        segment = ET.SubElement(line, "trkseg")
        for (x, y, z), at in zip(_lon_lat_height(track), _utc(track["time_ns"]), strict=True):
            point = ET.SubElement(segment, "trkpt", lat=str(y), lon=str(x))
            ET.SubElement(point, "ele").text = str(z)
            ET.SubElement(point, "time").text = at
    path = folder / f"{source.name}.gpx"
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    return [path]


def _lon_lat_height(track: Table) -> list[list[float]]:
    """Longitude, latitude (to 0.1 mm) and height (to 1 mm) of each point."""
    degrees = np.column_stack([track["longitude_deg"], track["latitude_deg"]]).round(9)
    height_m = -track["depth_m"].round(3)
    return [[x, y, z] for (x, y), z in zip(degrees.tolist(), height_m.tolist(), strict=True)]


def _utc(time_ns: Int) -> list[str]:
    """UTC to the millisecond, as ISO 8601."""
    stamps = np.datetime_as_string(time_ns.view("M8[ns]"), unit="ms")
    return [f"{stamp}Z" for stamp in stamps]
