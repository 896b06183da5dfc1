# SPDX-License-Identifier: Apache-2.0
"""Faults that stand in the numbers of one sensor: a heading that never changes, exact zeros."""

from typing import NamedTuple

import numpy as np

from abyssnav.diagnose.cause import CERTAIN, Cause, Mend
from abyssnav.tables import Bool, Dive

#: No compass in a vehicle reads one and the same number for so long; rad, s, share of the dive.
_STILL_RAD, _STILL_S, _STILL_SHARE = 1e-4, 120.0, 0.05
#: Exact zeros count where the vehicle ran faster within so many rows, and as this share at least.
_RUNNING_MPS, _NEAR_ROWS, _ZERO_SHARE, _LEAST_ZEROS = 0.2, 50, 0.001, 5


class Zeros(NamedTuple):
    """Velocities that are exactly zero though the vehicle runs."""

    rows: Bool
    cause: Cause | None


def zeros_for_lost_lock(dive: Dive) -> Zeros:
    """Rows (n,) of exact zeros among velocities of a running vehicle, and what they mean."""
    velocity = dive.velocity
    zero = velocity.valid & np.all(velocity.velocity_body_mps[:, :2] == 0.0, axis=1)
    n_zero = int(zero.sum())
    if n_zero < max(_LEAST_ZEROS, _ZERO_SHARE * len(velocity)):
        return Zeros(np.zeros(len(velocity), dtype=bool), None)
    speed_mps = np.hypot(*velocity.velocity_body_mps[:, :2].T)
    moving = velocity.valid & ~zero
    running = moving.any() and float(np.median(speed_mps[moving])) > _RUNNING_MPS
    if not running:
        return Zeros(np.zeros(len(velocity), dtype=bool), None)
    share = n_zero / max(int(velocity.valid.sum()), 1)
    return Zeros(
        zero,
        Cause(
            "velocity",
            "zeros_when_lost",
            f"{n_zero} zeros",
            CERTAIN,
            Mend(
                'valid = { field = "...", differs_from = 0 }',
                "under [velocity] of the profile, with the field by which the driver tells lost "
                "lock, or without one the forward velocity's own",
            ),
            f"{n_zero:,} velocities ({100 * share:.1f} %) are exactly zero, forward and "
            f"starboard, between others of {np.median(speed_mps[moving]):.1f} m/s.",
        ),
    )


def compass_stands_still(dive: Dive) -> Cause | None:
    """A heading that is one number for minutes: no compass that works does that."""
    heading = dive.heading
    if len(heading) < 3:
        return None
    changed = np.concatenate([[True], np.abs(np.diff(heading.heading_rad)) > _STILL_RAD, [True]])
    edges = np.flatnonzero(changed)
    length_s = heading.t_s[np.minimum(edges[1:], len(heading) - 1)] - heading.t_s[edges[:-1]]
    still_s = float(length_s[length_s > _STILL_S].sum())
    total_s = float(np.ptp(heading.t_s))
    if still_s < _STILL_SHARE * total_s or still_s <= 0:
        return None
    return Cause(
        "heading",
        "heading_constant",
        f"{np.degrees(heading.heading_rad[0]) % 360:.1f} deg",
        CERTAIN._replace(gain=2 * CERTAIN.gain),
        Mend(
            "",
            "Find the topic and field that hold the heading (abyssnav inspect lists them), and "
            "name them under [heading] of the profile",
        ),
        f"The heading stays on one and the same number for {still_s / 60:.0f} of "
        f"{total_s / 60:.0f} min, to a hundredth of a degree.",
    )
