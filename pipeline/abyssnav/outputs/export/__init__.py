# SPDX-License-Identifier: Apache-2.0
"""Stage export: a dive's tracks as the files that people's other tools open."""

import difflib
from collections.abc import Callable
from pathlib import Path
from typing import Final

from abyssnav.errors import ConfigError
from abyssnav.outputs.export.earth import write_geojson, write_gpx, write_kmz
from abyssnav.outputs.export.figures import write_png, write_svg
from abyssnav.outputs.export.source import Exported, load
from abyssnav.outputs.export.tabular import write_csv, write_netcdf, write_tum

#: Name -> what writes it; each takes the tracks and a folder, and returns the files it made.
FORMATS: Final[dict[str, Callable[[Exported, Path], list[Path]]]] = {
    "geojson": write_geojson,
    "kmz": write_kmz,
    "gpx": write_gpx,
    "csv": write_csv,
    "tum": write_tum,
    "netcdf": write_netcdf,
    "png": write_png,
    "svg": write_svg,
}


def export(dive: Path, to: str, folder: Path | None = None) -> list[Path]:
    """Write one format of a dive's output folder.

    Parameters
    ----------
    dive : an output folder, `OUT/<dive>`
    to : one of `FORMATS`
    folder : where to; `OUT/<dive>/export` when not given

    Returns
    -------
    paths : the files written

    Raises
    ------
    ConfigError
        An unknown format, or one that needs what the dive or the machine has not: an origin,
        matplotlib.
    ReadError
        The folder is no output of a dive.
    """
    if to not in FORMATS:
        nearest = difflib.get_close_matches(to, FORMATS, n=1, cutoff=0.0)[0]
        raise ConfigError(f"no export to {to!r}; nearest: {nearest}; known: {', '.join(FORMATS)}")
    source = load(dive)
    place = folder or dive / "export"
    place.mkdir(parents=True, exist_ok=True)
    return FORMATS[to](source, place)
