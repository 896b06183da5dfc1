# SPDX-License-Identifier: Apache-2.0
"""Beacons from a table of text, as surveys hand them over."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from abyssnav.config import BeaconSetting, on_earth
from abyssnav.errors import ConfigError, nearest_names

#: Our column by the names that surveys give it, without underscores and unit.
_COLUMNS = {
    "id": "id", "no": "id", "number": "id", "name": "name", "label": "name",
    "latitude": "latitude_deg", "lat": "latitude_deg",
    "longitude": "longitude_deg", "lon": "longitude_deg", "long": "longitude_deg",
    "depth": "depth_m", "east": "east_m", "north": "north_m", "up": "up_m",
    "turnaround": "turn_around_s", "tat": "turn_around_s", "turnaroundtime": "turn_around_s",
    "sigma": "sigma_m",
}  # fmt: skip
_UNIT = r"_(deg|m|s|ms)$"
_GEODETIC, _LOCAL = ("latitude_deg", "longitude_deg", "depth_m"), ("east_m", "north_m", "up_m")


def beacons_from_file(path: Path) -> tuple[BeaconSetting, ...]:
    """Beacons of a table whose first line names the columns, a leading `#` allowed.

    Columns are separated by commas, semicolons, tabs or blanks: `id`, or the number in `name`;
    `latitude_deg` `longitude_deg` `depth_m`, or `east_m` `north_m` `up_m`; `turn_around_s`;
    `sigma_m`.  Known too: lat, lon, depth, turnaround, tat, and `_ms` for milliseconds.

    Raises
    ------
    ConfigError
        The file cannot be read, lacks a column, or has a row that cannot be; with the line.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path}: cannot be read: {why}") from None
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not lines:
        raise ConfigError(f"{path}: no line names the columns")
    first = lines[0][1].lstrip("#").strip()
    separator = next((s for s in (",", ";", "\t") if s in first), None)
    columns = _columns(_cells(first, separator), path)
    rows = [(n, line) for n, line in lines[1:] if not line.startswith("#")]
    beacons = tuple(
        _beacon(_cells(line, separator), columns, f"{path}, line {n}") for n, line in rows
    )
    if not beacons:
        raise ConfigError(f"{path}: no beacon below the names of the columns")
    ids = [beacon.id for beacon in beacons]
    twice = next((number for k, number in enumerate(ids) if number in ids[:k]), None)
    if twice is not None:
        raise ConfigError(f"{path}: beacon {twice} is there {ids.count(twice)} times")
    return beacons


def _cells(line: str, separator: str | None) -> list[str]:
    return [cell.strip().strip("\"'") for cell in line.split(separator)]


def _columns(names: Sequence[str], path: Path) -> list[tuple[str, float]]:
    """Our column and the factor to our unit of each of the file's."""
    columns = []
    for name in names:
        unit = re.search(_UNIT, name.lower())
        bare = re.sub(_UNIT, "", name.lower()).replace("_", "")
        if bare not in _COLUMNS:
            nearest = nearest_names(bare, _COLUMNS)
            raise ConfigError(f"{path}: unknown column {name!r}; nearest: {_COLUMNS[nearest[0]]}")
        ours = _COLUMNS[bare]
        if unit and not ours.endswith("_s" if unit[1] == "ms" else f"_{unit[1]}"):
            raise ConfigError(f"{path}: column {name!r}: {ours} is not in {unit[1]}")
        columns.append((ours, 1e-3 if unit and unit[1] == "ms" else 1.0))
    known = [ours for ours, _ in columns]
    for needed in ("id or name", "turn_around_s"):
        if not any(name in known for name in needed.split(" or ")):
            raise ConfigError(f"{path}: no column {needed}")
    if not (set(_GEODETIC) <= set(known) or set(_LOCAL) <= set(known)):
        raise ConfigError(f"{path}: no columns {', '.join(_GEODETIC)}, nor {', '.join(_LOCAL)}")
    return columns


def _beacon(
    cells: Sequence[str], columns: Sequence[tuple[str, float]], where: str
) -> BeaconSetting:
    if len(cells) != len(columns):
        raise ConfigError(f"{where}: {len(cells)} values for {len(columns)} columns")
    texts = {ours: cell for (ours, _), cell in zip(columns, cells, strict=True)}
    numbers = {
        ours: _number(cell, ours, where) * factor
        for (ours, factor), cell in zip(columns, cells, strict=True)
        if ours not in ("id", "name")
    }
    place = _place(numbers, where)
    name = texts.get("name", "")
    return BeaconSetting(
        id=_whole(texts.get("id", ""), name, where),
        name=name,
        turn_around_s=numbers["turn_around_s"],
        sigma_m=numbers.get("sigma_m", 0.0),
        position_m=None if "latitude_deg" in place else tuple(place[axis] for axis in _LOCAL),  # type: ignore[arg-type]
        latitude_deg=place.get("latitude_deg"),
        longitude_deg=place.get("longitude_deg"),
        depth_m=place.get("depth_m"),
    )


def _place(numbers: Mapping[str, float], where: str) -> dict[str, float]:
    """The columns of the place; latitude and longitude go before a local one."""
    names = _GEODETIC if set(_GEODETIC) <= numbers.keys() else _LOCAL
    place = {name: numbers[name] for name in names}
    if names is _GEODETIC and not on_earth(place["latitude_deg"], place["longitude_deg"]):
        which = f"{place['latitude_deg']}, {place['longitude_deg']}"
        raise ConfigError(f"{where}: {which} is no latitude and longitude")
    return place


def _number(cell: str, name: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{where}: {name}: {cell!r} is no number")
    return value


def _whole(cell: str, name: str, where: str) -> int:
    """The beacon's number: its own, or the one in its name."""
    digits = re.findall(r"\d{1,18}", cell or name)
    if len(digits) != 1:
        raise ConfigError(f"{where}: {(cell or name)!r} has not one number in it")
    return int(digits[0])
