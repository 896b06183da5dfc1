# SPDX-License-Identifier: Apache-2.0
"""Where the beacons were taken to be, where the frame's zero lies, and how fast sound was taken."""

from html import escape

import numpy as np

from abyssnav.geometry import enu_to_geodetic
from abyssnav.outputs.html.words import number, table
from abyssnav.tables import Dive


def beacon_table(dive: Dive) -> str:
    """Positions and turn-around times as used; latitude and longitude where there is an origin."""
    beacons, origin = dive.beacons, dive.origin
    head = ["beacon", "id", "east [m]", "north [m]", "depth [m]", "turn-around [s]", "sigma [m]"]
    cells = [
        [escape(str(name)) for name in beacons.name],
        [str(k) for k in beacons.id],
        *([f"{x:,.2f}" for x in column] for column in (beacons.position_enu_m * [1, 1, -1]).T),
        [f"{tau_s:.4f}" for tau_s in beacons.turn_around_s],
        [number(sigma_m) for sigma_m in beacons.sigma_m],
    ]
    if origin is not None:
        place = (origin.latitude_deg, origin.longitude_deg)
        latitude_deg, longitude_deg, _ = enu_to_geodetic(*place, beacons.position_enu_m)
        head += ["latitude [°]", "longitude [°]"]
        cells += [[f"{x:.7f}" for x in column] for column in (latitude_deg, longitude_deg)]
    return table("Beacons as used", head, list(zip(*cells, strict=True)), "beacons")


def surroundings(dive: Dive) -> str:
    """Origin and sound speed in a sentence each."""
    where = "The log gives no origin: positions are local only."
    if dive.origin is not None:
        place = f"{dive.origin.latitude_deg:.7f}°, {dive.origin.longitude_deg:.7f}°"
        where = f"Origin of east and north: {place} (WGS 84)."
    speed_mps, depth_m = dive.sound_speed.sound_speed_mps, dive.sound_speed.depth_m
    source = "".join(c.detail for c in dive.checks if c.name == "sound_speed_mean")
    told = f"{speed_mps[0]:.1f} m/s at all depths"
    if np.ptp(speed_mps):
        told = (
            f"{speed_mps.min():.1f} to {speed_mps.max():.1f} m/s in {len(depth_m)} levels, "
            f"{depth_m[0]:,.0f} to {depth_m[-1]:,.0f} m deep"
        )
    return f"<p>{where} Sound speed: {told}{f', of {escape(source)}' if source else ''}.</p>"
