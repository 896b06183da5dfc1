# SPDX-License-Identifier: Apache-2.0
"""Stage pose: where the vehicle, or a sensor on it, was at any instants."""

from pathlib import Path

from abyssnav.pose.instants import Instants, read_instants
from abyssnav.pose.interpolate import IN_LINE, Mounting, Poses, poses_at, poses_of_solution
from abyssnav.pose.write import write_all, write_photogrammetry, write_poses
from abyssnav.results import one_dive

__all__ = [
    "IN_LINE",
    "Instants",
    "Mounting",
    "Poses",
    "poses_at",
    "poses_of_dive",
    "poses_of_solution",
    "read_instants",
    "write_all",
    "write_photogrammetry",
    "write_poses",
]


def poses_of_dive(
    dive: str | Path, instants: Instants, method: str | None = None, mounting: Mounting = IN_LINE
) -> Poses:
    """Poses of a sensor at given instants, from the `tracks.parquet` of a dive's folder.

    Parameters
    ----------
    dive : an output folder, `OUT/<dive>`, or its URL
    method : the smoother's track if not given, or the best that there is
    mounting : where the sensor sits; the navigated point, in line with the vehicle, if not given

    Raises
    ------
    ReadError
        The folder is no dive's, an older version made it, or it has no such method.
    """
    with one_dive(str(dive), ("tracks.parquet",)) as folder:
        return poses_at(folder / "tracks.parquet", instants.time_ns, method, mounting)
