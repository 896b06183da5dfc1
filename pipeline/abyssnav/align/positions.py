# SPDX-License-Identifier: Apache-2.0
"""Position fixes of another kind, GNSS or USBL, in the local frame."""

import numpy as np

from abyssnav.align.replies import lever_enu_m
from abyssnav.geometry import geodetic_to_enu
from abyssnav.tables import Check, Columns, Float, Heading, Origin, Positions

#: No survey's frame reaches farther; nor is a fix so far away of this dive.
_FARTHEST_M = 1e6


def positions_of(
    columns: Columns, start_ns: int, origin: Origin | None, heading: Heading, where: str
) -> tuple[Positions | None, list[Check]]:
    """Fixes of the antenna or transponder with its lever arm; None where they cannot be placed.

    Parameters
    ----------
    where : the topics, for people
    """
    t_s = np.asarray((columns["time_ns"] - start_ns) / 1e9)
    position_m = _placed(columns, origin)
    if position_m is None:
        detail = f"{where}: by latitude and longitude, and no origin is known: [origin] of settings"
        return None, [Check("align", "positions", 0, 0, "fixes", False, detail)]
    near = np.all(np.abs(position_m) < _FARTHEST_M, axis=1)
    lost = int(np.sum(~near))
    checks = [
        Check("align", "positions", int(near.sum()), 0, "fixes", True, where),
        Check("align", "positions_far_away", lost, 0, "fixes", lost == 0,
              f"{where}: more than {_FARTHEST_M / 1e3:.0f} km from the origin: left out"
              if lost else ""),
    ]  # fmt: skip
    if not near.any():
        return None, checks
    offset_m = columns.get("offset_m", np.zeros((len(t_s), 3)))[0]
    return Positions(
        t_s=t_s[near],
        position_enu_m=position_m[near],
        position_cov_m2=columns["cov_m2"][near],
        lever_enu_m=lever_enu_m(t_s[near], heading, offset_m),
    ), checks


def _placed(columns: Columns, origin: Origin | None) -> Float | None:
    if "position_enu_m" in columns:
        return np.asarray(columns["position_enu_m"], dtype=float)
    if origin is None:
        return None
    latitude_deg, longitude_deg = columns["latitude_deg"], columns["longitude_deg"]
    return geodetic_to_enu(
        origin.latitude_deg, origin.longitude_deg, latitude_deg, longitude_deg,
        np.zeros(len(latitude_deg)),
    )[:, :2]  # fmt: skip
