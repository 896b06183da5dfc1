# SPDX-License-Identifier: Apache-2.0
"""What is exported: tracks of a dive's output folder, and what stands beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from abyssnav.atomic import COMPLETION_MARKER
from abyssnav.errors import ConfigError
from abyssnav.outputs.parquet import FILES
from abyssnav.results import chosen_methods, read_summary, read_table
from abyssnav.tables import Float, Origin, in_order

Table = Mapping[str, NDArray[Any]]
#: What heights in exports are: no dive says where the water's surface lies above the ellipsoid.
HEIGHT: Final = "metres above the water's surface, negative below it (minus the measured depth)"
#: Files that `load` needs; `reference.parquet` where there is one.
SOURCES: Final = (
    "tracks.parquet", "fixes.parquet", "errors.parquet", "beacons.parquet", "accuracy.parquet",
    "reference.parquet", "solution.mcap",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Exported:
    """A dive's output, `time_ns` int64 UTC in each table; numbers that do not exist are NaN."""

    name: str
    folder: Path
    version: str
    origin: Origin | None
    tracks: Mapping[str, Table]  #: method -> the columns of `tracks.parquet`
    fixes: Table  #: the consistent ones, with latitude and longitude
    beacons: Table
    legs: Table  #: of `accuracy.parquet`
    reference: Table | None
    errors: Mapping[tuple[str, str], Table]  #: (method, reference) -> time_ns, distance_m
    attribution: Mapping[str, str] = field(default_factory=dict)  #: who made it, as settings say
    surface_height_m: float | None = None  #: of the water's surface above the ellipsoid, if given

    def need_origin(self, kind: str) -> None:
        """Refuse a format that needs latitude and longitude where there is no origin."""
        if self.origin is None:
            raise ConfigError(
                f"{self.name}: {kind} needs latitude and longitude, and the dive has no origin; "
                "give [origin] in the config and run it again"
            )

    def radius_95_m(self, time_ns: NDArray[np.int64]) -> Float:
        """The 95 % radius of the smoother's leg at each instant; NaN where there is none."""
        begin, end = self.legs["begin_time_ns"], self.legs["end_time_ns"]
        if not len(begin):
            return np.full(len(time_ns), np.nan)
        row = np.clip(np.searchsorted(begin, time_ns, side="right") - 1, 0, len(begin) - 1)
        inside = (time_ns >= begin[row]) & (time_ns <= end[row])
        return np.where(inside, self.legs["uncertainty_95_m"][row], np.nan)


def load(dive: Path, methods: Sequence[str] = ()) -> Exported:
    """Tables of an output folder.

    Parameters
    ----------
    methods : whose tracks; `all`; the smoother's, or the best that there is, if none is given

    Raises
    ------
    ReadError
        A file is missing or damaged, an older version made it, or a method has no track in this
        dive.
    """
    tracks = read_table(dive / "tracks.parquet", _names("tracks"))
    errors = read_table(dive / "errors.parquet", _names("errors")).columns
    fixes = read_table(dive / "fixes.parquet", _names("fixes")).columns
    pairs = np.unique(np.column_stack([errors["method"], errors["reference"]]), axis=0)
    path = dive / "reference.parquet"
    present = in_order(set(tracks.columns["method"].tolist()))
    chosen = chosen_methods(present, present if "all" in methods else methods, str(dive))
    return Exported(
        name=dive.resolve().name,
        folder=dive,
        version=tracks.version,
        origin=tracks.origin,
        tracks={m: _rows(tracks.columns, tracks.columns["method"] == m) for m in chosen},
        fixes=_on_earth(_rows(fixes, fixes["consistent"].astype(bool)), tracks.origin),
        beacons=read_table(dive / "beacons.parquet", _names("beacons")).columns,
        legs=read_table(dive / "accuracy.parquet", _names("accuracy")).columns,
        reference=read_table(path, _names("reference")).columns if path.is_file() else None,
        errors={
            (str(m), str(r)): _rows(errors, (errors["method"] == m) & (errors["reference"] == r))
            for m, r in pairs
            if m in chosen or m == "fix"
        },
        attribution=_attribution(dive),
    )


def _attribution(dive: Path) -> dict[str, str]:
    """What the settings of the run say of who made the data."""
    if not (dive / COMPLETION_MARKER).is_file():
        return {}
    stated = (read_summary(dive).get("settings") or {}).get("attribution") or {}
    return {name: str(text) for name, text in stated.items() if text}


def _names(file: str) -> list[str]:
    return [column.name for column in FILES[file].columns()]


def _on_earth(table: dict[str, NDArray[Any]], origin: Origin | None) -> Table:
    from abyssnav.geometry import enu_to_geodetic

    unknown = np.full(len(table["east_m"]), np.nan)
    if origin is None:
        return table | {"latitude_deg": unknown, "longitude_deg": unknown}
    enu_m = np.column_stack([table["east_m"], table["north_m"], -table["depth_m"]])
    place = enu_to_geodetic(origin.latitude_deg, origin.longitude_deg, enu_m)
    return table | {"latitude_deg": place[0], "longitude_deg": place[1]}


def _rows(table: Mapping[str, NDArray[Any]], mask: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    return {name: column[mask] for name, column in table.items()}
