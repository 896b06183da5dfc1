# SPDX-License-Identifier: Apache-2.0
"""Stage export: a dive's tracks as the files that people's other tools open."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from abyssnav.errors import ConfigError, nearest_hint
from abyssnav.outputs.export.earth import write_geojson, write_gpx, write_kmz
from abyssnav.outputs.export.figures import write_png, write_svg
from abyssnav.outputs.export.geopackage import write_gpkg
from abyssnav.outputs.export.rosbag import write_rosbag2
from abyssnav.outputs.export.source import SOURCES, Exported, load
from abyssnav.outputs.export.survey import write_nve, write_sbet
from abyssnav.outputs.export.tabular import write_csv, write_netcdf, write_tum
from abyssnav.remote import is_url
from abyssnav.results import one_dive

#: Name -> what writes it; each takes the tracks and a folder, and returns the files it made.
FORMATS: Final[dict[str, Callable[[Exported, Path], list[Path]]]] = {
    "geojson": write_geojson,
    "kmz": write_kmz,
    "gpx": write_gpx,
    "gpkg": write_gpkg,
    "csv": write_csv,
    "tum": write_tum,
    "netcdf": write_netcdf,
    "nve": write_nve,
    "sbet": write_sbet,
    "rosbag2": write_rosbag2,
    "png": write_png,
    "svg": write_svg,
}


def export(
    dive: str | Path,
    to: str,
    methods: Sequence[str] = (),
    folder: Path | None = None,
    surface_height_m: float | None = None,
) -> list[Path]:
    """Write one format of a dive's output folder.

    Parameters
    ----------
    dive : an output folder, `OUT/<dive>`, or its URL
    to : one of `FORMATS`
    methods : whose tracks; `all`; the smoother's, or the best that there is, if none is given
    folder : where to; `OUT/<dive>/export` when not given
    surface_height_m : height of the water's surface above the WGS 84 ellipsoid, which `sbet` needs

    Returns
    -------
    paths : the files written

    Raises
    ------
    ConfigError
        An unknown format, or one that needs what the dive or the machine has not: an origin,
        attitude, matplotlib.
    ReadError
        The folder is no output of a dive, an older version made it, or it has no such method.
    """
    if to not in FORMATS:
        raise ConfigError(f"no export to {to!r}{nearest_hint(to, FORMATS)}")
    if surface_height_m is not None and to != "sbet":
        raise ConfigError(
            f"{to} states no height above the ellipsoid: --surface-height-m is sbet's"
        )
    if is_url(str(dive)) and folder is None:
        raise ConfigError(f"{dive}: where to?  Give --output, as nothing is written beside a URL")
    with one_dive(str(dive), SOURCES) as result:
        place = folder or result / "export"
        source = replace(load(result, methods), surface_height_m=surface_height_m)
        place.mkdir(parents=True, exist_ok=True)
        return FORMATS[to](source, place)
